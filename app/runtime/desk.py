"""The desk: questions to humans, from asking to the answer, the deadline or the withdrawal.

Every change is made under the lock of the invocation it is about, and is durable before anybody learns of it. An answer
names the digest of what was shown; `app.runtime.answer` says what it leads to. Silence is closed by the wall clock,
also across restarts, and is never reported as anybody's answer.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from app.audit.documents import follow, is_founded, nothing_said
from app.audit.errors import AuditError, RecordUnavailable, RowUnreadable
from app.governance.authority import denial
from app.governance.model import EventKind, Outcome, Reason, Status
from app.runtime.answer import RULE, Answer
from app.runtime.drafts import (
    SERVER,
    acknowledged_event,
    escalation_event,
    outcome_event,
    reason,
    voided_event,
    with_reason,
)
from app.runtime.errors import Conflict, Forbidden, InvalidParams, NotFound
from app.runtime.escalation import (
    APPROVAL,
    EXPIRED,
    PENDING,
    POLICY_CHANGED,
    PROFILE_CHANGED,
    SESSION_QUESTION,
    WITHDRAWN,
    Escalation,
    read_escalation,
)
from app.runtime.grants import RULE as GRANTS
from app.runtime.grants import refused_for
from app.runtime.questions import Questions
from app.runtime.recollection import events_of, needed_first, questions_of
from app.runtime.reviews import Reviews
from app.runtime.uncut import uncut

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping

    from app.audit.reader import Row
    from app.governance.policy_model import Denial
    from app.runtime.fleet import Fleet
    from app.runtime.grant import Offer, Standing
    from app.runtime.invocation import Invocation, Principal
    from app.runtime.kernel import Kernel
    from app.runtime.register import Entry, Register

_SINCE: Final = {POLICY_CHANGED: "another policy is in force", PROFILE_CHANGED: "the cell is under another profile"}
POLL_S: Final = 0.5  # the wall clock may step; a deadline is met within this all the same


class Denied(NamedTuple):
    """What somebody denied a launch with, and when."""

    principal: Principal
    why: Denial
    comment: str | None
    at: str


class Desk(Questions):
    """What people and time do to the pending questions of one server."""

    def __init__(self, register: Register, fleet: Fleet, kernel: Kernel) -> None:
        """Take where changes are recorded, where orders go, and who decides."""
        super().__init__(register, fleet, kernel)
        self.reviews = Reviews(register, kernel)
        self._denials: dict[str, Denied] = {}  # that the record could not take: they hold, and wait for it
        self.decide_again: Callable[[], Awaitable[None]] = _nothing_waits

    def outdated(self, question: Escalation) -> str | None:
        """Return why a question is not the one to ask now; None where it is.

        A session's is not where it does not say what the policy in force has against going on, or says what one before
        it had: who read it would answer for what they were never shown.
        """
        if question.kind == APPROVAL:
            return super().outdated(question)
        return POLICY_CHANGED if self.departures.misstated(question.invocation, question.reasons) else None

    # -- reading -----------------------------------------------------------------------------------------------------

    async def list(
        self, *, status: str | None = None, limit: int = 50, cursor: str | None = None
    ) -> tuple[list[dict[str, Any]], str | None]:
        """Return questions, newest first, and the cursor behind them. Raises `ValueError` on a bad limit or cursor."""
        page = await self.register.store.page("escalations", {"status": status}, limit=limit, cursor=cursor)
        return self.register.stored.those_of("escalations", page.items, _shown), page.next

    def most_urgent(self, limit: int = 50) -> list[dict[str, Any]]:
        """Return the open questions, the most urgent first: the one that ends first, of two the one of higher risk.

        Where there are more than that, no agent's many leave out another's few, nor what a held session asks.
        """
        found = sorted(self._pending.values(), key=lambda escalation: escalation.urgency)
        turns: Counter[tuple[str, str]] = Counter()
        places: list[tuple[int, int]] = []
        for place, question in enumerate(found):
            asker = question.agent, question.kind
            places.append((turns[asker], place))
            turns[asker] += 1
        return [found[place].public() for _, place in sorted(sorted(places)[:limit], key=itemgetter(1))]

    async def get(self, escalation_id: str) -> dict[str, Any]:
        """Return one question.

        Raises:
            NotFound: there is none.
            RowUnreadable: it is damaged.
        """
        return (await self._load(escalation_id)).public()

    async def _load(self, escalation_id: str) -> Escalation:
        present = self._pending.get(escalation_id)
        if present is not None:
            return present
        row = await self.register.store.row("escalations", id=escalation_id)
        if row is None:
            raise NotFound("escalation", escalation_id)
        return self.register.stored.read("escalations", row, read_escalation)

    # -- answering ---------------------------------------------------------------------------------------------------

    @uncut
    async def resolve(
        self,
        escalation_id: str,
        principal: Principal,
        decision: str,
        digest: str,
        *,
        params: Mapping[str, Any] | None = None,
        comment: str | None = None,
        code: str | None = None,
        offer: Offer | None = None,
    ) -> dict[str, Any]:
        """Take one person's answer, `approve` or `deny`, and return the question as it stands then.

        A denial has a `code`, the declared default one where it names none: that is what the agent learns. With the
        last approval, `offer` is a standing grant for more of the same.

        Raises:
            NotFound: no such question.
            Conflict: `already_resolved`, `escalation_expired`, `digest_mismatch`, `already_approved`, `edit_refused`
                (with policy's reasons), `cell_offline`, `ending`, `grant_refused`; `policy_changed`, `profile_changed`
                where what was asked under another one is decided again.
            Forbidden: `own_proposal`, nobody approves what they proposed; `role_forbidden`, nor once they may no more.
            InvalidParams: edited parameters that do not fit the schema, or edit a session under way; a code that policy
                does not declare, or one with an approval; parameters with a denial; a grant for another object or task.
            RecordUnavailable: nothing was recorded; a denial of a session has been sent to the cell all the same, that
                of a launch holds, and is recorded as soon as it can be.
        """
        why = self._denial(decision, code)
        if decision == "deny" and params is not None:
            raise InvalidParams([{"path": "params", "message": "go with an approval; valid: none with a denial"}])
        entry = await self._open(escalation_id)
        first = await self._needed_first(escalation_id) if decision == "approve" else 1
        async with self.settled(entry) if decision == "approve" else entry.lock:
            present = await self._present(escalation_id, entry.newest)
            _check_answer(present, principal, digest, self.outdated(present))
            if decision == "approve":
                if self.denied(present):
                    message = f"the escalation `{present.id}` is denied, which the record could not take yet"
                    raise Conflict("already_resolved", message)
                self.ask_again(principal)
            grant = None if offer is None else self._grant(offer, present, entry.newest, principal, decision, params)
            answer = Answer(self, entry.newest, present, principal, comment, grant, first)
            match present.kind, decision:
                case "session", "approve":
                    final = await answer.go_on(params)
                case "session", _:
                    final = await answer.end(why)
                case _, "approve":
                    final = await answer.approve(params)
                case _:
                    self._denials[present.id] = Denied(principal, why, comment, self.register.now())
                    final = await self._deny(answer, present)
        return final.public()

    async def _deny(self, answer: Answer, present: Escalation) -> Escalation:
        """Have a denial recorded; it holds until then, and is tried again. Raises `RecordUnavailable`."""
        said = self._denials[present.id]
        final = await answer.deny(said.why, said.at)
        del self._denials[present.id]
        return final

    def denied(self, question: Escalation) -> bool:
        """Say whether somebody has denied a launch, and the record could not take it yet."""
        return question.id in self._denials

    async def _needed_first(self, escalation_id: str) -> int:
        """Return how many people an open question wanted when it was asked first.

        Nothing may be awaited later on, between a decision and what follows. Where it was asked under another policy or
        profile meanwhile, the answer names a digest that is none any more.
        """
        known = self._pending.get(escalation_id)
        if known is None or known.needed == 1:
            return 1
        said = await events_of(self.register.store, invocation=known.invocation, kind=EventKind.ESCALATION)
        return needed_first(said, known)

    @contextlib.asynccontextmanager
    async def settled(self, entry: Entry) -> AsyncGenerator[None]:
        """Hold the lock of an invocation that may launch, on facts newer than the last session's end on its cell.

        While the lock is waited for, a session may end: what is decided then is not decided on the world before.
        """
        cell = self.fleet.cell(entry.newest.cell) if entry.newest.cell else None
        while True:
            await self.fleet.settle(cell)
            async with entry.lock:
                if cell is None or not self.fleet.unsettled(cell):
                    yield
                    return

    def _denial(self, decision: str, code: str | None) -> Denial:
        policy = self.kernel.policy
        found = denial(policy, code)
        if decision != "deny" and code is not None:
            raise InvalidParams([{"path": "code", "message": "belongs to a denial; valid: none with an approval"}])
        if found is None:
            valid = ", ".join(f"`{known.code}`" for known in policy.authority.denials)
            raise InvalidParams([{"path": "code", "message": f"`{code}` is no code of a denial; valid: {valid}"}])
        return found

    def _grant(
        self,
        offer: Offer,
        present: Escalation,
        invocation: Invocation,
        principal: Principal,
        decision: str,
        params: Mapping[str, Any] | None,
    ) -> Standing:
        """Return the grant that goes with an approval: for the same agent, capability, cell and profile."""
        if decision != "approve" or present.kind != APPROVAL or params is not None:
            raise InvalidParams(
                [{"path": "grant", "message": "goes with an approval, before launch, of what was shown"}]
            )
        if len(self.approvals(present)) + 1 < present.needed:
            message = "a standing grant goes with the last approval, and this takes another person"
            raise refused_for(Reason(GRANTS, "another_person", message, "approve without one"))
        shown = self.kernel.handled(invocation, present.effective)
        return self.grants.build(principal, offer.request(invocation, shown), present)

    @uncut
    async def acknowledge(self, escalation_id: str, principal: Principal) -> dict[str, Any]:
        """Note that somebody looks at a question, so that everybody else can see it; nothing is decided by it.

        Saying it again changes nothing.

        Raises:
            NotFound: no such question.
            Conflict: `already_resolved`, `escalation_expired`; `profile_changed`, by which it was withdrawn.
            RecordUnavailable: nothing was recorded.
        """
        entry = await self._open(escalation_id)
        async with entry.lock:
            present = await self._present(escalation_id, entry.newest)
            if any(word["by"] == principal.name for word in present.acknowledged):
                return present.public()
            now = self.register.now()
            known = present.evolve(now, acknowledged=(*present.acknowledged, {"by": principal.name, "since": now}))
            await self.register.append([acknowledged_event(known, principal)], [known.row()])
            self.hold(known)
        return known.public()

    async def _open(self, escalation_id: str) -> Entry:
        """Return the entry of the invocation that an open question is about. Errors as `acknowledge`."""
        known = self._pending.get(escalation_id)
        entry = None if known is None else self.register.entry(known.invocation)
        if entry is None:
            await self._withdraw_stray(escalation_id)
            raise _gone(await self._load(escalation_id))
        return entry

    async def _present(self, escalation_id: str, invocation: Invocation) -> Escalation:
        """Return an open question under its invocation's lock. Errors as `acknowledge`."""
        present = self._pending.get(escalation_id)
        if present is None:
            raise _gone(await self._load(escalation_id))
        if self.due(present) and not self.denied(present):
            with contextlib.suppress(RecordUnavailable):  # it stays pending, and is tried again; the answer is the same
                await self._expire(present, invocation)
            raise Conflict("escalation_expired", f"the escalation `{present.id}` expired at `{present.expires_at}`")
        return present

    # -- silence -----------------------------------------------------------------------------------------------------

    async def expire_due(self) -> None:
        """Close every question whose time is over, as nobody's answer, and every one about what has ended.

        An approval of somebody who may give none any more is taken off what still waits for others.

        All of them at once: a session is told to end before that is recorded, and waits for the record of no other.

        Raises:
            RecordUnavailable: what could not be recorded stays pending; answers to it are refused as expired all the
                same.
        """
        self._denials = {name: said for name, said in self._denials.items() if name in self._pending}
        done = await asyncio.gather(*map(self._close_due, list(self._pending.values())), return_exceptions=True)
        for error in done:
            if error is not None:
                raise error

    async def _close_due(self, known: Escalation) -> None:
        entry = self.register.entry(known.invocation)
        if entry is None:
            await self._withdraw_stray(known.id)
        elif known.id in self._denials:
            async with entry.lock:
                present, said = self._pending.get(known.id), self._denials.get(known.id)
                if present is not None and said is not None:
                    await self._deny(Answer(self, entry.newest, present, said.principal, said.comment), present)
        elif self.due(known):
            async with entry.lock:
                present = self._pending.get(known.id)
                if present is not None and self.due(present):
                    await self._expire(present, entry.newest)
        elif self._void(known):
            async with entry.lock:
                present = self._pending.get(known.id)
                if present is not None and (void := self._void(present)):
                    now = self.register.now()
                    left = present.evolve(now, approvals=self.approvals(present))
                    await self.register.append([voided_event(left, void, entry.newest)], [left.row()])
                    self.hold(left)

    def _void(self, question: Escalation) -> list[str]:
        """Return who approved something that still waits for others, and may approve nothing any more."""
        counting = {said["by"] for said in self.approvals(question)}
        return [said["by"] for said in question.approvals if said["by"] not in counting]

    async def _expire(self, present: Escalation, invocation: Invocation) -> None:
        if present.kind == SESSION_QUESTION:
            await self._expire_session(present, invocation)
        else:
            await self._expire_approval(present, invocation)

    async def _expire_session(self, present: Escalation, invocation: Invocation) -> None:
        """End a held session that nobody spoke for."""
        now = self.register.now()
        closed = present.evolve(now, status=EXPIRED)
        ended = invocation.evolve(now, escalation=closed.reference())
        recording = self.commit([escalation_event(closed)], closed, ended)
        await self.end_session(invocation, present.on_timeout, SERVER, recording, expired=True)

    async def _expire_approval(self, present: Escalation, invocation: Invocation) -> None:
        now = self.register.now()
        void = self._void(present)
        left = present.evolve(now, approvals=self.approvals(present))
        closed = left.evolve(now, status=EXPIRED)
        asked_one = present.needed == 1 and not present.edits
        silence = "nobody answered in time" if asked_one else "too few people approved this in time"
        because = reason(RULE, "approval_expired", silence, "propose again when somebody is on duty")
        ended = invocation.evolve(
            now,
            status=Status.DENIED,
            outcome=Outcome.EXPIRED,
            escalation=closed.reference(),
            policy=with_reason(invocation.policy, because),
        )
        taken_off = [voided_event(left, void, invocation)] if void else []
        await self.commit([*taken_off, escalation_event(closed), outcome_event(ended, SERVER, because)], closed, ended)

    async def _withdraw_stray(self, escalation_id: str) -> None:
        """Withdraw a question whose invocation has ended without it: no answer to it could mean anything.

        Raises:
            RecordUnavailable: it is not recorded; the question is still there to be withdrawn.
        """
        stray = self._pending.pop(escalation_id, None)
        if stray is None:
            return
        now = self.register.now()
        closed = stray.evolve(now, status=WITHDRAWN)
        try:
            versions = await self._without(closed, now)
            await self.register.append([escalation_event(closed)], [closed.row()], versions)
        except RecordUnavailable:
            self.hold(stray)
            raise
        self.hold(closed)

    async def _without(self, closed: Escalation, now: str) -> list[Invocation]:
        """Return the version of an ended invocation that shows its question closed, if there is one that shows it.

        Raises:
            RecordUnavailable: the record cannot say now.
        """
        try:
            ended = await self.register.load(closed.invocation)
        except (RowUnreadable, NotFound):  # damaged, or gone: nobody is to be asked about it either way
            return []
        except AuditError as error:
            raise RecordUnavailable(str(error)) from error
        shown = (ended.escalation or {}).get("id") == closed.id
        return [ended.evolve(now, escalation=closed.reference())] if shown else []

    async def watch_deadlines(self) -> None:
        """Close questions when their time is over, for ever."""
        while True:
            self._asked.clear()
            deadlines = [deadline for item in self._pending.values() if (deadline := item.deadline_s) is not None]
            wait_s = max(0.0, min(POLL_S, min(deadlines) - self.register.now_s())) if deadlines else None
            wait_s = POLL_S if self._denials else wait_s
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._asked.wait()
            try:
                await self.expire_due()
            except RecordUnavailable:  # the store's health says so; the question stays closed to answers meanwhile
                await asyncio.sleep(POLL_S)

    # -- remembering -------------------------------------------------------------------------------------------------

    async def recall(self) -> None:
        """Read back the questions that were open when the server ended, as the log has them.

        An answer is worth what was shown to whoever gave it, so no row can have another question asked. One whose
        invocation has ended without it is read from its row, where the log has it so: it is only there to be withdrawn.
        """
        rows: dict[str, Row] = {}
        cursor: str | None = None
        while True:
            page = await self.register.store.page("escalations", {"status": PENDING}, limit=500, cursor=cursor)
            rows |= {row["id"]: row for row in page.items}
            cursor = page.next
            if cursor is None:
                break
        for known in self.register.live():
            events = await events_of(self.register.store, invocation=known.id)
            said = nothing_said()
            follow(events, said)
            for question in questions_of(events):
                self.hold(question)
                row = rows.pop(question.id, None)
                if row is None or not is_founded(row, said["escalations"]):
                    self.register.unfounded[question.id] = "its row is not what was asked"
        for name, row in rows.items():
            if self.register.entry(row["invocation"]) is None and await self._is_asked(row):
                self.hold(self.register.stored.read("escalations", row, read_escalation))
            else:
                self.register.unfounded[name] = "its row asks what the log does not"
        await self.grants.recall()
        await self.reviews.recall()

    async def _is_asked(self, row: Row) -> bool:
        """Say whether the log has the question of a row as the row has it: what is withdrawn is signed."""
        said = nothing_said()
        follow(await events_of(self.register.store, invocation=row["invocation"]), said)
        return is_founded(row, said["escalations"])


async def _nothing_waits() -> None:
    """Decide nothing again: nobody has said yet who does."""


def _shown(document: bytes) -> dict[str, Any]:
    return read_escalation(document).public()


def _check_answer(present: Escalation, principal: Principal, digest: str, outdated: str | None) -> None:
    stale = outdated or (present.renewed or POLICY_CHANGED if digest in present.former_digests else None)
    if stale is not None:
        raise Conflict(stale, f"{_SINCE[stale]} since that was asked: it is decided again, and may be asked anew")
    if digest != present.digest:
        # Not which one would count: whoever answers has to have read what it stands for.
        message = f"`{digest}` is not what is asked now: the question has changed; valid is to read it again first"
        raise Conflict("digest_mismatch", message)
    if principal.name == present.agent:
        raise Forbidden("own_proposal", "nobody answers for what they proposed themselves")


def _gone(escalation: Escalation) -> Conflict:
    if escalation.status == EXPIRED:
        return Conflict("escalation_expired", f"the escalation `{escalation.id}` expired at `{escalation.expires_at}`")
    if escalation.renewed == PROFILE_CHANGED and not escalation.former_digests:  # it ended by that, and was not renewed
        return Conflict(PROFILE_CHANGED, f"{_SINCE[PROFILE_CHANGED]} since that was asked: it is withdrawn")
    return Conflict("already_resolved", f"the escalation `{escalation.id}` is `{escalation.status}` already")
