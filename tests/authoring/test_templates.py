"""Templates: their numbers, their questions, and what comes of the answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from app.authoring.collaboration import REGIONS, Distances, contact_speed_mps, lasting_force_n
from app.authoring.drafting import Sections, drafted
from app.authoring.questions import AnswerError, Choice, Number, Question, Words, YesNo
from app.authoring.templates import TEMPLATES, common
from app.governance import bundle
from app.governance.bundle_yaml import parse
from app.governance.errors import PolicyErrors
from app.governance.model import Risk
from app.governance.policy import PolicySet

POLICIES = Path(__file__).resolve().parents[2] / "policies"
SAID = {
    "reduced-speed": {"base_speed_mps": "0.2"},
    "speed-and-separation": {
        "reaction_s": "0.1", "stopping_s": "0.3", "intrusion_m": "0.2", "position_uncertainty_m": "0.08",
        "robot_uncertainty_m": "0.05", "tcp_speed_mps": "0.25", "base_speed_mps": "0.3",
    },
    "force-limited": {
        "body_regions": "hand-and-fingers, abdomen", "moving_mass_kg": "20.6", "tool_kg": "1", "payload_kg": "2",
        "grip_force_n": "60",
        "tcp_speed_mps": "0.2", "base_speed_mps": "0.2",
    },
    "personal-care": {
        "tcp_speed_mps": "0.2", "base_speed_mps": "0.2", "contact_force_n": "60", "clearance_m": "0.5",
        "confidence": "0.7",
    },
    "human-oversight": {"within_s": "60", "confidence": "0.6"},
}  # fmt: skip


def shipped() -> PolicySet:
    return bundle.load(POLICIES)


def answers(name: str, **more: str) -> dict[str, Any]:
    said = {"assessment": "RA 7, section 3", **SAID[name], **more}
    asked = (
        *common(("human-shared", "real-restricted", "sim-relaxed"), "human-shared", name),
        *TEMPLATES[name].questions,
    )
    return {one.key: one.read(said.get(one.key, one.default or "")) for one in asked}


def made(name: str, *, model: PolicySet | None = None, **more: str) -> tuple[PolicySet, dict[str, str]]:
    policy = model or shipped()
    changed = drafted(policy, bundle.read_properties(POLICIES), TEMPLATES[name], answers(name, **more))
    files = {**policy.files, **{file: text for file, text in changed.items() if file != "properties.yaml"}}
    return bundle.load_files(files), changed


def test_the_forces_are_those_of_table_a2():
    assert {name: region.force_n for name, region in REGIONS.items()} == {
        "back-and-shoulders": 210, "chest": 140, "abdomen": 110, "pelvis": 180, "upper-arm-and-elbow": 150,
        "forearm-and-wrist": 160, "hand-and-fingers": 140, "thigh-and-knee": 220, "lower-leg": 130,
    }  # fmt: skip
    assert lasting_force_n(["chest", "abdomen", "pelvis"]) == 110


def test_a_contact_has_no_more_energy_than_the_spring_takes_at_its_transient_force():
    speed = contact_speed_mps(["hand-and-fingers"], moving_kg=20.6, load_kg=3.0)
    reduced_kg = 0.6 * 13.3 / 13.9
    assert reduced_kg * speed**2 / 2 == pytest.approx(280.0**2 / (2 * 75_000))
    assert contact_speed_mps(["hand-and-fingers"], moving_kg=20.6, load_kg=30.0) < speed


def test_the_distance_is_the_sum_of_its_parts():
    found = Distances(1.6, 0.1, 0.3, 0.2, 0.08, 0.05)
    assert found.separation_m(0.0) == pytest.approx(1.6 * 0.4 + 0.33)
    assert found.separation_m(1.0) == pytest.approx(1.6 * 0.4 + 0.1 + 0.15 + 0.33)


@pytest.mark.parametrize("name", TEMPLATES)
def test_every_template_makes_a_profile_of_a_policy_that_loads(name):
    policy, _ = made(name)
    profile = policy.profiles[name]
    model = shipped().profiles["human-shared"]
    draft = TEMPLATES[name].draft(answers(name))
    for limit, found in profile.limits.items():
        wanted = draft.limits.get(limit)
        assert (found.maximum, found.source) == (wanted or (model.limits[limit].maximum, model.limits[limit].source))
    assert {pair[0] for pair in policy.gates if pair[1] == name} == {
        pair[0] for pair in shipped().gates if pair[1] == "human-shared"
    }


@pytest.mark.parametrize("name", TEMPLATES)
def test_what_a_template_takes_from_the_assessment_says_so(name):
    draft = TEMPLATES[name].draft(answers(name))
    for question in TEMPLATES[name].questions:
        if question.key in draft.limits and question.default is None:
            assert "RA 7, section 3" in draft.limits[question.key].source


def test_other_profiles_are_left_as_they_were_with_their_comments():
    policy, changed = made("personal-care")
    assert {file for file in policy.files if policy.files[file] != shipped().files.get(file)} == {
        file for file in changed if file != "properties.yaml"
    }
    for name in shipped().profiles:
        assert policy.profiles[name] == shipped().profiles[name]
    assert "# From the strictest." in changed["properties.yaml"]
    manifest = changed["capabilities/takeover.yaml"]
    assert manifest.replace(", personal-care: guarded", "") == shipped().files["capabilities/takeover.yaml"]


@pytest.mark.parametrize("profiles", ["[real-restricted, human-shared]", "\n    - human-shared   # beside people\n"])
def test_what_all_profiles_share_holds_as_it_does_for_the_model(profiles: str):
    files = {**shipped().files}
    rule = f"profiles: {profiles}\n    then: deny\n    because: Nobody works a tool beside people."
    files["organization.yaml"] += f"  - id: first\n    {rule}\n  - id: second\n    {rule}\n"
    wait = "{capability: place_object, profile: human-shared, phases: [release], within_s: 60, on_deny: rollback}"
    files["authority.yaml"] = files["authority.yaml"].replace("confirm_before: []", f"confirm_before: [{wait}]")
    model = bundle.load_files(files)
    policy, changed = made("reduced-speed", model=model)
    for name in ("first", "second"):
        was = model.rules[f"organization/{name}"].profiles or frozenset()
        assert policy.rules[f"organization/{name}"].profiles == was | {"reduced-speed"}
    first, second = policy.authority.confirm_before
    assert (first.profile, second) == ("human-shared", replace(first, profile="reduced-speed"))
    other, _ = made("reduced-speed", model=model, like="sim-relaxed")
    assert other.rules["organization/first"] == model.rules["organization/first"]
    assert other.authority == model.authority
    assert "# Rules O: they hold in every profile." in changed["organization.yaml"]


def test_a_clearance_takes_the_place_of_the_models_lesser_one():
    policy, _ = made("personal-care")
    assert "personal-care/clearance" not in policy.rules
    held = policy.rules["personal-care/personal-care-clearance"]
    assert held.settings[0].minimum == 0.5
    assert held.applies_to == frozenset({"navigate_to", "transport_object"})
    wider, _ = made("personal-care", clearance_m="0.2")
    assert "personal-care/clearance" in wider.rules


@pytest.mark.parametrize(
    "row",
    [
        "for_ms: 0\n    response: {enter: continue}",
        "for_ms: 0\n    response: {enter: rollback}",  # it would drive back, whoever stands there
        "for_ms: 3000\n    response: {enter: pause}",
    ],
)
def test_a_protective_distance_is_paused_below_at_once_whatever_the_model_does_there(row: str):
    file, policy = "profiles/human-shared.yaml", shipped()
    held = "clear_after_ms: 1000, clear_beyond: 0.05, then: resume, persist_ms: 5000, else: escalate"
    held = f"for_ms: 0\n    response: {{enter: pause, {held}}}"
    assert held in policy.files[file]
    model = bundle.load_files({**policy.files, file: policy.files[file].replace(held, row, 1)})
    name = "speed-and-separation"
    rows = [one for one in made(name, model=model)[0].profiles[name].watch if one.signal == "separation_m"]
    assert ("pause", 0) in {(one.response.enter.value.lower(), one.for_ms) for one in rows}
    (alone,) = (one for one in made(name)[0].profiles[name].watch if one.signal == "separation_m")
    assert alone.id == "separation"


def test_who_oversees_is_asked_told_and_may_take_over():
    policy, _ = made("human-oversight", risks="critical,low")
    profile = policy.profiles["human-oversight"]
    assert sorted(profile.authority) == ["approval-required", "interrupt-enabled", "review-only", "takeover-enabled"]
    assert profile.approval is not None
    assert sorted(profile.approval.risks) == ["critical", "low"]
    assert profile.approval.within_s == 60
    assert profile.keep_every_tick


def test_who_oversees_is_as_many_as_in_the_model_and_reviews_what_is_reviewed_there():
    file, policy = "profiles/human-shared.yaml", shipped()
    assert "approvers: {default: 1, critical: 2}" in policy.files[file]
    text = policy.files[file].replace(
        "approvers: {default: 1, critical: 2}", "approvers: {default: 2, high: 3, low: 1}"
    )
    text = text.replace(
        "  modes: [approval-required,",
        "  review: {risk: [high, low], outcomes: [fault]}\n  modes: [review-only, approval-required,",
    )
    model = bundle.load_files({**policy.files, file: text})
    profile = made("human-oversight", model=model, risks="low,high,critical")[0].profiles["human-oversight"]
    assert profile.approval is not None
    assert profile.review is not None
    asked = {risk.value: profile.approval.approvers.get(risk, profile.approval.default_approvers) for risk in Risk}
    assert asked == {"low": 1, "medium": 2, "high": 3, "critical": 2}
    assert profile.review.risks == {Risk.LOW, Risk.HIGH}
    assert len(profile.review.outcomes) == 5


def test_a_speed_beyond_what_a_contact_bears_is_lowered_and_said():
    said = answers("force-limited", tcp_speed_mps="3")
    assert TEMPLATES["force-limited"].draft(said).limits["tcp_speed_mps"].most < 1.3
    assert "lowered" in TEMPLATES["force-limited"].warn(said)
    assert "lowered" not in TEMPLATES["force-limited"].warn(answers("force-limited"))


def test_a_base_touches_no_faster_than_an_arm_does():
    name, leg = "force-limited", {"body_regions": "lower-leg", "moving_mass_kg": "40", "base_speed_mps": "0.3"}
    said = answers(name, **leg)
    bears_mps = contact_speed_mps(["lower-leg"], moving_kg=40.0, load_kg=3.0)
    assert 0.2 < bears_mps < 0.3
    assert made(name, **leg)[0].profiles[name].limits["base_speed_mps"].maximum <= bears_mps
    assert "lowered to it: base_speed_mps" in TEMPLATES[name].warn(said)
    assert "arm and base together come to 0.45 m/s" in TEMPLATES[name].warn(said)
    assert "together" not in TEMPLATES[name].warn(answers(name, tcp_speed_mps="0.1", base_speed_mps="0.1"))


def test_what_is_carried_and_the_tool_count_in_a_contact_together():
    said = {"body_regions": "chest", "moving_mass_kg": "40", "tool_kg": "5", "payload_kg": "4", "tcp_speed_mps": "3"}
    limits = made("force-limited", **said)[0].profiles["force-limited"].limits
    heaviest_kg = 5.0 + limits["payload_kg"].maximum  # whatever is lighter is carried
    assert limits["payload_kg"].maximum == 4.0
    assert limits["tcp_speed_mps"].maximum <= contact_speed_mps(["chest"], moving_kg=40.0, load_kg=heaviest_kg)


def test_arm_and_base_that_add_up_to_more_than_reduced_speed_are_told_of():
    assert "0.45 m/s" in TEMPLATES["reduced-speed"].warn(answers("reduced-speed"))
    assert TEMPLATES["reduced-speed"].warn(answers("reduced-speed", tcp_speed_mps="0.1", base_speed_mps="0.1")) == ""


def test_the_strictest_comes_first_in_the_order_that_is_proved():
    _, changed = made("reduced-speed", strictest="yes")
    order = parse("properties.yaml", changed["properties.yaml"])[0].value
    assert order["order"][:2] == ["reduced-speed", "human-shared"]  # type: ignore[index, call-overload]


def test_a_profile_there_is_already_is_not_made_again():
    with pytest.raises(PolicyErrors, match="a profile `sim-relaxed` already"):
        made("reduced-speed", profile="sim-relaxed")


def test_a_file_that_is_all_one_flow_is_no_model():
    with pytest.raises(PolicyErrors, match="beginnings of lines"):
        Sections("profiles/a.yaml", "{profile: a, limits: {}}\n")


def test_items_are_added_and_taken_out_of_lists_however_they_are_written():
    sections = Sections(
        "a.yaml",
        "# head\n# of a\na: [{x: 1}]\n\nb:   # these\n  - x: 1\n  - x: 2\n    y: 3\n  - x: 4\nc: []\ne:\n- x: 0\n",
    )
    sections.append("a", [{"x": "two words"}])
    sections.drop("b", lambda item: item["x"] == 2)
    sections.append("b", [{"x": 0.5, "y": [True, None, "true"]}])
    sections.append("d", [{"x": 1.0}])
    sections.append("e", [{"x": 1, "y": 2}])
    sections.drop("c", lambda item: True)
    sections.drop("none", lambda item: True)
    assert parse("a.yaml", sections.text())[0].value == {
        "a": [{"x": 1}, {"x": "two words"}],
        "b": [{"x": 1}, {"x": 4}, {"x": 0.5, "y": [True, None, "true"]}],
        "c": [],
        "d": [{"x": 1}],
        "e": [{"x": 0}, {"x": 1, "y": 2}],
    }
    sections.drop("b", lambda item: True)
    assert parse("a.yaml", sections.text())[0].value["b"] == []  # type: ignore[index, call-overload]
    assert "# head\n# of a\n" in sections.text()


@pytest.mark.parametrize(
    ("question", "said", "valid"),
    [
        (Number(key="q", asks="", why="", most=0.25), "0.3", "at most 0.25"),
        (Number(key="q", asks="", why=""), "0", "above 0"),
        (Number(key="q", asks="", why="", least=1.6), "1.5", "at least 1.6"),
        (Number(key="q", asks="", why=""), "nan", "a number"),
        (Number(key="q", asks="", why=""), "fast", "a number"),
        (Words(key="q", asks="", why="", slug=True), "Hall 2", "hyphens"),
        (Words(key="q", asks="", why=""), "one\ntwo", "one line"),
        (Words(key="q", asks="", why=""), "  ", "one line"),
        (Choice(key="q", asks="", why="", among=("a", "b")), "a,b", "one of a, b"),
        (Choice(key="q", asks="", why="", among=("a", "b"), several=True), "a,c", "some of a, b"),
        (Choice(key="q", asks="", why="", among=("a", "b"), several=True), "", "some of a, b"),
        (YesNo(key="q", asks="", why=""), "perhaps", "yes or no"),
    ],
)
def test_an_answer_that_cannot_be_is_told_what_would_be_valid(question, said, valid):
    with pytest.raises(AnswerError, match=valid) as caught:
        question.read(said)
    assert caught.value.key == "q"


def test_a_kind_of_question_that_does_not_read_its_answers_cannot_be_asked():
    with pytest.raises(TypeError, match="abstract"):
        Question(key="q", asks="", why="")  # type: ignore[abstract]
