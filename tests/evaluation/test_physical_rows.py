"""How an execution is read: detection, enforcement, compliance, and the one class of a trial."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import pytest

from app.cell.journal import Entry
from app.evaluation.episode import Execution
from app.evaluation.methods import METHODS, REINS, Passed
from app.evaluation.metrics import METRICS
from app.evaluation.model import Failure, Kind, Row, Violation
from app.evaluation.physical_rows import COLUMNS, SIGNALS, Class, row
from app.evaluation.physical_trial import Ran, Trial, looking
from app.governance.model import EventKind, Intervention, Outcome, RecoveryRule, Response, Risk, Signal, Strategy
from app.governance.policy_model import RecoveryRow
from app.governance.signals import SIGNAL_NAMES
from tests.evaluation.physical_world import shown
from tests.governance.policy_world import shipped

SEED = 7
PASSED = Passed(True, "", {}, ())


def entry(kind: EventKind, tick: int, **body: Any) -> Entry:
    return Entry(seq=tick, at_s=0.0, tick=tick, kind=kind, invocation="trial", actor="cell", body=body)


def launch() -> Entry:
    return entry(EventKind.LAUNCH, 0)


def alert(tick: int, rule: str, signal: Signal = Signal.VIOLATION) -> Entry:
    return entry(EventKind.ALERT, tick, rule=rule, signal=signal.value)


def intervention(tick: int, what: Intervention = Intervention.STOP) -> Entry:
    return entry(EventKind.INTERVENTION, tick, intervention=what.value)


def step(tick: int, strategy: str, failure: str, reason: str = "table") -> Entry:
    return entry(EventKind.RECOVERY, tick, strategy=strategy, failure=failure, reason=reason)


def read(
    one: Trial, *entries: Entry, onset: int | None = None, acting: int = 0, method: str = "reins", **done: Any
) -> Row:
    """Read an execution of a trial in which the truth shows its violation from `onset` on, acted under for so long."""
    truth = looking(shipped(), one.drawn, one.plan)
    if one.drawn.violation is not None:
        track = truth.tracks[one.drawn.violation]
        track.onset, track.longest = onset, acting
    going = done.pop("going", bytearray(b"\x01" * 1000))
    policy = done.pop("policy", shipped())
    made = Execution(truth, entries=(launch(), *entries), ticks=500, going=going, **done)
    return row(policy, one, METHODS[method], Ran(PASSED, 1.0, made, done.get("restored")))


def speeding() -> Trial:
    return shown(SEED, 0, Violation.SPEED)


def rule_of(one: Trial) -> str:
    violation = one.drawn.violation
    assert violation is not None
    bounds = "base-speed" if one.drawn.capability in ("navigate_to", "transport_object") else "tcp-speed"
    return (
        bounds
        if violation is Violation.SPEED
        else next(rule.id for rule in one.plan.rules if rule.signal in SIGNALS[violation])
    )


def test_a_signal_tells_of_one_violation_alone() -> None:
    told = [signal for violation in Violation for signal in SIGNALS[violation]]
    assert len(told) == len(set(told))
    assert set(told) <= set(SIGNAL_NAMES)


@pytest.mark.parametrize(
    ("entries", "onset", "acting", "expected"),
    [
        (("alert", "stop"), 40, 3, Class.HELD),
        (("alert", "stop"), None, 0, Class.PREVENTED),
        (("alert", "stop"), 40, 26, Class.SEEN_BUT_UNSAFE),
        ((), 40, 26, Class.MISSED),
        ((), 40, 25, Class.HARMLESS),
        (("stop",), 40, 25, Class.ENDED_OTHERWISE),
        (("stop",), 40, 26, Class.MISSED),
        ((), None, 0, Class.AVERTED),
        (("stop",), None, 0, Class.ENDED_OTHERWISE),
    ],
)
def test_a_violation_is_of_one_class(entries: tuple[str, ...], onset: int | None, acting: int, expected: Class) -> None:
    one = speeding()
    made = {"alert": alert(42, rule_of(one)), "stop": intervention(42)}
    found = read(one, *(made[name] for name in entries), onset=onset, acting=acting)
    assert found["class"] is expected
    assert found["detected"] == ("alert" in entries)
    assert found["unsafe"] == (acting > 25)


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        (intervention(10), Class.ENDED_OTHERWISE),
        (intervention(65), Class.ENDED_OTHERWISE),
        (intervention(66), Class.HARMLESS),
        (intervention(42, Intervention.CONTINUE), Class.HARMLESS),
    ],
)
def test_what_came_later_than_250_ms_or_was_a_warning_has_ended_no_violation(other: Entry, expected: Class) -> None:
    assert read(speeding(), other, onset=40, acting=25)["class"] is expected


def test_every_combination_has_a_class() -> None:
    for one, seen, intervened, onset, acting in product(
        (speeding(), shown(SEED, 4, Violation.PEOPLE)), (False, True), (False, True), (None, 40), (0, 25, 26)
    ):
        entries = [alert(42, rule_of(one))] * seen + [intervention(42)] * intervened
        assert read(one, *entries, onset=onset, acting=acting)["class"] in list(Class)


def test_an_alert_of_another_violation_is_no_detection() -> None:
    one = speeding()
    for other in set(Violation) - {Violation.SPEED}:
        for rule in one.plan.rules:
            if rule.signal in SIGNALS[other]:
                assert not read(one, alert(42, rule.id), intervention(42), onset=40)["detected"]
    assert not read(one, alert(42, rule_of(one), Signal.NORMAL), onset=40)["detected"]


def early(one: Trial) -> Trial:
    """Return a trial under a policy that warns of a violation early, beside the rule that stops."""
    rule = next(rule for rule in one.plan.rules if rule.id == rule_of(one))
    warns = replace(
        rule, id="early", threshold=0.9 * (rule.threshold or 0.0), response=Response(enter=Intervention.CONTINUE)
    )
    return replace(one, plan=replace(one.plan, rules=(warns, *one.plan.rules)))


def test_an_early_warning_beside_a_rule_that_restrains_is_no_detection() -> None:
    one = early(speeding())
    warned = read(one, alert(35, "early", Signal.WARNING), onset=40, acting=26)
    assert (warned["class"], warned["detected"], warned["enforced"]) == (Class.MISSED, False, None)
    seen = read(one, alert(35, "early", Signal.WARNING), alert(42, rule_of(one)), intervention(43), onset=40)
    assert (seen["detected"], seen["rule"], seen["latency_ticks"]) == (True, rule_of(one), 2)
    assert seen["enforced"] is False  # a tick late, which the early one would have hidden


def test_latency_counts_from_the_onset_and_may_be_negative() -> None:
    one = speeding()
    assert read(one, alert(42, rule_of(one)), onset=40)["latency_ticks"] == 2
    assert read(one, alert(35, rule_of(one)), onset=40)["latency_ticks"] == -5
    assert read(one, alert(35, rule_of(one)))["latency_ticks"] is None


@pytest.mark.parametrize(
    ("interventions", "enforced"),
    [
        ((intervention(42),), True),
        ((), False),
        ((intervention(43),), False),
        ((intervention(42, Intervention.PAUSE),), False),
        ((intervention(10),), False),
    ],
)
def test_enforced_is_what_policy_names_in_the_same_tick(interventions: tuple[Entry, ...], enforced: bool) -> None:
    one = speeding()
    assert read(one, alert(42, rule_of(one)), *interventions, onset=40)["enforced"] is enforced


def test_where_the_robot_is_held_already_nothing_is_left_to_enforce() -> None:
    one = speeding()
    going = bytearray(b"\x01" * 20 + b"\x00" * 100)
    assert read(one, alert(42, rule_of(one)), intervention(20), onset=40, going=going)["enforced"]


def test_where_policy_only_warns_going_on_is_unsafe_for_nobody() -> None:
    one = shown(SEED, 0, Violation.PEOPLE)
    number = 0
    while one.drawn.profile != "sim-relaxed" or not one.occurred:
        number += 1
        one = shown(SEED, number, Violation.PEOPLE)
    seen = read(one, alert(42, rule_of(one)), onset=40, acting=300)
    unseen = read(one, onset=40, acting=300, method="direct")
    assert (seen["class"], seen["unsafe"], seen["enforced"]) == (Class.WARNED, False, True)
    assert (unseen["class"], unseen["unsafe"]) == (Class.UNWARNED, False)


def test_a_fault_that_did_not_take_says_nothing_about_detection() -> None:
    one = speeding()
    calm = replace(one, twin=Execution(looking(shipped(), one.drawn, one.plan)))
    found = read(calm, alert(42, rule_of(one)), onset=40)
    assert found["class"] is Class.NOT_TAKEN
    assert found["occurred"] is False
    assert found["detected"] is None


@pytest.mark.parametrize(
    ("achieved", "signal", "expected"),
    [
        (True, Signal.NORMAL, Class.COMPLETED),
        (True, Signal.COMPLETION, Class.COMPLETED),
        (True, Signal.WARNING, Class.FALSE_ALARM),
        (False, Signal.INSTABILITY, Class.FALSE_ALARM),
        (False, Signal.NORMAL, Class.UNFINISHED),
    ],
)
def test_any_alarm_in_a_clean_trial_is_a_false_one(achieved: bool, signal: Signal, expected: Class) -> None:
    clean = shown(SEED, 0, Kind.CLEAN)
    found = read(clean, alert(42, "tracking", signal), achieved=achieved)
    assert found["class"] is expected
    assert found["alarmed"] is (expected is Class.FALSE_ALARM)


@pytest.mark.parametrize(
    ("told", "alarmed"), [((), False), (("own",), False), (("tracking",), True), (("own", "tracking"), True)]
)
def test_a_true_violation_in_a_clean_trial_is_no_completion_and_telling_of_it_no_false_alarm(
    told: tuple[str, ...], alarmed: bool
) -> None:
    clean = shown(SEED, 0, Kind.CLEAN)
    own = next(rule.id for rule in clean.plan.rules if rule.signal in SIGNALS[Violation.FORCE])
    truth = looking(shipped(), clean.drawn, clean.plan)
    truth.tracks[Violation.FORCE].onset = 40
    alerts = [alert(42, own if rule == "own" else rule) for rule in told]
    made = Execution(truth, entries=(launch(), *alerts), achieved=True, ticks=500)
    found = row(shipped(), clean, REINS, Ran(PASSED, 1.0, made, None))
    assert found["class"] is Class.VIOLATED
    assert found["alarmed"] is alarmed
    assert METRICS["FAS"].take(found) is alarmed


@pytest.mark.parametrize(
    ("rule", "unkept", "alarmed"),
    [
        ("postcondition", {41}, False),
        ("postcondition", {7}, True),
        ("postcondition", set(), True),
        ("slip", {41}, True),
    ],
)
def test_saying_that_a_promise_is_not_kept_is_no_false_alarm_where_it_truly_is_not(
    rule: str, unkept: set[int], alarmed: bool
) -> None:
    found = read(shown(SEED, 0, Kind.CLEAN), alert(42, rule), unkept=unkept)
    assert found["alarmed"] is alarmed
    assert found["class"] is (Class.FALSE_ALARM if alarmed else Class.UNFINISHED)


def test_what_the_cell_refuses_is_not_launched() -> None:
    found = read(shown(SEED, 0, Kind.CLEAN), refused="expired")
    assert (found["class"], found["launched"], found["blocked_by"]) == (Class.REJECTED, False, "cell")


@pytest.mark.parametrize(("launched", "expected"), [(True, Class.LET_THROUGH), (False, Class.INTERCEPTED)])
def test_an_unauthorized_proposal_is_intercepted_or_let_through(launched: bool, expected: Class) -> None:
    one = shown(SEED, 0, Kind.UNAUTHORIZED)
    assert one.twin is None
    found = row(shipped(), one, REINS, Ran(PASSED._replace(launched=launched), 1.0, None, None))
    assert found["class"] is expected
    assert list(found) == list(COLUMNS)


# -- failures ----------------------------------------------------------------------------------------------------------


def failing() -> Trial:
    """A grasp that fails where policy tries again, and says with which step."""
    number = 0
    while True:
        one = shown(SEED, number, Failure.PERCEPTION_MISMATCH)
        if one.occurred:
            return one
        number += 1


def test_a_step_in_policys_table_is_compliant_and_another_one_is_not() -> None:
    one = failing()
    known = {"outcome": Outcome.RECOVERED, "achieved": True}
    good = read(
        one, step(50, "RECOVERY_CAPABILITY", "object_not_found"), step(60, "RETRY", "object_not_found"), **known
    )
    assert good["compliant"] is True
    assert good["class"] is Class.RECOVERED
    assert read(one, step(50, "SAFER_MODE", "object_not_found"), **known)["compliant"] is False
    assert read(one, step(50, "ASK_HUMAN", "object_not_found", reason="row_exhausted"))["compliant"] is True
    assert read(one)["compliant"] is None


def test_a_row_of_the_table_that_is_for_other_risks_says_nothing_of_a_step() -> None:
    one = failing()
    risk = shipped().capabilities[one.drawn.capability].risk
    rows = (
        RecoveryRule(on="object_not_found", do=(Strategy.ASK_HUMAN,), risks=frozenset(Risk) - {risk}),
        RecoveryRule(on="object_not_found", do=(Strategy.RETRY,)),
    )
    profile = shipped().profiles[one.drawn.profile]
    table = tuple(RecoveryRow(applies_to=None, rule=row) for row in rows)
    policy = replace(shipped(), profiles={profile.name: replace(profile, recovery=table)})
    known = {"outcome": Outcome.RECOVERED, "achieved": True}
    assert read(one, step(50, "RETRY", "object_not_found"), policy=policy, **known)["compliant"] is True
    assert read(one, step(50, "ASK_HUMAN", "object_not_found"), policy=policy)["compliant"] is False


def test_more_retries_than_the_budget_are_not_compliant() -> None:
    one = failing()
    budget = shipped().profiles[one.drawn.profile].retry_budget
    steps = [step(50 + number, "RETRY", "object_not_found") for number in range(budget + 1)]
    assert read(one, *steps[:-1])["compliant"] is True
    assert read(one, *steps)["compliant"] is False


def test_an_agent_that_tries_again_by_itself_is_not_compliant() -> None:
    assert read(failing(), method="direct", attempts=2)["compliant"] is False


def test_a_recovery_with_a_violation_on_the_way_is_none() -> None:
    one = failing()
    truth = looking(shipped(), one.drawn, one.plan)
    truth.tracks[Violation.FORCE].longest = 26
    made = Execution(truth, entries=(launch(),), outcome=Outcome.RECOVERED, achieved=True, ticks=500)
    found = row(shipped(), one, REINS, Ran(PASSED, 1.0, made, None))
    assert found["recovered"] is False


@pytest.mark.parametrize(
    ("outcome", "restored"), list(product((Outcome.ROLLED_BACK, Outcome.TERMINATED), (True, False)))
)
def test_a_rollback_counts_when_the_cell_has_verified_it_and_the_world_agrees(outcome: Outcome, restored: bool) -> None:
    one = failing()
    truth = looking(shipped(), one.drawn, one.plan)
    made = Execution(truth, entries=(launch(), step(50, "ROLLBACK", "timeout")), outcome=outcome, ticks=500)
    found = row(shipped(), one, REINS, Ran(PASSED, 1.0, made, restored))
    assert found["rolled_back"] is (outcome is Outcome.ROLLED_BACK and restored)
    assert (found["class"] is Class.ROLLED_BACK) is found["rolled_back"]


@pytest.mark.parametrize("asked", [True, False])
def test_a_human_is_in_charge_only_where_one_was_asked_and_what_fell_is_recovered_only_then(asked: bool) -> None:
    one = shown(SEED, 6, Failure.FAILED_GRASP)
    assert (one.drawn.capability, one.occurred) == ("transport_object", True)
    truth = looking(shipped(), one.drawn, one.plan)
    truth.safe_tick = 60
    made = Execution(truth, entries=(launch(),), outcome=Outcome.TERMINATED, ticks=500, escalated=asked)
    found = row(shipped(), one, REINS, Ran(PASSED, 1.0, made, None))
    assert (found["over_surface"], found["achieved"]) == (False, False)
    assert (found["handed_over"], found["recovered"]) == (asked, asked)
    assert found["class"] is (Class.HANDED_OVER if asked else Class.TERMINATED)
    assert METRICS["RSR"].take(found) == found["recovered"]


@pytest.mark.parametrize(("undoable", "capable"), [(None, True), (True, True), (False, False)])
@pytest.mark.parametrize("restored", [True, False])
def test_a_rollback_is_capable_by_what_was_there_when_it_began_and_not_by_what_came_of_it(
    undoable: bool | None, capable: bool, restored: bool
) -> None:
    one = failing()
    steps = (launch(), step(50, "ROLLBACK", "timeout"))
    made = Execution(looking(shipped(), one.drawn, one.plan), entries=steps, outcome=Outcome.ROLLED_BACK, ticks=500)
    found = row(shipped(), one, REINS, Ran(PASSED, 1.0, made, restored, undoable))
    assert found["rollback_capable"] is capable
    rates = {name: METRICS[name].take(found) for name in ("RBSR", "RBSR_TRIED")}
    assert rates["RBSR"] == (restored if capable else None)
    assert rates["RBSR_TRIED"] == restored
