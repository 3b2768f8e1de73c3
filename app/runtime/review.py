"""One review of a finished session, as it is kept and shown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import orjson

from app.audit.event import RowWrite

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


def read_review(document: bytes) -> Review:
    """Read a stored document back."""
    return Review(**orjson.loads(document))


@dataclass(frozen=True, slots=True, kw_only=True)
class Review:
    """The newest version of one review: what for, and the verdict once there is one."""

    id: str
    invocation: str
    status: str  # waiting, or the verdict
    capability: str
    agent: str
    cell: str | None
    profile: str
    risk: str
    outcome: str
    reasons: Sequence[Mapping[str, str]]
    verdict: Mapping[str, Any] | None
    created_at: str
    updated_at: str

    def public(self) -> dict[str, Any]:
        """Return the document."""
        return {
            "id": self.id,
            "invocation": self.invocation,
            "status": self.status,
            "capability": self.capability,
            "agent": self.agent,
            "cell": self.cell,
            "profile": self.profile,
            "risk": self.risk,
            "outcome": self.outcome,
            "reasons": [dict(reason) for reason in self.reasons],
            "verdict": None if self.verdict is None else dict(self.verdict),
            "created_at": self.created_at,
            "updated_at": self.updated_at,
        }

    def row(self) -> RowWrite:
        """Return the row that holds this version."""
        return RowWrite(
            table="reviews",
            values={
                "id": self.id,
                "invocation": self.invocation,
                "status": self.status,
                "document": orjson.dumps(self.public()),
                "created_at": self.created_at,
                "updated_at": self.updated_at,
            },
        )
