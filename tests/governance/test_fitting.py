from __future__ import annotations

from dataclasses import replace

import pytest

from app.governance import bundle
from app.governance.decision import decide
from app.governance.fitting import MISFIT, coupled
from app.governance.model import PolicyOutcome, Status
from app.governance.parcel import parcels, unpacked
from tests.governance.policy_world import context, files, proposal

THERE = {"x_m": 2.0, "y_m": 3.0, "yaw_rad": 0.0}


def rewritten(capability: str, *changes: tuple[str, str], rules: str = ""):
    """Return the shipped policy with a manifest rewritten, and further rules of the organization."""
    text = files()
    manifest = text[f"capabilities/{capability}.yaml"]
    for old, new in changes:
        assert old in manifest
        manifest = manifest.replace(old, new)
    organization = text["organization.yaml"] + rules
    return bundle.load_files({**text, f"capabilities/{capability}.yaml": manifest, "organization.yaml": organization})


def decided(policy, name: str, profile: str, params, **differs):
    filled = policy.validate_params(name, params)
    assert not isinstance(filled, tuple), filled
    return decide(policy, replace(proposal("retrace"), capability=name, params=filled), context(profile, **differs))


NO_CORRIDOR = ("yaw_rad: false}}", "yaw_rad: false, corridor: false}}")  # for whoever names a target
SLOW_IS_WEAK = (
    "  required: [object_id]",
    """  required: [object_id]
  if: {required: [speed_mps], properties: {speed_mps: {maximum: 0.3}}}
  then: {properties: {force_n: {minimum: 30}}}""",
)
WEAK = {"object_id": "mug_1", "force_n": 20.0, "speed_mps": 0.5}
LED = """
  - {id: led, applies_to: [navigate_to], then: modify, set: {corridor: {to: '"aisle"'}}, because: So.}
"""


@pytest.mark.parametrize(
    ("policy", "name", "params", "by", "fine"),
    [
        # what policy sets beside what must not stand there
        (lambda: rewritten("navigate_to", NO_CORRIDOR, rules=LED), "navigate_to", {"target": "dock"},
         "organization/led", THERE),
        # a limit, where a schema couples values: at 0.25 m/s it takes at least 30 N
        (lambda: rewritten("grasp_object", SLOW_IS_WEAK), "grasp_object", WEAK,
         "human-shared/tcp_speed_mps", {**WEAK, "force_n": 40.0}),
    ],
    ids=["a corridor", "a limit"],
)  # fmt: skip
def test_what_policy_makes_of_a_proposal_is_one_that_the_capability_takes(policy, name, params, by, fine):
    decision = decided(policy(), name, "human-shared", params)
    verdict = decision.verdict
    assert (decision.status, verdict.outcome, verdict.changes) == (Status.DENIED, PolicyOutcome.DENY, ())
    assert (verdict.reasons[0].rule, verdict.reasons[0].code) == ("guard", MISFIT)
    assert by in {reason.rule for reason in verdict.reasons}
    assert "policy's bounds cannot be combined with this schema" in verdict.reasons[0].message
    assert verdict.effective.items() >= params.items()
    assert decided(policy(), name, "human-shared", fine).verdict.outcome is PolicyOutcome.MODIFY


def test_what_would_escalate_is_denied_as_well():
    rules = "  - {id: asked, applies_to: [grasp_object], then: escalate, because: So.}\n"
    policy = rewritten("grasp_object", SLOW_IS_WEAK, rules=rules)
    verdict = decided(policy, "grasp_object", "human-shared", WEAK).verdict
    assert (verdict.outcome, [reason.code for reason in verdict.reasons][:2]) == (PolicyOutcome.DENY, [MISFIT, "asked"])
    assert decided(policy, "grasp_object", "human-shared", {**WEAK, "force_n": 40.0}).status is Status.AWAITING_APPROVAL


def test_what_policy_leaves_alone_and_what_it_denies_anyway_is_said_as_ever():
    policy = rewritten("navigate_to", NO_CORRIDOR, rules=LED)
    asked = {**THERE, "corridor": "aisle", "clearance_m": 0.5, "speed_mps": 0.2}
    assert decided(policy, "navigate_to", "human-shared", asked).verdict.outcome is PolicyOutcome.ALLOW
    outside = decided(policy, "navigate_to", "human-shared", {**asked, "x_m": 90.0}).verdict
    assert (outside.outcome, MISFIT in {reason.code for reason in outside.reasons}) == (PolicyOutcome.DENY, False)


def test_what_a_default_makes_of_a_proposal_is_one_that_the_capability_takes():
    policy = rewritten("grasp_object", SLOW_IS_WEAK)  # 0.3 m/s, where nothing is said
    verdict = decided(policy, "grasp_object", "sim-relaxed", {"object_id": "mug_1", "force_n": 20.0}).verdict
    assert (verdict.outcome, [reason.code for reason in verdict.reasons]) == (PolicyOutcome.DENY, [MISFIT])
    assert "with its defaults filled in" in verdict.reasons[0].message
    enough = {"object_id": "mug_1", "force_n": 30.0}
    assert decided(policy, "grasp_object", "sim-relaxed", enough).verdict.outcome is PolicyOutcome.ALLOW


@pytest.mark.parametrize(
    ("keywords", "named"),
    [
        ({}, ""),
        ({"required": ["a"], "description": "So.", "$defs": {}}, ""),
        ({"dependentRequired": {"a": ["b"]}}, "ab"),
        ({"dependentSchemas": {"a": {"required": ["b"]}, "c": True}}, "abc"),
        ({"oneOf": [{"required": ["a"], "properties": {"b": False}, "title": "One"}, False]}, "ab"),
        ({"if": {"properties": {"a": {"const": 1}}}, "then": {"not": {"required": ["c"]}}, "else": True}, "ac"),
        ({"allOf": [{"anyOf": [{"required": ["b"]}]}]}, "b"),
        ({"maxProperties": 2}, "abc"),
        ({"not": {"patternProperties": {"^a": True}}}, "abc"),
    ],
)
def test_knows_of_which_parameters_a_schema_speaks_together(keywords, named):
    assert coupled({"type": "object", "properties": {"a": {}, "b": {}, "c": {}}, **keywords}) == set(named)


def test_a_policy_from_another_process_denies_it_too():
    policy = rewritten("grasp_object", SLOW_IS_WEAK)
    (*_, taken) = unpacked(parcels(policy))
    assert decided(taken, "grasp_object", "human-shared", WEAK).verdict.reasons[0].code == MISFIT
