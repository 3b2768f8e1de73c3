"""What governing costs per tick, and how fast a violation reaches the actuators.

Prints, as medians over repeats inside the real loop (simulated workcell, shipped policy, human-shared):

1. watcher and telemetry per tick, in µs (target ≤ 40);
2. the governed loop's throughput against the same loop with governance off (target ≥ 0.88): against the same skill on
   the same workcell with no runner at all, and against the same runner that neither watches nor clamps nor packs, which
   says what governance is of the loop (target ≤ 12 %); and as a multiple of real time (target ≥ 18). Processor time
   over blocks of ticks that take turns, and by the clock;
3. control ticks from a violation in the simulator's truth to the first changed actuator command (target ≤ 2), with
   noise-free sensors.

Run with `python -m benchmarks.bench_watch`.
"""

from __future__ import annotations

import statistics
import tempfile
import time
import weakref
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from app.cell import governing, telling
from app.governance.clamp import clamp
from app.governance.keepout import REACTION_S
from app.governance.model import Zone
from app.governance.permit import Grant
from app.sim.faults import Fault
from app.sim.occasions import Trigger
from app.sim.sensors import Quality
from tests.cell.workshop import Workshop

REPEATS = 5
TICKS, BLOCK = 1200, 20
DRIVE: dict[str, Any] = {"target": "dock", "speed_mps": 0.3, "clearance_m": 0.3}


def shop(*faults: Fault, noise: float = 1.0) -> Workshop:
    """Return a workshop; the folder of its journal goes with it."""
    folder = tempfile.TemporaryDirectory(prefix="bench-watch-")
    one = Workshop(Path(folder.name), faults=faults, quality=Quality(noise=noise))
    weakref.finalize(one, folder.cleanup)
    return one


def inside_the_loop() -> tuple[float, float, float, float]:
    """Return the median µs per tick of watching, packing telemetry and clamping while a session drives.

    Last comes the 90th percentile of watching and packing: position fixes come at 20 Hz, and a median forgets them.
    """
    spent: dict[str, list[float]] = {"watch": [], "row": [], "clamp": []}

    def timed(name: str, deed: Callable[..., Any]) -> Callable[..., Any]:
        def do(*args: Any) -> Any:
            began = time.perf_counter()
            done = deed(*args)
            spent[name].append(time.perf_counter() - began)
            return done

        return do

    kept = telling.row, governing.clamp
    telling.row, governing.clamp = timed("row", telling.row), timed("clamp", clamp)
    try:
        one = shop()
        one.launch("navigate_to", **DRIVE)
        session = one.runner.session
        assert session is not None
        session.run.watcher.watch = timed("watch", session.run.watcher.watch)  # type: ignore[misc]
        for _ in range(TICKS):
            one.runner.tick()
    finally:
        telling.row, governing.clamp = kept
    watch, row, clamping = (statistics.median(values) * 1e6 for values in spent.values())
    both = [sum(pair) * 1e6 for pair in zip(spent["watch"], spent["row"], strict=True)]
    return watch, row, clamping, statistics.quantiles(both, n=10)[-1]


def governed() -> Callable[[], object]:
    """Return one tick of a session that drives under watch."""
    one = shop()
    one.launch("navigate_to", **DRIVE)
    return one.runner.tick


def off() -> Callable[[], object]:
    """Return one tick of the same session by the same runner, where nobody watches, clamps or packs."""
    one = shop()
    one.launch("navigate_to", **DRIVE)
    session = one.runner.session
    assert session is not None
    run, quiet = session.run, (session.run.watching, ())
    run.watcher.watch = lambda *_args: quiet  # type: ignore[misc]
    run.series = Unpacked()  # type: ignore[assignment]
    kept = telling.row, governing.clamp

    def tick() -> None:
        telling.row, governing.clamp = _no_row, _unclamped
        one.runner.tick()
        telling.row, governing.clamp = kept

    return tick


def _no_row(*_args: Any) -> bytes:
    return b""


def _unclamped(command: Any, *_args: Any) -> tuple[Any, tuple[()]]:
    return command, ()


class Unpacked:
    """Takes no rows."""

    ready = b""

    def add(self, _row: bytes, *, alerted: bool) -> None:
        """Forget it."""


def ungoverned(spent_s: list[float]) -> Callable[[], object]:
    """Return one tick of the same skill on the same workcell: act, step, nothing else; note what the step takes.

    The permit is real, there is no other way.
    """
    one = shop()
    grants: list[Grant] = []
    bind = one.cell.bind

    def keep(grant: Grant, *args: Any, **kwargs: Any) -> Any:
        grants.append(grant)
        return bind(grant, *args, **kwargs)

    one.cell.bind = keep  # type: ignore[method-assign]
    one.launch("navigate_to", **DRIVE)
    permit = grants[0].authorization
    skill = bind(grants[0], permit.capability, permit.params)

    def tick() -> None:
        command = skill.act(one.cell.observe(), 1.0)
        began = time.perf_counter()
        one.cell.step(command)
        spent_s.append(time.perf_counter() - began)

    return tick


def taken_s(tick: Callable[[], object]) -> tuple[float, float]:
    """Return the seconds that a tick takes: of processor time (all threads), and by the clock."""
    worked, began = time.process_time(), time.perf_counter()
    for _ in range(BLOCK):
        tick()
    return (time.process_time() - worked) / BLOCK, (time.perf_counter() - began) / BLOCK


def side_by_side() -> tuple[float, float, float, float, float, float]:
    """Return processor seconds per tick governed and not, the ratio of the two, the workcell's step, the governed mean.

    The ratio is ungoverned to governed; last comes that of the same runner with governance off to governed. All take
    turns every few ticks of the same drive, so that whatever slows the machine slows all alike. The step and the mean
    are by the clock.
    """
    steps: list[float] = []
    loops = (governed(), ungoverned(steps), off())
    turns = [[taken_s(tick) for tick in loops] for _ in range(TICKS // BLOCK)]
    on, bare, _ = (statistics.median(worked for worked, _ in taken) for taken in zip(*turns, strict=True))
    share = statistics.median(without / with_ for (with_, _), (without, _), _ in turns)
    same = statistics.median(without / with_ for (with_, _), _, (without, _) in turns)
    by_clock = statistics.fmean(taken for (_, taken), _, _ in turns)
    return on, bare, share, statistics.median(steps), by_clock, same


def reaction_ticks(one: Workshop, capability: str, params: dict[str, Any], violated: Callable[[], bool]) -> int:
    """Return control ticks from the first step that ends in a true violation to the first restrained command.

    The rate at which the skill may run is what restrains, and it only falls when governance intervenes.

    Raises:
        RuntimeError: nothing was restrained, or what was restrained was no violation in truth.
    """
    one.launch(capability, 2, **params)
    since: int | None = None
    before = 0.0
    for tick in range(6000):
        one.runner.tick()
        session = one.runner.session
        rate = 0.0 if session is None else session.run.rate
        if since is None and violated():
            since = tick
        if rate < before:
            if since is None:
                raise RuntimeError(f"`{capability}` was restrained without a violation: {one.rules()}")
            return tick - since
        before = rate
    raise RuntimeError(f"`{capability}`: nothing happened in 6000 ticks")


def speed_ticks() -> int:
    one = shop(Fault(kind="speed_scaling", at=driving(1.0), sizes={"gain": 1.6}), noise=0.0)
    return reaction_ticks(one, "navigate_to", DRIVE, lambda: one.cell.truth().base_speed_mps > 0.3 * 1.05)


def force_ticks() -> int:
    """A crate that hangs in the gripper's way while the base drives towards it: more than 105 N, as the 20 ms mean."""
    away = Trigger(capability="navigate_to", phase="drive", run=2, after_s=0.3)
    crate = Fault(kind="blocked", at=away, sizes={"x_m": 1.6, "y_m": 4.7, "z_m": 0.7})
    one = shop(crate, noise=0.0)
    one.launch("navigate_to", x_m=1.6, y_m=3.4, yaw_rad=1.5708, speed_mps=0.3, clearance_m=0.1)
    one.finish()
    back = {"target": "bench_a_stand", "speed_mps": 0.3, "clearance_m": 0.1}
    return reaction_ticks(one, "navigate_to", back, lambda: one.cell.truth().contact_force_n > 105.0)


def zone_ticks() -> int:
    """A zone across the way that only the watcher knows: violated when braking would no longer end before it."""
    one = shop(noise=0.0)
    edge_y = 2.6
    wall = Zone(name="wall", kind="forbidden", polygon=((-1.0, 0.0), (9.0, 0.0), (9.0, edge_y), (-1.0, edge_y)))
    one.edit = lambda plan: replace(plan, zones=(wall,))

    def violated() -> bool:
        truth = one.cell.truth()
        speed = truth.base_speed_mps
        return truth.base[1] - edge_y - 0.45 - speed * REACTION_S - speed * speed / 2.0 < 0.0

    return reaction_ticks(one, "navigate_to", DRIVE, violated)


def driving(after_s: float) -> Trigger:
    return Trigger(capability="navigate_to", phase="drive", after_s=after_s)


def main() -> None:
    costs = [inside_the_loop() for _ in range(REPEATS)]
    watch, row, clamping, slow = (statistics.median(values) for values in zip(*costs, strict=True))
    print(f"watcher {watch:.1f} µs + telemetry {row:.1f} µs = {watch + row:.1f} µs per tick in the loop (target ≤ 40)")
    print(f"        {slow:.1f} µs at the 90th percentile")
    print(f"clamp   {clamping:.1f} µs per tick in the loop")
    with_, without, share, step, by_clock, same = (
        statistics.median(values) for values in zip(*(side_by_side() for _ in range(REPEATS)), strict=True)
    )
    print(f"loop    governed {with_ * 1e6:.0f} µs; with governance off (target ≥ 0.88):")
    print(f"        {share:.3f} against {without * 1e6:.0f} µs of skill and workcell alone, with no runner at all")
    print(f"        {same:.3f} against the same runner that neither watches nor clamps nor packs telemetry,")
    print(f"        of which governance is {1.0 - same:.1%} (target ≤ 12 %)")
    print(f"step    {step * 1e6:.0f} µs of it are the workcell's own")
    print(f"speed   {0.01 / with_:.1f} × real time in processor time (target ≥ 18)")
    print(f"        {0.01 / by_clock:.1f} × by the clock, with whatever else this machine was doing")
    for name, measured in (("force", force_ticks), ("speed", speed_ticks), ("zone", zone_ticks)):
        print(f"{name:7s} violation in truth → changed command: {measured()} ticks (target ≤ 2)")


if __name__ == "__main__":
    main()
