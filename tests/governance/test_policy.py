from __future__ import annotations

import orjson
import pytest

from app.governance import bundle
from app.governance.model import Authorization, Mode, Risk, Strategy
from app.governance.policy import ParamProblem, closes, confirm_before, recovery_plan, watch_plan, watch_plan_for
from app.governance.watcher import compile_watch
from tests.governance.policy_world import PROFILES, files, proposal, shipped

LIMITS = {  # design, section 5
    "sim-relaxed": (0.3, 1.5, 1.5, 120, 250, 5, 5),
    "test-audit": (0.5, 1.0, 1.0, 100, 200, 5, 3),
    "real-restricted": (0.7, 0.5, 0.6, 80, 150, 4, 2),
    "human-shared": (0.9, 0.25, 0.3, 60, 100, 3, 1),
}


@pytest.mark.parametrize("name", PROFILES)
def test_profiles_have_the_designs_numbers(name):
    profile = shipped().profiles[name]
    limits = tuple(limit.maximum for limit in profile.limits.values())
    assert (profile.sensitivity, *limits, profile.retry_budget) == LIMITS[name]


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


@pytest.mark.parametrize(
    ("params", "code"),
    [
        ({"object_id": "mug_1", "force_n": 10**400}, "out_of_range"),
        ({"object_id": "mug_1", "force_n": 1e308}, "schema"),
        ({"object_id": "\ud800"}, "bad_text"),
        ({"object_id": ""}, "schema"),
        ({"object_id": "m" * 1_000_000}, "schema"),
        ({}, "schema"),
        ({"object_id": {"a"}}, "not_json"),
    ],
)
def test_bad_parameters_are_problems(params, code):
    assert shipped().validate_params("grasp_object", params)[0].code == code


@pytest.mark.parametrize("params", [{}, {"target": "dock", "x_m": 1.0}, {"x_m": 1.0, "y_m": 1.0}])
def test_says_between_which_parameters_there_is_a_choice(params):
    problems = shipped().validate_params("navigate_to", params)
    assert [problem.message for problem in problems] == ["name `target`, or `x_m`, `y_m` and `yaw_rad`"]


def test_names_a_parameter_that_there_is_not_and_lists_those_there_are():
    found = shipped().validate_params("grasp_object", {"object_id": "mug_1", "spede_mps": 1, "f" * 99: 2})
    valid = "`object_id`, `force_n`, `speed_mps`"
    assert found == tuple(ParamProblem(name, "schema", "is unknown", valid) for name in ("spede_mps", "f" * 64))


def test_lists_the_parameters_of_that_part_of_a_schema_which_takes_no_others():
    text = files()
    name = "capabilities/grasp_object.yaml"
    part = "{additionalProperties: false, properties: {object_id: true, force_n: true}}"
    text[name] = text[name].replace("  required: [object_id]", f"  required: [object_id]\n  allOf: [{part}]")
    problems = bundle.load_files(text).validate_params("grasp_object", {"object_id": "mug_1", "speed_mps": 0.2})
    assert problems == (ParamProblem("speed_mps", "schema", "is unknown", "`object_id`, `force_n`"),)


@pytest.mark.parametrize("branch", ["{minProperties: 3}", "false"])
def test_a_choice_of_another_kind_is_told_as_the_schema_has_it(branch):
    text = files()
    name = "capabilities/navigate_to.yaml"
    named = "- {required: [target], properties: {x_m: false, y_m: false, yaw_rad: false}}"
    text[name] = text[name].replace(named, f"- {branch}")
    problems = bundle.load_files(text).validate_params("navigate_to", {})
    assert "oneOf" in problems[0].message


@pytest.mark.parametrize("params", [{"object_id": "mug_ü"}, {"öbject": "mug_1"}])
def test_text_that_is_not_ascii_is_held_to_the_schema_like_any_other(params):
    problems = shipped().validate_params("grasp_object", {**params, "extra": True})
    assert {problem.code for problem in problems} == {"schema"}
    sound = shipped().validate_params("grasp_object", {"object_id": "mug_ü"})
    assert not isinstance(sound, tuple)
    assert sound["object_id"] == "mug_ü"


def test_a_key_no_one_could_write_down_is_a_problem():
    assert shipped().validate_params("grasp_object", {"object_id": "mug_1", "\ud800": 1})[0].code == "bad_text"


def test_a_flag_is_no_number():
    assert shipped().validate_params("grasp_object", {"object_id": "mug_1", "force_n": True})[0].code == "schema"


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


def test_bottomless_nesting_is_a_problem():
    deep: object = "x"
    for _ in range(40):
        deep = [deep]
    assert shipped().validate_params("grasp_object", {"object_id": deep})[0].code == "too_deep"


def test_an_unknown_capability_leaves_parameters_to_admission():
    assert shipped().validate_params("fly", {"height": 3}) == {"height": 3}


def test_a_rule_is_described_with_the_approvers_it_asks_for():
    described = {rule["id"]: rule["approvers"] for rule in shipped().describe()["rules"]}
    assert described["organization/press-two-approvers"] == 2
    assert described["organization/fragile-grip"] is None


def test_descriptions_are_json():
    assert orjson.loads(orjson.dumps(shipped().describe()))["version"] == shipped().digest
    assert len(orjson.loads(orjson.dumps(shipped().manifests()))) == len(shipped().capabilities)


@pytest.mark.parametrize(
    ("speed_mps", "threshold"), [(0.02, 0.03), (0.1, 0.11), (0.2, 0.21), (0.24, 0.252), (0.25, 0.2625), (1.0, 0.2625)]
)
def test_a_slow_session_has_headroom_for_the_noise_of_its_speed_and_never_more_than_the_profile(speed_mps, threshold):
    plan = watch_plan(shipped(), "grasp_object", "human-shared", {"object_id": "mug_1", "speed_mps": speed_mps})
    assert next(rule for rule in plan.rules if rule.id == "tcp-speed").threshold == pytest.approx(threshold)


@pytest.mark.parametrize(
    ("profile", "can_ask"),
    [("sim-relaxed", False), ("test-audit", False), ("real-restricted", True), ("human-shared", True)],
)
def test_a_recovery_plan_knows_the_risk_and_whether_anybody_can_be_asked(profile, can_ask):
    plan = recovery_plan(shipped(), "operate_tool", profile)
    assert (plan.risk, plan.can_ask) == (Risk.HIGH, can_ask)
    assert recovery_plan(shipped(), "navigate_to", profile).risk is Risk.LOW
