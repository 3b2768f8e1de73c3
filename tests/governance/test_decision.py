from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.governance import bundle
from app.governance.admission import admit
from app.governance.decision import decide
from app.governance.guard import check, constrain
from app.governance.model import AdmissionOutcome, PolicyOutcome, Status, Verdict
from app.governance.policy_code import Generator
from app.governance.policy_model import Setting
from app.governance.vocabulary import Vocabulary
from tests.governance.policy_world import PROFILES, context, decided_by, files, modify, proposal, shipped

grasps = st.builds(
    lambda name, force, speed: proposal("grasp_object", object_id=name, force_n=force, speed_mps=speed),
    st.sampled_from(["mug_1", "glass_1", "driver_1", "box_1", "solvent_1"]),
    st.floats(2, 140),
    st.floats(0.02, 2),
)
drives = st.builds(
    lambda name, speed, clearance: proposal("navigate_to", target=name, speed_mps=speed, clearance_m=clearance),
    st.sampled_from(["dock", "bench_a_stand", "bench_b_stand", "shelf_stand", "tool_stand"]),
    st.floats(0.05, 2),
    st.floats(0.1, 1),
)
SEVERITY = {PolicyOutcome.ALLOW: 0, PolicyOutcome.MODIFY: 0, PolicyOutcome.ESCALATE: 1, PolicyOutcome.DENY: 2}


@given(grasps | drives, st.sampled_from(PROFILES))
def test_a_constrained_proposal_rechecks_to_allow(proposed, profile):
    gamma = context(profile)
    if check(shipped(), proposed, gamma).outcome is PolicyOutcome.MODIFY:
        assert check(shipped(), constrain(shipped(), proposed, gamma), gamma).outcome is PolicyOutcome.ALLOW


@pytest.mark.parametrize(
    ("name", "force_n", "outcome", "constrained_n"),
    [
        ("mug_1", 60, "allow", 60),
        ("mug_1", 61, "modify", 60),
        ("glass_1", 61, "modify", 20),
        ("solvent_1", 61, "deny", 61),
    ],
)
def test_constrains_what_it_modifies_and_nothing_else(name, force_n, outcome, constrained_n):
    proposed = proposal("grasp_object", object_id=name, force_n=force_n, speed_mps=0.1)
    assert check(shipped(), proposed, context("human-shared")).outcome == outcome
    constrained = constrain(shipped(), proposed, context("human-shared"))
    assert constrained == replace(proposed, params={**proposed.params, "force_n": constrained_n})


@given(grasps | drives)
def test_a_stricter_profile_never_permits_more(proposed):
    verdicts = [check(shipped(), proposed, context(profile)) for profile in PROFILES]
    for wider, stricter in pairwise(verdicts):
        assert SEVERITY[stricter.outcome] >= SEVERITY[wider.outcome]
        if stricter.outcome is not PolicyOutcome.DENY:
            assert stricter.effective["speed_mps"] <= wider.effective["speed_mps"]


def test_adding_a_deny_rule_never_permits_more():
    text = files()
    rule = '\n  - {id: no-mugs, when: target.kind == "mug", then: deny, because: No mugs today.}\n'
    narrowed = bundle.load_files({**text, "organization.yaml": text["organization.yaml"] + rule})
    for name in shipped().site.objects:
        proposed = proposal("grasp_object", object_id=name)
        before, after = (check(p, proposed, context("sim-relaxed")).outcome for p in (shipped(), narrowed))
        assert SEVERITY[after] >= SEVERITY[before]
    assert check(narrowed, proposal("grasp_object", object_id="mug_1"), context("sim-relaxed")).outcome == "deny"


def test_no_policy_rejects_and_denies():
    proposed = proposal("navigate_to", target="dock")
    decision = decide(None, proposed, context("sim-relaxed"))
    assert (decision.status, decision.admission.reasons[0].code) == (Status.REJECTED, "no_policy")
    assert check(None, proposed, context("sim-relaxed")).reasons[0].code == "no_policy"


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_are_refused_by_schema_and_guard(bad):
    found = shipped().validate_params("grasp_object", {"object_id": "mug_1", "force_n": bad})
    assert [problem.code for problem in found] == ["not_finite"]
    proposed = proposal("grasp_object", object_id="mug_1")
    forced = replace(proposed, params={**proposed.params, "force_n": bad})
    verdict = check(shipped(), forced, context("sim-relaxed"))
    assert (verdict.outcome, verdict.reasons[0].code) == (PolicyOutcome.DENY, "rule_error")


def test_denies_when_a_rule_raises_and_names_it():
    text = files()
    rule = "\n  - {id: by-priority, when: metadata.priority > 3, then: escalate, because: Important.}\n"
    policy = bundle.load_files({**text, "organization.yaml": text["organization.yaml"] + rule})
    verdict = check(policy, proposal("navigate_to", target="dock"), context("sim-relaxed"))
    assert verdict.outcome is PolicyOutcome.DENY
    assert (verdict.reasons[0].rule, verdict.reasons[0].code) == ("organization/by-priority", "rule_error")


def test_an_empty_intersection_denies():
    text = files()
    rule = "\n  - {id: firm, then: modify, set: {force_n: {min: 130}}, because: Firmly.}\n"
    policy = bundle.load_files({**text, "organization.yaml": text["organization.yaml"] + rule})
    verdict = check(policy, proposal("grasp_object", object_id="mug_1"), context("human-shared"))
    assert (verdict.outcome, verdict.reasons[0].code) == (PolicyOutcome.DENY, "empty_intersection")


@pytest.mark.parametrize(
    ("capability", "setting", "said"),
    [
        (
            "navigate_to",
            Setting(param="clearance_m", minimum=1.5),
            "at least 1.5 (organization/odd) and at most 1 (the input schema)",
        ),
        (
            "grasp_object",
            Setting(param="force_n", maximum=1.0),
            "at least 2 (the input schema) and at most 1 (organization/odd)",
        ),
    ],
)
def test_no_rule_leads_out_of_the_input_schema(capability, setting, said):
    policy = decided_by(capability, modify("odd", setting))
    for profile in PROFILES:
        name = {"object_id": "mug_1"} if capability == "grasp_object" else {"target": "dock"}
        verdict = check(policy, proposal(capability, **name), context(profile))
        found = {reason.rule: reason.message for reason in verdict.reasons if reason.code == "empty_intersection"}
        assert verdict.outcome is PolicyOutcome.DENY
        assert said in found["organization/odd"]


def test_a_limit_beyond_the_input_schema_does_not_widen_it():
    firm = modify("firm", Setting(param="force_n", minimum=150.0))
    relaxed = shipped().profiles["sim-relaxed"]
    limits = {**relaxed.limits, "grip_force_n": replace(relaxed.limits["grip_force_n"], maximum=500.0)}
    gate = shipped().gates["grasp_object", "sim-relaxed"]
    generator = Generator(
        gate.capability, replace(relaxed, limits=limits), gate.site, Vocabulary(shipped().capabilities)
    )
    wide = replace(gate, check=generator.compile([firm]).check)
    policy = replace(shipped(), gates={("grasp_object", "sim-relaxed"): wide})
    verdict = check(policy, proposal("grasp_object", object_id="mug_1"), context("sim-relaxed"))
    assert (verdict.outcome, verdict.reasons[0].rule) == (PolicyOutcome.DENY, "organization/firm")


@cache
def between(low, high):
    bounds = Setting(param="force_n", minimum=float(low)), Setting(param="force_n", maximum=float(high))
    return decided_by("grasp_object", *(modify(f"bound-{n}", bound) for n, bound in enumerate(bounds)))


@settings(deadline=None)  # the first example with a pair of bounds compiles its policy
@given(grasps, st.sampled_from(PROFILES), st.sampled_from([0, 20, 61, 141]), st.sampled_from([1, 20, 60, 140]))
def test_whatever_the_bounds_of_rules_what_is_not_denied_fits_schema_limit_and_rules(proposed, profile, low, high):
    policy = between(low, high)
    verdict = check(policy, proposed, context(profile))
    limit = policy.profiles[profile].limits["grip_force_n"].maximum
    fragile = proposed.params["object_id"] == "glass_1"
    top = min(140, limit, high, 20 if fragile else math.inf)
    if max(2, low) > top:
        assert "empty_intersection" in [reason.code for reason in verdict.reasons]
    if verdict.outcome is PolicyOutcome.DENY:
        assert verdict.effective == proposed.params
    else:
        assert max(2, low) <= verdict.effective["force_n"] <= top
        assert check(policy, replace(proposed, params=verdict.effective), context(profile)).changes == ()


def test_metadata_admission_did_not_see_denies_where_a_rule_reads_it():
    proposed = proposal("grasp_object", object_id="mug_1", metadata={"confidence": "high"})
    verdict = check(shipped(), proposed, context("sim-relaxed"))
    assert (verdict.outcome, verdict.reasons[0].code) == (PolicyOutcome.DENY, "rule_error")
    assert "metadata.confidence" in verdict.reasons[0].message


def test_a_modify_that_modifies_nothing_cannot_be_built():
    with pytest.raises(ValueError, match="at least one change"):
        Verdict(outcome=PolicyOutcome.MODIFY, effective={})


def test_a_capability_marked_for_approval_asks_where_only_escalations_do():
    text = files()
    name = "capabilities/grasp_object.yaml"
    marked = text[name].replace("real-restricted: guarded", "real-restricted: approval-required")
    policy = bundle.load_files({**text, name: marked})
    for found, asked in ((shipped(), False), (policy, True)):
        decision = decide(found, proposal("grasp_object", object_id="mug_1"), context("real-restricted"))
        assert (decision.need is not None) == asked
        assert (decision.status == Status.AWAITING_APPROVAL) == asked
    assert decision.need is not None
    assert [reason.code for reason in decision.need.reasons] == ["approval_required"]


@pytest.mark.parametrize(
    ("value", "outcome", "code"),
    [("place.name", "deny", "rule_error"), ('"aisle"', "modify", "changed"), ('"left"', "modify", "changed")],
)
def test_a_rule_cannot_set_a_name_that_is_none(value, outcome, code):
    text = files()
    name = "capabilities/navigate_to.yaml"
    hand = "  properties:\n    hand: {type: string, enum: [left, right], default: right}\n"
    param = "hand" if value == '"left"' else "corridor"
    setting = f"{{{param}: {{to: '{value}'}}}}"
    rule = f"\n  - {{id: way, applies_to: [navigate_to], then: modify, set: {setting}, because: So.}}\n"
    text[name] = text[name].replace("  properties:\n", hand, 1)
    policy = bundle.load_files({**text, "organization.yaml": text["organization.yaml"] + rule})
    params = policy.validate_params("navigate_to", {"target": "dock"})
    verdict = check(policy, replace(proposal("navigate_to", target="dock"), params=params), context("sim-relaxed"))
    assert verdict.outcome == outcome
    assert verdict.reasons[0].rule == "organization/way"
    if code == "rule_error":
        assert verdict.reasons[0].code == code
    else:
        assert verdict.effective[param] == value.strip('"')


def test_two_rules_that_name_different_corridors_deny():
    text = files()
    rule = """
  - {id: other-way, applies_to: [navigate_to], then: modify, set: {corridor: {to: '"lane"'}}, because: No.}
"""
    site = text["site.yaml"].replace(
        "corridors:\n", "corridors:\n  lane: {line: [[1, 1], [2, 1]], half_width_m: 0.5}\n"
    )
    policy = bundle.load_files(
        {**text, "organization.yaml": text["organization.yaml"] + rule, "site.yaml": site},
    )
    verdict = check(policy, proposal("navigate_to", target="bench_b_stand"), context("human-shared"))
    assert "empty_intersection" in [reason.code for reason in verdict.reasons]


def test_what_escalates_carries_constrained_parameters():
    proposed = proposal("grasp_object", object_id="box_1", force_n=140, speed_mps=2)
    decision = decide(shipped(), proposed, context("real-restricted"))
    assert decision.status is Status.AWAITING_APPROVAL
    assert decision.verdict is not None
    assert (decision.verdict.effective["force_n"], decision.verdict.effective["speed_mps"]) == (80.0, 0.5)


@pytest.mark.parametrize("profile", ["sim-relaxed", "test-audit"])
@pytest.mark.parametrize("busy", [None, "inv_1"])
def test_an_escalation_nobody_can_answer_stays_one_and_is_denied(profile, busy):
    proposed = proposal("grasp_object", object_id="mug_1", force_n=140, metadata={"confidence": 0.2})
    decision = decide(shipped(), proposed, context(profile, busy=busy))
    assert decision.status is Status.DENIED
    assert decision.verdict is not None
    assert decision.verdict.outcome is PolicyOutcome.ESCALATE
    assert decision.verdict.effective["force_n"] == shipped().profiles[profile].limits["grip_force_n"].maximum
    assert decision.verdict.reasons[-1].code == "no_authority"


def test_a_defer_leaves_room_for_an_escalation_somebody_can_answer():
    proposed = proposal("grasp_object", object_id="mug_1", metadata={"confidence": 0.2})
    decision = decide(shipped(), proposed, context("real-restricted", busy="inv_1"))
    assert decision.status is Status.DEFERRED


def test_a_permission_under_supervision_escalates_at_admission():
    text = files()
    supervised = text["organization.yaml"].replace(
        "permissions: [navigation, perception, manipulation, tool_operation]}",
        "permissions: [navigation], supervised: [manipulation]}",
    )
    policy = bundle.load_files({**text, "organization.yaml": supervised})
    gamma = replace(context("real-restricted"), agent=policy.agent("planner"))
    decision = decide(policy, proposal("grasp_object", object_id="mug_1"), gamma)
    assert decision.admission.outcome is AdmissionOutcome.ESCALATE
    assert (decision.status, decision.need is not None) == (Status.AWAITING_APPROVAL, True)
    busy = replace(gamma, cell=replace(gamma.cell, busy="inv_1"))
    assert decide(policy, proposal("grasp_object", object_id="mug_1"), busy).status is Status.DEFERRED
    for where in (gamma, busy):
        relaxed = decide(policy, proposal("grasp_object", object_id="mug_1"), replace(where, profile="sim-relaxed"))
        assert relaxed.status is Status.DENIED
        assert relaxed.verdict is not None
        assert (relaxed.verdict.outcome, relaxed.verdict.reasons[-1].code) == (PolicyOutcome.ESCALATE, "no_authority")


@pytest.mark.parametrize(
    ("differs", "outcome", "code"),
    [
        ({"latched": True}, "reject", "estop_latched"),
        ({"online": False}, "defer", "cell_offline"),
        ({"busy": "inv_1"}, "defer", "cell_busy"),
        ({"arm_ready": False}, "defer", "precondition_unmet"),
        ({"sensors_fresh": False}, "defer", "precondition_unmet"),
        ({"agent": "stranger"}, "reject", "permission_missing"),
    ],
)
def test_admission_names_what_is_in_the_way(differs, outcome, code):
    found = admit(shipped(), proposal("grasp_object", object_id="mug_1"), context("sim-relaxed", **differs))
    assert (found.outcome, found.reasons[0].code) == (outcome, code)
    assert (found.retry_after_s is not None) == (outcome == "defer")


@pytest.mark.parametrize(
    ("extra", "code"),
    [
        ({"metadata": {"confidence": "high"}}, "invalid_metadata"),
        ({"metadata": {"confidence": math.nan}}, "invalid_metadata"),
        ({"preconditions": ["full_moon"]}, "unknown_precondition"),
    ],
)
def test_admission_rejects_what_it_cannot_judge(extra, code):
    found = admit(shipped(), proposal("grasp_object", object_id="mug_1", **extra), context("sim-relaxed"))
    assert (found.outcome, found.reasons[0].code) == ("reject", code)


def test_governance_may_start_recoveries_and_agents_may_not():
    proposed = proposal("release_and_retract")
    by_agent = decide(shipped(), proposed, context("human-shared"))
    assert by_agent.admission.reasons[0].code == "recovery_only"
    gamma = replace(context("human-shared"), agent=shipped().governance())
    assert decide(shipped(), proposed, gamma).status == "allowed"


def test_without_facts_nothing_that_has_preconditions_is_admitted():
    gamma = context("sim-relaxed")
    blind = replace(gamma, cell=replace(gamma.cell, facts=None))
    assert decide(shipped(), proposal("navigate_to", target="dock"), blind).status is Status.DEFERRED


def test_a_vocabulary_with_another_capability_types_that_one_anew_and_keeps_the_rest() -> None:
    capabilities = shipped().capabilities
    first = Vocabulary(capabilities)
    kept, gone = (
        first.typed("params.force_n > 20.0", "grasp_object"),
        first.typed("params.speed_mps > 0.2", "navigate_to"),
    )
    second = first.replacing(capabilities["navigate_to"])
    assert second.typed("params.force_n > 20.0", "grasp_object") is kept
    assert second.typed("params.speed_mps > 0.2", "navigate_to") is not gone
