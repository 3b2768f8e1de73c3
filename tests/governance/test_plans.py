from __future__ import annotations

import pytest

from app.governance import bundle
from app.governance.model import Authorization, Mode, Risk, Strategy
from app.governance.plans import closes, confirm_before, recovery_plan, watch_plan, watch_plan_for
from app.governance.watcher import compile_watch
from tests.governance.policy_world import PROFILES, files, proposal, shipped


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("capability", sorted(shipped().capabilities))
def test_every_pair_has_a_watch_plan_that_compiles(capability, profile):
    plan = watch_plan(shipped(), capability, profile, {})
    assert compile_watch(plan).rules == plan.rules


@pytest.mark.parametrize("profile", PROFILES)
def test_only_the_audited_profile_keeps_every_tick(profile):
    params = proposal("navigate_to", target="dock").params
    assert watch_plan(shipped(), "navigate_to", profile, params).keep_every_tick == (profile == "test-audit")


def test_bounds_are_the_smaller_of_limit_and_parameter_and_careful_halves_speed():
    params = proposal("grasp_object", object_id="mug_1", force_n=30, speed_mps=0.2).params
    normal = watch_plan(shipped(), "grasp_object", "human-shared", params).bounds
    assert (normal.grip_force_n, normal.tcp_speed_mps, normal.contact_force_n) == (30.0, 0.2, 100.0)
    careful = watch_plan(shipped(), "grasp_object", "human-shared", params, Mode.CAREFUL).bounds
    assert (careful.grip_force_n, careful.tcp_speed_mps) == (30.0, 0.1)


@pytest.mark.parametrize(
    ("capability", "tcp_mps", "base_mps"),
    [("safe_retreat", 0.1, 0.1), ("retrace", 0.1, 0.1), ("reposition_base", 0.25, 0.1), ("regrasp", 0.1, 0.3)],
)
def test_a_speed_that_is_not_said_to_be_arms_or_bases_holds_both(capability, tcp_mps, base_mps):
    bounds = watch_plan(shipped(), capability, "human-shared", {"speed_mps": 0.1}).bounds
    assert (bounds.tcp_speed_mps, bounds.base_speed_mps) == (tcp_mps, base_mps)


def test_a_violation_is_more_than_five_percent_above_the_bound():
    plan = watch_plan(shipped(), "grasp_object", "human-shared", {"speed_mps": 0.2})
    thresholds = {rule.id: rule.threshold for rule in plan.rules}
    assert thresholds["tcp-speed"] == pytest.approx(0.21)
    assert thresholds["contact-force"] == pytest.approx(105.0)
    assert (thresholds["timeout"], thresholds["separation"]) == (20.0, None)


@pytest.mark.parametrize(("force_n", "threshold"), [(30.0, 31.5), (60.0, 63.0), (140.0, 63.0)])
def test_a_threshold_named_after_a_limit_follows_the_smaller_of_limit_and_parameter(force_n, threshold):
    name = "profiles/human-shared.yaml"
    text = files()[name].replace("above: {limit: contact_force_n,", "above: {limit: grip_force_n,")
    policy = bundle.load_files({**files(), name: text})
    plan = watch_plan(policy, "grasp_object", "human-shared", {"force_n": force_n})
    assert {rule.id: rule.threshold for rule in plan.rules}["contact-force"] == pytest.approx(threshold)


@pytest.mark.parametrize("profile", PROFILES)
def test_a_lost_object_is_grasped_afresh_after_release_and_retract(profile):
    rows = [row for row in recovery_plan(shipped(), "grasp_object", profile).rules if row.on == "object_lost"]
    assert rows[0].do[:2] == (Strategy.RECOVERY_CAPABILITY, Strategy.RETRY)
    assert rows[0].capability == "release_and_retract"


def test_a_drop_while_driving_asks_a_human():
    rows = [
        row for row in recovery_plan(shipped(), "transport_object", "human-shared").rules if row.on == "object_lost"
    ]
    assert rows[0].do == (Strategy.ASK_HUMAN,)


def test_rollback_is_required_of_manipulation_only():
    assert recovery_plan(shipped(), "grasp_object", "human-shared").rollback == "required"
    assert recovery_plan(shipped(), "navigate_to", "human-shared").rollback == "optional"


def test_nothing_waits_for_confirmation_as_shipped():
    assert confirm_before(shipped(), "place_object", "human-shared") == ()


def test_an_authorization_is_watched_by_the_parameters_and_mode_it_names():
    authorization = Authorization(
        id="aut_1", invocation="inv_1", capability="grasp_object", version="1.0.0",
        params={"object_id": "mug_1", "force_n": 30.0, "speed_mps": 0.2}, cell="c", profile="human-shared",
        policy_digest=shipped().digest, issued_at_s=0.0, expires_at_s=1.0, mode=Mode.CAREFUL,
    )  # fmt: skip
    plan = watch_plan_for(shipped(), authorization)
    assert plan == watch_plan(shipped(), "grasp_object", "human-shared", authorization.params, Mode.CAREFUL)
    assert plan.bounds.tcp_speed_mps == 0.1


def test_what_is_held_lowers_the_bound_of_the_grip_and_its_threshold_and_never_raises_them():
    def grip(**held):
        plan = watch_plan(shipped(), "transport_object", "human-shared", {"target": "dock", "speed_mps": 0.2}, **held)
        return plan.bounds.grip_force_n, next(rule.threshold for rule in plan.rules if rule.id == "grip-force")

    assert grip() == grip(held_n=100.0) == (60.0, pytest.approx(63.0))
    assert grip(held_n=20.0) == (20.0, pytest.approx(21.0))


def test_some_capabilities_say_how_firmly_they_close():
    says = {name for name in shipped().capabilities if closes(shipped(), name, "human-shared")}
    assert says == {"grasp_object", "regrasp", "takeover"}


@pytest.mark.parametrize(
    ("speed_mps", "threshold"), [(0.02, 0.03), (0.1, 0.11), (0.2, 0.21), (0.24, 0.252), (0.25, 0.2625), (1.0, 0.2625)]
)
def test_a_slow_session_has_headroom_for_the_noise_of_its_speed_and_never_more_than_the_profile(speed_mps, threshold):
    plan = watch_plan(shipped(), "grasp_object", "human-shared", {"object_id": "mug_1", "speed_mps": speed_mps})
    assert next(rule for rule in plan.rules if rule.id == "tcp-speed").threshold == pytest.approx(threshold)


@pytest.mark.parametrize(("force_n", "threshold"), [(2.0, 2.5), (8.0, 8.5), (20.0, 21.0), (59.9, 62.895), (60.0, 63.0)])
def test_a_weak_grip_has_headroom_for_the_noise_of_its_pads(force_n, threshold):
    plan = watch_plan(shipped(), "grasp_object", "human-shared", {"object_id": "mug_1", "force_n": force_n})
    assert next(rule for rule in plan.rules if rule.id == "grip-force").threshold == pytest.approx(threshold)


@pytest.mark.parametrize("speed_mps", [0.05, 0.1, 0.2])
def test_what_speaks_up_before_a_speed_limit_does_so_in_a_slow_session_too(speed_mps):
    name = "profiles/human-shared.yaml"
    row = "{id: early, signal: tcp_speed_mps, above: {limit: tcp_speed_mps, times: 0.8}, response: {enter: pause}}"
    policy = bundle.load_files({**files(), name: files()[name].replace("watch:\n", f"watch:\n  - {row}\n")})
    plan = watch_plan(policy, "grasp_object", "human-shared", {"object_id": "mug_1", "speed_mps": speed_mps})
    assert next(rule.threshold for rule in plan.rules if rule.id == "early") == pytest.approx(0.8 * speed_mps)


@pytest.mark.parametrize(
    ("profile", "can_ask"),
    [("sim-relaxed", False), ("test-audit", False), ("real-restricted", True), ("human-shared", True)],
)
def test_a_recovery_plan_knows_the_risk_and_whether_anybody_can_be_asked(profile, can_ask):
    plan = recovery_plan(shipped(), "operate_tool", profile)
    assert (plan.risk, plan.can_ask) == (Risk.HIGH, can_ask)
    assert recovery_plan(shipped(), "navigate_to", profile).risk is Risk.LOW
