"""The way to the safe state and its floor, on glances made by hand."""

from __future__ import annotations

from typing import Any

import pytest

from app.cell.run import ARM_DECELERATION_MPS2
from app.evaluation.floor import ALL, DETECTION_TICKS, Reached
from app.evaluation.model import Violation
from app.evaluation.truth import Truth
from tests.evaluation.test_truth import HELD, ON, STILL, moving, truth

BACK: dict[str, Any] = {**ON, "attempting": False, "retreating": True}


def speeding(*ticks: tuple[Any, dict[str, Any]]) -> Truth:
    """Look on from 0.5 m/s where 0.3 m/s is allowed, which takes 50 ticks to brake."""
    seen = truth()
    for glance, told in ((moving(0.5), ON), *ticks):
        seen.see(glance, **told)
    return seen


def test_safe_is_standstill_after_the_onset_and_the_floor_is_to_see_and_to_brake() -> None:
    way = speeding((moving(0.3), HELD), (moving(0.1), HELD), (STILL, HELD), (STILL, HELD)).ways.of[Violation.SPEED]
    assert way.seconds == pytest.approx(0.03)
    assert way.floor_s(Violation.SPEED) == pytest.approx(0.01 + 0.5)


def test_a_fast_hand_brakes_at_the_arms_deceleration() -> None:
    seen = truth()
    seen.see(STILL._replace(tcp_speed_mps=0.5), **ON)
    floor_s = seen.ways.of[Violation.SPEED].floor_s(Violation.SPEED)
    assert floor_s == pytest.approx(0.01 + 0.5 / ARM_DECELERATION_MPS2)


def test_a_standstill_before_the_onset_is_no_safe_state_of_it() -> None:
    seen = truth()
    for glance, told in ((STILL, HELD), (STILL, ON), (moving(0.5), ON), (moving(0.2), HELD), (STILL, HELD)):
        seen.see(glance, **told)
    assert seen.ways.of[Violation.SPEED].seconds == pytest.approx(0.02)


def test_a_retreat_puts_the_safe_state_off_and_its_way_counts_at_the_allowed_speed() -> None:
    allowed = truth().plan.bounds.base_speed_mps
    slow = (moving(allowed / 4), BACK)
    way = speeding((STILL, HELD), slow, slow, slow, slow, (STILL, BACK), (STILL, HELD)).ways.of[Violation.SPEED]
    assert way.seconds == pytest.approx(0.07)
    assert way.floor_s(Violation.SPEED) == pytest.approx(0.01 + 0.5 + 0.01)


def test_a_new_attempt_leaves_the_safe_state_where_it_was() -> None:
    way = speeding((STILL, HELD), (moving(), ON), (moving(), BACK), (STILL, HELD)).ways.of[Violation.SPEED]
    assert way.seconds == pytest.approx(0.01)
    assert way.retreat_ticks == 0.0


def test_who_is_never_held_back_never_gets_safe() -> None:
    assert speeding((STILL, ON), (STILL, ON)).ways.of[Violation.SPEED].seconds is None


def test_a_late_sensor_raises_the_floor() -> None:
    assert DETECTION_TICKS[Violation.PEOPLE] > DETECTION_TICKS[Violation.ZONE] > DETECTION_TICKS[Violation.SPEED]
    assert set(DETECTION_TICKS) == set(Violation)


def test_sums_tell_what_did_not_come_about_from_what_was_never_safe() -> None:
    reached = Reached()
    for safe_s, floor_s in ((0.4, 0.2), (0.3, 0.2), (None, 0.2), (None, None)):
        reached.add({"occurred": True, "violation": "zone", "class": "held", "safe_s": safe_s, "floor_s": floor_s})
    reached.add({"occurred": True, "violation": "zone", "class": "warned", "safe_s": 9.0, "floor_s": 0.2})
    reached.add({"occurred": False, "violation": "zone", "safe_s": 9.0, "floor_s": 0.2})
    found = reached.entries()["zone"]
    assert (found["n"], found["never"], found["prevented"]) == (2, 1, 1)
    assert found["ratio_median"] == pytest.approx(1.75)
    assert found["above_s_p95"] == pytest.approx(0.195)
    assert reached.entries()[ALL] == found
