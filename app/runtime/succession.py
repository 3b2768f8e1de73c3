"""What follows when another policy has come into force: for grants, for sessions, for what waits for approval.

1. Standing grants of the former policy end at once.
2. Sessions that the new policy would not let go on as they are (`governance.continuing`) are told to hold, before
   anything is recorded. The cell asks a human then, for the reasons given here.
   One that is held already is not told: its question is asked anew, with these reasons.
3. What waits for approval is decided again: it ends, launches, or is asked anew, bound to the new version. The same
   when a cell is put under another profile, but that launches nothing.
4. What was decided before and is recorded only now is sent only if the new policy would let it go on as well, and never
   under another profile than the cell's.

What restrains is not told once: a launch that is still on its way to its cell cannot be held yet, so it is held as soon
as the cell says that it has it.
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from app.audit.errors import RecordUnavailable
from app.audit.event import EventDraft
from app.clock import monotonic_s, rfc3339
from app.governance.authority import need
from app.governance.continuing import ACCEPTED, CHANGED, CONFORMS, Departure
from app.governance.control import TAKEOVER, Phase
from app.governance.model import (
    SESSION,
    AdmissionOutcome,
    EventKind,
    Intervention,
    Outcome,
    PolicyOutcome,
    Reason,
    Status,
)
from app.protocol import Human
from app.runtime.drafts import SERVER, escalation_event, outcome_event, reason
from app.runtime.errors import InvalidParams
from app.runtime.escalation import APPROVAL, PROFILE_CHANGED, WITHDRAWN, bound_digest
from app.runtime.grant import REVOKED, GrantEnded
from app.runtime.hands import OPEN, led, over
from app.runtime.invocation import reasons_document
from app.runtime.kernel import ANOTHER_PROFILE, EDITED
from app.runtime.kernel import CHANGED as CONDITIONS_CHANGED
from app.runtime.readmission import lapsed
from app.runtime.recollection import events_of
from app.runtime.uncut import uncut
from app.runtime.version import UNREADABLE

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from app.governance.model import ApprovalNeed
    from app.governance.policy import PolicySet
    from app.runtime.desk import Desk
    from app.runtime.escalation import Escalation
    from app.runtime.fleet import Fleet
    from app.runtime.invocation import Invocation
    from app.runtime.kernel import Judgement, Kernel
    from app.runtime.register import Register

AGAIN_S: Final = 0.2
ENDS_FIRST_S: Final = 2.0  # a recovery ends before its session holds, and the record keeps every word to it
RULE: Final = "policy/changed"
OVERTAKEN: Final = Reason(
    RULE, CHANGED, "another policy came into force before this was sent, and does not let it", "propose again"
)
OTHER_PROFILE: Final = Reason(
    RULE, PROFILE_CHANGED, "the cell was put under another profile before this was sent", "propose again"
)
FORMER_HELD: Final = reason(
    RULE, CHANGED, "a policy that is not in force any more held this; it waits for a human", "let it go on, or end it"
)


class Succession:
    """Sees to whatever stood under a policy that is not in force any more."""

    def __init__(self, register: Register, fleet: Fleet, desk: Desk, kernel: Kernel) -> None:
        """Take the parts of one server."""
        self._register, self._fleet, self._desk, self._kernel = register, fleet, desk, kernel
        self._policies: dict[str, PolicySet] = {}  # those that live sessions run under
        self._under_way: set[asyncio.Task[None]] = set()
        kernel.outlived = self.outlived
        kernel.abandon = self.abandon
        desk.kept_back = self.kept_back
        desk.decide_again = self.decide_again

    # -- before and at the change ------------------------------------------------------------------------------------

    async def prepare(self, compiled: Callable[[str], Awaitable[PolicySet]]) -> None:
        """Have every policy at hand that something live stands under."""
        needed = {known.policy_version for known in self._register.live() if known.status in SESSION}
        present = self._kernel.policy
        kept = {digest: policy for digest, policy in self._policies.items() if digest in needed}
        kept[present.digest] = present
        for digest in needed - kept.keys():
            with contextlib.suppress(*UNREADABLE):  # what nobody knows departs from any
                kept[digest] = await compiled(digest)
        self._policies = kept

    def at_once(self) -> list[EventDraft]:
        """End grants, and tell every session to hold that departs from what is in force now; return what was done."""
        self._desk.grants.look()
        done: list[EventDraft] = []
        for present in self._register.live():
            if present.status in SESSION:
                done += self._compare(present)
        return done

    def _compare(self, present: Invocation) -> list[EventDraft]:
        """Tell a session to hold if it departs from what is in force now; return what was done."""
        found, departures = self.departure(present), self._desk.departures
        departed = departures.standing(present.id) is not None
        departures.conform(present.id, reasons_document(found.reasons))
        return [self._hold(present, found, departed=departed)] if found else []

    def departure(self, present: Invocation) -> Departure:
        """Say how a session departs from the policy in force."""
        if present.policy_version == self._kernel.policy.digest:
            return CONFORMS
        proposal = present.proposal(dict(present.effective or {}))
        context = self._kernel.context(present.capability, present.agent, present)
        covered = present.terms.recoveries
        former = self._policies.get(present.policy_version)
        return self._kernel.departure(former, proposal, context, covered, led=led(present.takeover))

    def kept_back(self, present: Invocation) -> list[dict[str, str]]:
        """Return why nobody may let a session go on; empty where a human's word is enough.

        Nothing keeps back what somebody has driven: before it goes on all of it is decided again.
        """
        if lapsed(present):
            return []
        found = self.departure(present)
        return [] if found.askable else reasons_document(found.reasons)

    def _hold(self, present: Invocation, found: Departure, *, departed: bool) -> EventDraft:
        """Tell a session to hold; who has taken one that had `departed` before is held to `Cell.hands` alone."""
        reasons = reasons_document(found.reasons)
        control = self._fleet.cell(present.cell or "").control
        mine = control is not None and control.invocation == present.id and control.phase is Phase.HELD
        drives = departed and mine
        self._desk.departures.depart(present.id, reasons, None if drives else monotonic_s())
        if not drives:
            self._restrain(present)
        body = {
            "intervention": Intervention.CONTINUE if drives else Intervention.ESCALATE,
            "code": CHANGED,
            "policy_version": self._kernel.policy.digest,
            "former": present.policy_version,
            "reasons": reasons,
            "askable": found.askable,
        }
        return EventDraft(kind=EventKind.INTERVENTION, actor=SERVER, invocation=present.id, body=body)

    def _restrain(self, present: Invocation) -> None:
        cell = self._fleet.cell(present.cell or "")
        if cell.driven(present.id):
            self._fleet.loosen(cell, SERVER)
        self._fleet.restrain(cell, Human(invocation=present.id, op="escalate", actor=SERVER))

    async def recall(self) -> None:
        """Take back from the log what an earlier run of the server told held sessions, for which policy, and why."""
        desk, policy = self._desk, self._kernel.policy.digest
        for question in desk.pending():
            present = self._register.newest(question.invocation)
            if question.kind == APPROVAL or present is None:
                continue
            # What was said of what it was bound to before is of no matter to what it is bound to now.
            told = [body for body in await self._interventions(present.id) if body["former"] == present.policy_version]
            now = [why for body in told if body["policy_version"] == policy for why in body["reasons"]]
            desk.departures.recall(present.id, now, (why for body in told for why in body["reasons"]))

    async def _interventions(self, name: str) -> list[dict[str, Any]]:
        said = await events_of(self._register.store, invocation=name, kind=EventKind.INTERVENTION)
        bodies: list[dict[str, Any]] = [one.payload() for one in said if one.actor == SERVER]
        return [body for body in bodies if body.get("code") == CHANGED]

    # -- afterwards --------------------------------------------------------------------------------------------------

    @uncut
    async def afterwards(self, done: list[EventDraft]) -> None:
        """Record what was done at once, and decide again on everything that waits for approval.

        What cannot be recorded now is said later, and what waits is decided again by `watch` or before its answer.
        """
        if done:
            await self._register.say(*done)
        await self._desk.grants.record_ends()
        await self.decide_again()

    async def watch(self) -> None:
        """Decide again what could not be recorded, for ever."""
        while True:
            await asyncio.sleep(AGAIN_S)
            await self.decide_again()

    async def keep_holding(self) -> None:
        """Hold what could not be held at once, for ever: however long the record takes for what is decided again."""
        while True:
            await asyncio.sleep(AGAIN_S)
            self.hold_again()

    def hold_again(self) -> None:
        """Tell sessions once more to hold, which were on their way to their cell when they were told."""
        now_s = monotonic_s()  # the wall clock may be put back, and what is to hold would run on for as long
        self._forget()
        departures = self._desk.departures
        for name, told_s in departures.telling():
            present = self._register.newest(name)
            if present is None or present.status not in SESSION or present.status is Status.ESCALATED:
                departures.holds(name)
            elif present.terms.confirmed and not self._in_hand(present) and now_s - told_s >= _again_s(present.status):
                departures.tell(name, now_s)
                self._restrain(present)

    def _in_hand(self, present: Invocation) -> bool:
        """Say whether somebody has taken a session over, by the record: they drive on, held to `Cell.hands` alone."""
        held = (present.takeover or {}).get("state") in OPEN
        return held and self._fleet.cell(present.cell or "").driven(present.id)

    def _forget(self) -> None:
        """Forget how sessions departed that are over."""
        departures = self._desk.departures
        for name in departures.sessions():
            present = self._register.newest(name)
            if present is None or present.status not in SESSION:
                departures.forget(name)

    # -- what was decided before and recorded after --------------------------------------------------------------------

    def outlived(self, launching: Invocation, judgement: Judgement, anew: bool) -> tuple[Reason, ...]:
        """Return why a launch must not be sent, because what it was decided under gave way while it was recorded.

        A grant that ended meanwhile answers for nothing. Another policy may let it go on all the same. Another profile
        does not: whoever puts a cell under one takes what begins from then on to be under that. Who takes a session
        over (it is bound `anew`, as when it goes on from there) keeps to its profile, and `cell.hands` is compared
        with each policy.
        """
        taking = anew and launching.capability == TAKEOVER
        if not taking and judgement.profile != self._fleet.profile(self._fleet.cell(launching.cell or "")):
            return (OTHER_PROFILE,)
        if not self._desk.grants.stands(judgement.grant if anew else launching.grant):
            return (REVOKED,)
        if taking or judgement.policy is self._kernel.policy:
            return ()
        proposal = launching.proposal(dict(launching.effective or {}))
        context = self._kernel.context(launching.capability, launching.agent, launching)
        covered = launching.terms.recoveries
        found = self._kernel.departure(judgement.policy, proposal, context, covered, led=anew)
        return (OVERTAKEN, *found.reasons) if found else ()

    def abandon(self, name: str, reasons: tuple[Reason, ...]) -> None:
        """End what was recorded as launched and never was; nothing has moved, and nobody drives it."""
        for cell in self._fleet.cells():
            if cell.driven(name):
                cell.control = None
        task = asyncio.create_task(self._abandon(name, reasons_document(reasons)), name=f"abandon-{name}")
        self._under_way.add(task)
        task.add_done_callback(self._under_way.discard)

    async def _abandon(self, name: str, reasons: list[dict[str, str]]) -> None:
        entry = self._register.entry(name)
        if entry is None:
            return
        async with entry.lock:
            present = entry.newest
            if present.final:
                return
            ended = present.evolve(
                self._register.now(),
                status=Status.FAILED,
                outcome=Outcome.FAULT,
                failure={"reasons": reasons},
                takeover=over(present.takeover),
            )
            with contextlib.suppress(RecordUnavailable):  # then it ends as a launch that nobody confirmed
                await self._register.append([outcome_event(ended, SERVER, *reasons)], (), [ended])

    # -- what waits for approval ---------------------------------------------------------------------------------------

    async def decide_again(self) -> None:
        """Decide again on everything that waits for approval under another policy or profile than the one in force.

        What a held session asks is asked anew where that policy has something else against its going on.
        """
        for known in self._desk.pending():
            entry = self._register.entry(known.invocation)
            if entry is None or self._desk.outdated(known) is None:
                continue
            # What waits for approval may launch, on what the last session left.
            async with self._desk.settled(entry) if known.kind == APPROVAL else entry.lock:
                present = self._desk.pending_for(known.invocation)
                why = None if present is None or self._desk.denied(present) else self._desk.outdated(present)
                if present is not None and why is not None:
                    # `watch` tries again; answers are refused meanwhile
                    with contextlib.suppress(RecordUnavailable, GrantEnded):
                        ask = self._anew if present.kind == APPROVAL else self._say_why
                        await ask(replace(present, renewed=why), entry.newest)

    async def _anew(self, question: Escalation, invocation: Invocation) -> None:
        """Decide on what waits for approval; an approver's edit stands in the place of what was requested.

        Where nobody is asked any more under another policy, it launches: an engineer put that in force with all that
        follows. Whoever puts a cell under another profile does not expect it to move by that, and what a person made of
        it is neither what was proposed nor approved: the agent proposes again.
        """
        asked = dict(question.edits[-1]["params"]) if question.edits else dict(invocation.requested)
        try:
            params = self._kernel.fill_in(invocation.capability, asked, invocation.terms.version)
        except InvalidParams as error:
            why = reason(RULE, "params_invalid", f"the capability takes other parameters now: {error}", "propose again")
            await self._end(question, invocation, status=Status.REJECTED, outcome=Outcome.REJECTED, reasons=[why])
            return
        cell = self._fleet.cell(invocation.cell) if invocation.cell else None
        judgement = self._kernel.judge(invocation.proposal(params), invocation.agent, cell)
        wanted = self._wanted(judgement, invocation)
        if judgement.refused or (wanted is None and judgement.status is Status.DEFERRED):
            await self._refuse(question, invocation, judgement)
        elif wanted is None and question.profile != judgement.profile:  # also where the policy changed as well
            await self._refuse(question, invocation, judgement, ANOTHER_PROFILE)
        elif wanted is None and question.edits:
            await self._refuse(question, invocation, judgement, EDITED)
        elif wanted is None:
            await self._launch(question, invocation, judgement)
        else:
            await self._ask(question, invocation, judgement, wanted)

    def _wanted(self, judgement: Judgement, invocation: Invocation) -> ApprovalNeed | None:
        """Return what authority asks for; what only has to wait for the world is asked about all the same."""
        decision = judgement.decision
        if decision.admission.outcome is not AdmissionOutcome.DEFER or decision.verdict is None:
            return decision.need
        if decision.verdict.outcome is PolicyOutcome.DENY:
            return None
        proposal = invocation.proposal(decision.verdict.effective)
        context = self._kernel.context(invocation.capability, invocation.agent, invocation, profile=judgement.profile)
        return need(judgement.policy, proposal, ACCEPTED, decision.verdict, context)

    async def _refuse(
        self, question: Escalation, invocation: Invocation, judgement: Judgement, because: Reason = CONDITIONS_CHANGED
    ) -> None:
        now = self._register.now()
        closed = question.evolve(now, status=WITHDRAWN)
        ended = judgement.refuse(invocation.evolve(now, escalation=closed.reference()), because)
        drafts = [*judgement.recheck_events(ended), escalation_event(closed)]
        drafts.append(outcome_event(ended, SERVER, *judgement.ending_reasons(because)))
        await self._desk.commit(drafts, closed, ended)

    async def _end(
        self,
        question: Escalation,
        invocation: Invocation,
        *,
        status: Status,
        outcome: Outcome,
        reasons: list[dict[str, str]],
    ) -> None:
        now = self._register.now()
        closed = question.evolve(now, status=WITHDRAWN)
        admission = {"outcome": AdmissionOutcome.REJECT, "reasons": reasons}
        ended = invocation.evolve(
            now, status=status, outcome=outcome, escalation=closed.reference(), admission=admission
        )
        await self._desk.commit([escalation_event(closed), outcome_event(ended, SERVER, *reasons)], closed, ended)

    async def _launch(self, question: Escalation, invocation: Invocation, judgement: Judgement) -> None:
        """Launch what nobody has to approve any more, or what a grant given meanwhile answers for.

        Raises:
            GrantEnded: that grant has ended since the decision.
            RecordUnavailable: it is not recorded, and not launched.
        """
        now = self._register.now()
        closed = question.evolve(now, status=WITHDRAWN)
        effective = judgement.effective(dict(invocation.requested))
        decided = invocation.evolve(
            now, effective=effective, escalation=closed.reference(), grant=judgement.grant, **judgement.parts()
        )
        async with self._kernel.launch(decided, judgement, judgement.by_grant) as launch:
            drafts = [escalation_event(closed), *judgement.recheck_events(launch.invocation), *launch.events]
            with self._desk.grants.use(judgement.grant) as used:
                await self._desk.commit(drafts, closed, launch.invocation, [*launch.rows, *used])

    async def _ask(
        self, question: Escalation, invocation: Invocation, judgement: Judgement, wanted: ApprovalNeed
    ) -> None:
        """Ask anew, about what the new version makes of it; who approved before approved something else."""
        now = self._register.now()
        effective = judgement.effective(dict(invocation.requested))
        decided = invocation.evolve(
            now, effective=effective, status=Status.AWAITING_APPROVAL, outcome=None, **judgement.parts()
        )
        reasons = reasons_document(wanted.reasons)
        bound = self._desk.bound(decided, effective, reasons)
        asked = question.evolve(
            now,
            constrained=effective if not question.edits else question.constrained,
            effective=effective,
            digest=bound,
            carried=self._kernel.carried(decided, effective),
            former_digests=_former(question, bound),
            policy_version=judgement.policy.digest,
            profile=judgement.profile,
            reasons=reasons,
            needed=wanted.approvers,
            approvals=(),
            acknowledged=(),
            risk=self._kernel.risk(invocation.capability),
            expires_at=rfc3339(self._register.now_s() + wanted.within_s),
            on_timeout=wanted.on_timeout,
        )
        shown = decided.evolve(now, escalation=asked.reference())
        drafts = [*judgement.recheck_events(shown), escalation_event(asked)]
        await self._desk.commit(drafts, asked, shown)

    async def _say_why(self, question: Escalation, invocation: Invocation) -> None:
        """Have a held session's question say what the policy in force has against its going on, and nobody else's."""
        now, policy = self._register.now(), self._kernel.policy.digest
        departures = self._desk.departures
        told, over = departures.standing(invocation.id) or (), departures.over(invocation.id)
        kept = [why for why in question.reasons if why not in (*told, *over, FORMER_HELD)]
        reasons = [*kept, *told] or [FORMER_HELD]
        under, carried = replace(invocation, policy_version=policy), question.carried
        bound = bound_digest(under, question.effective, reasons, question.phase, carried=carried)
        asked = question.evolve(
            now,
            reasons=reasons,
            digest=bound,
            former_digests=_former(question, bound),
            policy_version=policy,
            acknowledged=(),
        )
        await self._desk.commit([escalation_event(asked)], asked, invocation.evolve(now, escalation=asked.reference()))

    async def close(self) -> None:
        """Wait for what is being ended."""
        if self._under_way:
            await asyncio.wait(self._under_way)


def _again_s(status: Status) -> float:
    return ENDS_FIRST_S if status is Status.RECOVERING else AGAIN_S


def _former(question: Escalation, bound: str) -> tuple[str, ...]:
    """Return what a question was bound to before; what it is bound to again, as before, is worth an answer again."""
    return tuple(digest for digest in (*question.former_digests, question.digest) if digest != bound)
