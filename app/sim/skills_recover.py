"""Skills of recovery: letting go and drawing back, and retracing the recorded safe path (rollback)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from app.cell.substrate import SubstrateError
from app.sim.body import CONTACT_SPEED_MPS, JOINT_SPEED_RADPS, Body, Moves, SkillFailed
from app.sim.hand import MARK_MAX, WIDER_M
from app.sim.localisation import wrapped
from app.sim.skills_arm import (
    HOVER_M,
    LIFT_M,
    PLACE_HIGH_M,
    contact_speed,
    down_to,
    grasp_object,
    number,
    put_down,
    resting_place,
    within_reach,
)
from app.sim.skills_drive import RECOVERY_BASE_SPEED_MPS, RECOVERY_TCP_SPEED_MPS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from app.governance.model import Json, Vec3
    from app.sim.hand import Mark

    Floats = NDArray[np.float64]

_GENTLE_POINTS = 12
_ON_MARKS = 0.9  # the recorded way is a polygon: the hand is a little faster on it than along a smooth line
_APART_M, _APART_RAD = 0.03, 0.05
_LOWER_M = 0.01
_CAREFUL_RADPS = 0.1  # servos that run ahead of what they are told do so by a share of the joints' speed
_STANDS_RAD, _SHARP = 1e-4, 0.85  # a turn of more than 30 degrees is sharp


def release_and_retract(body: Body, params: Mapping[str, Json]) -> Moves:
    """Put down what is held onto what is below, open, rise, and draw the arm in.

    Raises:
        SubstrateError: `placement_failed`, nothing is below: what is held stays held.
    """
    speed = number(params, "speed_mps", RECOVERY_TCP_SPEED_MPS)
    return _release(body, resting_place(body), speed)


def _release(body: Body, below: float | None, limit_mps: float) -> Moves:
    speed = body.speed(limit_mps)
    hand = body.senses.hand
    put = False
    if body.holding and hand is not None and below is not None:
        try:
            yield from put_down(body, below, hand, limit_mps)
            put = True
        except SkillFailed as failed:
            if failed.failure != "object_lost":
                raise
            body.senses.hand = None  # it slid out on the way down: what was to be let go of is gone already
    if not put:
        body.enter("release", 0.2)
        yield from body.open()
        body.senses.hand = None
        body.senses.tare()
        body.enter("retreat", 0.5)
        yield from _rise(body, limit_mps)
    body.enter("retract", 0.8)
    yield from body.retract(speed)
    yield from body.wait(0.2)


def _rise(body: Body, limit_mps: float) -> Moves:
    """Draw the open hand back: by the way it came, if that is one for an empty hand, and else straight up.

    What the hand has met may hang above it as well, and an arm that is stretched out may reach no higher; the way it
    came is free, and within reach.
    """
    speed = min(body.speed(limit_mps), CONTACT_SPEED_MPS)
    way = _way_it_came(body)
    for stretch in _stretches(way):
        yield from body.follow(stretch, _ON_MARKS * speed)
    if not way:
        here = body.pose
        yield from body.line(here._replace(z_m=here.z_m + HOVER_M), speed)


def _way_it_came(body: Body) -> list[Floats]:
    """Return the arm's way backwards until the hand is clear; empty where that leads down, or to where it took hold."""
    here, points = body.pose, [body.joints]
    if len(body.senses.trail) >= MARK_MAX:
        return []
    for mark in reversed(_split(list(body.senses.trail))[1]):
        at = body.senses.solver.forward(mark.joints)
        if mark.driving or mark.holding or at.z_m < here.z_m - _LOWER_M:
            break
        points.append(mark.joints)
        if hypot(at.x_m - here.x_m, at.y_m - here.y_m, at.z_m - here.z_m) >= HOVER_M:
            return _thinned(points)
    return []


def regrasp(body: Body, params: Mapping[str, Json]) -> Moves:
    """Let go of what has slipped, rise, find it where it lies, and take hold of it again.

    Raises:
        SubstrateError: `placement_failed`, nothing is below: what is held stays held.
    """
    return _regrasp(body, params, resting_place(body), number(params, "speed_mps", RECOVERY_TCP_SPEED_MPS))


def _regrasp(body: Body, params: Mapping[str, Json], below: float | None, limit_mps: float) -> Moves:
    body.stretch = (0.0, 0.5)
    yield from _release(body, below, limit_mps)  # with the arm drawn in, the cameras see the bench
    body.stretch = (0.5, 1.0)
    try:
        again = grasp_object(body, params)
    except SubstrateError as error:
        raise SkillFailed(error.failure, error.detail) from error
    yield from again


def retrace(body: Body, params: Mapping[str, Json]) -> Moves:
    """Go the recorded safe path backwards, put the object back where it was taken from, and draw back.

    A recovery draws the arm in: what the arm did until then is undone, and of that part of the path only where the base
    stood is retraced, with the arm drawn in.

    Raises:
        SubstrateError: `no_path`, the path was longer than what is recorded of one: nothing leads from here to its end.
    """
    if len(body.senses.trail) >= MARK_MAX:
        detail = f"the way here is longer than its record of {MARK_MAX} points: a human has to lead the robot back"
        raise SubstrateError("no_path", detail)
    return _retrace(body, _joined(body.senses.trail), number(params, "speed_mps", RECOVERY_TCP_SPEED_MPS))


def _retrace(body: Body, trail: list[Mark], limit_mps: float) -> Moves:
    stands, since = _split(trail)
    body.enter("retrace", 0.1)
    yield from _undo(body, since, limit_mps)
    if stands:
        yield from body.retract(body.speed(limit_mps))
        body.enter("retrace", 0.6)
        yield from body.drive_poses(stands, min(body.speed(limit_mps), RECOVERY_BASE_SPEED_MPS))
    if trail and trail[0].holding:  # it began with this in its hand, and so it ends
        yield from body.wait(0.2)
        return
    yield from _give_back(body, limit_mps)


def _joined(trail: list[Mark]) -> list[Mark]:
    """Return the recorded path without what was gone back of it already.

    Going back is not recorded. Whoever took the controls in the middle of it went on from there: the path leaps from
    its far end to that place, and back it would lead to that end first, and straight there.
    """
    joined: list[Mark] = []
    for mark in trail:
        if mark.leaps:
            near = [(_between(other, mark), k) for k, other in enumerate(joined) if other.holding == mark.holding]
            del joined[min(near)[1] + 1 if near else len(joined) :]
        joined.append(mark)
    return joined


def _between(mark: Mark, other: Mark) -> float:
    """Return how far two marks are apart, in metres and radians together."""
    dx, dy, turn = mark.base[0] - other.base[0], mark.base[1] - other.base[1], wrapped(mark.base[2] - other.base[2])
    return hypot(dx, dy) + abs(turn) + float(np.abs(mark.joints - other.joints).max())


def _split(trail: list[Mark]) -> tuple[list[Vec3], list[Mark]]:
    """Return the poses of the base to go back through from where the last recovery ended, and the marks since then.

    Poses are newest first; those that say nothing new are left out. None where no recovery moved.
    """
    recovered = [k for k, mark in enumerate(trail) if mark.recovering]
    if not recovered:
        return [], trail
    stands = [trail[recovered[-1]].base]
    for mark in trail[recovered[-1] :: -1]:
        if _apart(mark.base, stands[-1]):
            stands.append(mark.base)
    return [*stands, trail[0].base], trail[recovered[-1] + 1 :]


def _apart(pose: Vec3, other: Vec3) -> bool:
    return hypot(pose[0] - other[0], pose[1] - other[1]) > _APART_M or abs(wrapped(pose[2] - other[2])) > _APART_RAD


def _spaced(poses: list[Vec3]) -> list[Vec3]:
    """Leave out poses that say nothing new: a base that hardly moved would follow the noise of its own position."""
    kept = [poses[0]]
    for pose in poses[1:-1]:
        if _apart(pose, kept[-1]):
            kept.append(pose)
    return [*kept, poses[-1]]


def _undo(body: Body, trail: list[Mark], limit_mps: float) -> Moves:
    """Follow the marks backwards; what was taken on them is put back where it was taken.

    A hand that was shut on nothing is opened where it was shut: what it passed before stood between its fingers.
    """
    taken = _taken_at(trail) if body.holding else None
    if taken is not None:
        yield from _back(body, trail[taken:], limit_mps, gentle=True)
        stood_m = body.senses.solver.forward(trail[taken].joints).z_m
        yield from down_to(body, stood_m, contact_speed(body, limit_mps))
        if body.seen.tcp_m[2] > stood_m + PLACE_HIGH_M:
            raise SkillFailed("placement_failed", "something stands where what is held was taken from")
        body.enter("put_back", 0.5)
        yield from body.open()
        body.senses.hand = None
        body.senses.tare()
        trail = trail[: taken + 1]
        body.enter("retreat", 0.6)
    elif (shut := _shut_at(body, trail)) is not None:
        yield from _back(body, trail[shut:], limit_mps, gentle=False)
        yield from body.open()
        trail = trail[: shut + 1]
    yield from _back(body, trail, limit_mps, gentle=False)


def _give_back(body: Body, limit_mps: float) -> Moves:
    """Put what is still held where it was taken, if that is in reach, and draw the arm in."""
    hand = body.senses.hand
    if body.holding and hand is not None and within_reach(*body.relative(hand.x_m, hand.y_m)):
        body.enter("put_back", 0.7)
        here = body.relative(hand.x_m, hand.y_m)
        over = body.pose._replace(x_m=here[0], y_m=here[1], z_m=hand.support_z_m + hand.above_support_m + LIFT_M)
        yield from body.approach(over, body.speed(limit_mps))
        yield from put_down(body, hand.support_z_m, hand, limit_mps)
    body.enter("retract", 0.9)
    yield from body.retract(body.speed(limit_mps))
    yield from body.wait(0.2)


def _taken_at(trail: list[Mark]) -> int | None:
    """Return the mark at which the pads first held what they hold now, or None where they held it from the start."""
    empty = [k for k, mark in enumerate(trail) if not mark.holding]
    return min(empty[-1] + 1, len(trail) - 1) if empty else None


def _shut_at(body: Body, trail: list[Mark]) -> int | None:
    """Return the mark at which the hand was last open wider than now; None where it was not, or holds something."""
    if body.holding:
        return None
    wider = (k for k, mark in enumerate(trail) if mark.width_m > body.seen.grip_width_m + WIDER_M and not mark.holding)
    return max(wider, default=None)


def _back(body: Body, trail: list[Mark], limit_mps: float, *, gentle: bool) -> Moves:
    """Follow marks backwards: arm and base in turns, as they were recorded."""
    marks = trail[::-1]
    k = 0
    while k < len(marks) - 1:
        base = marks[k].driving
        end = k + 1
        while end < len(marks) - 1 and marks[end].driving == base:
            end += 1
        if base:
            stands = _spaced([mark.base for mark in marks[k : end + 1]])
            yield from body.drive_poses(stands, min(body.speed(limit_mps), RECOVERY_BASE_SPEED_MPS))
        else:
            yield from _back_arm(
                body,
                _thinned([mark.joints for mark in marks[k : end + 1]]),
                limit_mps,
                gentle=gentle and end == len(marks) - 1,
            )
        k = end


def _back_arm(body: Body, points: list[Floats], limit_mps: float, *, gentle: bool) -> Moves:
    points = [body.joints, *points]
    speed = _ON_MARKS * body.speed(limit_mps)
    split = max(0, len(points) - _GENTLE_POINTS) if gentle else len(points) - 1
    for stretch in _stretches(points[: split + 1]):
        yield from body.follow(stretch, speed, joint_radps=_CAREFUL_RADPS if body.careful else JOINT_SPEED_RADPS)
    if not gentle:
        return
    yield from body.follow(points[split:], min(speed, 0.9 * CONTACT_SPEED_MPS), until=lambda: body.touched(12.0))


def _stretches(points: list[Floats]) -> list[list[Floats]]:
    """Cut a way where it turns sharply: the arm has to stand still there, or it overshoots its speed in the turn."""
    cuts, before = [0], None
    for k, (a, b) in enumerate(itertools.pairwise(points)):
        step = b - a
        length = float(np.linalg.norm(step))
        if length < _STANDS_RAD:
            continue
        if before is not None and float(before @ step) < _SHARP * float(np.linalg.norm(before)) * length:
            cuts.append(k)
        before = step
    cuts.append(len(points) - 1)
    return [points[a : b + 1] for a, b in itertools.pairwise(cuts) if b > a]


def _thinned(points: list[Floats]) -> list[Floats]:
    kept = [points[0]]
    for point in points[1:-1]:
        if float(np.abs(point - kept[-1]).max()) > 0.01:
            kept.append(point)
    return [*kept, points[-1]]
