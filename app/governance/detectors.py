"""What the watcher measures in one tick: every signal that a watch rule can name, from sensors alone.

One function per detector. Each takes what it names, from the sensors (`seen`, and `before` a tick ago), what was told
(`command`, `report`), what the tick before left (`Senses`), the plan's constants (`plan`) and what detectors above
it found; and returns what `DETECTORS` says it gives. `fusing` makes one function of those that a plan needs, so what a
plan does not watch and no display shows costs nothing.

NaN never passes as well: what is not finite makes `implausible`, whatever its field.
"""

from __future__ import annotations

import math
from math import cos, dist, hypot, inf, nan, sin, sqrt
from typing import TYPE_CHECKING, Final

from app.governance.estimation import now, scattered, tcp_velocity, track_base, track_people
from app.governance.fusing import Part, parts
from app.governance.keepout import CREEP_MPS, LARGEST_BASE_SPEED_MPS, REACTION_S, near_zones, slide, turned
from app.governance.policy_model import WALKING_MPS
from app.governance.signals import FAR_M

if TYPE_CHECKING:
    from app.governance.estimation import BaseEstimate, PersonEstimate
    from app.governance.model import Command, Frames, Observation, SensorStamps, SkillReport, Vec6
    from app.governance.signals import Constants

NEAR_ZONE_M: Final = 1.5
HALTING_S: Final = 0.1  # the same, and what the drives take to follow
LEFT_M: Final = 0.85
"""What has to be left to the middle of a person, as trackers give it, once the robot stands: 0.25 m to a body of 0.25 m
radius, and what else they come nearer than was foreseen, since how fast somebody goes has to be learned first. Of the
79 walks in real-restricted on seeds for tuning that was 0.06 m at most."""
SLOWEST_WALK_MPS: Final = 0.6
"""Who comes slower is judged by where they are. Of somebody who stands the filter says as much at times (three σ), and
what somebody covers at that while the robot brakes, 0.4 m, is left over of a distance of 1 m."""
LEARNED_SAMPLES: Final = 6
"""How often somebody has to be seen before it is known how fast they come; until then they may come as fast as people
walk. After six samples the filter follows nine tenths of a speed that it has to learn from nothing."""
STUCK_TICKS: Final = 3  # readings carry noise: that two repeat bit by bit is chance, three in a row never are
HELD_TICKS: Final = 10
LOST_TICKS: Final = 3
FIST_M: Final = 0.008
PROGRESS_STEP: Final = 1e-4
FALLS_BACK: Final = 0.2
ON_TRACK_RAD: Final = 0.02
FIX_JUMP_M: Final = 0.3

LARGEST_JOINT_RAD: Final = 2 * math.pi + 0.1
LARGEST_JOINT_SPEED_RADPS: Final = 10.0
LARGEST_TORQUE_NM: Final = 1000.0
LARGEST_FORCE_N: Final = 20_000.0
LARGEST_WIDTH_M: Final = 0.5
LONGEST_REACH_M: Final = 3.0
LATEST_STAMP_S: Final = 0.1
FASTEST_FINGERS_MPS: Final = 2.5  # they snap shut at 1 m/s when 80 N lose what was between them
FINGERS_STEP_M: Final = 0.015  # less than that in a tick is not looked at closer
OFF_TRACK_RAD: Final = 0.05  # joints that have leapt are off their command at least by this
DOUBT_S: Final = 5.0
"""How long a reading that leapt is held against its sensor: it does not come right by staying where it leapt to, so
this is longer than any shipped profile waits (3 s) before it ends the session or asks a human."""

STILL: Final = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
RESTING: Final = (0.0, 0.0, 0.0)


# -- where everything is -----------------------------------------------------------------------------------------------


def soundness(seen: Observation, before: Observation, sound: bool) -> tuple[float, bool, bool, float]:
    """Add up every reading that says where base, hand and people are: finite only if all of them are.

    Also says whether the people are the very readings of a sound tick before, and the norm of the joint speeds.
    """
    x, y, yaw = seen.odometry
    vx, vy, wz = seen.base_velocity
    tx, ty, tz = seen.tcp_m
    # A norm is finite if every number is, and takes half as long as their sum.
    fastest_radps = hypot(*seen.joint_speed_radps)
    placed = x + y + yaw + vx + vy + wz + tx + ty + tz + seen.time_s + hypot(*seen.jacobian) + fastest_radps
    # Fixes and people come at 20 Hz: what was added up in the tick before, and was finite, still is.
    if seen.fix is not None and not (sound and seen.fix is before.fix):
        placed += sum(seen.fix)
    same_people = sound and seen.people is before.people
    if seen.people and not same_people:
        for track in seen.people:
            placed += sum(track)
    sound = placed - placed == 0.0
    return placed, sound, same_people, fastest_radps


def position(seen: Observation, base: BaseEstimate, sound: bool) -> tuple[BaseEstimate, bool, float, float, float]:
    """Say where the base is by odometry and fixes, and whether a fix has jumped.

    Where readings are not finite the estimate stays as it was, and every signal that needs it is unknown.
    """
    fix_jumped = False
    base_x_m = base_y_m = base_yaw_rad = nan
    if sound:
        if seen.time_s >= base.due_s or (seen.fix is not None and seen.fix.stamp_s != base.fix_s):
            base = track_base(base, seen.time_s, seen.odometry, seen.fix)
        x, y, yaw = seen.odometry
        # Taken apart as a whole: looking these fields up one by one takes half as long again.
        at_s, off_x, off_y, off_yaw, drift_x, drift_y, _, _, _, _, miss_m, _, _, from_x, from_y, cosine, sine = base
        ahead_s, since_x, since_y = seen.time_s - at_s, x - from_x, y - from_y
        base_x_m = from_x + (off_x + drift_x * ahead_s) + (cosine * since_x - sine * since_y)
        base_y_m = from_y + (off_y + drift_y * ahead_s) + (sine * since_x + cosine * since_y)
        base_yaw_rad = yaw + off_yaw
        # Until another fix says otherwise: fixes come every fifth tick, and what is debounced has to last.
        fix_jumped = miss_m > FIX_JUMP_M
    return base, fix_jumped, base_x_m, base_y_m, base_yaw_rad


def motion(seen: Observation) -> float:
    """Return the base's speed."""
    vx, vy, _ = seen.base_velocity
    return sqrt(vx * vx + vy * vy)


def zone_margin(  # noqa: PLR0913, PLR0917  # what a part needs, it names
    seen: Observation,
    before: Observation,
    sound: bool,
    base: BaseEstimate,
    base_x_m: float,
    base_y_m: float,
    base_yaw_rad: float,
    base_speed_mps: float,
    plan: Constants,
) -> float:
    """Return the least clearance between the hull and a zone on the way to standstill, if braking began now.

    Far off the distance to the bounding box stands in for that to the zone (it is never more), and the drives' word
    for where braking leads.
    """
    zone_margin_m = FAR_M if sound else nan
    if sound and plan.keepouts:
        for zone in plan.keepouts:
            x0, y0, x1, y1, _ = zone
            dx = x0 - base_x_m if base_x_m < x0 else base_x_m - x1 if base_x_m > x1 else 0.0
            dy = y0 - base_y_m if base_y_m < y0 else base_y_m - y1 if base_y_m > y1 else 0.0
            off_m = sqrt(dx * dx + dy * dy)
            if not off_m >= zone_margin_m:
                zone_margin_m = off_m
        zone_margin_m -= (
            base_speed_mps * (REACTION_S + base_speed_mps / (2.0 * plan.base_deceleration_mps2)) + plan.base_radius_m
        )
        if not zone_margin_m > NEAR_ZONE_M:
            velocity = turned(base_yaw_rad, seen.base_velocity)
            slides = slide(seen, before, base, base_speed_mps, velocity)
            zone_margin_m = near_zones(
                plan.keepouts, (base_x_m, base_y_m), velocity, slides, plan.base_deceleration_mps2, plan.base_radius_m
            )
    return zone_margin_m


def people_around(
    seen: Observation, people: tuple[PersonEstimate, ...], sound: bool, same_people: bool
) -> tuple[PersonEstimate, ...]:
    """Follow the people the tracker saw, and those it saw a moment ago."""
    # The same tracks once more say nothing new, unless somebody else is to be forgotten in time.
    if sound and (people or seen.people) and not (same_people and len(people) == len(seen.people)):
        people = track_people(people, seen.people, seen.time_s)
    return people


def separation(
    seen: Observation,
    sound: bool,
    people: tuple[PersonEstimate, ...],
    base_x_m: float,
    base_y_m: float,
    base_yaw_rad: float,
    base_speed_mps: float,
    plan: Constants,
) -> tuple[float, float, float, float]:
    """Return distance, protective separation and margin of the person with the least margin, and the least ahead."""
    separation_m = separation_margin_m = separation_ahead_m = FAR_M if sound else nan
    protective_separation_m = plan.fixed_gap_m
    if sound and people:
        separation_margin_m = inf
        spare_m = max(0.0, plan.held_off_m - LEFT_M)  # a rule that names less asks for no more to be left
        c, s = cos(base_yaw_rad), sin(base_yaw_rad)
        vx, vy = turned(base_yaw_rad, seen.base_velocity)
        tx, ty, _ = seen.tcp_m
        jx, jy = tcp_velocity(seen.jacobian, seen.joint_speed_radps)
        _, _, wz = seen.base_velocity
        arm_x, arm_y = c * tx - s * ty, s * tx + c * ty
        hand_x, hand_y = base_x_m + arm_x, base_y_m + arm_y
        hand_vx, hand_vy = vx + c * jx - s * jy - wz * arm_y, vy + s * jx + c * jy + wz * arm_x
        # Of the whole speed, in whatever direction: who comes from the side comes as long as the robot moves.
        fastest_mps = max(base_speed_mps, seen.tcp_speed_mps, hypot(hand_vx, hand_vy))
        braking_s = fastest_mps / plan.base_deceleration_mps2 if fastest_mps > CREEP_MPS else 0.0
        for person in people:
            px, py = now(person, seen.time_s)
            to_x, to_y = px - base_x_m, py - base_y_m
            reach_x, reach_y = px - hand_x, py - hand_y
            far, near = hypot(to_x, to_y), hypot(reach_x, reach_y)
            # Directed: only speed towards the person shortens the time they have.
            closing = max(
                0.0, (vx * to_x + vy * to_y) / (far or 1.0), (hand_vx * reach_x + hand_vy * reach_y) / (near or 1.0)
            )
            coming = -(person.vx_mps * to_x + person.vy_mps * to_y) / (far or 1.0)
            hurrying = max(0.0, coming - plan.human_speed_mps)
            gap_m = min(far - plan.base_radius_m, near)
            needed_m = plan.fixed_gap_m + hurrying * plan.gap_per_human_speed_s + closing * plan.gap_per_speed_s
            if gap_m - needed_m < separation_margin_m:
                separation_m, protective_separation_m, separation_margin_m = gap_m, needed_m, gap_m - needed_m
            if person.samples < LEARNED_SAMPLES and braking_s > 0.0:  # a robot that stands need not be stopped
                coming = max(coming, plan.human_speed_mps, WALKING_MPS)
            ahead_m = at_standstill(gap_m, closing, coming, braking_s) + spare_m
            separation_ahead_m = min(separation_ahead_m, gap_m, ahead_m)
    return separation_m, protective_separation_m, separation_margin_m, separation_ahead_m


# -- how the attempt goes ----------------------------------------------------------------------------------------------


def timeout(rate: float, elapsed_ticks: int, plan: Constants) -> tuple[int, float]:
    """Count the time the skill was let run."""
    if rate > 0.0:
        elapsed_ticks += 1
    return elapsed_ticks, elapsed_ticks * plan.period_s


def stall(
    seen: Observation,
    report: SkillReport,
    rate: float,
    base_speed_mps: float,
    stall_ticks: int,
    progress: float,
    plan: Constants,
) -> tuple[int, float, float]:
    """Count the time without progress and without motion; what visibly moves is not stalled."""
    if rate > 0.0 and base_speed_mps < CREEP_MPS and seen.tcp_speed_mps < CREEP_MPS:
        stall_ticks += 1
    told = report.progress
    if abs(told - progress) > PROGRESS_STEP:
        stall_ticks, progress = 0, told
    return stall_ticks, progress, stall_ticks * plan.period_s


def attempts(
    command: Command,
    report: SkillReport,
    rate: float,
    retried: int,
    closing: bool | None,
    closings: int,
    reached: float,
    restarts: int,
) -> tuple[bool | None, int, float, int, float]:
    """Count retries: those that governance ordered, and those that a skill makes by itself without saying so.

    A skill that begins again closes its hand a second time, or falls back in its own progress. Neither can lower what
    governance counts. What a hold makes of the hand is none of the skill's doing.
    """
    closes = command.grip_force_n > 0.0 if rate > 0.0 else closing
    if closes and closing is False:
        closings += 1
    closing = closes
    told = report.progress
    if told > reached:
        reached = told
    elif told < reached - FALLS_BACK:
        restarts, reached = restarts + 1, told
    again = closings - 1 if closings - 1 > restarts else restarts
    return closing, closings, reached, restarts, float(retried + again)


def counted(unmet: int) -> float:
    """Pass on what governance counted itself: postconditions found unmet."""
    return float(unmet)


# -- force and grip ----------------------------------------------------------------------------------------------------


def contact_force(seen: Observation, before: Observation) -> float:
    """Return the mean of the last two ticks: 20 ms."""
    return 0.5 * (seen.contact_force_n + before.contact_force_n)


def grip_force(seen: Observation, before: Observation) -> float:
    """Return the mean of the last two ticks between the pads: 20 ms."""
    return 0.5 * (seen.grip_force_n + before.grip_force_n)


def external_torque(seen: Observation) -> float:
    """Return the largest momentum residual of any joint, whatever its direction."""
    a, b, c, d, e, f = seen.residual_nm
    residual_nm = abs(a)  # written out: half the time of max(map(abs, …))
    if abs(b) > residual_nm:
        residual_nm = abs(b)
    if abs(c) > residual_nm:
        residual_nm = abs(c)
    if abs(d) > residual_nm:
        residual_nm = abs(d)
    if abs(e) > residual_nm:
        residual_nm = abs(e)
    if abs(f) > residual_nm:
        residual_nm = abs(f)
    return residual_nm


def grip(
    seen: Observation, command: Command, held_ticks: int, lost_ticks: int, slip_from_m: float | None
) -> tuple[int, int, float, float, float]:
    """Say how far an object has slipped since the grip closed on it, and whether it is gone."""
    slip_m = 0.0
    if not command.grip_force_n > 0.0:
        held_ticks, lost_ticks, slip_from_m = 0, 0, seen.slip_m
    else:
        if seen.pads_loaded and seen.grip_width_m > FIST_M:  # a closed fist that presses a button holds nothing
            held_ticks, lost_ticks = held_ticks + 1, 0
        elif held_ticks >= HELD_TICKS:
            lost_ticks += 1
        else:
            held_ticks = 0
        if slip_from_m is None or seen.slip_m < slip_from_m:  # the sensor starts from zero when the grip closes anew
            slip_from_m = seen.slip_m
        slip_m = seen.slip_m - slip_from_m
    return held_ticks, lost_ticks, slip_from_m, slip_m, 1.0 if lost_ticks >= LOST_TICKS else 0.0


# -- what was told against what is seen --------------------------------------------------------------------------------


def arm_speed(seen: Observation) -> float:
    """Return the hand's speed relative to the base."""
    return seen.tcp_speed_mps


def tracking(seen: Observation, command: Command) -> float:
    """Return how far the joint that is farthest off is from where it was told to be.

    While all joints together are off by less than `ON_TRACK_RAD`, that norm, which is never less, stands in.
    """
    tracking_error_rad = dist(command.joint_rad, seen.joint_rad)
    if not tracking_error_rad < ON_TRACK_RAD:
        tracking_error_rad = farthest(command.joint_rad, seen.joint_rad)
    return tracking_error_rad


def base_tracking(seen: Observation, command: Command) -> float:
    """Return how far the base's velocity is from what it was told."""
    told_x, told_y, _ = command.base_velocity
    vx, vy, _ = seen.base_velocity
    off_x, off_y = told_x - vx, told_y - vy
    return sqrt(off_x * off_x + off_y * off_y)


# -- whether the sensors can be believed -------------------------------------------------------------------------------


def staleness(seen: Observation, stamps: SensorStamps, plan: Constants) -> tuple[float, float]:
    """Return the age of the sensor that exceeds its limit most (or comes nearest to), and by how much, in ms."""
    arm_s, wrist_s, gripper_s, odometry_s, fix_s, people_s, objects_s = plan.age_limits_s
    # Written out: a loop takes three times as long. The sample that expires first is the worst.
    taken_s, expires_s = stamps.arm, stamps.arm + arm_s
    if stamps.wrist + wrist_s < expires_s:
        taken_s, expires_s = stamps.wrist, stamps.wrist + wrist_s
    if stamps.gripper + gripper_s < expires_s:
        taken_s, expires_s = stamps.gripper, stamps.gripper + gripper_s
    if stamps.odometry + odometry_s < expires_s:
        taken_s, expires_s = stamps.odometry, stamps.odometry + odometry_s
    if stamps.fix + fix_s < expires_s:
        taken_s, expires_s = stamps.fix, stamps.fix + fix_s
    if stamps.people + people_s < expires_s:
        taken_s, expires_s = stamps.people, stamps.people + people_s
    if stamps.objects + objects_s < expires_s:
        taken_s, expires_s = stamps.objects, stamps.objects + objects_s
    return (seen.time_s - taken_s) * 1000.0, (seen.time_s - expires_s) * 1000.0


def stuck_arm(seen: Observation, before: Observation, stamps: SensorStamps, command: Command, stuck_ticks: int) -> int:
    """Count ticks of commanded arm movement in which a signal that never repeats bit by bit has just done so.

    Only under a new stamp: an old one is stale, which is another matter, and over when the next comes.
    """
    if command.joint_speed_radps != STILL:
        old = before.stamps_s
        repeats = (
            (
                (
                    seen.joint_torque_nm == before.joint_torque_nm
                    or seen.joint_rad == before.joint_rad
                    or seen.joint_speed_radps == before.joint_speed_radps
                )
                and stamps.arm != old.arm
            )
            or (seen.contact_force_n == before.contact_force_n and stamps.wrist != old.wrist)
            or (seen.pads_loaded and seen.grip_force_n == before.grip_force_n and stamps.gripper != old.gripper)
        )
        stuck_ticks = stuck_ticks + 1 if repeats else 0
    return stuck_ticks


def stuck_drives(
    seen: Observation, before: Observation, stamps: SensorStamps, command: Command, stuck_base_ticks: int
) -> int:
    """Count ticks of commanded driving in which the drives', arm's, wrist's or a full hand's reading repeated exactly.

    Of the arm, which stands meanwhile, the torques: what holds it on a moving base is never twice the same.
    """
    if command.base_velocity != RESTING:
        old = before.stamps_s
        repeats = (
            (seen.base_velocity == before.base_velocity and stamps.odometry != old.odometry)
            or (seen.joint_torque_nm == before.joint_torque_nm and stamps.arm != old.arm)
            or (seen.contact_force_n == before.contact_force_n and stamps.wrist != old.wrist)
            or (seen.pads_loaded and seen.grip_force_n == before.grip_force_n and stamps.gripper != old.gripper)
        )
        stuck_base_ticks = stuck_base_ticks + 1 if repeats else 0
    return stuck_base_ticks


def frozen_samples(
    seen: Observation, before: Observation, stamps: SensorStamps, frozen: int, stuck_grip_ticks: int
) -> tuple[int, int]:
    """Say which of fix, people and objects (a bit each) came again under a new stamp; count what the gripper repeats.

    A bit stays until the next sample says otherwise: they come every fifth tick or less, and what is debounced lasts.
    """
    if seen.frames is not before.frames:
        frozen = repeated(seen.frames, before.frames, stamps, before.stamps_s, frozen)
    if seen.grip_width_m == before.grip_width_m:
        if seen.frames is not None and stamps.gripper != before.stamps_s.gripper:
            stuck_grip_ticks += 1
    elif stuck_grip_ticks:
        stuck_grip_ticks = 0
    return frozen, stuck_grip_ticks


def leaps(
    seen: Observation,
    before: Observation,
    stamps: SensorStamps,
    people: tuple[PersonEstimate, ...],
    fix_jumped: bool,
    tracking_error_rad: float,
    scatter_m2: float,
    doubted_until_s: float,
) -> tuple[float, float]:
    """Say until when sensors are doubted, because base, joints, fingers, people or things moved as none can.

    That is, from one sample to the next. A leap is over at once, and what it leaves behind may look sound: an offset.
    So it is remembered for `DOUBT_S`. Also follows how far pictures of loose objects scatter.
    """
    leapt = fix_jumped
    opened_m = seen.grip_width_m - before.grip_width_m
    if not -FINGERS_STEP_M <= opened_m <= FINGERS_STEP_M:
        leapt = leapt or abs(opened_m) > FASTEST_FINGERS_MPS * (stamps.gripper - before.stamps_s.gripper)
    if not tracking_error_rad < OFF_TRACK_RAD:
        could_rad = LARGEST_JOINT_SPEED_RADPS * (stamps.arm - before.stamps_s.arm)
        leapt = leapt or dist(seen.joint_rad, before.joint_rad) > could_rad
    if people:
        for person in people:
            leapt = leapt or person.leapt
    if seen.sightings is not before.sightings:
        gap_s = stamps.objects - before.stamps_s.objects
        strewn, scatter_m2 = scattered(seen.sightings, before.sightings, gap_s, scatter_m2)
        leapt = leapt or strewn
    if leapt:
        doubted_until_s = seen.time_s + DOUBT_S
    return scatter_m2, doubted_until_s


def implausible(  # noqa: PLR0913, PLR0917  # what a part needs, it names
    seen: Observation,
    before: Observation,
    placed: float,
    fastest_radps: float,
    residual_nm: float,
    stuck_ticks: int,
    stuck_base_ticks: int,
    frozen: int,
    stuck_grip_ticks: int,
    doubted_until_s: float,
) -> float:
    """Say whether a reading is not finite, cannot be, jumps, repeats, or comes with a clock that stands."""
    total = (
        placed
        + sum(seen.stamps_s)
        + (seen.tcp_speed_mps + seen.contact_force_n + seen.peak_force_n)
        + (seen.grip_width_m + seen.grip_force_n + seen.slip_m)
    )
    x, y, _ = seen.tcp_m
    vx, vy, _ = seen.base_velocity
    arm_s, wrist_s, gripper_s, odometry_s, fix_s, people_s, objects_s = seen.stamps_s
    latest_s = seen.time_s + LATEST_STAMP_S
    # A norm within the limit says so of each part, in half the time, and is not for what is not finite. Torques are
    # at most their distance from the residual and that residual: one norm for both.
    believed = (
        total - total == 0.0
        and (hypot(*seen.joint_rad) < LARGEST_JOINT_RAD or within(seen.joint_rad, LARGEST_JOINT_RAD))
        and (fastest_radps < LARGEST_JOINT_SPEED_RADPS or within(seen.joint_speed_radps, LARGEST_JOINT_SPEED_RADPS))
        and (
            dist(seen.joint_torque_nm, seen.residual_nm) + residual_nm < LARGEST_TORQUE_NM
            or (within(seen.joint_torque_nm, LARGEST_TORQUE_NM) and hypot(*seen.residual_nm) < inf)
        )
        and 0.0 <= seen.contact_force_n <= LARGEST_FORCE_N
        and -0.05 <= seen.grip_width_m <= LARGEST_WIDTH_M
        and abs(x) + abs(y) <= LONGEST_REACH_M
        and abs(vx) + abs(vy) <= LARGEST_BASE_SPEED_MPS
        and arm_s <= latest_s  # written out: a third of the time of max()
        and wrist_s <= latest_s
        and gripper_s <= latest_s
        and odometry_s <= latest_s
        and fix_s <= latest_s
        and people_s <= latest_s
        and objects_s <= latest_s
        and stuck_ticks < STUCK_TICKS
        and stuck_base_ticks < STUCK_TICKS
        and not frozen
        and stuck_grip_ticks < STUCK_TICKS
        and not seen.time_s < doubted_until_s
        and (not seen.time_s <= before.time_s or seen is before)
    )
    return 0.0 if believed else 1.0


def at_standstill(gap_m: float, closing_mps: float, coming_mps: float, braking_s: float) -> float:
    """Return how far away a person will be once the robot stands, if it brakes now and they come on as they do.

    Args:
        gap_m: how far away they are.
        closing_mps: how fast the robot nears them.
        coming_mps: how fast they near the robot; what is slower than a walk is the estimate's noise.
        braking_s: how long braking takes, to standstill.
    """
    if coming_mps < SLOWEST_WALK_MPS:
        coming_mps = 0.0
    return gap_m - coming_mps * (HALTING_S + braking_s) - closing_mps * (HALTING_S + braking_s / 2.0)


def farthest(told: Vec6, seen: Vec6) -> float:
    """Return the largest difference between what was told and what is seen; NaN where one is none."""
    apart = [abs(one - other) for one, other in zip(told, seen, strict=True)]
    return max(apart) if sum(apart) < inf else nan


def repeated(seen: Frames | None, before: Frames | None, stamps: SensorStamps, old: SensorStamps, frozen: int) -> int:
    """Return which of fix, people and objects (a bit each) came again, when some of them have come."""
    if seen is None or before is None:
        return 0
    # Written out: with a loop it takes three times as long. What is not finite tells nothing new either.
    fix, people, objects = seen
    fix_before, people_before, objects_before = before
    _, _, _, _, fix_s, people_s, objects_s = stamps
    _, _, _, _, fix_old_s, people_old_s, objects_old_s = old
    if fix_s != fix_old_s:
        frozen = frozen & ~1 if 0.0 < abs(fix - fix_before) < inf else frozen | 1
    if people_s != people_old_s:
        frozen = frozen & ~2 if 0.0 < abs(people - people_before) < inf else frozen | 2
    if objects_s != objects_old_s:
        frozen = frozen & ~4 if 0.0 < abs(objects - objects_before) < inf else frozen | 4
    return frozen


def within(values: Vec6, limit: float) -> bool:
    """Say whether every value is known to be within ±limit."""
    return all(-limit <= value <= limit for value in values)


DETECTORS: Final[tuple[Part, ...]] = parts(
    {
        soundness: ("placed", "sound", "same_people", "fastest_radps"),
        position: ("base", "fix_jumped", "base_x_m", "base_y_m", "base_yaw_rad"),
        motion: ("base_speed_mps",),
        zone_margin: ("zone_margin_m",),
        people_around: ("people",),
        separation: ("separation_m", "protective_separation_m", "separation_margin_m", "separation_ahead_m"),
        timeout: ("elapsed_ticks", "elapsed_s"),
        stall: ("stall_ticks", "progress", "stall_s"),
        attempts: ("closing", "closings", "reached", "restarts", "retries"),
        counted: ("postcondition",),
        contact_force: ("contact_force_n",),
        grip_force: ("grip_force_n",),
        external_torque: ("residual_nm",),
        grip: ("held_ticks", "lost_ticks", "slip_from_m", "slip_m", "grip_lost"),
        arm_speed: ("tcp_speed_mps",),
        tracking: ("tracking_error_rad",),
        base_tracking: ("base_tracking_error_mps",),
        staleness: ("sensor_age_ms", "sensor_margin_ms"),
        stuck_arm: ("stuck_ticks",),
        stuck_drives: ("stuck_base_ticks",),
        frozen_samples: ("frozen", "stuck_grip_ticks"),
        leaps: ("scatter_m2", "doubted_until_s"),
        implausible: ("implausible",),
    }
)
"""Every detector with the names of what it gives: signals, state (`Senses`), or what a detector below takes."""
