"""The one channel: minting and verifying authorizations (design, rule 1).

An `Authorization` is serialized to canonical JSON, signed with the governance kernel's Ed25519 key, and verified by the cell before anything
is bound. `verify` is the only maker of a `Grant`, and a substrate binds nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from app.governance.model import Authorization


@dataclass(frozen=True, slots=True, kw_only=True)
class Grant:
    """A verified authorization: what a substrate needs to see before it moves."""

    authorization: Authorization
