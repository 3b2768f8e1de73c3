from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.governance.detectors import STUCK_TICKS
from app.governance.intervention import Responses, leaving
from app.governance.model import (
    Alert,
    Bounds,
    Command,
    Fix,
    Frames,
    Intervention,
    Observation,
    PersonTrack,
    Response,
    SensorStamps,
    Separation,
    Sighting,
    Signal,
    SkillReport,
    WatchPlan,
    WatchRule,
    Zone,
)
from app.governance.signals import SIGNAL_NAMES, Signals, WatchState
from app.governance.watcher import Watcher, compile_watch

STILL = (0.0,) * 6
AT = (0.1, -1.0, 1.2, -0.3, 1.0, 0.2)
HOLD = Command(AT, STILL, (0.0, 0.0, 0.0), 0.0)
STOP = Response(enter=Intervention.STOP)
GAP = Separation(
    human_speed_mps=1.6,
    reaction_s=0.1,
    stopping_s=0.3,
    intrusion_m=0.2,
    position_uncertainty_m=0.08,
    robot_uncertainty_m=0.05,
)
PRESS = Zone(name="press_area", kind="forbidden", polygon=((4.6, 0.4), (6.2, 0.4), (6.2, 1.6), (4.6, 1.6)))
PLAN = WatchPlan(
    capability="navigate_to",
    profile="human-shared",
    sensitivity=0.5,
    bounds=Bounds(tcp_speed_mps=0.25, base_speed_mps=0.3, grip_force_n=60.0, contact_force_n=100.0),
    rules=(),
    zones=(PRESS,),
    separation=GAP,
    stale_after_ms={"arm": 50, "wrist": 50, "fix": 300, "people": 300},
    timeout_s=2.0,
    postconditions=(),
    params={},
)


def rule(signal: str, *, above: bool = True, threshold: float | None = None, **changes: object) -> WatchRule:
    made = WatchRule(id=signal, signal=signal, emits=Signal.VIOLATION, response=STOP, above=above, threshold=threshold)
    return replace(made, **changes)  # type: ignore[arg-type]


def seen(tick: int, **changes: object) -> Observation:
    """A healthy robot at (2, 2) that stands still; every noisy reading differs from tick to tick."""
    now_s, wobble = tick * 0.01, 1e-6 * (tick % 97)
    healthy = Observation(
        tick=tick,
        time_s=now_s,
        joint_rad=tuple(joint + wobble for joint in AT),  # type: ignore[arg-type]
        joint_speed_radps=(wobble,) * 6,
        joint_torque_nm=(10.0 + wobble,) * 6,
        residual_nm=(0.5 + wobble,) * 6,
        tcp_m=(0.4, 0.0, 0.9),
        tcp_speed_mps=wobble,
        jacobian=(0.1,) * 18,
        contact_force_n=2.0 + wobble,
        peak_force_n=3.0,
        grip_width_m=0.05 + wobble,
        grip_force_n=0.0,
        slip_m=0.0,
        pads_loaded=False,
        odometry=(2.0, 2.0, 0.0),
        base_velocity=(wobble, 0.0, 0.0),
        fix=Fix(now_s, 2.0, 2.0, 0.0),
        people=(),
        stamps_s=SensorStamps(*(now_s,) * 7),
        frames=Frames(4.0 + wobble, wobble, -wobble),
    )
    return healthy._replace(**changes)  # type: ignore[arg-type]


def run(
    plan: WatchPlan,
    stream: Sequence[Observation],
    *,
    command: Command = HOLD,
    report: SkillReport | None = None,
    **given_: object,
) -> tuple[list[tuple[Alert, ...]], WatchState, Watcher]:
    watcher = compile_watch(plan)
    state, said = watcher.begin(), []
    for tick, one in enumerate(stream):
        word = report or SkillReport("move", min(0.9, 0.001 * tick))
        state, alerts = watcher.watch(state, one, word, command, **given_)  # type: ignore[arg-type]
        said.append(alerts)
    return said, state, watcher


def first_alert(plan: WatchPlan, stream: Sequence[Observation], **given_: object) -> tuple[int | None, Alert | None]:
    said, _, _ = run(plan, stream, **given_)  # type: ignore[arg-type]
    for tick, alerts in enumerate(said):
        if alerts:
            return tick, alerts[0]
    return None, None


def watching(*rules: WatchRule, **changes: object) -> WatchPlan:
    return replace(PLAN, rules=rules, **changes)  # type: ignore[arg-type]


# -- each detector ---------------------------------------------------------------------------------------------------


def test_a_healthy_robot_is_quiet_under_every_rule() -> None:
    plan = watching(
        rule("contact_force_n"),
        rule("residual_nm", threshold=40.0),
        rule("tcp_speed_mps"),
        rule("base_speed_mps", method="cusum"),
        rule("zone_margin_m", above=False),
        rule("separation_m", above=False),
        rule("stall_s", threshold=5.0),
        rule("elapsed_s"),
        rule("retries", threshold=1.0),
        rule("slip_m", threshold=0.005),
        rule("grip_lost"),
        rule("tracking_error_rad", threshold=0.05),
        rule("base_tracking_error_mps", threshold=0.1),
        rule("sensor_age_ms"),
    )
    assert first_alert(plan, [seen(tick) for tick in range(150)]) == (None, None)


def test_contact_force_is_judged_by_its_20_ms_mean() -> None:
    plan = watching(rule("contact_force_n", threshold=100.0))
    spike = [seen(tick, contact_force_n=190.0 if tick == 5 else 2.0 + tick * 1e-6) for tick in range(10)]
    assert first_alert(plan, spike) == (None, None)
    press = [seen(tick, contact_force_n=130.0 + tick * 1e-6 if tick >= 5 else 2.0) for tick in range(10)]
    tick, alert = first_alert(plan, press)
    assert tick == 6
    assert alert is not None
    assert alert.value == pytest.approx(130.0, abs=0.1)
    assert alert.threshold == 100.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_external_torque_counts_whatever_its_direction(sign: float) -> None:
    plan = watching(rule("residual_nm", threshold=40.0))
    pushed = [seen(tick, residual_nm=(0.0, 0.0, sign * 50.0, 0.0, 0.0, 0.0)) for tick in range(3)]
    assert first_alert(plan, pushed)[0] == 0


def test_speed_limits_left_to_the_watcher_have_the_declared_headroom() -> None:
    plan = watching(rule("tcp_speed_mps"))
    assert first_alert(plan, [seen(tick, tcp_speed_mps=0.25 * 1.04) for tick in range(5)]) == (None, None)
    assert first_alert(plan, [seen(tick, tcp_speed_mps=0.25 * 1.06) for tick in range(5)])[0] == 0


def test_base_speed_is_its_norm() -> None:
    plan = watching(rule("base_speed_mps", threshold=0.32))
    fast = [seen(tick, base_velocity=(0.25, -0.25, 0.0)) for tick in range(3)]
    assert first_alert(plan, fast)[0] == 0


def test_a_cusum_adds_up_small_excesses_and_jumps_at_large_ones() -> None:
    plan = watching(rule("tcp_speed_mps", threshold=0.25, method="cusum"))
    slightly = [seen(tick, tcp_speed_mps=0.2515) for tick in range(20)]  # 0.0015 a tick against 0.005
    assert first_alert(plan, slightly)[0] == 3
    assert first_alert(plan, [seen(tick, tcp_speed_mps=0.30) for tick in range(5)])[0] == 0
    assert first_alert(plan, [seen(tick, tcp_speed_mps=0.249) for tick in range(500)]) == (None, None)


def test_a_cusum_waits_for_its_sum_and_not_for_its_debounce_as_well() -> None:
    plan = watching(rule("tcp_speed_mps", threshold=0.2, for_ms=100, method="cusum"))
    assert first_alert(plan, [seen(tick, tcp_speed_mps=0.5) for tick in range(20)])[0] == 0
    slightly = [seen(tick, tcp_speed_mps=0.211) for tick in range(20)]
    assert first_alert(plan, slightly)[0] == 3  # 4 × 0.011 > 0.02 · 0.2 · 10


def test_the_zone_margin_includes_the_way_to_standstill() -> None:
    plan = watching(rule("zone_margin_m", above=False), base_radius_m=0.45, base_deceleration_mps2=1.0)
    here = {"odometry": (3.9, 1.0, 0.0), "fix": None}  # 0.25 m from the hull to the zone
    _, state, _ = run(plan, [seen(0, **here)])
    assert state.signals.zone_margin_m == pytest.approx(0.25)
    slow = [seen(tick, base_velocity=(0.3, 0.0, 0.0), **here) for tick in range(3)]  # needs 0.06 m
    assert first_alert(plan, slow) == (None, None)
    fast = [seen(tick, base_velocity=(0.8, 0.0, 0.0), **here) for tick in range(3)]  # needs 0.36 m
    assert first_alert(plan, fast)[0] == 0
    away = [seen(tick, base_velocity=(-0.8, 0.0, 0.0), **here) for tick in range(3)]
    assert first_alert(plan, away) == (None, None)


@pytest.mark.parametrize(
    ("inside_m", "vx", "alarms"),
    [(0.01, 0.0, False), (0.01, -0.2, False), (0.01, 0.02, True), (0.05, 0.0, True), (0.05, -0.2, True)],
)
def test_a_base_stopped_at_a_zone_s_edge_may_stand_there_and_back_out(inside_m: float, vx: float, alarms: bool) -> None:
    plan = watching(rule("zone_margin_m", above=False, threshold=0.0), base_radius_m=0.45)
    here = {"odometry": (4.15 + inside_m, 1.0, 0.0), "base_velocity": (vx, 0.0, 0.0), "fix": None}
    assert (first_alert(plan, [seen(tick, **here) for tick in range(3)])[0] == 0) is alarms


def test_the_zone_margin_is_negative_inside_and_sees_a_corner_on_the_way() -> None:
    plan = watching(rule("zone_margin_m", above=False), base_radius_m=0.1)
    _, inside, _ = run(plan, [seen(0, odometry=(5.0, 1.0, 0.0), fix=None)])
    assert inside.signals.zone_margin_m < -0.4
    # From north-west of the corner (4.6, 1.6) to its east: both ends are farther off than the corner is from the way.
    past = seen(0, odometry=(4.2, 1.75, 0.0), base_velocity=(1.2, 0.0, 0.0), fix=None)
    _, state, _ = run(plan, [past])
    assert state.signals.zone_margin_m == pytest.approx(0.05, abs=0.02)


@pytest.mark.parametrize("order", [1, -1])
def test_of_several_zones_the_nearest_counts_whatever_their_order(order: int) -> None:
    farther = Zone(name="pit", kind="forbidden", polygon=((4.8, 2.2), (5.8, 2.2), (5.8, 3.0), (4.8, 3.0)))
    plan = watching(rule("zone_margin_m", above=False), zones=(PRESS, farther)[::order], base_radius_m=0.45)
    _, state, _ = run(plan, [seen(0, odometry=(4.0, 1.0, 0.0), fix=None)])
    assert state.signals.zone_margin_m == pytest.approx(0.15)


def test_the_zone_is_judged_by_the_fix_where_odometry_drifts() -> None:
    plan = watching(rule("zone_margin_m", above=False))
    stream = [
        seen(tick, odometry=(2.0, 1.0, 0.0), fix=Fix(tick * 0.01, 2.0 + 0.003 * tick, 1.0, 0.0)) for tick in range(900)
    ]
    tick, _ = first_alert(plan, stream)
    assert tick is not None
    true_x = 2.0 + 0.003 * tick
    assert 4.6 - 0.45 - true_x == pytest.approx(0.0, abs=0.1)


def leaving_under_a_bias(vx_mps: float, *, slips: bool) -> list[Observation]:
    """At a zone's edge, four seconds after odometry began to drift by 0.1 m/s: at rest until then, then it creeps.

    The drift is a bias of the odometry alone, or that of wheels that slip: then it is the base that moves.
    """
    stream = []
    for tick in range(500):
        went_m = max(0, tick - 400) * 0.01 * vx_mps
        drift_m = 0.001 * tick - 0.4
        odometry_x = 4.1 + went_m - (0.0 if slips else drift_m)
        true_x = 4.1 + went_m + (drift_m if slips else 0.0)
        stream.append(
            seen(
                tick,
                odometry=(odometry_x, 1.0, 0.0),
                base_velocity=(vx_mps if tick > 400 else 0.0, 0.0, 0.0),
                fix=Fix(tick * 0.01, true_x, 1.0, 0.0),
            )
        )
    return stream


def test_a_bias_of_the_odometry_is_no_motion_and_does_not_keep_the_base_from_creeping_out_of_a_zone() -> None:
    plan = watching(rule("zone_margin_m", above=False, threshold=0.0), base_radius_m=0.45)
    assert first_alert(plan, leaving_under_a_bias(-0.03, slips=False)) == (None, None)
    _, state, _ = run(plan, leaving_under_a_bias(-0.03, slips=False)[:420])
    assert state.signals.zone_margin_m == pytest.approx(0.05 + 0.006, abs=0.003)


def test_wheels_that_slip_towards_a_zone_are_judged_by_where_they_slip_and_not_by_the_drives() -> None:
    plan = watching(rule("zone_margin_m", above=False, threshold=0.0), base_radius_m=0.45, base_deceleration_mps2=1.0)
    _, state, _ = run(plan, leaving_under_a_bias(-0.03, slips=True)[:402])
    moving_m = 0.07 * (0.05 + 0.07 / 2.0)  # 0.1 m/s of slip less 0.03 m/s of driving, to standstill
    assert state.signals.zone_margin_m == pytest.approx(0.05 - moving_m, abs=0.002)


def test_what_the_odometry_did_since_it_was_no_number_is_unknown_and_a_jump_is_left_to_the_position() -> None:
    plan = watching(rule("zone_margin_m", above=False))
    drives = {"base_velocity": (0.1, 0.0, 0.0), "fix": None}
    near = {"odometry": (3.2, 2.0, 0.0), **drives}  # far off, where the base is says enough
    broken = [seen(0, **near), seen(1, odometry=(math.nan, 2.0, 0.0), **drives), seen(2, **near)]
    margins = [run(plan, broken[: count + 1])[1].signals.zone_margin_m for count in range(3)]
    assert margins[0] > 0.0
    assert all(math.isnan(margin) for margin in margins[1:])
    jumped = [seen(0, **near), seen(1, odometry=(3.5, 2.0, 0.0), **drives)]  # 30 m/s
    assert run(plan, jumped)[1].signals.zone_margin_m == pytest.approx(margins[0] - 0.28, abs=0.03)


def expected_gap(closing_mps: float) -> float:
    """S_p = v_h (T_r + T_s) + v_r T_r + v_r T_s / 2 + C + Z_d + Z_r."""
    return 1.6 * (0.1 + 0.3) + closing_mps * 0.1 + closing_mps * 0.3 / 2 + 0.2 + 0.08 + 0.05


@pytest.mark.parametrize(("vx", "closing"), [(0.0, 0.0), (0.3, 0.3), (-0.3, 0.0)])
def test_the_protective_separation_follows_the_standard_with_directed_robot_speed(vx: float, closing: float) -> None:
    plan = watching(rule("separation_m", above=False))
    person = (PersonTrack(1, 0.0, 4.0, 2.0),)
    _, state, _ = run(plan, [seen(0, people=person, base_velocity=(vx, 0.0, 0.0), joint_speed_radps=STILL)])
    assert state.signals.protective_separation_m == pytest.approx(expected_gap(closing))
    assert state.signals.separation_m == pytest.approx(2.0 - 0.45)


def test_the_hand_counts_where_it_is_nearer_than_the_hull() -> None:
    plan = watching(rule("separation_m", above=False))
    person = (PersonTrack(1, 0.0, 4.0, 2.0),)
    _, state, _ = run(plan, [seen(0, people=person, tcp_m=(0.9, 0.0, 0.9))])
    assert state.signals.separation_m == pytest.approx(4.0 - 2.9)


@pytest.mark.parametrize("order", [1, -1])
def test_of_several_people_the_one_with_the_least_left_counts_whatever_their_order(order: int) -> None:
    plan = watching(rule("separation_m", above=False, threshold=0.25), base_radius_m=0.45)
    near, far = PersonTrack(1, 0.0, 2.0, 3.0), PersonTrack(2, 0.0, 2.0, 5.0)
    (_, alone, _), (_, both, _) = (
        run(plan, [seen(0, people=people, joint_speed_radps=STILL)]) for people in ((near,), (near, far)[::order])
    )
    assert both.signals.separation_ahead_m == alone.signals.separation_ahead_m
    assert both.signals.separation_m == alone.signals.separation_m


def test_separation_alarms_below_the_computed_distance_and_reports_it() -> None:
    plan = watching(rule("separation_m", above=False))
    need = expected_gap(0.0) + 0.45
    near = [
        seen(t, people=(PersonTrack(1, t * 0.01, 2.0 + need - 0.02, 2.0),), joint_speed_radps=STILL) for t in range(3)
    ]
    far = [
        seen(t, people=(PersonTrack(1, t * 0.01, 2.0 + need + 0.02, 2.0),), joint_speed_radps=STILL) for t in range(3)
    ]
    assert first_alert(plan, far) == (None, None)
    tick, alert = first_alert(plan, near)
    assert tick == 0
    assert alert is not None
    assert alert.threshold == pytest.approx(expected_gap(0.0), abs=1e-3)


def test_the_person_with_the_least_margin_counts() -> None:
    plan = watching(rule("separation_m", above=False))
    people = (PersonTrack(1, 0.0, 7.0, 2.0), PersonTrack(2, 0.0, 2.9, 2.0), PersonTrack(3, 0.0, 2.0, 5.0))
    assert first_alert(plan, [seen(0, people=people)])[0] == 0


def test_whoever_is_hidden_for_a_moment_is_still_there() -> None:
    plan = watching(rule("separation_m", above=False))
    stream = [seen(t, people=(PersonTrack(1, t * 0.01, 2.9, 2.0),) if t < 10 else ()) for t in range(60)]
    said, _, _ = run(plan, stream)
    assert said[59]


def test_a_numeric_separation_needs_no_constants() -> None:
    plan = watching(rule("separation_m", above=False, threshold=0.5), separation=None)
    assert first_alert(plan, [seen(0, people=(PersonTrack(1, 0.0, 2.9, 2.0),))])[0] == 0
    assert first_alert(plan, [seen(0, people=(PersonTrack(1, 0.0, 3.1, 2.0),))]) == (None, None)


@pytest.mark.parametrize(
    ("enter", "kept_m"), [(Intervention.PAUSE, 0.5), (Intervention.STOP, 0.5), (Intervention.CONTINUE, 0.0)]
)
def test_a_distance_that_a_rule_keeps_is_shown_as_what_there_has_to_be(enter: Intervention, kept_m: float) -> None:
    near = rule("separation_m", above=False, threshold=0.5, response=replace(STOP, enter=enter))
    for people in ((), (PersonTrack(1, 0.0, 2.9, 2.0),)):
        _, state, _ = run(watching(near, separation=None), [seen(0, people=people)])
        assert state.signals.protective_separation_m == kept_m
    assert state.signals.separation_margin_m == pytest.approx(state.signals.separation_m - kept_m)


def test_a_stall_is_no_progress_and_no_motion_and_a_pause_is_none() -> None:
    plan = watching(rule("stall_s", threshold=1.0))
    stuck = SkillReport("press", 0.4)
    assert first_alert(plan, [seen(tick) for tick in range(200)], report=stuck)[0] == 101
    assert first_alert(plan, [seen(tick) for tick in range(200)], report=stuck, rate=0.0) == (None, None)
    moving = [seen(tick, tcp_speed_mps=0.1) for tick in range(200)]
    assert first_alert(plan, moving, report=stuck) == (None, None)


def test_the_timeout_counts_the_time_a_session_may_move() -> None:
    plan = watching(rule("elapsed_s", emits=Signal.TIMEOUT, failure="timeout"))
    tick, alert = first_alert(plan, [seen(tick) for tick in range(250)])
    assert tick == 200
    assert alert is not None
    assert (alert.signal, alert.failure, alert.threshold) == (Signal.TIMEOUT, "timeout", 2.0)
    assert first_alert(plan, [seen(tick) for tick in range(250)], rate=0.0) == (None, None)


def test_retries_and_unmet_postconditions_are_what_governance_counted() -> None:
    plan = watching(rule("retries", threshold=1.0))
    assert first_alert(plan, [seen(0)], retried=1) == (None, None)
    assert first_alert(plan, [seen(0)], retried=2)[0] == 0
    tick, alert = first_alert(plan, [seen(0)], unmet=1)
    assert tick == 0
    assert alert is not None
    assert alert.failure == "postcondition_failed"


GRIPPING = HOLD._replace(grip_force_n=30.0)


@pytest.mark.parametrize(("rate", "told"), [(1.0, ["retries"]), (0.0, [])])
def test_a_hand_that_closes_again_is_a_retry_but_not_where_a_hold_had_stopped_it(rate: float, told: list[str]) -> None:
    watcher = compile_watch(watching(rule("retries", threshold=0.5)))
    state, alerts, close = watcher.begin(), (), SkillReport("close", 0.5)
    for tick, (command, went) in enumerate([(HOLD, 1.0), (GRIPPING, 1.0), (HOLD, rate), (GRIPPING, 1.0)]):
        state, alerts = watcher.watch(state, seen(tick), close, command, went)
    assert [alert.rule for alert in alerts] == told


def test_slip_counts_from_the_grip_and_starts_anew_with_the_next_one() -> None:
    plan = watching(rule("slip_m", threshold=0.005))
    slipping = [seen(t, slip_m=0.002 + 0.001 * t, pads_loaded=True) for t in range(20)]
    assert first_alert(plan, slipping, command=GRIPPING)[0] == 6
    assert first_alert(plan, slipping, command=HOLD) == (None, None)
    anew = [seen(t, slip_m=0.004 if t < 10 else 0.0, pads_loaded=True) for t in range(20)]
    assert first_alert(plan, anew, command=GRIPPING) == (None, None)


def test_a_grip_is_lost_when_it_was_held_and_the_pads_are_empty() -> None:
    plan = watching(rule("grip_lost"))
    dropped = [seen(t, pads_loaded=t < 20) for t in range(40)]
    assert first_alert(plan, dropped, command=GRIPPING)[0] == 22
    assert first_alert(plan, dropped, command=HOLD._replace(grip_force_n=-20.0)) == (None, None)
    bouncing = [seen(t, pads_loaded=t % 2 == 0) for t in range(40)]
    assert first_alert(plan, bouncing, command=GRIPPING) == (None, None)


def test_a_fist_holds_nothing_and_pads_that_meet_have_lost_what_was_between_them() -> None:
    plan = watching(rule("grip_lost"))
    fist = [seen(t, pads_loaded=t < 20, grip_width_m=0.001, frames=None) for t in range(40)]
    assert first_alert(plan, fist, command=GRIPPING) == (None, None)
    shut = [seen(t, pads_loaded=True, grip_width_m=0.02 if t < 20 else 0.001, frames=None) for t in range(40)]
    assert first_alert(plan, shut, command=GRIPPING)[0] == 22


def test_tracking_compares_what_was_told_with_what_is_seen() -> None:
    plan = watching(rule("tracking_error_rad", threshold=0.05))
    off = HOLD._replace(joint_rad=(AT[0], AT[1] + 0.1, *AT[2:]))
    assert first_alert(plan, [seen(0)], command=off)[0] == 0
    plan = watching(rule("base_tracking_error_mps", threshold=0.1))
    told = HOLD._replace(base_velocity=(0.2, 0.0, 0.0))
    assert first_alert(plan, [seen(0)], command=told)[0] == 0


def test_each_sensor_has_its_own_age_and_the_stale_ones_are_named() -> None:
    plan = watching(rule("sensor_age_ms"))
    stale = [seen(t, stamps_s=SensorStamps(*(t * 0.01,) * 7)._replace(wrist=0.0)) for t in range(20)]
    tick, alert = first_alert(plan, stale)
    assert tick == 6
    assert alert is not None
    assert alert.value == pytest.approx(60.0)
    assert alert.threshold == pytest.approx(50.0)
    _, _, watcher = run(plan, stale)
    assert watcher.stale_sensors(stale[-1]) == ("wrist",)
    assert (watcher.signal_of("sensor_age_ms"), watcher.signal_of("no such rule")) == ("sensor_age_ms", "")
    assert first_alert(
        plan, [seen(t, stamps_s=SensorStamps(*(t * 0.01,) * 7)._replace(fix=0.0)) for t in range(20)]
    ) == (None, None)


MOVING = HOLD._replace(joint_speed_radps=(0.1,) * 6, base_velocity=(0.1, 0.0, 0.0))


@pytest.mark.parametrize(
    "field", ["contact_force_n", "joint_torque_nm", "joint_rad", "joint_speed_radps", "base_velocity"]
)
def test_a_reading_that_repeats_bit_by_bit_while_moving_is_implausible(field: str) -> None:
    frozen = getattr(seen(0), field)
    stream = [seen(tick, **{field: frozen}) for tick in range(40)]
    assert first_alert(PLAN, stream, command=MOVING)[0] == STUCK_TICKS
    assert first_alert(PLAN, stream, command=HOLD) == (None, None)


@pytest.mark.parametrize("moved", ["joint_speed_radps", "base_velocity"])
def test_only_a_full_hand_s_reading_cannot_repeat(moved: str) -> None:
    command = HOLD._replace(**{moved: getattr(MOVING, moved)})
    empty = [seen(tick, grip_force_n=0.0, pads_loaded=False) for tick in range(40)]
    assert first_alert(PLAN, empty, command=command) == (None, None)
    full = [one._replace(grip_force_n=20.0, pads_loaded=True) for one in empty]
    assert first_alert(PLAN, full, command=command)[0] == STUCK_TICKS


@pytest.mark.parametrize(("sensor", "field"), [("wrist", "contact_force_n"), ("odometry", "base_velocity")])
def test_a_reading_that_repeats_under_its_old_stamp_is_stale_and_not_implausible(sensor: str, field: str) -> None:
    frozen = {field: getattr(seen(0), field)}
    stream = [
        one._replace(stamps_s=one.stamps_s._replace(**{sensor: 0.0}), **frozen)
        for one in (seen(tick) for tick in range(40))
    ]
    plan = watching(rule("implausible", threshold=0.5))
    assert first_alert(plan, stream, command=MOVING) == (None, None)


@pytest.mark.parametrize(
    "changes",
    [
        {"joint_rad": (9.0, *AT[1:])},
        {"joint_speed_radps": (0.0, -30.0, 0.0, 0.0, 0.0, 0.0)},
        {"joint_torque_nm": (5000.0,) * 6},
        {"contact_force_n": -1.0},
        {"contact_force_n": 1e6},
        {"grip_width_m": 3.0},
        {"tcp_m": (9.0, 0.0, 0.0)},
        {"base_velocity": (50.0, 0.0, 0.0)},
        {"stamps_s": SensorStamps(9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)},
        {"time_s": 0.0},
        {"fix": Fix(0.05, 9.0, 2.0, 0.0)},
        {"fix": Fix(0.05, 2.0, 2.0, 1.0)},
    ],
)
def test_a_reading_that_cannot_be_is_implausible(changes: dict[str, object]) -> None:
    stream = [seen(tick, fix=Fix(0.0, 2.0, 2.0, 0.0)) for tick in range(5)]
    tick, alert = first_alert(PLAN, [*stream, seen(5, **changes)])
    assert tick == 5
    assert alert is not None
    assert alert.rule == "watch/implausible"


SIGHTED = (Sighting("mug_1", 2.5, 2.1), Sighting("can_1", 2.6, 1.9), Sighting("tin_1", 2.9, 2.4))
LEAPT = {
    "joints": {"joint_rad": tuple(joint + 0.2 for joint in AT)},
    "fingers": {"grip_width_m": 0.1},
    "somebody": {"people": (PersonTrack(1, 0.05, 5.0, 3.5),)},
    "things": {"sightings": (Sighting("mug_1", 2.7, 2.1), Sighting("can_1", 2.6, 1.7), Sighting("tin_1", 2.9, 2.4))},
}


@pytest.mark.parametrize("what", LEAPT)
def test_what_leaps_as_no_body_can_is_doubted_for_longer_than_it_takes_to_end_the_session(what: str) -> None:
    """One tick in which it leaps, and then it stays there as if nothing were: an offset."""
    there = {"people": (PersonTrack(1, 0.0, 5.0, 2.0),), "sightings": SIGHTED}
    stream = [seen(tick, **there) for tick in range(5)]
    lied = dict(LEAPT[what])
    for tick in range(5, 600):
        stands = {**there, **lied}
        if "joint_rad" in lied:
            stands["joint_rad"] = tuple(joint + 1e-6 * tick for joint in LEAPT[what]["joint_rad"])
        if "grip_width_m" in lied:
            stands["grip_width_m"] = 0.1 + 1e-6 * (tick % 97)
        stream.append(seen(tick, **stands))
    said, _, _ = run(watching(rule("implausible", threshold=0.5)), stream)
    alarms = [tick for tick, alerts in enumerate(said) if alerts]
    assert alarms[0] == 5
    assert 500 <= len(alarms) <= 720
    assert alarms == list(range(5, 5 + len(alarms)))


def test_what_was_doubted_is_doubted_in_the_next_attempt_as_well() -> None:
    watcher = compile_watch(watching(rule("implausible", threshold=0.5)))
    _, state, _ = run(watcher.plan, [seen(0), seen(1, grip_width_m=0.1), seen(2, grip_width_m=0.101)])
    assert watcher.watch(watcher.begin(state), seen(3, grip_width_m=0.102), SkillReport("move", 0.1), HOLD)[1]


def test_an_arm_that_is_off_its_track_and_a_sample_that_comes_late_have_not_leapt() -> None:
    plan = watching(rule("implausible", threshold=0.5))
    off = HOLD._replace(joint_rad=tuple(joint + 0.2 for joint in AT))  # type: ignore[arg-type]
    assert first_alert(plan, [seen(tick) for tick in range(40)], command=off) == (None, None)
    late = [seen(0), seen(1, stamps_s=SensorStamps(*(0.0,) * 7), joint_rad=seen(0).joint_rad, grip_width_m=0.05)]
    moved = seen(20, joint_rad=tuple(joint + 0.2 for joint in AT), grip_width_m=0.1)
    assert first_alert(plan, [*late, moved], command=off) == (None, None)
    assert first_alert(plan, [seen(0), moved._replace(stamps_s=SensorStamps(*(0.01,) * 7))])[0] == 1


@pytest.mark.parametrize(
    ("sighted", "gap_s", "believed"),
    [
        ({}, 0.1, True),
        ({"mug_1": (3.5, 2.1)}, 0.1, True),  # somebody took it: one thing alone may go anywhere
        ({"mug_1": (2.61, 2.1), "can_1": (2.6, 1.79), "tin_1": (2.79, 2.4)}, 0.1, True),  # noise
        ({"mug_1": (2.63, 2.1), "can_1": (2.6, 1.77)}, 0.1, False),
        ({"mug_1": (2.63, 2.1), "can_1": (2.6, 1.77)}, 0.2, True),  # two hands can in so long
        ({"mug_1": (math.nan, 2.1)}, 0.1, False),
        ({"mug_1": (2.5, -math.inf)}, 0.1, False),
    ],
)
def test_two_things_that_move_at_once_as_nothing_moves_them_are_the_camera(
    sighted: dict[str, tuple[float, float]], gap_s: float, believed: bool
) -> None:
    stamps = SensorStamps(*(0.2,) * 6, 0.2 - gap_s)
    stream = [seen(20, stamps_s=stamps, sightings=SIGHTED)]
    moved = tuple(Sighting(name, *sighted.get(name, (x, y))) for name, x, y in SIGHTED)
    stream.append(seen(21, stamps_s=SensorStamps(*(0.21,) * 6, 0.2), sightings=moved))
    tick, _ = first_alert(watching(rule("implausible", threshold=0.5)), stream)
    assert tick == (None if believed else 1)


def test_what_comes_into_view_has_not_leapt() -> None:
    stream = [seen(0, sightings=()), seen(1, sightings=SIGHTED), seen(2, sightings=SIGHTED[1:]), seen(3)]
    assert first_alert(watching(rule("implausible", threshold=0.5)), stream) == (None, None)


@pytest.mark.parametrize("sensor", ["fix", "people", "objects"])
def test_a_picture_that_comes_again_under_a_new_stamp_is_no_picture_until_another_comes(sensor: str) -> None:
    one = getattr(seen(20).frames, sensor)
    stream = [seen(tick) for tick in range(21)]
    for tick in range(21, 40):  # a new sample every fifth tick, of which those of this sensor are all the same
        sampled = seen(tick - tick % 5)
        frames = sampled.frames._replace(**{sensor: one})
        stream.append(seen(tick, frames=frames, stamps_s=SensorStamps(*seen(tick).stamps_s[:4], *sampled.stamps_s[4:])))
    said, _, _ = run(PLAN, [*stream, *(seen(tick) for tick in range(40, 45))])
    alarms = [tick for tick, alerts in enumerate(said) if alerts]
    assert alarms == list(range(25, 40))
    assert {alert.rule for alerts in said for alert in alerts} == {"watch/implausible"}


def test_without_anything_to_tell_pictures_apart_by_none_is_called_frozen() -> None:
    assert first_alert(PLAN, [seen(tick, frames=None, grip_width_m=0.05) for tick in range(40)]) == (None, None)


def test_an_open_gripper_that_says_the_same_width_again_and_again_is_stuck() -> None:
    stream = [seen(tick, grip_width_m=0.05) for tick in range(40)]
    assert first_alert(PLAN, stream, command=HOLD)[0] == STUCK_TICKS


def walker(speed_mps: float, from_m: float, ticks: int) -> list[Observation]:
    """Somebody who walks up to the robot's front at a constant speed; the tracker says where they are every 50 ms."""
    return [
        seen(
            tick,
            base_velocity=(0.5, 1e-6 * (tick % 97), 0.0),
            odometry=(2.0, 2.0, 0.0),
            people=(PersonTrack(1, 0.05 * (tick // 5), 2.45 + from_m - speed_mps * 0.05 * (tick // 5), 2.0),),
        )
        for tick in range(ticks)
    ]


HOLDING_OFF = replace(STOP, enter=Intervention.PAUSE, then="resume", clear_after_ms=1000)


def test_a_fixed_distance_is_kept_ahead_of_whoever_comes_on_and_named_as_it_is_for_whoever_stands() -> None:
    near = rule("separation_m", above=False, threshold=1.0)
    plan = watching(replace(near, response=HOLDING_OFF), base_radius_m=0.45, base_deceleration_mps2=1.0)
    standing = [one._replace(base_velocity=(0.0, 0.0, 0.0), tcp_m=(0.0, 0.0, 0.9)) for one in walker(0.0, 1.2, 60)]
    assert first_alert(plan, standing) == (None, None)
    stream = [one._replace(tcp_m=(0.0, 0.0, 0.9)) for one in walker(2.0, 3.5, 200)]
    tick, alert = first_alert(plan, stream)
    assert tick is not None
    assert alert is not None
    assert 1.9 < 3.5 - 2.0 * 0.01 * tick < 2.6  # 2 m/s for 0.6 s, half a second's braking from 0.5 m/s, 0.85 m left
    warned = watching(replace(near, response=replace(STOP, enter=Intervention.CONTINUE)), base_radius_m=0.45)
    late, _ = first_alert(warned, stream)
    assert late is not None
    assert 3.5 - 2.0 * 0.01 * late == pytest.approx(1.0, abs=0.12)  # who only warns says where somebody is


def test_who_comes_from_the_side_comes_as_long_as_the_robot_moves() -> None:
    near = rule("separation_m", above=False, threshold=1.0)
    plan = watching(replace(near, response=HOLDING_OFF), base_radius_m=0.45, base_deceleration_mps2=1.0)

    def alerted_at_m(speed_mps: float) -> float:
        """Return how far off somebody was, who walks at 1.5 m/s at right angles to the way of the robot."""
        stream = [
            seen(
                tick,
                base_velocity=(speed_mps, 1e-6 * (tick % 97), 0.0),
                tcp_m=(0.0, 0.0, 0.9),
                people=(PersonTrack(1, 0.05 * (tick // 5), 2.0, 2.45 + 3.5 - 1.5 * 0.05 * (tick // 5)),),
            )
            for tick in range(250)
        ]
        tick, _ = first_alert(plan, stream)
        assert tick is not None
        return 3.5 - 1.5 * 0.01 * tick

    # Half a second of braking, and the 0.1 s until it begins, at 1.5 m/s: 0.9 m, of which 0.15 m may be lost.
    assert alerted_at_m(0.0) == pytest.approx(1.0, abs=0.08)
    assert alerted_at_m(0.5) == pytest.approx(1.75, abs=0.08)


def test_a_base_that_turns_moves_the_hand() -> None:
    plan = watching(rule("separation_m", above=False))
    person = (PersonTrack(1, 0.0, 2.9, 4.0),)  # beside the hand, which a turn to the left brings nearer
    hand = {"people": person, "tcp_m": (0.9, 0.0, 0.9), "joint_speed_radps": STILL}
    _, turning, _ = run(plan, [seen(0, base_velocity=(0.0, 0.0, 1.0), **hand)])
    _, away, _ = run(plan, [seen(0, base_velocity=(0.0, 0.0, -1.0), **hand)])
    assert turning.signals.protective_separation_m == pytest.approx(expected_gap(0.9))
    assert away.signals.protective_separation_m == pytest.approx(expected_gap(0.0))


def test_whoever_has_just_come_into_view_may_come_as_fast_as_people_walk() -> None:
    near = rule("separation_m", above=False, threshold=1.0)
    plan = watching(replace(near, response=HOLDING_OFF), base_radius_m=0.45, base_deceleration_mps2=1.0)
    driving = [one._replace(tcp_m=(0.0, 0.0, 0.9)) for one in walker(0.0, 1.9, 60)]
    held = [bool(alerts) for alerts in run(plan, driving)[0]]
    assert held[0]  # 1.6 m/s for 0.6 s would leave less than 0.85 m
    assert not any(held[30:])  # known by then: somebody who stands
    standing = [one._replace(base_velocity=(0.0, 0.0, 0.0), joint_speed_radps=STILL) for one in driving]
    assert first_alert(plan, standing) == (None, None)


@pytest.mark.parametrize(("speed_mps", "more_m"), [(1.2, 0.0), (2.0, 0.4 * (0.1 + 0.3))])
def test_who_comes_faster_than_people_walk_needs_more_separation(speed_mps: float, more_m: float) -> None:
    plan = watching(rule("separation_m", above=False))
    stream = [one._replace(base_velocity=(0.0, 0.0, 0.0), joint_speed_radps=STILL) for one in walker(speed_mps, 5, 120)]
    _, state, _ = run(plan, stream)
    assert state.signals.protective_separation_m == pytest.approx(expected_gap(0.0) + more_m, abs=0.03)


FLOATS = [name for name in Observation._fields if name not in ("tick", "pads_loaded", "fix", "people", "sightings")]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", FLOATS)
def test_a_reading_that_is_not_finite_is_never_all_is_well(field: str, bad: float) -> None:
    healthy = getattr(seen(5), field)
    sick: object = bad if isinstance(healthy, float) else (*healthy[:-1], bad)
    if field == "stamps_s":
        sick = SensorStamps(*sick)  # type: ignore[misc]
    stream = [seen(tick) for tick in range(5)] + [seen(5, **{field: sick})]
    assert first_alert(PLAN, stream)[0] == 5


@pytest.mark.parametrize(
    "sick",
    [
        {"fix": Fix(0.05, math.nan, 2.0, 0.0)},
        {"people": (PersonTrack(1, 0.05, math.nan, 0.0),)},
        {"sightings": (Sighting("mug_1", math.nan, 0.0),)},
        {"sightings": (Sighting("mug_1", 0.0, math.inf),)},
    ],
)
def test_what_is_nowhere_is_never_all_is_well(sick: dict[str, object]) -> None:
    assert first_alert(PLAN, [seen(tick) for tick in range(5)] + [seen(5, **sick)])[0] == 5


def test_where_the_base_is_stays_known_after_a_reading_that_was_none() -> None:
    stream = [seen(tick) for tick in range(9)]
    stream[5] = seen(5, odometry=(math.inf, math.nan, 0.0))
    said, state, _ = run(watching(rule("zone_margin_m", above=False)), stream)
    assert {alert.rule for alert in said[5]} == {"zone_margin_m", "watch/implausible"}
    assert said[8] == ()
    assert state.signals.base_x_m == pytest.approx(2.0)


def test_a_signal_that_is_nan_violates_its_rule_in_both_directions() -> None:
    plan = watching(rule("tcp_speed_mps", id="above"), rule("tcp_speed_mps", id="below", above=False, threshold=-1.0))
    said, _, _ = run(plan, [seen(0, tcp_speed_mps=math.nan)])
    assert {alert.rule for alert in said[0]} == {"above", "below", "watch/implausible"}
    summed = watching(rule("tcp_speed_mps", method="cusum"))
    assert "tcp_speed_mps" in {alert.rule for alert in run(summed, [seen(0, tcp_speed_mps=math.nan)])[0][0]}


# -- debounce, attempts, plans that cannot be watched ----------------------------------------------------------------


@pytest.mark.parametrize(("sensitivity", "first"), [(0.0, 9), (0.5, 4), (0.9, 0), (1.0, 0)])
def test_a_violation_must_last_for_its_debounce_scaled_by_sensitivity(sensitivity: float, first: int) -> None:
    plan = watching(rule("tcp_speed_mps", threshold=0.2, for_ms=50), sensitivity=sensitivity)
    assert first_alert(plan, [seen(tick, tcp_speed_mps=0.3) for tick in range(20)])[0] == first


def test_an_interruption_starts_the_debounce_anew() -> None:
    plan = watching(rule("tcp_speed_mps", threshold=0.2, for_ms=50))
    broken = [seen(tick, tcp_speed_mps=0.1 if tick % 4 == 3 else 0.3) for tick in range(40)]
    assert first_alert(plan, broken) == (None, None)


WAITING = replace(STOP, enter=Intervention.PAUSE, then="resume", clear_after_ms=40, clear_beyond=0.05)


def heard(
    watcher: Watcher, speeds_mps: Sequence[float], state: WatchState | None = None, start: int = 0
) -> tuple[list[str], WatchState]:
    """Return by tick what is said of each speed, `!` with the threshold of an alert, and the last state."""
    said: list[str] = []
    state = watcher.begin() if state is None else state
    for tick, speed_mps in enumerate(speeds_mps, start):
        state, alerts = watcher.watch(state, seen(tick, tcp_speed_mps=speed_mps), SkillReport("move", 0.5), HOLD)
        said.append("".join(f"!{alert.threshold:g}" for alert in alerts))
    return said, state


def test_what_has_spoken_is_over_once_it_is_clear_by_the_distance_for_as_long_as_policy_says() -> None:
    watcher = compile_watch(watching(rule("tcp_speed_mps", threshold=0.2, response=WAITING), sensitivity=1.0))
    assert heard(watcher, [0.19, 0.21, 0.19, 0.16, 0.21])[0] == ["", "!0.2", "!0.15", "!0.15", "!0.2"]
    once = [0.21, 0.14, 0.14, 0.14, 0.16, 0.16]  # clear for 30 ms is not clear yet
    assert heard(watcher, once)[0] == ["!0.2", "", "", "", "!0.15", "!0.15"]
    over = [0.21, 0.14, 0.14, 0.14, 0.14, 0.16, 0.19, 0.21]
    assert heard(watcher, over)[0] == ["!0.2", "", "", "", "", "", "", "!0.2"]
    assert heard(watcher, over[:5])[1].lasting == ()


def test_what_never_spoke_is_over_at_its_threshold() -> None:
    waiting = rule("tcp_speed_mps", threshold=0.2, for_ms=30, response=WAITING)
    watcher = compile_watch(watching(waiting, sensitivity=0.5))
    assert heard(watcher, [0.21, 0.21, 0.19, 0.21, 0.21, 0.21, 0.19])[0] == [*[""] * 5, "!0.2", "!0.15"]


def test_a_distance_to_be_clear_by_holds_where_the_threshold_is_computed() -> None:
    near = rule("separation_m", above=False, response=replace(WAITING, clear_after_ms=0, clear_beyond=0.1))
    watcher = compile_watch(watching(near, sensitivity=1.0))
    gap, state, said = expected_gap(0.0), watcher.begin(), []
    for number, by_m in enumerate((0.05, -0.05, 0.05, 0.15, 0.05)):  # somebody else each time, and nobody remembered
        standing = (PersonTrack(number, number * 3.0, 2.45 + gap + by_m, 2.0),)
        one = seen(number * 300, people=standing, tcp_m=(0.0, 0.0, 0.9), base_velocity=(0.0, 0.0, 0.0))
        state, alerts = watcher.watch(state, one, SkillReport("move", 0.5), HOLD)
        said.append([round(alert.threshold - gap, 3) for alert in alerts if alert.rule == near.id])
    assert said == [[], [0.0], [0.1], [], []]


def test_a_human_who_lets_go_on_need_not_wait_for_what_is_within_its_limit() -> None:
    watcher = compile_watch(watching(rule("tcp_speed_mps", threshold=0.2, response=WAITING), sensitivity=1.0))
    for before, kept in (
        ([0.21, 0.19], []),
        ([0.21, 0.14], []),
        ([0.19, 0.21], [(0, 1)]),
        ([0.21, math.nan], [(0, 2)]),
    ):
        _, state = heard(watcher, before)
        assert [one for one in watcher.let_go(state).lasting if one[0] == 0] == kept
        assert watcher.violated(watcher.let_go(state)) == watcher.violated(state)
        assert ("tcp_speed_mps" in watcher.violated(state)) == bool(kept)
    _, state = heard(watcher, [0.21, 0.19])
    assert heard(watcher, [0.19, 0.21], watcher.let_go(state), start=2)[0] == ["", "!0.2"]
    waiting = rule("tcp_speed_mps", threshold=0.2, for_ms=100)  # without a distance all stays as it is
    other = compile_watch(watching(waiting, sensitivity=0.5))
    _, state = heard(other, [0.21] * 5)
    assert other.let_go(state) == state


def test_a_hand_leads_out_of_what_is_clear_only_well_within_its_limit() -> None:
    pressed = rule("contact_force_n", threshold=50.0, response=replace(WAITING, clear_beyond=20.0))
    watcher = compile_watch(watching(pressed, sensitivity=1.0))
    responses, state, spoke = Responses(watcher.rules, 0.01), watcher.begin(), list[bool]()
    led = leaving({pressed.id: ("contact_force_n", 4.0)}, 0, 0.01)
    for tick, force_n in enumerate((54.0, 53.0, 48.0, 44.0, 40.0, 36.0, 32.0, 28.0, 26.0)):
        now = seen(tick, contact_force_n=force_n, peak_force_n=force_n)
        state, alerts = watcher.watch(state, now, SkillReport("move", 0.5), HOLD)
        spoke.append(bool(alerts))
        led, decision = responses.intervene(led, alerts, tick)
        assert decision.intervention is Intervention.CONTINUE, force_n
    assert spoke == [*[True] * 7, False, False]


def test_an_attempt_begins_with_fresh_timers_and_known_positions() -> None:
    plan = watching(rule("elapsed_s"))
    stream = [seen(tick, fix=Fix(tick * 0.01, 2.5, 2.0, 0.0)) for tick in range(190)]
    _, state, watcher = run(plan, stream)
    fresh = watcher.begin(state)
    assert fresh.senses.elapsed_ticks == 0
    assert fresh.senses.base == state.senses.base
    assert fresh.senses.base.x_m == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (watching(rule("mood", threshold=1.0)), "unknown signal `mood`"),
        (watching(rule("slip_m", threshold=1.0, method="magic")), "unknown method `magic`"),
        (watching(rule("slip_m", threshold=math.nan)), "finite"),
        (watching(rule("slip_m", threshold=1.0, method="cusum", response=WAITING)), "only a threshold is cleared"),
        (watching(rule("slip_m", threshold=1.0, response=replace(WAITING, clear_beyond=-1.0))), "0 or more"),
        (watching(rule("slip_m", threshold=1.0, response=replace(WAITING, clear_beyond=math.nan))), "0 or more"),
        (watching(rule("slip_m")), "needs a threshold"),
        (watching(rule("separation_m", above=False), separation=None), "needs a threshold"),
        (watching(rule("slip_m", threshold=1.0), rule("slip_m", threshold=2.0)), "appear twice"),
        (replace(PLAN, sensitivity=1.5), "sensitivity"),
        (replace(PLAN, sensitivity=math.nan), "sensitivity"),
        (replace(PLAN, stale_after_ms={"nose": 5}), "unknown sensor `nose`"),
        (replace(PLAN, base_deceleration_mps2=0.0), "deceleration"),
    ],
)
def test_a_plan_that_cannot_be_watched_is_refused(plan: WatchPlan, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        compile_watch(plan)


# -- raising s never detects less ------------------------------------------------------------------------------------

readings = st.fixed_dictionaries(
    {
        "contact_force_n": st.floats(0.0, 200.0),
        "tcp_speed_mps": st.floats(0.0, 0.6) | st.just(math.nan),
        "base_velocity": st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.just(0.0)),
        "residual_nm": st.tuples(*[st.floats(-60.0, 60.0)] * 6),
        "people": st.just(())
        | st.tuples(st.builds(PersonTrack, st.just(1), st.floats(0, 1), st.floats(0, 8), st.floats(0, 6))),
        "slip_m": st.floats(0.0, 0.02),
        "pads_loaded": st.booleans(),
    }
)
watched = st.lists(
    st.tuples(
        st.sampled_from([*SIGNAL_NAMES[:6], *SIGNAL_NAMES[9:13]]),
        st.booleans(),
        st.floats(0.0, 120.0),
        st.integers(0, 120),
        st.sampled_from(["threshold", "cusum"]),
        st.sampled_from([0.0, 0.05, 20.0]),
    ),
    min_size=1,
    max_size=6,
)


@settings(max_examples=60, deadline=None)
@given(
    rules=watched,
    stream=st.lists(readings, min_size=10, max_size=40),
    low=st.floats(0.0, 1.0),
    high=st.floats(0.0, 1.0),
)
def test_raising_sensitivity_never_detects_less_nor_later(
    rules: list[tuple[str, bool, float, int, str, float]], stream: list[dict[str, object]], low: float, high: float
) -> None:
    low, high = sorted((low, high))
    made = tuple(
        rule(
            signal,
            above=above,
            threshold=threshold,
            for_ms=for_ms,
            method=method,
            id=f"{signal}-{number}",
            response=replace(WAITING, clear_beyond=0.0 if method == "cusum" else beyond),
        )
        for number, (signal, above, threshold, for_ms, method, beyond) in enumerate(rules)
    )
    observations = [seen(tick, **one) for tick, one in enumerate(stream)]
    lax, _, _ = run(watching(*made, sensitivity=low), observations, command=GRIPPING)
    strict, _, _ = run(watching(*made, sensitivity=high), observations, command=GRIPPING)
    threshold_rules = {one.id for one in made if one.method == "threshold"}
    found: set[str] = set()
    for few, many in zip(lax, strict, strict=True):
        found |= {alert.rule for alert in many}
        assert {alert.rule for alert in few} & threshold_rules <= {alert.rule for alert in many}
        assert {alert.rule for alert in few} <= found


def test_watching_is_pure() -> None:
    watcher = compile_watch(watching(rule("slip_m", threshold=0.001, for_ms=30)))
    state = watcher.begin()
    one = seen(3, slip_m=0.01, pads_loaded=True)
    word = SkillReport("move", 0.1)
    assert watcher.watch(state, one, word, GRIPPING) == watcher.watch(state, one, word, GRIPPING)
    assert state == watcher.begin()


def test_every_signal_has_a_name_policy_can_use() -> None:
    assert SIGNAL_NAMES[-1] == "grip_force_n"
    assert set(SIGNAL_NAMES) <= set(Signals._fields)


@pytest.mark.parametrize("sensitivity", [0.3, 0.5, 0.7, 0.9])
def test_a_fix_that_jumps_is_implausible_in_every_profile(sensitivity: float) -> None:
    """Fixes come every fifth tick; a debounce of several ticks must not wait for what is there in one of them alone."""
    plan = watching(rule("implausible", threshold=0.5, for_ms=50, emits=Signal.INSTABILITY), sensitivity=sensitivity)
    watcher = compile_watch(plan)
    state, told = watcher.begin(), []
    for tick in range(1, 120):
        at_s = tick // 5 * 5 / 100
        jumped = 1.0 if at_s >= 0.5 else 0.0
        fix = Fix(at_s, jumped, 0.0, 0.0)
        state, alerts = watcher.watch(state, seen(tick, fix=fix), SkillReport("move", 0.1), MOVING)
        told += [tick for alert in alerts if alert.rule == "implausible"]
    assert told
    assert 50 <= told[0] <= 65
