from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.governance import bundle
from app.governance.admission import admit
from app.governance.model import AdmissionOutcome, CellFacts, Mode
from tests.governance.policy_world import PROFILES, context, files, proposal, shipped

GRASP = proposal("grasp_object", object_id="mug_1")


def only_grasping_supervised():
    organization = files()["organization.yaml"].replace(
        "permissions: [navigation, perception, manipulation, tool_operation]}",
        "permissions: [navigation], supervised: [manipulation]}",
    )
    return bundle.load_files({**files(), "organization.yaml": organization})


@pytest.mark.parametrize(
    ("capability", "profile", "code", "remedy"),
    [
        ("grasp_object", "moon", "unknown_profile", "one of: human-shared, real-restricted, sim-relaxed, test-audit"),
        ("fly", "sim-relaxed", "unknown_capability", "grasp_object"),
        ("grasp_object", "sim-relaxed", "not_in_profile", "propose another capability"),
    ],
)
def test_rejects_what_no_rules_were_compiled_for(capability, profile, code, remedy):
    text = files()
    name = "capabilities/grasp_object.yaml"
    text[name] = text[name].replace("sim-relaxed: allowed", "sim-relaxed: forbidden")
    policy = bundle.load_files(text)
    gamma = replace(context("test-audit"), profile=profile)
    found = admit(policy, replace(GRASP, capability=capability), gamma)
    assert (found.outcome, [reason.code for reason in found.reasons]) == (AdmissionOutcome.REJECT, [code])
    assert remedy in found.reasons[0].remedy


def test_an_unknown_capability_is_answered_without_the_recoveries():
    found = admit(shipped(), replace(GRASP, capability="fly"), context("sim-relaxed"))
    assert "safe_retreat" not in found.reasons[0].remedy


@pytest.mark.parametrize(
    ("proposed", "code", "said"),
    [
        (proposal("grasp_object", object_id="mug_9"), "unknown_object", "mug_1"),
        (proposal("navigate_to", target="mars"), "unknown_target", "dock"),
        (proposal("navigate_to", target="dock", corridor="alley"), "unknown_corridor", "aisle"),
        (proposal("inspect_area", area="moon"), "unknown_area", "shelf_front"),
        (proposal("operate_tool", tool="saw", action="press"), "unknown_tool", "lever"),
        (proposal("operate_tool", tool="lever", action="press"), "unknown_action", "pull_down, push_up"),
        (proposal("place_object", surface="floor"), "unknown_surface", "bench_a"),
    ],
)
def test_rejects_a_name_the_site_does_not_know_and_lists_those_it_does(proposed, code, said):
    found = admit(shipped(), proposed, context("sim-relaxed"))
    assert (found.outcome, [reason.code for reason in found.reasons]) == (AdmissionOutcome.REJECT, [code])
    assert said in found.reasons[0].remedy


def test_rejects_a_mode_the_profile_does_not_admit():
    name = "profiles/test-audit.yaml"
    text = files()[name].replace("modes: [normal, careful]", "modes: [careful]")
    policy = bundle.load_files({**files(), name: text})
    found = admit(policy, GRASP, context("test-audit"))
    assert (found.reasons[0].code, found.reasons[0].remedy) == ("mode_not_admitted", "one of: careful")
    assert admit(policy, replace(GRASP, mode=Mode.CAREFUL), context("test-audit")).outcome is AdmissionOutcome.ACCEPT


def test_all_reasons_of_the_strongest_outcome_are_reported():
    gamma = context("sim-relaxed", latched=True, agent="stranger", busy="inv_1")
    found = admit(shipped(), replace(GRASP, metadata={"priority": "now"}, preconditions=("full_moon",)), gamma)
    assert found.outcome is AdmissionOutcome.REJECT
    assert [reason.code for reason in found.reasons] == [
        "permission_missing", "invalid_metadata", "unknown_precondition", "estop_latched",
    ]  # fmt: skip


def test_where_no_cell_has_ever_attached_a_proposal_defers_and_is_told_so():
    found = admit(shipped(), GRASP, replace(context("sim-relaxed"), cell=CellFacts(id="", online=False)))
    assert (found.outcome, found.reasons[0].code) == (AdmissionOutcome.DEFER, "cell_offline")
    assert found.reasons[0].message == "no cell has attached yet"
    assert found.reasons[0].remedy == "propose again once a cell is connected"


def test_a_cell_that_holds_because_its_link_lapsed_defers():
    gamma = context("sim-relaxed")
    found = admit(shipped(), GRASP, replace(gamma, cell=replace(gamma.cell, holding_link=True)))
    assert (found.outcome, found.reasons[0].code) == (AdmissionOutcome.DEFER, "cell_offline")
    assert "link" in found.reasons[0].message


def test_a_cell_that_cannot_write_its_journal_defers():
    gamma = context("sim-relaxed")
    found = admit(shipped(), GRASP, replace(gamma, cell=replace(gamma.cell, recording=False)))
    assert (found.outcome, found.reasons[0].code) == (AdmissionOutcome.DEFER, "journal_unavailable")
    assert "cannot write its journal" in found.reasons[0].message


def test_preconditions_of_the_proposal_count_beside_those_of_the_capability():
    drive = proposal("navigate_to", target="dock", preconditions=["arm_ready", "gripper_empty"])
    assert admit(shipped(), drive, context("sim-relaxed")).outcome is AdmissionOutcome.ACCEPT
    found = admit(shipped(), drive, context("sim-relaxed", arm_ready=False, holding="mug_1"))
    assert found.outcome is AdmissionOutcome.DEFER
    assert sorted(reason.rule for reason in found.reasons) == ["admission/arm_ready", "admission/gripper_empty"]
    assert (
        admit(shipped(), replace(drive, preconditions=()), context("sim-relaxed", arm_ready=False)).outcome == "accept"
    )


def test_supervision_covers_what_is_supervised_and_nothing_else():
    policy = only_grasping_supervised()
    gamma = replace(context("real-restricted"), agent=policy.agent("planner"))
    grasp, press = (
        admit(policy, GRASP, gamma),
        admit(policy, proposal("operate_tool", tool="press", action="press"), gamma),
    )
    assert (grasp.outcome, grasp.reasons[0].code) == (AdmissionOutcome.ESCALATE, "permission_supervised")
    assert (press.outcome, press.reasons[0].code) == (AdmissionOutcome.REJECT, "permission_missing")


@pytest.mark.parametrize(
    ("differs", "outcome"),
    [
        ({}, "escalate"),
        ({"busy": "inv_1"}, "defer"),
        ({"arm_ready": False}, "defer"),
        ({"busy": "inv_1", "latched": True}, "reject"),
    ],
)
def test_reject_outranks_defer_and_defer_outranks_escalate(differs, outcome):
    policy = only_grasping_supervised()
    gamma = replace(context("real-restricted", **differs), agent=policy.agent("planner"))
    assert admit(policy, GRASP, gamma).outcome == outcome


OBSTACLES = {
    "reject": [{"latched": True}, {"agent": "stranger"}],
    "defer": [
        {"online": False}, {"busy": "inv_1"}, {"arm_ready": False}, {"sensors_fresh": False}, {"unseen": ["mug_1"]},
        {"unreachable": ["mug_1"]}, {"holding": "glass_1"},
    ],
}  # fmt: skip


@given(st.sampled_from(PROFILES), st.sets(st.sampled_from(range(2))), st.sets(st.sampled_from(range(7))))
def test_the_strongest_obstacle_decides_whatever_else_is_in_the_way(profile, rejecting, deferring):
    differs: dict[str, object] = {}
    for index in deferring:
        differs |= OBSTACLES["defer"][index]
    for index in rejecting:
        differs |= OBSTACLES["reject"][index]
    expected = "reject" if rejecting else "defer" if deferring else "accept"
    found = admit(shipped(), GRASP, context(profile, **differs))
    assert found.outcome == expected
    assert bool(found.reasons) == (expected != "accept")
    assert (found.retry_after_s is not None) == (expected == "defer")
