from __future__ import annotations

import random
from math import cos, hypot, pi, sin, sqrt
from statistics import mean
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.governance.model import CONTROL_PERIOD_S, Fix
from app.sim.localisation import HISTORY_TICKS, Localiser, wrapped

FIX_TICKS = 5


class Journey(NamedTuple):
    """How a base drives and how its sensors err: metres, seconds, radians."""

    speed_mps: float = 0.0
    turn_radps: float = 0.0
    driving_s: float = 8.0
    resting_s: float = 0.0
    scale: float = 1.0
    heading_off_radpm: float = 0.0
    bias_mps: float = 0.0
    bias_from_s: float = 0.0
    late_ticks: int = 5
    noise: float = 1.0
    seed: int = 5003


def errors(journey: Journey, start: tuple[float, float, float] = (1.0, 2.0, 0.3)) -> list[tuple[float, float]]:
    """Return how far position (m) and heading (rad) are off after each tick."""
    draw = random.Random(journey.seed).gauss  # noqa: S311  # repeatable noise, no secret
    truth, odometry, localiser, found = start, start, Localiser(start), list[tuple[float, float]]()
    on_the_way: list[tuple[int, Fix]] = []
    for tick in range(1, round((journey.driving_s + journey.resting_s) / CONTROL_PERIOD_S) + 1):
        now = tick * CONTROL_PERIOD_S
        driving = now <= journey.driving_s
        v, w = (journey.speed_mps, journey.turn_radps) if driving else (0.0, 0.0)
        truth = moved(truth, v, w)
        odometry = moved(odometry, journey.scale * v, journey.scale * w + journey.heading_off_radpm * v)
        if now > journey.bias_from_s:
            odometry = (odometry[0] + journey.bias_mps * CONTROL_PERIOD_S, *odometry[1:])
        if tick % FIX_TICKS == 0:
            sigmas = (0.02, 0.02, 0.005)
            seen = [at + journey.noise * draw(0.0, sigma) for at, sigma in zip(truth, sigmas, strict=True)]
            on_the_way.append((tick + journey.late_ticks, Fix(now, seen[0], seen[1], wrapped(seen[2]))))
        fix = on_the_way.pop(0)[1] if on_the_way and on_the_way[0][0] <= tick else None
        localiser.update(now, (*odometry[:2], wrapped(odometry[2])), fix)
        x, y, yaw = localiser.pose
        found.append((hypot(x - truth[0], y - truth[1]), abs(wrapped(yaw - truth[2]))))
    return found


def moved(pose: tuple[float, float, float], v: float, w: float) -> tuple[float, float, float]:
    x, y, yaw = pose
    step = v * CONTROL_PERIOD_S
    return x + step * cos(yaw), y + step * sin(yaw), yaw + w * CONTROL_PERIOD_S


def test_fixes_that_scatter_by_28_millimetres_leave_a_quarter_of_it_at_rest():
    at_rest = [errors(Journey(driving_s=0.0, resting_s=8.0, seed=seed))[-1][0] for seed in range(5000, 5030)]
    assert sqrt(mean(off**2 for off in at_rest)) < 0.028 / 4


@pytest.mark.parametrize("late_ticks", [0, 3, 5, 20])
def test_a_fix_is_compared_with_where_the_base_was_when_it_was_taken(late_ticks: int):
    drive = Journey(speed_mps=0.6, turn_radps=0.3, noise=0.0, late_ticks=late_ticks)
    assert max(off for off, _ in errors(drive)) < 1e-6


def test_a_fix_between_two_ticks_is_compared_with_the_way_between_them():
    localiser = Localiser((0.0, 0.0, 0.0))
    for tick in range(1, 41):
        now, halfway = 0.01 * tick, 0.01 * (tick - 5.5)
        localiser.update(now, (0.6 * now, 0.0, 0.0), Fix(halfway, 0.6 * halfway, 0.0, 0.0) if tick > 6 else None)
    assert localiser.pose == pytest.approx((0.24, 0.0, 0.0), abs=1e-6)


def test_a_fix_from_before_all_that_is_remembered_teaches_nothing():
    localiser = Localiser((0.0, 0.0, 0.0))
    for tick in range(1, HISTORY_TICKS + 20):
        localiser.update(0.01 * tick, (0.0, 0.0, 0.0), None)
    localiser.update(0.01 * (HISTORY_TICKS + 20), (0.0, 0.0, 0.0), Fix(0.05, 5.0, 5.0, 1.0))
    assert localiser.pose == (0.0, 0.0, 0.0)


def test_a_heading_that_wanders_off_is_put_right_before_a_stop_and_after():
    for seed in range(5000, 5020):
        drive = Journey(speed_mps=0.6, heading_off_radpm=0.02, scale=1.005, resting_s=1.0, seed=seed)
        off = errors(drive)
        assert max(metres for metres, _ in off[-200:]) < 0.025
        assert max(radians for _, radians in off[-200:]) < 0.012


@pytest.mark.parametrize("bias_mps", [0.02, 0.05, 0.1, 0.3])
@pytest.mark.parametrize("speed_mps", [0.0, 0.4])
def test_an_odometry_that_begins_to_drift_is_followed_to_two_centimetres_within_four_seconds(
    bias_mps: float, speed_mps: float
):
    for seed in range(5000, 5008):
        drive = Journey(speed_mps=speed_mps, driving_s=11.0, bias_mps=bias_mps, bias_from_s=4.0, seed=seed)
        assert max(metres for metres, _ in errors(drive)[800:]) < 0.022


def test_the_heading_goes_round_and_round():
    off = errors(Journey(turn_radps=1.5, driving_s=12.0), start=(0.0, 0.0, pi - 0.01))
    assert max(radians for _, radians in off) < 0.02


@given(
    speed_mps=st.floats(0.0, 1.0),
    turn_radps=st.floats(-1.5, 1.5),
    bias_mps=st.floats(-0.2, 0.2),
    heading_off_radpm=st.floats(-0.03, 0.03),
    yaw_rad=st.floats(-pi, pi),
)
@settings(max_examples=25, deadline=None)
def test_at_rest_exact_fixes_leave_nothing_of_any_error_on_the_way(
    speed_mps: float, turn_radps: float, bias_mps: float, heading_off_radpm: float, yaw_rad: float
):
    journey = Journey(
        speed_mps=speed_mps,
        turn_radps=turn_radps,
        bias_mps=bias_mps,
        heading_off_radpm=heading_off_radpm,
        driving_s=3.0,
        resting_s=5.0,
        noise=0.0,
    )
    metres, radians = errors(journey, start=(0.0, 0.0, yaw_rad))[-1]
    assert metres < 0.01
    assert radians < 0.005
