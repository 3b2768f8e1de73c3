"""The tick loop: deadlines, orders, the lease, and how it ends."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from queue import SimpleQueue

import pytest

from app.cell.loop import SIGHT_EVERY, Lease, Order, Outbox, Shutdown, TickLoop, Welcomed
from app.cell.moment import Sight
from app.clock import monotonic_s
from app.protocol import LEASE_MS, Ack, Estop, Jogged, Launch, State, Unrecorded, UpEvent
from tests.conftest import until

LONG_S = 3600.0


class Recorder:
    """A runner that writes down what it is told."""

    def __init__(self, period_s: float = 0.001, status: str | None = None, *, driven: bool = False) -> None:
        self.period_s = period_s
        self.status = status
        self.driven = driven
        self.ticks = 0
        self.orders: list[Order] = []
        self.holds: list[str] = []
        self.moving_for = 0
        self.fault: Exception | None = None
        self.cut = False
        self.settled_behind: tuple[int, bool] | None = None
        self.unrecorded: Unrecorded | None = None

    def tick(self) -> None:
        if self.fault is not None:
            raise self.fault
        self.ticks += 1
        self.moving_for = max(0, self.moving_for - 1)

    def obey(self, order: Order) -> None:
        self.orders.append(order)

    def hold(self, reason: str) -> None:
        self.holds.append(reason)

    def standing(self) -> bool:
        return self.moving_for == 0

    def when_written(self, then: Callable[[], None]) -> None:
        then()

    def settle(self) -> None:
        self.settled_behind = (self.ticks, self.cut)

    def break_off(self, error: Exception) -> None:
        assert error is self.fault
        self.cut = True

    def sight(self) -> Sight | None:
        return None if self.status is None else Sight("inv_1", self.ticks * self.period_s, (), lambda: b"")

    def state(self, overruns: int) -> State:
        return State(
            at_s=0.0,
            tick=self.ticks,
            invocation=None,
            status=self.status,
            latched=self.cut,
            holding=False,
            policy_digest=None,
            profile=None,
            facts={},
            gauges={"late_ticks": float(overruns)},
            jog=Jogged(n=-1, refused=None) if self.driven else None,
            fault=self.unrecorded,
        )


class Bench:
    """A loop with its parts."""

    def __init__(self, runner: Recorder, pace: float) -> None:
        self.runner = runner
        self.inbox: SimpleQueue[Order] = SimpleQueue()
        self.outbox = Outbox()
        self.lease = Lease()
        self.loop = TickLoop(runner, self.inbox, self.outbox, self.lease, pace=pace)


@pytest.fixture
def start() -> Iterator[Callable[..., Bench]]:
    benches: list[Bench] = []

    def make(runner: Recorder, pace: float = 1.0) -> Bench:
        bench = Bench(runner, pace)
        benches.append(bench)
        bench.loop.start()
        return bench

    yield make
    for bench in benches:
        bench.inbox.put(Shutdown())
        assert bench.loop.join(10.0)


def event(seq: int) -> UpEvent:
    return UpEvent(seq=seq, at_s=0.0, tick=0, kind="alert", invocation=None, actor="cell", body={})


def test_obeys_a_stop_at_once_however_far_the_next_tick_is(start: Callable[..., Bench]) -> None:
    bench = start(Recorder(period_s=LONG_S))
    until(lambda: bench.runner.ticks == 1)
    bench.inbox.put(Estop(actor="operator"))
    until(lambda: bench.runner.orders == [Estop(actor="operator")])
    assert bench.runner.ticks == 1


@pytest.mark.parametrize("pace", [0.0, 1.0])
def test_ticks_however_many_orders_come(start: Callable[..., Bench], pace: float) -> None:
    class Flooded(Recorder):
        def obey(self, order: Order) -> None:
            bench.inbox.put(order)  # there is always one more

    bench = start(Flooded(), pace)
    bench.inbox.put(Ack(seq=1))
    until(lambda: bench.runner.ticks > 3)


def test_holds_when_nothing_was_heard_for_the_lease(start: Callable[..., Bench]) -> None:
    bench = start(Recorder())
    bench.lease.welcomed()
    bench.inbox.put(Welcomed(profile="human-shared"))
    until(lambda: bench.runner.holds == ["link"], what="the hold")


def test_does_not_hold_while_the_server_is_heard(start: Callable[..., Bench]) -> None:
    bench = start(Recorder())
    bench.lease.welcomed()
    bench.inbox.put(Welcomed(profile="human-shared"))

    def heard_for_a_while() -> bool:
        bench.lease.heard()
        return bench.runner.ticks > 500

    until(heard_for_a_while)
    assert bench.runner.holds == []


def test_a_lease_starts_lapsed() -> None:
    assert Lease().lapsed()


def test_a_frame_that_comes_after_the_lapse_does_not_hide_it(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 100.0
    monkeypatch.setattr("app.cell.loop.monotonic_s", lambda: now_s)
    lease = Lease()
    lease.welcomed()
    now_s += LEASE_MS / 1000
    assert not lease.lapsed()
    now_s += 0.01
    assert lease.lapsed()
    lease.heard()
    assert lease.lapsed()
    lease.welcomed()
    assert not lease.lapsed()


def test_a_frame_that_ends_a_silence_does_not_hide_it_where_nobody_asked_meanwhile(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = 100.0
    monkeypatch.setattr("app.cell.loop.monotonic_s", lambda: now_s)
    lease = Lease()
    lease.welcomed()
    now_s += 3.0  # the whole process stood still
    lease.heard()
    assert lease.lapsed()


class Busy(Recorder):
    """A runner whose ticks take as long as somebody else wants."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[str] = []
        self.free = threading.Event()
        self.free.set()
        self.stands = threading.Event()

    def tick(self) -> None:
        super().tick()
        if not self.free.is_set():
            self.stands.set()
            assert self.free.wait(10.0)

    def obey(self, order: Order) -> None:
        super().obey(order)
        self.told.append(type(order).__name__)

    def hold(self, reason: str) -> None:
        super().hold(reason)
        self.told.append(reason)


@pytest.mark.parametrize("seen", [True, False], ids=["the link saw it", "nobody saw it"])
def test_a_lapse_is_held_for_although_a_welcome_came_before_the_loop_could_see_it(
    start: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch, seen: bool
) -> None:
    now_s = monotonic_s()
    monkeypatch.setattr("app.cell.loop.monotonic_s", lambda: now_s)
    runner = Busy()
    bench = start(runner)
    bench.lease.welcomed()
    bench.inbox.put(Welcomed(profile="human-shared"))
    until(lambda: runner.told == ["Welcomed"])
    runner.free.clear()
    assert runner.stands.wait(10.0)
    bench.inbox.put(Launch(body="", signature=""))  # the last word of the connection that falls silent now
    now_s += LEASE_MS / 1000 + 0.01
    if seen:
        assert bench.lease.lapsed()
    bench.lease.welcomed()
    bench.inbox.put(Welcomed(profile="human-shared"))
    runner.free.set()
    until(lambda: runner.told.count("Welcomed") == 2)
    assert runner.told == ["Welcomed", "link", "Launch", "Welcomed"]


def test_goes_on_ticking_until_everything_stands_when_shut_down(start: Callable[..., Bench]) -> None:
    runner = Recorder(period_s=LONG_S)
    runner.moving_for = 25
    bench = start(runner)
    until(lambda: runner.ticks == 1)
    bench.inbox.put(Shutdown())
    assert bench.loop.join(10.0)
    assert runner.holds == ["shutdown"]
    assert runner.moving_for == 0
    assert runner.settled_behind == (runner.ticks, False), "what was said last is written before the process ends"


def test_a_bug_in_the_runner_ends_the_loop_and_is_kept(start: Callable[..., Bench]) -> None:
    runner = Recorder()
    runner.fault = RuntimeError("broken")
    bench = start(runner)
    until(lambda: not bench.loop.alive())
    assert bench.loop.broken is runner.fault
    assert runner.settled_behind == (runner.ticks, True), "power is cut first, then what was said is written"
    assert bench.outbox.state is not None
    assert bench.outbox.state.latched, "whoever is linked still hears of it"


@pytest.mark.parametrize("status", ["running", "paused", "recovering"])
def test_pace_zero_does_not_wait_while_a_session_works(start: Callable[..., Bench], status: str) -> None:
    bench = start(Recorder(period_s=LONG_S, status=status), 0.0)
    until(lambda: bench.runner.ticks > 1000)


@pytest.mark.parametrize("pace", [0.0, 100.0])
@pytest.mark.parametrize(("status", "driven"), [(None, False), ("escalated", False), ("running", True)])
def test_a_pace_is_that_of_the_clock_while_nothing_moves_by_itself(
    start: Callable[..., Bench], status: str | None, driven: bool, pace: float
) -> None:
    bench = start(Recorder(period_s=LONG_S, status=status, driven=driven), pace)
    until(lambda: bench.runner.ticks == 1)
    bench.inbox.put(Estop(actor="operator"))
    until(lambda: bench.runner.orders)
    assert bench.runner.ticks == 1


def test_counts_the_ticks_that_came_late(start: Callable[..., Bench]) -> None:
    bench = start(Recorder(period_s=1e-9))
    until(lambda: bench.loop.overruns > 10)


def test_shows_a_change_without_waiting_for_the_next_period(
    start: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.cell.loop.STATE_MS", LONG_S * 1000)
    bench = start(Recorder(period_s=0.005))
    until(lambda: bench.runner.ticks > 3)
    shown = bench.outbox.state
    bench.outbox.event(event(1))
    until(lambda: bench.outbox.state is not shown)


@pytest.mark.parametrize("status", ["running", None])
def test_takes_hold_of_what_is_to_be_seen_of_a_session_now_and_then(
    start: Callable[..., Bench], status: str | None
) -> None:
    bench = start(Recorder(status=status))
    until(lambda: bench.runner.ticks > 10 * SIGHT_EVERY)
    ticks = [round(sight.time_s / bench.runner.period_s) for sight in tuple(bench.outbox.sights)][:10]
    assert ticks == ([] if status is None else [SIGHT_EVERY * count for count in range(1, 11)])


def test_events_stay_until_they_are_acknowledged() -> None:
    outbox = Outbox()
    for seq in (1, 2, 3):
        outbox.event(event(seq))
    assert [one.seq for one in outbox.after(1, 3)] == [2, 3]
    assert [one.seq for one in outbox.after(1, 2)] == [2]
    outbox.acknowledge(2)
    assert [one.seq for one in outbox.after(0, 3)] == [3]
    assert outbox.last_seq == 3
