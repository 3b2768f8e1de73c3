"""Each detector earns its place: with it the violation it is for is seen in time, and taken out it is not.

Once a detector is out, an alert of any other counts, whatever it is about: what is asked is whether anything at all
would have noticed. Where another does as well, that is a test here too: those detectors are redundant in these trials.
"""

from __future__ import annotations

from functools import cache
from math import inf
from typing import NamedTuple

import numpy as np
import pytest

from app.evaluation.counted import WARNINGS
from app.evaluation.draws import INTO_NEAR_M, Drawing, of_type
from app.evaluation.methods import ABLATIONS, METHODS, REINS
from app.evaluation.metrics import measure
from app.evaluation.model import TUNING_SEEDS, Row, Violation
from app.evaluation.physical_rows import SIGNALS, UNLOOKED, Class, row
from app.evaluation.physical_trial import LONGEST_TICKS, Trial, run, twinned
from app.evaluation.truth import SLACK_TICKS
from app.governance.model import EventKind, Intervention
from app.governance.watcher import without
from app.sim.world import CRATE_HALF_M
from tests.evaluation.physical_world import bench, ran, shown, watched
from tests.governance.policy_world import shipped

SEED = TUNING_SEEDS[3]
COUNT = 2
SEEN = 1.0
LOST = 0.25
PROMPT_TICKS = 5  # what the goals ask of force and speed
LIMIT_TICKS = LONGEST_TICKS + 200  # a violation shows by then, and whoever is told of it 2 s later is told too late
IN_TIME_TICKS = SLACK_TICKS  # whoever is told later has acted under it for too long


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


class Watched(NamedTuple):
    """A trial some of whose detectors may be out: its row, and ticks from the onset to the first alert of any kind."""

    row: Row
    late: float

    @property
    def seen(self) -> bool:
        return self.late <= IN_TIME_TICKS


def blind(one: Trial, *taken_out: str) -> Watched:
    taken = run(bench(), one, (REINS,), change=lambda plan: without(plan, *taken_out), limit=LIMIT_TICKS)
    under = taken[REINS.name]
    done = under.execution
    assert done is not None
    assert one.drawn.violation is not None
    alarms = [entry.tick for entry in done.of(EventKind.ALERT) if str(entry.body["signal"]) not in UNLOOKED]
    onset = done.truth.tracks[one.drawn.violation].onset
    # What never came about was seen in time by whatever alarmed.
    late = inf if not alarms else -inf if onset is None else alarms[0] - done.entries[0].tick - onset
    return Watched(row(shipped(), one, REINS, under), late)


@cache
def governed(violation: Violation) -> tuple[Row, ...]:
    return tuple(watched(SEED, one.drawn.number, violation) for one in trials(violation))


@cache
def blinded(violation: Violation) -> tuple[Watched, ...]:
    return tuple(blind(one, *sorted(SIGNALS[violation])) for one in trials(violation))


def mean(rows: tuple[Row, ...], metric: str) -> float:
    found = measure(rows, [metric])[metric]
    # Whom policy only warns of is nobody that anything has to stop for: UCR and CEF leave them out.
    assert found["n"] == sum(metric.startswith("RVDR") or row["class"] not in WARNINGS for row in rows) > 0
    return float(found["mean"])


@pytest.mark.parametrize("violation", list(Violation))
def test_a_violation_is_seen_and_without_its_detectors_nothing_else_alarms_in_time(violation: Violation) -> None:
    assert mean(governed(violation), f"RVDR_{violation.name}") >= SEEN
    found = [one.seen for one in blinded(violation)]
    assert sum(found) / len(found) <= LOST


@pytest.mark.parametrize("violation", list(Violation))
def test_going_on_under_it_becomes_more_frequent_without_the_detector(violation: Violation) -> None:
    with_it = mean(governed(violation), "UCR")
    without_it = mean(tuple(one.row for one in blinded(violation)), "UCR")
    assert with_it <= LOST
    assert without_it > with_it


@pytest.mark.parametrize("violation", list(Violation))
def test_what_policy_names_follows_whatever_is_seen(violation: Violation) -> None:
    assert mean(governed(violation), "CEF") == 1.0


@pytest.mark.parametrize("violation", list(Violation))
def test_without_a_watcher_nothing_is_seen_and_the_truth_is_the_twins(violation: Violation) -> None:
    one = trials(violation)[0]
    unwatched = ran(one, ABLATIONS["-watcher"], limit=LIMIT_TICKS)
    assert not unwatched["detected"]
    assert unwatched["class"] in (Class.MISSED, Class.HARMLESS, Class.UNWARNED)


def test_a_claim_that_the_cell_finds_untrue_is_marked_as_untrue_in_the_tick_before_it_says_so() -> None:
    told = 0
    for one in trials(Violation.POSTCONDITION):
        # What is left is the check of the claim.
        under = run(bench(), one, (REINS,), change=lambda plan: without(plan, "slip_m", "grip_lost"))[REINS.name]
        done = under.execution
        assert done is not None
        said = [entry for entry in done.of(EventKind.ALERT) if str(entry.body["signal"]) not in UNLOOKED]
        ticks = [entry.tick - done.entries[0].tick for entry in said if entry.body["rule"] == "postcondition"]
        assert {tick - 1 for tick in ticks} <= done.unkept
        told += len(ticks)
    assert told


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


def test_what_meets_the_arm_above_the_wrist_is_seen_by_the_residual_alone() -> None:
    for one in met(1.15, 1.25):
        assert not blind(one, "contact_force_n").row["unsafe"]
        pressed_on = blind(one, "residual_nm")
        assert not pressed_on.seen
        assert pressed_on.row["unsafe"]


def test_contact_force_is_redundant_to_the_residual_at_the_hand_and_without_both_what_is_left_tells_too_late() -> None:
    for one in met(0.93, 1.05):
        for taken_out in (("contact_force_n",), ("residual_nm",)):
            backed = blind(one, *taken_out)
            assert backed.late <= PROMPT_TICKS
            assert not backed.row["unsafe"]
        left = blind(one, "contact_force_n", "residual_nm")
        # The arm falls behind what it is told, and that is noticed as well, once it has lasted.
        assert left.late > PROMPT_TICKS
        assert left.row["unsafe"]


@pytest.mark.parametrize(
    ("violation", "capability", "signal"),
    [
        (Violation.FORCE, "transport_object", "grip_force_n"),
        (Violation.SPEED, "grasp_object", "tcp_speed_mps"),
        (Violation.SPEED, "navigate_to", "base_speed_mps"),
    ],
)
def test_each_detector_is_the_only_one_for_what_it_sees(violation: Violation, capability: str, signal: str) -> None:
    one = first_of(violation, capability)
    assert ran(one)["detected"]
    assert not blind(one, signal).seen


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


def test_a_lost_grip_and_a_false_claim_are_redundant_to_slip_and_a_lost_grip_stands_in_for_it() -> None:
    one = first_of(Violation.POSTCONDITION, "transport_object")
    by_slip = blind(one, "grip_lost", "postcondition")
    assert by_slip.row["rule"] == "slip"
    assert by_slip.late <= PROMPT_TICKS
    by_loss = blind(one, "slip_m")
    assert by_loss.row["rule"] == "grip-lost"
    assert by_slip.late < by_loss.late <= IN_TIME_TICKS
    assert not by_loss.row["unsafe"]


def test_a_slip_is_acted_under_where_neither_slip_nor_loss_is_looked_for_and_only_the_claim_tells() -> None:
    left = blind(first_of(Violation.POSTCONDITION, "transport_object"), "slip_m", "grip_lost")
    assert left.row["rule"] == "postcondition"
    assert not left.seen
    assert left.row["unsafe"]


def test_what_slips_out_slowly_is_told_too_late_by_a_lost_grip_alone() -> None:
    one = trials(Violation.POSTCONDITION)[0]
    assert not blind(one, "grip_lost", "postcondition").row["unsafe"]
    without_slip = blind(one, "slip_m")
    assert not without_slip.seen
    assert without_slip.row["unsafe"]


def test_the_detectors_of_other_types_do_not_stand_in() -> None:
    others = sorted(set().union(*SIGNALS.values()) - SIGNALS[Violation.ZONE])
    for one in trials(Violation.ZONE)[:2]:
        assert ran(one, change=lambda plan: without(plan, *others), limit=LIMIT_TICKS)["detected"]


def test_the_skills_own_checks_see_force_but_neither_places_nor_people_nor_retries() -> None:
    internal = METHODS["capability-internal"]
    assert ran(trials(Violation.FORCE)[0], internal, limit=LIMIT_TICKS)["detected"]
    for violation in (Violation.SPEED, Violation.ZONE, Violation.PEOPLE, Violation.RETRY):
        assert not ran(trials(violation)[0], internal, limit=LIMIT_TICKS)["detected"], violation
