"""One person's answer to one question.

What is approved is exactly what was shown. An edit is decided again; it voids earlier approvals, and where policy
constrains the edit further, or has people asked about more for it, that is a new question. With the last approval the
proposal is decided once more, because the world went on while people thought. Where policy has people asked by then for
what nobody was shown, that is a new question as well: no approval was of it, nor is an edit.

Answering a session's question: *approve* lets it go on (recorded first, and only to a cell that is there), *deny* ends
it as policy says: it comes to rest (sent first), or is undone (recorded first).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, NoReturn

from app.audit.event import EventDraft
from app.clock import rfc3339
from app.governance.model import EventKind, Outcome, Status
from app.protocol import Human
from app.runtime.drafts import (
    DENIAL,
    SERVER,
    decided_again,
    escalation_event,
    grant_event,
    outcome_event,
    reason,
    with_edit,
    with_reason,
)
from app.runtime.errors import Conflict, InvalidParams
from app.runtime.escalation import APPROVED, DENIED, ROLLBACK, bound_digest
from app.runtime.invocation import reasons_document
from app.runtime.readmission import OFFLINE, going_on, lapsed, readmitted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from app.governance.model import ApprovalNeed
    from app.governance.policy_model import Denial
    from app.runtime.cells import Cell, Moment
    from app.runtime.escalation import Escalation
    from app.runtime.grant import Standing
    from app.runtime.invocation import Invocation, Principal
    from app.runtime.kernel import Judgement
    from app.runtime.questions import Questions

RULE: Final = "authority/approval"


class Answer:
    """One person's answer to one question, under the invocation's lock."""

    def __init__(
        self,
        questions: Questions,
        invocation: Invocation,
        escalation: Escalation,
        principal: Principal,
        comment: str | None,
        grant: Standing | None = None,
        first: int = 1,
    ) -> None:
        """Take the question and its invocation as they stand, who answers, and what is granted with an approval.

        `first` is how many people the question wanted when it was asked first.
        """
        self._questions = questions
        self._register = questions.register
        self._fleet = questions.fleet
        self._kernel = questions.kernel
        self._invocation = invocation
        self._escalation = escalation
        self._principal = principal
        self._comment = comment
        self._grant = grant
        self._first = first

    # -- before launch -----------------------------------------------------------------------------------------------

    async def deny(self, why: Denial, said_at: str) -> Escalation:
        """End the invocation: one denial is enough. The agent gets the code's words, never the person's."""
        now = self._register.now()
        closed = self._denied(now, why, said_at)
        reasons = [reason(RULE, "denied_by_human", "a human denied this", why.remedy)]
        if why != self._kernel.policy.authority.denials[0]:
            reasons.insert(0, reason(DENIAL, why.code, why.says, why.remedy))
        policy = self._invocation.policy
        for because in reasons:
            policy = with_reason(policy, because)
        ended = self._invocation.evolve(
            now, status=Status.DENIED, outcome=Outcome.DENIED, escalation=closed.reference(), policy=policy
        )
        await self._questions.commit(
            [self._event("deny", closed), outcome_event(ended, self._principal.name, *reasons)], closed, ended
        )
        return closed

    def _denied(self, at: str, why: Denial, said_at: str) -> Escalation:
        said = {"by": self._principal.name, "at": said_at, "code": why.code, "says": why.says}
        return self._escalation.evolve(at, status=DENIED, denial=said)

    async def approve(self, params: Mapping[str, Any] | None) -> Escalation:
        """Count this approval, of the question as shown or as edited, and launch with the last one needed."""
        present = self._escalation
        judgement = self._judge(present.effective)
        if judgement.conforms(present.effective) and self._outlived(judgement.need):
            await self._ask_anew(judgement)
        full = {**present.effective, **(params or {})}
        if full != present.effective:
            return await self._approve_edit(full)
        if any(approval["by"] == self._principal.name for approval in present.approvals):
            raise Conflict("already_approved", f"`{self._principal.name}` approved this: it takes another person")
        return await self._count(present, judgement)

    async def _approve_edit(self, full: Mapping[str, Any]) -> Escalation:
        filled = self._kernel.fill_in(self._invocation.capability, full, self._invocation.terms.version)
        judgement = self._judge(filled)
        if judgement.refused:
            raise _edit_refused(judgement)
        effective = judgement.effective(filled)
        self._note_edit(judgement)
        now, asking = self._register.now(), self._asked_for(judgement)
        bound = self._bound(effective, asking.get("reasons", self._escalation.reasons))
        edit = {"by": self._principal.name, "at": now, "params": effective, "digest": bound}
        edited = self._escalation.evolve(
            now,
            effective=effective,
            digest=bound,
            carried=self._kernel.carried(self._invocation, effective),
            # What others approved is what is asked still, where policy cut the edit back to it.
            approvals=self._escalation.approvals if bound == self._escalation.digest else (),
            edits=(*self._escalation.edits, edit),
            **asking,
        )
        need = judgement.need
        if effective == filled and self._shown() and (need is None or not _unsaid(need, self._escalation)):
            return await self._count(edited, judgement)
        # Policy constrained the edit further, or has people asked about more, or it is about another object by now:
        # nobody has seen that, so nobody approved.
        await self._commit_pending(edited, "edit")
        return edited

    def _bound(self, effective: Mapping[str, Any], why: Sequence[Mapping[str, str]]) -> str:
        return self._questions.bound(self._invocation, effective, why)

    def _outlived(self, need: ApprovalNeed | None) -> bool:
        """Say whether a question does not say what people would be asked by now, or was about another object."""
        return (need is not None and _unsaid(need, self._escalation)) or not self._shown()

    def _shown(self) -> bool:
        """Say whether a question was asked about the object that is handled by now."""
        present = self._escalation
        return present.digest == self._bound(present.effective, present.reasons)

    def _asked_for(self, judgement: Judgement) -> dict[str, Any]:
        """Return how many people authority wants now, and why; never fewer than it wanted when it asked first."""
        need = judgement.need
        if need is None:
            return {"needed": self._first}
        return {"needed": max(need.approvers, self._first), "reasons": reasons_document(need.reasons)}

    def _note_edit(self, judgement: Judgement) -> None:
        """Let the invocation's verdict lead from what was requested to what is approved, and say who changed what."""
        said, verdict = self._invocation.policy, judgement.decision.verdict
        if said is None or verdict is None:
            raise AssertionError("what is asked about was checked, and so was the edit that is not refused")
        edited = with_edit(said, self._invocation.requested, self._escalation.effective, verdict)
        self._invocation = replace(self._invocation, policy=edited)

    async def _count(self, present: Escalation, judgement: Judgement) -> Escalation:
        approval = {"by": self._principal.name, "at": self._register.now(), "digest": present.digest}
        counted = present.evolve(self._register.now(), approvals=(*self._questions.approvals(present), approval))
        if len(counted.approvals) < counted.needed:
            await self._commit_pending(counted, "approve")
            return counted
        return await self._conclude(counted, judgement)

    async def _conclude(self, counted: Escalation, judgement: Judgement) -> Escalation:
        """Launch, if the proposal still conforms in the world as it is now; otherwise say what changed."""
        need = judgement.need
        if need is not None and need.approvers > len(counted.approvals):
            # Its reasons are among those that were shown, or it would have been asked anew.
            stricter = counted.evolve(self._register.now(), needed=need.approvers)
            await self._commit_pending(stricter, "approve")
            return stricter
        now = self._register.now()
        closed = counted.evolve(now, status=APPROVED)
        invocation = self._invocation.evolve(now, escalation=closed.reference())
        # What was shown was shown under a profile: the same parameters under another one are watched differently.
        if judgement.profile != invocation.profile or not judgement.conforms(counted.effective):
            ended = judgement.refuse(invocation)
            ended = replace(ended, policy=decided_again(invocation.policy, ended.policy))
            await self._questions.commit(
                [
                    self._event("approve", closed),
                    *judgement.recheck_events(ended),
                    outcome_event(ended, SERVER, *judgement.ending_reasons()),
                ],
                closed,
                ended,
            )
            return closed
        closed, given = self._granting(closed)
        approvers = tuple(str(approval["by"]) for approval in closed.approvals)
        # What the agent reads stays the verdict on its request; that the approved form conforms is in the record.
        launching = invocation.evolve(
            now,
            effective=dict(counted.effective),
            profile=judgement.profile,
            policy_version=judgement.policy.digest,
        )
        async with self._kernel.launch(launching, judgement, approvers) as launch:
            await self._questions.commit(
                [
                    self._event("approve", closed),
                    *(grant_event("given", self._principal.name, grant) for grant in given),
                    *judgement.recheck_events(launch.invocation),
                    *launch.events,
                ],
                closed,
                launch.invocation,
                [*(grant.row() for grant in given), *launch.rows],
            )
        self._questions.grants.hold(*given)
        return closed

    async def _ask_anew(self, judgement: Judgement) -> NoReturn:
        """Ask about what policy wants a human to look at by now, and nobody was shown; nothing said is a word on that.

        Another object is asked about for the same reasons and until the same deadline, where policy names no others: a
        grant given meanwhile may answer for it, and nobody's approval.

        Raises:
            Conflict: `digest_mismatch`, always.
            RecordUnavailable: nothing is asked anew; the next answer meets the same.
        """
        now, present, need = self._register.now(), self._escalation, judgement.need
        asking = {"reasons": present.reasons, **self._asked_for(judgement)}
        asked = present.evolve(
            now,
            digest=self._bound(present.effective, asking["reasons"]),
            carried=self._kernel.carried(self._invocation, present.effective),
            approvals=(),
            acknowledged=(),
            expires_at=present.expires_at if need is None else rfc3339(self._register.now_s() + need.within_s),
            **asking,
        )
        shown = self._invocation.evolve(now, escalation=asked.reference())
        await self._questions.commit([escalation_event(asked)], asked, shown)
        raise _asked_anew(asking["reasons"])

    def _granting(self, closed: Escalation) -> tuple[Escalation, tuple[Standing, ...]]:
        if self._grant is None:
            return closed, ()
        return replace(closed, grant=self._grant.id), (self._grant,)

    async def _commit_pending(self, escalation: Escalation, decision: str) -> None:
        invocation = self._invocation.evolve(
            self._register.now(), effective=dict(escalation.effective), escalation=escalation.reference()
        )
        await self._questions.commit([self._event(decision, escalation)], escalation, invocation)

    def _judge(self, params: Mapping[str, Any]) -> Judgement:
        invocation = self._invocation
        cell = self._fleet.cell(invocation.cell) if invocation.cell else None
        return self._kernel.judge(invocation.proposal(params), invocation.agent, cell)

    # -- in mid-execution --------------------------------------------------------------------------------------------

    async def go_on(self, params: Mapping[str, Any] | None) -> Escalation:
        """Let the session go on as it was authorized: recorded first, and not at all while the cell is away."""
        if params is not None:
            message = (
                "cannot be edited in a session: its authorization is signed; valid: none, or deny and propose again"
            )
            raise InvalidParams([{"path": "params", "message": message}])
        cell = self._fleet.cell(self._invocation.cell or "")
        if word := cell.ending(self._invocation.id):
            raise Conflict("ending", f"the session is coming to its end after `{word}`: it cannot go on")
        if not self._fleet.attached(cell):
            raise Conflict("cell_offline", f"the cell `{cell.id}` is away: it cannot be told to go on")
        _not_driven(cell, self._invocation)
        self._register.check_undamaged()
        decided = cell.moment
        if reasons := self._questions.kept_back(self._invocation):
            raise Conflict("resume_refused", "the policy in force does not let it go on; valid: deny", reasons=reasons)
        now = self._register.now()
        approval = {"by": self._principal.name, "at": now, "digest": self._escalation.digest}
        closed = self._escalation.evolve(now, status=APPROVED, approvals=(approval,))
        if lapsed(self._invocation):
            return await self._go_on_anew(cell, closed, decided)
        answered = self._questions.departures.standing(self._invocation.id)
        await self._commit_session("approve", closed)
        self._questions.departures.let_go(self._invocation.id, answered)
        # Only who was asked about a phase confirms one: the cell may wait for a word that is not known here yet.
        op = "resolve_continue" if closed.phase is None else "confirm"
        word = Human(invocation=self._invocation.id, op=op, actor=self._principal.name)
        with suppress(Conflict):  # it was answered all the same, and is asked about again
            self._fleet.order(cell, word, decided=decided)
        return closed

    async def _go_on_anew(self, cell: Cell, closed: Escalation, decided: Moment) -> Escalation:
        """Let a session go on that a human drove and left: what it does is decided again, and bound anew."""
        present = self._invocation
        found = await readmitted(self._questions, cell, present, self._principal)
        self._questions.ask_again(self._principal)  # again, as what follows: that was waited for
        _not_driven(cell, present)
        carried = self._kernel.carried(present, self._escalation.effective)
        if found.unasked is not None and (
            _unsaid(found.unasked, self._escalation) or carried != self._escalation.carried
        ):
            await self._ask_more(found.unasked, carried)
        remedy = "answer again, once it is asked about"  # it is answered by this, though it may not be sent
        answered = False
        try:
            async with going_on(self._questions, cell, found, decided, "approve", remedy) as launch:
                version = launch.invocation.evolve(closed.updated_at, escalation=closed.reference())
                drafts = [self._event("approve", closed), *launch.events]
                await self._questions.commit(drafts, closed, version, launch.rows)
                answered = True
        except Conflict as error:
            if not answered or error.code != OFFLINE:  # else it was answered all the same, and is asked about again
                raise
        return closed

    async def _ask_more(self, need: ApprovalNeed, carried: str | None) -> NoReturn:
        """Ask also about what policy has people asked from here, and the question does not say, or not of this load.

        Raises:
            Conflict: `digest_mismatch`, always.
            RecordUnavailable: nothing more is asked; the next answer meets the same.
        """
        now, present = self._register.now(), self._escalation
        wanted = reasons_document(need.reasons)
        reasons = [*present.reasons, *(why for why in wanted if why not in present.reasons)]
        bound = bound_digest(self._invocation, present.effective, reasons, present.phase, carried=carried)
        asked = present.evolve(now, reasons=reasons, digest=bound, carried=carried, acknowledged=())
        shown = self._invocation.evolve(now, escalation=asked.reference())
        await self._questions.commit([escalation_event(asked)], asked, shown)
        self._questions.departures.ask(present.invocation, wanted)
        raise _asked_anew(reasons)

    async def end(self, why: Denial) -> Escalation:
        """End the session as policy says of a denial."""
        now = self._register.now()
        closed = self._denied(now, why, now)
        await self._questions.end_session(
            self._invocation, closed.on_deny, self._principal.name, self._commit_session("deny", closed)
        )
        return closed

    async def _commit_session(self, decision: str, closed: Escalation) -> None:
        terms = self._invocation.terms
        if decision == "deny" and closed.on_deny == ROLLBACK:
            terms = replace(terms, undone_by=self._principal.name)
        invocation = self._invocation.evolve(closed.updated_at, escalation=closed.reference(), terms=terms)
        await self._questions.commit([self._event(decision, closed)], closed, invocation)

    def _event(self, decision: str, escalation: Escalation) -> EventDraft:
        edited = {"policy": self._invocation.policy} if escalation.edits else {}  # policy's own event is on the request
        return EventDraft(
            kind=EventKind.APPROVAL,
            actor=self._principal.name,
            invocation=self._invocation.id,
            body={"decision": decision, "escalation": escalation.public(), "comment": self._comment, **edited},
        )


def _not_driven(cell: Cell, invocation: Invocation) -> None:
    if cell.driven(invocation.id):  # whoever took over has answered what was asked
        raise Conflict("control_held", f"somebody drives `{cell.id}` by hand; valid: they hand back")


def _unsaid(need: ApprovalNeed, shown: Escalation) -> bool:
    """Say whether people would be asked for something that a question does not say."""
    said = {(why["rule"], why["code"]) for why in shown.reasons}
    return any((why.rule, why.code) not in said for why in need.reasons)


def _asked_anew(reasons: Sequence[Mapping[str, str]]) -> Conflict:
    message = "people are asked about something else by now; valid is to read the question again first"
    return Conflict("digest_mismatch", message, reasons=reasons)


def _edit_refused(judgement: Judgement) -> Conflict:
    """Say who refuses an edit, and only that: what else it would have to wait for is not why."""
    verdict = judgement.decision.verdict
    if judgement.status is Status.DENIED and verdict is not None:
        message, reasons = "policy denies the edited proposal", verdict.reasons
    else:
        message, reasons = "the edited proposal would not be admitted", judgement.decision.admission.reasons
    return Conflict("edit_refused", message, reasons=reasons_document(reasons))
