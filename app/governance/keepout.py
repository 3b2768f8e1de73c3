"""Zones the base keeps out of: how far it is from one, on the way to where braking would end."""

from __future__ import annotations

import math
from math import hypot
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

if TYPE_CHECKING:
    from app.governance.model import Zone


Pair: TypeAlias = "tuple[float, float]"


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


def _to_segment(x: float, y: float, x0: float, y0: float, x1: float, y1: float) -> float:
    ex, ey = x1 - x0, y1 - y0
    length = ex * ex + ey * ey
    along = ((x - x0) * ex + (y - y0) * ey) / length if length > 0.0 else 0.0
    along = 0.0 if along < 0.0 else min(along, 1.0)
    return hypot(x - x0 - along * ex, y - y0 - along * ey)
