"""Zones the base keeps out of: how far the hull stays from them on the way to where braking would end."""

from __future__ import annotations

import math
from math import cos, hypot, sin
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

if TYPE_CHECKING:
    from app.governance.estimation import BaseEstimate
    from app.governance.model import Observation, Vec3, Zone

Pair: TypeAlias = "tuple[float, float]"

REACTION_S: Final = 0.05  # from a violation to less speed: two ticks, the filter's lag and the drives'
EDGE_M: Final = 0.03
CREEP_MPS: Final = 0.01
LARGEST_BASE_SPEED_MPS: Final = 10.0


class Keepout(NamedTuple):
    """A zone with its bounding box and its edges (x0, y0, x1, y1), in m, world frame."""

    x0: float
    y0: float
    x1: float
    y1: float
    edges: tuple[tuple[float, float, float, float], ...]

    @classmethod
    def of(cls, zone: Zone) -> Keepout:
        """Work box and edges of a zone's polygon out."""
        corners = zone.polygon
        xs, ys = [x for x, _ in corners], [y for _, y in corners]
        around = zip(corners, (*corners[1:], corners[0]), strict=True)
        return cls(min(xs), min(ys), max(xs), max(ys), tuple((*a, *b) for a, b in around))

    def clearance(self, x: float, y: float, ahead_x: float, ahead_y: float) -> float:
        """Return the distance from the way ahead to the zone; negative inside."""
        here, there = self._signed(x, y), self._signed(x + ahead_x, y + ahead_y)
        least = min(here, there)
        if least <= 0.0:
            return least
        for x0, y0, _, _ in self.edges:  # a corner may reach into the way between its ends
            least = min(least, _to_segment(x0, y0, x, y, x + ahead_x, y + ahead_y))
        return least

    def _signed(self, x: float, y: float) -> float:
        inside, least = False, math.inf
        for x0, y0, x1, y1 in self.edges:
            least = min(least, _to_segment(x, y, x0, y0, x1, y1))
            if (y0 > y) != (y1 > y) and x < x0 + (y - y0) * (x1 - x0) / (y1 - y0):
                inside = not inside
        return -least if inside else least


def least_clearance(zone: Keepout, x: float, y: float, velocities: tuple[Pair, ...], reach_s: float) -> float:
    """Return the least distance from the ways that velocities lead in a time to a zone; NaN if one is no number."""
    least = math.inf
    for vx, vy in velocities:
        if (vx + vy) * reach_s - (vx + vy) * reach_s != 0.0:
            return math.nan
        least = min(least, zone.clearance(x, y, vx * reach_s, vy * reach_s))
    return least


def leaves(keepouts: tuple[Keepout, ...], x: float, y: float, velocity: Pair, reach_s: float) -> bool:
    """Say whether the base stands, or nears no zone: who was stopped at the edge has to be able to back out."""
    ahead_x, ahead_y = velocity[0] * reach_s, velocity[1] * reach_s
    return all(zone.clearance(x, y, ahead_x, ahead_y) >= zone.clearance(x, y, 0.0, 0.0) for zone in keepouts)


def turned(yaw_rad: float, velocity: Vec3) -> Pair:
    """Return a velocity of the base in the world frame."""
    vx, vy, _ = velocity
    c, s = cos(yaw_rad), sin(yaw_rad)
    return c * vx - s * vy, s * vx + c * vy


def slide(seen: Observation, before: Observation, base: BaseEstimate, base_speed_mps: float, velocity: Pair) -> Pair:
    """Return how fast the estimated position moves while the base drives: what odometry does in a tick, and its drift.

    Drift is never added to what the drives say: a bias of the odometry is no motion.
    """
    apart_s = seen.stamps_s.odometry - before.stamps_s.odometry
    if base_speed_mps > CREEP_MPS and apart_s > 0.0:
        x, y, _ = seen.odometry
        from_x, from_y, _ = before.odometry
        told_x, told_y = (x - from_x) / apart_s, (y - from_y) / apart_s
        rate_x = base.cosine * told_x - base.sine * told_y + base.drift_x_mps
        rate_y = base.sine * told_x + base.cosine * told_y + base.drift_y_mps
        # A jump is no motion: where the base is shows it. What is no number stays none.
        if not abs(rate_x) + abs(rate_y) > LARGEST_BASE_SPEED_MPS:
            return rate_x, rate_y
    return velocity


def near_zones(
    keepouts: tuple[Keepout, ...], at: Pair, velocity: Pair, slides: Pair, deceleration_mps2: float, radius_m: float
) -> float:
    """Return the least clearance between the hull and zones on the way to standstill, if braking began now.

    Two say where that leads, and the worse one counts: the drives (`velocity`), who know nothing of wheels that slip,
    and the rate of the estimated position (`slides`), which follows a bias of the odometry only as fast as fixes tell
    of it.
    """
    x, y = at
    speed = max(hypot(*velocity), hypot(*slides))
    reach_s = REACTION_S + speed / (2.0 * deceleration_mps2)
    margin_m = math.inf
    for zone in keepouts:
        clearance_m = least_clearance(zone, x, y, (velocity, slides), reach_s)
        if not clearance_m >= margin_m:
            margin_m = clearance_m
    margin_m -= radius_m
    # Stopped at the edge, the base stands within the noise of its own estimate: a violation again and again. While
    # it creeps that noise is more than its motion, so whether it backs out is for the drives to say.
    if -EDGE_M < margin_m < 0.0 and leaves(keepouts, x, y, velocity, reach_s):
        return 0.0
    return margin_m


def _to_segment(x: float, y: float, x0: float, y0: float, x1: float, y1: float) -> float:
    ex, ey = x1 - x0, y1 - y0
    length = ex * ex + ey * ey
    along = ((x - x0) * ex + (y - y0) * ey) / length if length > 0.0 else 0.0
    along = 0.0 if along < 0.0 else min(along, 1.0)
    return hypot(x - x0 - along * ex, y - y0 - along * ey)
