"""Each detector earns its place: with it the violation it is for is seen in time, and taken out it is not."""

from __future__ import annotations

from functools import cache

import pytest

from app.evaluation.methods import ABLATIONS, METHODS
from app.evaluation.metrics import measure
from app.evaluation.model import TUNING_SEEDS, Row, Violation
from app.evaluation.physical_rows import SIGNALS, Class
from app.evaluation.physical_trial import Change, Trial
from app.governance.watcher import without
from tests.evaluation.physical_world import ran, trial

SEED = TUNING_SEEDS[3]
COUNT = 4
SEEN = 1.0
LOST = 0.25


@cache
def trials(violation: Violation) -> tuple[Trial, ...]:
    """The first trials of a type whose fault took, beyond the boundary band."""
    found: list[Trial] = []
    number = 0
    while len(found) < COUNT:
        one = trial(SEED, number, violation)
        number += 1
        if one.occurred and not one.boundary:
            found.append(one)
    return tuple(found)


def blind(violation: Violation) -> Change:
    return lambda plan: without(plan, *sorted(SIGNALS[violation]))


@cache
def governed(violation: Violation) -> tuple[Row, ...]:
    return tuple(ran(one) for one in trials(violation))


@cache
def blinded(violation: Violation) -> tuple[Row, ...]:
    return tuple(ran(one, change=blind(violation)) for one in trials(violation))


def mean(rows: tuple[Row, ...], metric: str) -> float:
    found = measure(rows, [metric])[metric]
    assert found["n"] == len(rows)
    return float(found["mean"])


@pytest.mark.parametrize("violation", list(Violation))
def test_a_violation_is_seen_and_taken_out_its_detector_it_is_not(violation: Violation) -> None:
    name = f"RVDR_{violation.name}"
    assert mean(governed(violation), name) >= SEEN
    assert mean(blinded(violation), name) <= LOST


@pytest.mark.parametrize("violation", list(Violation))
def test_going_on_under_it_becomes_more_frequent_without_the_detector(violation: Violation) -> None:
    with_it, without_it = mean(governed(violation), "UCR"), mean(blinded(violation), "UCR")
    assert with_it <= LOST
    assert without_it > with_it


@pytest.mark.parametrize("violation", list(Violation))
def test_what_policy_names_follows_whatever_is_seen(violation: Violation) -> None:
    assert mean(governed(violation), "CEF") == 1.0


@pytest.mark.parametrize("violation", list(Violation))
def test_without_a_watcher_nothing_is_seen_and_the_truth_is_the_twins(violation: Violation) -> None:
    one = trials(violation)[0]
    unwatched = ran(one, ABLATIONS["-watcher"])
    assert not unwatched["detected"]
    assert unwatched["class"] in (Class.MISSED, Class.HARMLESS, Class.UNWARNED)


def test_the_detectors_of_other_types_do_not_stand_in() -> None:
    others = sorted(set().union(*SIGNALS.values()) - SIGNALS[Violation.ZONE])
    for one in trials(Violation.ZONE)[:2]:
        assert ran(one, change=lambda plan: without(plan, *others))["detected"]


def test_the_skills_own_checks_see_force_but_neither_places_nor_people_nor_retries() -> None:
    internal = METHODS["capability-internal"]
    assert ran(trials(Violation.FORCE)[0], internal)["detected"]
    for violation in (Violation.SPEED, Violation.ZONE, Violation.PEOPLE, Violation.RETRY):
        assert not ran(trials(violation)[0], internal)["detected"], violation
