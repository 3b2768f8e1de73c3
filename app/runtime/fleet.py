"""The fleet: every cell the server knows, what is known of each, and the two ways to speak to one.

`restrain` sends at once and asks nobody; `order` is for everything that lets something move, and its caller has
recorded it already. A cell that is away is owed its restraints: it gets them with its next welcome, before anything
else. What lets something move is never kept for later.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from typing import TYPE_CHECKING, Any, Final

from app.audit.cells import CONFIRMED
from app.audit.errors import RecordUnavailable
from app.audit.event import EventDraft
from app.clock import monotonic_s
from app.governance.model import SESSION, CellFacts, EventKind
from app.protocol import BEAT_MS, LEASE_MS, Estop, Human, Launch, Policy, ProtocolError, Reset, Watch, encode
from app.runtime.budget import ROW
from app.runtime.cells import FRESH_S, Reunion, read_world
from app.runtime.drafts import SERVER
from app.runtime.errors import Conflict
from app.runtime.link import DEAD_S, RETRY_S, SILENT_S, TRY_LATER, Attachment
from app.runtime.roster import Roster
from app.runtime.screens import Screens
from app.runtime.uncut import uncut

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping, Sequence

    from app.governance.control import Control
    from app.governance.model import WorldFacts
    from app.protocol import Hello, Jog, Message, Sighting, State, UpEvent
    from app.runtime.cells import Cell, Line, Moment
    from app.runtime.link import Link
    from app.runtime.register import Register
    from app.runtime.reports import Reports

TEND_S: Final = 0.25
EXPECTED_S: Final = 10.0  # a process that takes longer to start is missed like any other
NOWHERE: Final = CellFacts(id="", online=False)
TOO_MUCH: Final = "it reports more than is recorded of one cell: its reports wait"
RESET_S: Final = 1.0  # a cell states itself ten times a second, and on every change


class Fleet:
    """Cells and their links, of one server."""

    def __init__(self, register: Register, *, default_profile: str) -> None:
        """Take the register and the profile of a cell never seen before."""
        self._register = register
        self.roster = Roster(register, default_profile=default_profile)
        self._closings: set[asyncio.Task[None]] = set()
        self._reports: Reports | None = None
        self.screens = Screens(self.show_cell)
        self.on_stated: Callable[[Cell], None] = lambda _: None
        self.kernel_key = ""
        self.policy_digest = ""
        self.policy_files: Mapping[str, str] = {}
        self._profiles = frozenset[str]()  # that the policy in force knows

    def enforce(
        self, *, kernel_key: str, policy_digest: str, policy_files: Mapping[str, str], profiles: frozenset[str]
    ) -> None:
        """Say which key signs and which policy is in force; cells learn it now, or at their welcome.

        What is ordered from here on comes behind it, on every link.
        """
        self.kernel_key = kernel_key
        self._profiles = profiles
        self.policy_digest = policy_digest
        self.policy_files = policy_files
        for cell in self.cells():
            if cell.attachment is not None and cell.attachment.welcomed:
                cell.attachment.post(Policy(digest=policy_digest, files=dict(policy_files)))

    def report_to(self, reports: Reports) -> None:
        """Say who takes the cells' reports; without that no cell can attach."""
        self._reports = reports

    @property
    def _desk(self) -> Reports:
        if self._reports is None:
            raise RuntimeError("the fleet takes no reports yet: call `report_to` first")
        return self._reports

    # -- what is known -----------------------------------------------------------------------------------------------

    def cell(self, cell_id: str) -> Cell:
        """Return a cell.

        Raises:
            NotFound: never heard of.
        """
        return self.roster.cell(cell_id)

    def cells(self) -> list[Cell]:
        """Return all cells, by name."""
        return self.roster.cells()

    def knows(self, cell_id: str) -> bool:
        """Say whether the cell was ever heard of."""
        return cell_id in self.roster

    def choose(self) -> Cell | None:
        """Return the cell for a proposal that names none: one that is free, else one to wait for, else any.

        A latched cell, one that holds and one that says nothing of use is not free; it is chosen only where no other is
        there. A busy one is worth waiting for, a latched one is not.
        """
        cells = self.cells()
        fresh = [cell for cell in cells if cell.fresh]
        usable = [cell for cell in fresh if not self.latched(cell)]
        awake = [cell for cell in usable if self._trouble(cell) is None]
        free = [cell for cell in awake if self.busy(cell) is None]
        return next(iter(free or awake or usable or fresh or cells), None)

    def busy(self, cell: Cell) -> str | None:
        """Return the invocation that has the cell: claimed by the server, or held by the cell itself."""
        if cell.claim is not None:
            return cell.claim
        held = None if cell.state is None else cell.state.invocation
        return None if held == cell.ended else held  # its state may be a little older than its last report

    def facts(self, cell: Cell | None) -> CellFacts:
        """Return what a decision may know of a cell, now; of no cell at all, that it is not there."""
        if cell is None:
            return NOWHERE
        state = cell.state if cell.fresh and not cell.owing else None
        return CellFacts(
            id=cell.id,
            online=state is not None,
            latched=self.latched(cell),
            busy=self.busy(cell),
            holding_link=state is not None and state.holding,
            recording=state is None or state.fault is None,
            facts=None if state is None else self._world(cell, state),
        )

    def profile(self, cell: Cell | None) -> str:
        """Return the profile a cell works under; the default one where there is no cell."""
        return self.roster.default_profile if cell is None else cell.profile

    def latched(self, cell: Cell) -> bool:
        """Say whether a stop is latched, on the server or on the cell, which may not have heard of its reset yet."""
        if cell.latched or cell.reset or cell.unheard is not None:
            return True
        hello = None if cell.attachment is None else cell.attachment.hello
        said = hello if cell.state is None else cell.state
        return said is not None and said.latched

    def _world(self, cell: Cell, state: State) -> WorldFacts | None:
        if cell.world is None and cell.trouble is None:
            try:
                cell.world = read_world(state.facts)
            except ValueError as error:
                cell.trouble = f"the cell's facts are malformed: {error}"
        return cell.world

    def document(self, cell: Cell) -> dict[str, Any]:
        """Return the cell as JSON, for lists."""
        state = cell.state if cell.fresh else None
        attachment = cell.attachment
        hello = None if attachment is None else attachment.hello
        return {
            "id": cell.id,
            "online": state is not None,
            "latched": self.latched(cell),
            "profile": cell.profile,
            "busy": self.busy(cell),
            "status": None if state is None or cell.outlived else state.status,
            "holding_link": state is not None and state.holding,
            "fault": None if state is None else _fault(cell, state),
            "robot": None if hello is None else hello.robot,
            "policy_version": None if state is None else state.policy_digest,
            "facts": None if state is None else state.facts,
            "gauges": {} if state is None else state.gauges,
            "control": cell.control_document(),
            "armed_by": cell.armed_by,
            "session": None if state is None or state.session is None or cell.outlived else state.session.model_dump(),
        }

    def problems(self) -> dict[str, str]:
        """Return what is in the way of any launch, by cell; empty where some cell could take a proposal."""
        if not self.cells():
            return {"cells": "no cell has ever attached"}
        found = self.unusable()
        return found if len(found) == len(self.cells()) else {}

    def unusable(self) -> dict[str, str]:
        """Return why cells take no proposal now, by cell, whether others do or not."""
        known = {f"cell/{cell.id}": self._trouble(cell) for cell in self.cells()}
        return {name: why for name, why in known.items() if why is not None}

    def _trouble(self, cell: Cell) -> str | None:
        """Return why a cell takes no proposal, however free it is; None where it may take one."""
        if cell.state is None or not cell.fresh:
            return "not attached, or silent"
        if (fault := _fault(cell, cell.state)) is not None:
            return fault
        if cell.profile not in self._profiles:
            valid = ", ".join(f"`{name}`" for name in sorted(self._profiles))
            return f"the policy in force has no profile `{cell.profile}`; valid: put it under one of {valid}"
        if cell.records.owed_s() > 0:
            return TOO_MUCH
        if cell.behind:
            return "its older reports are not in the log yet"
        self._world(cell, cell.state)  # which finds out
        if cell.trouble is not None:
            return cell.trouble
        return "holds: its link's lease lapsed" if cell.state.holding else None

    def faults(self) -> dict[str, str]:
        """Return why cells that are there move nothing, by cell: without a record, a guard, or the site in force.

        Or the log lacks what they have reported, and they could not send it again. Or their clocks are others.
        """
        known = {cell.id: _fault(cell, cell.state) for cell in self.cells() if cell.fresh and cell.state is not None}
        return {f"cell/{name}": why for name, why in known.items() if why is not None}

    # -- having a cell -----------------------------------------------------------------------------------------------

    def claim(self, cell: Cell, invocation: str) -> None:
        """Give the cell to one invocation, between its decision and its end.

        Raises:
            RuntimeError: somebody has it; a decision on fresh facts would have said so.
        """
        if cell.claim not in (None, invocation):
            raise RuntimeError(f"cell `{cell.id}` is claimed by `{cell.claim}` already")
        cell.claim = invocation

    def release(self, cell_id: str | None, invocation: str, *, ended: bool = False) -> None:
        """Let the cell go, if this invocation has it; `ended` where the cell itself said that the session is over."""
        cell = self.roster.get(cell_id)
        if cell is None:
            return
        if cell.driven(invocation):
            cell.control = None
        if cell.claim != invocation:
            return
        cell.claim = None
        cell.owed = {key: message for key, message in cell.owed.items() if key[1] != invocation}
        cell.restrained.clear()
        if ended:
            cell.ended = invocation
            cell.ended_at_s = monotonic_s()

    async def settle(self, cell: Cell | None) -> None:
        """Wait for facts newer than the last session's end: what it changed counts for the next decision.

        A state that names that session was on its way when it ended, whenever it came. Waits no longer than the facts
        that are there count for. Whoever decides then meets a cell that is silent, not what its world looked like
        before.
        """
        while cell is not None and self.unsettled(cell):
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(max(0.0, cell.state_at_s + FRESH_S - monotonic_s())):
                    await cell.stated.wait()

    def unsettled(self, cell: Cell) -> bool:
        """Say whether the facts that are there are from before the last session's end."""
        return cell.fresh and cell.outlived

    def expect(self, cell_id: str, coming: bool) -> None:
        """Note that a cell's process is being started, or that nobody starts it any more."""
        cell = self.roster.get(cell_id)
        if cell is not None:
            cell.expected_until_s = monotonic_s() + EXPECTED_S if coming else 0.0

    async def unlatch(self, cell: Cell, actor: str, *, seen: int, decided: Moment) -> bool:
        """Have a cell that is there leave its latched stop; waits, shortly, until it says that it has heard of that.

        What it says before may be older than the stop itself. One that is away, or was meanwhile, says when it is back
        whether it is latched still. Returns whether the cell has said that it heard.

        Args:
            cell: which.
            actor: who says so.
            seen: of which tick the state was that they say it of: a stop that the cell has set since stays.
            decided: how the cell stood when they said it; ticks are counted anew by one that was restarted.
        """
        reset = Reset(id=secrets.token_hex(8), actor=actor, seen=seen)
        try:
            self.order(cell, reset, decided=decided)
        except Conflict:
            return False
        cell.reset = reset.id
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(RESET_S):
                while cell.reset == reset.id:
                    await cell.stated.wait()
        return cell.state is not None and cell.state.reset == reset.id

    # -- speaking to a cell ------------------------------------------------------------------------------------------

    def restrain(self, cell: Cell, message: Human | Estop) -> bool:
        """Send a restraint at once, ahead of everything. Returns whether the cell is there.

        One that is away is owed it. What is said to its session is owed until the cell says that it has heard it, what
        ends the session until that is over: a link may drop with it.
        """
        attachment = cell.attachment
        there = attachment is not None and attachment.welcomed
        match message:
            case Human():
                cell.note(message, there=there)
            case Estop():  # the latch itself is remembered, and sent at every welcome until it is reset
                if cell.claim is not None:
                    cell.note(Human(invocation=cell.claim, op="stop", actor=message.actor), there=there)
        if attachment is not None and there:
            attachment.post(message, urgent=True)
        return there

    def order(self, cell: Cell, message: Message, *, decided: Moment) -> None:
        """Send something that was recorded, and behind it every restraint that was said while it was.

        Args:
            cell: whom to.
            message: what.
            decided: how the cell stood when it was decided.

        Raises:
            Conflict: `cell_offline`, the cell is not there, or was away meanwhile; nothing is kept for later.
        """
        attachment = self.check(cell, decided)
        if isinstance(message, Launch | Human):
            cell.lifted(decided.restraints)
            if cell.claim is not None:  # whatever of these is ordered has the cell's session begin, or go on
                cell.onward = attachment, cell.claim
        attachment.post(message)
        for number, restraint in cell.restrained.values():
            if number > decided.restraints:
                attachment.post(restraint)

    def check(self, cell: Cell, decided: Moment) -> Line:
        """Return the link that a cell has had ever since something was decided.

        Raises:
            Conflict: `cell_offline`, it is not there, or was away meanwhile.
        """
        attachment = cell.attachment
        if attachment is None or not attachment.welcomed or attachment is not decided.link:
            raise Conflict("cell_offline", f"the cell `{cell.id}` is not attached, or was away meanwhile")
        return attachment

    def jog(self, cell: Cell, command: Jog) -> bool:
        """Pass a jog command on; only the newest one waits, and one that is not sent at once is never kept.

        Returns whether the cell is there.
        """
        attachment = cell.attachment
        if attachment is None or not attachment.welcomed:
            return False
        attachment.jog(command)
        return True

    def loosen(self, cell: Cell, actor: str) -> Control | None:
        """Take a cell's controls out of whoever's hands they are in: a controlled stop. Returns whose they were."""
        control, cell.control = cell.control, None
        if control is not None:
            self.restrain(cell, Human(invocation=control.invocation, op="let_go", actor=actor))
        return control

    def show_cell(self, cell_id: str, on: bool) -> None:
        """Have a cell show itself, or not any more; one that is away is asked again at its welcome."""
        cell = self.roster.get(cell_id)
        if cell is not None and cell.attachment is not None and cell.attachment.welcomed:
            cell.attachment.post(Watch(on=on))

    def attached(self, cell: Cell) -> bool:
        """Say whether the cell is there to be spoken to."""
        return cell.attachment is not None and cell.attachment.welcomed

    # -- links -------------------------------------------------------------------------------------------------------

    async def attach(self, cell_id: str, link: Link) -> Attachment:
        """Take a new link for a cell; its first frame must be `Hello`.

        The caller passes every frame to the attachment's `receive`, and calls `detach` when the socket is gone.

        Raises:
            AuditError: the cell is not known, and the record cannot be asked about it.
        """
        return Attachment(self, await self.roster.newcomer(cell_id), link)

    async def take_place(self, attachment: Attachment, hello: Hello) -> None:
        """Make this the cell's link, unless another one lives; a new cell is recorded first.

        Raises:
            ProtocolError: the cell has a link that was heard within the last second, or too many others are known.
        """
        cell = self.roster.stays(attachment.cell)
        attachment.cell = cell
        present = cell.attachment
        if present is not None and not present.closed and present.silent_s() < DEAD_S:
            raise ProtocolError(f"the cell `{cell.id}` has a live link already: one link per cell")
        away_s = cell.away_s() if present is None else present.silent_s()
        cell.lapsed = away_s is None or away_s >= LEASE_MS / 1000
        if "" in cell.taken:  # recorded before journals had names: the numbers go on in this one
            cell.taken[hello.journal] = cell.taken.pop("")
        cell.latched |= cell.forgetful(hello)
        cell.journal = hello.journal  # another one counts for itself, and those before it stay known
        cell.attachment = attachment
        cell.state = cell.arming = None  # what was armed was so by what an earlier run may have said
        cell.reset = ""
        if present is not None:
            self.loosen(cell, "server")  # the lease ended with the link, whose `leave` comes too late now
        cell.absent_since_s = None
        cell.expected_until_s = 0.0
        cell.recalled = False
        if present is not None:
            present.shut(TRY_LATER, "another link took this one's place")

    def welcome(self, attachment: Attachment, hello: Hello) -> None:
        """Deliver what the cell is owed, stops first, and see what it was doing."""
        cell = attachment.cell
        if cell.latched:
            attachment.post(Estop(actor="server"))
        for message in cell.owed.values():
            attachment.post(message)
        cell.owed = {key: message for key, message in cell.owed.items() if key[1] == cell.claim}
        if self.screens.watched(cell.id):
            attachment.post(Watch(on=True))
        # Only what is believed now: a session launched on this very link must not be held against its `Hello`, not even
        # one that has the cell already and is being recorded.
        known = None if cell.claim is None else self._register.newest(cell.claim)
        believed = None if known is None or known.status not in SESSION else known.id
        cell.unreconciled = Reunion(hello=hello, believed=believed)

    async def arrived(self, attachment: Attachment, hello: Hello) -> None:
        """Record that a cell is there, and that its former link is not, as soon as the record takes it.

        Only its reports wait for that: the log tells by it which journal they count in. Of a link that is gone before
        it could be recorded, nothing is.
        """
        cell = attachment.cell
        async with cell.arriving:
            await self._left(cell)
            while cell.attachment is attachment:
                if await self._attached(cell, hello):
                    break
                await asyncio.sleep(RETRY_S)
        await self.caught_up(attachment)

    async def _attached(self, cell: Cell, hello: Hello) -> bool:
        """Record that a cell is there; returns whether it is recorded."""
        if cell.records.owed_s() > 0:
            return False
        try:
            await self._desk.attached(cell.id, hello)
        except RecordUnavailable:
            return False
        cell.records.spend(len(encode(hello)) + 2 * ROW)  # and that it leaves
        cell.came = True
        return True

    async def _left(self, cell: Cell) -> None:
        """Record that a cell's link is gone, of which the record says that it is there."""
        if cell.came:
            cell.came = False
            await self._desk.left(cell.id)

    async def _unrecorded(self, cell: Cell, attachment: Line) -> None:
        """Have what a cell says has ended, and cannot write down, seen to once every older report is in."""
        fault = None if cell.state is None else cell.state.fault
        if fault is not None and fault.ended and attachment.settled:
            await self._desk.unrecorded(cell.id, fault.ended)

    async def _confirmed(self, cell: Cell) -> None:
        """Record that a cell has no stop although it was not heard to have had its reset: it stays latched until then.

        It never heard of the stop, or of both. A start knows by this alone that nothing is latched.
        """
        said = cell.state if cell.fresh else None
        pending = cell.latched or cell.reset or cell.resetting
        if cell.unheard != cell.journal or said is None or said.latched or pending:
            return
        body = {"what": CONFIRMED, "op": "reset", "cell": cell.id}
        with contextlib.suppress(RecordUnavailable):
            await self._register.append([EventDraft(kind=EventKind.CELL, actor=SERVER, body=body)])
            cell.unheard = cell.unheard if cell.resetting else None

    def _stop_stray(self, cell: Cell, attachment: Line) -> None:
        """Tell a cell to stop a session that nobody believes it to have: it ended, or is not known here."""
        held = cell.state.invocation if cell.fresh and cell.state is not None else None
        if held is None or held == cell.claim or self._register.under_way(held):
            return
        just_ended = (
            held == cell.ended and monotonic_s() - cell.ended_at_s <= FRESH_S
        )  # its state may be a little older
        if not just_ended and cell.told != (attachment, held):
            cell.told = attachment, held
            self.restrain(cell, Human(invocation=held, op="stop", actor="server"))

    async def caught_up(self, attachment: Line) -> None:
        """Compare what the cell holds with what the server believes, as soon as every older report is in."""
        cell = attachment.cell
        reunion = cell.unreconciled
        if reunion is None or cell.attachment is not attachment or cell.up_seq < reunion.hello.last_seq:
            return
        try:
            await self._desk.reconcile(cell.id, reunion.hello, reunion.believed)
        except RecordUnavailable:
            return  # `tend` tries again
        if cell.unreconciled is reunion:
            cell.unreconciled = None

    async def leave(self, attachment: Attachment) -> None:
        """Forget a link whose socket is gone; the cell stays known."""
        cell = attachment.cell
        if cell.attachment is attachment:
            cell.attachment = None
            cell.unreconciled = None
            cell.absent_since_s = monotonic_s()
            self.loosen(cell, "server")  # the cell holds by itself; should it be back before it does, it is told
            async with cell.arriving:  # it came before it left
                await self._left(cell)

    def closing(self, closing: Coroutine[Any, Any, None]) -> None:
        """Close a socket without waiting for it."""
        task = asyncio.ensure_future(closing)
        self._closings.add(task)
        task.add_done_callback(self._closed)

    def _closed(self, task: asyncio.Task[None]) -> None:
        self._closings.discard(task)
        if not task.cancelled():
            task.exception()  # a socket that cannot be closed is gone all the same

    # -- what cells say ----------------------------------------------------------------------------------------------

    def take_state(self, cell: Cell, state: State) -> None:
        """Keep the newest state."""
        cell.state = state
        cell.state_at_s = monotonic_s()
        cell.ahead_s = state.at_s - self._register.now_s()
        if state.reset == cell.reset:
            cell.reset = ""
        cell.stated.set()
        cell.stated = asyncio.Event()
        cell.world = None
        cell.trouble = None
        self.on_stated(cell)

    def take_telemetry(self, cell: Cell, invocation: str, rows: Sequence[tuple[float, ...]]) -> None:
        """Pass rows of telemetry on."""
        self._desk.telemetry(cell.id, invocation, rows)

    def take_sighting(self, cell: Cell, sighting: Sighting) -> None:
        """Pass on where people and things were."""
        self._desk.sighting(cell.id, sighting)

    def check_report(self, cell: Cell, event: UpEvent) -> None:
        """Refuse a report that this cell may not make. Raises `ProtocolError`."""
        self._desk.check(cell.id, event)

    @uncut
    async def record(self, attachment: Line, batch: Sequence[UpEvent], lengths: Sequence[int]) -> None:
        """Record what of a batch the log does not hold yet, and how far it has come then.

        Runs to its end even if the link that brought the batch is gone meanwhile: what the record has taken is known
        to have been taken, also to the next link, and its cell has spent what it costs.

        Args:
            attachment: which link brought it.
            batch: the reports, in order.
            lengths: of each, in characters.

        Raises:
            RecordUnavailable: nothing was recorded.
            ProtocolError: a report the cell may not make, or the cell has not this link any more.
        """
        cell = attachment.cell
        async with cell.recording:
            # The log counts reports in the journal of the link that it knows of last: these are sent again on theirs.
            if cell.attachment is not attachment:
                raise ProtocolError(f"the cell `{cell.id}` has another link by now, or none")
            journal = cell.journal
            if not await self._register.say_unsaid():
                raise RecordUnavailable("what came before is not recorded yet")
            known = cell.taken.get(journal, 0)
            fresh = [event for event in batch if event.seq > known]
            if not fresh:
                return
            taken = cell.taken_with(journal, fresh[-1].seq)
            await self._desk.absorb(cell.id, fresh, cell.progress(taken, self._register.now()))
            cell.taken = taken
            cell.records.spend(sum(lengths[len(batch) - len(fresh) :]) + len(fresh) * ROW)
        for event in fresh:
            if event.kind == EventKind.LAUNCH:
                cell.onward = None
            elif event.kind == EventKind.HUMAN and event.invocation is not None:
                cell.heard(str(event.body.get("op")), event.invocation, event.body.get("refused"))
            elif event.kind == EventKind.CELL and event.invocation is None:
                cell.reported(event.body.get("what"))

    # -- keeping on --------------------------------------------------------------------------------------------------

    async def beat(self) -> None:
        """Keep every link's lease alive, for ever."""
        while True:
            for cell in self.cells():
                if cell.attachment is not None and cell.attachment.welcomed:
                    cell.attachment.beat()
            await asyncio.sleep(BEAT_MS / 1000)

    async def watch(self) -> None:
        """Close links that hang, and stop what nobody believes to run, for ever: no record is waited for."""
        while True:
            await asyncio.sleep(TEND_S)
            self.look()

    def look(self) -> None:
        """Close silent links, and tell cells to stop sessions that nobody believes them to have."""
        for cell in self.cells():
            attachment = cell.attachment
            if attachment is not None and attachment.silent_s() > SILENT_S:
                attachment.shut(TRY_LATER, f"nothing heard for {SILENT_S} s")
            if attachment is not None and attachment.welcomed:
                self._stop_stray(cell, attachment)

    async def tend(self) -> None:
        """See to cells that owe something, for ever."""
        while True:
            await asyncio.sleep(TEND_S)
            await self.tend_once()

    async def tend_once(self) -> None:
        """Have what is overdue seen to."""
        await self.roster.keep_late()
        for cell in self.cells():
            attachment = cell.attachment
            if attachment is not None and attachment.welcomed:
                await self.caught_up(attachment)
                await self._unrecorded(cell, attachment)
                await self._confirmed(cell)
            if self.knows(cell.id):  # it may have been forgotten meanwhile
                await self._desk.overdue(cell.id)


def _fault(cell: Cell, state: State) -> str | None:
    missing = None if cell.missing is None else _lacking(*cell.missing)
    unwritten = None if state.fault is None else state.fault.why
    return state.broken or missing or unwritten or state.elsewhere or cell.untimely or None


def _lacking(first: int, last: int) -> str:
    return (
        f"the log lacks its reports `{first}` to `{last}`, which it has not kept: the record was put back to an older "
        "copy. Put the newer one back, or start the cell with its journal moved away"
    )
