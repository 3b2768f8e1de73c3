"""Ways for the base: around furniture, crates and zones with the clearance asked for, or along a corridor.

The base drives sideways as well as it drives forward. It leaves a bench straight backwards and comes up to one
straight ahead; in between it keeps `clearance_m` beyond its own circle. A grid search (A*, 0.1 m) finds the way, and
its corners are then cut where the straight line is free. Nowhere does its circle come into anything; where it stands so
near already, it comes no nearer. Along a corridor the whole base stays within it: where
something stands there that leaves no room, there is no way.
"""

from __future__ import annotations

import heapq
import itertools
from math import cos, hypot, sin
from typing import TYPE_CHECKING

import numpy as np

from app.cell.substrate import SubstrateError
from app.sim.robot import BASE_RADIUS_M
from app.sim.world import CRATE_HALF_M

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from app.governance.model import Corridor, Point, Site, Vec3, Zone

CELL_M = 0.1
ZONE_MARGIN_M = 0.20  # beside the clearance, so that a stop still ends outside
MIN_CLEARANCE_M = 0.05
_UNDOCK_STEP_M, _UNDOCK_MAX_M = 0.05, 1.6
_ROUNDING_M = 1e-6
_NEIGHBOURS = tuple((dx, dy, hypot(dx, dy)) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if (dx, dy) != (0, 0))


class FloorMap:
    """Where the middle of the base may be, for one clearance; distances are to outlines in metres."""

    def __init__(
        self,
        site: Site,
        crates: Iterable[Point],
        clearance_m: float,
        goal: Point,
        corridor: Corridor | None = None,
    ) -> None:
        """Draw the obstacles: walls, furniture, crates, forbidden zones.

        And restricted ones unless the goal lies within, and whatever is beside the corridor, if one is to be kept.
        """
        self._bounds = site.bounds_m
        keep = BASE_RADIUS_M + max(clearance_m, MIN_CLEARANCE_M)
        outlines = [(outline, keep) for outline in furniture(site)]
        half = CRATE_HALF_M[0]
        outlines += [
            (((x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)), keep)
            for x, y in crates
        ]
        outlines += [
            (zone.polygon, max(keep, BASE_RADIUS_M + ZONE_MARGIN_M))
            for zone in site.zones.values()
            if _shut(zone, goal)
        ]
        x0, y0, x1, y1 = self._bounds
        self._nx, self._ny = round((x1 - x0) / CELL_M) + 1, round((y1 - y0) / CELL_M) + 1
        xs, ys = np.meshgrid(x0 + CELL_M * np.arange(self._nx), y0 + CELL_M * np.arange(self._ny), indexing="ij")
        wall = np.minimum.reduce([xs - x0, x1 - xs, ys - y0, y1 - ys])
        self._free: NDArray[np.bool_] = wall >= BASE_RADIUS_M
        self._outlines = outlines
        for outline, distance in outlines:
            self._free &= distance_to(outline, xs, ys) >= distance
        self._line = () if corridor is None else corridor.line
        # The centre line itself is always within, however narrow the corridor is said to be.
        self._aside_m = 0.0 if corridor is None else max(corridor.half_width_m - BASE_RADIUS_M, CELL_M)
        self._free &= self._within(xs, ys)

    def _within(self, xs: NDArray[np.float64], ys: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which points lie in the corridor; all do where none is to be kept."""
        aside = [_to_segment(a, b, xs, ys) for a, b in itertools.pairwise(self._line)]
        return np.minimum.reduce(aside) <= self._aside_m + 1e-9 if aside else np.ones(xs.shape, dtype=bool)

    def free(self, x: float, y: float) -> bool:
        """Tell whether the middle of the base may be here."""
        if self._to_wall(x, y) < BASE_RADIUS_M:
            return False
        px, py = np.array([x]), np.array([y])
        clear = all(float(distance_to(outline, px, py)[0]) >= distance for outline, distance in self._outlines)
        return clear and bool(self._within(px, py)[0])

    def distances(self, x: float, y: float) -> list[float]:
        """Return how far a point is from the walls, and from everything else that is drawn here."""
        px, py = np.array([x]), np.array([y])
        return [self._to_wall(x, y), *(float(distance_to(outline, px, py)[0]) for outline, _ in self._outlines)]

    def _to_wall(self, x: float, y: float) -> float:
        x0, y0, x1, y1 = self._bounds
        return min(x - x0, x1 - x, y - y0, y1 - y)

    def straight(self, start: Point, end: Point) -> bool:
        """Tell whether the straight line is free."""
        steps = max(2, int(hypot(end[0] - start[0], end[1] - start[1]) / (CELL_M / 2)) + 1)
        share = np.linspace(0.0, 1.0, steps)
        xs, ys = start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1])
        clear = all(
            bool((distance_to(outline, xs, ys) >= distance - 1e-9).all()) for outline, distance in self._outlines
        )
        return clear and bool(self._within(xs, ys).all())

    def search(self, start: Point, end: Point) -> list[Point] | None:
        """Return way points from start to end, both included, or None where no way is free."""
        if self.straight(start, end):
            return [start, end]
        cells = self._astar(self._cell(start), self._cell(end))
        if cells is None:
            return None
        x0, y0 = self._bounds[0], self._bounds[1]
        return self._cut([start, *((x0 + CELL_M * i, y0 + CELL_M * j) for i, j in cells), end])

    def beside(self, point: Point) -> Point | None:
        """Return the point, or the nearest place that is free where it is not; None where none is near."""
        if self.free(*point):
            return point
        i, j = self._cell(point)
        x, y = self._bounds[0] + CELL_M * i, self._bounds[1] + CELL_M * j
        near = bool(self._free[i, j]) and hypot(x - point[0], y - point[1]) <= BASE_RADIUS_M
        return (x, y) if near else None

    def _cell(self, point: Point) -> tuple[int, int]:
        i, j = round((point[0] - self._bounds[0]) / CELL_M), round((point[1] - self._bounds[1]) / CELL_M)
        if self._free[i, j]:
            return i, j
        free = np.argwhere(self._free)
        if not len(free):
            return i, j
        best = free[np.argmin(((free - (i, j)) ** 2).sum(axis=1))]
        return int(best[0]), int(best[1])

    def _astar(self, start: tuple[int, int], end: tuple[int, int]) -> list[tuple[int, int]] | None:
        open_: list[tuple[float, float, tuple[int, int]]] = [(0.0, 0.0, start)]
        came: dict[tuple[int, int], tuple[int, int]] = {start: start}
        cost = {start: 0.0}
        while open_:
            _, spent, cell = heapq.heappop(open_)
            if cell == end:
                return _walk_back(came, end)
            if spent > cost[cell]:
                continue
            for dx, dy, length in _NEIGHBOURS:
                after = (cell[0] + dx, cell[1] + dy)
                if not (0 <= after[0] < self._nx and 0 <= after[1] < self._ny) or not self._free[after]:
                    continue
                total = spent + length
                if total < cost.get(after, 1e9):
                    cost[after], came[after] = total, cell
                    heapq.heappush(open_, (total + hypot(after[0] - end[0], after[1] - end[1]), total, after))
        return None

    def _cut(self, points: list[Point]) -> list[Point]:
        kept, k = [points[0]], 0
        while k < len(points) - 1:
            far = next(j for j in range(len(points) - 1, k, -1) if j == k + 1 or self.straight(points[k], points[j]))
            kept.append(points[far])
            k = far
        return kept


def plan_way(
    site: Site, start: Vec3, goal: Vec3, *, clearance_m: float, corridor: str | None, crates: Iterable[Point] = ()
) -> list[Point]:
    """Return way points for the middle of the base, start and goal included.

    Raises:
        SubstrateError: `no_path`, saying between what.
    """
    here, there = (start[0], start[1]), (goal[0], goal[1])
    floor = FloorMap(site, crates, clearance_m, there)
    least = [min(now, BASE_RADIUS_M) for now in floor.distances(*here)]
    if hypot(there[0] - here[0], there[1] - here[1]) < 0.15:
        if not _clear(floor, there, least):
            raise SubstrateError("no_path", "the base would touch what stands there")
        return [here, there]
    leave, arrive = _back_off(floor, start, least), _back_off(floor, goal, [BASE_RADIUS_M] * len(least))
    if leave is None or arrive is None:
        raise SubstrateError(
            "no_path",
            f"with {clearance_m:.2f} m clearance the base cannot {'leave' if leave is None else 'reach'} its stand",
        )
    legs = [(floor, leave, arrive)]
    if corridor is not None:
        lane = FloorMap(site, crates, clearance_m, there, site.corridors[corridor])
        line = _along(site.corridors[corridor], leave, arrive)
        legs = _lane_legs(floor, lane, line, leave, arrive)
    way: list[Point] = [here]
    for on, begin, end in legs:
        leg = on.search(begin, end)
        if leg is None:
            within = "" if on is floor else f" within `{corridor}`"
            raise SubstrateError(
                "no_path",
                f"no way from ({begin[0]:.1f}, {begin[1]:.1f}) to ({end[0]:.1f}, {end[1]:.1f}) "
                f"with {clearance_m:.2f} m clearance{within}",
            )
        way += leg
    return _tidy([*way, there])


def _lane_legs(
    floor: FloorMap, lane: FloorMap, line: list[Point], leave: Point, arrive: Point
) -> list[tuple[FloorMap, Point, Point]]:
    """Return the legs onto a corridor's centre line, along it, and off it.

    What stands on a corner of the line is gone around.

    Raises:
        SubstrateError: `no_path`, it stands where the way leads onto the line or off it.
    """
    first, *middle, last = line
    on, off = lane.beside(first), lane.beside(last)
    if on is None or off is None:
        raise SubstrateError("no_path", "something stands where the way leads into the corridor, or out of it")
    stops = [on, *(point for point in middle if lane.free(*point)), off]
    return [(floor, leave, on), *((lane, a, b) for a, b in itertools.pairwise(stops)), (floor, off, arrive)]


def furniture(site: Site) -> list[tuple[Point, ...]]:
    """Return the outlines of everything fixed that stands on the floor."""
    outlines: list[tuple[Point, ...]] = []
    for s in site.surfaces.values():
        c, n = cos(s.yaw_rad), sin(s.yaw_rad)
        corners = (
            (-s.half_x_m, -s.half_y_m),
            (s.half_x_m, -s.half_y_m),
            (s.half_x_m, s.half_y_m),
            (-s.half_x_m, s.half_y_m),
        )
        outlines.append(tuple((s.x_m + c * x - n * y, s.y_m + n * x + c * y) for x, y in corners))
    for t in site.tools.values():
        outlines.append(
            (
                (t.x_m - 0.12, t.y_m - 0.30),
                (t.x_m + 0.12, t.y_m - 0.30),
                (t.x_m + 0.12, t.y_m + 0.08),
                (t.x_m - 0.12, t.y_m + 0.08),
            )
        )
    return outlines


def distance_to(outline: tuple[Point, ...], xs: NDArray[np.float64], ys: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance of points to a polygon, 0 inside."""
    best = np.full(xs.shape, 1e9)
    inside = np.zeros(xs.shape, dtype=bool)
    for (ax, ay), (bx, by) in zip(outline, (*outline[1:], outline[0]), strict=True):
        dx, dy = bx - ax, by - ay
        best = np.minimum(best, _to_segment((ax, ay), (bx, by), xs, ys))
        if dy != 0.0:
            inside ^= ((ay > ys) != (by > ys)) & (xs < dx * (ys - ay) / dy + ax)
    return np.where(inside, 0.0, best)


def _to_segment(start: Point, end: Point, xs: NDArray[np.float64], ys: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance of points to a line from one point to another."""
    (ax, ay), (bx, by) = start, end
    dx, dy = bx - ax, by - ay
    share = np.clip(((xs - ax) * dx + (ys - ay) * dy) / max(dx * dx + dy * dy, 1e-12), 0.0, 1.0)
    return np.hypot(xs - ax - share * dx, ys - ay - share * dy)


def _shut(zone: Zone, goal: Point) -> bool:
    if zone.kind == "shared":
        return False
    here = float(distance_to(zone.polygon, np.array([goal[0]]), np.array([goal[1]]))[0]) == 0.0
    return zone.kind == "forbidden" or not here


def _clear(floor: FloorMap, point: Point, least: list[float]) -> bool:
    """Tell whether a point is far enough from everything, each by its own distance."""
    return all(now >= enough - _ROUNDING_M for now, enough in zip(floor.distances(*point), least, strict=True))


def _back_off(floor: FloorMap, pose: Vec3, least: list[float]) -> Point | None:
    """Return the nearest free place straight behind a pose; None where something stands nearer to the way there."""
    for k in range(int(_UNDOCK_MAX_M / _UNDOCK_STEP_M)):
        x, y = pose[0] - k * _UNDOCK_STEP_M * cos(pose[2]), pose[1] - k * _UNDOCK_STEP_M * sin(pose[2])
        if not _clear(floor, (x, y), least):
            return None
        if floor.free(x, y):
            return x, y
    return None


def _along(corridor: Corridor, start: Point, end: Point) -> list[Point]:
    """Return the part of the corridor's centre line between the points nearest to start and end."""
    (s0, p0), (s1, p1) = _project(corridor.line, start), _project(corridor.line, end)
    marks = np.concatenate(
        (
            [0.0],
            np.cumsum(
                [hypot(b[0] - a[0], b[1] - a[1]) for a, b in zip(corridor.line, corridor.line[1:], strict=False)]
            ),
        )
    )
    between = [
        (float(m), point)
        for m, point in zip(marks, corridor.line, strict=True)
        if min(s0, s1) + 1e-6 < m < max(s0, s1) - 1e-6
    ]
    middle = [point for _, point in sorted(between, reverse=s0 > s1)]
    return [p0, *middle, p1]


def _project(line: tuple[Point, ...], point: Point) -> tuple[float, Point]:
    best, along, done = (1e9, 0.0, line[0]), 0.0, 0.0
    for a, b in itertools.pairwise(line):
        dx, dy = b[0] - a[0], b[1] - a[1]
        length = hypot(dx, dy)
        share = ((point[0] - a[0]) * dx + (point[1] - a[1]) * dy) / (length**2 or 1.0)  # a point may be named twice
        share = min(max(share, 0.0), 1.0)
        at = (a[0] + share * dx, a[1] + share * dy)
        along = done + share * length
        best = min(best, (hypot(point[0] - at[0], point[1] - at[1]), along, at))
        done += length
    return best[1], best[2]


def _walk_back(came: dict[tuple[int, int], tuple[int, int]], end: tuple[int, int]) -> list[tuple[int, int]]:
    cells = [end]
    while came[cells[-1]] != cells[-1]:
        cells.append(came[cells[-1]])
    return cells[::-1]


def _tidy(points: list[Point]) -> list[Point]:
    kept = [points[0]]
    for point in points[1:]:
        if hypot(point[0] - kept[-1][0], point[1] - kept[-1][1]) > 0.03:
            kept.append(point)
    kept[-1] = points[-1]
    return kept if len(kept) > 1 else [points[0], points[-1]]
