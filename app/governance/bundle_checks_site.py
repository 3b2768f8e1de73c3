"""What the organization, authority and site have to mean: known names, nothing reserved, areas with an inside."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations
from typing import TYPE_CHECKING, TypeAlias

from app.governance import bundle_build
from app.governance.bundle_checks import ASKING
from app.governance.places import inside, on_surface
from app.governance.policy_model import GOVERNANCE

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from app.governance import bundle_shapes as shapes
    from app.governance.bundle_checks import Known
    from app.governance.bundle_yaml import Path, Reader
    from app.governance.errors import PolicyError
    from app.governance.model import Capability

_Exact: TypeAlias = "tuple[Fraction, Fraction]"


def organization(reader: Reader, shape: shapes.OrganizationShape) -> Iterator[PolicyError]:
    """Check the agents: known permissions, and none that governance keeps for itself."""
    for name, agent in shape.agents.items():
        if name == GOVERNANCE:
            yield reader.problem(("agents", name), f"`{GOVERNANCE}` is reserved", ["another name"])
        for key, names in (("permissions", agent.permissions), ("supervised", agent.supervised)):
            for index, permission in enumerate(names):
                path = ("agents", name, key, index)
                yield from reader.unknown(path, "permission", permission, shape.permissions)
        for permission in sorted(set(agent.permissions) & set(agent.supervised)):
            message = f"`{permission}` is both granted and supervised"
            yield reader.problem(("agents", name), message, ["permissions", "supervised"])
    if GOVERNANCE in shape.permissions:
        yield reader.problem(("permissions",), f"`{GOVERNANCE}` is reserved", ["another name"])


def authority(reader: Reader, shape: shapes.AuthorityFileShape, known: Known) -> Iterator[PolicyError]:
    """Check what authority names."""
    for index, entry in enumerate(shape.confirm_before):
        path = ("confirm_before", index)
        yield from reader.unknown((*path, "capability"), "capability", entry.capability, known.named)
        yield from reader.unknown((*path, "profile"), "profile", entry.profile, known.profiles)
        found = known.capabilities.get(entry.capability)
        if found is None:
            continue
        for at, phase in enumerate(entry.phases):
            what = f"phase of `{entry.capability}` called"
            yield from reader.unknown((*path, "phases", at), what, phase, found.phases)
        yield from _confirming(reader, path, entry, found, known)
    if shape.denials is not None:
        yield from reader.unknown(("denials", "default"), "code", shape.denials.default, shape.denials.codes)


def _confirming(
    reader: Reader, path: Path, entry: shapes.ConfirmShape, found: Capability, known: Known
) -> Iterator[PolicyError]:
    """A phase waits for somebody who can be asked, and what is to be undone has something that undoes it."""
    modes = known.modes.get(entry.profile, ASKING)
    if ASKING.isdisjoint(modes):
        message = f"nobody is asked in `{entry.profile}`: the phase would end every session"
        yield reader.problem((*path, "profile"), message, sorted(ASKING))
    for key in ("on_deny", "on_timeout"):
        if getattr(entry, key) == "rollback" and found.rollback is None:
            yield reader.problem((*path, key), f"`{entry.capability}` has no rollback", ["terminate"])


def site(reader: Reader, shape: shapes.SiteShape) -> Iterator[PolicyError]:
    """Check the site: references, bounds that are not empty, polygons with an area."""
    x0, y0, x1, y1 = shape.bounds_m
    if x0 >= x1 or y0 >= y1:
        yield reader.problem(("bounds_m",), "empty bounds: x0 < x1 and y0 < y1 are needed", ["[x0, y0, x1, y1]"])
    yield from reader.unknown(("start",), "target", shape.start, shape.targets)
    for name, target in shape.targets.items():
        if target.corridor is not None:
            path = ("targets", name, "corridor")
            yield from reader.unknown(path, "corridor", target.corridor, shape.corridors)
    for key, held in (("surfaces", shape.surfaces), ("areas", shape.areas), ("tools", shape.tools)):
        for name, found in held.items():
            yield from reader.unknown((key, name, "target"), "target", found.target, shape.targets)
    for name, found in shape.objects.items():
        yield from reader.unknown(("objects", name, "surface"), "surface", found.surface, shape.surfaces)
    yield from _polygons(reader, shape)
    yield from _places(reader, shape)
    yield from _resting(reader, shape)


def _polygons(reader: Reader, shape: shapes.SiteShape) -> Iterator[PolicyError]:
    for key, held in (("zones", shape.zones), ("areas", shape.areas)):
        for name, found in held.items():
            if not (area := _area(found.polygon)) > 0.0:
                valid = ["the same corners in the other order"] if area < 0.0 else ["corners that are not on one line"]
                message = "a polygon runs counter-clockwise around some area"
                yield reader.problem((key, name, "polygon"), message, valid)
            elif (crossing := _crossing(found.polygon)) is not None:
                corners = " and ".join(str(number) for number in crossing)
                message = f"its edges cross, those from corners {corners}: nobody could tell what is inside"
                yield reader.problem((key, name, "polygon"), message, ["edges that meet at corners alone"])


def _area(polygon: Sequence[Sequence[float]]) -> float:
    corners = list(polygon)
    return sum(x1 * y2 - x2 * y1 for (x1, y1), (x2, y2) in zip(corners, [*corners[1:], corners[0]], strict=True)) / 2


def _crossing(polygon: Sequence[Sequence[float]]) -> tuple[int, int] | None:
    """Return the first two edges that cross, each by the number of its first corner (from 1); touching is no crossing.

    Computed exactly: rounding makes no crossing of two edges that only touch.
    """
    corners = [(Fraction(x), Fraction(y)) for x, y in polygon]
    edges = list(zip(corners, [*corners[1:], corners[0]], strict=True))
    for (one, (a, b)), (other, (c, d)) in combinations(enumerate(edges, 1), 2):
        if _side(a, b, c) * _side(a, b, d) < 0 and _side(c, d, a) * _side(c, d, b) < 0:
            return one, other
    return None


def _side(a: _Exact, b: _Exact, c: _Exact) -> int:
    """Return on which side of the line from a to b a point lies: 1 to the left, -1 to the right, 0 on it."""
    turn = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    return (turn > 0) - (turn < 0)


def _places(reader: Reader, shape: shapes.SiteShape) -> Iterator[PolicyError]:
    """Whatever has a name lies inside the site, and no target in a forbidden zone: all of it would be denied."""
    x0, y0, x1, y1 = shape.bounds_m
    for key in ("targets", "surfaces", "objects", "tools"):
        for name, found in getattr(shape, key).items():
            if not (x0 <= found.x_m <= x1 and y0 <= found.y_m <= y1):
                message = f"`{name}` lies at ({found.x_m:g}, {found.y_m:g}), outside the site"
                valid = [f"x_m from {x0:g} to {x1:g}", f"y_m from {y0:g} to {y1:g}"]
                yield reader.problem((key, name), message, valid)
    for name, target in shape.targets.items():
        for zone, held in shape.zones.items():
            corners = [(x, y) for x, y in held.polygon]
            if held.kind == "forbidden" and inside((target.x_m, target.y_m), corners):
                message = f"target `{name}` lies in the forbidden zone `{zone}`: nothing could ever go there"
                yield reader.problem(("targets", name), message, ["a place outside every forbidden zone"])


def _resting(reader: Reader, shape: shapes.SiteShape) -> Iterator[PolicyError]:
    """An object lies over its surface (its edge included), and no two of them at one point."""
    built = bundle_build.site(shape)
    there: dict[tuple[str, float, float], str] = {}
    for name, found in built.objects.items():
        surface = built.surfaces.get(found.surface)
        lies = f"`{name}` lies at ({found.x_m:g}, {found.y_m:g})"
        if surface is not None and not on_surface((found.x_m, found.y_m), surface):
            halves = f"{surface.half_x_m:g} m along and {surface.half_y_m:g} m across"
            valid = [f"within {halves} of ({surface.x_m:g}, {surface.y_m:g}), turned by {surface.yaw_rad:g} rad"]
            yield reader.problem(("objects", name), f"{lies}, which is not on `{surface.name}`", valid)
        other = there.setdefault((found.surface, found.x_m, found.y_m), name)
        if other != name:
            yield reader.problem(("objects", name), f"{lies}, where `{other}` lies already", ["another point"])
