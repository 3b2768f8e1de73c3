"""Where base and people really are, how far pictures scatter, whether an excess has lasted: the watcher's estimators.

All of it is arithmetic on named tuples: a step takes a state and returns the next one. No matrices, because the
filters are small enough to be written out, and a tick has 40 µs for everything.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

if TYPE_CHECKING:
    from app.governance.model import Fix, Observation, PersonTrack, Sighting, Vec3, Vec6

HISTORY: Final = 10
HISTORY_STEP_S: Final = 0.05
"""Odometry kept, so that a fix can be compared with where the odometry was when the fix was taken; coarse, because a
long tuple that is built anew in every tick is what costs most in a loop whose caches belong to the physics."""
EARLY_S: Final = 0.01  # so much before it is due, odometry is kept along with a new fix

FIX_SIGMA_M: Final = 0.02
FIRST_SIGMA_M: Final = 0.5
FIRST_DRIFT_MPS: Final = 0.05
OFFSET_NOISE_M2PS: Final = 4e-6
DRIFT_NOISE: Final = 4e-3  # (m/s)² per s: an odometry bias that appears at once is followed within about 0.3 s
YAW_GAIN: Final = 0.1
AHEAD_M: Final = 1.0  # where a fix misses is asked of what lies so far ahead of the robot: the hand, or who comes

ALPHA: Final = 0.5
BETA: Final = 0.17
FASTEST_PERSON_MPS: Final = 2.5
EXTRAPOLATE_S: Final = 0.3
FORGET_S: Final = 2.0
EARLIEST_S: Final = 0.1  # a track that is stamped later than that from now has a clock of its own
LEAP_M: Final = 0.6
"""Who is seen farther than this from where they were expected, beyond what turning on the spot at full speed explains,
did not walk there: five σ of the tracker at twice its noise."""

LOOSE_SCATTER_M: Final = (0.014, 0.03)
"""How far loose objects scatter from one picture to the next: at least, and to begin with and at most. That is the one
that scatters most, in each coordinate, of cameras at their noise and at twice that."""
SCATTER_GAIN: Final = 0.15
LOOSE_SIGMAS: Final = 4.0
FASTEST_LOOSE_MPS: Final = 1.2  # a hand that moves things out of the way does it slower
ALONE: Final = 1.5  # an object alone in view must go so much farther: there is no second one to say so as well


_Moment: TypeAlias = tuple[float, float, float, float]


class BaseEstimate(NamedTuple):
    """Offset between true position and odometry, its drift, and how sure that is, as of `at_s`.

    The truth is modelled as odometry + offset, where the offset drifts with a slowly changing velocity: a Kalman filter
    with the state (offset, drift) per axis. Both axes have the same noise, so they share one covariance (`p_oo`,
    `p_od`, `p_dd`). Odometry adds up along a heading of its own, which wanders off without end: what it says since it
    was at (`from_x_m`, `from_y_m`) is turned by the heading error, of which `cosine` and `sine` are kept.
    `fix_s` is the stamp of the last fix used, −1 before the first; `miss_m` says how far that fix lay
    from where it was expected, its yaw as what it moves 1 m ahead. `history` holds (time_s, x_m, y_m, yaw_rad) of the
    odometry, newest first; `due_s` is when it takes the next.
    """

    at_s: float = 0.0
    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    drift_x_mps: float = 0.0
    drift_y_mps: float = 0.0
    p_oo: float = FIRST_SIGMA_M**2
    p_od: float = 0.0
    p_dd: float = FIRST_DRIFT_MPS**2
    fix_s: float = -1.0
    miss_m: float = 0.0
    due_s: float = -math.inf
    history: tuple[_Moment, ...] = ()
    from_x_m: float = 0.0
    from_y_m: float = 0.0
    cosine: float = 1.0
    sine: float = 0.0


_made: Final = BaseEstimate._make  # a quarter less than by the call that knows their names


def track_base(estimate: BaseEstimate, time_s: float, odometry: Vec3, fix: Fix | None) -> BaseEstimate:
    """Return the estimate after what came in by now: the same one, unless a fix is new or history is due.

    Between fixes nothing has to be computed: the offset moves by drift × time, and as far as what odometry covers is
    turned (see `offset`). A fix of the past is compared with odometry + offset *of that past*, which compensates its
    latency without re-running the filter.
    """
    at_s, x, y, yaw, dx, dy, p_oo, p_od, p_dd, fix_s, miss_m, due_s, history, from_x, from_y, cosine, sine = estimate
    new = fix is not None and fix.stamp_s != fix_s
    if not new and time_s < due_s:
        return estimate
    newest = (time_s, *odometry)
    if time_s >= due_s - EARLY_S:  # with the fix, where fixes come as often: one tick with both costs less than two
        due_s, history = time_s + HISTORY_STEP_S + EARLY_S / 2.0, (newest, *history[: HISTORY - 1])
    if fix is None or not new:
        return _made(
            (at_s, x, y, yaw, dx, dy, p_oo, p_od, p_dd, fix_s, miss_m, due_s, history, from_x, from_y, cosine, sine)
        )
    stamp_s, fix_x, fix_y, fix_yaw = fix
    x, y = offset(estimate, time_s, odometry)
    gone_s = max(0.0, time_s - at_s)
    p_oo += gone_s * (2.0 * p_od + gone_s * p_dd) + OFFSET_NOISE_M2PS * gone_s
    p_od += gone_s * p_dd
    p_dd += DRIFT_NOISE * gone_s
    age_s = time_s - stamp_s
    then_x, then_y, then_yaw = _at(newest, history, stamp_s)
    since_x, since_y = odometry[0] - then_x, odometry[1] - then_y
    off_x = fix_x - then_x - (x - dx * age_s - (cosine * since_x - sine * since_y - since_x))
    off_y = fix_y - then_y - (y - dy * age_s - (sine * since_x + cosine * since_y - since_y))
    turned = math.remainder(fix_yaw - then_yaw - yaw, math.tau)
    sure = 1.0 / (p_oo + FIX_SIGMA_M**2)
    gain_o, gain_d = p_oo * sure, p_od * sure
    first = fix_s < 0.0
    yaw += turned if first else YAW_GAIN * turned
    return _made(
        (
            time_s,
            x + gain_o * off_x,
            y + gain_o * off_y,
            yaw,
            dx + gain_d * off_x,
            dy + gain_d * off_y,
            (1.0 - gain_o) * p_oo,
            (1.0 - gain_o) * p_od,
            p_dd - gain_d * p_od,
            stamp_s,
            0.0 if first else math.hypot(off_x, off_y, turned * AHEAD_M),
            due_s,
            history,
            odometry[0],
            odometry[1],
            math.cos(yaw),
            math.sin(yaw),
        )
    )


def follow_base(estimate: BaseEstimate, seen: Observation) -> BaseEstimate:
    """Return the estimate after a tick in which nothing else is watched; what is not finite tells nothing."""
    told = seen.time_s + sum(seen.odometry) + (0.0 if seen.fix is None else sum(seen.fix))
    return track_base(estimate, seen.time_s, seen.odometry, seen.fix) if told - told == 0.0 else estimate


def offset(estimate: BaseEstimate, time_s: float, odometry: Vec3) -> tuple[float, float]:
    """Return the offset of the odometry by now."""
    ahead_s, cosine, sine = time_s - estimate.at_s, estimate.cosine, estimate.sine
    since_x, since_y = odometry[0] - estimate.from_x_m, odometry[1] - estimate.from_y_m
    return (
        estimate.x_m + estimate.drift_x_mps * ahead_s + (cosine * since_x - sine * since_y - since_x),
        estimate.y_m + estimate.drift_y_mps * ahead_s + (sine * since_x + cosine * since_y - since_y),
    )


def _at(newest: _Moment, history: tuple[_Moment, ...], stamp_s: float) -> Vec3:
    """Return the odometry at a moment, between two that were kept."""
    later = newest
    for entry in history:
        if entry[0] <= stamp_s and later[0] > entry[0]:
            share = min(1.0, (stamp_s - entry[0]) / (later[0] - entry[0]))
            turned = math.remainder(later[3] - entry[3], math.tau)
            return (
                entry[1] + share * (later[1] - entry[1]),
                entry[2] + share * (later[2] - entry[2]),
                entry[3] + share * turned,
            )
        later = entry
    return later[1], later[2], later[3]


class PersonEstimate(NamedTuple):
    """One person as filtered: position and velocity at `stamp_s`, world frame.

    `leapt` says that the last sample lay farther from where they were expected than anybody can get, or in the future;
    `samples` counts how many have come since they came into view.
    """

    person: int
    stamp_s: float
    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    leapt: bool = False
    samples: int = 1


def track_people(
    known: tuple[PersonEstimate, ...], tracks: tuple[PersonTrack, ...], time_s: float
) -> tuple[PersonEstimate, ...]:
    """Advance every person's α-β filter by the tracks that are new; people out of sight are kept for `FORGET_S`.

    Whoever vanished behind a pillar is still there: forgetting at once would make occlusion look like clearance.
    """
    if not tracks:
        return tuple([one for one in known if time_s - one.stamp_s <= FORGET_S]) if known else known
    fresh = [_track(known, track, time_s) for track in tracks]
    seen = {track.person for track in tracks}
    fresh += [one for one in known if one.person not in seen and time_s - one.stamp_s <= FORGET_S]
    return tuple(fresh)


def _track(known: tuple[PersonEstimate, ...], track: PersonTrack, time_s: float) -> PersonEstimate:
    person, stamp_s, x, y = track
    if early := stamp_s > time_s + EARLIEST_S:  # taken as it stands, it would not be followed again before then
        stamp_s = time_s
    for old in known:
        if old.person == person:
            break
    else:
        return PersonEstimate(person, stamp_s, x, y, 0.0, 0.0, early)
    gap_s = stamp_s - old.stamp_s
    if gap_s <= 0.0:
        return old
    ahead_x, ahead_y = old.x_m + old.vx_mps * gap_s, old.y_m + old.vy_mps * gap_s
    miss_x, miss_y = x - ahead_x, y - ahead_y
    vx, vy = old.vx_mps + BETA * miss_x / gap_s, old.vy_mps + BETA * miss_y / gap_s
    speed = math.hypot(vx, vy)
    if not speed < math.inf:  # finite, and too far off to reckon with: begun anew, and doubted
        return PersonEstimate(person, stamp_s, x, y, 0.0, 0.0, leapt=True)
    if speed > FASTEST_PERSON_MPS:
        vx, vy = vx * FASTEST_PERSON_MPS / speed, vy * FASTEST_PERSON_MPS / speed
    leapt = early or math.hypot(miss_x, miss_y) > LEAP_M + 2.0 * FASTEST_PERSON_MPS * gap_s
    x, y = ahead_x + ALPHA * miss_x, ahead_y + ALPHA * miss_y
    # Who was out of sight may have turned or started meanwhile: how fast they go is to be learned again.
    return PersonEstimate(person, stamp_s, x, y, vx, vy, leapt, old.samples + 1 if gap_s <= EXTRAPOLATE_S else 1)


def now(person: PersonEstimate, time_s: float) -> tuple[float, float]:
    """Return where a person is by now, along the estimated velocity for at most `EXTRAPOLATE_S`."""
    age_s = time_s - person.stamp_s
    if age_s > EXTRAPOLATE_S:
        age_s = EXTRAPOLATE_S
    return person.x_m + person.vx_mps * age_s, person.y_m + person.vy_mps * age_s


def scattered(
    sightings: tuple[Sighting, ...], before: tuple[Sighting, ...], gap_s: float, scatter_m2: float
) -> tuple[bool, float]:
    """Say whether loose objects went from one picture to the next as nothing moves them, or one is nowhere.

    One of several may have been moved: somebody took it, or it slipped and rolled; two at once is the camera. One that
    is alone in view has to go `ALONE` times as far, which is faster than it is taken or falls. What is more than noise
    is learned from the pictures in which nothing leaps: the mean square of what a coordinate of the object that
    scatters most changes by, which is the second number. Not of all of them, since of those that the exact camera at
    the wrist sees the others' noise could not be told.
    """
    were = {name: (x, y) for name, x, y in before}
    far_m = max(LOOSE_SIGMAS * math.sqrt(scatter_m2), FASTEST_LOOSE_MPS * gap_s)
    again, leapt, most_m = 0, 0, -1.0
    for name, x, y in sightings:
        if name in were:
            again += 1
            apart_m = math.dist((x, y), were[name])
            if not apart_m <= far_m:
                leapt += 1 if apart_m < math.inf else 2
            most_m = max(most_m, apart_m)
        elif not math.isfinite(x + y):
            leapt += 2
    if again == 1 and leapt == 1 and most_m > ALONE * far_m:
        return True, scatter_m2
    if again and not leapt:
        least_m, largest_m = LOOSE_SCATTER_M
        heard_m2 = min(max(most_m * most_m / 2.0, least_m * least_m), largest_m * largest_m)
        scatter_m2 += SCATTER_GAIN * (heard_m2 - scatter_m2)
    return leapt > 1, scatter_m2


def tcp_velocity(jacobian: tuple[float, ...], speeds: Vec6) -> tuple[float, float]:
    """Return the hand's horizontal velocity relative to the base, in the base frame."""
    a, b, c, d, e, f = speeds
    j0, j1, j2, j3, j4, j5, k0, k1, k2, k3, k4, k5, *_ = jacobian
    return (
        j0 * a + j1 * b + j2 * c + j3 * d + j4 * e + j5 * f,
        k0 * a + k1 * b + k2 * c + k3 * d + k4 * e + k5 * f,
    )


def cusum(total: float, value: float, reference: float, limit: float) -> float:
    """Return the next cumulative sum of what a signal exceeds its reference by: never negative, at most 2 × limit.

    The bound lets the sum come back down as fast as it went up (Page 1954, one-sided).
    """
    total += value - reference
    if total <= 0.0:
        return 0.0
    # Written so that a NaN alarms, and is forgotten again like any large excess.
    return total if total <= 2.0 * limit else 2.0 * limit
