"""A question to a human: what is asked, bound by digest to exactly what was shown, and what became of it.

Two kinds. `approval` is asked before launch, `session` while a session is held in mid-execution, with the `phase` that
waits for it where policy has a human confirm one. Both have a deadline that policy sets; silence denies the one and
ends the other as policy says, and is reported as what it is.

Three versions of the parameters are kept: as requested, as policy constrained them (`constrained`), and as approved.
`effective` is what is asked about now: the constrained ones, or what an approver's edit (`edits`) came to. When another
policy comes into force, or the cell is put under another profile, an approval is decided again and bound to that:
`former_digests` are worth no answer any more, and `renewed` is the code that says why.

`carried` is what the gripper held when it was asked, where that is what is handled: the digest is of that as well.

`goal` and `task` are what the agent says it asks for, in its own words: nobody has checked them, nothing is decided by
them, and an approval is of the parameters alone. An agent may say a lot, so people are shown the beginning.
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
TERMINATE: Final = "terminate"
ROLLBACK: Final = "rollback"
RISKS: Final = ("critical", "high", "medium", "low")
POLICY_CHANGED: Final = "policy_changed"
PROFILE_CHANGED: Final = "profile_changed"
NEVER_S: Final = float("inf")
STATED_AT_MOST: Final = 160  # characters of what an agent says: two or three lines on a card


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
    on_deny: str = "deny"
    on_timeout: str = "deny"
    cell: str | None = None
    profile: str | None = None
    phase: str | None = None
    edits: Sequence[Mapping[str, Any]] = ()
    acknowledged: Sequence[Mapping[str, Any]] = ()
    denial: Mapping[str, Any] | None = None
    grant: str | None = None
    policy_version: str | None = None
    former_digests: Sequence[str] = ()
    renewed: str | None = None
    names_task: bool = False
    goal: str | None = None
    task: str | None = None
    carried: str | None = None

    @property
    def approved(self) -> Mapping[str, Any] | None:
        """Return the parameters that were approved; None while they are not, and of a session, which has its own."""
        return self.effective if self.kind == APPROVAL and self.status == APPROVED else None

    @property
    def urgency(self) -> tuple[float, int]:
        """Return what open questions are sorted by: the one that ends first, of two the one of higher risk."""
        deadline_s = self.deadline_s
        return NEVER_S if deadline_s is None else deadline_s, RISKS.index(self.risk)

    @property
    def deadline_s(self) -> float | None:
        """Return when silence answers it, in wall seconds."""
        return None if self.expires_at is None else parse_rfc3339(self.expires_at)

    def evolve(self, at: str, **changes: Any) -> Escalation:  # noqa: ANN401  # fields of this class
        """Return the next version."""
        return replace(self, updated_at=at, **changes)

    def reference(self) -> dict[str, Any]:
        """Return what an invocation's document says of its escalation: of a denial, its code."""
        reference = {"id": self.id, "status": self.status, "expires_at": self.expires_at}
        return reference if self.denial is None else {**reference, "code": self.denial["code"]}

    def public(self) -> dict[str, Any]:
        """Return the document of design section 8."""
        return {
            "id": self.id,
            "invocation": self.invocation,
            "kind": self.kind,
            "phase": self.phase,
            "capability": self.capability,
            "agent": self.agent,
            "cell": self.cell,
            "profile": self.profile,
            "risk": self.risk,
            "reasons": list(self.reasons),
            "requested": dict(self.requested),
            "constrained": dict(self.constrained),
            "effective": dict(self.effective),
            "approved": None if self.approved is None else dict(self.approved),
            "digest": self.digest,
            "former_digests": list(self.former_digests),
            "renewed": self.renewed,
            "names_task": self.names_task,
            "goal": self.goal,
            "task": self.task,
            "carried": self.carried,
            "policy_version": self.policy_version,
            "status": self.status,
            "approvals": [dict(approval) for approval in self.approvals],
            "edits": [dict(edit) for edit in self.edits],
            "needed": self.needed,
            "acknowledged": [dict(word) for word in self.acknowledged],
            "denial": None if self.denial is None else dict(self.denial),
            "grant": self.grant,
            "expires_at": self.expires_at,
            "on_deny": self.on_deny,
            "on_timeout": self.on_timeout,
            "created_at": self.created_at,
            "updated_at": self.updated_at,
        }

    def row(self) -> RowWrite:
        """Return the row that holds this version."""
        return RowWrite(
            table="escalations",
            values={
                "id": self.id,
                "invocation": self.invocation,
                "status": self.status,
                "expires_at": self.expires_at,
                "document": orjson.dumps(self.public()),
                "created_at": self.created_at,
                "updated_at": self.updated_at,
            },
        )


def stated(said: str | None) -> str | None:
    """Return the beginning of an agent's own words, in one line; None where it says nothing."""
    words = " ".join((said or "").split())
    return (words if len(words) <= STATED_AT_MOST else f"{words[: STATED_AT_MOST - 1]}…") or None


def read_escalation(document: bytes) -> Escalation:
    """Read a stored document back; one of an earlier release kept some of it apart."""
    fields: dict[str, Any] = orjson.loads(document)
    fields.pop("approved", None)
    return Escalation(**fields.pop(PRIVATE, {}), **fields)


def bound_digest(
    invocation: Invocation,
    effective: Mapping[str, Any],
    why: Sequence[Mapping[str, str]],
    phase: str | None = None,
    *,
    carried: str | None = None,
) -> str:
    """Return the digest that an approval of these parameters is bound to.

    Whose proposal, what, where, how, and under which policy and profile: the same parameters are watched differently
    under another one. For which reasons people are asked (`why`: by which rule, with which code), and what the gripper
    holds (`carried`), where that is what is handled. In mid-execution which phase waits: who lets a held session go on
    confirms none; and the reasons where they became others while somebody was asked.
    """
    return digest(
        {
            "invocation": invocation.id,
            "capability": invocation.capability,
            "cell": invocation.cell,
            "mode": invocation.terms.mode,
            "policy": invocation.policy_version,
            "profile": invocation.profile,
            "params": dict(effective),
            "why": [[because["rule"], because["code"]] for because in why],
            **({} if phase is None else {"phase": phase}),
            **({} if carried is None else {"carried": carried}),
        }
    )
