"""A session that a human drove goes on only if it would still be let run, decided again from where the robot is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from app.governance.model import EventKind
from app.runtime.cells import Told
from app.runtime.errors import Conflict
from app.runtime.hands import LAPSED
from app.runtime.invocation import reasons_document
from app.runtime.kernel import GRANTED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from app.governance.model import ApprovalNeed, Reason
    from app.runtime.cells import Cell
    from app.runtime.invocation import Invocation, Principal
    from app.runtime.kernel import Judgement
    from app.runtime.questions import Questions
    from app.runtime.register import Register


async def readmitted(
    desk: Questions, cell: Cell, present: Invocation, principal: Principal
) -> tuple[Judgement, tuple[str, ...]]:
    """Decide again on what a session does, from where the robot is now; returns the judgement and who approved it.

    Whoever approved its launch and may approve nothing any more is none of them, nor is a grant that has ended. Where
    policy has people asked from here for what nobody was shown at the launch, letting it go on is an approval of that
    only by whom a refusal has told of it: the first attempt is refused with the reasons, the same again approves them.

    Raises:
        Conflict: `resume_refused`, with the reasons.
    """
    # First: nothing is awaited between the decision and the launch.
    said, shown = await _approvals(desk.register, present.id)
    approvals = tuple(name for name in said if _counts(desk, name))
    effective = dict(present.effective or {})
    judgement = desk.kernel.judge(present.proposal(effective), present.agent, cell, within=present)
    if not judgement.conforms(effective):
        raise _refused("policy does not let it go on from here", judgement.reasons())
    if (need := judgement.need) is not None:
        # Those who were asked about all of it; a grant may be of one of them.
        asked = approvals if _codes(need) <= shown else ()
        people = {name for name in asked if not name.startswith(GRANTED)} - {present.agent}
        _check_approved(need, people, cell, present, principal)
    if principal.name not in (*approvals, present.agent):
        approvals = (*approvals, principal.name)
    return judgement, approvals


def _check_approved(
    need: ApprovalNeed, people: set[str], cell: Cell, present: Invocation, principal: Principal
) -> None:
    """Refuse what too few people have approved, among them whoever lets it go on, once they know what of."""
    if len(people) >= need.approvers:
        return
    if len(people | {principal.name} - {present.agent}) < need.approvers:
        raise _refused("it takes more approvals from here", need.reasons)
    told = Told(present.id, principal.name, _codes(need))
    if cell.told_of == told:
        return
    cell.told_of = told
    raise _refused(
        "policy has people asked about this from here; valid: the same again, which approves it", need.reasons
    )


def _refused(message: str, reasons: Sequence[Reason]) -> Conflict:
    return Conflict("resume_refused", message, reasons=reasons_document(tuple(reasons)))


def _codes(need: ApprovalNeed) -> frozenset[tuple[str, str]]:
    return frozenset((why.rule, why.code) for why in need.reasons)


def _counts(desk: Questions, name: str) -> bool:
    if name.startswith(GRANTED):
        return desk.grants.stands(name.removeprefix(GRANTED))
    return desk.grants.may_give(name)


async def _approvals(register: Register, invocation: str) -> tuple[tuple[str, ...], frozenset[tuple[str, str]]]:
    """Return who approved the session when it was launched, and by which rules and codes they were asked."""
    events = await register.store.events(invocation=invocation, kind=EventKind.AUTHORIZATION, limit=1)
    if not events:
        return (), frozenset()
    permit = cast("dict[str, list[str]]", events[0].payload()["authorization"])
    answers = await register.store.events(
        invocation=invocation, kind=EventKind.APPROVAL, before=events[0].seq, newest=True, limit=1
    )
    asked = cast("list[dict[str, dict[str, Any]]]", [answer.payload() for answer in answers])
    shown = {(why["rule"], why["code"]) for answer in asked for why in answer["escalation"]["reasons"]}
    return tuple(permit["approvals"]), frozenset(shown)


def lapsed(invocation: Invocation) -> bool:
    """Say whether a human drove this session and left without handing it back."""
    left = invocation.takeover is not None and invocation.takeover["state"] == LAPSED
    return left or invocation.terms.displaced
