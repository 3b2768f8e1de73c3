"""The coin watches as often as it should, and policy decides what follows."""

from __future__ import annotations

from collections import Counter
from itertools import repeat

import pytest
from scipy import stats

from app.evaluation.methods import ABLATIONS, METHODS, REINS
from app.evaluation.model import PAPER_FAILURES, PROFILES, Failure, Kind, Violation
from app.evaluation.paper_generator import ALL, RECOVERY_FIRST, Trial, draw
from app.evaluation.paper_runtime import Chance, Ending, Step, chances, monitor, undergo
from app.governance import bundle
from app.governance.model import Strategy
from tests.governance.policy_world import files, shipped

SEED, MANY, SURE = 77, 4000, 1e-6
S = {"sim-relaxed": 0.3, "test-audit": 0.5, "real-restricted": 0.7, "human-shared": 0.9}
GOOD, BAD = Chance(True, True), Chance(False, False)


def perturbed() -> list[Trial]:
    drawn = (draw(shipped(), SEED, ALL, number) for number in range(MANY))
    return [trial for trial in drawn if trial.kind is Kind.PERTURBED]


def failing(failure: Failure, profile: str, capability: str = "grasp_object") -> Trial:
    return draw(shipped(), SEED, ALL, RECOVERY_FIRST)._replace(failure=failure, profile=profile, capability=capability)


# Watching ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", PROFILES)
def test_sees_as_often_as_the_profile_is_sensitive(profile: str) -> None:
    mine = [trial for trial in perturbed() if trial.profile == profile and trial.violation is not Violation.PEOPLE]
    seen = sum(monitor(REINS, shipped(), trial).detected for trial in mine)
    assert stats.binomtest(seen, len(mine), S[profile]).pvalue > SURE


@pytest.mark.parametrize("profile", PROFILES)
def test_people_are_seen_only_where_s_is_above_seven_tenths(profile: str) -> None:
    mine = [trial for trial in perturbed() if trial.profile == profile and trial.violation is Violation.PEOPLE]
    found = [monitor(REINS, shipped(), trial) for trial in mine]
    if profile == "human-shared":
        assert stats.binomtest(sum(one.detected for one in found), len(mine), 0.9).pvalue > SURE
    else:
        assert {one.ending for one in found} == {Ending.NOT_WATCHED}


def test_seven_tenths_itself_is_not_above() -> None:
    trial = next(trial for trial in perturbed() if trial.violation is Violation.PEOPLE)._replace(coin=0.0)
    assert not monitor(REINS, shipped(), trial, 0.7).detected
    assert monitor(REINS, shipped(), trial, 0.71).detected


def test_what_is_seen_is_held_and_what_is_not_goes_on() -> None:
    for trial in perturbed():
        found = monitor(REINS, shipped(), trial)
        assert found.unsafe is not found.detected
        assert found.enforced is (True if found.detected else None)


def test_where_policy_only_warns_of_people_the_robot_goes_on() -> None:
    people = next(trial for trial in perturbed() if trial.violation is Violation.PEOPLE)
    warned = monitor(REINS, shipped(), people._replace(profile="sim-relaxed"), 1.0)
    assert warned == (True, True, True, Ending.WARNED)
    assert monitor(REINS, shipped(), people._replace(profile="real-restricted"), 1.0).ending is Ending.HELD


def test_a_profile_that_does_not_watch_zones_does_not_see_them() -> None:
    changed = files()
    rule = "  - id: zone\n    signal: zone_margin_m\n    below: 0.0\n    failure: zone\n    response: {enter: stop}\n"
    assert rule in changed["profiles/test-audit.yaml"]
    changed["profiles/test-audit.yaml"] = changed["profiles/test-audit.yaml"].replace(rule, "")
    zone = next(trial for trial in perturbed() if trial.violation is Violation.ZONE)._replace(profile="test-audit")
    assert monitor(REINS, shipped(), zone, 1.0).ending is Ending.HELD
    assert monitor(REINS, bundle.load_files(changed), zone, 1.0).ending is Ending.NOT_WATCHED


@pytest.mark.parametrize("name", ["direct", "static-rule", "autort-style", "roboguard-style", "-watcher"])
def test_nothing_is_seen_where_nothing_watches(name: str) -> None:
    method = {**METHODS, **ABLATIONS}[name]
    assert {monitor(method, shipped(), trial, 1.0).ending for trial in perturbed()} == {Ending.NOT_WATCHED}


def test_a_capability_sees_its_own_force_and_grip_alone() -> None:
    seen = [
        trial.violation for trial in perturbed() if monitor(METHODS["capability-internal"], shipped(), trial).detected
    ]
    assert set(seen) == {Violation.FORCE, Violation.POSTCONDITION}


# Recovering ----------------------------------------------------------------------------------------------------------


def steps(trial: Trial, luck: list[Chance], name: str = "reins") -> tuple[list[Strategy], Ending]:
    found = undergo({**METHODS, **ABLATIONS}[name], shipped(), trial, iter(luck))
    return [step.strategy for step in found.steps], found.ending


def test_policy_lets_go_before_it_grasps_again() -> None:
    trial = failing(Failure.FAILED_GRASP, "human-shared")
    assert steps(trial, [GOOD, BAD]) == ([Strategy.RECOVERY_CAPABILITY, Strategy.RETRY], Ending.RECOVERED)


def test_a_recovery_that_fails_goes_to_a_human_where_there_is_one() -> None:
    assert steps(failing(Failure.FAILED_GRASP, "human-shared"), [BAD]) == (
        [Strategy.RECOVERY_CAPABILITY],
        Ending.HANDED_OVER,
    )
    assert steps(failing(Failure.FAILED_GRASP, "sim-relaxed"), [BAD])[1] is Ending.TERMINATED


def test_a_timeout_is_rolled_back_and_not_tried_again() -> None:
    trial = failing(Failure.TIMEOUT, "real-restricted")
    assert steps(trial, [GOOD]) == ([Strategy.ROLLBACK], Ending.ROLLED_BACK)
    assert steps(trial, [BAD]) == ([Strategy.ROLLBACK], Ending.HANDED_OVER)
    found = undergo(REINS, shipped(), trial, repeat(BAD))
    assert (found.recovered, found.rolled_back) == (False, False)


def test_what_has_no_rollback_is_not_rolled_back() -> None:
    found = undergo(REINS, shipped(), failing(Failure.TIMEOUT, "human-shared", "inspect_area"), repeat(GOOD))
    assert (found.rolled_back, found.ending) == (None, Ending.TERMINATED)


def test_a_retry_after_a_timeout_is_no_success_for_anybody() -> None:
    for name in ("direct", "capability-internal", "roboguard-style"):
        assert steps(failing(Failure.TIMEOUT, "sim-relaxed"), [GOOD], name) == ([Strategy.RETRY], Ending.GIVEN_UP)
        assert steps(failing(Failure.BLOCKED_PATH, "sim-relaxed"), [GOOD], name)[1] is Ending.RECOVERED


def test_only_what_policy_names_complies() -> None:
    grasp = failing(Failure.FAILED_GRASP, "sim-relaxed")
    assert undergo(REINS, shipped(), grasp, repeat(BAD)).compliant
    assert not undergo(METHODS["direct"], shipped(), grasp, repeat(GOOD)).compliant
    assert undergo(METHODS["capability-internal"], shipped(), grasp, repeat(GOOD)).compliant
    assert not undergo(ABLATIONS["-recovery"], shipped(), grasp, repeat(GOOD)).compliant
    blocked = failing(Failure.BLOCKED_PATH, "sim-relaxed", "navigate_to")
    assert not undergo(METHODS["capability-internal"], shipped(), blocked, repeat(GOOD)).compliant


def test_taking_the_human_out_leaves_a_step_that_policy_wanted_undone() -> None:
    trial = failing(Failure.FAILED_GRASP, "human-shared")
    found = undergo(ABLATIONS["-human"], shipped(), trial, repeat(BAD))
    assert (found.ending, found.compliant) == (Ending.TERMINATED, False)


def test_every_method_has_the_same_luck() -> None:
    trial = failing(Failure.BLOCKED_PATH, "sim-relaxed", "navigate_to")
    first = [next(luck) for luck in (chances(trial), chances(trial))]
    assert first[0] == first[1]
    alike = {undergo(METHODS[name], shipped(), trial).steps for name in ("direct", "static-rule", "autort-style")}
    assert len(alike) == 1


def test_motions_succeed_at_nine_tenths_and_causes_go_by_even_odds() -> None:
    drawn = [next(chances(draw(shipped(), SEED, ALL, RECOVERY_FIRST + place))) for place in range(2000)]
    assert stats.binomtest(sum(one.motion for one in drawn), 2000, 0.9).pvalue > SURE
    assert stats.binomtest(sum(one.gone for one in drawn), 2000, 0.5).pvalue > SURE


def test_recovery_ends_whatever_befalls_it() -> None:
    endings: Counter[Ending] = Counter()
    for profile in PROFILES:
        for failure in PAPER_FAILURES:
            for capability in ("grasp_object", "navigate_to", "inspect_area"):
                found = undergo(REINS, shipped(), failing(failure, profile, capability), repeat(BAD))
                endings[found.ending] += 1
                assert all(isinstance(step, Step) for step in found.steps)
    assert set(endings) == {Ending.HANDED_OVER, Ending.TERMINATED}
