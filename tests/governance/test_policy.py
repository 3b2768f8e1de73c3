from __future__ import annotations

import orjson
import pytest

from app.governance import bundle
from app.governance.policy import ParamProblem
from tests.governance.policy_world import PROFILES, files, shipped

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


def test_names_a_parameter_that_is_missing_and_one_without_a_name():
    assert shipped().validate_params("grasp_object", {}) == (ParamProblem("object_id", "schema", "is missing"),)
    unnamed = shipped().validate_params("navigate_to", {"target": "dock", "": 1})
    assert [problem.param for problem in unnamed] == ['""']


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


def test_what_a_profile_watches_is_described_with_its_thresholds_and_what_it_does():
    described = orjson.loads(orjson.dumps(shipped().watched()))
    assert described["version"] == shipped().digest
    near, force = described["profiles"]["human-shared"]["watch"][:2]
    assert (near["signal"], near["above"], near["threshold"]) == ("separation_m", False, "protective_separation_m")
    assert (near["response"]["enter"], near["response"]["else"], near["response"]["persist_ms"]) == (
        "PAUSE", "ESCALATE", 5000,
    )  # fmt: skip
    assert force["threshold"] == {"limit": "contact_force_n", "times": 1.05}
    relaxed = described["profiles"]["sim-relaxed"]["watch"][0]
    assert (relaxed["threshold"], relaxed["response"]["enter"]) == (0.5, "CONTINUE")


def test_descriptions_are_json():
    assert orjson.loads(orjson.dumps(shipped().describe()))["version"] == shipped().digest
    assert len(orjson.loads(orjson.dumps(shipped().manifests()))) == len(shipped().capabilities)
