"""Pre- and postconditions by name: pure predicates over what a cell's sensors say.

Each returns None where the condition is met, else what is missing, in words an agent can act on. Without facts nothing
is met. Paper: preconditions and postconditions of a Capability Package.
"""

from __future__ import annotations

from math import cos, hypot, sin
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, cast

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from app.governance.model import ObjectFact, Params, Site, Surface, WorldFacts

# How close the base has to stand to a target to work from it: a little closer than skills ask for, because the estimate
# they go by may be another by then, and not as close as `at_target`, because a base that has arrived can work.
NEAR_M: Final = 0.25
NEAR_RAD: Final = 0.25
ARRIVED_M: Final = 0.15
ARRIVED_RAD: Final = 0.2
TURN: Final = 6.283185307179586


class Unmet(NamedTuple):
    """A condition that is not met: which, what is missing, and what would help."""

    condition: str
    message: str
    remedy: str


Test: TypeAlias = "Callable[[Params, WorldFacts, Site], tuple[str, str] | None]"


def _text(params: Params, name: str) -> str:
    value = params.get(name)
    return value if isinstance(value, str) else ""


def _sensors_fresh(_params: Params, facts: WorldFacts, _site: Site) -> tuple[str, str] | None:
    return None if facts.sensors_fresh else ("the cell's sensors are stale", "propose again when they are back")


def _arm_ready(_params: Params, facts: WorldFacts, _site: Site) -> tuple[str, str] | None:
    return None if facts.arm_ready else ("the arm is not ready", "propose again when it is")


def _arm_retracted(_params: Params, facts: WorldFacts, _site: Site) -> tuple[str, str] | None:
    return None if facts.arm_retracted else ("the arm is not retracted", "retract it first")


def _gripper_empty(_params: Params, facts: WorldFacts, _site: Site) -> tuple[str, str] | None:
    if facts.gripper_empty and facts.holding is None:
        return None
    held = facts.holding or "something"
    return f"the gripper holds `{held}`", "place it first, or use `transport_object` to drive with it"


def _carrying(_params: Params, facts: WorldFacts, site: Site) -> tuple[str, str] | None:
    if facts.gripper_empty or facts.holding is None:
        return "the gripper holds nothing that is known", "grasp an object first"
    if facts.holding not in site.objects:
        return f"`{facts.holding}` in the gripper is not an object of the site", "place it first"
    return None


def _object_visible(params: Params, facts: WorldFacts, _site: Site) -> tuple[str, str] | None:
    name = _text(params, "object_id")
    seen = facts.objects.get(name)
    if seen is not None and seen.visible:
        return None
    return f"`{name}` is not in sight", "inspect the area where it stands"


def _object_reachable(params: Params, facts: WorldFacts, _site: Site) -> tuple[str, str] | None:
    name = _text(params, "object_id")
    seen = facts.objects.get(name)
    if seen is not None and seen.reachable:
        return None
    return f"`{name}` is out of reach from here", "navigate to the target beside it"


def _stands_at(target: str, facts: WorldFacts, site: Site, what: str) -> tuple[str, str] | None:
    stand = site.targets.get(target)
    if stand is None:
        return f"the site does not know `{what}`", "propose a name of the site"
    x, y, yaw = facts.base
    if hypot(stand.x_m - x, stand.y_m - y) <= NEAR_M and _turned(stand.yaw_rad, yaw) <= NEAR_RAD:
        return None
    return f"`{what}` is out of reach from here", f"navigate to `{target}` first"


def _turned(one_rad: float, other_rad: float) -> float:
    """Return the angle between two headings, in 0…π."""
    return abs((other_rad - one_rad + TURN / 2) % TURN - TURN / 2)


def _surface_reachable(params: Params, facts: WorldFacts, site: Site) -> tuple[str, str] | None:
    name = _text(params, "surface")
    surface = site.surfaces.get(name)
    return _stands_at("" if surface is None else surface.target, facts, site, name)


def _tool_reachable(params: Params, facts: WorldFacts, site: Site) -> tuple[str, str] | None:
    name = _text(params, "tool")
    tool = site.tools.get(name)
    return _stands_at("" if tool is None else tool.target, facts, site, name)


def _area_in_view(params: Params, facts: WorldFacts, site: Site) -> tuple[str, str] | None:
    name = _text(params, "area")
    area = site.areas.get(name)
    return _stands_at("" if area is None else area.target, facts, site, name)


def _object_secured(params: Params, facts: WorldFacts, _site: Site) -> tuple[str, str] | None:
    name = _text(params, "object_id")
    if not facts.gripper_empty and facts.holding is not None and name in ("", facts.holding):
        return None
    return f"`{name or 'the object'}` is not in the gripper", "grasp it again"


def _object_placed(params: Params, facts: WorldFacts, site: Site) -> tuple[str, str] | None:
    name = _text(params, "surface")
    surface = site.surfaces.get(name)
    if surface is None or facts.holding is not None:
        return f"nothing was put down on `{name}`", "place it again"
    thing = _text(params, "object_id")
    seen = facts.objects.get(thing)
    if seen is None or not _on(surface, seen):
        return f"`{thing or 'the object'}` was not seen on `{name}`", "inspect the surface"
    if not seen.upright:  # it fell over, or was never put down
        return f"`{thing}` lies on its side", "grasp it and place it again"
    away = _beside(params, seen)
    return None if away <= PLACED_M else (f"`{thing}` stands {away:.2f} m from where it was to be", "place it again")


def _beside(params: Params, seen: ObjectFact) -> float:
    """Return how far an object was seen from the point that was asked for; 0 where none was."""
    x, y = params.get("x_m"), params.get("y_m")
    if isinstance(x, (int, float)) and isinstance(y, (int, float)):
        return hypot(x - seen.x_m, y - seen.y_m)
    return 0.0


def _on(surface: Surface, seen: ObjectFact) -> bool:
    """Say whether an object was seen on a surface, the surface's own axes being turned by its yaw."""
    dx, dy = seen.x_m - surface.x_m, seen.y_m - surface.y_m
    along = dx * cos(surface.yaw_rad) + dy * sin(surface.yaw_rad)
    across = dy * cos(surface.yaw_rad) - dx * sin(surface.yaw_rad)
    over = abs(along) <= surface.half_x_m and abs(across) <= surface.half_y_m
    return over and 0.0 <= seen.z_m - surface.z_m <= PLACED_HEIGHT_M


PLACED_HEIGHT_M: Final = 0.2
PLACED_M: Final = 0.1  # more than the 0.06 m that skills allow, since memory of what was seen lags a little


def _at_target(params: Params, facts: WorldFacts, site: Site) -> tuple[str, str] | None:
    goal = _goal(params, site)
    if goal is None:
        return "there is no target to be at", "propose a target of the site"
    x, y, yaw = goal
    away = hypot(x - facts.base[0], y - facts.base[1])
    turned = _turned(yaw, facts.base[2])
    if away <= ARRIVED_M and turned <= ARRIVED_RAD:
        return None
    return f"the base is {away:.2f} m and {turned:.2f} rad away from the target", "navigate there again"


def _goal(params: Params, site: Site) -> tuple[float, float, float] | None:
    target = site.targets.get(_text(params, "target"))
    if target is not None:
        return target.x_m, target.y_m, target.yaw_rad
    point = tuple(params.get(name) for name in ("x_m", "y_m", "yaw_rad"))
    return cast("tuple[float, float, float]", point) if all(isinstance(v, (int, float)) for v in point) else None


def _area_inspected(params: Params, facts: WorldFacts, _site: Site) -> tuple[str, str] | None:
    name = _text(params, "area")
    return None if name in facts.inspected else (f"`{name}` was not seen completely", "inspect it again")


def _tool_actuated(params: Params, facts: WorldFacts, site: Site) -> tuple[str, str] | None:
    name, action = _text(params, "tool"), _text(params, "action")
    tool = site.tools.get(name)
    wanted = None if tool is None else tool.actions.get(action)
    if wanted is not None and facts.tools.get(name) == wanted:
        return None
    return f"`{name}` is not `{wanted}`", f"repeat `{action}`"


TESTS: Final[Mapping[str, Test]] = {
    "sensors_fresh": _sensors_fresh,
    "arm_ready": _arm_ready,
    "arm_retracted": _arm_retracted,
    "gripper_empty": _gripper_empty,
    "carrying": _carrying,
    "object_visible": _object_visible,
    "object_reachable": _object_reachable,
    "surface_reachable": _surface_reachable,
    "tool_reachable": _tool_reachable,
    "area_in_view": _area_in_view,
    "object_secured": _object_secured,
    "object_placed": _object_placed,
    "at_target": _at_target,
    "area_inspected": _area_inspected,
    "tool_actuated": _tool_actuated,
}


def unmet(names: tuple[str, ...], params: Params, facts: WorldFacts | None, site: Site) -> tuple[Unmet, ...]:
    """Return every named condition that is not met, with what is missing.

    Args:
        names: Names of conditions; one that is not in `TESTS` is unmet.
        params: Effective parameters.
        facts: What the sensors say; None meets nothing.
        site: The site.
    """
    found: list[Unmet] = []
    for name in names:
        test = TESTS.get(name)
        if test is None:
            found.append(Unmet(name, f"there is no condition `{name}`", "name one that exists"))
        elif facts is None:
            found.append(Unmet(name, "the cell has not said anything about its world yet", "propose again later"))
        elif (missing := test(params, facts, site)) is not None:
            found.append(Unmet(name, *missing))
    return tuple(found)
