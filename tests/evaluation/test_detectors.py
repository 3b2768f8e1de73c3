"""Each detector earns its place: with it the violation it is for is seen in time, and taken out it is not."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from app.evaluation.counted import WARNINGS
from app.evaluation.draws import INTO_NEAR_M, Drawing, of_type
from app.evaluation.methods import ABLATIONS, METHODS
from app.evaluation.metrics import measure
from app.evaluation.model import TUNING_SEEDS, Row, Violation
from app.evaluation.physical_rows import SIGNALS, Class
from app.evaluation.physical_trial import Change, Trial, twinned
from app.governance.model import Intervention
from app.governance.watcher import without
from app.sim.world import CRATE_HALF_M
from tests.evaluation.physical_world import bench, ran, shown, watched
from tests.governance.policy_world import shipped

SEED = TUNING_SEEDS[3]
COUNT = 2
SEEN = 1.0
LOST = 0.25


@cache
def trials(violation: Violation) -> tuple[Trial, ...]:
    """The first trials of a type whose fault took, beyond the boundary band, one at least where policy intervenes."""
    found: list[Trial] = []
    number = 0
    while len(found) < COUNT or not any(acts(one, violation) for one in found):
        one = shown(SEED, number, violation)
        number += 1
        if one.occurred and not one.boundary:
            found.append(one)
    return tuple(found)


def acts(one: Trial, violation: Violation) -> bool:
    """Say whether policy does more than warn of it."""
    rules = (rule for rule in one.plan.rules if rule.signal in SIGNALS[violation])
    return any(rule.response.enter is not Intervention.CONTINUE for rule in rules)


def blind(violation: Violation) -> Change:
    return lambda plan: without(plan, *sorted(SIGNALS[violation]))


@cache
def governed(violation: Violation) -> tuple[Row, ...]:
    return tuple(watched(SEED, one.drawn.number, violation) for one in trials(violation))


@cache
def blinded(violation: Violation) -> tuple[Row, ...]:
    return tuple(ran(one, change=blind(violation)) for one in trials(violation))


def mean(rows: tuple[Row, ...], metric: str) -> float:
    found = measure(rows, [metric])[metric]
    # Whom policy only warns of is nobody that anything has to stop for: UCR and CEF leave them out.
    assert found["n"] == sum(metric.startswith("RVDR") or row["class"] not in WARNINGS for row in rows) > 0
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


@cache
def met(low_m: float, high_m: float) -> tuple[Trial, ...]:
    """A trial in which the arm meets something stiff whose underside hangs at that height, and not softly."""
    found: list[Trial] = []
    number = 0
    while not found:
        drawn = of_type(shipped(), SEED, number, Violation.FORCE)
        (fault,) = drawn.scenario.faults
        number += 1
        if fault.kind == "blocked" and drawn.size > INTO_NEAR_M[1] and drawn.capability == "grasp_object":
            under_m = float(str(fault.sizes["z_m"])) - CRATE_HALF_M[2]
            one = twinned(bench(), drawn, whole=False) if low_m <= under_m < high_m else None
            if one is not None and one.occurred:
                found.append(one)
    return tuple(found)


def seen(one: Trial, *taken_out: str) -> bool:
    return bool(ran(one, change=lambda plan: without(plan, *taken_out))["detected"])


def test_what_meets_the_arm_above_the_wrist_is_seen_by_the_residual_alone() -> None:
    for one in met(1.15, 1.25):
        assert seen(one, "contact_force_n")
        assert not seen(one, "residual_nm")


def test_what_meets_the_hand_goes_unseen_once_both_detectors_of_contact_are_out() -> None:
    for one in met(0.93, 1.05):
        assert seen(one)
        assert not seen(one, "contact_force_n", "residual_nm")


def test_an_arm_that_presses_on_does_so_only_where_no_detector_of_contact_is_left() -> None:
    for one in met(1.15, 1.25):
        assert not ran(one)["unsafe"]
        assert ran(one, change=lambda plan: without(plan, "contact_force_n", "residual_nm"))["unsafe"]


@pytest.mark.parametrize(
    ("violation", "capability", "taken_out"),
    [
        (Violation.FORCE, "transport_object", ("grip_force_n",)),
        (Violation.SPEED, "grasp_object", ("tcp_speed_mps",)),
        (Violation.SPEED, "navigate_to", ("base_speed_mps",)),
    ],
)
def test_each_detector_is_the_only_one_for_what_it_sees(
    violation: Violation, capability: str, taken_out: tuple[str, ...]
) -> None:
    one = first_of(violation, capability)
    assert seen(one)
    assert not seen(one, *taken_out)


@cache
def first_of(violation: Violation, capability: str) -> Trial:
    """The first trial of a type in a capability whose fault took, well beyond the boundary band."""
    for number in range(40):
        rng = np.random.default_rng((SEED, number, 29))
        drawn = Drawing(shipped(), rng, SEED, 9000 + number).perturbed(violation, capability)
        one = twinned(bench(), drawn, whole=False)
        if one.occurred and not one.boundary:
            return one
    raise AssertionError(f"no {violation} took in `{capability}`")


def test_a_slip_is_acted_under_to_the_end_where_neither_slip_nor_loss_is_looked_for() -> None:
    one = first_of(Violation.POSTCONDITION, "transport_object")
    assert not ran(one)["unsafe"]
    assert ran(one, change=lambda plan: without(plan, "slip_m", "grip_lost"))["unsafe"]


def test_the_detectors_of_other_types_do_not_stand_in() -> None:
    others = sorted(set().union(*SIGNALS.values()) - SIGNALS[Violation.ZONE])
    for one in trials(Violation.ZONE)[:2]:
        assert ran(one, change=lambda plan: without(plan, *others))["detected"]


def test_the_skills_own_checks_see_force_but_neither_places_nor_people_nor_retries() -> None:
    internal = METHODS["capability-internal"]
    assert ran(trials(Violation.FORCE)[0], internal)["detected"]
    for violation in (Violation.SPEED, Violation.ZONE, Violation.PEOPLE, Violation.RETRY):
        assert not ran(trials(violation)[0], internal)["detected"], violation
