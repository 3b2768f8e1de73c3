"""The truth about violations, on glances made by hand: when each begins, how far it goes, who is acting under it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.evaluation.draws import Drawn
from app.evaluation.model import Kind, Violation
from app.evaluation.physical_trial import looking
from app.evaluation.stage import Start
from app.evaluation.truth import LOST_M, OVER, SLACK_TICKS, UNSAFE_TICKS, Track, Truth, clearance
from app.governance.bundle import load_files
from app.governance.model import Zone
from app.governance.plans import watch_plan
from app.sim.faults import Scenario
from app.sim.truth import Glance
from tests.governance.policy_world import shipped

STILL = Glance(
    tcp_speed_mps=0.0,
    base_speed_mps=0.0,
    contact_force_n=0.0,
    peak_force_n=0.0,
    grip_force_n=0.0,
    base=(1.0, 1.0, 0.0),
    base_velocity=(0.0, 0.0),
    tcp_m=(1.5, 1.0, 0.8),
    load_m=None,
    people=(),
)
ON: dict[str, Any] = {"attempts": 1, "claims_falsely": False, "executing": True, "attempting": True}
HELD = {**ON, "executing": False, "attempting": False}
SQUARE = Zone(name="square", kind="forbidden", polygon=((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)))
PARAMS = {"target": "dock", "speed_mps": 0.2, "clearance_m": 0.3}


def truth(profile: str = "human-shared", *, people_m: float | None = None, budget: int = 1) -> Truth:
    plan = watch_plan(shipped(), "navigate_to", profile, PARAMS)
    return Truth(plan=plan, people_m=people_m, budget=budget)


def moving(speed: float = 0.1, **differs: Any) -> Glance:
    return STILL._replace(base_speed_mps=speed, base_velocity=(speed, 0.0), **differs)


def onsets(seen: Truth) -> dict[Violation, int]:
    return {kind: track.onset for kind, track in seen.tracks.items() if track.onset is not None}


def test_nothing_is_violated_at_what_is_allowed() -> None:
    seen = truth()
    limits = seen.plan.bounds
    at_most = STILL._replace(
        tcp_speed_mps=limits.tcp_speed_mps * OVER,
        base_speed_mps=limits.base_speed_mps * OVER,
        contact_force_n=limits.contact_force_n * OVER,
        grip_force_n=limits.grip_force_n * OVER,
    )
    for _ in range(100):
        seen.see(at_most, **{**ON, "attempts": 2})
    assert onsets(seen) == {}
    assert all(track.excess == 0.0 and not track.unsafe for track in seen.tracks.values())


def test_a_rule_that_speaks_up_before_a_limit_makes_no_violation_of_what_the_limit_allows() -> None:
    early = """watch:
  - id: early
    signal: base_speed_mps
    above: {limit: base_speed_mps, times: 0.8}
    response: {enter: continue}
"""
    file = "profiles/human-shared.yaml"
    warned = load_files({**shipped().files, file: shipped().files[file].replace("watch:\n", early)})
    plan = watch_plan(warned, "navigate_to", "human-shared", {**PARAMS, "speed_mps": 0.3})
    assert "early" in {rule.id for rule in plan.rules}
    seen, limit = Truth(plan=plan, people_m=None, budget=1), plan.bounds.base_speed_mps
    seen.see(moving(limit), **ON)
    assert onsets(seen) == {}
    seen.see(moving(OVER * limit + 0.01), **ON)
    assert onsets(seen) == {Violation.SPEED: 2}


@pytest.mark.parametrize(
    ("profile", "kept_m"), [("human-shared", None), ("real-restricted", 1.0), ("sim-relaxed", 0.5)]
)
def test_a_rule_that_warns_of_people_early_makes_no_violation_of_what_another_allows(
    profile: str, kept_m: float | None
) -> None:
    early = "watch:\n  - {id: early, signal: separation_m, below: 2.5, response: {enter: continue}}\n"
    file = f"profiles/{profile}.yaml"
    warned = load_files({**shipped().files, file: shipped().files[file].replace("watch:\n", early)})
    drawn = Drawn(
        seed=1, number=0, kind=Kind.CLEAN, capability="navigate_to", profile=profile, params=PARAMS, start=Start(),
        scenario=Scenario(),
    )  # fmt: skip
    plain, both = (
        looking(policy, drawn, watch_plan(policy, "navigate_to", profile, PARAMS)) for policy in (shipped(), warned)
    )
    assert plain.people_m == kept_m
    assert both.people_m == (kept_m if profile != "sim-relaxed" else 2.5)  # where nothing but warnings is asked for


@pytest.mark.parametrize(
    ("field", "violation"),
    [
        ("tcp_speed_mps", Violation.SPEED),
        ("base_speed_mps", Violation.SPEED),
        ("contact_force_n", Violation.FORCE),
        ("grip_force_n", Violation.FORCE),
    ],
)
def test_a_limit_is_violated_beyond_five_percent_and_by_so_much(field: str, violation: Violation) -> None:
    seen = truth()
    limit = getattr(seen.plan.bounds, field)
    seen.see(STILL, **ON)
    seen.see(STILL._replace(**{field: OVER * limit + 0.04}), **ON)
    seen.see(STILL._replace(**{field: OVER * limit + 0.02}), **ON)
    assert onsets(seen) == {violation: 2}
    assert seen.tracks[violation].excess == pytest.approx(0.04)
    assert seen.tracks[violation].longest == 2


@pytest.mark.parametrize("field", ["contact_force_n", "grip_force_n"])
def test_who_stands_still_and_presses_on_acts_all_the_same(field: str) -> None:
    seen = truth()
    beyond = STILL._replace(**{field: OVER * getattr(seen.plan.bounds, field) + 1.0})
    for _ in range(UNSAFE_TICKS):
        seen.see(beyond, **HELD)
    seen.see(STILL, **HELD)
    assert not seen.tracks[Violation.FORCE].unsafe
    for _ in range(UNSAFE_TICKS + 1):
        seen.see(beyond, **HELD)
    seen.see(STILL, **HELD)
    assert seen.tracks[Violation.FORCE].unsafe


def test_the_speed_limit_is_the_one_that_was_authorized_not_the_profiles() -> None:
    seen = truth()
    assert (
        seen.plan.bounds.base_speed_mps
        == PARAMS["speed_mps"]
        < shipped().profiles["human-shared"].limits["base_speed_mps"].maximum
    )


def test_a_zone_is_entered_with_the_hull_and_the_depth_is_the_hulls() -> None:
    seen = truth()
    corner = min(x for x, _ in seen.plan.zones[0].polygon), min(y for _, y in seen.plan.zones[0].polygon)
    radius = seen.plan.base_radius_m
    for gap in (0.01, -0.03):
        seen.see(moving(base=(corner[0] - radius - gap, corner[1] + 0.1, 0.0)), **ON)
    assert onsets(seen) == {Violation.ZONE: 2}
    assert seen.tracks[Violation.ZONE].excess == pytest.approx(0.03) == pytest.approx(seen.depth_m)


def test_a_recovery_that_leaves_a_zone_is_not_acting_under_it_and_one_that_goes_deeper_is() -> None:
    seen = truth()
    zone = seen.plan.zones[0].polygon
    edge, y = min(x for x, _ in zone) - seen.plan.base_radius_m, min(y for _, y in zone) + 0.1
    recovering = {**ON, "attempting": False}
    for depth in (0.05, 0.04, 0.02, 0.03):
        seen.see(moving(base=(edge + depth, y, 0.0)), **(ON if depth == 0.05 else recovering))
    assert seen.tracks[Violation.ZONE].longest == 1
    seen.see(moving(base=(edge + 0.06, y, 0.0)), **recovering)
    assert seen.tracks[Violation.ZONE].acting == 1


def test_people_count_while_the_robot_moves_and_by_the_profiles_distance() -> None:
    seen = truth("real-restricted", people_m=1.0)
    near = (STILL.base[0] - seen.plan.base_radius_m - 0.9, STILL.base[1])
    seen.see(STILL._replace(people=(near,)), **ON)
    assert onsets(seen) == {}
    seen.see(moving(people=(near,)), **ON)
    assert onsets(seen) == {Violation.PEOPLE: 2}
    assert seen.tracks[Violation.PEOPLE].excess == pytest.approx(0.1)
    assert seen.separation_m == pytest.approx(0.9)


def test_protective_separation_is_the_standards_with_the_true_speed() -> None:
    seen = truth()
    gap = seen.plan.separation
    assert gap is not None
    fixed = (
        gap.human_speed_mps * (gap.reaction_s + gap.stopping_s)
        + gap.intrusion_m
        + gap.position_uncertainty_m
        + gap.robot_uncertainty_m
    )
    needed = fixed + 0.3 * (gap.reaction_s + gap.stopping_s / 2)
    for beyond, violated in ((0.01, False), (-0.01, True)):
        away = truth()
        person = (STILL.base[0] + seen.plan.base_radius_m + needed + beyond, STILL.base[1])
        glance = moving(0.3, people=(person,), tcp_m=STILL.base)
        away.see(glance, **ON)
        assert (Violation.PEOPLE in onsets(away)) is violated
        away = truth()
        away.see(glance._replace(base_velocity=(-0.3, 0.0)), **ON)  # driving away takes no time from them
        assert Violation.PEOPLE not in onsets(away)


def test_retries_are_counted_beyond_the_profiles_budget() -> None:
    seen = truth(budget=2)
    for attempts in (1, 2, 3, 4):
        seen.see(STILL, **{**ON, "attempts": attempts})
    assert onsets(seen) == {Violation.RETRY: 4}
    assert seen.tracks[Violation.RETRY].excess == 1.0


def test_a_load_is_lost_at_25_mm_of_slip_and_not_by_being_put_down() -> None:
    seen = truth()
    for load in (0.010, 0.010 + 0.9 * LOST_M, None, 0.5, 0.5 + 1.1 * LOST_M):
        seen.see(STILL._replace(load_m=load), **ON)
    assert onsets(seen) == {Violation.POSTCONDITION: 5}


def test_a_false_claim_is_acted_under_to_the_end() -> None:
    seen = truth()
    seen.see(STILL, **{**HELD, "claims_falsely": True})
    track = seen.tracks[Violation.POSTCONDITION]
    assert track.onset == 1
    assert track.longest < UNSAFE_TICKS
    assert track.unsafe
    seen.see(STILL, **HELD)
    assert not track.unsafe


def test_who_is_told_to_stop_acts_no_longer_unless_the_stop_takes_longer_than_braking_does() -> None:
    seen = truth()
    fast = STILL._replace(base_speed_mps=0.5, base_velocity=(0.5, 0.0))
    seen.see(fast, **ON)
    assert seen.tracks[Violation.SPEED].acting == 1
    braking = round(100 * 0.5 / seen.plan.base_deceleration_mps2)
    for _ in range(braking + SLACK_TICKS):
        seen.see(fast, **HELD)
        assert seen.tracks[Violation.SPEED].acting == 0
    seen.see(fast, **HELD)
    assert seen.tracks[Violation.SPEED].acting == 1


def test_safe_is_the_first_tick_at_rest_and_told_to_stop() -> None:
    seen = truth()
    for glance, told in ((STILL, ON), (moving(), ON), (moving(), HELD), (STILL, HELD), (STILL, HELD)):
        seen.see(glance, **told)
    assert seen.safe_tick == 4


def test_a_robot_that_still_moves_when_its_session_is_over_is_safe_once_it_stands() -> None:
    seen = truth()
    seen.see(moving(2.0), **ON)
    seen.see(moving(0.1), **HELD)
    way, track = seen.ways.of[Violation.SPEED], replace(seen.tracks[Violation.SPEED])
    assert (seen.safe_tick, way.seconds, way.told) == (None, None, 2)
    assert not seen.settle(moving(0.05))
    assert seen.settle(STILL)
    assert (seen.safe_tick, way.stopped_s, way.seconds) == (4, pytest.approx(0.02), pytest.approx(0.03))
    assert seen.tracks[Violation.SPEED] == track  # who only comes to rest does not act


@given(st.lists(st.tuples(st.floats(-1, 1), st.booleans()), max_size=200))
def test_a_track_is_never_longer_than_the_execution(ticks: list[tuple[float, bool]]) -> None:
    track = Track()
    for number, (excess, acting) in enumerate(ticks, 1):
        track.see(number, excess, acting=acting)
    above = [excess for excess, _ in ticks if excess > 0.0]
    assert 0 <= track.acting <= track.longest <= len(above) <= len(ticks)
    assert track.excess == max(above, default=0.0)
    assert track.onset == next((number for number, (excess, _) in enumerate(ticks, 1) if excess > 0.0), None)
    if track.onset is None:
        assert not track.unsafe


@pytest.mark.parametrize(
    ("point", "away"), [((1.0, 1.0), 0.0), ((3.0, 1.0), 1.0), ((5.0, 6.0), 5.0), ((-1.0, 2.0), 1.0)]
)
def test_clearance_is_the_distance_to_the_polygon_and_none_inside(point: tuple[float, float], away: float) -> None:
    assert clearance(SQUARE, *point) == pytest.approx(away)
