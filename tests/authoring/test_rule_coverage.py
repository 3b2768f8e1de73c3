from __future__ import annotations

from app.authoring.rule_coverage import rule_coverage
from app.governance import bundle
from tests.governance.policy_world import POLICIES, shipped

CASE = "cases:\n  - {name: x, profile: %s, capability: grasp_object, params: %s, expect: {status: %s}}\n"


def covered(profile, params, status="denied"):
    found = rule_coverage(shipped(), {"tests/x.yaml": CASE % (profile, params, status)})
    return {rule for rule, count in found.determined.items() if count}


def test_the_shipped_cases_reach_every_rule_and_limit():
    found = rule_coverage(shipped(), bundle.read_cases(POLICIES))
    assert found.never == []
    assert found.share == 1.0


def test_a_rule_that_holds_beside_a_denial_determined_nothing():
    """The box is too heavy, and force and speed are above the limits: only the weight decides."""
    assert covered("human-shared", "{object_id: box_1, force_n: 100, speed_mps: 1.0}") == {"organization/payload"}


def test_an_escalation_is_determined_by_what_it_carries_too():
    found = covered("real-restricted", "{object_id: box_1, force_n: 100}")
    assert found == {"organization/payload-margin", "real-restricted/grip_force_n"}


def test_invalid_and_rejected_proposals_cover_nothing():
    assert covered("human-shared", "{}") == set()
    assert covered("human-shared", "{object_id: teapot}", "rejected") == set()
