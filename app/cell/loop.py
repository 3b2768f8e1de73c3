"""The cell's control loop on a thread of its own: 100 Hz by deadline, and nothing in it waits for the network.

Everything that wants something from the runner (the link, a signal) puts an `Order` into the inbox; the loop obeys
between ticks and, while it waits for the next deadline, at once. Everything the runner says leaves through the
`Outbox`. The lease is judged here as well, so that a cell whose link thread is stuck holds all the same.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from queue import Empty
from typing import TYPE_CHECKING, Final, Protocol, TypeAlias

from app.cell.run import LINK
from app.clock import monotonic_s
from app.governance.model import Status
from app.protocol import LEASE_MS, STATE_MS, Ack, Estop, Human, Jog, Launch, Reset, SetProfile, State

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from queue import SimpleQueue

    from app.cell.moment import Moment, Sight
    from app.governance.policy import PolicySet
    from app.protocol import Scene, UpEvent

MAX_LAG_S: Final = 0.1  # a loop further behind than this starts afresh instead of catching up
MAX_BATCHES: Final = 3000  # about ten minutes of telemetry while nobody listens
MOST_LATE: Final = 64  # orders that a tick which is due may wait for: a burst, but no flood
STOPPING_S: Final = 2.0  # how long a controlled stop may take before the loop ends anyway
LOOK_S: Final = 1 / 30
SIGHT_EVERY: Final = 20  # ticks: taking hold of all poses costs some 12 us, of which a tick may bear one
MAX_SIGHTS: Final = 3000  # about ten minutes while nobody listens
WORKING: Final = frozenset({Status.RUNNING, Status.PAUSED, Status.RECOVERING})


@dataclass(frozen=True, slots=True)
class Welcomed:
    """The server answered the cell's hello: the lease runs again."""

    profile: str


@dataclass(frozen=True, slots=True)
class NewPolicy:
    """The bundle the server sent, its digest verified, compiled."""

    policies: PolicySet


@dataclass(frozen=True, slots=True)
class Shutdown:
    """Come to a controlled stop, then leave the loop."""


Order: TypeAlias = Launch | Human | Jog | Estop | Reset | SetProfile | Ack | Welcomed | NewPolicy | Shutdown
Inbox: TypeAlias = "SimpleQueue[Order]"


class Governed(Protocol):
    """What the loop drives: the runner, as seen from its thread."""

    @property
    def period_s(self) -> float:
        """Return the control period."""
        ...

    def tick(self) -> None:
        """Do one control period."""
        ...

    def obey(self, order: Order) -> None:
        """Do what was ordered; what cannot be done is reported upward, never raised."""
        ...

    def hold(self, reason: str) -> None:
        """Hold in place (category 2) and launch nothing until welcomed."""
        ...

    def state(self, overruns: int) -> State:
        """Return the newest state, with its facts and how many ticks came late."""
        ...

    def standing(self) -> bool:
        """Say whether nothing moves."""
        ...

    def when_written(self, then: Callable[[], None]) -> None:
        """Do something once everything said so far is recorded, or at once where that cannot be."""
        ...

    def settle(self) -> None:
        """Return once everything that can be recorded is."""
        ...

    def break_off(self, error: Exception) -> None:
        """Stop by category 0 and stay latched, on the disk: nobody ticks any more."""
        ...

    def look(self) -> Moment:
        """Return what there is to be seen at this moment, for displays."""
        ...

    def sight(self) -> Sight | None:
        """Return where people and things are during a session, for its telemetry; None without one."""
        ...


class Lease:
    """When the server was last heard; written by the link, read by the loop.

    A lapse that anybody saw is final until the next welcome. Were it judged anew each time, a frame that comes right
    after the loop began to hold would hide the lapse from the link: it would not dial again, and the hold never end.
    Nor does a welcome undo it for a loop that was busy meanwhile, and obeys by an older term still.
    """

    __slots__ = ("_heard_s", "_lapsed", "_term")

    def __init__(self) -> None:
        """Start lapsed: a cell holds until it is welcomed."""
        self._heard_s = float("-inf")
        self._term = 0
        self._lapsed = 0  # the term that lapsed last

    def welcomed(self) -> None:
        """Begin a new term: the server answered the cell's hello just now."""
        self.lapsed()  # for the record, where nobody has asked since the last frame
        self._heard_s = monotonic_s()
        self._term += 1  # last, so that whoever looks meanwhile sees the old term, or a new one that was just heard

    def heard(self) -> None:
        """Note that the server spoke just now; a term that has lapsed stays so, also where nobody has asked before."""
        self.lapsed()  # a cell that stood still may read what was said meanwhile before anybody looks at the time
        self._heard_s = monotonic_s()

    def lapsed(self, since: int | None = None) -> bool:
        """Say whether nothing was heard for `LEASE_MS` at a time when it was asked since the last welcome.

        Args:
            since: the term of an older welcome, for whoever goes by that one still.
        """
        term = self._term
        if monotonic_s() - self._heard_s > LEASE_MS / 1000:
            self._lapsed = term  # both threads ask: one that judged an old term must not end a new one
        return self._lapsed >= (term if since is None else since)


class Outbox:
    """What the loop hands over to the link: events until they are acknowledged, telemetry, the newest state.

    One thread fills, another empties; each operation is one atomic step on a deque or a reference.
    """

    def __init__(self, last_seq: int = 0) -> None:
        """Start empty, with nobody to wake; `last_seq` is the newest report that the journal holds already."""
        self.events: deque[UpEvent] = deque()
        self.batches: deque[bytes] = deque(maxlen=MAX_BATCHES)
        self.sights: deque[Sight] = deque(maxlen=MAX_SIGHTS)
        self.things: tuple[str, ...] = ()  # which bodies of the scene sightings are of
        self.state: State | None = None
        self.last_seq = last_seq
        self.changed = False
        self.scene: Scene | None = None
        self.watched = 0  # which time it is that somebody wants to see; 0 while nobody does
        self.moment: Moment | None = None
        self.wake: Callable[[], None] = lambda: None

    def event(self, event: UpEvent) -> None:
        """Report one event; it stays until the server has it."""
        self.events.append(event)
        self.last_seq = max(self.last_seq, event.seq)
        self.changed = True
        self.wake()

    def batch(self, frame: bytes) -> None:
        """Hand over one frame of telemetry; the oldest goes when nobody listens for long."""
        self.batches.append(frame)
        self.wake()

    def say(self, state: State) -> None:
        """Hand over the newest state, behind the reports of what led to it."""
        self.state = state
        self.wake()

    def acknowledge(self, seq: int) -> None:
        """Forget what the server's log holds."""
        while self.events and self.events[0].seq <= seq:
            self.events.popleft()

    def after(self, seq: int, last: int) -> Sequence[UpEvent]:
        """Return the events behind a sequence number and up to another, in order."""
        return [event for event in tuple(self.events) if seq < event.seq <= last]


class TickLoop:
    """Drives the runner tick by tick.

    Pace is simulated seconds per second while a session works, and 0 as fast as possible; whatever idles, or is driven
    by hand, goes at most as fast as the clock.
    """

    def __init__(self, runner: Governed, inbox: Inbox, outbox: Outbox, lease: Lease, *, pace: float) -> None:
        """Take the runner over; nobody else may touch it from here on."""
        self._runner = runner
        self._inbox = inbox
        self._outbox = outbox
        self._lease = lease
        self._pace = pace
        self._held = True
        self._term = 0  # of the lease: how many welcomes it has obeyed
        self._ending = False
        self._state_due_s = self._look_due_s = 0.0
        self._thread = threading.Thread(target=self.run, name="tick", daemon=True)
        self.overruns = 0
        self.ticks = 0
        self.broken: Exception | None = None

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def join(self, timeout_s: float) -> bool:
        """Wait for the loop to end; say whether it did."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def alive(self) -> bool:
        """Say whether the loop runs."""
        return self._thread.is_alive()

    def run(self) -> None:
        """Tick until shut down. A bug in the runner cuts power, and ends the loop and with it the cell.

        Whatever starts the cell again finds it latched: what broke would break again, or drive on as if it had not.
        """
        try:
            self._run()
        except Exception as error:  # whatever it is, the link reads it here and ends the process
            self.broken = error
            self._runner.break_off(error)  # a robot keeps to its last command until somebody says otherwise
            self._runner.settle()
            self._outbox.state = self._runner.state(self.overruns)
        finally:
            self._outbox.wake()

    def _run(self) -> None:
        due_s = monotonic_s()
        while not self._ending:
            self._check_lease()
            self._runner.tick()
            self.ticks += 1
            if self.ticks % SIGHT_EVERY == 0 and (sight := self._runner.sight()) is not None:
                self._outbox.sights.append(sight)  # it leaves with the next telemetry or state: no need to wake anybody
            self._publish()
            due_s = self._next_due(due_s)
            self._obey_until(due_s)
        self._come_to_rest()

    def _next_due(self, due_s: float) -> float:
        now_s = monotonic_s()
        pace = self._pace if self._working() else min(self._pace or 1.0, 1.0)  # to hurry through nothing is dear
        if not pace:
            return now_s
        due_s += self._runner.period_s / pace
        if due_s >= now_s:
            return due_s
        self.overruns += 1
        return due_s if now_s - due_s < MAX_LAG_S else now_s

    def _working(self) -> bool:
        state = self._outbox.state
        return state is not None and state.status in WORKING and state.jog is None

    def _obey_until(self, due_s: float) -> None:
        """Obey what has come in, and whatever comes in before the deadline; then no more than a burst.

        Nobody watches meanwhile, and the last command stays in force: however many orders come, the tick does.
        """
        late = 0
        while not self._ending and late < MOST_LATE:
            try:
                wait_s = due_s - monotonic_s()
                order = self._inbox.get(timeout=wait_s) if wait_s > 0 else self._inbox.get_nowait()
            except Empty:
                return
            late += wait_s <= 0
            self._obey(order)

    def _obey(self, order: Order) -> None:
        self._check_lease()  # what a connection has left behind whose lease lapsed is obeyed by a cell that holds
        match order:
            case Shutdown():
                self._ending = True
                self._runner.hold("shutdown")
            case Welcomed():
                self._held = False
                self._term += 1
                self._runner.obey(order)
            case Jog():  # many a second: the state says ten times a second what became of them
                self._runner.obey(order)
                return
            case _:
                self._runner.obey(order)
        self._outbox.changed = True

    def _check_lease(self) -> None:
        if not self._held and self._lease.lapsed(self._term):
            self._held = True
            self._runner.hold(LINK)

    def _publish(self) -> None:
        """Make the newest state public ten times a second and on every change."""
        now_s = monotonic_s()
        if self._outbox.watched and now_s >= self._look_due_s:
            self._look_due_s = max(self._look_due_s + LOOK_S, now_s)
            self._outbox.moment = self._runner.look()
            self._outbox.wake()
        if now_s < self._state_due_s and not self._outbox.changed:
            return
        self._outbox.changed = False
        self._state_due_s = now_s + STATE_MS / 1000
        state = self._runner.state(self.overruns)
        self._runner.when_written(lambda: self._outbox.say(state))  # it is to say no more than the reports before it

    def _come_to_rest(self) -> None:
        end_s = monotonic_s() + STOPPING_S
        while not self._runner.standing() and monotonic_s() < end_s:
            self._runner.tick()
        self._runner.settle()
        self._outbox.state = self._runner.state(self.overruns)
