from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.governance.clamp import LARGEST_TURN_RADPS, clamp, hold
from app.governance.model import Bounds, Command

BOUNDS = Bounds(tcp_speed_mps=0.25, base_speed_mps=0.3, grip_force_n=60.0, contact_force_n=100.0)
AT = (0.1, -1.0, 1.2, -0.3, 1.0, 0.2)
STILL = (0.0,) * 6
PREVIOUS = Command(AT, STILL, (0.0, 0.0, 0.0), 10.0)
JACOBIAN = (0.5, 0.2, 0.1, 0.0, 0.1, 0.0, 0.3, 0.1, 0.4, 0.1, 0.0, 0.0, 0.0, 0.5, 0.4, 0.1, 0.1, 0.0)
PERIOD_S = 0.01


def moving(
    speed_radps: tuple[float, ...], base: tuple[float, float, float] = (0.0, 0.0, 0.0), grip: float = 10.0
) -> Command:
    joints = tuple(at + speed * PERIOD_S for at, speed in zip(AT, speed_radps, strict=True))
    return Command(joints, speed_radps, base, grip)  # type: ignore[arg-type]


def tcp_speed(command: Command) -> float:
    step = [(now - then) / PERIOD_S for now, then in zip(command.joint_rad, AT, strict=True)]
    rows = [JACOBIAN[:6], JACOBIAN[6:12], JACOBIAN[12:]]
    return math.hypot(*(sum(j * q for j, q in zip(row, step, strict=True)) for row in rows))


def test_a_command_within_bounds_passes_untouched() -> None:
    command = moving((0.1, 0.1, 0.0, 0.0, 0.0, 0.0), (0.2, 0.1, 0.3))
    assert clamp(command, PREVIOUS, BOUNDS, JACOBIAN, PERIOD_S) == (command, False)


def test_the_hand_is_slowed_to_the_bound_along_its_own_way() -> None:
    command = moving((1.0, 0.5, 0.0, 0.0, 0.0, 0.0))
    held, changed = clamp(command, PREVIOUS, BOUNDS, JACOBIAN, PERIOD_S)
    assert changed
    assert tcp_speed(held) == pytest.approx(0.25)
    asked, given_ = command.joint_rad[0] - AT[0], held.joint_rad[0] - AT[0]
    assert (command.joint_rad[1] - AT[1]) / asked == pytest.approx((held.joint_rad[1] - AT[1]) / given_)


def test_a_jump_of_the_target_cannot_hide_behind_a_small_feed_forward() -> None:
    command = Command((AT[0] + 0.5, *AT[1:]), STILL, (0.0, 0.0, 0.0), 0.0)
    held, changed = clamp(command, PREVIOUS, BOUNDS, JACOBIAN, PERIOD_S)
    assert changed
    assert tcp_speed(held) <= 0.25 + 1e-9


def test_a_feed_forward_cannot_hide_behind_a_target_that_stays() -> None:
    command = Command(AT, (3.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)
    held, changed = clamp(command, PREVIOUS, BOUNDS, JACOBIAN, PERIOD_S)
    assert changed
    assert held.joint_speed_radps[0] < 3.0


def test_a_joint_that_does_not_move_the_hand_is_held_to_the_joint_speed() -> None:
    bounds = BOUNDS._replace(joint_speed_radps=1.0)
    held, changed = clamp(moving((0.0, 0.0, 0.0, 0.0, 0.0, 4.0)), PREVIOUS, bounds, JACOBIAN, PERIOD_S)
    assert changed
    assert held.joint_speed_radps[5] == pytest.approx(1.0)


def test_the_base_is_held_by_the_norm_of_its_speed_and_keeps_its_direction() -> None:
    held, changed = clamp(moving(STILL, (0.3, 0.4, 0.0)), PREVIOUS, BOUNDS, JACOBIAN, PERIOD_S)
    assert changed
    assert math.hypot(*held.base_velocity[:2]) == pytest.approx(0.3)
    assert held.base_velocity[1] / held.base_velocity[0] == pytest.approx(4 / 3)


def test_the_base_turns_no_faster_than_it_may() -> None:
    held, changed = clamp(moving(STILL, (0.0, 0.0, -9.0)), PREVIOUS, BOUNDS, JACOBIAN, PERIOD_S)
    assert changed
    assert held.base_velocity[2] == pytest.approx(-LARGEST_TURN_RADPS)


def test_the_grip_is_held_to_its_force_and_may_always_open() -> None:
    held, changed = clamp(moving(STILL, grip=80.0), PREVIOUS, BOUNDS, JACOBIAN, PERIOD_S)
    assert (held.grip_force_n, changed) == (60.0, True)
    held, changed = clamp(moving(STILL, grip=-40.0), PREVIOUS, BOUNDS, JACOBIAN, PERIOD_S)
    assert (held.grip_force_n, changed) == (-40.0, False)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", range(16))
def test_a_command_that_is_not_finite_holds(bad: float, place: int) -> None:
    flat = [*AT, *STILL, 0.0, 0.0, 0.0, 10.0]
    flat[place] = bad
    command = Command(tuple(flat[:6]), tuple(flat[6:12]), tuple(flat[12:15]), flat[15])  # type: ignore[arg-type]
    assert clamp(command, PREVIOUS, BOUNDS, JACOBIAN, PERIOD_S) == (hold(PREVIOUS), True)


def test_a_jacobian_that_is_not_finite_stops_the_arm() -> None:
    held, changed = clamp(moving((0.1,) * 6), PREVIOUS, BOUNDS, (math.nan,) * 18, PERIOD_S)
    assert changed
    assert held.joint_rad == AT
    assert held.joint_speed_radps == STILL


numbers = st.floats(-50.0, 50.0)


@given(
    speeds=st.tuples(*[numbers] * 6),
    jump=st.tuples(*[st.floats(-3.0, 3.0)] * 6),
    base=st.tuples(numbers, numbers, numbers),
    grip=st.floats(-500.0, 500.0),
)
def test_nothing_leaves_the_clamp_beyond_the_bounds(
    speeds: tuple[float, ...], jump: tuple[float, ...], base: tuple[float, float, float], grip: float
) -> None:
    command = Command(tuple(at + by for at, by in zip(AT, jump, strict=True)), speeds, base, grip)  # type: ignore[arg-type]
    held, _ = clamp(command, PREVIOUS, BOUNDS, JACOBIAN, PERIOD_S)
    again, _ = clamp(held, PREVIOUS, BOUNDS, JACOBIAN, PERIOD_S)
    assert tcp_speed(held) <= 0.25 * (1 + 1e-6)
    assert max(map(abs, held.joint_speed_radps)) <= BOUNDS.joint_speed_radps * (1 + 1e-6)
    assert math.hypot(*held.base_velocity[:2]) <= 0.3 * (1 + 1e-6)
    assert abs(held.base_velocity[2]) <= LARGEST_TURN_RADPS * (1 + 1e-6)
    assert held.grip_force_n <= 60.0
    assert again.joint_rad == pytest.approx(held.joint_rad)
