"""Events the runtime says in its own name or on a person's behalf, and the reasons it gives."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from app.audit.event import EventDraft
from app.governance.model import EventKind, PolicyOutcome

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from app.governance.model import Verdict
    from app.runtime.cells import Cell
    from app.runtime.escalation import Escalation
    from app.runtime.grant import Standing
    from app.runtime.invocation import Invocation, Principal
    from app.runtime.review import Review

SERVER: Final = "server"
GRANTED: Final = "grant:"  # what a grant is called among those who approved; no person's name begins so
ACKNOWLEDGE: Final = "acknowledge"  # somebody looks at a question; decides nothing
VOID: Final = "void"  # approvals count no more
EDIT: Final = "authority/edit"
DENIAL: Final = "authority/denial"  # by a person, for a reason that policy names


def reason(rule: str, code: str, message: str, remedy: str = "") -> dict[str, str]:
    """Return a reason of the runtime's own, in the form that policy's have."""
    return {"rule": rule, "code": code, "message": message, "remedy": remedy}


def with_reason(policy: Mapping[str, Any] | None, because: Mapping[str, str]) -> Mapping[str, Any] | None:
    """Return what policy said with one more reason: the agent learns why by code, never in a person's words."""
    return None if policy is None else {**policy, "reasons": [*policy["reasons"], because]}


def with_edit(
    policy: Mapping[str, Any], requested: Mapping[str, Any], shown: Mapping[str, Any], verdict: Verdict
) -> dict[str, Any]:
    """Return what policy said of a request after an approver's edit: the changes lead from requested to approved.

    A change names who made it: the policy rule that constrained the request or the edit, else `EDIT`.

    Args:
        policy: what was said until then, leading from `requested` to `shown`.
        requested: the agent's parameters.
        shown: the parameters that the approver edited.
        verdict: policy's word on the edit; its `effective` is what may be approved.
    """
    approved, limits = verdict.effective, {change.param: change.rule for change in verdict.changes}
    kept = [change for change in policy["changes"] if approved.get(change["param"]) == change["effective"]]
    known = {change["param"] for change in kept}
    edited = [
        {
            "param": param,
            "requested": requested.get(param),
            "effective": value,
            "rule": limits.get(param, EDIT),
        }
        for param, value in approved.items()
        if param not in known and value != requested.get(param) and value != shown.get(param)
    ]
    was_edited = any(item["rule"] == EDIT for item in policy["reasons"])
    reasons = [item for item in policy["reasons"] if item["rule"] != EDIT]
    told = {(item["rule"], item["code"]) for item in reasons}
    reasons += [item._asdict() for item in verdict.reasons if (item.rule, item.code) not in told]
    if was_edited or approved != shown:  # an edit that policy cuts to what was asked before changes nothing
        reasons.append(reason(EDIT, "edited_by_human", "a human changed this before approving it"))
    changes = [*kept, *edited]
    outcome = policy["outcome"]
    if outcome in {PolicyOutcome.ALLOW, PolicyOutcome.MODIFY}:
        outcome = PolicyOutcome.MODIFY if changes else PolicyOutcome.ALLOW
    return {"outcome": outcome, "reasons": reasons, "changes": changes}


def decided_again(said: Mapping[str, Any] | None, anew: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """Return what policy said of a request, once what was approved of it was decided again and may not launch.

    The changes lead on from the request, so that the agent sees why the values are other than its own.

    Args:
        said: the verdict on the request, with what approvers edited.
        anew: the verdict on what was approved; None where admission left nothing to check.
    """
    if said is None or anew is None:
        return anew if said is None else said
    further = {change["param"]: change for change in anew["changes"]}
    before = {change["param"]: change["requested"] for change in said["changes"]}
    changes = [change for change in said["changes"] if change["param"] not in further]
    changes += [{**one, "requested": before.get(name, one["requested"])} for name, one in further.items()]
    told = {(one["rule"], one["code"]) for one in anew["reasons"]}
    reasons = [*anew["reasons"], *(one for one in said["reasons"] if (one["rule"], one["code"]) not in told)]
    outcome = anew["outcome"]
    if outcome in {PolicyOutcome.ALLOW, PolicyOutcome.MODIFY}:
        outcome = PolicyOutcome.MODIFY if changes else PolicyOutcome.ALLOW
    return {"outcome": outcome, "reasons": reasons, "changes": changes}


def outcome_event(invocation: Invocation, actor: str, *reasons: Mapping[str, str]) -> EventDraft:
    """Return the event that says how an invocation ended."""
    body = {"status": invocation.status, "outcome": invocation.outcome, "reasons": list(reasons)}
    return EventDraft(kind=EventKind.OUTCOME, actor=actor, invocation=invocation.id, body=body)


def escalation_event(escalation: Escalation) -> EventDraft:
    """Return the event that says what is asked, or that nobody answered."""
    body = {"escalation": escalation.public()}
    return EventDraft(kind=EventKind.ESCALATION, actor=SERVER, invocation=escalation.invocation, body=body)


def acknowledged_event(escalation: Escalation, principal: Principal) -> EventDraft:
    """Return the event of a person's saying that they look at a question."""
    body = {"op": ACKNOWLEDGE, "role": principal.role, "escalation": escalation.public()}
    return EventDraft(kind=EventKind.HUMAN, actor=principal.name, invocation=escalation.invocation, body=body)


def voided_event(escalation: Escalation, givers: Sequence[str], invocation: Invocation) -> EventDraft:
    """Return the event that approvals count no more: who gave them may approve nothing since."""
    edited = {"policy": invocation.policy} if escalation.edits else {}  # every approval of an edit says what policy did
    body = {"decision": VOID, "givers": list(givers), "escalation": escalation.public(), **edited}
    return EventDraft(kind=EventKind.APPROVAL, actor=SERVER, invocation=escalation.invocation, body=body)


def grant_event(op: str, actor: str, standing: Standing) -> EventDraft:
    """Return the event of a standing grant's being given, or of its end."""
    body = {"op": op, "grant": standing.public()}
    return EventDraft(kind=EventKind.GRANT, actor=actor, invocation=standing.invocation, body=body)


def review_event(op: str, actor: str, review: Review) -> EventDraft:
    """Return the event of a session's coming up for review, or of the verdict on it."""
    body = {"op": op, "review": review.public()}
    return EventDraft(kind=EventKind.REVIEW, actor=actor, invocation=review.invocation, body=body)


def human_event(op: str, invocation: Invocation, principal: Principal) -> EventDraft:
    """Return the event of a person's word on an invocation."""
    body = {"op": op, "role": principal.role, "cell": invocation.cell, "status": invocation.status}
    return EventDraft(kind=EventKind.HUMAN, actor=principal.name, invocation=invocation.id, body=body)


def cell_word(op: str, cell: Cell, principal: Principal) -> EventDraft:
    """Return the event of a person's word on a cell."""
    body = {"op": op, "role": principal.role, "cell": cell.id}
    return EventDraft(kind=EventKind.HUMAN, actor=principal.name, invocation=cell.claim, body=body)
