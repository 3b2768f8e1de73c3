"""Where physical trials begin: a few prepared worlds per process, restored bitwise for every trial.

Preparing takes seconds (a world is compiled, an object is grasped), a trial should not. Each start is made once per
process from a fixed seed, so that a trial depends on its own seed alone, wherever it runs; then the trial's seed gives
it noise, traits, masses, friction, and places of the objects.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from app.sim.sensors import AS_MEASURED, Quality
from app.sim.trial import run_skill
from app.sim.workcell import Workcell, make_workcell

if TYPE_CHECKING:
    from app.governance.model import Site
    from app.sim.faults import Scenario

CELL: Final = "evaluation"
PREPARED_WITH: Final = 20261
PEOPLE: Final = 1
SETTLE_TICKS: Final = 30
FRICTION: Final = (0.7, 1.0)
MASS: Final = 0.1
SHIFT_M: Final = 0.05
TURN_RAD: Final = 0.2


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
        site = replace(self.site, start=start.stand)
        cell = make_workcell(site, cell_id=CELL, seed=PREPARED_WITH, people=PEOPLE, quality=self.quality)
        if start.holding:
            fragile = site.objects[start.holding].fragile
            params = {
                "object_id": start.holding,
                "force_n": 20.0 if fragile else 40.0,
                "speed_mps": 0.15 if fragile else 0.25,
            }
            ran = run_skill(cell, "grasp_object", params)
            if not ran.done:
                raise ValueError(f"start `{start}` cannot be prepared: {ran.failure}: {ran.detail}")
        return cell, cell.snapshot()


def _vary(cell: Workcell, seed: int, holding: str) -> None:
    """Shift, turn, weigh and oil the world of a seed, and let the robot look again (compare `app.sim.soak.vary`)."""
    rng = np.random.default_rng((seed, 7))
    for name, thing in cell.site.objects.items():
        dx, dy, turn, weight = rng.uniform(-1, 1, 4)
        if name == holding:
            continue
        z = cell.site.surfaces[thing.surface].z_m + thing.size_m[2] + 0.0005
        x, y = thing.x_m + SHIFT_M * dx, thing.y_m + SHIFT_M * dy
        cell.plant.place_object(name, x, y, z, TURN_RAD * turn)
        cell.plant.scale_mass(name, 1.0 + MASS * weight)
    cell.plant.set_pad_friction(float(rng.uniform(*FRICTION)))
    for _ in range(SETTLE_TICKS):
        cell.step(cell.hold())
