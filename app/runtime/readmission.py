"""A session that a human drove goes on only if it would still be let run, decided again from where the robot is."""

from __future__ import annotations

from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, cast

from app.audit.event import EventDraft
from app.audit.projection import NOT_SENT
from app.governance.model import EventKind, Reason
from app.runtime.drafts import GRANTED, SERVER
from app.runtime.errors import Conflict, GaveWay, InvalidParams
from app.runtime.escalation import PROFILE_CHANGED
from app.runtime.hands import LAPSED
from app.runtime.identity import digest
from app.runtime.invocation import reasons_document
from app.runtime.kernel import Launching
from app.runtime.recollection import events_of

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Mapping, Sequence

    from app.governance.model import ApprovalNeed
    from app.runtime.cells import Cell, Moment
    from app.runtime.invocation import Invocation, Principal
    from app.runtime.kernel import Judgement
    from app.runtime.questions import Questions

RULE: Final = "authority/takeover"
OFFLINE: Final = "cell_offline"
REFUSED: Final = "resume_refused"
PROPOSE: Final = "roll it back or end it, and propose it again"


@dataclass(frozen=True, slots=True, kw_only=True)
class Readmission:
    """A session that policy lets go on from where the robot is now.

    `session` is as it was then. `approvals` is who approved it, whoever lets it go on among them. `unasked` is what
    that one approves by it: what policy has people asked from here, and too few of those who approved the launch were
    shown. They have to be, first.
    """

    session: Invocation
    by: str  # who lets it go on
    judgement: Judgement
    approvals: tuple[str, ...]
    unasked: ApprovalNeed | None


async def readmitted(desk: Questions, cell: Cell, present: Invocation, principal: Principal) -> Readmission:
    """Decide again on what a session does, from where the robot is now.

    Whoever approved its launch and may approve nothing any more is none of them, nor is a grant that it was launched
    by: one that answers by now is found again. It is a new authorization, and none is given under a profile that its
    cell has left.

    Raises:
        Conflict: `resume_refused`, with the reasons.
    """
    # First: nothing is awaited between the decision and the launch.
    said, shown = await _approvals(desk, present)
    approvals = tuple(name for name in said if desk.grants.may_give(name))
    effective = dict(present.effective or {})
    try:
        taken = desk.kernel.fill_in(present.capability, effective, present.terms.version)
    except InvalidParams as error:
        raise _misfit(str(error)) from error
    if more := sorted(taken.keys() - effective.keys()):
        raise _misfit(", ".join(f"`{name}`" for name in more) + " as well")
    judgement = desk.kernel.judge(present.proposal(effective), present.agent, cell, within=present)
    if cell.profile != present.profile:
        raise _refused("the profile that it was launched under gave way", (_gave_way(cell, present),))
    if not judgement.conforms(effective):
        raise _refused("policy does not let it go on from here", judgement.reasons())
    unasked = judgement.need
    if unasked is not None:
        # Those who were asked about all of it, in these words.
        approvals = approvals if {(why.rule, why.code, why.message) for why in unasked.reasons} <= shown else ()
        people = set(approvals) - {present.agent}
        if len(people | {principal.name} - {present.agent}) < unasked.approvers:
            # Nobody else is asked, whatever policy advises.
            left = "roll it back, or end it" if cell.driven(present.id) else "deny it"
            raise _refused("it takes more approvals from here", [why._replace(remedy=left) for why in unasked.reasons])
        unasked = None if len(people) >= unasked.approvers else unasked
    approvals = (*approvals, *judgement.by_grant)
    if principal.name not in (*approvals, present.agent):
        approvals = (*approvals, principal.name)
    return Readmission(session=present, by=principal.name, judgement=judgement, approvals=approvals, unasked=unasked)


async def told_by(desk: Questions, invocation: str) -> dict[str, int]:
    """Return which events told whoever hands a session back of what policy asks, each by the digest of that."""
    events = await events_of(desk.register.store, invocation=invocation, kind=EventKind.POLICY)
    backs = [(cast("dict[str, Any]", event.payload().get("hand_back", {})), event.seq) for event in events]
    return {back["digest"]: seq for back, seq in backs if "digest" in back}


async def tell_first(
    desk: Questions, present: Invocation, found: Readmission, lease: str, told: Mapping[str, int], said: str | None
) -> dict[str, Any]:
    """Let a hand-back count as an approval only if it says the digest of a refusal that told what of; return which one.

    The refusal is in the record (`told`). It counts for one lease, and for what an approval of a launch is bound to.

    Raises:
        Conflict: `resume_refused`, with the reasons and their digest.
        RecordUnavailable: nobody was told.
    """
    if (need := found.unasked) is None:
        return {}
    judgement = found.judgement
    now = replace(present, policy_version=judgement.policy.digest, profile=judgement.profile)
    bound = desk.bound(now, present.effective or {}, reasons_document(need.reasons))
    bound = digest({"lease": lease, "approvers": need.approvers, "bound": bound})
    if bound not in told:
        await desk.register.append(judgement.refused_back(present, found.by, bound))
    elif bound == said:
        return {"approves": told[bound]}
    again = "hand back again, with the `digest` of this refusal"
    reasons = [why._replace(remedy=again) for why in need.reasons]  # nobody else is asked, whatever policy advises
    message = "policy has people asked about this from here: whoever hands back again approves that"
    raise _refused(message, reasons, bound)


@asynccontextmanager
async def going_on(
    desk: Questions, cell: Cell, found: Readmission, decided: Moment, op: str, remedy: str
) -> AsyncGenerator[Launching]:
    """Let a session go on that a human drove, bound anew: the caller makes it durable inside, and then it is sent.

    Args:
        desk: where it is asked about.
        cell: which has it.
        found: what was decided on it. Nothing was awaited since.
        decided: how the cell stood before.
        op: what is said to it, as the record names it.
        remedy: what whoever says so may do where it is not sent after all, and their cell is under its profile still.

    Raises:
        Conflict: `resume_refused`, what it was to go on by gave way while that was recorded, and nothing is sent: it
            is in the hands, and under the terms, that it was in before; `cell_offline`, the cell was away meanwhile:
            likewise.
        RecordUnavailable: nothing is sent.
    """
    present, judgement = found.session, found.judgement
    try:
        async with desk.kernel.launch(present, judgement, found.approvals, anew=decided) as launch:
            terms = launch.invocation.terms
            with desk.grants.use(judgement.grant) as used:
                yield Launching(
                    invocation=replace(present, terms=terms, policy_version=judgement.policy.digest),
                    events=(*judgement.recheck_events(present), *launch.events),
                    rows=(*launch.rows, *used),
                )
    except GaveWay as error:
        why = list(error.reasons)
        if cell.profile != present.profile:
            why = [_gave_way(cell, present)]
        elif why[0].code != OFFLINE:
            why = [each._replace(remedy=remedy) for each in why]
        raise await _not_sent(desk, present, op, why) from error
    desk.departures.conform(present.id, [])  # what was said until now was of what bound it before


async def _not_sent(desk: Questions, before: Invocation, op: str, reasons: Sequence[Reason]) -> Conflict:
    """Record that a session was not let go on after all, and return the refusal of whoever let it go on."""
    recorded, why = desk.register.newest(before.id), reasons[0]
    if recorded is not None and recorded is not before:  # else that came first, and there is no record
        unsent, bound = recorded.terms.authorization, before.policy_version
        body = {"what": NOT_SENT, "op": op, "code": why.code, "authorization": unsent, "policy_version": bound}
        draft = EventDraft(kind=EventKind.CELL, actor=SERVER, invocation=before.id, body=body)
        version = recorded.evolve(
            desk.register.now(), takeover=before.takeover, terms=before.terms, policy_version=bound
        )
        await desk.register.append([draft], versions=[version])
    return _refused(f"{why.message}: it was not sent", reasons, code=OFFLINE if why.code == OFFLINE else REFUSED)


def _refused(message: str, reasons: Sequence[Reason], bound: str | None = None, code: str = REFUSED) -> Conflict:
    return Conflict(code, message, reasons=reasons_document(tuple(reasons)), digest=bound)


def _misfit(what: str) -> Conflict:
    other = Reason(RULE, "params_invalid", f"the capability takes other parameters now: {what}", PROPOSE)
    return _refused("it cannot go on with what it was launched with", (other,))


def _gave_way(cell: Cell, present: Invocation) -> Reason:
    message = f"`{cell.id}` is under {cell.profile} by now, and this was launched under {present.profile}"
    return Reason(RULE, PROFILE_CHANGED, message, PROPOSE)


async def _approvals(desk: Questions, present: Invocation) -> tuple[tuple[str, ...], frozenset[tuple[str, str, str]]]:
    """Return who approved the session when it was launched, and by which rules, codes and words they were asked.

    Nobody, where the gripper held something else then, and that is what is handled. A grant is no person.
    """
    events = desk.register.store.events
    launched = await events(invocation=present.id, kind=EventKind.AUTHORIZATION, limit=1)
    if not launched:
        return (), frozenset()
    permit = cast("dict[str, list[str]]", launched[0].payload()["authorization"])
    answers = await events(invocation=present.id, kind=EventKind.APPROVAL, before=launched[0].seq, newest=True, limit=1)
    asked = cast("list[dict[str, Any]]", [answer.payload()["escalation"] for answer in answers])
    if not all(_same(desk, present, question) for question in asked):
        return (), frozenset()
    people = tuple(name for name in permit["approvals"] if not name.startswith(GRANTED))
    reasons = [why for question in asked for why in question["reasons"]]
    return people, frozenset((why["rule"], why["code"], why["message"]) for why in reasons)


def _same(desk: Questions, present: Invocation, question: Mapping[str, Any]) -> bool:
    then = replace(present, policy_version=question.get("policy_version"), profile=question.get("profile"))
    return desk.bound(then, question["effective"], question["reasons"]) == question["digest"]


def lapsed(invocation: Invocation) -> bool:
    """Say whether a human drove this session and left without handing it back."""
    left = invocation.takeover is not None and invocation.takeover["state"] == LAPSED
    return left or invocation.terms.displaced
