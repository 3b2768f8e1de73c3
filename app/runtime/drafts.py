"""Events the runtime says in its own name or on a person's behalf, and the reasons it gives."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from app.audit.event import EventDraft
from app.governance.model import EventKind

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.runtime.cells import Cell
    from app.runtime.escalation import Escalation
    from app.runtime.invocation import Invocation, Principal

SERVER: Final = "server"


def reason(rule: str, code: str, message: str, remedy: str = "") -> dict[str, str]:
    """Return a reason of the runtime's own, in the form that policy's have."""
    return {"rule": rule, "code": code, "message": message, "remedy": remedy}


def with_reason(policy: Mapping[str, Any] | None, because: Mapping[str, str]) -> Mapping[str, Any] | None:
    """Return what policy said with one more reason: the agent learns why by code, never in a person's words."""
    return None if policy is None else {**policy, "reasons": [*policy["reasons"], because]}


def outcome_event(invocation: Invocation, actor: str, *reasons: Mapping[str, str]) -> EventDraft:
    """Return the event that says how an invocation ended."""
    body = {"status": invocation.status, "outcome": invocation.outcome, "reasons": list(reasons)}
    return EventDraft(kind=EventKind.OUTCOME, actor=actor, invocation=invocation.id, body=body)


def escalation_event(escalation: Escalation) -> EventDraft:
    """Return the event that says what is asked, or that nobody answered."""
    body = {"escalation": escalation.public()}
    return EventDraft(kind=EventKind.ESCALATION, actor=SERVER, invocation=escalation.invocation, body=body)


def human_event(op: str, invocation: Invocation, principal: Principal) -> EventDraft:
    """Return the event of a person's word on an invocation."""
    body = {"op": op, "role": principal.role, "cell": invocation.cell, "status": invocation.status}
    return EventDraft(kind=EventKind.HUMAN, actor=principal.name, invocation=invocation.id, body=body)


def cell_word(op: str, cell: Cell, principal: Principal) -> EventDraft:
    """Return the event of a person's word on a cell."""
    body = {"op": op, "role": principal.role, "cell": cell.id}
    return EventDraft(kind=EventKind.HUMAN, actor=principal.name, invocation=cell.claim, body=body)
