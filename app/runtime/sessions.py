"""What cells report becomes the record, and what follows from it: statuses, outcomes, questions.

Report and consequence are one transaction, so an invocation never says more than the log. A report can only be about an
invocation of the cell that makes it, and only of a kind that a cell may say; anything else ends the link.

When server and cell have lost sight of each other:

| the server believes | the cell | becomes |
|---|---|---|
| a session | is back and holds it | `escalated`; a human decides |
| a session | is back without it | `failed`, outcome `fault` (`session_lost`) |
| a session | has been away for `LOST_S`, its process not being started | `escalated` (`link_lost`) |
| a session | has been away for `absent_s` | `failed`, outcome `fault` (`cell_lost`) |
| a session | says it is over, its journal being full | over, with that outcome (`journal_unavailable`) |
| a launch | said nothing of it until its permit ran out | `failed`, outcome `fault` (`launch_unconfirmed`) |
| a session that was let go on | still waits after `GOES_ON_S` | asked about again (`not_gone_on`) |
| no such session, or it has ended | holds one | is told to stop it |

A cell that comes back after `absent_s` finds its session ended, and is told to stop: nothing goes on that the server
has given up.
"""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, suppress
from typing import TYPE_CHECKING, Any, Final

from app.audit.documents import TABLES, follow, is_founded, nothing_said
from app.audit.errors import AuditError, RecordUnavailable
from app.audit.event import EventDraft
from app.clock import monotonic_s, parse_rfc3339
from app.governance.control import GOING_ON, TAKEOVER, Phase, refused
from app.governance.model import SESSION, EventKind, Outcome, Status
from app.governance.session import final_status
from app.protocol import Human, ProtocolError
from app.runtime.cells import LAUNCH_WITHIN_S, PAUSE, ended_by
from app.runtime.drafts import SERVER, escalation_event, outcome_event, reason
from app.runtime.escalation import DENIED, EXPIRED, PENDING, ROLLBACK, WITHDRAWN
from app.runtime.failures import failure
from app.runtime.hands import HELD, OPEN, never_taken, over
from app.runtime.questions import RULE
from app.runtime.recollection import events_of, last_phase, last_question
from app.runtime.story import DONE, Story, denied
from app.runtime.telemetry import CUT_OFF
from app.runtime.uncut import uncut

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from app.audit.event import Event, RowWrite
    from app.protocol import Ended, Hello, Sighting, UpEvent
    from app.runtime.cells import Cell
    from app.runtime.desk import Desk
    from app.runtime.fleet import Fleet
    from app.runtime.invocation import Invocation
    from app.runtime.register import Register
    from app.runtime.telemetry import Telemetry

LOST_S: Final = 1.0
ABSENT_S: Final = 30.0
LAST_ROWS_S: Final = 0.5
SEALED_S: Final = 2.0  # as long as who asks for telemetry of a session that has just ended waits for it at most
LOST_WITH_CELL: Final = frozenset(
    {"session_lost", "cell_lost", "cell_restarted"}
)  # how a session ends without its cell
END_TAKEOVER: Final = "end_takeover"
UNWRITABLE: Final = "journal_unavailable"
GOES_ON_S: Final = 2.0  # a session that was answered has long begun by then
UNCONFIRMED_S: Final = LAUNCH_WITHIN_S + 1.0  # by then the permit has run out
_ENDS_AS: Final = {DENIED: "on_deny", EXPIRED: "on_timeout"}  # what a question says of it
LIFTING: Final = GOING_ON | {TAKEOVER, "release"}  # words that end a pause
LIVED_THROUGH: Final = SESSION | {Status.COMPLETED, Status.FAILED}
ENDS: Final = frozenset(Outcome) - {Outcome.REJECTED, Outcome.DENIED, Outcome.DEFERRED, Outcome.EXPIRED}  # of sessions
REPORTABLE: Final = frozenset({
    EventKind.LAUNCH, EventKind.ALERT, EventKind.INTERVENTION, EventKind.RECOVERY, EventKind.STATUS, EventKind.HUMAN,
    EventKind.ESCALATION, EventKind.OUTCOME, EventKind.CELL,
})  # fmt: skip
SERVERS_WORDS: Final = frozenset({*TABLES, WITHDRAWN, "role", "cell"})
"""What no report holds. A role is a person's: an echo of their word names none. And a cell speaks of itself alone."""
CODES: Final = frozenset({"op", "what", "reason", "refused", "permit", "failure", "code"})  # what follows goes by these


class Sessions:
    """Takes what cells say, and keeps invocations in step with it."""

    def __init__(
        self, register: Register, fleet: Fleet, desk: Desk, telemetry: Telemetry, *, absent_s: float = ABSENT_S
    ) -> None:
        """Take the parts; `absent_s` is how long a cell with a session may be away before it is given up."""
        self._register = register
        self._fleet = fleet
        self._desk = desk
        self._telemetry = telemetry
        self._absent_s = absent_s
        self._sealing: dict[str, str] = {}
        self._seals: dict[str, asyncio.Task[None]] = {}

    # -- reports -----------------------------------------------------------------------------------------------------

    def check(self, cell: str, event: UpEvent) -> None:
        """Refuse a report this cell may not make.

        Raises:
            ProtocolError: a kind or a word that only the server says, a code that is no text, a status or outcome that
                is none, or an invocation that is live on another cell.
        """
        if event.kind not in REPORTABLE:
            raise ProtocolError(f"a cell does not report `{event.kind}`: valid are {', '.join(sorted(REPORTABLE))}")
        if strange := SERVERS_WORDS & event.body.keys():  # what is asked and granted is read back from those
            raise ProtocolError(f"a cell's report holds no `{min(strange)}`: that is the server's to say")
        for word in CODES & event.body.keys():
            if not isinstance(said := event.body[word], str | None):
                raise ProtocolError(f"`{word}` of a cell's report is a text or null, not a `{type(said).__name__}`")
        match event.kind:
            case EventKind.STATUS:
                _member("status", event.body.get("status"), LIVED_THROUGH)
            case EventKind.OUTCOME:
                _member("outcome", event.body.get("outcome"), ENDS)
            case _:
                pass
        known = None if event.invocation is None else self._register.newest(event.invocation)
        if known is not None and known.cell != cell:
            raise ProtocolError(f"`{event.invocation}` is not an invocation of the cell `{cell}`")

    async def absorb(self, cell: str, events: Sequence[UpEvent], rows: Sequence[RowWrite]) -> None:
        """Record reports with the rows given, and what follows from them, all of it or nothing.

        Reports of an invocation that the cell never had, or that was never launched, are kept, outside its trace.

        Raises:
            RecordUnavailable: nothing was recorded.
        """
        names = {event.invocation for event in events if event.invocation is not None}
        strange = frozenset([name for name in names if not await self._had(cell, name)])
        async with AsyncExitStack() as locks:
            versions: dict[str, Invocation] = {}
            for name in sorted(names - strange):
                entry = self._register.entry(name)
                if entry is not None:
                    await locks.enter_async_context(entry.lock)
                    versions[name] = entry.newest
            story = Story(self._desk, versions, strange)
            for event in events:
                story.tell(cell, event, self._register.now())
            questions = story.questions.values()
            await self._register.append(story.drafts, [*rows, *(item.row() for item in questions)], story.changed())
            self._desk.hold(*questions)
        for version in story.changed():
            self._keep_control(story.before(version.id), version)
        self._telemetry.note(*(event for event in events if event.invocation not in strange))
        for version in story.changed():
            if version.final:
                self._seal_soon(version, cell)

    async def _had(self, cell: str, name: str) -> bool:
        """Say whether an invocation was ever launched on this cell, live or over.

        Raises:
            RecordUnavailable: the record cannot say now.
        """
        known = self._register.newest(name)
        if known is not None:
            return known.cell == cell and known.status in SESSION
        try:
            row = await self._register.store.row("invocations", id=name)
        except AuditError as error:
            raise RecordUnavailable(str(error)) from error
        return row is not None and row["cell"] == cell and row["status"] in LIVED_THROUGH

    def _keep_control(self, before: Invocation, version: Invocation) -> None:
        """Keep the lease of a cell's controls in step with what became of the session they were of.

        Only news count: a lease is there before its takeover is recorded, and reports come meanwhile.
        """
        cell = self._fleet.cell(version.cell or "")
        control = cell.control
        if control is None or control.invocation != version.id:
            return
        former, state = (None if one.takeover is None else one.takeover["state"] for one in (before, version))
        if state == former and not version.final:
            return
        if version.final or state not in OPEN:
            cell.control = None
        elif state == HELD and control.phase is Phase.RETURNING:
            cell.control = refused(control, monotonic_s())

    def telemetry(self, cell: str, invocation: str, rows: Sequence[tuple[float, ...]]) -> None:
        """Keep rows of a session of this cell; rows of anything else are refused.

        Raises:
            ProtocolError: the invocation is live on another cell.
        """
        if self._recording(cell, invocation):
            self._telemetry.write(invocation, rows)

    def sighting(self, cell: str, sighting: Sighting) -> None:
        """Keep where people and things were in a session of this cell; what is of anything else is refused.

        Raises:
            ProtocolError: the invocation is live on another cell.
        """
        if self._recording(cell, sighting.invocation):
            self._telemetry.sight(sighting)

    def _recording(self, cell: str, invocation: str) -> bool:
        known = self._register.newest(invocation)
        if known is not None and known.cell != cell:
            raise ProtocolError(f"telemetry of `{invocation}`, which is not an invocation of the cell `{cell}`")
        if known is None:
            return self._sealing.get(invocation) == cell
        return known.status in SESSION

    def _seal_soon(self, ended: Invocation, cell: str) -> None:
        self._sealing[ended.id] = cell
        task = asyncio.create_task(self._seal(ended, cell), name=f"seal-{ended.id}")
        self._seals[ended.id] = task
        task.add_done_callback(lambda _: self._seals.pop(ended.id, None))

    async def sealed(self, invocation: str) -> None:
        """Wait, shortly, until the telemetry of a session that has just ended is sealed."""
        if (task := self._seals.get(invocation)) is not None:
            await asyncio.wait([task], timeout=SEALED_S)

    async def _seal(self, ended: Invocation, cell: str) -> None:
        """Seal a session's telemetry once its last rows are in: they precede the cell's next state."""
        with suppress(TimeoutError):
            async with asyncio.timeout(LAST_ROWS_S):
                await self._fleet.cell(cell).stated.wait()
        reasons = (ended.failure or {}).get("reasons", ())
        await self._sealed(ended.id, lost=any(because["code"] in LOST_WITH_CELL for because in reasons))

    async def tell_unsealed(self) -> None:
        """Record what telemetry was lost with an earlier run of the server, which was killed: nobody vouches for it.

        Else a session that outlived it would look as if it had been measured whole.
        """
        for name, count in self._telemetry.unsealed().items():
            if await self._register.store.row("invocations", id=name) is None:  # what else lies there is not ours
                continue
            said = await events_of(self._register.store, invocation=name, kind=EventKind.TELEMETRY)
            told = sum("failed" in event.payload() for event in said)
            draft = EventDraft(kind=EventKind.TELEMETRY, actor=SERVER, invocation=name, body={"failed": CUT_OFF})
            await self._register.say(*[draft] * (count - told))

    async def _sealed(self, invocation: str, *, lost: bool = False) -> None:
        """Seal a session's telemetry; `lost` where its cell was, and with it what that had not sent."""
        self._sealing.pop(invocation, None)
        draft = await self._telemetry.seal(invocation, lost=lost)
        if draft is not None:
            await self._register.say(draft)

    async def close(self) -> None:
        """Seal what is open and say what was left unsaid; what a session reports later goes into another file."""
        if self._seals:
            await asyncio.wait(self._seals.values())
        for invocation in self._telemetry.open():
            await self._sealed(invocation)
        await self._fleet.roster.keep_late()
        await self._register.say_unsaid()

    # -- coming and going --------------------------------------------------------------------------------------------

    async def recall(self) -> None:
        """Owe cells again what was said in an earlier run to hold or end their sessions, where they may not know it."""
        for known in self._register.live():
            if known.status not in SESSION or not known.cell:
                continue
            events = await events_of(self._register.store, invocation=known.id)
            await self._compare_answered(events)
            if (word := _last_word(known, events) or _unheard_pause(events)) is not None:
                said = {"invocation": known.id, "actor": SERVER, **word}
                self._fleet.restrain(self._fleet.cell(known.cell), Human.model_validate(said))

    async def _compare_answered(self, events: Sequence[Event]) -> None:
        """Name the row of a session's last question where it was answered and the row is not what the log has of it."""
        question = last_question(events)
        if question is None or question["status"] == PENDING:  # the desk compares those that are open
            return
        row = await self._register.store.row("escalations", id=question["id"])
        said = nothing_said()
        follow(events, said)
        if row is None or not is_founded(row, said["escalations"]):
            self._register.unfounded.setdefault(question["id"], "its row is not what was asked and answered")

    async def attached(self, cell: str, hello: Hello) -> None:
        """Record that a cell is there, in the trace of the invocation that it holds, if it has that from here.

        Raises:
            RecordUnavailable: it is not recorded, nor anything that was said before.
        """
        place, held = self._fleet.cell(cell), None
        with suppress(RecordUnavailable):  # its word says which one all the same
            held = hello.invocation if hello.invocation and await self._had(cell, hello.invocation) else None
        body = {"link": "attached", **hello.model_dump(exclude={"type", "version", "cell"})}
        draft = EventDraft(kind=EventKind.CELL, actor=cell, body=body, invocation=held)
        if not await self._register.say_unsaid():
            raise RecordUnavailable("what came before is not recorded yet")
        await self._fleet.roster.introduce(place, [draft])

    async def left(self, cell: str) -> None:
        """Record that a cell's link is gone."""
        place = self._fleet.cell(cell)
        await self._register.say(
            EventDraft(kind=EventKind.CELL, actor=SERVER, body={"link": "lost", "cell": cell}, invocation=place.claim)
        )

    async def reconcile(self, cell: str, hello: Hello, believed: str | None) -> None:
        """Compare what the cell held with what the server believed, every older report being in.

        Raises:
            RecordUnavailable: not all of it is recorded; asking again does the rest.
        """
        place = self._fleet.cell(cell)
        if hello.invocation is not None and not self._register.under_way(hello.invocation):
            self._fleet.restrain(place, Human(invocation=hello.invocation, op="stop", actor=SERVER))
        if believed is None:
            return
        if believed != hello.invocation:
            await self._fault(believed, "session_lost", "the cell is back without the session")
            return
        known = self._register.newest(believed)
        # Who drives now took it on this very link: a lease ends with the link it was given on.
        lost = None if known is None or place.driven(believed) else known.takeover
        if lost is not None and lost["state"] in OPEN:
            self._fleet.restrain(place, Human(invocation=believed, op="let_go", actor=SERVER))
            await self._never_taken(place, believed)
        if place.lapsed:
            await self._ask(believed, "link_returned", "the cell is back and has held the session meanwhile")

    async def _never_taken(self, place: Cell, name: str) -> None:
        """Note that the launch of a human's driving was lost with its link, of which the cell has said nothing."""
        entry = self._register.entry(name)
        if entry is None:
            return
        async with entry.lock:
            present = entry.newest
            if present.terms.taking and not place.driven(name) and not present.final:
                body = {"what": "never_taken", "cell": place.id}
                draft = EventDraft(kind=EventKind.CELL, actor=SERVER, invocation=name, body=body)
                await self._register.append([draft], versions=[never_taken(present, self._register.now())])

    async def unrecorded(self, cell: str, ended: Sequence[Ended]) -> None:
        """End the sessions of this cell that it says are over, and cannot report: its journal cannot be written.

        What it reports of them once it can is recorded as what came late.
        """
        over = {end.invocation: end for end in ended}
        for invocation in self._sessions_of(cell):
            if (end := over.get(invocation.id)) is not None:
                message = f"the cell cannot write its journal; it says itself that the session is over (`{end.code}`)"
                told: list[dict[str, str]] = [] if end.code == UNWRITABLE else failure(end.code)["reasons"]
                with suppress(RecordUnavailable):  # tried again at the next round
                    await self._finish(invocation.id, Outcome(end.outcome), UNWRITABLE, message, told)

    async def overdue(self, cell: str) -> None:
        """See to a session whose cell is away, and to what a cell that is there has not done."""
        place = self._fleet.cell(cell)
        await self._register.say_unsaid()
        for invocation in self._sessions_of(cell):
            with suppress(RecordUnavailable):  # tried again at the next round
                if place.absent_since_s is not None:
                    await self._missed(invocation, place, monotonic_s() - place.absent_since_s)
                elif place.attachment is not None and place.attachment.settled:
                    await self._owing(invocation, place)

    async def _missed(self, invocation: Invocation, place: Cell, absent_s: float) -> None:
        """See to a session whose cell is away."""
        if absent_s > self._absent_s:
            await self._fault(invocation.id, "cell_lost", f"the cell has been away for more than {self._absent_s} s")
        elif absent_s > LOST_S and not place.expected:
            await self._ask(invocation.id, "link_lost", "the link to the cell is lost; the cell holds by itself")

    async def _owing(self, invocation: Invocation, place: Cell) -> None:
        """See to a session whose cell is there, and has said nothing that is not in the log."""
        terms, answered_at = invocation.terms, invocation.updated_at
        launched_s = None if terms.confirmed else terms.launched_at_s
        if launched_s is not None and self._late(place, "launch", str(terms.authorization), launched_s, UNCONFIRMED_S):
            self._fleet.restrain(place, Human(invocation=invocation.id, op="stop", actor=SERVER))
            await self._fault(invocation.id, "launch_unconfirmed", "the cell never confirmed the launch")
        elif (
            invocation.status is Status.ESCALATED
            and self._desk.pending_for(invocation.id) is None
            and self._late(place, "answer", answered_at, parse_rfc3339(answered_at), GOES_ON_S)
        ):  # what lets it go on is sent once, and may be lost or refused
            message = "it was answered, and the session waits all the same"
            place.onward = None
            await self._ask(invocation.id, "not_gone_on", message)

    def _late(self, place: Cell, what: str, upon: str, since_s: float, most_s: float) -> bool:
        """Say whether a session has been waited for too long, by either clock: the wall's may have been put back."""
        waited_s = place.awaited_s(what, upon)
        return waited_s > most_s or self._register.now_s() > since_s + most_s

    async def _phase(self, invocation: Invocation) -> str | None:
        """Return the phase that a held session waits for, by the last question about it.

        Raises:
            RecordUnavailable: the record cannot say now.
        """
        if invocation.status is not Status.ESCALATED:
            return None
        try:
            return await last_phase(self._register.store, invocation.id)
        except AuditError as error:
            raise RecordUnavailable(str(error)) from error

    def _sessions_of(self, cell: str) -> list[Invocation]:
        return [known for known in self._register.live() if known.cell == cell and known.status in SESSION]

    @uncut
    async def _ask(self, name: str, code: str, message: str) -> None:
        """Escalate a session, unless a human has been asked already, or has answered: what follows is on its way."""
        entry = self._register.entry(name)
        if entry is None:
            return
        async with entry.lock:
            present = entry.newest
            if present.status not in SESSION or self._desk.pending_for(name) is not None:
                return
            cell = self._fleet.cell(present.cell or "")
            if cell.ending(name) is not None or cell.goes_on(name):
                return
            phase, now = await self._phase(present), self._register.now()
            question = self._desk.session_question(present, [reason(RULE, code, message)], phase)
            asked = present.evolve(now, status=Status.ESCALATED, escalation=question.reference())
            await self._desk.commit([escalation_event(question)], question, asked)

    async def _fault(self, name: str, code: str, message: str) -> None:
        """End a session as a fault."""
        await self._finish(name, Outcome.FAULT, code, message)

    @uncut
    async def _finish(
        self, name: str, outcome: Outcome, code: str, message: str, told: Sequence[Mapping[str, str]] = ()
    ) -> None:
        """End a session of which the cell itself has not reported the end; `told` is why, as far as it has said so."""
        entry = self._register.entry(name)
        if entry is None:
            return
        async with entry.lock:
            present = entry.newest
            if present.status not in SESSION:
                return
            open_question = self._desk.withdrawal(name)
            changes: dict[str, Any] = {} if open_question is None else {"escalation": open_question.reference()}
            because = [*denied(self._desk.kernel.policy, present), *told, reason(RULE, code, message)]
            changes["failure"] = None if outcome in DONE else {"reasons": because}
            changes["takeover"] = over(present.takeover)
            ended = present.evolve(self._register.now(), status=final_status(outcome), outcome=outcome, **changes)
            rows = [] if open_question is None else [open_question.row()]
            drafts = [] if open_question is None else [escalation_event(open_question)]
            drafts.append(outcome_event(ended, SERVER, reason(RULE, code, message)))
            await self._register.append(drafts, rows, [ended])
            if open_question is not None:
                self._desk.hold(open_question)
        self._seal_soon(ended, ended.cell or "")  # no other cell waits for what this one's file takes


def _last_word(known: Invocation, events: Sequence[Event]) -> dict[str, Any] | None:
    """Return by which word a session was to end, if the log has that one was said, or that nobody said one in time."""
    if (word := ended_by(_words(events))) is not None:
        return {"op": word}
    answered = last_question(events)
    if known.status is not Status.ESCALATED or answered is None or answered["status"] not in _ENDS_AS:
        return None
    undone = answered.get(_ENDS_AS[answered["status"]]) == ROLLBACK
    return None if undone else {"op": "resolve_terminate", "expired": answered["status"] == EXPIRED}


def _words(events: Sequence[Event]) -> list[str]:
    """Return the words that were said to a session, but for the end of a takeover that was over when it was heard.

    An emergency stop of its cell is a stop of the session that it met, also where it was reset since.
    """
    said: list[str] = []
    for event in events:
        body = event.payload() if event.kind == EventKind.HUMAN else {}
        word = END_TAKEOVER if body.get("then") == "end" else str(body.get("op"))
        word = "stop" if word == "estop" else word
        if word == END_TAKEOVER and body.get("refused") == "not_taken_over":
            said = [earlier for earlier in said if earlier != END_TAKEOVER]
        else:
            said.append(word)
    return said


def _unheard_pause(events: Sequence[Event]) -> dict[str, Any] | None:
    """Return a pause that nobody has lifted since, and of which the cell has not said that it heard it."""
    pause: dict[str, Any] | None = None
    for event in events:
        body = event.payload() if event.kind in {EventKind.HUMAN, EventKind.APPROVAL} else {}
        match body.get("op"):
            case "pause":
                pause = {"op": PAUSE, "actor": event.actor} if "role" in body else None
            case str(op) if op in LIFTING:
                pause = None
            case _ if "decision" in body:
                pause = None
            case _:
                pass
    return pause


def _member(what: str, value: object, valid: Any) -> None:  # noqa: ANN401  # an enumeration or a set of one
    names = sorted(str(item) for item in valid)
    if value not in names:
        raise ProtocolError(f"`{value}` is no {what}: valid are {', '.join(names)}")
