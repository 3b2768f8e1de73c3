from __future__ import annotations

import pytest

from app.authoring.explain import NotEnabled, explain
from app.authoring.sentences import sentence
from app.governance import bundle
from app.governance.vocabulary import Vocabulary
from tests.governance.policy_world import files, shipped


def said(capability, profile, policy=None):
    return {section.heading: section.sentences for section in explain(policy or shipped(), capability, profile)}


def test_a_rule_is_said_with_its_condition_bound_and_reason():
    rules = said("grasp_object", "human-shared")["Rules"]
    assert (
        "If the object is fragile, `force_n` is lowered to at most 20 N and `speed_mps` is lowered to at most "
        "0.15 m/s. Fragile things break above 20 N. (human-shared/fragile-grip)"
    ) in rules
    assert any("more than 80 % of the payload limit (2.4 kg) and" in rule for rule in rules)


def test_what_the_pair_decides_is_not_asked_again():
    rules = " ".join(said("operate_tool", "human-shared")["Rules"])
    assert "If the tool is a press, a human decides, and 2 people have to agree" in rules
    assert "press-two-approvers" not in " ".join(
        said("operate_tool", "real-restricted")["Rules"]
    )  # it never holds there
    assert "low-confidence" not in " ".join(said("navigate_to", "real-restricted")["Rules"])


def test_limits_are_said_with_their_value_and_source():
    assert (
        "`speed_mps` is lowered to at most 0.25 m/s, the limit `tcp_speed_mps` here (ISO 10218-2:2025, reduced speed)."
    ) in said("grasp_object", "human-shared")["Parameters and limits"]


def test_people_are_said_as_authority_has_them():
    assert said("grasp_object", "human-shared")["Humans"][0].startswith("Before it is launched one person approves")
    assert "unless a rule escalates it" in said("grasp_object", "real-restricted")["Humans"][0]
    assert "Nobody is asked" in said("grasp_object", "sim-relaxed")["Humans"][0]
    assert "before a recovery" in said("retrace", "human-shared")["Humans"][0]


def test_every_enabled_pair_can_be_explained():
    for pair in shipped().gates:
        assert len(said(*pair)) == 7, pair


def test_a_rule_that_changes_is_explained_as_changed():
    policy = bundle.load_files({
        **files(), "organization.yaml": files()["organization.yaml"].replace("confidence < 0.5", "confidence < 0.7")
    })  # fmt: skip
    assert any("less than 0.7" in rule for rule in said("grasp_object", "human-shared", policy)["Rules"])


@pytest.mark.parametrize(
    ("capability", "profile", "message"),
    [("fly", "human-shared", "no capability `fly`"), ("retrace", "moon", "no profile `moon`")],
)
def test_what_does_not_exist_is_named_with_what_does(capability, profile, message):
    with pytest.raises(NotEnabled, match=message):
        explain(shipped(), capability, profile)


def test_what_is_not_enabled_says_where_it_is():
    name = "capabilities/inspect_area.yaml"
    policy = bundle.load_files(
        {**files(), name: files()[name].replace("human-shared: allowed", "human-shared: forbidden")}
    )
    with pytest.raises(NotEnabled, match="not enabled in `human-shared`; valid: `real-restricted`"):
        explain(policy, "inspect_area", "human-shared")


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("!(target.fragile || target.hazardous)", "the object is not fragile and the object is not hazardous"),
        ("target.fragile || (target.hazardous && tool.press)",
         "the object is fragile or (the object is hazardous and the tool is a press)"),
        ("target.fragile && !(target.hazardous && tool.press)",
         "the object is fragile and (the object is not hazardous or the tool is no press)"),
        ('agent.permissions.exists(p, p == "hazmat") && tool.press',
         "(some `p` of the agent's permissions: `p` is `hazmat`) and the tool is a press"),
        ("target.mass_kg - (limits.payload_kg - target.mass_kg) > 1.0",
         "the object's mass minus (the payload limit minus the object's mass) is more than 1 kg"),
        ("0.5 * (target.mass_kg + limits.payload_kg) > 1.0",
         "50 % of (the object's mass plus the payload limit) is more than 1 kg"),
        ("params.force_n * params.speed_mps > 10.0", "`force_n` times `speed_mps` is more than 10"),
        ('mode == "careful"', "the mode is `careful`"),
        ('!(capability.risk in ["low", "medium"])', "the risk is not `low` or `medium`"),
        ('agent.permissions.exists(p, p == "hazmat")', "some `p` of the agent's permissions: `p` is `hazmat`"),
        ('world.people_nearest_m < (operator_on_duty ? 1.0 : 2.0)',
         "the distance to the nearest person is less than 1 m where an operator is on duty, else 2 m"),
        ("!has(metadata.confidence)", "no confidence is stated"),
        ('tool.name.startsWith("p")', "the tool begins with `p`"),
        ("size(agent.permissions) > 2", "the number of the agent's permissions is more than 2"),
    ],
)  # fmt: skip
def test_conditions_read_as_sentences(source, words):
    capability = shipped().capabilities["operate_tool"]
    assert sentence(Vocabulary({"operate_tool": capability}).typed(source, "operate_tool"), {}) == words
