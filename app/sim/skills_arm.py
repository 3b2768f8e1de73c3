"""Skills of the arm: looking over an area, grasping, placing. All of it happens by contact."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from math import cos, hypot, isnan, pi, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from app.cell.substrate import SubstrateError
from app.sim.body import CONTACT_NEAR_M, CONTACT_SPEED_MPS, Body, Moves, SkillFailed, near_segment
from app.sim.hand import Hand, on_surface, support
from app.sim.kinematics import ToolPose
from app.sim.localisation import to_world, wrapped
from app.sim.perception import Glimpse

if TYPE_CHECKING:
    from app.governance.model import Command, Json, Point, SiteObject, Surface
    from app.sim.perception import Seen

HOVER_M, LIFT_M, GRIP_DEPTH_M = 0.10, 0.12, 0.06
REACH_MIN_M, REACH_MAX_M = 0.42, 0.95
LOCALISE_S, MISMATCH_M, PLACED_WITHIN_M = 0.3, 0.15, 0.06
SLIPPED_MAX_M = 0.05
PLACE_GAP_M, PLACE_TOUCH_N, PLACE_HIGH_M, SPOT_FREE_M, SURFACE_MARGIN_M = 0.002, 12.0, 0.02, 0.15, 0.07
HANGS_M, LOWERINGS = 0.005, 4  # of what hangs higher than it was to stand, and how often it is led down by as much
OPEN_HAND_M = 0.09  # half of its width, and what cameras are off by
FINGER_M = 0.02  # half of its depth, and what cameras are off by
BESIDE_M = 0.02  # at least, between what stands and what is put beside it, or carried over it
SEEN_FROM_M, SEEN_FROM_RAD = 0.3, 0.3  # how far off its stand an area is still seen; `area_in_view` asks for less
TRAVEL_SPEED_MPS = 0.20  # of the arm, where a skill's own speed is the base's
_LOOK_HEIGHT_M, _LOOK_FORWARD_M, _LOOK_ASIDE_M = 0.42, 0.55, (-0.3, 0.0, 0.3)
_SPOTS = tuple((x, y) for x in (0.64, 0.72) for y in (0.0, 0.16, -0.16, 0.32, -0.32))


class Grip(NamedTuple):
    """How to grasp an object: tool pose at closing."""

    pose: ToolPose
    top_m: float


def number(params: Mapping[str, Json], name: str, default: float) -> float:
    """Return a numeric parameter."""
    value = params.get(name)
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else default


def inspect_area(body: Body, params: Mapping[str, Json]) -> Moves:
    """Look over an area with the wrist from the place where it is seen."""
    site = body.senses.site
    area = site.areas[str(params["area"])]
    target = site.targets[area.target]
    x, y, yaw = body.senses.believed_pose()
    if hypot(target.x_m - x, target.y_m - y) > SEEN_FROM_M or abs(wrapped(target.yaw_rad - yaw)) > SEEN_FROM_RAD:
        raise SubstrateError("unreachable", f"`{area.name}` is seen from `{target.name}`: drive there first")
    middle = (sum(p[0] for p in area.polygon) / len(area.polygon), sum(p[1] for p in area.polygon) / len(area.polygon))
    surface = support(site, *middle)
    return _look_over(body, area.name, surface.z_m if surface else 0.0, number(params, "dwell_s", 1.0))


def _look_over(body: Body, area: str, surface_z_m: float, dwell_s: float) -> Moves:
    senses = body.senses
    speed = body.speed(TRAVEL_SPEED_MPS)
    senses.perception.forget_area(senses.site.areas[area])
    for k, aside in enumerate(_LOOK_ASIDE_M):
        body.enter("look", k / len(_LOOK_ASIDE_M))
        yield from body.approach(ToolPose(_LOOK_FORWARD_M, aside, surface_z_m + _LOOK_HEIGHT_M, 0.0), speed)
        for command in body.wait(dwell_s * (2.0 if body.careful else 1.0) / len(_LOOK_ASIDE_M) + 0.15):
            senses.sweep(area, surface_z_m)
            yield command
    if area not in senses.perception.inspected:
        raise SkillFailed("perception_mismatch", f"parts of `{area}` stayed out of sight")
    body.enter("retract", 0.9)
    yield from body.retract(speed)


# -- grasping ------------------------------------------------------------------------------------------------


def grasp_object(body: Body, params: Mapping[str, Json]) -> Moves:
    """Close the gripper on an object and lift it clear of its support."""
    name = str(params["object_id"])
    thing = body.senses.site.objects[name]
    seen = body.senses.perception.memory.get(name)
    if seen is None:
        raise SubstrateError("object_not_found", f"`{name}` has not been seen yet: inspect the area where it may be")
    x, y = body.relative(seen.x_m, seen.y_m)
    if not within_reach(x, y):
        raise SubstrateError(
            "unreachable", f"`{name}` is {hypot(x, y):.2f} m from the base: drive to where it is in reach"
        )
    resting_place(body)
    force = number(params, "force_n", 40.0) * 0.98
    return _grasp(
        body,
        thing,
        Glimpse(x, y, seen.z_m, wrapped(seen.yaw_rad - body.senses.believed_pose()[2]), seen.upright, 0.01),
        force,
        number(params, "speed_mps", 0.3),
    )


def _grasp(body: Body, thing: SiteObject, guess: Glimpse, force_n: float, limit_mps: float) -> Moves:
    speed, slow = body.speed(limit_mps), contact_speed(body, limit_mps)
    body.enter("approach", 0.0)
    yield from _emptied(body, limit_mps)
    grip = grip_for(thing, guess)
    yield from body.approach(grip.pose._replace(z_m=_hover(body, thing, grip)), speed)
    body.enter("localise", 0.3)
    found = yield from localise(body, thing.name)
    if hypot(found.x_m - guess.x_m, found.y_m - guess.y_m) > MISMATCH_M:
        raise SkillFailed("perception_mismatch", f"`{thing.name}` is not where it was remembered")
    grip = grip_for(thing, found)
    yield from body.line(grip.pose._replace(z_m=_hover(body, thing, grip)), speed)
    body.enter("descend", 0.45)
    near = max(grip.pose.z_m, _top_beside(body, thing, grip)) + CONTACT_NEAR_M
    yield from body.line(grip.pose._replace(z_m=near), speed)
    yield from body.line(grip.pose, slow, until=body.touched)
    if body.touched():
        raise SkillFailed("grasp_failed", "the fingers met something on the way down")
    body.enter("close", 0.6)
    yield from body.close(force_n, taken=lambda: remember_grip(body, thing, found))
    body.enter("lift", 0.75)
    here = body.pose
    lost = _loss_of(body)
    for height, pace in ((0.02, slow), (LIFT_M, speed)):
        yield from body.line(here._replace(z_m=here.z_m + height), pace, until=lost)
        if lost():
            raise SkillFailed("object_lost", f"the grip holds `{thing.name}` no more")
    body.enter("verify", 0.95)
    yield from body.wait(0.3)
    if not body.holding:
        raise SkillFailed("object_lost", f"the grip holds `{thing.name}` no more")
    body.senses.tare()
    yield from body.wait(0.1)


def _emptied(body: Body, limit_mps: float) -> Moves:
    """Open the hand; what an attempt before this one left in it is put down first."""
    below, hand = resting_place(body), body.senses.hand
    if below is not None and hand is not None:
        body.enter("descend", 0.0)
        yield from _lower(body, below, hand, limit_mps)
        yield from _set_free(body)
        body.enter("approach", 0.0)
        yield from _withdraw(body, limit_mps)
    yield from body.open()


def _loss_of(body: Body) -> Callable[[], bool]:
    """Return a check that counts how long the pads have been empty: five ticks are a loss."""
    empty = 0

    def lost() -> bool:
        nonlocal empty
        empty = 0 if body.holding else empty + 1
        return empty >= 5

    return lost


def localise(body: Body, name: str) -> Generator[Command, None, Glimpse]:
    """Stand still over an object and average what the wrist camera sees; returns the glimpse."""
    shots: list[Glimpse] = []
    for command in body.wait(LOCALISE_S * (2.0 if body.careful else 1.0)):
        shot = body.senses.glimpse(name)
        if shot is not None:
            shots.append(shot)
        yield command
    if len(shots) < 10:
        raise SkillFailed("object_not_found", f"`{name}` is not where it was remembered")
    turn = shots[0].yaw_rad
    mean = np.array([(s.x_m, s.y_m, s.z_m, wrapped(s.yaw_rad - turn)) for s in shots]).mean(axis=0)
    return Glimpse(
        float(mean[0]),
        float(mean[1]),
        float(mean[2]),
        wrapped(turn + float(mean[3])),
        shots[-1].upright,
        shots[-1].sigma_m,
    )


def grip_for(thing: SiteObject, at: Glimpse) -> Grip:
    """Return where to close on an object: across its narrower side, from above, not deeper than the fingers reach."""
    rx, ry, _ = thing.size_m
    half_height = _half_height(thing, at.upright)
    if thing.shape == "cylinder":
        yaw = 0.0 if at.upright else at.yaw_rad
    else:
        yaw = at.yaw_rad if ry <= rx else at.yaw_rad + pi / 2
    yaw = (yaw + pi / 2) % pi - pi / 2  # a parallel gripper is the same turned by half a circle
    top = at.z_m + half_height
    return Grip(ToolPose(at.x_m, at.y_m, max(at.z_m, top - GRIP_DEPTH_M), yaw), top)


def _hover(body: Body, thing: SiteObject, grip: Grip) -> float:
    """Return how high the open hand is over a thing and over whatever stands beside it."""
    return max(grip.top_m + HOVER_M, _top_beside(body, thing, grip) + CONTACT_NEAR_M)


def _top_beside(body: Body, thing: SiteObject, grip: Grip) -> float:
    """Return how high what stands so near that the open hand may come down on it reaches; 0 where nothing does."""
    senses = body.senses
    x, y = to_world(senses.believed_pose(), grip.pose.x_m, grip.pose.y_m)
    tops = [
        seen.z_m + _half_height(other, seen.upright)
        for name, seen in senses.perception.memory.items()
        if name != thing.name
        and hypot(seen.x_m - x, seen.y_m - y) < OPEN_HAND_M + max((other := senses.site.objects[name]).size_m)
    ]
    return max(tops, default=0.0)


def _half_height(thing: SiteObject, upright: bool) -> float:
    """Return how far an object's top is above its middle, standing or lying."""
    rx, ry, rz = thing.size_m
    return rz if upright else min(rx, ry)


def remember_grip(body: Body, thing: SiteObject, found: Glimpse) -> None:
    """Keep what was taken, from where, and how high above its support it is held."""
    senses = body.senses
    pose = senses.believed_pose()
    x, y = to_world(pose, found.x_m, found.y_m)
    surface = support(senses.site, x, y)
    z = surface.z_m if surface else found.z_m - thing.size_m[2]
    senses.hand = Hand(thing.name, body.pose.z_m - z, x, y, wrapped(body.pose.yaw_rad + pose[2]), z)


# -- placing -------------------------------------------------------------------------------------------------


def place_object(body: Body, params: Mapping[str, Json]) -> Moves:
    """Put the held object down on a surface, at a point of it or at a free spot in reach."""
    site = body.senses.site
    surface = site.surfaces[str(params["surface"])]
    hand = body.senses.hand
    if hand is None or not body.holding:
        raise SubstrateError("object_lost", "the gripper holds nothing to place")
    x, y = number(params, "x_m", float("nan")), number(params, "y_m", float("nan"))
    spot = free_spot(body, surface) if isnan(x) or isnan(y) else (x, y)
    if spot is None or not on_surface(surface, *spot, margin_m=0.03):
        raise SubstrateError(
            "placement_failed",
            f"no such place on `{surface.name}`" if spot else f"no free place on `{surface.name}` in reach",
        )
    if (there := _standing_at(body, hand.name, spot)) is not None:
        raise SubstrateError("placement_failed", f"`{there}` stands there, as far as is known")
    if not within_reach(*body.relative(*spot)):
        raise SubstrateError(
            "unreachable", f"the place on `{surface.name}` is out of reach: drive to `{surface.target}` first"
        )
    return _place(body, surface.z_m, spot, hand, number(params, "speed_mps", 0.2))


def _place(body: Body, support_z_m: float, spot: Point, hand: Hand, limit_mps: float) -> Moves:
    body.enter("approach", 0.0)
    speed = body.speed(limit_mps)
    if (clear := _clear_of_others(body, support_z_m, spot, hand)) > LIFT_M:
        yield from body.line(body.pose._replace(z_m=support_z_m + hand.above_support_m + clear), speed)
    over = ToolPose(*body.relative(*spot), support_z_m + hand.above_support_m + LIFT_M, body.pose.yaw_rad)
    for command in body.approach(over, speed):
        if (there := _standing_at(body, hand.name, spot)) is not None:  # somebody has put it there since
            raise SkillFailed("placement_failed", f"`{there}` stands there")
        yield command
    yield from put_down(body, support_z_m, hand, limit_mps)
    body.enter("verify", 0.9)
    found = yield from localise(body, hand.name)
    x, y = to_world(body.senses.believed_pose(), found.x_m, found.y_m)
    if hypot(x - spot[0], y - spot[1]) > PLACED_WITHIN_M or not found.upright:
        raise SkillFailed("placement_failed", f"`{hand.name}` does not stand where it was put")


def _clear_of_others(body: Body, support_z_m: float, spot: Point, hand: Hand) -> float:
    """Return how high what is held has to hang over a support to pass over all that stands near its way to a spot."""
    senses = body.senses
    here = to_world(senses.believed_pose(), body.pose.x_m, body.pose.y_m)
    tops = [
        seen.z_m + _half_height(senses.site.objects[name], seen.upright) - support_z_m
        for name, seen in senses.perception.memory.items()
        if name != hand.name and near_segment((seen.x_m, seen.y_m), here, spot) < SPOT_FREE_M
    ]
    return max(tops, default=0.0) + BESIDE_M


def resting_place(body: Body) -> float | None:
    """Return the height of what is below that the hand can put down on it what it holds; None where it holds nothing.

    Raises:
        SubstrateError: `placement_failed`, it holds something, and there is nothing below.
    """
    hand = body.senses.hand
    if hand is None or not body.holding:
        return None
    below = body.support_below()
    if below is None:
        raise SubstrateError("placement_failed", f"the hand holds `{hand.name}`, and nothing is below to put it on")
    return below


def put_down(body: Body, support_z_m: float, hand: Hand, limit_mps: float) -> Moves:
    """Lower what is held onto the support below, let go, and rise."""
    body.enter("descend", 0.4)
    yield from _lower(body, support_z_m, hand, limit_mps)
    body.enter("release", 0.6)
    yield from _set_free(body)
    body.enter("retreat", 0.75)
    yield from _withdraw(body, limit_mps)


def _lower(body: Body, support_z_m: float, hand: Hand, limit_mps: float) -> Moves:
    # What has slipped hangs lower in the grip than it was taken: put down as if it had not, it would be pressed down.
    here, floor = body.pose, support_z_m + hand.above_support_m + PLACE_GAP_M + min(body.seen.slip_m, SLIPPED_MAX_M)
    if here.z_m > floor + CONTACT_NEAR_M:
        yield from body.line(here._replace(z_m=floor + CONTACT_NEAR_M), body.speed(limit_mps))
    if not body.holding:
        raise SkillFailed("object_lost", f"the grip holds `{hand.name}` no more")
    slow = contact_speed(body, limit_mps)
    yield from body.line(here._replace(z_m=floor), slow, until=lambda: body.touched(PLACE_TOUCH_N))
    yield from down_to(body, floor, slow)
    if body.seen.tcp_m[2] > floor + PLACE_HIGH_M:  # let go of up here it would fall, or stand on what is no support
        raise SkillFailed("placement_failed", f"something stands where `{hand.name}` was to be put down")


def down_to(body: Body, floor_z_m: float, slow_mps: float) -> Moves:
    """Wait until the tool stands, and lead it on down where that is too high.

    Servos that run ahead of what they are told touch down early, and draw back to where they were told to be once they
    rest: what is let go of then falls.
    """
    yield from body.arrived()
    for _ in range(LOWERINGS):
        high_m = body.seen.tcp_m[2] - floor_z_m
        if high_m < HANGS_M:
            return
        here = body.pose
        yield from body.line(here._replace(z_m=here.z_m - high_m), slow_mps, until=lambda: body.touched(PLACE_TOUCH_N))
        yield from body.arrived()


def _set_free(body: Body) -> Moves:
    yield from body.open()
    body.senses.hand = None
    body.senses.tare()


def _withdraw(body: Body, limit_mps: float) -> Moves:
    up = body.pose
    yield from body.line(up._replace(z_m=up.z_m + 0.04), contact_speed(body, limit_mps))
    yield from body.line(up._replace(z_m=up.z_m + HOVER_M + 0.06), body.speed(limit_mps))


def contact_speed(body: Body, limit_mps: float) -> float:
    """Return how fast the tool goes where it touches things."""
    return min(body.speed(limit_mps), CONTACT_SPEED_MPS * (0.5 if body.careful else 0.95))


def _standing_at(body: Body, held: str, spot: Point) -> str | None:
    """Return what is remembered to stand where the object in the hand is to stand, or where the hand has to open."""
    senses = body.senses
    things = senses.site.objects
    half_m = min(things[held].size_m[:2]) + BESIDE_M
    across = senses.believed_pose()[2] + body.pose.yaw_rad + pi / 2  # fingers open to both sides
    fingers = _reaching(spot, OPEN_HAND_M - FINGER_M, across)
    for name, seen in senses.perception.memory.items():
        if name == held:
            continue
        lies, thick_m = _footprint(things[name], seen)
        hand_m = min(*(near_segment(end, *lies) for end in fingers), *(near_segment(end, *fingers) for end in lies))
        if near_segment(spot, *lies) < half_m + thick_m or hand_m < FINGER_M + thick_m:
            return name
    return None


def _footprint(thing: SiteObject, seen: Seen) -> tuple[tuple[Point, Point], float]:
    """Return the line that an object's outline lies around, and how far around it."""
    rx, ry, rz = thing.size_m
    if not seen.upright:
        rx, ry = rz, min(rx, ry)  # the heading of what lies is that of its long axis
    thick_m = min(rx, ry)
    return _reaching((seen.x_m, seen.y_m), max(rx, ry) - thick_m, seen.yaw_rad + (0.0 if rx >= ry else pi / 2)), thick_m


def _reaching(middle: Point, half_m: float, heading_rad: float) -> tuple[Point, Point]:
    dx, dy = half_m * cos(heading_rad), half_m * sin(heading_rad)
    return (middle[0] - dx, middle[1] - dy), (middle[0] + dx, middle[1] + dy)


def free_spot(body: Body, surface: Surface) -> Point | None:
    """Return the nearest free place in reach, away from everything remembered."""
    senses = body.senses
    others = [
        (s.x_m, s.y_m)
        for name, s in senses.perception.memory.items()
        if senses.hand is None or name != senses.hand.name
    ]
    for x, y in _SPOTS:
        at = to_world(senses.believed_pose(), x, y)
        if (
            on_surface(surface, *at, margin_m=SURFACE_MARGIN_M)
            and all(hypot(at[0] - ox, at[1] - oy) > SPOT_FREE_M for ox, oy in others)
            and (senses.hand is None or _standing_at(body, senses.hand.name, at) is None)
        ):
            return at
    return None


def within_reach(x_m: float, y_m: float) -> bool:
    """Tell whether the arm gets at a point over a bench, relative to the base."""
    return x_m > REACH_MIN_M and hypot(x_m, y_m) < REACH_MAX_M
