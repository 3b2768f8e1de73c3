from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.governance.model import ObjectFact
from app.governance.places import NOTHING, NOWHERE, centre, finder, inside, locator, on_surface
from tests.governance.policy_world import context, shipped

SITE = shipped().site
IN_PRESS_AREA = (5.0, 1.0)


def facts(**objects: tuple[float, float]):
    seen = {
        name: ObjectFact(visible=True, reachable=True, x_m=x, y_m=y, z_m=0.8, stamp_s=0.0)
        for name, (x, y) in objects.items()
    }
    world = context("sim-relaxed").cell.facts
    assert world is not None
    return replace(world, objects=seen)


@pytest.mark.parametrize(
    ("references", "params", "kind", "forbidden", "outside"),
    [
        ({"target": "target"}, {"target": "dock"}, "target", False, False),
        ({"target": "target"}, {"x_m": 3.0, "y_m": 3.0}, "point", False, False),
        ({"target": "target"}, {"x_m": IN_PRESS_AREA[0], "y_m": IN_PRESS_AREA[1]}, "point", True, False),
        ({"target": "target"}, {"x_m": 9.0, "y_m": 3.0}, "point", False, True),
        ({"target": "target"}, {"x_m": math.nan, "y_m": 3.0}, "point", False, True),
        ({"surface": "surface"}, {"surface": "bench_a"}, "surface", False, False),
        ({"surface": "surface"}, {"surface": "bench_a", "x_m": 1.6, "y_m": 5.4}, "surface", False, False),
        ({"surface": "surface"}, {"surface": "bench_a", "x_m": 5.2, "y_m": 5.4}, "surface", False, True),
        ({"surface": "surface"}, {"surface": "bench_a", "x_m": math.nan, "y_m": 5.4}, "surface", False, True),
        ({"area": "area"}, {"area": "shelf_front"}, "area", False, False),
        ({"tool": "tool"}, {"tool": "press"}, "tool", False, False),
        ({"object": "object_id"}, {"object_id": "mug_1"}, "object", False, False),
    ],
)
def test_a_proposal_leads_where_its_names_and_points_say(references, params, kind, forbidden, outside):
    place = locator(references, SITE)(params, None)
    assert (place.kind, place.forbidden, place.outside) == (kind, forbidden, outside)


@pytest.mark.parametrize(
    ("x_m", "y_m", "corridor"),
    [
        (6.75, 2.6, "aisle"),  # the shelf's stand, by another notation
        (6.75 - 0.45, 2.6 + 0.45, "aisle"),
        (5.2, 4.2, "aisle"),
        (6.25, 2.6, None),
        (6.75, 3.1, None),
        (0.8, 0.8, None),
        (math.nan, 2.6, None),
    ],
)
def test_a_corridor_leads_to_points_where_the_base_covers_its_target(x_m: float, y_m: float, corridor: str | None):
    place = locator({"target": "target"}, SITE)({"x_m": x_m, "y_m": y_m}, None)
    assert (place.kind, place.corridor) == ("point", corridor)


@pytest.mark.parametrize(
    ("seen_at", "forbidden", "outside"),
    [
        (None, False, False),
        ((3.0, 3.0), False, False),
        (IN_PRESS_AREA, True, False),
        ((-1.0, 3.0), False, True),
        ((3.0, 6.5), False, True),
        ((math.nan, 3.0), False, True),
        ((3.0, math.inf), False, True),
    ],
)
def test_an_object_is_where_it_was_seen_last_else_where_the_site_has_it(seen_at, forbidden, outside):
    locate = locator({"object": "object_id"}, SITE)
    place = locate({"object_id": "mug_1"}, facts() if seen_at is None else facts(mug_1=seen_at))
    assert (place.name, place.kind, place.forbidden, place.outside) == ("mug_1", "object", forbidden, outside)


def test_a_corridor_leads_to_the_targets_that_have_one():
    locate = locator({"target": "target"}, SITE)
    assert (locate({"target": "shelf_stand"}, None).corridor, locate({"target": "dock"}, None).corridor) == (
        "aisle",
        None,
    )


def test_what_names_nothing_leads_nowhere_and_handles_what_is_held():
    assert locator({}, SITE)({}, None) == NOWHERE
    find = finder({}, SITE)
    assert find({}, None) is NOTHING
    assert find({}, context("sim-relaxed").cell.facts) is NOTHING
    assert find({}, context("sim-relaxed", holding="glass_1").cell.facts) is SITE.objects["glass_1"]


def test_an_object_or_place_nobody_knows_raises_so_that_rules_about_it_fail_closed():
    with pytest.raises(KeyError):
        finder({}, SITE)({}, context("sim-relaxed", holding="stone_7").cell.facts)
    with pytest.raises(KeyError):
        finder({"object": "object_id"}, SITE)({"object_id": "stone_7"}, None)
    for kind in ("target", "surface", "area", "tool", "object"):
        with pytest.raises(KeyError):
            locator({kind: "name"}, SITE)({"name": "nowhere"}, None)


coordinate = st.floats(-2, 10)


@given(coordinate, coordinate)
def test_every_point_of_the_forbidden_zone_and_no_other_is_forbidden(x, y):
    place = locator({"target": "target"}, SITE)({"x_m": x, "y_m": y}, None)
    assert place.forbidden == (4.6 <= x <= 6.2 and 0.4 <= y <= 1.6)
    assert place.outside == (not (0.0 <= x <= 8.0 and 0.0 <= y <= 6.0))


@given(st.integers(0, 3), st.floats(0, 1))
def test_the_boundary_of_a_forbidden_zone_belongs_to_it(edge, along):
    corners = SITE.zones["press_area"].polygon
    (x0, y0), (x1, y1) = corners[edge], corners[(edge + 1) % 4]
    x, y = (1 - along) * x0 + along * x1, (1 - along) * y0 + along * y1
    x, y = (x0 if x0 == x1 else x), (y0 if y0 == y1 else y)  # rounding must not lead off the edge
    assert locator({"target": "target"}, SITE)({"x_m": x, "y_m": y}, None).forbidden


@given(st.integers(0, 2), st.floats(0, 1))
def test_the_slanted_boundary_of_a_polygon_belongs_to_it(edge, along):
    corners = ((0.0, 0.0), (7.3, 1.9), (3.1, 5.7))
    (x0, y0), (x1, y1) = corners[edge], corners[(edge + 1) % 3]
    assert inside(((1 - along) * x0 + along * x1, (1 - along) * y0 + along * y1), corners)


@pytest.mark.parametrize(("x_m", "y_m"), [(0.0, 0.0), (8.0, 6.0), (0.0, 3.0), (4.0, 6.0)])
def test_the_boundary_of_the_site_belongs_to_it(x_m, y_m):
    assert not locator({"target": "target"}, SITE)({"x_m": x_m, "y_m": y_m}, None).outside


def test_the_edge_of_a_surface_belongs_to_it():
    bench = SITE.surfaces["bench_a"]
    edge = {"surface": "bench_a", "x_m": bench.x_m, "y_m": bench.y_m + bench.half_y_m}
    assert not locator({"surface": "surface"}, SITE)(edge, None).outside


@given(coordinate, coordinate, st.integers(0, 3))
def test_a_notched_polygon_holds_what_its_two_halves_hold(x, y, turn):
    notched = ((0.0, 0.0), (4.0, 0.0), (4.0, 2.0), (2.0, 2.0), (2.0, 4.0), (0.0, 4.0))
    corners = (*notched[turn:], *notched[:turn])
    low, high = 0.0 <= x <= 4.0 and 0.0 <= y <= 2.0, 0.0 <= x <= 2.0 and 0.0 <= y <= 4.0
    if min(abs(value - edge) for value in (x, y) for edge in (0.0, 2.0, 4.0)) > 1e-6 or {x, y} <= {0.0, 1.0, 2.0, 4.0}:
        assert inside((x, y), corners) == (low or high)


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-math.pi, math.pi))
def test_a_turned_surface_holds_the_points_that_turn_with_it(u, v, yaw):
    bench = replace(SITE.surfaces["bench_a"], yaw_rad=yaw)
    point = (bench.x_m + u * math.cos(yaw) - v * math.sin(yaw), bench.y_m + u * math.sin(yaw) + v * math.cos(yaw))
    if min(abs(abs(u) - bench.half_x_m), abs(abs(v) - bench.half_y_m)) > 1e-9:
        assert on_surface(point, bench) == (abs(u) < bench.half_x_m and abs(v) < bench.half_y_m)


def test_the_centre_of_a_square_is_its_middle():
    assert centre(((0.0, 0.0), (2.0, 0.0), (2.0, 4.0), (0.0, 4.0))) == (1.0, 2.0)
