"""What governing costs per tick, and how fast a violation reaches the actuators.

Prints, as medians over repeats inside the real loop (simulated workcell, shipped policy, human-shared):

1. watcher and telemetry per tick, in µs (target ≤ 40);
2. the governed loop's throughput against the same skill on the same workcell with governance off (target ≥ 0.88), and
   as a multiple of real time (target ≥ 18);
3. control ticks from a violation in the simulator's truth to the first changed actuator command (target ≤ 2).

Run with `python -m benchmarks.bench_watch`.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from app.cell import telling
from app.governance.clamp import clamp
from app.governance.model import Command, Observation
from app.governance.permit import Grant
from app.governance.watcher import Watcher
from app.sim.faults import Fault
from app.sim.occasions import Trigger
from tests.cell.workshop import Workshop

REPEATS = 5
TICKS = 1200
DRIVE: dict[str, Any] = {"target": "dock", "speed_mps": 0.3, "clearance_m": 0.3}


def shop(*faults: Fault, profile: str = "human-shared") -> Workshop:
    return Workshop(Path(tempfile.mkdtemp(prefix="bench-watch-")), faults=faults, profile=profile)


def inside_the_loop() -> tuple[float, float, float]:
    """Return the median µs per tick that watching, packing telemetry and clamping take while a session drives."""
    spent: dict[str, list[float]] = {"watch": [], "row": [], "clamp": []}

    def timed(name: str, deed: Callable[..., Any]) -> Callable[..., Any]:
        def do(*args: Any) -> Any:
            began = time.perf_counter()
            done = deed(*args)
            spent[name].append(time.perf_counter() - began)
            return done

        return do

    from app.cell import governing

    kept = Watcher.watch, telling.row, governing.clamp
    Watcher.watch, telling.row, governing.clamp = (  # type: ignore[method-assign]
        timed("watch", Watcher.watch),
        timed("row", telling.row),
        timed("clamp", clamp),
    )
    try:
        one = shop()
        one.launch("navigate_to", **DRIVE)
        for _ in range(TICKS):
            one.runner.tick()
    finally:
        Watcher.watch, telling.row, governing.clamp = kept  # type: ignore[method-assign]
    watch, row, clamping = (statistics.median(values) * 1e6 for values in spent.values())
    return watch, row, clamping


def governed_s() -> float:
    one = shop()
    one.launch("navigate_to", **DRIVE)
    began = time.perf_counter()
    for _ in range(TICKS):
        one.runner.tick()
    return (time.perf_counter() - began) / TICKS


def ungoverned_s() -> float:
    """The same skill on the same workcell: act, step, nothing else. The permit is real, there is no other way."""
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
    seen = one.cell.observe()
    began = time.perf_counter()
    for _ in range(TICKS):
        seen = one.cell.step(skill.act(seen, 1.0))
    return (time.perf_counter() - began) / TICKS


def reaction_ticks(
    capability: str, params: dict[str, Any], faults: tuple[Fault, ...], violated: Callable[[Workshop], bool]
) -> int:
    """Return control ticks from the first step that ends in a true violation to the first restrained command."""
    one = shop(*faults)
    one.launch(capability, **params)
    sent: list[Command] = []
    step = one.cell.step

    def watched(command: Command) -> Observation:
        sent.append(command)
        return step(command)

    one.cell.step = watched  # type: ignore[method-assign]
    since: int | None = None
    for tick in range(6000):
        rate = one.runner._session.run.rate if one.runner._session else 0.0  # what the loop does next
        one.runner.tick()
        session = one.runner._session
        now = session.run.rate if session else 0.0
        if since is not None and now < rate:
            return tick - since
        if since is None and violated(one):
            since = tick
    raise RuntimeError(f"`{capability}`: nothing happened in 6000 ticks")


def driving(after_s: float) -> Trigger:
    return Trigger(capability="navigate_to", phase="drive", after_s=after_s)


def main() -> None:
    costs = [inside_the_loop() for _ in range(REPEATS)]
    watch, row, clamping = (statistics.median(values) for values in zip(*costs, strict=True))
    print(f"watcher {watch:.1f} µs + telemetry {row:.1f} µs = {watch + row:.1f} µs per tick in the loop (target ≤ 40)")
    print(f"clamp   {clamping:.1f} µs per tick in the loop")
    pairs = [(governed_s(), ungoverned_s()) for _ in range(REPEATS)]
    with_, without = (statistics.median(values) for values in zip(*pairs, strict=True))
    share = statistics.median(off / on for on, off in pairs)
    print(
        f"loop    governed {with_ * 1e6:.0f} µs, ungoverned {without * 1e6:.0f} µs per tick: {share:.3f} (target ≥ 0.88)"
    )
    print(f"speed   {0.01 / with_:.1f} × real time (target ≥ 18)")
    fast = Fault(kind="speed_scaling", at=driving(1.0), sizes={"gain": 1.6})
    limit = 0.3 * 1.05
    ticks = reaction_ticks("navigate_to", DRIVE, (fast,), lambda one: one.cell.truth().base_speed_mps > limit)
    print(f"speed   violation in truth → changed command: {ticks} ticks (target ≤ 2)")


if __name__ == "__main__":
    main()
