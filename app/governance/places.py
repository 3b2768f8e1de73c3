"""Where a proposal leads and what it handles, from names and perception: the `place` and `target` of conditions.

Pure geometry over the site. Points are world frame, metres. Every boundary belongs to what it bounds: a point on the
edge of a forbidden zone is forbidden, one on the edge of the site or of a surface is still inside it, or on it.
"""

from __future__ import annotations

from dataclasses import replace
from math import cos, hypot, inf, sin, sqrt
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar, cast

from app.governance.model import Area, SiteObject, Surface, Tool

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from app.governance.model import Params, Point, Site, WorldFacts

Locate: TypeAlias = "Callable[[Params, WorldFacts | None], Place]"
Find: TypeAlias = "Callable[[Params, WorldFacts | None], SiteObject]"


_Led = TypeVar("_Led", Surface, Area, Tool)


class Place(NamedTuple):
    """Where a proposal leads: `kind` is target, surface, area, tool, object, point or none."""

    name: str
    kind: str
    forbidden: bool = False
    outside: bool = False
    corridor: str | None = None


STAND_M: Final = 0.45  # the base's radius
EDGE_M: Final = 1e-9  # what rounding may shift a point on a slanted edge by
NOWHERE: Final = Place("", "none")
NOTHING: Final = SiteObject(
    name="", kind="none", shape="box", size_m=(0.0, 0.0, 0.0), mass_kg=0.0, fragile=False, hazardous=False, surface="",
    x_m=0.0, y_m=0.0,
)  # fmt: skip


def inside(point: Point, polygon: Sequence[Point]) -> bool:
    """Say whether a point lies in a polygon (even-odd rule) or on its boundary, to within a nanometre."""
    x, y = point
    odd = False
    x1, y1 = polygon[-1]
    for x2, y2 in polygon:
        if _on_edge(x, y, x1, y1, x2, y2):
            return True
        if (y1 > y) != (y2 > y) and x < (x2 - x1) * (y - y1) / (y2 - y1) + x1:
            odd = not odd
        x1, y1 = x2, y2
    return odd


def _on_edge(x: float, y: float, x1: float, y1: float, x2: float, y2: float) -> bool:
    """Say whether a point lies on the edge between two corners, as far as rounding lets one tell."""
    dx, dy = x2 - x1, y2 - y1
    along = (x - x1) * dx + (y - y1) * dy
    length = dx * dx + dy * dy
    return 0.0 <= along <= length and abs((x - x1) * dy - (y - y1) * dx) <= EDGE_M * sqrt(length)


def on_surface(point: Point, surface: Surface) -> bool:
    """Say whether a point (world frame) lies over a surface, its edge included."""
    dx, dy = point[0] - surface.x_m, point[1] - surface.y_m
    c, s = cos(surface.yaw_rad), sin(surface.yaw_rad)
    return abs(c * dx + s * dy) <= surface.half_x_m and abs(c * dy - s * dx) <= surface.half_y_m


def centre(polygon: Sequence[Point]) -> Point:
    """Return the mean of a polygon's corners."""
    return sum(x for x, _ in polygon) / len(polygon), sum(y for _, y in polygon) / len(polygon)


class Stand(NamedTuple):
    """The box of points (world frame, m) that count as a target, and the corridor that leads there."""

    x0: float
    y0: float
    x1: float
    y1: float
    corridor: str


class _Keepout(NamedTuple):
    """A forbidden polygon behind its bounding box."""

    x0: float
    y0: float
    x1: float
    y1: float
    polygon: tuple[Point, ...]


class _Map(NamedTuple):
    """The site as places: whatever has a name, resolved once."""

    site: Site
    keepouts: tuple[_Keepout, ...]

    def forbids(self, x: float, y: float) -> bool:
        for x0, y0, x1, y1, polygon in self.keepouts:
            if x0 <= x <= x1 and y0 <= y <= y1 and inside((x, y), polygon):
                return True
        return False

    def point(self, name: str, kind: str, point: Point, corridor: str | None = None) -> Place:
        x, y = point
        x0, y0, x1, y1 = self.site.bounds_m
        return Place(name, kind, self.forbids(x, y), not (x0 <= x <= x1 and y0 <= y <= y1), corridor)


def _keepout(polygon: tuple[Point, ...]) -> _Keepout:
    xs, ys = [x for x, _ in polygon], [y for _, y in polygon]
    return _Keepout(min(xs), min(ys), max(xs), max(ys), polygon)


def stands(site: Site) -> tuple[Stand, ...]:
    """Return where the base stands as good as at a target that a corridor leads to, in the site's order.

    A point there is that target by another notation, and the corridor leads to it as well: within `STAND_M` of it along
    either axis, the base covers the target.
    """
    return tuple(
        Stand(at.x_m - STAND_M, at.y_m - STAND_M, at.x_m + STAND_M, at.y_m + STAND_M, at.corridor)
        for at in site.targets.values()
        if at.corridor is not None
    )


def names(site: Site) -> Mapping[str, frozenset[str]]:
    """Return every name a parameter may refer to, by kind; an action is one that some tool has."""
    return {
        "object": frozenset(site.objects),
        "target": frozenset(site.targets),
        "surface": frozenset(site.surfaces),
        "area": frozenset(site.areas),
        "corridor": frozenset(site.corridors),
        "tool": frozenset(site.tools),
        "action": frozenset(action for tool in site.tools.values() for action in tool.actions),
    }


def places(site: Site) -> Mapping[str, Mapping[str, object]]:
    """Return where everything is that a parameter may name, by kind; where an object is, sensors say."""
    return {
        "target": {name: (found.x_m, found.y_m, found.yaw_rad) for name, found in site.targets.items()},
        "surface": _unled(site.surfaces),
        "area": _unled(site.areas),
        "corridor": site.corridors,
        "tool": _fixtures(site),
    }


def barriers(site: Site) -> Mapping[tuple[str, str], object]:
    """Return what every drive keeps clear of, wherever it leads: furniture and restricted zones, and the site's bounds.

    By kind and name, since a zone may be called as what stands in it. What is forbidden is not among it: that binds
    what stands still as well.
    """
    restricted = {name: zone.polygon for name, zone in site.zones.items() if zone.kind == "restricted"}
    found = {"surface": _unled(site.surfaces), "tool": _fixtures(site), "zone": restricted}
    named = {(kind, name): thing for kind, things in found.items() for name, thing in things.items()}
    return {("site", "bounds_m"): site.bounds_m, **named}


def moved(old: Site, new: Site) -> list[tuple[str, object]]:
    """Return those of `barriers` that are where none of their kind was before, by name: another name moves nothing.

    Of the site's bounds a wall that stands where it stood is infinitely far.
    """
    stood = [(kind, place) for (kind, _), place in barriers(old).items()]
    found = [(name, place) for (kind, name), place in barriers(new).items() if (kind, place) not in stood]
    away = (-inf, -inf, inf, inf)
    walls = tuple(
        there if now == was else now for now, was, there in zip(new.bounds_m, old.bounds_m, away, strict=True)
    )
    return [(name, walls if place == new.bounds_m else place) for name, place in found]


def beside(point: Point, thing: object, reach_m: float) -> bool:
    """Say whether one of `barriers` comes as near to a point as that; of what is no box its bounding box does."""
    x, y = point
    match thing:
        case Surface():
            half = hypot(thing.half_x_m, thing.half_y_m)
            x0, y0, x1, y1 = thing.x_m - half, thing.y_m - half, thing.x_m + half, thing.y_m + half
        case Tool():
            x0, y0, x1, y1 = thing.x_m, thing.y_m, thing.x_m, thing.y_m
        case (float(x0), float(y0), float(x1), float(y1)):  # walls, from within
            return min(x - x0, y - y0, x1 - x, y1 - y) <= reach_m
        case _:
            x0, y0, x1, y1, _ = _keepout(cast("tuple[Point, ...]", thing))
    return hypot(max(x0 - x, 0.0, x - x1), max(y0 - y, 0.0, y - y1)) <= reach_m


def _unled(found: Mapping[str, _Led]) -> dict[str, _Led]:
    """Return things as they stand, whatever they are called, and what leads to them: another name moves nothing."""
    return {name: replace(thing, name="", target="") for name, thing in found.items()}


def _fixtures(site: Site) -> dict[str, Tool]:
    """Return tools as they stand: what else can be done with one moves nothing either."""
    return {name: replace(tool, actions={}) for name, tool in _unled(site.tools).items()}


def kinds(site: Site) -> Mapping[str, frozenset[str]]:
    """Return what kinds of objects and of tools there are."""
    return {
        "object": frozenset(found.kind for found in site.objects.values()),
        "tool": frozenset(found.kind for found in site.tools.values()),
    }


def locator(references: Mapping[str, str], site: Site) -> Locate:
    """Make the function that says where a proposal leads, for a capability with these references (kind → parameter).

    The function raises `KeyError` on a name the site does not know; admission has rejected such a proposal before.
    """
    ground = _Map(site, tuple(_keepout(zone.polygon) for zone in site.zones.values() if zone.kind == "forbidden"))
    for kind, make in _LOCATORS.items():
        if kind in references:
            return make(references[kind], ground)
    return lambda params, facts: NOWHERE


def leading(references: Mapping[str, str]) -> frozenset[str]:
    """Return the parameters that `locator` reads, for a capability with these references (kind → parameter)."""
    kind = next((kind for kind in _LOCATORS if kind in references), None)
    return frozenset() if kind is None else frozenset({references[kind], "x_m", "y_m"})


def _target(param: str, ground: _Map) -> Locate:
    known = {
        name: ground.point(name, "target", (target.x_m, target.y_m), target.corridor)
        for name, target in ground.site.targets.items()
    }
    led = stands(ground.site)

    def locate(params: Params, _facts: WorldFacts | None) -> Place:
        name = params.get(param)
        if name is not None:
            return known[cast("str", name)]
        x, y = point = _point(params)
        corridor = next((leads for x0, y0, x1, y1, leads in led if x0 <= x <= x1 and y0 <= y <= y1), None)
        return ground.point("", "point", point, corridor)

    return locate


def _surface(param: str, ground: _Map) -> Locate:
    surfaces = ground.site.surfaces
    known = {name: ground.point(name, "surface", (found.x_m, found.y_m)) for name, found in surfaces.items()}

    def locate(params: Params, _facts: WorldFacts | None) -> Place:
        name = cast("str", params[param])
        if "x_m" not in params:
            return known[name]
        point = _point(params)
        place = ground.point(name, "surface", point)
        return place if on_surface(point, surfaces[name]) else place._replace(outside=True)

    return locate


def _fixed(kind: str) -> Callable[[str, _Map], Locate]:
    def make(param: str, ground: _Map) -> Locate:
        site = ground.site
        points = (
            {name: centre(area.polygon) for name, area in site.areas.items()}
            if kind == "area"
            else {name: (tool.x_m, tool.y_m) for name, tool in site.tools.items()}
        )
        known = {name: ground.point(name, kind, point) for name, point in points.items()}
        return lambda params, facts: known[cast("str", params[param])]

    return make


def _object(param: str, ground: _Map) -> Locate:
    objects = ground.site.objects
    known = {name: ground.point(name, "object", (found.x_m, found.y_m)) for name, found in objects.items()}
    clear = {name: Place(name, "object") for name in objects}
    x0, y0, x1, y1 = ground.site.bounds_m
    forbids = ground.forbids

    def locate(params: Params, facts: WorldFacts | None) -> Place:
        name = cast("str", params[param])
        seen = None if facts is None else facts.objects.get(name)
        if seen is None:
            return known[name]
        x, y = seen.x_m, seen.y_m
        if x0 <= x <= x1 and y0 <= y <= y1 and not forbids(x, y):
            return clear[name]
        return ground.point(name, "object", (x, y))

    return locate


def _point(params: Params) -> Point:
    return cast("float", params["x_m"]), cast("float", params["y_m"])


_LOCATORS: Final[Mapping[str, Callable[[str, _Map], Locate]]] = {
    "target": _target,
    "surface": _surface,
    "area": _fixed("area"),
    "tool": _fixed("tool"),
    "object": _object,
}


LEADING: Final = frozenset(_LOCATORS)
"""The kinds of names that lead somewhere; the place is of that kind itself."""


def finder(references: Mapping[str, str], site: Site) -> Find:
    """Make the function that says what a proposal handles: the object it names, else what the gripper holds.

    Nothing named and nothing held is `NOTHING`: no mass, not fragile, not hazardous. The function raises `KeyError` on
    an object the site does not know, so that rules about it fail closed.
    """
    objects = site.objects
    param = references.get("object")
    if param is not None:
        return lambda params, facts: objects[cast("str", params[param])]

    def held(_params: Params, facts: WorldFacts | None) -> SiteObject:
        return NOTHING if facts is None or facts.holding is None else objects[facts.holding]

    return held
