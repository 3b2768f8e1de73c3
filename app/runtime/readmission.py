"""A session that a human drove goes on only if it would still be let run, decided again from where the robot is."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from app.governance.model import EventKind
from app.runtime.errors import Conflict
from app.runtime.hands import LAPSED
from app.runtime.kernel import GRANTED

if TYPE_CHECKING:
    from app.runtime.cells import Cell
    from app.runtime.invocation import Invocation, Principal
    from app.runtime.kernel import Judgement
    from app.runtime.questions import Questions
    from app.runtime.register import Register


async def readmitted(
    desk: Questions, cell: Cell, present: Invocation, principal: Principal
) -> tuple[Judgement, tuple[str, ...]]:
    """Decide again on what a session does, from where the robot is now; returns the judgement and who approved it.

    Whoever approved its launch and may approve nothing any more is none of them, nor is a grant that has ended.

    Raises:
        Conflict: `resume_refused`, with the reasons.
    """
    said = await _approvals(desk.register, present.id)  # first: nothing is awaited between the decision and the launch
    approvals = tuple(name for name in said if _counts(desk, name))
    effective = dict(present.effective or {})
    judgement = desk.kernel.judge(present.proposal(effective), present.agent, cell, within=present)
    reasons = [reason._asdict() for reason in judgement.reasons()]
    if not judgement.conforms(effective):
        raise Conflict("resume_refused", "policy does not let it go on from here", reasons=reasons)
    if principal.name not in (*approvals, present.agent):
        approvals = (*approvals, principal.name)
    people = [name for name in approvals if not name.startswith(GRANTED)]  # a grant may be of one who is among them
    if judgement.need is not None and judgement.need.approvers > len(people):
        raise Conflict("resume_refused", "it takes more approvals from here", reasons=reasons)
    return judgement, approvals


def _counts(desk: Questions, name: str) -> bool:
    if name.startswith(GRANTED):
        return desk.grants.stands(name.removeprefix(GRANTED))
    return desk.grants.may_give(name)


async def _approvals(register: Register, invocation: str) -> tuple[str, ...]:
    """Return who approved the session when it was launched."""
    events = await register.store.events(invocation=invocation, kind=EventKind.AUTHORIZATION, limit=1)
    if not events:
        return ()
    permit = cast("dict[str, list[str]]", events[0].payload()["authorization"])
    return tuple(permit["approvals"])


def lapsed(invocation: Invocation) -> bool:
    """Say whether a human drove this session and left without handing it back."""
    left = invocation.takeover is not None and invocation.takeover["state"] == LAPSED
    return left or invocation.terms.displaced
