"""Which cells there are, and what the record keeps of each: its profile, a latched stop, how far its reports are in.

A server that has just started knows by it whom it waits for, and who is stopped. What the record could not take when it
was due is taken down as soon as it can.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final

import orjson

from app.audit.cells import LATCHED, latch_problem, latches, progress_problem, reported
from app.audit.errors import RecordUnavailable, RowUnreadable
from app.audit.event import EventDraft, RowWrite
from app.clock import monotonic_s
from app.governance.model import SESSION, EventKind
from app.protocol import ProtocolError
from app.runtime.cells import KEPT, Cell
from app.runtime.drafts import SERVER
from app.runtime.errors import NotFound
from app.runtime.recollection import events_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from app.audit.reader import Row
    from app.runtime.register import Register

MOST_CELLS: Final = 64  # each costs memory, and its part of what every console is shown
FORGOTTEN_S: Final = 3600.0


class Roster:
    """The cells of one server, by name. One that was heard of stays, unless others need its place.

    Only so many are known. Where one more comes, the one is forgotten that has been away for longest, an hour at the
    least, and of which nothing is known but what the record holds: that is read back should it come again. One that the
    record knows, and that was forgotten at a start, takes at once the place of another that has not come since.
    """

    def __init__(self, register: Register, *, default_profile: str) -> None:
        """Take the register and the profile of a cell never seen before."""
        self._register = register
        self._cells: dict[str, Cell] = {}
        self.default_profile = default_profile

    def __contains__(self, cell_id: str) -> bool:
        """Say whether the cell was ever heard of."""
        return cell_id in self._cells

    def cell(self, cell_id: str) -> Cell:
        """Return a cell.

        Raises:
            NotFound: never heard of.
        """
        try:
            return self._cells[cell_id]
        except KeyError:
            raise NotFound("cell", cell_id) from None

    def cells(self) -> list[Cell]:
        """Return all cells, by name."""
        return [self._cells[name] for name in sorted(self._cells)]

    def get(self, cell_id: str | None) -> Cell | None:
        """Return a cell, or None where nobody has heard of it."""
        return self._cells.get(cell_id or "")

    async def newcomer(self, cell_id: str) -> Cell:
        """Return a cell that says this name; one that is not among those known is kept once it `stays`.

        Raises:
            AuditError: nobody knows what the record holds of it.
        """
        if (known := self._cells.get(cell_id)) is not None:
            return known
        cell, store = Cell(id=cell_id, profile=self.default_profile), self._register.store
        if (row := await store.row("cell_progress", cell=cell_id)) is not None:
            cell.journal, cell.taken = row["journal"], {row["journal"]: row["up_seq"]}
        for name in KEPT:
            if (kept := await store.row("settings", name=f"{name}/{cell_id}")) is not None:
                self._register.stored.read("settings", kept, partial(cell.recall, name))
        await self._believe_reports(cell)
        return self._cells.get(cell_id, cell)

    def stays(self, cell: Cell) -> Cell:
        """Keep a cell, and return the one there is by its name.

        Raises:
            ProtocolError: so many are known, and each of them has to be.
        """
        if cell.id not in self._cells and len(self._cells) >= MOST_CELLS:
            self._forget(unseen=bool(cell.journal))
            if len(self._cells) >= MOST_CELLS:
                raise ProtocolError(f"`{MOST_CELLS}` cells are known, and none may be forgotten: valid is one of them")
        return self._cells.setdefault(cell.id, cell)

    def _forget(self, *, unseen: bool) -> None:
        """Have room for one more: leave to the record what it holds of cells that have been away, the longest first."""
        engaged = {invocation.cell for invocation in self._register.live()}
        idle = [cell for cell in self._cells.values() if cell.id not in engaged and self._is_idle(cell, unseen)]
        idle.sort(key=lambda cell: cell.absent_since_s or 0.0)
        for cell in idle[: max(0, len(self._cells) - MOST_CELLS + 1)]:
            del self._cells[cell.id]

    def _is_idle(self, cell: Cell, unseen: bool) -> bool:
        """Say whether all that is known of a cell stands in its rows: it is away, has nothing, and owes nothing.

        `unseen`: nobody has to wait for it who has not come since the start.
        """
        if cell.attachment is not None or cell.absent_since_s is None or cell.expected:
            return False
        stopped = cell.latched or cell.itself or cell.unheard is not None or cell.latch_unkept or cell.resetting
        engaged = cell.claim or cell.control or cell.owed or cell.profile != self.default_profile
        waits = cell.came or cell.arriving.locked() or cell.recording.locked() or cell.profiling.locked()
        missed = (unseen and cell.recalled) or monotonic_s() - cell.absent_since_s >= FORGOTTEN_S
        return missed and not (stopped or engaged or waits)

    # -- what the record keeps ---------------------------------------------------------------------------------------

    async def keep(self, cell: Cell, drafts: Sequence[EventDraft], **settings: str | bool) -> None:
        """Record events together with settings of a cell (`profile`, `estop`). Raises `RecordUnavailable`."""
        now = self._register.now()
        rows = [
            RowWrite(
                table="settings",
                values={"name": f"{name}/{cell.id}", "value": orjson.dumps(value), "updated_at": now},
            )
            for name, value in settings.items()
        ]
        await self._register.append(drafts, rows)

    async def keep_late(self) -> None:
        """Record the stops that were latched while the record could take nothing; what fails now is tried again."""
        for cell in self.cells():
            if cell.latch_unkept:
                cell.latch_unkept = False
                # With a word of its own: the one that latched it may be among what nothing could be said of yet.
                word = EventDraft(kind=EventKind.CELL, actor=SERVER, body={"what": LATCHED, "cell": cell.id})
                try:
                    await self.keep(cell, [word], estop=True)
                except RecordUnavailable:
                    cell.latch_unkept = cell.latched

    async def introduce(self, cell: Cell, drafts: Sequence[EventDraft]) -> None:
        """Record that a cell is there, so that it is known after a restart. Raises `RecordUnavailable`."""
        async with cell.recording:  # or an older count could follow a newer one into the record
            await self._register.append(drafts, cell.progress(cell.taken, self._register.now()))

    async def recall(self) -> None:
        """Read back which cells there are, their profiles and latched stops, and who had them when the server ended.

        A cell whose own row is missing, because the record could take none when it came, is known by whatever names it:
        a stop must not be forgotten with it.
        """
        progress = await self._register.store.rows("cell_progress")
        for row in sorted(progress, key=lambda row: row["updated_at"]):
            cell = self._recalled(row["cell"])
            cell.journal, cell.taken = row["journal"], {row["journal"]: row["up_seq"]}
        settings = await self._register.store.rows("settings")
        for row in settings:
            name, _, cell_id = row["name"].partition("/")
            if name in KEPT and cell_id:
                cell = self._recalled(cell_id)
                try:
                    self._register.stored.read("settings", row, partial(cell.recall, name))
                except RowUnreadable:
                    cell.latched |= name == "estop"  # whoever knows no better holds
        for invocation in self._register.live():
            if invocation.cell is not None:
                cell = self._recalled(invocation.cell)
                cell.claim = invocation.id if invocation.status in SESSION else cell.claim
        await self._believe_the_log({row["name"]: row for row in settings})
        if len(self._cells) > MOST_CELLS:
            self._forget(unseen=True)

    def _recalled(self, cell_id: str) -> Cell:
        """Return a cell of an earlier run, which is away."""
        if cell_id not in self._cells:
            self._cells[cell_id] = Cell(
                id=cell_id, profile=self.default_profile, recalled=True, absent_since_s=monotonic_s()
            )
        return self._cells[cell_id]

    async def _believe_the_log(self, settings: Mapping[str, Row]) -> None:
        """Take from the log what cells stand under, and what of theirs it holds, whatever their rows say."""
        await self._believe_stops(settings)
        await self._believe_profiles()
        for cell in self._cells.values():
            await self._believe_reports(cell)

    async def _believe_stops(self, settings: Mapping[str, Row]) -> None:
        """Latch every cell whose stop stands in the log, by a word or its own report; also one that no row knows.

        One whose newest reset was not heard says itself, at its return, whether it is latched still. Where log and row
        disagree the stricter holds: what the row latches stays latched.
        """
        known = await self._register.store.ask(latches)
        for cell_id, latch in known.items():
            if latch.latched:
                cell = self._recalled(cell_id)
                cell.latched |= latch.worded or latch.itself
                cell.itself, cell.unheard = latch.itself, latch.unheard
        for cell_id in self._cells:
            worded = cell_id in known and known[cell_id].worded
            name = f"estop/{cell_id}"
            if (wrong := latch_problem(settings.get(name), worded=worded)) is not None:
                self._register.unfounded[name] = wrong if worded else f"{wrong}: it stays so until a reset"

    async def _believe_profiles(self) -> None:
        """Put every cell under the profile that was chosen for it last."""
        chosen: dict[str, str] = {}
        for event in await events_of(self._register.store, kind=EventKind.PROFILE_CHANGED):
            body: dict[str, Any] = event.payload()
            chosen[body["cell"]] = body["profile"]
        for cell in self._cells.values():
            profile = chosen.get(cell.id, self.default_profile)
            if cell.profile != profile:
                self._register.unfounded[f"profile/{cell.id}"] = f"its row says `{cell.profile}`"
                cell.profile = profile

    async def _believe_reports(self, cell: Cell) -> None:
        """Take no report for recorded that the log does not hold: what is acknowledged, a cell forgets."""
        held = await self._register.store.ask(partial(reported, cell=cell.id, journals=tuple(cell.taken)))
        for journal, seq in held.items():
            if cell.taken[journal] > seq:
                name = f"{'cell_progress' if journal == cell.journal else 'journals'}/{cell.id}"
                self._register.unfounded[name] = progress_problem(cell.taken[journal], seq)
                cell.taken[journal] = seq
