"""The way to the safe state and its floor, on glances made by hand and on executions."""

from __future__ import annotations

from typing import Any

import pytest

from app.cell.run import ARM_DECELERATION_MPS2
from app.evaluation.floor import ARM_BEST_MPS2, BASE_BEST_MPS2, STANDSTILL_MPS, Way
from app.evaluation.model import TUNING_SEEDS, Violation
from app.evaluation.safe_state import ALL, Reached
from app.evaluation.truth import Truth
from tests.evaluation.physical_world import watched
from tests.evaluation.test_truth import HELD, ON, STILL, moving, truth

SEED = TUNING_SEEDS[3]  # as in `test_detectors`, which executes some of the same
PARTS = ("told_s", "stopped_s", "back_s")
BACK: dict[str, Any] = {**ON, "attempting": False, "retreating": True}


def speeding(*ticks: tuple[Any, dict[str, Any]]) -> Way:
    """Look on from 0.5 m/s where 0.3 m/s is allowed."""
    seen = truth()
    for glance, told in ((moving(0.5), ON), *ticks):
        seen.see(glance, **told)
    return way_of(seen)


def way_of(seen: Truth) -> Way:
    return seen.ways.of[Violation.SPEED]


def test_safe_is_standstill_after_the_onset_and_the_floor_is_to_see_and_to_brake() -> None:
    way = speeding((moving(0.4), HELD), (moving(0.1), HELD), (STILL, HELD), (STILL, HELD))
    assert (way.seconds, way.told_s, way.stopped_s, way.back_s) == pytest.approx((0.03, 0.01, 0.02, 0.0))
    best_s = (0.4 - STANDSTILL_MPS) / BASE_BEST_MPS2
    assert best_s < way.stop_s < best_s + 0.01
    assert way.stop_s == pytest.approx(round(way.stop_s * 100) / 100)
    assert way.floor_s == pytest.approx(0.01 + way.stop_s)
    assert way.declared_stop_s == pytest.approx(0.4 - STANDSTILL_MPS)


def test_the_floor_is_of_the_speed_at_which_it_was_told() -> None:
    late, soon = speeding((moving(0.9), HELD)), speeding((moving(0.3), HELD))
    assert late.stop_s > soon.stop_s > 0.0


def test_what_was_held_back_by_the_onset_needs_no_time_to_be_seen() -> None:
    seen = truth()
    for told in (HELD, HELD, HELD):
        seen.see(moving(0.5), **told)
    way = way_of(seen)
    assert (way.told_s, way.floor_s) == (0.0, way.stop_s)


def test_a_fast_hand_is_stopped_by_its_own_joints_but_not_where_it_met_something_stiff() -> None:
    seen = truth()
    for told in (ON, HELD):
        seen.see(STILL._replace(tcp_speed_mps=0.9, contact_force_n=500.0), **told)
    hand_s = (0.9 - STANDSTILL_MPS) / ARM_BEST_MPS2
    assert hand_s < way_of(seen).stop_s < hand_s + 0.01
    assert way_of(seen).declared_stop_s == pytest.approx((0.9 - STANDSTILL_MPS) / ARM_DECELERATION_MPS2)
    assert seen.ways.of[Violation.FORCE].stop_s == 0.0


def test_a_standstill_before_the_onset_is_no_safe_state_of_it() -> None:
    seen = truth()
    for glance, told in ((STILL, HELD), (STILL, ON), (moving(0.5), ON), (moving(0.2), HELD), (STILL, HELD)):
        seen.see(glance, **told)
    assert way_of(seen).seconds == pytest.approx(0.02)


def test_a_retreat_puts_the_safe_state_off_and_its_way_counts_at_the_allowed_speed() -> None:
    allowed = truth().plan.bounds.base_speed_mps
    slow = (moving(allowed / 4), BACK)
    way = speeding((STILL, HELD), *[slow] * 200, (STILL, BACK), (STILL, HELD))
    assert way.seconds == pytest.approx(2.03)
    assert (way.told_s, way.stopped_s, way.back_s) == pytest.approx((0.01, 0.0, 2.02))
    ramp_s = allowed / truth().plan.base_deceleration_mps2
    assert way.floor_s == pytest.approx(0.01 + 0.5 + ramp_s)


def test_a_way_too_short_to_come_up_to_speed_on_takes_two_ramps() -> None:
    allowed = truth().plan.bounds.base_speed_mps
    way = speeding((STILL, HELD), *[(moving(allowed / 4), BACK)] * 4, (STILL, HELD))
    assert way.back.seconds == pytest.approx(2 * (0.01 * allowed / truth().plan.base_deceleration_mps2) ** 0.5)


def test_faster_than_allowed_is_no_way_to_beat_the_floor() -> None:
    allowed = truth().plan.bounds.base_speed_mps
    way = speeding((STILL, HELD), *[(moving(3 * allowed), BACK)] * 10, (STILL, HELD))
    assert way.back.ticks == pytest.approx(10)


def test_a_way_back_that_is_bound_before_standstill_is_seen_counts_as_one() -> None:
    allowed = truth().plan.bounds.base_speed_mps
    way = speeding((moving(0.05), HELD), (moving(0.03), BACK), (STILL, BACK), (moving(allowed), BACK), (STILL, HELD))
    assert (way.stopped_s, way.back_s) == pytest.approx((0.02, 0.02))
    assert way.back.ticks > 1.0


def test_what_comes_about_on_the_way_back_was_held_back_by_then() -> None:
    seen = truth()
    for glance, told in ((STILL, HELD), (STILL, BACK), (moving(0.9), BACK), (STILL, BACK), (STILL, HELD)):
        seen.see(glance, **told)
    assert (way_of(seen).told_s, way_of(seen).back_s) == pytest.approx((0.0, 0.02))


def test_a_new_attempt_leaves_the_safe_state_where_it_was() -> None:
    way = speeding((STILL, HELD), (moving(), ON), (moving(), BACK), (STILL, HELD))
    assert way.seconds == pytest.approx(0.01)
    assert way.back.ticks == 0.0


def test_a_new_attempt_that_is_bound_before_standstill_is_seen_hides_no_standstill() -> None:
    way = speeding((moving(0.03), HELD), (STILL, ON), (moving(), ON), (STILL, HELD))
    assert way.seconds == pytest.approx(0.02)


def test_who_is_never_held_back_never_gets_safe() -> None:
    assert speeding((STILL, ON), (STILL, ON)).seconds is None


@pytest.mark.parametrize("violation", Violation)
def test_nothing_that_is_executed_is_faster_than_its_floor(violation: Violation) -> None:
    rows = [watched(SEED, number, violation) for number in range(4)]
    timed = [row for row in rows if row["safe_s"] is not None]
    for row in timed:
        safe_s, floor_s, *parts = (float(row[name] or 0.0) for name in ("safe_s", "floor_s", *PARTS))
        assert safe_s >= floor_s - 1e-9, row
        assert safe_s == pytest.approx(sum(parts))
    assert timed or violation in (Violation.ZONE, Violation.PEOPLE)  # those are prevented, or warned of


def test_sums_tell_what_did_not_come_about_from_what_was_never_safe() -> None:
    reached = Reached()
    for safe_s, floor_s in ((0.4, 0.2), (0.3, 0.2), (None, 0.2), (None, None)):
        reached.add({"occurred": True, "violation": "zone", "class": "held", "safe_s": safe_s, "floor_s": floor_s})
    reached.add({"occurred": True, "violation": "zone", "class": "warned", "safe_s": 9.0, "floor_s": 0.2})
    reached.add({"occurred": False, "violation": "zone", "safe_s": 9.0, "floor_s": 0.2})
    found = reached.entries()["zone"]
    assert (found["n"], found["never"], found["prevented"], found["below"]) == (2, 1, 1, 0)
    assert found["ratio_median"] == pytest.approx(1.75)
    assert found["above_s_p95"] == pytest.approx(0.195)
    assert reached.entries()[ALL] == found


def test_sums_say_how_many_are_below_their_floor() -> None:
    reached = Reached()
    reached.add({"occurred": True, "violation": "zone", "class": "held", "safe_s": 0.1, "floor_s": 0.2})
    assert reached.entries()["zone"]["below"] == 1
