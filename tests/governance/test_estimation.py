from __future__ import annotations

import math
import random

import pytest

from app.governance.estimation import (
    ALONE,
    FORGET_S,
    HISTORY,
    LOOSE_SCATTER_M,
    BaseEstimate,
    PersonEstimate,
    cusum,
    follow_base,
    now,
    offset,
    scattered,
    track_base,
    track_people,
)
from app.governance.model import Fix, PersonTrack, Sighting
from tests.governance.test_watcher import seen

PERIOD_S = 0.01


def drive(*, seconds: float, bias_mps: float, latency_s: float, speed_mps: float = 0.5, sigma_m: float = 0.02) -> float:
    """Drive along x with an odometry that drifts; return the largest error in the second half."""
    noise = random.Random(3)  # noqa: S311  # repeatable noise, no secret
    estimate, fix, worst = BaseEstimate(), None, 0.0
    ticks = round(seconds / PERIOD_S)
    for tick in range(ticks):
        now_s = tick * PERIOD_S
        true_x, odometry = speed_mps * now_s, (speed_mps * now_s - bias_mps * now_s, 2.0, 0.3)
        if tick % 5 == 0 and now_s >= latency_s:
            then_s = now_s - latency_s
            fix = Fix(then_s, speed_mps * then_s + noise.gauss(0, sigma_m), 2.0 + noise.gauss(0, sigma_m), 0.3)
        estimate = track_base(estimate, now_s, odometry, fix)
        if tick > ticks / 2:
            worst = max(worst, abs(odometry[0] + offset(estimate, now_s, odometry)[0] - true_x))
    return worst


def test_a_good_odometry_is_left_alone() -> None:
    assert drive(seconds=6.0, bias_mps=0.0, latency_s=0.05, sigma_m=0.0) < 1e-6


def test_a_drifting_odometry_is_followed() -> None:
    assert drive(seconds=10.0, bias_mps=0.15, latency_s=0.05) < 0.04


@pytest.mark.parametrize("wandered_rad", [0.5, 1.6, 3.1])
def test_an_odometry_whose_heading_has_wandered_off_is_turned_back(wandered_rad: float) -> None:
    noise = random.Random(5)  # noqa: S311  # repeatable noise, no secret
    estimate, worst, true_x, told = BaseEstimate(), 0.0, 0.0, [2.0, 1.0]
    for tick in range(2400):
        now_s = tick * PERIOD_S
        step = 0.6 * PERIOD_S if tick % 400 >= 200 else 0.0  # it starts and stops: that is when the error changes
        true_x += step
        told[0] += step * math.cos(wandered_rad)
        told[1] += step * math.sin(wandered_rad)
        odometry = (told[0], told[1], wandered_rad)
        fix = Fix(now_s, true_x + noise.gauss(0, 0.02), noise.gauss(0, 0.02), 0.0) if tick % 5 == 0 else None
        estimate = track_base(estimate, now_s, odometry, fix)
        off_x, off_y = offset(estimate, now_s, odometry)
        if tick > 100:
            worst = max(worst, math.hypot(told[0] + off_x - true_x, told[1] + off_y))
    assert worst < 0.05


def test_the_latency_of_the_fix_is_compensated() -> None:
    # Uncompensated, 0.2 s at 0.5 m/s would be an error of 0.1 m.
    assert drive(seconds=10.0, bias_mps=0.0, latency_s=0.2, sigma_m=0.0) < 0.01


def test_a_fix_counts_once() -> None:
    fix = Fix(0.0, 1.0, 0.0, 0.0)
    once = track_base(BaseEstimate(), 0.0, (0.0, 0.0, 0.0), fix)
    assert track_base(once, 0.01, (0.0, 0.0, 0.0), fix) is once


def test_the_first_fix_is_believed_and_a_later_jump_is_told() -> None:
    first = track_base(BaseEstimate(), 0.0, (0.0, 0.0, 0.0), Fix(0.0, 0.4, 0.0, 0.1))
    assert first.x_m == pytest.approx(0.4, abs=0.01)
    assert first.yaw_rad == pytest.approx(0.1)
    assert first.miss_m == 0.0
    jump = track_base(first, 0.05, (0.0, 0.0, 0.0), Fix(0.05, 1.4, 0.0, 0.1))
    assert jump.miss_m == pytest.approx(1.0, abs=0.05)


def test_yaw_is_compared_the_short_way_round() -> None:
    first = track_base(BaseEstimate(), 0.0, (0.0, 0.0, math.pi - 0.01), Fix(0.0, 0.0, 0.0, -math.pi + 0.01))
    assert first.yaw_rad == pytest.approx(0.02)


def test_the_history_is_bounded_and_a_fix_older_than_it_takes_the_oldest() -> None:
    estimate = BaseEstimate()
    for tick in range(150):
        estimate = track_base(estimate, tick * PERIOD_S, (0.0, 0.0, 0.0), None)
    assert len(estimate.history) == HISTORY
    late = track_base(estimate, 1.5, (0.0, 0.0, 0.0), Fix(-9.0, 0.1, 0.0, 0.0))
    assert math.isfinite(late.x_m)


def test_a_nan_stays_visible_in_the_estimate() -> None:
    sick = track_base(BaseEstimate(), 0.0, (0.0, 0.0, 0.0), Fix(0.0, math.nan, 0.0, 0.0))
    assert math.isnan(sick.x_m)


def test_a_walker_is_seen_where_they_are_by_now() -> None:
    people: tuple[PersonEstimate, ...] = ()
    for sample in range(40):
        stamp_s = sample * 0.05
        people = track_people(people, (PersonTrack(7, stamp_s, 5.0 - 1.6 * stamp_s, 1.0),), stamp_s + 0.06)
    at_s = people[0].stamp_s + 0.06
    x, y = now(people[0], at_s)
    assert x == pytest.approx(5.0 - 1.6 * at_s, abs=0.01)
    assert y == pytest.approx(1.0)


def test_the_same_sample_counts_once() -> None:
    track = PersonTrack(1, 0.0, 3.0, 3.0)
    first = track_people((), (track,), 0.0)
    assert track_people(first, (track,), 0.01) == first


def test_a_person_out_of_sight_is_kept_for_a_while_and_then_forgotten() -> None:
    known = track_people((), (PersonTrack(1, 0.0, 3.0, 3.0),), 0.0)
    assert track_people(known, (), FORGET_S) == known
    assert track_people(known, (), FORGET_S + 0.02) == ()
    other = (PersonTrack(2, 1.0, 6.0, 3.0),)
    assert {one.person for one in track_people(known, other, 1.0)} == {1, 2}
    assert {one.person for one in track_people(known, (PersonTrack(2, 3.0, 6.0, 3.0),), 3.0)} == {2}
    assert track_people((), (), 9.0) == ()


def test_who_comes_back_into_view_is_to_be_learned_again() -> None:
    people: tuple[PersonEstimate, ...] = ()
    for sample in range(10):
        people = track_people(people, (PersonTrack(1, sample * 0.05, 3.0, 3.0),), sample * 0.05)
    assert people[0].samples == 10
    people = track_people(people, (PersonTrack(1, 0.7, 3.0, 3.0),), 0.7)
    assert people[0].samples == 11  # one picture that lacks them is no absence
    assert track_people(people, (PersonTrack(1, 1.5, 3.0, 3.0),), 1.5)[0].samples == 1


def test_a_track_from_the_future_leaps_and_is_followed_all_the_same() -> None:
    people = track_people((), (PersonTrack(1, 30.0, 3.0, 3.0),), 0.0)
    assert people[0].leapt
    for sample in range(1, 20):
        people = track_people(people, (PersonTrack(1, sample * 0.05, 3.0 - sample * 0.05, 3.0),), sample * 0.05)
    assert not people[0].leapt
    assert people[0].x_m == pytest.approx(2.05, abs=0.02)


def test_a_track_that_was_beyond_reckoning_does_not_spoil_the_next() -> None:
    people = track_people((), (PersonTrack(1, 0.0, 1.7e308, 3.0),), 0.0)
    for sample in range(1, 20):
        people = track_people(people, (PersonTrack(1, sample * 0.05, 3.0, 3.0),), sample * 0.05)
    assert (people[0].x_m, people[0].y_m, people[0].leapt) == (3.0, 3.0, False)
    assert track_people(people, (PersonTrack(1, 1.0, -1.7e308, 3.0),), 1.0)[0].leapt


def test_nobody_is_extrapolated_far_nor_faster_than_people_run() -> None:
    people = track_people((), (PersonTrack(1, 0.0, 0.0, 0.0),), 0.0)
    for sample in range(1, 10):
        people = track_people(people, (PersonTrack(1, sample * 0.05, sample * 3.0, 0.0),), sample * 0.05)
    assert math.hypot(people[0].vx_mps, people[0].vy_mps) <= 2.5 + 1e-9
    x, _ = now(people[0], people[0].stamp_s + 60.0)
    assert x <= people[0].x_m + 2.5 * 0.3 + 1e-9


def test_a_sum_never_falls_below_zero_nor_rises_beyond_twice_the_limit() -> None:
    assert cusum(0.0, 0.9, 1.0, 0.1) == 0.0
    assert cusum(0.0, 1.05, 1.0, 0.1) == pytest.approx(0.05)
    assert cusum(0.1, 9.0, 1.0, 0.1) == pytest.approx(0.2)
    assert cusum(0.0, math.nan, 1.0, 0.1) == pytest.approx(0.2)


def pictures(
    sigmas_m: tuple[float, ...], count: int, scatter_m2: float, moving: Sighting | None = None
) -> tuple[int, float]:
    """Look `count` times at things that stand; return how often they were called strewn, and the scatter then."""
    noise = random.Random(7)  # noqa: S311  # repeatable noise, no secret
    before: tuple[Sighting, ...] = ()
    strewn = 0
    for turn in range(count):
        after = tuple(
            Sighting(f"mug_{i}", i + noise.gauss(0, sigma), noise.gauss(0, sigma)) for i, sigma in enumerate(sigmas_m)
        )
        if moving is not None:
            after += (moving._replace(x_m=moving.x_m * turn),)
        said, scatter_m2 = scattered(after, before, 0.033, scatter_m2)
        strewn += said
        before = after
    return strewn, scatter_m2


LEAST_M2, MOST_M2 = (bound**2 for bound in LOOSE_SCATTER_M)


def test_what_scatters_little_is_doubted_sooner_and_never_below_what_cameras_are_good_for() -> None:
    strewn, quiet_m2 = pictures((0.0015,) * 3, 400, MOST_M2)
    assert (strewn, quiet_m2) == (0, pytest.approx(LEAST_M2, rel=1e-3))
    leap = (Sighting("mug_0", 0.07, 0.0), Sighting("mug_1", 1.07, 0.0))
    stood = (Sighting("mug_0", 0.0, 0.0), Sighting("mug_1", 1.0, 0.0))
    assert scattered(leap, stood, 0.033, quiet_m2) == (True, quiet_m2)
    assert scattered(leap, stood, 0.033, MOST_M2)[0] is False


def test_the_noise_of_one_camera_is_not_taken_for_that_of_all() -> None:
    """Two things the exact camera sees, and two only the wide one does: by the mean of all these would be strewn."""
    strewn, scatter_m2 = pictures((0.0015, 0.0015, 0.008, 0.008), 5_000, LEAST_M2)
    assert strewn == 0
    assert scatter_m2 >= 2 * 0.008**2


@pytest.mark.parametrize("sigma_m", [0.008, 0.016])
def test_cameras_at_their_noise_and_at_twice_that_are_believed(sigma_m: float) -> None:
    strewn, scatter_m2 = pictures((sigma_m,) * 3, 5_000, MOST_M2)
    assert strewn <= 1
    assert 2 * sigma_m**2 < scatter_m2 <= MOST_M2 + 1e-12


def test_one_thing_that_is_carried_off_neither_alarms_nor_makes_the_next_leap_pass() -> None:
    strewn, scatter_m2 = pictures((0.008,) * 3, 400, LEAST_M2, Sighting("can_1", 0.02, 0.0))
    assert strewn == 0
    assert scatter_m2 < MOST_M2 / 2
    garbage = (0.1,) * 3
    assert pictures(garbage, 2, scatter_m2)[0] == 1


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_thing_that_is_nowhere_is_the_camera_known_or_not_and_teaches_nothing(value: float) -> None:
    here, nowhere = Sighting("mug_1", 1.0, 1.0), Sighting("mug_1", value, 1.0)
    assert scattered((nowhere,), (here,), 0.033, LEAST_M2) == (True, LEAST_M2)
    assert scattered((nowhere,), (), 0.033, LEAST_M2) == (True, LEAST_M2)
    assert scattered((here,), (nowhere,), 0.033, LEAST_M2) == (True, LEAST_M2)


def test_one_thing_alone_may_be_moved_as_far_as_a_hand_moves_it_and_no_farther() -> None:
    """Beside another that stands, the same leap is somebody who takes it."""
    far_m = 4.0 * math.sqrt(LEAST_M2)
    stood = (Sighting("mug_0", 0.0, 0.0),)
    taken = (Sighting("mug_0", 0.97 * ALONE * far_m, 0.0),)
    leapt = (Sighting("mug_0", 1.03 * ALONE * far_m, 0.0),)
    assert scattered(taken, stood, 0.033, LEAST_M2) == (False, LEAST_M2)
    assert scattered(leapt, stood, 0.033, LEAST_M2) == (True, LEAST_M2)
    beside = (Sighting("mug_1", 1.0, 0.0),)
    assert scattered(leapt + beside, stood + beside, 0.033, LEAST_M2) == (False, LEAST_M2)
    new = (Sighting("can_1", 5.0, 0.0),)
    assert scattered(leapt + new, stood, 0.033, LEAST_M2) == (True, LEAST_M2)
    assert scattered(leapt, stood, 0.2, LEAST_M2)[0] is False, "0.2 s explain it"


@pytest.mark.parametrize("sigma_m", [0.0015, 0.008, 0.016])
def test_one_thing_alone_is_believed_whether_it_stands_or_is_carried(sigma_m: float) -> None:
    assert pictures((sigma_m,), 5_000, MOST_M2)[0] == 0
    assert pictures((), 400, MOST_M2, Sighting("can_1", 0.02, 0.0)) == (0, pytest.approx(0.02**2 / 2, rel=1e-3))


@pytest.mark.parametrize(
    "broken",
    [
        {"odometry": (math.nan, 2.0, 0.0)},
        {"odometry": (2.0, 2.0, -math.inf)},
        {"fix": Fix(0.02, math.inf, 2.0, 0.0)},
        {"time_s": math.nan},
    ],
)
def test_while_nothing_else_is_watched_what_is_not_finite_tells_the_base_nothing(broken: dict[str, object]) -> None:
    follows = follow_base(follow_base(BaseEstimate(), seen(0)), seen(1))
    assert follows == track_base(track_base(BaseEstimate(), 0.0, *_told(0)), 0.01, *_told(1))
    assert follow_base(follows, seen(2, **broken)) is follows
    assert follow_base(follows, seen(2, fix=None)) == track_base(follows, 0.02, seen(2).odometry, None)


def _told(tick: int) -> tuple[tuple[float, float, float], Fix | None]:
    return seen(tick).odometry, seen(tick).fix
