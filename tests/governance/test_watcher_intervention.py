from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.governance.intervention import (
    GO_ON,
    NOTHING,
    SEVERITY,
    Decision,
    Engaged,
    Grace,
    InterventionState,
    Responses,
    ends_attempt,
    leaving,
    recovering,
    released,
)
from app.governance.model import Alert, Intervention, Response, Signal, WatchRule

CONTINUE, PAUSE, STOP, ROLLBACK, ESCALATE = (
    Intervention.CONTINUE,
    Intervention.PAUSE,
    Intervention.STOP,
    Intervention.ROLLBACK,
    Intervention.ESCALATE,
)


def rule(name: str, response: Response, failure: str = "") -> WatchRule:
    return WatchRule(
        id=name,
        signal="slip_m",
        emits=Signal.VIOLATION,
        response=response,
        above=True,
        threshold=1.0,
        failure=failure,
    )


def said(*names: str) -> tuple[Alert, ...]:
    return tuple(Alert(Signal.VIOLATION, name, 2.0, 1.0) for name in names)


def play(rules: tuple[WatchRule, ...], *alerts: tuple[Alert, ...]) -> list[Decision]:
    responses, state, decisions = Responses(rules, 0.01), NOTHING, []
    for tick, spoken in enumerate(alerts):
        state, decision = responses.intervene(state, spoken, tick)
        decisions.append(decision)
    return decisions


KEEP_AWAY = rule("gap", Response(enter=PAUSE, clear_after_ms=30, then="resume", persist_ms=50, otherwise=ESCALATE))


def test_nothing_said_is_go_on() -> None:
    assert play((KEEP_AWAY,), ()) == [GO_ON]


def test_a_pause_holds_until_it_has_been_quiet_long_enough() -> None:
    decisions = play((KEEP_AWAY,), said("gap"), said("gap"), (), (), (), ())
    assert [one.intervention for one in decisions] == [PAUSE, PAUSE, PAUSE, PAUSE, CONTINUE, CONTINUE]


def test_a_violation_that_returns_while_waiting_starts_the_wait_anew() -> None:
    decisions = play((KEEP_AWAY,), said("gap"), (), (), said("gap"), (), (), ())
    assert [one.intervention for one in decisions][-3:] == [PAUSE, PAUSE, CONTINUE]


def test_a_violation_that_persists_becomes_what_the_response_says_and_stays_that() -> None:
    decisions = play((KEEP_AWAY,), *[said("gap")] * 7, *[()] * 20)
    assert [one.intervention for one in decisions[:7]] == [PAUSE] * 5 + [ESCALATE] * 2
    assert decisions[-1].intervention is ESCALATE


def test_a_pause_that_stays_waits_for_a_human() -> None:
    responses = Responses((rule("slip", Response(enter=PAUSE)),), 0.01)
    state, _ = responses.intervene(NOTHING, said("slip"), 0)
    for tick in range(1, 500):
        state, decision = responses.intervene(state, (), tick)
        assert decision.intervention is PAUSE
    assert responses.intervene(released(state), (), 500) == (NOTHING, GO_ON)


def test_what_a_human_let_go_on_and_is_still_violated_speaks_again() -> None:
    responses = Responses((KEEP_AWAY,), 0.01)
    state, _ = responses.intervene(NOTHING, said("gap"), 0)
    _, decision = responses.intervene(released(state), said("gap"), 1)
    assert decision.intervention is PAUSE


@pytest.mark.parametrize(("one", "two"), list(itertools.combinations(Intervention, 2)))
def test_the_most_severe_wins(one: Intervention, two: Intervention) -> None:
    rules = (rule("one", Response(enter=one)), rule("two", Response(enter=two)))
    (decision,) = play(rules, said("one", "two"))
    assert decision.intervention is max(one, two, key=SEVERITY.__getitem__)


def test_severity_is_stop_rollback_escalate_pause_continue() -> None:
    assert sorted(SEVERITY, key=SEVERITY.__getitem__) == [CONTINUE, PAUSE, ESCALATE, ROLLBACK, STOP]


@pytest.mark.parametrize(
    ("response", "failure", "ends"),
    [
        (Response(enter=STOP), "contact", True),
        (Response(enter=STOP), "", True),
        (Response(enter=ROLLBACK), "zone", True),
        (Response(enter=PAUSE), "slip", True),
        (Response(enter=PAUSE), "", False),
        (Response(enter=PAUSE, then="resume"), "gap", False),
        (Response(enter=PAUSE, persist_ms=100), "gap", False),
        (Response(enter=ESCALATE), "fault", False),
        (Response(enter=CONTINUE), "fault", False),
    ],
)
def test_which_responses_end_the_attempt(response: Response, failure: str, ends: bool) -> None:
    made = rule("it", response, failure)
    assert ends_attempt(made) is ends
    assert play((made,), said("it"))[0].ends_attempt is ends


def test_a_persisting_pause_may_end_the_attempt() -> None:
    stale = rule("stale", Response(enter=PAUSE, then="resume", persist_ms=10, otherwise=STOP), "sensor_fault")
    decisions = play((stale,), said("stale"), said("stale"))
    assert [one.ends_attempt for one in decisions] == [False, True]


def test_whatever_only_holds_is_told_beside_what_ends_the_attempt() -> None:
    lost = rule("lost", Response(enter=STOP), "object_lost")
    (decision,) = play((lost, KEEP_AWAY), said("lost", "gap"))
    assert decision.intervention is STOP
    assert decision.holding is not None
    assert decision.holding.intervention is PAUSE
    assert play((lost,), said("lost"))[0].holding is None


def test_a_recovery_is_not_ended_by_what_it_was_started_for_until_grace_is_over() -> None:
    lost = rule("lost", Response(enter=STOP), "object_lost")
    responses = Responses((lost,), 0.01)
    state = recovering(("lost",), 100, 0.01)
    for tick in range(100, 200):
        state, decision = responses.intervene(state, said("lost"), tick)
        assert decision == GO_ON
    _, decision = responses.intervene(state, said("lost"), 200)
    assert decision.intervention is STOP


def test_grace_ends_with_the_violation() -> None:
    lost = rule("lost", Response(enter=STOP), "object_lost")
    responses = Responses((lost,), 0.01)
    state, _ = responses.intervene(recovering(("lost",), 0, 0.01), (), 0)
    assert state is NOTHING
    _, decision = responses.intervene(state, said("lost"), 1)
    assert decision.intervention is STOP


def test_grace_spares_only_what_the_recovery_was_started_for() -> None:
    lost = rule("lost", Response(enter=STOP), "object_lost")
    responses = Responses((lost, KEEP_AWAY), 0.01)
    _, decision = responses.intervene(recovering(("lost",), 0, 0.01), said("lost", "gap"), 0)
    assert decision.intervention is PAUSE
    assert released(InterventionState(grace=(Grace("lost", 9),))).grace == (Grace("lost", 9),)


def test_grace_is_over_where_the_robot_goes_deeper_instead_of_leaving() -> None:
    zone = replace(rule("zone", Response(enter=STOP), "zone"), signal="zone_margin_m", above=False, threshold=0.0)
    responses = Responses((zone,), 0.01)
    state = recovering(("zone",), 0, 0.01)

    def inside(depth_m: float) -> tuple[Alert, ...]:
        return (Alert(Signal.VIOLATION, "zone", -depth_m, 0.0, "zone"),)

    for tick, depth_m in enumerate((0.010, 0.015, 0.004)):
        state, decision = responses.intervene(state, inside(depth_m), tick)
        assert decision == GO_ON
    assert responses.intervene(state, inside(0.049), 3)[1] == GO_ON  # noise may move the estimate by as much
    _, decision = responses.intervene(state, inside(0.051), 3)
    assert decision.intervention is STOP


def test_grace_outlasts_a_moment_at_the_edge_where_noise_alone_makes_the_violation_come_and_go() -> None:
    zone = replace(rule("zone", Response(enter=STOP), "zone"), signal="zone_margin_m", above=False, threshold=0.0)
    responses = Responses((zone,), 0.01)
    state = recovering(("zone", "forgotten"), 0, 0.01)
    for tick, depth_m in enumerate((0.0, 0.015, 0.0, 0.018)):
        alerts = (Alert(Signal.VIOLATION, "zone", -depth_m, 0.0, "zone"),) if depth_m else ()
        state, decision = responses.intervene(state, alerts, tick)
        assert decision == GO_ON
    back_again = (Alert(Signal.VIOLATION, "zone", -0.041, 0.0, "zone"),)
    assert responses.intervene(state, back_again, 4)[1].intervention is STOP
    assert responses.intervene(state, (), 100)[0] is NOTHING


@given(st.lists(st.sets(st.sampled_from(["gap", "stop", "warn"])), max_size=60))
def test_a_violation_is_answered_in_the_tick_it_is_told(stream: list[set[str]]) -> None:
    rules = (KEEP_AWAY, rule("stop", Response(enter=STOP)), rule("warn", Response(enter=CONTINUE)))
    decisions = play(rules, *[said(*sorted(names)) for names in stream])
    for names, decision in zip(stream, decisions, strict=True):
        if "stop" in names:
            assert decision.intervention is STOP
        if "gap" in names:
            assert decision.intervention is not CONTINUE


def test_a_hand_leads_out_of_what_moving_mends_and_no_further_in() -> None:
    zone = replace(rule("zone", Response(enter=STOP), "zone"), signal="zone_margin_m", above=False, threshold=0.0)
    responses = Responses((zone,), 0.01)

    def inside(depth_m: float) -> tuple[Alert, ...]:
        return (Alert(Signal.VIOLATION, "zone", -depth_m, 0.0, "zone"),)

    state = leaving({"zone": ("zone_margin_m", 0.02)}, 0, 0.01)
    state, decision = responses.intervene(state, inside(0.039), 0)
    assert decision is GO_ON
    _, decision = responses.intervene(state, inside(0.041), 1)
    assert decision.intervention is STOP
    _, decision = responses.intervene(state, inside(0.02), 100)
    assert decision.intervention is STOP


def test_a_hand_is_spared_nothing_that_moving_does_not_mend() -> None:
    assert leaving({"separation": ("separation_m", 0.1), "stale": ("sensor_age_ms", 5.0)}, 0, 0.01) is NOTHING


def test_what_moving_does_not_mend_bars_the_way_until_it_has_been_quiet_even_after_it_became_a_question() -> None:
    warns = replace(rule("warns", Response(enter=CONTINUE)), signal="sensor_age_ms")
    zone = replace(rule("zone", Response(enter=STOP), "zone"), signal="zone_margin_m", above=False, threshold=0.0)
    responses, state, barred = Responses((KEEP_AWAY, warns, zone), 0.01), NOTHING, list[str]()
    for tick in range(14):
        spoken = said("warns", "zone", "gap") if tick < 9 else said("warns", "zone")
        state, _ = responses.intervene(state, spoken, tick)
        barred.append(responses.barred(state, tick))
    assert barred == ["gap"] * 11 + [""] * 3


def test_a_hold_that_was_given_up_is_answered_before_what_only_spoke_beside_it() -> None:
    pressed = rule("contact", Response(enter=STOP), failure="contact")
    unsure = rule("unsure", Response(enter=PAUSE, then="resume", persist_ms=30, otherwise=STOP), failure="sensor_fault")
    held, *_, last = play((pressed, unsure), *[said("contact", "unsure")] * 5)
    assert held.holding is not None
    assert not held.gave_up
    assert last.holding is None
    assert last.gave_up
    assert last.alert is not None
    assert last.alert.rule == "unsure"


# -- what a state says to whoever begins anew ------------------------------------------------------------------------

PRESSED = replace(rule("pressed", Response(enter=STOP), "contact"), signal="contact_force_n")
LOST = rule("lost", Response(enter=STOP), "object_lost")
WARNED = rule("warned", Response(enter=CONTINUE))
ANSWERS = Responses((PRESSED, LOST, WARNED, KEEP_AWAY), 0.01)


def engaged(*names: str, since: int = 5, failure: str = "contact") -> InterventionState:
    return InterventionState(
        tuple(Engaged(name, Alert(Signal.VIOLATION, name, 2.0, 1.0, failure), since, None, False) for name in names)
    )


@pytest.mark.parametrize(
    ("before", "left"),
    [
        (engaged("gap", "pressed", "warned"), engaged("pressed")),  # only what ended the attempt has ended it
        (engaged("gap", "warned"), NOTHING),
        (engaged("gap")._replace(grace=(Grace("lost", 9),)), NOTHING._replace(grace=(Grace("lost", 9),))),
    ],
)
def test_what_a_human_lets_go_on_answers_anew(before: InterventionState, left: InterventionState) -> None:
    assert ANSWERS.let_go(before) == left


def test_what_is_only_warned_of_is_borne_into_what_begins_anew() -> None:
    # of another plan, that a recovery's own may not have
    assert [one.rule for one in ANSWERS.borne(engaged("gap", "elsewhere", "warned"))] == ["warned"]


@pytest.mark.parametrize(
    ("state", "names"),
    [
        (engaged("pressed", "lost", "warned"), ["pressed"]),  # of what ended the attempt, the contacts
        (engaged("pressed", since=3), []),  # not later than the decision
        (engaged("pressed", failure="object_lost"), []),  # the failure that is being answered already
        (engaged("elsewhere"), []),
    ],
)
def test_a_contact_on_the_way_to_rest_is_answered_by_itself(state: InterventionState, names: list[str]) -> None:
    assert [one.rule for one in ANSWERS.met(state, "object_lost", 3)] == names


@pytest.mark.parametrize(
    ("response", "signal", "off"),
    [
        (Response(enter=PAUSE), "separation_m", True),
        (Response(enter=CONTINUE, persist_ms=100, otherwise=PAUSE), "separation_m", True),
        (Response(enter=CONTINUE), "separation_m", False),
        (Response(enter=PAUSE), "slip_m", False),
    ],
)
def test_whoever_is_too_near_keeps_everything_from_beginning(response: Response, signal: str, off: bool) -> None:
    responses = Responses((replace(rule("near", response), signal=signal), LOST), 0.01)
    assert responses.keeps_off(("near",)) is off
    assert not responses.keeps_off(("lost", "elsewhere"))
