"""The paper's generator: shares, determinism, and that policy agrees about what is authorized."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest
from scipy import stats

from app.evaluation.extensions import REGISTRY, UnknownName
from app.evaluation.model import CAPABILITIES, PAPER_FAILURES, PROFILES, TASKS, Breach, Kind, Task, Violation
from app.evaluation.paper_generator import ALL, OVERRIDE_FIRST, RECOVERY_FIRST, SHARED, Trial, breaches, draw
from app.evaluation.paper_scenes import SCALED, scenes
from app.governance import bundle
from app.governance.decision import decide
from app.governance.guard import check
from app.governance.model import PolicyOutcome, Status
from app.governance.places import inside
from tests.governance.policy_world import files, shipped

SEED, MANY = 7, 3000  # a tuning seed: what is reported is run on others
SURE = 1e-6  # how unlikely chance would have to be before a share counts as wrong


def trials(task: str = ALL, first: int = 0, count: int = MANY) -> list[Trial]:
    return [draw(shipped(), SEED, task, first + place) for place in range(count)]


def uniform(counted: Counter[object]) -> bool:
    return bool(stats.chisquare(list(counted.values())).pvalue > SURE)


def test_half_of_the_trials_are_unauthorized() -> None:
    unauthorized = sum(trial.kind is Kind.UNAUTHORIZED for trial in trials())
    assert stats.binomtest(unauthorized, MANY, 0.5).pvalue > SURE


def test_capabilities_profiles_violations_and_failures_are_uniform() -> None:
    for counted, things in (
        (Counter[object](trial.capability for trial in trials()), CAPABILITIES),
        (Counter[object](trial.profile for trial in trials()), PROFILES),
        (Counter[object](trial.violation for trial in trials() if trial.violation), Violation),
        (Counter[object](trial.failure for trial in trials(first=RECOVERY_FIRST)), PAPER_FAILURES),
    ):
        assert set(counted) == set(things)
        assert uniform(counted)


def test_a_trial_follows_from_its_name_alone() -> None:
    again = draw.__wrapped__(shipped(), SEED, "sorting", 12)
    draw.__wrapped__(shipped(), SEED + 1, ALL, 3)
    assert draw.__wrapped__(shipped(), SEED, "sorting", 12) == again
    assert again != draw(shipped(), SEED + 1, "sorting", 12)
    assert again != draw(shipped(), SEED, "fetch_and_deliver", 12)
    assert again != draw(shipped(), SEED, "sorting", 13)


def status(trial: Trial) -> object:
    return decide(shipped(), trial.proposal, trial.context).status


def test_policy_refuses_every_attempt_for_the_reason_it_was_made_for() -> None:
    codes = {
        Breach.PERMISSION: "permission_missing",
        Breach.ZONE: "forbidden_zone",
        Breach.OBJECT: "hazardous",
    }
    met: set[Breach] = set()
    for trial in trials():
        if trial.breach is None:
            continue
        met.add(trial.breach)
        decision = decide(shipped(), trial.proposal, trial.context)
        if trial.breach is Breach.APPROVAL:
            assert (decision.status, trial.approved) == (Status.AWAITING_APPROVAL, False)
            continue
        reasons = [*decision.admission.reasons, *(decision.verdict.reasons if decision.verdict else ())]
        assert decision.status in (Status.REJECTED, Status.DENIED)
        assert codes[trial.breach] in [reason.code for reason in reasons]
    assert met == {*codes, Breach.APPROVAL}


@pytest.mark.parametrize("first", [0, RECOVERY_FIRST])
def test_policy_allows_every_other_request_as_it_stands(first: int) -> None:
    for trial in trials(first=first):
        if trial.kind is Kind.UNAUTHORIZED:
            continue
        assert status(trial) in ("allowed", Status.AWAITING_APPROVAL)
        assert trial.approved
        verdict = check(shipped(), trial.proposal, trial.context)
        assert verdict.outcome in (PolicyOutcome.ALLOW, PolicyOutcome.ESCALATE)
        assert not verdict.changes


def test_speeds_and_forces_lie_between_four_and_eight_tenths_of_what_policy_allows() -> None:
    for trial in trials(count=500):
        if trial.kind is Kind.UNAUTHORIZED:
            continue
        for name in SCALED:
            if name in trial.proposal.params:
                more = replace(trial.proposal, params={**trial.proposal.params, name: 1e6})
                most = check(shipped(), more, trial.context).effective[name]
                assert 0.4 <= trial.proposal.params[name] / most <= 0.8  # type: ignore[operator]


def test_a_zone_is_entered_at_a_point_inside_it() -> None:
    press = shipped().site.zones["press_area"].polygon
    for trial in trials():
        if trial.breach is Breach.ZONE:
            params, facts = trial.proposal.params, trial.context.cell.facts
            assert facts is not None
            thing = facts.objects.get(str(params.get("object_id")))
            assert inside((params["x_m"], params["y_m"]) if thing is None else (thing.x_m, thing.y_m), press)  # type: ignore[arg-type]


def test_a_capability_attempts_only_what_it_can() -> None:
    assert breaches(shipped(), "inspect_area", SHARED) == (Breach.PERMISSION,)
    assert breaches(shipped(), "navigate_to", SHARED) == (Breach.PERMISSION, Breach.ZONE)
    assert set(breaches(shipped(), "grasp_object", SHARED)) == {*Breach} - {Breach.MODE}
    assert Breach.APPROVAL not in breaches(shipped(), "grasp_object", "sim-relaxed")


def test_what_no_profile_lifts_is_asked_for_by_nobody() -> None:
    assert "box_1" in {scene.object for scene in scenes(shipped(), "grasp_object", "real-restricted").open}
    heavy = scenes(shipped(), "grasp_object", SHARED)
    assert "box_1" not in {scene.object for scene in (*heavy.open, *heavy.restricted)}
    assert {scene.object for scene in heavy.restricted} == {"solvent_1"}


@pytest.mark.parametrize("task", TASKS)
def test_a_task_keeps_to_its_capabilities_and_its_object(task: str) -> None:
    for trial in trials(task, count=300):
        assert trial.capability in TASKS[task].capabilities
        if task == "fragile_handling" and trial.kind is not Kind.UNAUTHORIZED:
            facts = trial.context.cell.facts
            assert facts is not None
            assert "glass_1" in (trial.proposal.params.get("object_id"), facts.holding)


def test_a_mode_that_a_profile_does_not_admit_is_attempted_there_and_refused() -> None:
    normal = files()
    shared = f"profiles/{SHARED}.yaml"
    normal[shared] = normal[shared].replace("modes: [normal, careful]", "modes: [normal]").replace("safer_mode, ", "")
    policy = bundle.load_files(normal)
    drawn = [draw(policy, SEED, ALL, number) for number in range(600)]
    attempts = [trial for trial in drawn if trial.breach is Breach.MODE]
    assert {trial.profile for trial in attempts} == {SHARED}
    for trial in attempts:
        reasons = decide(policy, trial.proposal, trial.context).admission.reasons
        assert [reason.code for reason in reasons] == ["mode_not_admitted"]


def test_a_policy_that_leaves_nothing_to_ask_for_is_named() -> None:
    heavy = files()
    heavy["site.yaml"] = heavy["site.yaml"].replace("mass_kg: 0.25", "mass_kg: 9.0")
    policy = bundle.load_files(heavy)
    with pytest.raises(ValueError, match=r"nothing to ask of `\w+` in \S+ for task `fragile_handling`"):
        [draw(policy, SEED, "fragile_handling", number) for number in range(50)]


def test_a_task_from_outside_fixes_names_and_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    fixed = {"target": "shelf_stand", "clearance_m": 0.45}
    task = Task("shelf_run", "navigation", ("navigate_to",), {"navigate_to": fixed})
    monkeypatch.setitem(REGISTRY.tasks, task.name, task)
    for trial in trials(task.name, count=200):
        params = trial.proposal.params
        assert params["clearance_m"] == 0.45
        assert params.get("target") == (None if trial.breach is Breach.ZONE else "shelf_stand")
        assert 0.4 <= params["speed_mps"] / shipped().profiles[trial.profile].limits["base_speed_mps"].maximum <= 0.8  # type: ignore[operator]


def test_override_trials_need_an_approval_and_have_it_half_of_the_time() -> None:
    drawn = trials(first=OVERRIDE_FIRST, count=1000)
    assert {trial.profile for trial in drawn} == {SHARED}
    assert {trial.capability for trial in drawn} == {"grasp_object", "transport_object", "operate_tool"}
    assert all(status(trial) is Status.AWAITING_APPROVAL for trial in drawn)
    assert all((trial.kind is Kind.UNAUTHORIZED) is not trial.approved for trial in drawn)
    assert stats.binomtest(sum(trial.approved for trial in drawn), 1000, 0.5).pvalue > SURE


def test_names_the_tasks_there_are() -> None:
    with pytest.raises(UnknownName, match="no task `juggling`: valid are waypoint_reaching"):
        draw(shipped(), SEED, "juggling", 0)
