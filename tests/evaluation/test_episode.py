"""Executions are functions of their trial: repeatable bit by bit, whatever ran before, governed as much as asked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from app.evaluation.capabilities import judge_of
from app.evaluation.draws import of_type
from app.evaluation.episode import LIMIT_TICKS, RECOVERY_TICKS, REST_TICKS, Execution, ungoverned, watch_rest
from app.evaluation.methods import ABLATIONS, METHODS, REINS, Recovering, Watching
from app.evaluation.model import TUNING_SEEDS, Failure, Kind, Violation
from app.evaluation.physical_rows import row
from app.evaluation.physical_trial import Bench, Trial, looking, prepare, run
from app.governance.model import EventKind, Outcome, Signal
from tests.evaluation.physical_world import bench, ran, shown, trial, watched
from tests.governance.policy_world import shipped

SEED = 7
WITHOUT = replace(REINS, name="nothing", watch=Watching.NOTHING, recovery=Recovering.NOTHING)


def seen(done: Execution | None) -> dict[str, Any]:
    """Everything that the truth noted, and how it ended."""
    assert done is not None
    noted = {one.name: repr(getattr(done.truth, one.name)) for one in fields(done.truth) if one.name != "plan"}
    return {**noted, "ticks": done.ticks, "achieved": done.achieved, "failures": done.failures}


def executed(one: Trial, method: Any = REINS, *, limit: int = LIMIT_TICKS + RECOVERY_TICKS) -> Execution:
    done = run(bench(), one, (method,), limit=limit)[method.name].execution
    assert done is not None
    return done


def taken(violation: Violation) -> Trial:
    return next(one for number in range(9) if (one := trial(SEED, number, violation)).occurred)


def under(profile: str, violation: Violation, seed: int = SEED) -> Iterator[Trial]:
    """The trials that are drawn under a profile: to learn the profile of the others, no twin of theirs is run."""
    for number in range(30):
        if of_type(shipped(), seed, number, violation).profile == profile:
            one = shown(seed, number, violation)
            if one.drawn.profile == profile:  # it may have been drawn again, because the fault did not take
                yield one


@pytest.mark.parametrize("violation", [Violation.FORCE, Violation.SPEED, Violation.POSTCONDITION])
def test_the_ungoverned_twin_is_repeatable_bit_by_bit(violation: Violation) -> None:
    one = taken(violation)
    executed(one, limit=500)  # something else on the same stage, let go midway
    again = prepare(bench(), SEED, one.drawn.number, wanted=violation)
    assert seen(again.twin) == seen(one.twin)


def test_a_trial_after_others_is_the_same_as_alone() -> None:
    one = taken(Violation.SPEED)
    after = ran(one)
    alone = Bench.of(shipped())
    fresh = prepare(alone, SEED, one.drawn.number, wanted=Violation.SPEED)
    first = row(shipped(), fresh, REINS, run(alone, fresh, (REINS,))["reins"])
    assert {**first, "decision_us": None} == {**after, "decision_us": None}


def test_methods_that_behave_alike_share_an_execution_and_say_the_same_as_alone() -> None:
    one = taken(Violation.FORCE)
    methods = (*METHODS.values(), *ABLATIONS.values())
    together = run(bench(), one, methods)
    assert together["direct"].execution is together["static-rule"].execution is one.twin
    assert together["reins"].execution is together["-policy"].execution is together["-admission"].execution
    assert len({id(found.execution) for found in together.values() if found.execution}) == 6
    for name in ("capability-internal", "-policy", "-human"):
        method = {**METHODS, **ABLATIONS}[name]
        assert seen(run(bench(), one, (method,))[name].execution) == seen(together[name].execution)


def test_who_watches_nothing_hears_nothing_not_even_of_what_is_watched_without_being_asked() -> None:
    ones = (trial(SEED, number, Violation.POSTCONDITION) for number in range(20))
    one = next(one for one in ones if one.twin and one.twin.claimed and not one.twin.achieved)
    done = executed(one, WITHOUT)
    assert {entry.body["signal"] for entry in done.of(EventKind.ALERT)} <= {Signal.COMPLETION.value}
    assert not done.of(EventKind.INTERVENTION)
    assert done.outcome is Outcome.SUCCEEDED
    assert not done.achieved
    assert done.truth.tracks[Violation.POSTCONDITION].unsafe


def test_a_clean_trial_is_done_with_and_without_governance() -> None:
    one = trial(SEED, 1, Kind.CLEAN)
    for done in (one.twin, executed(one), executed(one, WITHOUT)):
        assert done is not None
        assert done.achieved
        assert all(track.onset is None for track in done.truth.tracks.values())


def test_attempts_are_those_of_the_skill_and_of_governance_together() -> None:
    one = taken(Violation.RETRY)
    budget = shipped().profiles[one.drawn.profile].retry_budget
    free, watched = executed(one, WITHOUT, limit=LIMIT_TICKS), executed(one)
    for wild in (free, one.twin):
        assert wild is not None
        assert wild.attempts > budget + 2
        assert wild.attempts - 1 - budget == wild.truth.tracks[Violation.RETRY].excess
    assert 1 < watched.attempts <= budget + 3
    assert watched.attempts - 1 - budget == watched.truth.tracks[Violation.RETRY].excess or watched.attempts <= budget
    assert free.truth.ways.of[Violation.RETRY].seconds is None  # nobody ever held it back
    assert not one.twin.over  # type: ignore[union-attr]  # an obstinate skill never stops by itself


def test_what_is_withdrawn_midway_is_undone_in_the_world() -> None:
    one = next(one for number in range(9) if (one := trial(SEED, number, Failure.WITHDRAWN)).occurred)
    found = ran(one)
    assert found["outcome"] == Outcome.ROLLED_BACK
    assert found["rolled_back"] is True
    assert found["recovered"] is None


@pytest.mark.parametrize(("moves", "looked"), [(0, 1), (7, 8), (10_000, REST_TICKS)])
def test_the_truth_looks_on_after_the_session_until_the_robot_stands_and_no_longer(moves: int, looked: int) -> None:
    one = taken(Violation.SPEED)
    seen, passed = looking(shipped(), one.drawn, one.plan), 0

    def tick() -> None:
        nonlocal passed
        passed += 1

    at_rest = bench().stage.set(one.drawn.start, one.drawn.world, one.drawn.scenario).glance()
    cell = SimpleNamespace(glance=lambda: at_rest._replace(base_speed_mps=0.1 if passed <= moves else 0.0))
    watch_rest(cast("Any", SimpleNamespace(tick=tick)), cast("Any", cell), seen)
    assert (passed, seen.tick) == (looked, looked)
    assert seen.safe_tick == (moves + 1 if moves < REST_TICKS else None)


def test_looking_on_does_not_make_the_session_longer() -> None:
    done = executed(taken(Violation.SPEED))
    assert done.over
    assert done.ticks < done.truth.tick <= done.ticks + REST_TICKS
    assert all(way.seconds is not None for way in done.truth.ways.of.values())


@pytest.mark.parametrize(
    ("number", "wanted", "capability"),
    [(65, Violation.SPEED, "transport_object"), (34, Violation.FORCE, "grasp_object")],
)
def test_servos_that_run_ahead_or_something_in_the_arms_way_do_not_hinder_the_way_back(
    number: int, wanted: Violation, capability: str
) -> None:
    one = shown(SEED, number, wanted)
    assert (one.drawn.capability, one.drawn.profile, one.occurred) == (capability, "test-audit", True)
    found = ran(one)
    assert (found["rollback_capable"], found["rolled_back"]) == (True, True)


@pytest.mark.parametrize(
    ("number", "capability"),
    [(17, "grasp_object"), (215, "transport_object")],
)
def test_what_was_moved_away_or_slides_out_of_the_grip_leaves_nothing_to_go_back_to(
    number: int, capability: str
) -> None:
    wanted = Failure.PERCEPTION_MISMATCH if capability == "grasp_object" else Failure.FAILED_GRASP
    one = shown(SEED, number, wanted)
    assert (one.drawn.capability, one.occurred) == (capability, True)
    found = ran(one)
    assert (found["rollback_capable"], found["rolled_back"]) == (False, False)


def test_an_execution_ends_at_its_limit() -> None:
    one = taken(Violation.RETRY)
    cell = bench().stage.set(one.drawn.start, one.drawn.world, one.drawn.scenario)
    truth = looking(shipped(), one.drawn, one.plan)
    done = ungoverned(cell, one.drawn.capability, one.proposal.params, truth, judge_of(one.drawn), limit=50)
    assert done.ticks == 50
    assert not done.claimed


def test_where_nobody_may_be_asked_policy_ends_what_slips_again_and_again() -> None:
    seed = TUNING_SEEDS[3]  # as in `test_detectors`, which executes the same: it is long
    slipping = under("sim-relaxed", Violation.POSTCONDITION, seed)
    one = next(one for one in slipping if one.drawn.capability == "grasp_object")
    found = watched(seed, one.drawn.number, Violation.POSTCONDITION)
    assert found["ended"] is True
    assert found["outcome"] == Outcome.TERMINATED
    assert found["attempts"] == 1 + shipped().profiles["sim-relaxed"].retry_budget
    assert (found["asked"], found["answers"], found["midway_s"]) == (0, None, 0.0)


def test_who_was_asked_midway_what_they_said_and_how_long_that_took_is_in_the_row() -> None:
    found = next(row for one in under("human-shared", Violation.FORCE) if (row := ran(one))["asked"])
    assert found["answers"] == "resolve_terminate"
    assert found["midway_s"] == pytest.approx(2.0, abs=0.05)
    assert found["outcome"] == Outcome.TERMINATED
