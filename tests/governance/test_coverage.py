from __future__ import annotations

import pytest

from app.governance import bundle
from app.governance.coverage import covered_recoveries
from app.governance.model import CoveredRecovery, Mode, Strategy
from tests.governance.policy_world import PROFILES, context, files, proposal, shipped

BUSY = {"busy": "inv_1"}  # at a launch, it is the invocation itself that has the cell


def covered(proposed, profile="real-restricted", policy=None, **differs):
    found = covered_recoveries(policy or shipped(), proposed, context(profile, **{**BUSY, **differs}))
    return {(recovery.strategy, recovery.capability, recovery.mode): recovery for recovery in found}


def with_files(**changes):
    return bundle.load_files({**files(), **changes})


@pytest.mark.parametrize("profile", PROFILES)
def test_covers_what_the_table_asks_for_each_as_constrained_as_policy_has_it(profile):
    found = covered(proposal("grasp_object", object_id="mug_1", force_n=140, speed_mps=2), profile)
    again, careful = (
        (Strategy.RETRY, "grasp_object", Mode.NORMAL),
        (Strategy.SAFER_MODE, "grasp_object", Mode.CAREFUL),
    )
    limit = shipped().profiles[profile].limits["grip_force_n"].maximum
    assert found[again].params["force_n"] == found[careful].params["force_n"] == limit
    assert isinstance(found[again], CoveredRecovery)
    assert (Strategy.ROLLBACK, "release_and_retract", Mode.NORMAL) in found
    assert (Strategy.RECOVERY_CAPABILITY, "reposition_base", Mode.NORMAL) in found


def test_what_has_no_rollback_is_covered_without_one():
    found = covered(proposal("inspect_area", area="bench_a_top"))
    assert (Strategy.RETRY, "inspect_area", Mode.NORMAL) in found
    assert Strategy.ROLLBACK not in {strategy for strategy, *_ in found}


def test_what_policy_denies_is_not_tried_again_and_the_way_out_stays():
    strategies = {strategy for strategy, *_ in covered(proposal("grasp_object", object_id="solvent_1"))}
    assert strategies == {Strategy.RECOVERY_CAPABILITY, Strategy.ROLLBACK}


def test_what_a_human_approved_may_be_tried_again_but_no_other_recovery_that_asks():
    text = files()["organization.yaml"]
    rule = "\n  - {id: ask, applies_to: [safe_retreat], then: escalate, because: Somebody has to look.}\n"
    policy = with_files(**{"organization.yaml": text + rule})
    box = proposal("grasp_object", object_id="box_1")  # 3.5 kg escalate here
    asked = {capability for _, capability, _ in covered(box, policy=policy)}
    assert asked == {"grasp_object", "release_and_retract", "reposition_base", "retrace"}
    assert "safe_retreat" in {capability for _, capability, _ in covered(box)}


def test_a_cell_that_may_not_move_covers_nothing():
    grasp = proposal("grasp_object", object_id="mug_1")
    assert covered(grasp, latched=True) == covered(grasp, online=False) == {}


def test_what_waits_for_a_precondition_is_not_covered():
    strategies = {strategy for strategy, *_ in covered(proposal("grasp_object", object_id="mug_1"), arm_ready=False)}
    assert strategies == {Strategy.RECOVERY_CAPABILITY, Strategy.ROLLBACK}


def test_a_profile_without_careful_covers_no_safer_mode():
    name = "profiles/real-restricted.yaml"
    text = files()[name].replace("modes: [normal, careful]", "modes: [normal]").replace("safer_mode, ", "")
    policy = with_files(**{name: text})
    assert Mode.CAREFUL not in {
        mode for *_, mode in covered(proposal("grasp_object", object_id="mug_1"), policy=policy)
    }


def test_a_recovery_that_cannot_run_on_its_defaults_is_not_covered():
    name = "capabilities/safe_retreat.yaml"
    policy = with_files(**{name: files()[name].replace("  properties:", "  required: [speed_mps]\n  properties:")})
    needy = with_files(**{
        name: files()[name].replace("  properties:", "  required: [way]\n  properties:\n    way: {type: boolean}")
    })  # fmt: skip
    grasp = proposal("grasp_object", object_id="mug_1")
    assert "safe_retreat" not in {capability for _, capability, _ in covered(grasp, policy=needy)}
    assert "release_and_retract" in {capability for _, capability, _ in covered(grasp, policy=needy)}
    assert "safe_retreat" not in {capability for _, capability, _ in covered(grasp, policy=policy)}


@pytest.mark.parametrize(
    ("proposed", "holding", "told"),
    [
        (proposal("grasp_object", object_id="mug_1"), "glass_1", "mug_1"),
        (proposal("transport_object", target="dock"), "glass_1", "glass_1"),
        (proposal("transport_object", target="dock"), None, None),
    ],
)
def test_a_recovery_is_told_the_object_in_hand_and_not_covered_where_there_is_none(proposed, holding, told):
    name = "capabilities/safe_retreat.yaml"
    needs = "  required: [object_id]\n  properties:\n    object_id: {type: string, x-ref: object}\n"
    policy = with_files(**{name: files()[name].replace("  properties:\n", needs)})
    found = covered(proposed, policy=policy, holding=holding)
    params = {recovery.params["object_id"] for _, recovery in found.items() if recovery.capability == "safe_retreat"}
    assert params == (set() if told is None else {told})


def test_a_recovery_is_told_the_object_that_is_held_and_grips_it_no_harder_than_policy_has_it():
    held = covered(proposal("place_object", surface="bench_a"), "human-shared", holding="glass_1")
    again = held[Strategy.RECOVERY_CAPABILITY, "regrasp", Mode.NORMAL]
    assert (again.params["object_id"], again.params["force_n"]) == ("glass_1", 20.0)
    assert "regrasp" not in {name for _, name, _ in covered(proposal("place_object", surface="bench_a"))}


def test_a_recovery_may_no_more_than_the_agent_it_is_made_for():
    kept = covered(proposal("place_object", surface="shelf"), holding="solvent_1")
    assert "regrasp" not in {name for _, name, _ in kept}


def test_a_rollback_that_may_end_elsewhere_comes_with_the_way_back_where_the_plant_has_one():
    grasp = proposal("grasp_object", object_id="mug_1")
    backs = [name for strategy, name, _ in covered(grasp) if strategy is Strategy.ROLLBACK]
    assert backs == ["release_and_retract", "retrace"]
    plants = {
        name: text.replace("rollback: retrace", "rollback: safe_retreat").replace(", retrace", "")
        for name, text in files().items()
        if not name.endswith("/retrace.yaml")
    }
    without = covered(grasp, policy=bundle.load_files(plants))
    assert [name for strategy, name, _ in without if strategy is Strategy.ROLLBACK] == ["release_and_retract"]
