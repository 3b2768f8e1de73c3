"""The way from what a cell says to its journal: in the order of what happened, and never in the way of a stop.

A disk may take its time even for one line: pages are written back, a card tidies itself up. Nobody ticks meanwhile who
waits for it, and a robot keeps to its last command. So whatever is said stands in line, and a thread of its own writes
(`write_behind`); what lets something move out of standstill is waited for (`say_first`, `sync`). Without that thread
whoever speaks writes, as evaluation and tests want it.

What cannot be written stays in line until it can be, and `fault` says why; so it does where the disk has not taken the
first in line for `STALL_S`. Nothing may move then.
"""

from __future__ import annotations

import threading
from collections import deque
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final, NamedTuple

from app.cell.journal import USED, JournalUnavailable
from app.clock import monotonic_s
from app.governance.model import EMPTY, EventKind
from app.governance.session import refused_launch

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from app.cell.journal import Entry, Journal
    from app.cell.telling import Saying
    from app.governance.model import Params

STALL_S: Final = 2.0


class Kept(NamedTuple):
    """One thing in line: what was said, with which marks, when, and since when it waits (monotonic)."""

    saying: Saying
    marks: Params
    at_s: float
    tick: int
    since_s: float


class Recorder:
    """Writes what is said to the journal, which is its own from here on.

    The record is in the order of what happened: nothing is written before what stands in line. The marks of that would
    otherwise undo those of what came later.

    One thread speaks. It may look at what the other one writes without asking, and waits for it only where it says so.
    """

    __slots__ = (
        "_acknowledged", "_emit", "_handing", "_journal", "_line", "_looking", "_then", "_turn", "_unsynced", "_wall",
        "_woken", "_writer", "broken", "fault", "tick",
    )  # fmt: skip

    def __init__(self, journal: Journal, wall: Callable[[], float], emit: Callable[[Entry], None]) -> None:
        """Take the journal, a wall clock, and who is told every entry once it is written, by whoever wrote it."""
        self._journal, self._wall, self._emit = journal, wall, emit
        self._line: deque[Kept] = deque()
        self._turn = threading.RLock()  # whoever has it writes
        self._woken = threading.Event()
        self._writer: threading.Thread | None = None
        self._handing = threading.Lock()  # whoever has it looks whether something waits for the line to be written
        self._then: Callable[[], None] | None = None
        self._acknowledged: int | None = None
        self._looking = False
        self._unsynced = False  # something that could not be written at once is, and may be lost with the power
        self.broken = ""
        self.fault = ""
        self.tick = 0

    def write_behind(self) -> None:
        """Have a thread write from here on, for as long as the process lives."""
        self._writer = threading.Thread(target=self._write_on, name="journal", daemon=True)
        self._writer.start()

    # -- saying --------------------------------------------------------------------------------------------------------

    def say(self, saying: Saying, marks: Params = EMPTY) -> None:
        """Have one entry written, behind everything in line.

        Raises:
            JournalUnavailable: it will not be written, and what it was to permit must not happen. Where a thread
                writes, what fails later is in `fault`.
        """
        if self._writer is None:
            self.say_first(saying, marks)
        elif self.fault:
            raise JournalUnavailable(self.fault)
        else:
            self._keep(saying, marks)

    def say_anyway(self, saying: Saying, marks: Params = EMPTY) -> None:
        """Have one entry written once that is possible: for what restrains, and for what has happened already."""
        try:
            self.say(saying, marks)
        except JournalUnavailable:
            self._keep(saying, marks)

    def say_first(self, saying: Saying, marks: Params = EMPTY) -> None:
        """Return once one entry is written, and everything in line before it.

        Raises:
            JournalUnavailable: it is not written, nor will it be.
        """
        with self._turn_in_time():
            self._write_line()
            self._write(self._as_kept(saying, marks))

    def sync(self) -> None:
        """Return once everything said is on the disk. Raises `JournalUnavailable`."""
        with self._turn_in_time():
            self._write_line()
            try:
                self._journal.sync()
            except JournalUnavailable as error:
                self.fault = str(error)
                raise
            self._unsynced = False

    def require_room(self) -> None:
        """Return where a session could be recorded, and what was kept is on the disk: all is well then.

        Raises:
            JournalUnavailable: it could not, or it is not, and `fault` says why.
        """
        with self._turn_in_time():
            self._write_line()
            if self._unsynced:  # an emergency stop may be among it, of which the server has not heard
                self.sync()
            try:
                if self.fault:  # what was refused may not be in line, and no look at the disk tells of a quota
                    self._journal.mark({})
                self._journal.require_room()
            except JournalUnavailable as error:
                self.fault = str(error)
                raise
            self.fault = ""

    def catch_up(self) -> None:
        """Have everything in line written; all is well again once it is on the disk, and there is room for more."""
        if self._writer is None:
            with suppress(JournalUnavailable):  # `fault` says so
                self.require_room()
        else:
            self._looking = True
            self._woken.set()

    def acknowledged(self, seq: int) -> None:
        """Have the journal forget what the server's log holds, and used permits that expired long ago."""
        self._acknowledged = seq
        if self._writer is None:
            self._keep_house()
        else:
            self._woken.set()

    def settle(self) -> None:
        """Return once nothing is left in line that can be written; for whoever leaves."""
        with suppress(JournalUnavailable), self._turn_in_time():  # `fault` says so
            self._write_line()

    def when_written(self, then: Callable[[], None]) -> None:
        """Do something once everything said so far is written, or at once where that cannot be.

        One thing waits at most: the newest takes the place of an older one. It may be done by the thread that writes.
        """
        with self._handing:
            waits = bool(self._line) and not self.fault
            self._then = then if waits else None
            if not waits:
                then()
        if waits:
            self._woken.set()

    # -- looking -------------------------------------------------------------------------------------------------------

    def check_on_time(self) -> None:
        """See to it that what the disk does not take for long is not waited for in silence: `fault` says so."""
        if self._line and not self.fault:
            with suppress(IndexError):  # written just now
                if monotonic_s() - self._line[0].since_s > STALL_S:
                    self.fault = _stalled()

    def used_permits(self) -> frozenset[str]:
        """Return the identifiers of permits that were used and have not been forgotten, written or not."""
        marks = [name for kept in tuple(self._line) for name in kept.marks]
        return self._journal.used_permits().union(name.removeprefix(USED) for name in marks if name.startswith(USED))

    def unsaid_ends(self) -> dict[str, tuple[str, str]]:
        """Return how what stands in line says that invocations ended: outcome and code, by invocation.

        A launch that was refused is no more than that where the session of its name ran already.
        """
        ends: dict[str, tuple[str, str]] = {}
        for saying in [kept.saying for kept in tuple(self._line)]:
            if saying.invocation is None:
                continue
            if saying.kind == EventKind.OUTCOME:
                ends[saying.invocation] = str(saying.body["outcome"]), str(saying.body["code"])
            elif saying.kind == EventKind.LAUNCH and "refused" in saying.body:
                code = str(saying.body["refused"])
                ends.setdefault(saying.invocation, (refused_launch(code).value, code))
        return ends

    # -- writing -------------------------------------------------------------------------------------------------------

    def _as_kept(self, saying: Saying, marks: Params) -> Kept:
        return Kept(saying, marks, self._wall(), self.tick, monotonic_s())

    def _keep(self, saying: Saying, marks: Params) -> None:
        self._line.append(self._as_kept(saying, marks))
        self._woken.set()

    @contextmanager
    def _turn_in_time(self) -> Generator[None]:
        if not self._turn.acquire(timeout=STALL_S):
            self.fault = _stalled()
            raise JournalUnavailable(self.fault)
        try:
            yield
        finally:
            self._turn.release()

    def _write_on(self) -> None:
        try:
            while True:
                self._woken.wait()
                self._woken.clear()
                with suppress(JournalUnavailable), self._turn:  # `fault` says so, and whoever ticks asks again
                    self._do_what_waits()
        except Exception as error:  # nobody would write any more
            self.broken = self.fault = f"what writes the journal broke: {error!r}"

    def _do_what_waits(self) -> None:
        if self._looking:
            self._looking = False
            self.require_room()
        self._write_line()
        self._keep_house()

    def _write_line(self) -> None:
        if self.broken:
            raise JournalUnavailable(self.broken)
        while True:
            while self._line:
                self._write(self._line[0])
                self._unsynced = self._unsynced or bool(self.fault)
                self._line.popleft()
            if not self._do_then():  # what was said before that is in line by now
                return

    def _do_then(self) -> bool:
        """Do what was to be done once all is written that was said before; say whether there is more to write."""
        with self._handing:
            if self._line:
                return True
            if self._then is not None:
                self._then()
                self._then = None
        return False

    def _keep_house(self) -> None:
        seq, self._acknowledged = self._acknowledged, None
        if seq is None:
            return
        # A journal that cannot be made smaller is whole all the same; the next thing to be recorded says what is wrong.
        with suppress(JournalUnavailable):
            self._journal.acknowledge(seq)
            self._journal.forget_permits(self._wall())

    def _write(self, kept: Kept) -> None:
        saying = kept.saying
        try:
            entry = self._journal.append(at_s=kept.at_s, tick=kept.tick, marks=kept.marks, **saying._asdict())
        except JournalUnavailable as error:
            self.fault = str(error)
            raise
        self._emit(entry)


def _stalled() -> str:
    return f"the disk has not taken what was to be recorded for {STALL_S:g} s"
