"""Where physical trials begin: a few prepared worlds per process, restored bitwise for every trial.

Preparing takes seconds (a world is compiled, an object is grasped), a trial should not. Each start is made once per
process from a fixed seed, so that a trial depends on its own seed alone, wherever it runs; then the trial's seed gives
it noise, traits, masses, friction, and places of the objects.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import combinations
from math import hypot
from typing import TYPE_CHECKING, Final

import numpy as np

from app.sim.sensors import AS_MEASURED, Quality
from app.sim.trial import run_skill
from app.sim.workcell import Workcell, make_workcell

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.random import Generator

    from app.governance.model import Json, Site, SiteObject
    from app.sim.faults import Scenario

CELL: Final = "evaluation"
PREPARED_WITH: Final = 20261
PEOPLE: Final = 1
SETTLE_TICKS: Final = 30
FRICTION: Final = (0.7, 1.0)
MASS: Final = 0.1
SHIFT_M: Final = 0.05
TURN_RAD: Final = 0.2
APART_M: Final = 0.15


@dataclass(frozen=True, slots=True)
class Start:
    """Where a trial begins: at which stand, with which object in the gripper (or none)."""

    stand: str = "bench_a_stand"
    holding: str = ""


@dataclass(slots=True)
class Stage:
    """The prepared worlds of one process; `quality` is how good their sensors are."""

    site: Site
    quality: Quality = AS_MEASURED
    _ready: dict[Start, tuple[Workcell, object]] = field(default_factory=dict["Start", tuple[Workcell, object]])

    def set(self, start: Start, seed: int, scenario: Scenario) -> Workcell:
        """Return the workcell at a start, varied by the trial's seed, with its faults and people waiting.

        The workcell is the process's own for that start: a trial is over when the next one is set. Times of triggers
        are cell times and count from `Workcell.truth().time_s` at the return.

        Raises:
            ValueError: the start cannot be prepared.
        """
        if start not in self._ready:
            self._ready[start] = self._prepare(start)
        cell, state = self._ready[start]
        cell.restore(state)
        cell.begin(seed, scenario)
        _vary(cell, seed, start.holding)
        return cell

    def _prepare(self, start: Start) -> tuple[Workcell, object]:
        site = self.site
        taken = site.surfaces[site.objects[start.holding].surface].target if start.holding else start.stand
        site = replace(site, start=taken)
        cell = make_workcell(site, cell_id=CELL, seed=PREPARED_WITH, people=PEOPLE, quality=self.quality)
        for capability, params in _work(site, start):
            ran = run_skill(cell, capability, params)
            if not ran.done:
                raise ValueError(f"start `{start}` cannot be prepared: {ran.failure}: {ran.detail}")
        return cell, cell.snapshot()


def _work(site: Site, start: Start) -> list[tuple[str, dict[str, Json]]]:
    """Return what leads to a start: taking what is held where it lies, and carrying it to the stand."""
    if not start.holding:
        return []
    thing = site.objects[start.holding]
    force, speed = (20.0, 0.15) if thing.fragile else (40.0, 0.25)
    work: list[tuple[str, dict[str, Json]]] = [
        ("grasp_object", {"object_id": start.holding, "force_n": force, "speed_mps": speed})
    ]
    if site.surfaces[thing.surface].target != start.stand:
        work.append(("transport_object", {"target": start.stand, "speed_mps": speed}))
    return work


def _vary(cell: Workcell, seed: int, holding: str) -> None:
    """Shift, turn, weigh and oil the world of a seed, and let the robot look again (compare `app.sim.soak.vary`)."""
    rng = np.random.default_rng((seed, 7))
    loose = {name: thing for name, thing in cell.site.objects.items() if name != holding}
    for (name, thing), (x, y, turn, weight) in zip(loose.items(), places(rng, loose), strict=True):
        z = cell.site.surfaces[thing.surface].z_m + thing.size_m[2] + 0.0005
        cell.plant.place_object(name, x, y, z, TURN_RAD * turn)
        cell.plant.scale_mass(name, 1.0 + MASS * weight)
    cell.plant.set_pad_friction(float(rng.uniform(*FRICTION)))
    for _ in range(SETTLE_TICKS):
        cell.step(cell.hold())


def places(rng: Generator, loose: Mapping[str, SiteObject]) -> list[tuple[float, float, float, float]]:
    """Draw where objects stand (x, y in metres), how far they are turned and how heavy they are (-1 to 1).

    All of them again where two stand so close that the fingers would not go between: no task asks for that.
    """
    while True:
        drawn = [
            (thing.x_m + SHIFT_M * dx, thing.y_m + SHIFT_M * dy, turn, weight)
            for thing, (dx, dy, turn, weight) in zip(
                loose.values(), rng.uniform(-1, 1, (len(loose), 4)).tolist(), strict=True
            )
        ]
        if all(hypot(a[0] - b[0], a[1] - b[1]) >= APART_M for a, b in combinations(drawn, 2)):
            return drawn
