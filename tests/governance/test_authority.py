"""The five modes of authority: what each leaves to humans, and what is refused without it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from app.governance import bundle
from app.governance.authority import allows, denial, grantable, handled, refusal, reviewed, waiting
from app.governance.decision import decide
from app.governance.model import AuthorityMode, Context, Grant, GrantScope, Outcome, Risk
from app.governance.policy import PolicySet
from app.governance.policy_model import Confirmation, GrantTerms
from tests.governance.policy_world import PROFILES, context, files, proposal, shipped

INTERRUPT, TAKEOVER, REVIEW = (
    AuthorityMode.INTERRUPT_ENABLED,
    AuthorityMode.TAKEOVER_ENABLED,
    AuthorityMode.REVIEW_ONLY,
)


def under(profile: str, *modes: AuthorityMode) -> PolicySet:
    """Return the shipped policy with other modes in one profile."""
    policy = shipped()
    changed = replace(policy.profiles[profile], authority=frozenset(modes))
    gates = {
        pair: replace(gate, profile=changed) if pair[1] == profile else gate for pair, gate in policy.gates.items()
    }
    return replace(policy, profiles={**policy.profiles, profile: changed}, gates=gates)


def test_every_shipped_profile_may_be_interrupted():
    assert all(allows(shipped(), profile, INTERRUPT) for profile in PROFILES)


def test_the_controls_are_taken_only_where_people_are_on_duty():
    assert [allows(shipped(), profile, TAKEOVER) for profile in PROFILES] == [False, False, True, True]
    assert [allows(shipped(), profile, REVIEW) for profile in PROFILES] == [True, True, False, False]


@pytest.mark.parametrize(
    ("mode", "code"),
    [
        (INTERRUPT, "interrupt_not_enabled"),
        (TAKEOVER, "takeover_not_enabled"),
        (REVIEW, "review_not_enabled"),
        (AuthorityMode.APPROVAL_REQUIRED, "approval_not_enabled"),
        (AuthorityMode.APPROVAL_ON_ESCALATION, "approval_not_enabled"),
    ],
)
def test_a_mode_that_is_missing_refuses_by_its_own_code(mode, code):
    others = [other for other in AuthorityMode if other is not mode]
    refused = refusal(under("human-shared", *others), "human-shared", mode)
    assert refused is not None
    assert (refused.rule, refused.code) == ("human-shared/authority", code)
    assert "`human-shared`" in refused.message
    assert refusal(under("human-shared", mode), "human-shared", mode) is None


def test_a_profile_that_policy_does_not_know_has_no_mode():
    assert not any(allows(shipped(), "long-gone", mode) for mode in AuthorityMode)


# -- asking ------------------------------------------------------------------------------------------------------------

REQUIRED, ON_ESCALATION = AuthorityMode.APPROVAL_REQUIRED, AuthorityMode.APPROVAL_ON_ESCALATION
DOUBTFUL = {"confidence": 0.2}  # what organization/low-confidence escalates


@pytest.mark.parametrize(
    ("modes", "plain", "escalated"),
    [
        ((REQUIRED,), "awaiting_approval", "awaiting_approval"),
        ((ON_ESCALATION,), "allowed", "awaiting_approval"),
        ((REVIEW, INTERRUPT, TAKEOVER), "allowed", "denied"),
    ],
)
def test_the_modes_say_who_is_asked_before_launch(modes, plain, escalated):
    policy = under("human-shared", *modes)
    gate = policy.gates["grasp_object", "human-shared"]
    unmarked = replace(gate, capability=replace(gate.capability, env_profile={"human-shared": "guarded"}))
    policy = replace(policy, gates={**policy.gates, ("grasp_object", "human-shared"): unmarked})
    asked = [
        decide(policy, proposal("grasp_object", object_id="mug_1", metadata=doubt), context("human-shared")).status
        for doubt in ({}, DOUBTFUL)
    ]
    assert asked == [plain, escalated]


# -- standing grants ---------------------------------------------------------------------------------------------------

NOW_S = context("human-shared").time_s
MUG = proposal("grasp_object", object_id="mug_1")
GRANT = Grant(
    id="gr_1", capability="grasp_object", agent="planner", cell=context("human-shared").cell.id, profile="human-shared",
    policy_digest=shipped().digest, scope=GrantScope.TIME, issued_by="olivia", issued_at_s=NOW_S - 1.0,
    expires_at_s=NOW_S + 1.0,
)  # fmt: skip


def holding(*grants: Grant, at: Context | None = None) -> Context:
    return replace(at or context("human-shared"), grants=grants)


def test_a_grant_answers_what_the_profile_requires_approval_for_and_says_so():
    assert decide(shipped(), MUG, holding()).status == "awaiting_approval"
    decision = decide(shipped(), MUG, holding(GRANT))
    assert (decision.status, decision.need, decision.grant) == ("allowed", None, GRANT)


def test_a_grant_widens_nothing():
    greedy = proposal("grasp_object", object_id="mug_1", force_n=140)
    decision = decide(shipped(), greedy, holding(GRANT))
    assert decision.verdict.effective["force_n"] == 60
    hazardous = proposal("grasp_object", object_id="solvent_1")
    assert decide(shipped(), hazardous, holding(GRANT)).status == "denied"


@pytest.mark.parametrize(
    "differs",
    [
        {"capability": "operate_tool"},
        {"agent": "another"},
        {"cell": "another"},
        {"profile": "real-restricted"},
        {"policy_digest": "sha256:00"},
        {"issued_at_s": NOW_S - 2.0, "expires_at_s": NOW_S},
        {"issued_at_s": NOW_S + 0.1},
        {"scope": GrantScope.OBJECT, "object": "glass_1"},
        {"scope": GrantScope.TASK, "task": "tidy up"},
    ],
)
def test_a_grant_for_anything_else_leaves_the_question_to_a_human(differs):
    decision = decide(shipped(), MUG, holding(replace(GRANT, **differs)))
    assert (decision.status, decision.grant) == ("awaiting_approval", None)


def test_the_first_grant_that_covers_it_answers():
    for_mug = replace(GRANT, id="gr_2", scope=GrantScope.OBJECT, object="mug_1")
    assert decide(shipped(), MUG, holding(replace(GRANT, agent="x"), for_mug, GRANT)).grant == for_mug


def test_a_grant_for_a_task_answers_for_proposals_that_name_it():
    tidying = replace(GRANT, scope=GrantScope.TASK, task="tidy up")
    named = replace(MUG, metadata={"task": "tidy up"})
    assert decide(shipped(), named, holding(tidying)).grant == tidying


def test_the_object_of_a_proposal_is_the_one_it_names_else_the_one_in_the_gripper():
    at = context("human-shared", holding="mug_1")
    carry, drive = proposal("transport_object", target="dock"), proposal("navigate_to", target="dock")
    assert [handled(shipped(), proposed, at) for proposed in (MUG, carry, drive)] == ["mug_1"] * 3
    assert handled(shipped(), replace(MUG, params={}), at) is None
    blind = replace(at, cell=replace(at.cell, facts=None))
    assert handled(shipped(), carry, blind) is None
    assert handled(shipped(), replace(carry, capability="dance"), at) == "mug_1"


def test_no_grant_answers_what_a_rule_escalates():
    doubtful = replace(MUG, metadata=DOUBTFUL)
    assert decide(shipped(), doubtful, holding(GRANT)).status == "awaiting_approval"


def test_no_grant_answers_what_takes_two_people():
    press = proposal("operate_tool", tool="press", action="press")
    at = context("human-shared", stand="tool_stand")
    grant = replace(GRANT, capability="operate_tool")
    decision = decide(shipped(), press, holding(grant, at=at))
    assert (decision.status, decision.need.approvers) == ("awaiting_approval", 2)
    lever = proposal("operate_tool", tool="lever", action="pull_down")
    assert decide(shipped(), lever, holding(grant, at=at)).grant == grant


def risky(capability: str, risk: Risk, policy: PolicySet | None = None) -> PolicySet:
    """Return a policy in which a capability is of another risk."""
    policy = policy or shipped()
    package = replace(policy.capabilities[capability], risk=risk)
    gates = {
        pair: replace(gate, capability=package) if pair[0] == capability else gate
        for pair, gate in policy.gates.items()
    }
    return replace(policy, capabilities={**policy.capabilities, capability: package}, gates=gates)


def test_critical_risk_is_never_granted_whatever_policy_says():
    everything = GrantTerms(up_to_s=900.0, risks=frozenset(Risk))
    policy = risky("grasp_object", Risk.CRITICAL)
    policy = replace(policy, authority=replace(policy.authority, grants=everything))
    gate = policy.gates["grasp_object", "human-shared"]
    one = replace(gate.profile.approval, approvers={}, default_approvers=1)  # not even where one person is enough
    gate = replace(gate, profile=replace(gate.profile, approval=one))
    policy = replace(policy, gates={**policy.gates, ("grasp_object", "human-shared"): gate})
    assert grantable(policy, "grasp_object", "human-shared").code == "risk_not_granted"
    assert decide(policy, MUG, holding(GRANT)).status == "awaiting_approval"


def test_says_why_nothing_is_granted():
    policy = shipped()
    without = replace(policy, authority=replace(policy.authority, grants=None))
    approval = replace(policy.gates["grasp_object", "human-shared"].profile.approval, default_approvers=2)
    gates = {
        pair: replace(gate, profile=replace(gate.profile, approval=approval)) for pair, gate in policy.gates.items()
    }
    quorum = replace(policy, gates=gates)
    assert grantable(policy, "grasp_object", "human-shared") is None
    told = [
        grantable(without, "grasp_object", "human-shared"),
        grantable(policy, "navigate_to", "human-shared"),
        grantable(policy, "grasp_object", "sim-relaxed"),
        grantable(policy, "grasp_object", "real-restricted"),
        grantable(policy, "dance", "human-shared"),
        grantable(policy, "regrasp", "human-shared"),
        grantable(quorum, "grasp_object", "human-shared"),
    ]
    assert [reason.code for reason in told] == ["grants_not_enabled", *["nothing_to_grant"] * 5, "quorum_not_granted"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"expires_at_s": NOW_S + 900.0},
        {"expires_at_s": NOW_S - 1.0},
        {"expires_at_s": float("nan")},
        {"scope": GrantScope.OBJECT},
        {"scope": GrantScope.TASK, "task": "tidy up", "object": "mug_1"},
        {"scope": GrantScope.TASK},
    ],
)
def test_a_grant_without_an_end_or_with_another_scope_cannot_be_made(wrong):
    with pytest.raises(ValueError, match="a grant"):
        replace(GRANT, **wrong)


# -- waiting, denying, reviewing ---------------------------------------------------------------------------------------


def test_a_phase_waits_as_its_entry_says_and_anything_else_as_every_session():
    entry = Confirmation(
        capability="place_object", profile="human-shared", phases=("release",), within_s=60.0, on_deny="rollback"
    )
    brief = replace(entry, capability="grasp_object", within_s=None)
    policy = shipped()
    policy = replace(policy, authority=replace(policy.authority, confirm_before=(entry, brief)))
    assert waiting(policy, "place_object", "human-shared", "release") == (60.0, "rollback", "terminate")
    assert waiting(policy, "grasp_object", "human-shared", "release") == (600.0, "rollback", "terminate")
    for other in (("place_object", "human-shared", None), ("place_object", "real-restricted", "release")):
        assert waiting(policy, *other) == (600.0, "terminate", "terminate")


def test_a_denial_without_a_code_means_the_declared_default():
    assert denial(shipped(), None).code == "unspecified"
    assert denial(shipped(), "person_in_the_way").says == "a person is in the way"
    assert denial(shipped(), "bad_hair_day") is None


def test_a_policy_that_says_nothing_of_grants_and_denials_grants_nothing_and_knows_one_denial():
    text = files()
    head, _, _ = text["authority.yaml"].partition("# Where one person")
    silent = bundle.load_files({**text, "authority.yaml": head})
    assert grantable(silent, "grasp_object", "human-shared").code == "grants_not_enabled"
    assert (denial(silent, None).code, denial(silent, "not_needed")) == ("unspecified", None)


def test_sessions_are_reviewed_for_their_risk_and_for_how_they_ended():
    def codes(capability, profile, outcome, policy=None):
        return [reason.code for reason in reviewed(policy or shipped(), capability, profile, outcome)]

    assert codes("operate_tool", "test-audit", Outcome.SUCCEEDED) == ["reviewed_for_risk"]
    assert codes("operate_tool", "test-audit", Outcome.FAULT) == ["reviewed_for_risk", "reviewed_for_outcome"]
    assert codes("navigate_to", "sim-relaxed", Outcome.STOPPED) == ["reviewed_for_outcome"]
    assert codes("navigate_to", "sim-relaxed", Outcome.SUCCEEDED) == []
    assert codes("grasp_object", "human-shared", Outcome.FAULT) == []
    assert codes("dance", "test-audit", Outcome.FAULT) == []
    assert codes("navigate_to", "long-gone", Outcome.FAULT) == []
    assert codes("navigate_to", "test-audit", Outcome.FAULT, under("test-audit", INTERRUPT)) == []
