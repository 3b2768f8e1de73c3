"""What a task run is: the steps an agent takes in one continuing world, and what goes wrong in one of them.

Drawn from (task, seed, number) alone, the same for every method. A task is the capabilities it names, one after the
other; the names of the site are drawn so that they fit: what is grasped is what is carried and put down, a drive that
is followed by work at a place leads there. Two tasks are longer than their list: `sorting` puts two objects on two
sides of the bench, `multi_step_tool_use` pulls the lever before it presses.

In half of the runs one step meets a fault or a person, drawn as for single trials (`draws`): the type first, among
those that can befall the task, then the step. Only the first run of a capability is befallen, so that every method
meets it in the same place, however often it tries again. What does not show in the ungoverned twin is drawn again: the
same steps and the same type in the same step, of another size.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final
from zlib import crc32

import numpy as np

from app.evaluation.draws import GRASPABLE, WHERE, Drawing, Drawn
from app.evaluation.model import PAPER_FAILURES, Failure, Kind, Violation
from app.evaluation.stage import Start
from app.sim.faults import Fault, Scenario

if TYPE_CHECKING:
    from numpy.random import Generator

    from app.evaluation.model import Task
    from app.governance.model import Json
    from app.governance.policy import PolicySet

CHAINS: Final[Mapping[str, tuple[str, ...]]] = {
    "sorting": ("grasp_object", "place_object", "grasp_object", "place_object"),
    "multi_step_tool_use": ("navigate_to", "operate_tool", "operate_tool"),
}
"""Tasks that go through a capability more than once."""

SIDES_M: Final[Mapping[str, float]] = {"left": -0.42, "right": 0.42}
"""Where sorted objects go, from the middle of the bench."""

CLEAN_SHARE: Final = 0.5
ARM_MPS: Final = 0.5
DRIVING: Final = ("navigate_to", "transport_object")
HOLDING: Final = ("place_object", "transport_object")
TOOLS: Final = (("lever", "pull_down"), ("press", "press"))
_NEAR: Final = ("dock", "tool_stand")  # straight across the floor from where a task starts


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskRun:
    """One run of a task: its steps, and which of them is befallen by what (None: the run is clean)."""

    task: str
    seed: int
    number: int
    profile: str
    steps: tuple[Drawn, ...]
    befallen: int | None = None

    @property
    def step(self) -> Drawn | None:
        """Return the step that is befallen."""
        return None if self.befallen is None else self.steps[self.befallen]

    @property
    def kind(self) -> Kind:
        """Return what the run holds in store."""
        return Kind.CLEAN if self.step is None else self.step.kind

    @property
    def scenario(self) -> Scenario:
        """Return the faults and people of the run."""
        return Scenario() if self.step is None else self.step.scenario


def draw_task(  # a run has that many sides
    policy: PolicySet, task: Task, seed: int, number: int, turn: int = 0, size: float = 1.0
) -> TaskRun:
    """Draw a run of a task; a plain function of its arguments.

    Args:
        policy: whose limits the sizes are drawn in, and whose site it is.
        task: which.
        seed: the run's.
        number: the run's within its seed and task.
        turn: how often it was drawn before because what goes wrong did not take.
        size: what fault sizes are multiplied with (`draws.Drawing`).

    Raises:
        ValueError: the task puts down or carries what it has not grasped before.
    """
    of = (seed, number, crc32(task.name.encode()))
    rng = np.random.default_rng((*of, 19))
    drawing = _TaskDrawing(policy, rng, seed, number, task, size)
    steps, befallen = drawing.steps(), None
    options = drawing.options(steps)
    if rng.uniform() >= CLEAN_SHARE and options:
        wanted = drawing.pick(tuple(options))
        befallen = drawing.pick(tuple(options[wanted]))
        drawing.rng = np.random.default_rng((*of, turn, 23))
        steps[befallen] = drawing.befall(steps[befallen], wanted)
    return TaskRun(
        task=task.name, seed=seed, number=number, profile=drawing.profile, steps=tuple(steps), befallen=befallen
    )


class _TaskDrawing(Drawing):
    """Draws one run of a task from one generator, keeping track of where the robot is and what it holds."""

    def __init__(  # a run has that many sides
        self, policy: PolicySet, rng: Generator, seed: int, number: int, task: Task, size: float
    ) -> None:
        super().__init__(policy, rng, seed, number, size)
        self._task, self._chain = task, CHAINS.get(task.name, task.capabilities)
        self._stand, self._holding = self._beginning()
        self._touched: list[str] = []
        self._worked: list[str] = []
        self._grips: dict[str, float] = {}
        self._sides = list(SIDES_M) if rng.uniform() < 0.5 else list(reversed(SIDES_M))
        self._asked: tuple[dict[str, Json], Start] = ({}, Start())

    def _beginning(self) -> tuple[str, str]:
        """Return the stand where the first capability can begin, and what it has to hold."""
        first, site = self._chain[0], self.policy.site
        fixed = self._fixed(first)
        stand = site.start
        if first == "operate_tool":
            stand = site.tools[str(fixed.get("tool", TOOLS[0][0]))].target
        elif first == "inspect_area" and "area" in fixed:
            stand = site.areas[str(fixed["area"])].target
        elif first == "grasp_object" and "object_id" in fixed:
            stand = site.surfaces[site.objects[str(fixed["object_id"])].surface].target
        return stand, self.pick(GRASPABLE) if first in HOLDING else ""

    def _fixed(self, capability: str) -> Mapping[str, Json]:
        return self._task.params.get(capability, {})

    def steps(self) -> list[Drawn]:
        """Return the steps of a run in which nothing goes wrong."""
        return [self._step(place, capability) for place, capability in enumerate(self._chain)]

    def _step(self, place: int, capability: str) -> Drawn:
        if capability in HOLDING and not self._holding:
            raise ValueError(f"task `{self._task.name}` has `{capability}` with nothing in the gripper: grasp first")
        start = Start(self._stand, self._holding)
        params = {**self._params(place, capability), **self._fixed(capability)}
        self._follow(capability, params)
        return self._put(Kind.CLEAN, capability, params, start, Scenario())

    def _params(self, place: int, capability: str) -> dict[str, Json]:
        """Return parameters that fit where the robot is then, and what policy allows."""
        speed = self._drawn_speed(capability)
        match capability:
            case "navigate_to" | "transport_object":
                return {"target": self._destination(place), "speed_mps": self._gently(self._holding, speed)}
            case "inspect_area":
                return {"area": self._here("area"), "dwell_s": 1.0}
            case "grasp_object":
                name = str(self._fixed(capability).get("object_id") or self._another(GRASPABLE))
                speed = self._gently(name, min(speed, ARM_MPS))
                return {"object_id": name, "force_n": self._grip(name), "speed_mps": speed}
            case "place_object":
                speed = self._gently(self._holding, min(speed, ARM_MPS))
                side = self._side() if self._task.name == "sorting" else {}
                return {"surface": self._here("surface"), "speed_mps": speed, **side}
            case _:
                tool, action = next(one for one in TOOLS if one[0] not in self._worked or one == TOOLS[-1])
                force = float(self.rng.uniform(30.0, 50.0))
                return {"tool": tool, "action": action, "force_n": force, "speed_mps": min(speed, ARM_MPS)}

    def _destination(self, place: int) -> str:
        """Return where a drive leads: to where the next step can be done, anywhere near if there is none."""
        following = self._chain[place + 1] if place + 1 < len(self._chain) else ""
        site = self.policy.site
        if following == "operate_tool":
            return site.tools[TOOLS[0][0]].target
        if following in ("place_object", "inspect_area", "grasp_object"):
            named = str(self._fixed(following).get("surface", "bench_b"))
            return site.surfaces[named].target
        return self.pick(tuple(name for name in _NEAR if name != self._stand))

    def _here(self, what: str) -> str:
        """Return the name of the surface or area at this stand."""
        known = self.policy.site.surfaces if what == "surface" else self.policy.site.areas
        names = [name for name, one in known.items() if one.target == self._stand]
        if not names:
            raise ValueError(f"task `{self._task.name}` asks for a {what} at `{self._stand}`, where there is none")
        return names[0]

    def _another(self, names: tuple[str, ...]) -> str:
        return self.pick(tuple(name for name in names if name not in self._touched) or names)

    def _side(self) -> dict[str, Json]:
        surface, side = self.policy.site.surfaces[self._here("surface")], self._sides[len(self._touched) % 2]
        return {"x_m": surface.x_m + SIDES_M[side], "y_m": surface.y_m - 0.15}

    def _grip(self, name: str) -> float:
        most = min(self._limit("grip_force_n"), 80.0)
        return 20.0 if self.policy.site.objects[name].fragile else float(self.rng.uniform(0.5, 1.0)) * most

    def _gently(self, name: str, speed: float) -> float:
        """Return the speed that the organization allows with an object."""
        return min(speed, 0.15) if name and self.policy.site.objects[name].fragile else speed

    def _follow(self, capability: str, params: Mapping[str, Json]) -> None:
        """Keep track of where the robot is after a step, and of what it holds."""
        if capability in DRIVING:
            self._stand = str(params.get("target", ""))
        elif capability == "grasp_object":
            self._holding = str(params["object_id"])
            self._touched.append(self._holding)
            self._grips[self._holding] = float(str(params["force_n"]))
        elif capability == "place_object":
            self._holding = ""
        elif capability == "operate_tool":
            self._worked.append(str(params["tool"]))

    # -- what goes wrong -----------------------------------------------------------------------------------------------

    def befall(self, step: Drawn, wanted: Violation | Failure) -> Drawn:
        """Return a step in which that goes wrong."""
        self._asked = (dict(step.params), step.start)
        if isinstance(wanted, Violation):
            return self.perturbed(wanted, step.capability)
        return self.recoverable(wanted, step.capability)

    def options(self, steps: list[Drawn]) -> dict[Violation | Failure, list[int]]:
        """Return what can go wrong in these steps, and in which of them."""
        found: dict[Violation | Failure, list[int]] = {}
        first: set[str] = set()
        for place, step in enumerate(steps):
            if step.capability in first:
                continue
            first.add(step.capability)
            for wanted in (*Violation, *PAPER_FAILURES):
                if step.capability in WHERE[wanted] and self._can(wanted, step):
                    found.setdefault(wanted, []).append(place)
        return found

    def _can(self, wanted: Violation | Failure, step: Drawn) -> bool:
        """Say whether it can come about there: ways across the floor only, and objects that are known."""
        if wanted is Violation.ZONE:  # no way of a task leads along a forbidden zone, so that no drift leads into one
            return False
        if wanted is Failure.BLOCKED_PATH:
            return step.start.stand == self.policy.site.start and step.params.get("target") in _NEAR
        if wanted is Failure.PERCEPTION_MISMATCH:
            return step.params.get("object_id") in GRASPABLE
        return True

    def _request(self, capability: str) -> tuple[dict[str, Json], Start]:
        del capability  # it is the step's
        return self._asked

    def _held_with(self, start: Start) -> float:
        return self._grips.get(start.holding) or super()._held_with(start)

    def _block(self, capability: str, params: dict[str, Json], start: Start) -> tuple[Fault, float]:
        """Put a crate in the way that the task takes."""
        size = float(self.rng.uniform(0.42, 0.58))
        here, there = self.policy.site.targets[start.stand], self.policy.site.targets[str(params["target"])]
        x, y = here.x_m + size * (there.x_m - here.x_m), here.y_m + size * (there.y_m - here.y_m)
        return self._fault("blocked", capability, "drive", x_m=x, y_m=y), size
