"""How fast a robot that is driven by hand may near what is known to stand about it.

Nothing plans the way of a hand on the controls, and no sensor feels what the base or the side of the arm meets before
it has been met. So what the site names and what the robot has seen holds a hand's driving: the base comes no nearer to
it than a planned way does, and the tool, which has to be led up to things, comes up to them as slowly as in any skill.
Only nearing something is held: away from it, and along it, both go as fast as they may.
"""

from __future__ import annotations

import itertools
from math import cos, hypot, inf, sin
from typing import TYPE_CHECKING, Final, NamedTuple

from app.governance.model import CONTROL_PERIOD_S
from app.sim.body import CONTACT_NEAR_M, CONTACT_SPEED_MPS, MARGIN, from_segment
from app.sim.navigation import furniture
from app.sim.robot import BASE_RADIUS_M
from app.sim.world import CRATE_HALF_M, LEVER_LENGTH_M, TOP_THICKNESS_M

if TYPE_CHECKING:
    from collections.abc import Iterator

    from app.governance.model import Point, Site, Vec3
    from app.sim.perception import Perception

STANDOFF_M: Final = 0.02  # of the base's circle: at a bench it docks with 3 cm left, and knows where it is within one
BASE_LEFT_S, HAND_LEFT_S = 0.4, 0.15  # what is left of a way is driven in no less; a base is behind its command
TOUCHING_MPS: Final = MARGIN * CONTACT_SPEED_MPS
PUSHING_MPS: Final = 0.4 * TOUCHING_MPS  # of a hand that the base takes along: all of its weight comes behind it
_HAND_M, _TIP_M, _PALM_M = 0.07, 0.015, 0.165  # to the sides, and from the tool centre down and up
_RESTS_M = 0.005  # what is held and stands on something is no deeper in it than that


class Block(NamedTuple):
    """Something that stands: its middle, half its extent along x and y of the world, and from where up to where."""

    x_m: float
    y_m: float
    half_x_m: float
    half_y_m: float
    low_m: float
    high_m: float


def blocks(site: Site, perception: Perception, held: str | None) -> Iterator[Block]:
    """Yield what a tool can be led against: tops of furniture, tools, crates, and objects where they were seen last."""
    for top in site.surfaces.values():
        half_x, half_y = _turned(top.half_x_m, top.half_y_m, top.yaw_rad)
        yield Block(top.x_m, top.y_m, half_x, half_y, top.z_m - 2 * TOP_THICKNESS_M, top.z_m)
    for tool in site.tools.values():
        half = LEVER_LENGTH_M / 2
        yield Block(tool.x_m, tool.y_m, half, half, 0.0, tool.z_m + half)
    for x, y in perception.crates:
        yield Block(x, y, *CRATE_HALF_M[:2], 0.0, 2 * CRATE_HALF_M[2])
    for name, seen in perception.memory.items():
        if name != held:
            rx, ry, high = site.objects[name].size_m
            if not seen.upright:
                rx, ry, high = high, max(rx, ry), min(rx, ry)  # the heading of what lies is that of its long axis
            half_x, half_y = _turned(rx, ry, seen.yaw_rad)
            yield Block(seen.x_m, seen.y_m, half_x, half_y, seen.z_m - high, seen.z_m + high)


def hand_share(tool: Vec3, velocity: Vec3, hangs_m: float, around: Iterator[Block], touching_mps: float) -> float:
    """Return what share of its velocity leaves a tool no faster than it may touch what it nears.

    Args:
        tool: Where it is, in the world.
        velocity: Where it goes, the base's motion included.
        hangs_m: How far below it reaches what it holds.
        around: What stands.
        touching_mps: How fast it may touch that.
    """
    x, y, z = tool
    vx, vy, vz = velocity
    share, speed = 1.0, hypot(vx, vy, vz)
    ahead = (x + vx * CONTROL_PERIOD_S, y + vy * CONTROL_PERIOD_S, z + vz * CONTROL_PERIOD_S)
    for block in around:
        gap = _apart(tool, hangs_m, block)
        nearing = (gap - _apart(ahead, hangs_m, block)) / CONTROL_PERIOD_S
        if gap < -_RESTS_M and nearing >= 0.0:  # the hand is around it, or at its edge: any way but out may be onto it
            nearing = speed
        may = touching_mps + max(gap - CONTACT_NEAR_M, 0.0) / HAND_LEFT_S
        share = min(share, may / nearing) if nearing > may else share
    return share


def held_off(site: Site, perception: Perception, pose: Vec3, velocity: Vec3) -> Vec3:
    """Return a velocity of the base, in its own frame, without what would take it nearer to anything than it may come.

    Args:
        site: What stands about, and where the room ends.
        perception: Which crates were seen.
        pose: Where the base believes to be.
        velocity: What is wanted.
    """
    x, y, yaw = pose
    vx, vy, wz = velocity
    c, s = cos(yaw), sin(yaw)
    wx, wy = c * vx - s * vy, s * vx + c * vy
    for nx, ny, far_m in _nearest(site, perception, x, y):
        toward = -(nx * wx + ny * wy)
        over = toward - max(far_m - BASE_RADIUS_M - STANDOFF_M, 0.0) / BASE_LEFT_S
        if over > 0.0 and toward > 0.0:
            wx, wy = wx + over * nx, wy + over * ny
    return c * wx + s * wy, c * wy - s * wx, wz


def _apart(tool: Vec3, hangs_m: float, block: Block) -> float:
    """Return how far a hand is from a block; below 0 where they overlap, by as much as would part them."""
    x, y, z = tool
    aside_x, aside_y = abs(x - block.x_m) - block.half_x_m, abs(y - block.y_m) - block.half_y_m
    aside = _outside(aside_x, aside_y) - _HAND_M
    return _outside(aside, max(z - max(_TIP_M, hangs_m) - block.high_m, block.low_m - z - _PALM_M))


def _outside(one: float, other: float) -> float:
    """Return how far outside something is that is so far beyond one side and another; below 0 within both."""
    largest = max(one, other)
    return largest if largest <= 0.0 else hypot(max(one, 0.0), max(other, 0.0))


def _turned(half_x_m: float, half_y_m: float, yaw_rad: float) -> Point:
    c, s = abs(cos(yaw_rad)), abs(sin(yaw_rad))
    return c * half_x_m + s * half_y_m, s * half_x_m + c * half_y_m


def _nearest(site: Site, perception: Perception, x: float, y: float) -> Iterator[Vec3]:
    """Yield of everything on the floor, and of the walls, the way from it to a point: its direction and length."""
    x0, y0, x1, y1 = site.bounds_m
    yield from ((1.0, 0.0, x - x0), (-1.0, 0.0, x1 - x), (0.0, 1.0, y - y0), (0.0, -1.0, y1 - y))
    half = CRATE_HALF_M[0]
    crates = (
        ((cx - half, cy - half), (cx + half, cy - half), (cx + half, cy + half), (cx - half, cy + half))
        for cx, cy in perception.crates
    )
    for outline in (*furniture(site), *crates):
        nearest, dx, dy = inf, 0.0, 0.0
        for start, end in itertools.pairwise((*outline, outline[0])):
            ax, ay = from_segment((x, y), start, end)
            if (far := hypot(ax, ay)) < nearest:
                nearest, dx, dy = far, ax, ay
        if nearest > 0.0:
            yield dx / nearest, dy / nearest, nearest
