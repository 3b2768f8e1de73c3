"""What is drawn for protocol `physical`, without running any of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import cache
from itertools import combinations
from math import hypot

import numpy as np
import pytest

from app.evaluation.draws import CLEAR_OF_ARM_M, STIFF, WHERE, Drawn, draw, of_type
from app.evaluation.methods import ABLATIONS, REINS, Passed, pass_gate
from app.evaluation.model import CAPABILITIES, PROFILES, TUNING_SEEDS, Breach, Failure, Kind, Violation
from app.evaluation.permits import context_of
from app.evaluation.stage import APART_M, Stage, Start, places
from app.governance.guard import check
from app.governance.model import AgentFacts, Context, PolicyOutcome, Proposal
from app.sim.faults import Scenario
from app.sim.localisation import to_base
from app.sim.world import CRATE_HALF_M
from tests.governance.policy_world import shipped

COUNT = 800
SEED = TUNING_SEEDS[2]


@cache
def many() -> tuple[Drawn, ...]:
    return tuple(draw(shipped(), SEED, number) for number in range(COUNT))


def context(start: Start, profile: str) -> Context:
    """Γ of a start; where the objects lie exactly makes no difference to what is authorized."""
    return _contexts(start)[profile]


@cache
def _contexts(start: Start) -> dict[str, Context]:
    cell = _stage().set(start, 1, Scenario())
    return {profile: context_of(cell, shipped(), profile) for profile in PROFILES}


@cache
def _stage() -> Stage:
    return Stage(shipped().site)


def proposed(drawn: Drawn) -> Proposal:
    params = shipped().validate_params(drawn.capability, drawn.params)
    assert not isinstance(params, tuple), params
    return Proposal(capability=drawn.capability, params=params)


def passed(drawn: Drawn, method: str = REINS.name) -> Passed:
    around = context(drawn.start, drawn.profile)
    if drawn.breach is Breach.PERMISSION:
        around = replace(around, agent=AgentFacts(name="visitor", permissions=frozenset()))
    one = {REINS.name: REINS, **ABLATIONS}[method]
    return pass_gate(one, shipped(), proposed(drawn), around, approved=drawn.breach is not Breach.APPROVAL)


def test_a_trial_is_a_function_of_its_seed_and_number() -> None:
    again = tuple(draw(shipped(), SEED, number) for number in reversed(range(COUNT)))[::-1]
    assert again == many()
    assert len({repr(drawn) for drawn in many()}) == COUNT
    assert draw(shipped(), TUNING_SEEDS[0], 3) != draw(shipped(), TUNING_SEEDS[1], 3)
    assert len({drawn.world for drawn in many()}) == COUNT


def test_half_is_unauthorized_and_the_rest_is_clean_perturbed_or_failing() -> None:
    kinds = Counter(drawn.kind for drawn in many())
    expected = {Kind.UNAUTHORIZED: 0.5, Kind.PERTURBED: 0.25, Kind.RECOVERABLE: 0.125, Kind.CLEAN: 0.125}
    for kind, share in expected.items():
        sigma = (share * (1 - share) / COUNT) ** 0.5
        assert abs(kinds[kind] / COUNT - share) < 4 * sigma, kind


@pytest.mark.parametrize("named", ["violation", "failure", "breach", "profile", "capability"])
def test_every_value_comes_up(named: str) -> None:
    whole: dict[str, set[object]] = {
        "violation": set(Violation),
        "failure": set(Failure),
        "breach": set(Breach) - {Breach.MODE},
        "profile": set(PROFILES),
        "capability": set(CAPABILITIES),
    }
    assert {getattr(drawn, named) for drawn in many()} - {None} == whole[named]


def test_types_of_violation_are_drawn_alike() -> None:
    count = Counter(drawn.violation for drawn in many() if drawn.violation is not None)
    whole = count.total()
    assert all(abs(found - whole / 6) < 4 * (whole * 5 / 36) ** 0.5 for found in count.values())


def test_each_trial_is_of_one_kind_and_says_of_which() -> None:
    for drawn in many():
        said = (drawn.breach is not None, drawn.violation is not None, drawn.failure is not None)
        order = {Kind.UNAUTHORIZED: 0, Kind.PERTURBED: 1, Kind.RECOVERABLE: 2}
        assert said == tuple(order.get(drawn.kind) == place for place in range(3))
        spoiled = bool(drawn.scenario.faults or drawn.scenario.people)
        assert spoiled == (drawn.kind is Kind.PERTURBED or drawn.failure not in (None, Failure.WITHDRAWN))
        if fault := drawn.violation or drawn.failure:
            assert drawn.capability in WHERE[fault]


def test_what_is_not_authorized_is_refused_and_what_is_is_not() -> None:
    for drawn in many():
        found = passed(drawn)
        assert found.launched == (drawn.kind is not Kind.UNAUTHORIZED), (drawn, found)


def test_an_authorized_request_is_allowed_as_it_stands_but_for_what_policy_adds() -> None:
    for drawn in many():
        if drawn.kind is Kind.UNAUTHORIZED:
            continue
        proposal = proposed(drawn)
        verdict = check(shipped(), proposal, context(drawn.start, drawn.profile))
        assert verdict.outcome is not PolicyOutcome.DENY
        lowered = {"speed_mps", "force_n"} & {change.param for change in verdict.changes}
        assert not lowered, (drawn, verdict.changes)


@pytest.mark.parametrize(
    ("ablation", "breaches"),
    [
        ("-admission", {Breach.PERMISSION}),
        ("-policy", {Breach.ZONE, Breach.OBJECT}),
        ("-human", {Breach.APPROVAL}),
        ("-watcher", set()),
        ("-recovery", set()),
    ],
)
def test_each_part_of_the_gate_is_the_only_one_to_stop_something(ablation: str, breaches: set[Breach]) -> None:
    through = {drawn.breach for drawn in many() if drawn.breach is not None and passed(drawn, ablation).launched}
    assert through == breaches


def test_drawn_again_is_of_the_same_type_in_other_circumstances() -> None:
    for drawn in many():
        again = draw(shipped(), SEED, drawn.number, turn=1)
        assert (again.kind, again.violation, again.failure) == (drawn.kind, drawn.violation, drawn.failure)
        assert again.scenario != drawn.scenario or drawn.scenario == Scenario()
        assert again.world == drawn.world


@pytest.mark.parametrize("wanted", [*Violation, *Failure])
def test_a_type_can_be_asked_for(wanted: Violation | Failure) -> None:
    for number in range(30):
        drawn = of_type(shipped(), SEED, number, wanted)
        assert wanted in (drawn.violation, drawn.failure)
        assert drawn == of_type(shipped(), SEED, number, wanted)


@pytest.mark.parametrize("kind", list(Kind))
def test_a_kind_can_be_asked_for(kind: Kind) -> None:
    assert {draw(shipped(), SEED, number, kind=kind).kind for number in range(30)} == {kind}


def test_sizes_stand_on_both_sides_of_twelve_sigma() -> None:
    drawn_forces = [of_type(shipped(), SEED, number, Violation.FORCE) for number in range(300)]
    forces = [drawn for drawn in drawn_forces if drawn.scenario.faults[0].kind == "grip_gain"]
    limits = [
        drawn.params.get("force_n", shipped().profiles[drawn.profile].limits["grip_force_n"].maximum)
        for drawn in forces
    ]
    beyond = [drawn.size / float(limit) - 1.05 for drawn, limit in zip(forces, limits, strict=True)]  # type: ignore[arg-type]
    assert min(beyond) > -1e-9
    assert max(beyond) < 0.81
    assert 0.3 < sum(excess > 0.3 for excess in beyond) / len(beyond) < 0.6


def test_forces_are_about_as_often_the_arms_as_the_grippers_and_what_is_met_hangs_clear_of_the_arm() -> None:
    drawn = [of_type(shipped(), SEED, number, Violation.FORCE) for number in range(300)]
    stiff = [one for one in drawn if one.scenario.faults[0].kind == "blocked"]
    assert 0.35 < len(stiff) / len(drawn) < 0.6
    assert {one.capability for one in stiff} == set(STIFF)
    for one in stiff:
        stand, sizes = shipped().site.targets[one.start.stand], one.scenario.faults[0].sizes
        x, y = sizes["x_m"], sizes["y_m"]
        assert isinstance(x, float)
        assert isinstance(y, float)
        ahead, _ = to_base((stand.x_m, stand.y_m, stand.yaw_rad), x, y)
        assert ahead - CRATE_HALF_M[0] >= CLEAR_OF_ARM_M - 1e-9


def test_no_two_objects_stand_too_close_for_the_fingers() -> None:
    for seed in range(200):
        stood = places(np.random.default_rng((seed, 7)), shipped().site.objects)
        assert all(hypot(a[0] - b[0], a[1] - b[1]) >= APART_M for a, b in combinations(stood, 2))
