"""Where a proposal leads and what it handles, symbolically: the records `target`, `place` and `tool`.

Names are looked up with the real functions of `governance.places`, once for each name there is; only a point with a
range (a pose on the floor, an object as perceived) needs geometry in formulas. A rectangle along the axes is exact.
Any other polygon, and a turned surface, leave open what is within `BAND_M` of an edge, where rounding decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import cos, hypot, sin
from typing import TYPE_CHECKING, Final, cast

import z3

from app.governance.places import NOTHING, Place, finder, inside, leading, locator, on_surface, stands
from app.proofs.encoding import Record, Slot
from app.proofs.formulas import Formula, both, choose, either, no, rational, some
from app.proofs.values import Value, choice, truth

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from app.governance.model import Params, Point, Site, SiteObject, Surface

BAND_M: Final = 1e-6
_ABSENT: Final = Slot(False, Value(((True, ""),)))


@dataclass(frozen=True, slots=True)
class Coordinates:
    """A point with a range, by cases: where which of them holds, x and y (numbers, or terms)."""

    cases: tuple[tuple[Formula, object, object], ...]


def coordinates(x: Value, y: Value) -> Coordinates:
    """Return a point from its two numbers."""
    return Coordinates(tuple((both(one, other), a, b) for one, a in x.cases for other, b in y.cases))


class Ground:
    """The site as one capability's references see it."""

    def __init__(self, references: Mapping[str, str], site: Site) -> None:
        """Take the capability's references (kind → parameter)."""
        self.references, self.site = references, site
        self._locate, self._find = locator(references, site), finder(references, site)
        self.approximate = False
        self.edges: list[Formula] = []  # where an answer is left open
        self.open: list[z3.BoolRef] = []  # what then answers it, either way
        kinds = ("target", "surface", "area", "tool", "object")
        self._found: dict[object, tuple[object, tuple[Record, Formula]]] = {}
        self.answers: dict[object, tuple[object, Formula]] = {}  # about points; two sites may share them
        self.kind = next((kind for kind in kinds if leading({kind: "-"}) and kind in references), None)

    def _once(
        self, what: str, slots: Sequence[object], make: Callable[[], tuple[Record, Formula]]
    ) -> tuple[Record, Formula]:
        """Look up the same names once only, so that what is left open is the same wherever it is asked for."""
        key = (what, *(id(slot) for slot in slots))
        if key not in self._found:
            self._found[key] = (slots, make())  # what an id belongs to has to live as long as the id is used
        return self._found[key][1]

    # What it handles -------------------------------------------------------------------------------------------------

    def target(self, params: Record, holding: Sequence[tuple[Formula, str | None]]) -> tuple[Record, Formula]:
        """Return the object a proposal handles, and where looking it up fails."""
        param = self.references.get("object")
        if param is None:
            found = [(guard, NOTHING if name is None else self.site.objects[name]) for guard, name in holding]
            return _fields(found, ("name", "kind", "mass_kg", "fragile", "hazardous")), False
        return self._once("target", [params[param]], lambda: self._named_target(param, params[param]))

    def _named_target(self, param: str, slot: Slot) -> tuple[Record, Formula]:
        named: list[tuple[Formula, SiteObject]] = []
        for guard, name in slot.value.cases:
            named.append((guard, self._find(cast("Params", {param: name}), None)))
        return _fields(named, ("name", "kind", "mass_kg", "fragile", "hazardous")), no(slot.present)

    def tool(self, params: Record) -> tuple[Record, Formula]:
        """Return the tool it works, and where looking it up fails."""
        slot = params[self.references["tool"]]
        named = [(guard, self.site.tools[cast("str", name)]) for guard, name in slot.value.cases]
        return _fields(named, ("name", "kind", "press")), no(slot.present)

    # Where it leads --------------------------------------------------------------------------------------------------

    def place(self, params: Record, seen: Coordinates) -> tuple[Record, Formula]:
        """Return where a proposal leads, and where looking it up fails; `seen` is where its object is perceived."""
        slots = [params.get(name) for name in (self.references.get(self.kind or "", ""), "x_m", "y_m")]
        return self._once("place", slots, lambda: self._place(params, seen))

    def _place(self, params: Record, seen: Coordinates) -> tuple[Record, Formula]:
        if self.kind is None:
            return self._record([(True, self._locate({}, None))], []), False
        slot = params[self.references[self.kind]]
        named = [
            (guard, self._locate(cast("Params", {self.references[self.kind]: name}), None), str(name))
            for guard, name in slot.value.cases
        ]
        x, y = params.get("x_m", _ABSENT), params.get("y_m", _ABSENT)
        match self.kind:
            case "target":
                lost = both(no(slot.present), no(both(x.present, y.present)))
                free = both(no(slot.present), x.present, y.present)
                places = [(both(slot.present, guard), place) for guard, place, _ in named]
                points = [(free, "", "point", coordinates(x.value, y.value), None)] if free is not False else []
            case "surface":
                lost = either(no(slot.present), both(x.present, no(y.present)))
                places = [(both(no(x.present), guard), place) for guard, place, _ in named]
                at = coordinates(x.value, y.value)
                points = [
                    (both(x.present, guard), name, "surface", at, self.site.surfaces[name]) for guard, _, name in named
                ] if x.present is not False else []  # fmt: skip
            case "object":
                lost, places = no(slot.present), []
                points = [(guard, name, "object", seen, None) for guard, _, name in named]
            case _:
                lost, points = no(slot.present), []
                places = [(guard, place) for guard, place, _ in named]
        return self._record(places, points), lost

    def _record(
        self,
        places: Sequence[tuple[Formula, Place]],
        points: Sequence[tuple[Formula, str, str, Coordinates, Surface | None]],
    ) -> Record:
        fields = dict(_fields(places, ("name", "kind", "forbidden", "outside"))) if places else {}
        corridors = [(guard, place.corridor) for guard, place in places if place.corridor is not None]
        corridors += [led for guard, _, kind, at, _ in points if kind == "point" for led in self._led(guard, at)]
        corridor = Slot(some(guard for guard, _ in corridors), choice(corridors))
        if points:
            free = [(guard, name, kind) for guard, name, kind, _, _ in points]
            names = [(guard, place.name) for guard, place in places] + [(guard, name) for guard, name, _ in free]
            kinds = [(guard, place.kind) for guard, place in places] + [(guard, kind) for guard, _, kind in free]
            forbidden = some(both(guard, self.forbids(at)) for guard, _, _, at, _ in points)
            outside = some(both(guard, self.leaves(at, surface)) for guard, _, _, at, surface in points)
            fields |= {
                "name": Slot(True, choice(names)),
                "kind": Slot(True, choice(kinds)),
                "forbidden": Slot(True, truth(either(_truth(fields.get("forbidden")), forbidden))),
                "outside": Slot(True, truth(either(_truth(fields.get("outside")), outside))),
            }
        return {**fields, "corridor": corridor}

    def _led(self, guard: Formula, at: Coordinates) -> list[tuple[Formula, str]]:
        """Return which corridors lead to a point, and where: to the first target that the base covers there."""
        found: list[tuple[Formula, str]] = []
        for case, x, y in at.cases:
            before: Formula = False
            for x0, y0, x1, y1, corridor in stands(self.site):
                here = both(_between(x0, x, x1), _between(y0, y, y1))
                found.append((both(guard, case, no(before), here), corridor))
                before = either(before, here)
        return found

    # Geometry --------------------------------------------------------------------------------------------------------

    def forbids(self, at: Coordinates) -> Formula:
        """Return where a point lies in a forbidden zone."""
        zones = [zone.polygon for zone in self.site.zones.values() if zone.kind == "forbidden"]
        return some(both(guard, self._in(x, y, polygon)) for guard, x, y in at.cases for polygon in zones)

    def _in(self, x: object, y: object, polygon: Sequence[Point]) -> Formula:
        return self._shared(("in", tuple(polygon)), x, y, lambda: self._inside(x, y, polygon))

    def _shared(self, what: object, x: object, y: object, make: Callable[[], Formula]) -> Formula:
        """Ask the same of the same point once only."""
        key = (what, *(value.get_id() if isinstance(value, z3.ExprRef) else value for value in (x, y)))
        if key not in self.answers:
            self.answers[key] = ((x, y), make())
        return self.answers[key][1]

    def leaves(self, at: Coordinates, surface: Surface | None) -> Formula:
        """Return where a point lies outside the site, or off the surface that was named with it."""
        x0, y0, x1, y1 = self.site.bounds_m
        found: list[Formula] = []
        for guard, x, y in at.cases:
            off = no(both(_between(x0, x, x1), _between(y0, y, y1)))
            found.append(both(guard, off if surface is None else either(off, no(self._over(x, y, surface)))))
        return some(found)

    def _over(self, x: object, y: object, surface: Surface) -> Formula:
        return self._shared(("on", surface), x, y, lambda: self._on(x, y, surface))

    def _inside(self, x: object, y: object, polygon: Sequence[Point]) -> Formula:
        xs, ys = [point[0] for point in polygon], [point[1] for point in polygon]
        boxed = both(_between(min(xs), x, max(xs)), _between(min(ys), y, max(ys)))
        if isinstance(x, float) and isinstance(y, float):
            return boxed is True and inside((x, y), polygon)
        corners = {(a, b) for a in (min(xs), max(xs)) for b in (min(ys), max(ys))}
        if len(polygon) == 4 and set(polygon) == corners and _around(polygon):
            return boxed
        self.approximate = True
        return both(boxed, self._parity(_number(x), _number(y), polygon))

    def _parity(self, x: z3.ArithRef, y: z3.ArithRef, polygon: Sequence[Point]) -> Formula:
        """The even-odd rule over the reals; near an edge either answer is left open."""
        odd: Formula = False
        near: list[Formula] = []
        x1, y1 = polygon[-1]
        for x2, y2 in polygon:
            a, b, dx, dy = rational(x1), rational(y1), rational(x2 - x1), rational(y2 - y1)
            length = hypot(x2 - x1, y2 - y1)
            across = (x - a) * dy - (y - b) * dx
            band = rational(BAND_M * length)
            along, margin = (x - a) * dx + (y - b) * dy, rational(BAND_M * length)
            whole = rational(length * length)
            near.append(
                both(across <= band, across >= -band, along >= -margin, along <= whole + margin)
            )  # fmt: skip
            if y2 != y1:
                slope = rational(Fraction(x2 - x1) / Fraction(y2 - y1))
                crossing = both((b > y) != (rational(y2) > y), x < slope * (y - b) + a)
                odd = either(both(odd, no(crossing)), both(no(odd), crossing))
            x1, y1 = x2, y2
        self.edges.append(some(near))
        return choose(some(near), self._left_open(), odd)

    def _left_open(self) -> z3.BoolRef:
        self.open.append(z3.FreshBool("edge"))
        return self.open[-1]

    def _on(self, x: object, y: object, surface: Surface) -> Formula:
        if isinstance(x, float) and isinstance(y, float):
            return on_surface((x, y), surface)
        self.approximate = True
        dx, dy = _number(x) - rational(surface.x_m), _number(y) - rational(surface.y_m)
        c, s = rational(cos(surface.yaw_rad)), rational(sin(surface.yaw_rad))
        inner: list[Formula] = []
        outer: list[Formula] = []
        for value, half in ((c * dx + s * dy, surface.half_x_m), (c * dy - s * dx, surface.half_y_m)):
            for limit, kept in ((half - BAND_M, inner), (half + BAND_M, outer)):
                kept += [value <= rational(limit), value >= rational(-limit)]
        self.edges.append(both(*outer, no(both(*inner))))
        return either(both(*inner), both(*outer, self._left_open()))


def _truth(slot: Slot | None) -> Formula:
    return False if slot is None else slot.value.truth


def _fields(options: Sequence[tuple[Formula, object]], names: Sequence[str]) -> Record:
    """Return a record that is one of a few objects, field by field."""
    record: dict[str, Slot] = {}
    for name in names:
        held = [(guard, getattr(option, name)) for guard, option in options]
        boolean = bool(held) and isinstance(held[0][1], bool)
        value = truth(some(guard for guard, there in held if there)) if boolean else choice(held)
        record[name] = Slot(True, value)
    return record


def _between(low: float, value: object, high: float) -> Formula:
    if isinstance(value, float):
        return low <= value <= high
    number = _number(value)
    return both(number >= rational(low), number <= rational(high))


def _number(value: object) -> z3.ArithRef:
    return rational(value) if isinstance(value, float) else cast("z3.ArithRef", value)


def _around(polygon: Sequence[Point]) -> bool:
    """Say whether four corners follow one another along the sides, not across."""
    return all((x1 == x2) != (y1 == y2) for (x1, y1), (x2, y2) in zip(polygon, (*polygon[1:], polygon[0]), strict=True))


__all__ = ["Coordinates", "Ground", "coordinates"]
