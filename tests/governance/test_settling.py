from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.governance import bundle
from app.governance.guard import check
from app.governance.model import PolicyOutcome
from app.governance.policy_model import Setting
from app.governance.settling import parameters_behind
from tests.governance.policy_world import PROFILES, context, decided_by, files, modify, proposal, shipped

GENTLY = modify("gently", Setting(param="speed_mps", maximum=0.05), when="params.force_n < 30.0")
WEAKLY = modify("weakly", Setting(param="force_n", maximum=25.0), when='target.name == "mug_1"')


def reading(rules: str):
    """Return the shipped policy with further rules of the organization."""
    text = files()
    return bundle.load_files({**text, "organization.yaml": text["organization.yaml"] + rules})


def test_a_rule_that_begins_to_hold_by_another_rules_change_denies():
    policy = decided_by("grasp_object", GENTLY, WEAKLY)
    proposed = proposal("grasp_object", object_id="mug_1", force_n=40, speed_mps=0.2)
    verdict = check(policy, proposed, context("sim-relaxed"))
    assert verdict.outcome is PolicyOutcome.DENY
    assert (verdict.reasons[0].rule, verdict.reasons[0].code) == ("organization/gently", "unsettled")
    assert verdict.effective["force_n"] == 40.0


def test_what_settles_at_once_is_modified_as_ever():
    policy = decided_by("grasp_object", GENTLY, WEAKLY)
    proposed = proposal("grasp_object", object_id="mug_1", force_n=28, speed_mps=0.2)
    verdict = check(policy, proposed, context("sim-relaxed"))
    assert verdict.outcome is PolicyOutcome.MODIFY
    assert (verdict.effective["force_n"], verdict.effective["speed_mps"]) == (25.0, 0.05)


def test_a_limit_is_a_change_like_any_other():
    policy = decided_by("grasp_object", modify("gently", GENTLY.settings[0], when="params.force_n <= 60.0"))
    strong = proposal("grasp_object", object_id="mug_1", force_n=100, speed_mps=0.2)
    assert check(policy, strong, context("human-shared")).reasons[0].code == "unsettled"
    assert check(policy, strong, context("sim-relaxed")).outcome is PolicyOutcome.ALLOW


def test_a_rule_that_escalates_what_another_made_of_it_denies():
    policy = reading("""
  - {id: weakly, applies_to: [grasp_object], then: modify, set: {force_n: {max: 25}}, because: So.}
  - {id: too-weak, applies_to: [grasp_object], when: params.force_n < 26.0, then: escalate, because: It may slip.}
""")
    verdict = check(policy, proposal("grasp_object", object_id="mug_1", force_n=40), context("human-shared"))
    assert (verdict.outcome, verdict.reasons[0].code) == (PolicyOutcome.DENY, "unsettled")
    weak = check(policy, proposal("grasp_object", object_id="mug_1", force_n=20), context("human-shared"))
    assert weak.outcome is PolicyOutcome.ESCALATE


def test_an_escalation_may_hold_of_what_was_asked_for_only():
    policy = reading("""
  - {id: strong, applies_to: [grasp_object], when: params.force_n > 100.0, then: escalate, because: Why so much.}
""")
    verdict = check(policy, proposal("grasp_object", object_id="mug_1", force_n=120), context("human-shared"))
    assert (verdict.outcome, verdict.effective["force_n"]) == (PolicyOutcome.ESCALATE, 60.0)


def test_a_name_set_by_a_rule_is_where_the_proposal_leads_then():
    policy = reading("""
  - {id: detour, applies_to: [transport_object], when: place.name == "shelf_stand", then: modify,
     set: {target: {to: '"bench_b_stand"'}}, because: The shelf is full.}
  - {id: benches, applies_to: [transport_object], when: place.name == "bench_b_stand", then: deny, because: No.}
""")
    gamma = context("sim-relaxed", holding="mug_1")
    verdict = check(policy, proposal("transport_object", target="shelf_stand"), gamma)
    assert (verdict.outcome, verdict.reasons[0].code) == (PolicyOutcome.DENY, "unsettled")
    assert verdict.reasons[0].rule == "organization/benches"


@pytest.mark.parametrize(
    ("capability", "paths", "behind"),
    [
        ("grasp_object", {"params.force_n", "target.fragile", "agent.name"}, {"force_n", "object_id"}),
        ("grasp_object", {"params"}, {"object_id", "force_n", "speed_mps"}),
        ("navigate_to", {"place.corridor", "target.fragile"}, {"target", "x_m", "y_m"}),
        ("operate_tool", {"tool.press", "limits.payload_kg"}, {"tool"}),
        ("retrace", {"place.outside", "target.kind", "tool.press"}, set()),
    ],
)
def test_knows_which_parameters_stand_behind_what_is_read(capability, paths, behind):
    assert parameters_behind(paths, shipped().capabilities[capability]) == behind


def test_no_shipped_pair_is_checked_twice():
    assert {gate.check.__name__ for gate in shipped().gates.values()} == {"check"}


@given(st.sampled_from(PROFILES), st.floats(2, 140), st.floats(0.02, 2), st.sampled_from(["mug_1", "glass_1"]))
def test_whatever_reads_what_a_modify_rechecks_to_allow(profile, force_n, speed_mps, name):
    policy = CIRCLING
    proposed = proposal("grasp_object", object_id=name, force_n=force_n, speed_mps=speed_mps)
    verdict = check(policy, proposed, context(profile))
    if verdict.outcome is PolicyOutcome.MODIFY:
        again = check(policy, replace(proposed, params=verdict.effective), context(profile))
        assert (again.outcome, again.changes) == (PolicyOutcome.ALLOW, ())


CIRCLING = decided_by(
    "grasp_object",
    GENTLY,
    WEAKLY,
    modify("firmly", Setting(param="force_n", minimum=35.0), when="params.speed_mps > 0.4"),
    modify("slowly", Setting(param="speed_mps", maximum=0.3), when="params.force_n > 50.0"),
)
