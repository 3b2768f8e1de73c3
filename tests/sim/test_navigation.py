"""Ways for the base: what policy asks of them is kept, or there is none."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from math import hypot, pi

import numpy as np
import pytest

from app.cell.substrate import SubstrateError
from app.governance.model import Corridor, Point, Site, Vec3
from app.sim.motion import reversals
from app.sim.navigation import distance_to, furniture, plan_way
from app.sim.robot import BASE_RADIUS_M

BENCH_A, BENCH_B = (1.6, 4.6, 1.5708), (5.2, 4.6, 1.5708)
CRATE_ASIDE_M = 0.2 + BASE_RADIUS_M + 0.3  # its half, the base's, and the clearance asked for


def aside(corridor: Corridor, x: float, y: float) -> float:
    least = 99.0
    for (ax, ay), (bx, by) in pairwise(corridor.line):
        dx, dy = bx - ax, by - ay
        share = min(max(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy), 0.0), 1.0)
        least = min(least, hypot(x - ax - share * dx, y - ay - share * dy))
    return least


def along(site: Site, crates: list[Point]) -> list[Point]:
    return plan_way(site, BENCH_A, BENCH_B, clearance_m=0.3, corridor="aisle", crates=crates)


@pytest.mark.parametrize("crate", [(3.4, 3.6), (3.4, 3.2), (3.4, 4.0), (2.4, 3.0)])
def test_a_corridor_that_something_stands_in_is_not_left(site: Site, crate: Point) -> None:
    with pytest.raises(SubstrateError) as raised:
        along(site, [crate])
    assert raised.value.failure == "no_path"
    assert "within `aisle`" in raised.value.detail


def test_what_leaves_room_in_a_corridor_is_gone_around_within_it(site: Site) -> None:
    wide = replace(site.corridors["aisle"], half_width_m=1.1)
    way = along(replace(site, corridors={"aisle": wide}), [(3.0, 4.15)])
    inside = [(x, y) for x, y in way if 1.7 < x < 5.1]
    assert inside
    assert any(y < 3.6 - 1e-6 for _, y in inside)
    assert all(aside(wide, x, y) <= wide.half_width_m - BASE_RADIUS_M + 1e-6 for x, y in inside)
    for (ax, ay), (bx, by) in pairwise(way):
        for share in (0.0, 0.25, 0.5, 0.75, 1.0):
            x, y = ax + share * (bx - ax), ay + share * (by - ay)
            assert hypot(x - 3.0, y - 4.15) >= CRATE_ASIDE_M - 0.1


def test_without_anything_in_it_the_centre_line_is_the_way(site: Site) -> None:
    corridor = site.corridors["aisle"]
    for x, y in along(site, []):
        assert aside(corridor, x, y) < 1e-6 or min(abs(x - 1.6), abs(x - 5.2)) < 1e-3


def test_the_way_out_of_a_corridor_may_begin_beside_its_end(site: Site) -> None:
    # 0.4 m from everything leaves no room on the very end of the line, near the store.
    way = plan_way(site, (6.75, 2.6, 0.0), BENCH_B, clearance_m=0.4, corridor="aisle")
    assert way[-1] == BENCH_B[:2]


def nearest(site: Site, way: list[Point]) -> float:
    """Return how near the middle of the base comes to anything that stands, or to a forbidden zone."""
    share = np.linspace(0.0, 1.0, 200)
    solid = [*furniture(site), *(zone.polygon for zone in site.zones.values() if zone.kind == "forbidden")]
    gaps = (
        float(distance_to(outline, ax + share * (bx - ax), ay + share * (by - ay)).min())
        for (ax, ay), (bx, by) in pairwise(way)
        for outline in solid
    )
    return min(gaps, default=99.0)


BESIDE_PRESS, BESIDE_ZONE = (3.72, 0.64), (4.4, 1.0)


@pytest.mark.parametrize(
    "at", [(1.6, 5.4), (5.2, 5.4), (7.5, 2.6), (3.15, 0.64), (3.4, 0.64), BESIDE_PRESS, BESIDE_ZONE]
)
@pytest.mark.parametrize("yaw", [0.0, 0.5 * pi, pi, -0.5 * pi])
@pytest.mark.parametrize("clearance_m", [0.1, 0.3])
def test_no_way_leads_into_anything_or_through_it(site: Site, at: Point, yaw: float, clearance_m: float) -> None:
    way: list[Point] = []
    with suppress(SubstrateError):
        way = plan_way(site, (0.8, 0.8, 0.0), (*at, yaw), clearance_m=clearance_m, corridor=None)
    assert nearest(site, way) >= BASE_RADIUS_M


@pytest.mark.parametrize("start", [(1.6, 4.6, 0.5 * pi), (1.6, 4.64, 0.5 * pi)])
def test_a_step_leads_no_nearer_to_what_stands_there_than_the_base_is_wide(site: Site, start: Vec3) -> None:
    with pytest.raises(SubstrateError):
        plan_way(site, start, (1.6, 4.74, 0.5 * pi), clearance_m=0.1, corridor=None)
    assert plan_way(site, (1.6, 4.74, 0.5 * pi), BENCH_A, clearance_m=0.1, corridor=None)[-1] == BENCH_A[:2]


def test_no_way_leads_into_a_wall(site: Site) -> None:
    with pytest.raises(SubstrateError):
        plan_way(site, (0.8, 0.8, 0.0), (0.3, 2.0, pi), clearance_m=0.1, corridor=None)


def test_what_stands_behind_the_base_is_not_driven_through(site: Site) -> None:
    with pytest.raises(SubstrateError):
        plan_way(site, BENCH_A, (0.8, 0.8, 0.0), clearance_m=0.1, corridor=None, crates=[(1.6, 3.85)])


def test_a_corridor_may_name_a_point_of_its_line_twice(site: Site) -> None:
    line = site.corridors["aisle"].line
    twice = replace(site.corridors["aisle"], line=(line[0], line[0], *line[1:], line[-1]))
    assert along(replace(site, corridors={"aisle": twice}), []) == along(site, [])


def test_a_way_turns_back_where_it_leads_furthest_and_noise_is_no_turn() -> None:
    out = [0.01 * k for k in range(41)]
    there = [(x, 0.0) for x in out] + [(x, 0.01) for x in reversed(out[10:])] + [(x, 0.02) for x in out[10:31]]
    assert reversals([np.array((*at, 0.0)) for at in there]) == [41, 72]
    corner = [(x, 0.0) for x in out] + [(0.4, y) for y in out] + [(0.4 - x, 0.4 - x) for x in out[1:]]
    noise = np.random.default_rng(1).normal(0.0, 0.004, (len(corner), 2))
    assert reversals([np.array((*at, 0.0)) for at in corner + noise]) == [81]
