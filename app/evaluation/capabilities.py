"""Whether the world is as a capability promises, by the simulator's exact state and not by anybody's word."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import dist, hypot, remainder, tau
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from app.evaluation.draws import Drawn
    from app.governance.model import Params
    from app.sim.truth import Truth
    from app.sim.workcell import Workcell

ARRIVED_M: Final = 0.15
STANDS_M: Final = 0.03
BACK_M: Final = 0.05
STOOD_M: Final = 0.10
STOOD_RAD: Final = 0.10
"""How near to where they stood object and base count as back. A session verifies this by sensors, to 10 cm, and to
15 cm and 0.15 rad; the truth, which has no error of its own, is held to less."""
TOOL_BACK: Final[Mapping[str, float]] = {"lever": 0.08, "button": 0.003}  # rad, m
"""A quarter of the way at which a tool's switch turns: play, which operates nothing."""

Judge = Callable[["Workcell"], bool]


def judge_of(trial: Drawn) -> Judge:
    """Return the judge of a trial: true where its task is done.

    Arrival is within 15 cm of the goal, an object stands where it should when its middle is over the surface at its own
    half height (3 cm), a tool is in the state its action ends in, an inspection counts when all of the area was seen.
    """
    made = _JUDGES[trial.capability]
    return lambda cell: made(trial, cell)


def restored_of(trial: Drawn, began: Truth) -> Judge:
    """Return the judge of a rollback: true where the world is again as it was when the trial began.

    The base stands within 10 cm and 0.1 rad, the gripper holds what it held, an object that was to be grasped stands
    upright within 5 cm of where it stood, and a tool that was to be operated says what it said, and stands so.
    """

    def restored(cell: Workcell) -> bool:
        now = cell.truth()
        return (
            _stood(began, now)
            and now.held == began.held
            and _stands(trial, began, now)
            and _unmoved(trial, cell, began, now)
        )

    return restored


def undoable_of(trial: Drawn, began: Truth) -> Judge:
    """Return the judge of whether a rollback has anything to go back to, asked when it begins.

    By the exact state alone. Going back picks nothing up and operates nothing: what was held when the trial began still
    has to be in the gripper, with friction enough to bear it; an object that was to be grasped has to be in the gripper
    or still stand where it stood (not tipped over, fallen, or moved by somebody); a tool has to be as it was. What is
    held is not judged by where it is.
    """

    def undoable(cell: Workcell) -> bool:
        now = cell.truth()
        if began.held is not None:
            return now.held == began.held and now.secure
        taken = now.held is not None and now.held == trial.params.get("object_id")
        return (taken or _stands(trial, began, now)) and _unmoved(trial, cell, began, now)

    return undoable


def truly_unmet(name: str, params: Params, began: Truth, now: Truth) -> bool:
    """Say whether what a cell found unmet after a recovery or a rollback truly is; what only sensors tell of is not."""
    match name:
        case "holding":
            return now.held != began.held
        case "object_secured":
            return now.held is None
        case "gripper_empty":
            return now.held is not None
        case "base_pose":
            return not _stood(began, now)
        case "object_pose":
            handled = str(params.get("object_id"))
            return not now.upright[handled] or dist(now.objects[handled], began.objects[handled]) >= BACK_M
        case _:
            return False


def _stood(began: Truth, now: Truth) -> bool:
    """Say whether the base stands where it stood."""
    away = hypot(now.base[0] - began.base[0], now.base[1] - began.base[1])
    return away <= STOOD_M and abs(remainder(now.base[2] - began.base[2], tau)) <= STOOD_RAD


def _stands(trial: Drawn, began: Truth, now: Truth) -> bool:
    """Say whether the object that was to be grasped, if any, stands upright where it stood."""
    name = str(trial.params.get("object_id", ""))
    if name not in began.objects:
        return True
    return now.upright[name] and dist(now.objects[name], began.objects[name]) < BACK_M


def _unmoved(trial: Drawn, cell: Workcell, began: Truth, now: Truth) -> bool:
    """Say whether the tool that was to be operated, if any, is as it was."""
    tool = cell.site.tools.get(str(trial.params.get("tool", "")))
    if tool is None:
        return True
    moved = abs(now.tools[tool.name] - began.tools[tool.name])
    return now.switches[tool.name] == began.switches[tool.name] and moved <= TOOL_BACK[tool.kind]


def _arrived(trial: Drawn, cell: Workcell) -> bool:
    target = cell.site.targets.get(str(trial.params.get("target")))
    goal = (target.x_m, target.y_m) if target else (trial.params["x_m"], trial.params["y_m"])
    x, y, _ = cell.truth().base
    return hypot(x - float(goal[0]), y - float(goal[1])) < ARRIVED_M  # type: ignore[arg-type]  # numbers, as drawn


def _carried(trial: Drawn, cell: Workcell) -> bool:
    return _arrived(trial, cell) and cell.truth().held == trial.start.holding


def _grasped(trial: Drawn, cell: Workcell) -> bool:
    return cell.truth().held == trial.params["object_id"]


def _placed(trial: Drawn, cell: Workcell) -> bool:
    name, surface = trial.start.holding, cell.site.surfaces[str(trial.params["surface"])]
    truth: Truth = cell.truth()
    x, y, z = truth.objects[name]
    over = abs(x - surface.x_m) < surface.half_x_m and abs(y - surface.y_m) < surface.half_y_m
    stands = truth.upright[name] and abs(z - surface.z_m - cell.site.objects[name].size_m[2]) < STANDS_M
    return truth.held != name and over and stands


def _operated(trial: Drawn, cell: Workcell) -> bool:
    tool = cell.site.tools[str(trial.params["tool"])]
    return cell.tool_state(tool.name) == tool.actions[str(trial.params["action"])]


def _inspected(trial: Drawn, cell: Workcell) -> bool:
    return str(trial.params["area"]) in cell.facts().inspected


_JUDGES: Final[Mapping[str, Callable[[Drawn, Workcell], bool]]] = {
    "navigate_to": _arrived,
    "inspect_area": _inspected,
    "grasp_object": _grasped,
    "place_object": _placed,
    "transport_object": _carried,
    "operate_tool": _operated,
}
