"""A question to a human: what is asked, bound by digest to exactly what was shown, and what became of it.

Two kinds. `approval` is asked before launch, `session` while a session is held in mid-execution. Both have a deadline
that policy sets; silence denies the one and terminates the other, and is reported as what it is.

Three versions of the parameters are kept: as requested, as policy constrained them (`constrained`), and as approved
(`effective`, which an approver may have edited).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import orjson

from app.audit.event import RowWrite
from app.clock import parse_rfc3339
from app.runtime.identity import digest
from app.runtime.invocation import PRIVATE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from app.runtime.invocation import Invocation

APPROVAL: Final = "approval"
SESSION_QUESTION: Final = "session"
PENDING: Final = "pending"
APPROVED: Final = "approved"
DENIED: Final = "denied"
EXPIRED: Final = "expired"
WITHDRAWN: Final = "withdrawn"


@dataclass(frozen=True, slots=True, kw_only=True)
class Escalation:
    """The newest version of one question; `evolve` makes the next."""

    id: str
    invocation: str
    kind: str
    capability: str
    risk: str
    agent: str
    reasons: Sequence[Mapping[str, str]]
    requested: Mapping[str, Any]
    constrained: Mapping[str, Any]
    effective: Mapping[str, Any]
    digest: str
    status: str
    approvals: Sequence[Mapping[str, Any]]
    needed: int
    expires_at: str | None
    created_at: str
    updated_at: str

    @property
    def deadline_s(self) -> float | None:
        """Return when silence answers it, in wall seconds."""
        return None if self.expires_at is None else parse_rfc3339(self.expires_at)

    def evolve(self, at: str, **changes: Any) -> Escalation:  # noqa: ANN401  # fields of this class
        """Return the next version."""
        return replace(self, updated_at=at, **changes)

    def reference(self) -> dict[str, Any]:
        """Return what an invocation's document says of its escalation."""
        return {"id": self.id, "status": self.status, "expires_at": self.expires_at}

    def public(self) -> dict[str, Any]:
        """Return the document of design section 8."""
        return {
            "id": self.id,
            "invocation": self.invocation,
            "kind": self.kind,
            "capability": self.capability,
            "agent": self.agent,
            "risk": self.risk,
            "reasons": list(self.reasons),
            "requested": dict(self.requested),
            "effective": dict(self.effective),
            "digest": self.digest,
            "status": self.status,
            "approvals": [dict(approval) for approval in self.approvals],
            "needed": self.needed,
            "expires_at": self.expires_at,
        }

    def row(self) -> RowWrite:
        """Return the row that holds this version."""
        hidden = {
            "constrained": dict(self.constrained),
            "created_at": self.created_at,
            "updated_at": self.updated_at,
        }
        return RowWrite(
            table="escalations",
            values={
                "id": self.id,
                "invocation": self.invocation,
                "status": self.status,
                "expires_at": self.expires_at,
                "document": orjson.dumps({**self.public(), PRIVATE: hidden}),
                "created_at": self.created_at,
                "updated_at": self.updated_at,
            },
        )


def read_escalation(document: bytes) -> Escalation:
    """Read a stored document back."""
    fields: dict[str, Any] = orjson.loads(document)
    return Escalation(**fields.pop(PRIVATE), **fields)


def bound_digest(invocation: Invocation, effective: Mapping[str, Any]) -> str:
    """Return the digest that an approval of these parameters is bound to: whose, what, where and how."""
    return digest(
        {
            "invocation": invocation.id,
            "capability": invocation.capability,
            "cell": invocation.cell,
            "mode": invocation.terms.mode,
            "params": dict(effective),
        }
    )
