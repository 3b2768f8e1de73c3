"""Faults planted in the shipped policy, each of which must be found, and changes that are none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache

import pytest
import z3

from app.governance import bundle, cases
from app.proofs.findings import Kind, Weight
from app.proofs.prove import Report
from app.proofs.space import Space
from tests.governance.policy_world import files
from tests.proofs.planted import HUMAN, ORGANIZATION, REAL, SIM, edited, promises, proved, proved_of, with_rules


@dataclass(frozen=True)
class Plant:
    name: str
    changed: dict[str, str]
    kind: Kind
    rule: str = ""
    capability: str = ""
    properties: str | None = None
    also: frozenset[Kind] = field(default_factory=frozenset)  # what follows from it


def rule(text: str, file: str = ORGANIZATION) -> dict[str, str]:
    return with_rules(f"  - {{{text}, because: So.}}", file)


PLANTS = [
    # contradictions
    Plant("a bound below and one above it", with_rules("""
  - {id: firm, applies_to: [grasp_object], when: target.mass_kg > 0.3, then: modify, set: {force_n: {min: 30}}, because: So.}
  - {id: soft, applies_to: [grasp_object], when: 'target.kind == "mug"', then: modify, set: {force_n: {max: 25}}, because: So.}
"""), Kind.CONTRADICTION, "organization/soft"),
    Plant("a bound above the limit of one profile",
          rule("id: firm, applies_to: [grasp_object], when: target.mass_kg > 0.3, then: modify, set: {force_n: {min: 70}}"),
          Kind.CONTRADICTION, "human-shared/grip_force_n", also=frozenset({Kind.ORDER})),
    Plant("a bound that only a rare object meets",
          rule("id: firm, applies_to: [grasp_object], when: target.fragile, then: modify, set: {force_n: {min: 20.5}}"),
          Kind.CONTRADICTION, also=frozenset({Kind.DEAD, Kind.SHADOWED})),
    Plant("two names at once", rule(
        "id: other-way, applies_to: [navigate_to], profiles: [real-restricted], when: 'params.speed_mps > 0.55 && has(params.target) && params.target == \"shelf_stand\"', "
        "then: modify, set: {corridor: {to: '\"byway\"'}}") | edited("site.yaml", "corridors:\n", "corridors:\n  byway: {line: [[1.0, 1.0], [2.0, 2.0]], half_width_m: 0.5}\n"),
        Kind.CONTRADICTION, also=frozenset({Kind.ORDER, Kind.PROPERTY, Kind.IDEMPOTENCE, Kind.DEAD, Kind.SHADOWED})),
    Plant("a bound that a number of the proposal brings about", with_rules("""
  - {id: quick, applies_to: [place_object], when: params.speed_mps > 1.2, then: modify, set: {speed_mps: {min: 0.3}}, because: So.}
"""), Kind.CONTRADICTION, also=frozenset({Kind.DEAD, Kind.SHADOWED, Kind.IDEMPOTENCE, Kind.ORDER, Kind.PROPERTY})),
    # gaps
    Plant("everything is denied", rule("id: closed, applies_to: [inspect_area], then: deny"), Kind.COVERAGE,
          capability="inspect_area", also=frozenset({Kind.SHADOWED})),
    Plant("everything is asked about where nobody is asked",
          rule("id: ask, applies_to: [inspect_area], profiles: [sim-relaxed], then: escalate"), Kind.COVERAGE,
          capability="inspect_area", also=frozenset({Kind.ORDER})),
    Plant("the denials leave no room between them", with_rules("""
  - {id: slow, applies_to: [inspect_area], when: params.dwell_s < 3.0, then: deny, because: So.}
  - {id: long, applies_to: [inspect_area], when: params.dwell_s >= 2.5, then: deny, because: So.}
"""), Kind.COVERAGE, capability="inspect_area"),
    Plant("a point that may be half given", edited(
        "capabilities/place_object.yaml", "  dependentRequired: {x_m: [y_m], y_m: [x_m]}\n", ""),
        Kind.COVERAGE, capability="place_object", also=frozenset({Kind.PROPERTY})),
    Plant("a place that may not be named at all", edited(
        "capabilities/navigate_to.yaml", "  oneOf:\n    - {required: [target], properties: {x_m: false, y_m: false, yaw_rad: false}}\n    - {required: [x_m, y_m, yaw_rad], properties: {target: false}}\n", ""),
        Kind.COVERAGE, capability="navigate_to"),
    # dead and shadowed rules
    Plant("no object is that heavy", rule("id: huge, applies_to: [grasp_object], when: target.mass_kg > 50.0, then: deny"),
          Kind.DEAD, "organization/huge"),
    Plant("a condition against itself",
          rule("id: never, applies_to: [navigate_to], when: params.speed_mps > 1.0 && params.speed_mps < 0.5, then: deny"),
          Kind.DEAD, "organization/never"),
    Plant("a number beyond its own range",
          rule("id: never, applies_to: [inspect_area], when: params.dwell_s > 10.0, then: escalate"), Kind.DEAD, "organization/never"),
    Plant("a text that no object has",
          rule("id: never, applies_to: [grasp_object], when: 'target.kind.startsWith(\"mu\") && target.kind.endsWith(\"tle\")', then: deny"),
          Kind.DEAD, "organization/never"),
    Plant("a profile it can never be in",
          rule("id: never, profiles: [sim-relaxed], when: profile.shared_floor, then: deny"), Kind.DEAD, "organization/never"),
    Plant("it sets nothing where it applies", rule(
        "id: never, applies_to: [grasp_object, inspect_area], when: 'capability.name == \"inspect_area\"', then: modify, set: {force_n: {max: 10}}"),
        Kind.DEAD, "organization/never"),
    Plant("a denial inside another", with_rules("""
  - {id: less, applies_to: [inspect_area], when: params.dwell_s > 9.0, then: deny, because: So.}
  - {id: more, applies_to: [inspect_area], when: params.dwell_s > 8.0, then: deny, because: So.}
"""), Kind.SHADOWED, "organization/less"),
    Plant("an escalation of what is denied",
          rule("id: ask, applies_to: [grasp_object], when: target.mass_kg > limits.payload_kg + limits.payload_kg * 0.1, then: escalate"),
          Kind.SHADOWED, "organization/ask"),
    Plant("a looser bound under the same condition",
          rule("id: looser, applies_to: [grasp_object, regrasp], when: target.fragile, then: modify, set: {force_n: {max: 25}}"),
          Kind.SHADOWED, "organization/looser"),
    Plant("a bound at a profile's own limit",
          rule("id: same, applies_to: [grasp_object], then: modify, set: {force_n: {max: 60}}", HUMAN), Kind.SHADOWED, "human-shared/same"),
    Plant("the same rule twice in one file",
          rule("id: again, when: place.forbidden, then: deny"), Kind.SHADOWED, "organization/forbidden-zone"),
    # errors
    Plant("a field that may be missing",
          rule("id: doubt, when: metadata.confidence < 0.2, then: escalate"), Kind.ERROR, "organization/doubt",
          also=frozenset({Kind.PROPERTY, Kind.ORDER, Kind.SHADOWED})),
    Plant("a parameter that may be missing",
          rule("id: far, applies_to: [navigate_to], when: params.x_m > 7.5, then: escalate"), Kind.ERROR, "organization/far",
          also=frozenset({Kind.ORDER})),
    Plant("a division by zero",
          rule("id: ratio, applies_to: [inspect_area], when: 1.0 / (params.dwell_s * params.dwell_s - 4.0) > 0.5, then: escalate"),
          Kind.ERROR, "organization/ratio"),
    Plant("a remainder by zero",
          rule("id: odd, when: 10 % world.people_count == 1, then: escalate"), Kind.ERROR, "organization/odd",
          also=frozenset({Kind.PROPERTY, Kind.ORDER})),
    Plant("an overflow",
          rule("id: rank, when: has(metadata.priority) && metadata.priority * 2 > 100, then: escalate"), Kind.ERROR, "organization/rank",
          also=frozenset({Kind.ORDER})),
    Plant("an index outside the list",
          rule("id: first, when: '[\"a\", \"b\"][world.people_count] == \"a\"', then: escalate"), Kind.ERROR, "organization/first",
          also=frozenset({Kind.ORDER})),
    Plant("a name that is not there",
          edited(REAL, "    when: has(place.corridor)\n", ""), Kind.ERROR, "real-restricted/corridor",
          also=frozenset({Kind.ORDER, Kind.DEAD, Kind.SHADOWED})),
    Plant("a name the site does not have",
          rule("id: way, applies_to: [navigate_to], when: 'has(metadata.intent) && metadata.intent.startsWith(\"by \")', then: modify, set: {corridor: {to: metadata.intent}}"),
          Kind.ERROR, "organization/way", also=frozenset({Kind.DEAD, Kind.SHADOWED, Kind.ORDER, Kind.PROPERTY, Kind.CONTRADICTION})),
    Plant("the gripper's holding may be nothing",
          rule("id: held, when: 'world.holding == \"glass_1\"', then: escalate"), Kind.ERROR, "organization/held",
          also=frozenset({Kind.PROPERTY, Kind.ORDER})),
    # what is constrained does not re-check
    Plant("a bound that begins to hold by another", with_rules("""
  - {id: weakly, applies_to: [grasp_object], when: 'target.name == "mug_1"', then: modify, set: {force_n: {max: 25}}, because: So.}
  - {id: gently, applies_to: [grasp_object], when: params.force_n < 30.0, then: modify, set: {speed_mps: {max: 0.05}}, because: So.}
"""), Kind.IDEMPOTENCE, "organization/gently"),
    Plant("a limit makes a rule deny",
          rule("id: slow, applies_to: [navigate_to], when: params.speed_mps <= 0.3 && params.clearance_m > 0.9, then: deny"),
          Kind.IDEMPOTENCE, "organization/slow", also=frozenset({Kind.ORDER})),
    # the order of profiles
    Plant("a limit wider than the next profile's", edited(HUMAN, "tcp_speed_mps: {max: 0.25", "tcp_speed_mps: {max: 0.55"),
          Kind.ORDER, "human-shared/tcp_speed_mps", also=frozenset({Kind.PROPERTY})),
    Plant("a limit that no parameter names", edited(HUMAN, "contact_force_n: {max: 100", "contact_force_n: {max: 160"),
          Kind.ORDER, "human-shared/contact_force_n"),
    Plant("the payload of the stricter", edited(HUMAN, "payload_kg: {max: 3,", "payload_kg: {max: 4.2,"), Kind.ORDER, "human-shared/payload_kg",
          also=frozenset({Kind.DEAD})),
    Plant("a rule the stricter profile has lost", edited(HUMAN, "set: {clearance_m: {min: 0.3}}", "set: {clearance_m: {min: 0.25}}"),
          Kind.ORDER, capability="navigate_to", also=frozenset({Kind.PROPERTY})),
    Plant("a rule that only a wider profile has",
          rule("id: extra, applies_to: [inspect_area], when: params.dwell_s > 9.5, then: deny", SIM), Kind.ORDER, capability="inspect_area"),
    Plant("enabled in the stricter, forbidden in the wider", edited(
        "capabilities/operate_tool.yaml", "real-restricted: guarded", "real-restricted: forbidden"), Kind.ORDER, capability="operate_tool",
        also=frozenset({Kind.DEAD})),
    Plant("sensitivity the wrong way round", edited(REAL, "sensitivity: 0.7", "sensitivity: 0.95"), Kind.ORDER),
    Plant("more retries where it is stricter", edited(HUMAN, "retry_budget: 1", "retry_budget: 4"), Kind.ORDER),
    Plant("fewer people asked where it is stricter", edited(REAL, "approvers: {default: 1,", "approvers: {default: 2,"), Kind.ORDER, capability="grasp_object"),
    Plant("a later alarm where it is stricter", edited(HUMAN, "above: 0.012", "above: 0.016"), Kind.ORDER),
    # stated properties
    Plant("the rule behind a promise is gone", edited(ORGANIZATION, "when: target.hazardous && !(\"hazmat\" in agent.permissions)",
          "when: target.hazardous && !(\"hazmat\" in agent.permissions) && target.mass_kg > 1.0"), Kind.PROPERTY, "hazardous-needs-hazmat",
          also=frozenset({Kind.DEAD})),
    Plant("a subtly looser bound", edited(ORGANIZATION, "speed_mps: {max: 0.15}", "speed_mps: {max: 0.16}"), Kind.PROPERTY, "fragile-speed"),
    Plant("less or equal became less", edited(ORGANIZATION, "when: target.mass_kg > limits.payload_kg\n", "when: target.mass_kg > limits.payload_kg + 0.6\n".replace("+ 0.6", "* 1.2")),
          Kind.PROPERTY, "payload", also=frozenset({Kind.ORDER, Kind.DEAD})),
    Plant("one approver for the press", edited(ORGANIZATION, "    approvers: 2\n", ""), Kind.PROPERTY, "press-takes-two"),
    Plant("a risk that is asked about no longer", edited(HUMAN, "risk: [medium, high, critical], within_s", "risk: [critical], within_s")
          | edited("capabilities/grasp_object.yaml", "human-shared: approval-required", "human-shared: guarded"),
          Kind.PROPERTY, "high-risk-passes-a-human", "grasp_object"),
    Plant("the doubt's threshold moved", edited(ORGANIZATION, "metadata.confidence < 0.5 &&", "metadata.confidence < 0.49 &&"),
          Kind.PROPERTY, "unsure-passes-a-human"),
]  # fmt: skip


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.name)
def test_a_planted_fault_is_found(plant: Plant):
    policy = bundle.load_files({**files(), **plant.changed})
    report = proved_of(policy, plant.properties)
    found = [
        finding
        for finding in report.faults
        if finding.kind is plant.kind
        and plant.rule in ("", finding.rule)
        and plant.capability in ("", finding.capability)
    ]
    assert found, [(f.kind.value, f.rule, f.capability, f.message) for f in report.faults]
    assert {finding.weight for finding in report.faults} == {Weight.REFUTED}, [f.message for f in report.faults]
    assert {finding.kind for finding in report.faults} <= {plant.kind, *plant.also}, [
        (f.kind.value, f.message) for f in report.faults if f.kind not in (plant.kind, *plant.also)
    ]
    for finding in report.faults:  # what is shown, anybody can run
        for result in cases.run(policy, {"tests/x.yaml": finding.example}) if finding.example else ():
            assert result.differences == ()
    assert all(finding.line > 0 and finding.file in {*files(), "properties.yaml"} for finding in found)


def test_a_contradiction_is_shown_by_a_proposal_that_nothing_else_denies() -> None:
    condition = "when: '!target.fragile && target.mass_kg > 0.3'"  # the hazardous solvent as well
    planted = rule(
        f"id: firm, applies_to: [grasp_object], {condition}, then: modify, set: {{speed_mps: {{min: 0.26}}}}", HUMAN
    )
    (found,) = proved(planted).faults
    assert found.kind is Kind.CONTRADICTION
    assert "- hazardous" not in found.example
    assert "- empty_intersection" in found.example


@pytest.fixture
def solver_seed(request: pytest.FixtureRequest) -> Iterator[None]:
    """Let the solver look elsewhere first: what it shows, of all that there is, is another thing."""
    z3.set_param("smt.random_seed", request.param)
    yield
    z3.set_param("smt.random_seed", 0)


@pytest.mark.usefixtures("solver_seed")
@pytest.mark.parametrize("solver_seed", [0, 17, 35], indirect=True)
def test_that_fewer_people_are_asked_is_shown_by_a_proposal_that_is_launched() -> None:
    turned = promises().replace("[human-shared, real-restricted", "[real-restricted, human-shared")
    found = [fault for fault in proved({}, turned).faults if "is approved by 1 in human-shared" in fault.message]
    assert found
    assert [fault for fault in found if "status: allowed" not in fault.example] == []


def test_a_case_made_small_still_shows_that_fewer_people_are_asked_by_authority() -> None:
    turned = promises().replace("[human-shared, real-restricted", "[real-restricted, human-shared")
    narrow = 'params.tool != "press" || params.speed_mps < 0.1234 || params.speed_mps > 0.1235'
    asks = rule(f"id: narrow, applies_to: [operate_tool], when: '{narrow}', then: escalate", REAL)
    found = [
        fault
        for fault in proved(asks, turned).faults
        if "`operate_tool` is approved by 1 in human-shared" in fault.message
    ]
    assert found
    assert all(
        "status: allowed" in fault.example for fault in found
    )  # a shorter speed asks one, where the other asks two


SOUND: list[tuple[str, dict[str, str]]] = [
    ("a tighter limit", edited(HUMAN, "tcp_speed_mps: {max: 0.25", "tcp_speed_mps: {max: 0.2")),
    ("a rule about an agent that may come", rule("id: hazmat-asks, applies_to: [grasp_object], when: 'target.hazardous && \"hazmat\" in agent.permissions', then: escalate")),
    ("a field asked for first", rule("id: doubt, when: has(metadata.confidence) && metadata.confidence < 0.1, then: deny")),
    ("a division that cannot be by zero", rule("id: ratio, applies_to: [inspect_area], when: 10.0 / params.dwell_s > 40.0, then: deny")),
    ("rules that only touch", with_rules("""
  - {id: at-least, applies_to: [navigate_to], then: modify, set: {clearance_m: {min: 0.15}}, because: So.}
  - {id: at-most, applies_to: [navigate_to, transport_object], when: 'world.people_count == 0', then: modify, set: {clearance_m: {max: 0.9}}, because: So.}
""")),
    ("a mode that only the wider profiles admit", {
        HUMAN: files()[HUMAN].replace("modes: [normal, careful]", "modes: [normal]").replace("safer_mode, ", "")}),
    ("an earlier alarm where it is stricter", edited(HUMAN, "above: 0.012", "above: 0.011")),
    ("people are near", rule("id: near, applies_to: [inspect_area], when: world.people_count > 0 && world.people_nearest_m < 0.5, then: deny")),
    ("a text of any alphabet", rule("id: snow, when: 'has(metadata.intent) && metadata.intent.startsWith(\"größer ☃ 🤖\")', then: escalate")),
    ("a text with what the solver takes for an escape", rule("id: odd, when: 'has(metadata.intent) && metadata.intent == \"\\\\u{41}\"', then: escalate")),
    ("the same in another owner's words", rule("id: fragile-grip, applies_to: [grasp_object], when: target.fragile, then: modify, set: {force_n: {max: 20}, speed_mps: {max: 0.15}}", REAL)),
]  # fmt: skip


@cache
def as_shipped() -> Report:
    return proved({})


def test_what_is_shipped_passes():
    assert [(f.kind.value, f.rule, f.message, f.example) for f in as_shipped().faults] == []


@pytest.mark.parametrize("changed", [changed for _, changed in SOUND], ids=[name for name, _ in SOUND])
def test_what_is_sound_passes(changed: dict[str, str]):
    assert [(f.kind.value, f.rule, f.message, f.example) for f in proved(changed).faults] == []


def test_a_character_that_the_solver_does_not_know_leaves_a_rule_undecided() -> None:
    odd = rule("id: odd, when: 'has(metadata.intent) && metadata.intent == \"\U000f0000\"', then: escalate")
    found = [fault for fault in proved(odd).faults if fault.rule == "organization/odd"]
    assert found
    assert {fault.weight for fault in found} == {Weight.UNDECIDED}


def test_a_fault_is_shown_in_a_profile_that_is_called_as_a_mode_is() -> None:
    planted = rule("id: odd, applies_to: [navigate_to], when: 10 % world.people_count == 1, then: deny")
    named = {
        file.replace("sim-relaxed", "normal"): text.replace("sim-relaxed", "normal")
        for file, text in {**files(), **planted}.items()
    }
    report = proved_of(bundle.load_files(named), "properties: []\n")
    (shown,) = (one for one in report.faults if one.kind is Kind.ERROR and one.profile == "normal")
    assert "profile: normal" in shown.example


def test_a_promise_about_nothing_is_named() -> None:
    idle = "  - {id: idle, says: So., when: target.mass_kg > 50.0, never: [allowed]}\n"
    report = proved({}, promises().replace("properties:\n", f"properties:\n{idle}"))
    assert not report.faults
    assert report.idle == ["idle"]
    assert [(f.kind, f.weight, f.rule) for f in report.findings if f.kind is Kind.PROPERTY] == [
        (Kind.PROPERTY, Weight.NOTE, "idle")
    ]
    assert report.summary().endswith("about nothing that can be proposed: `idle`")
    assert "about nothing" not in as_shipped().summary()


def test_a_value_that_a_schema_lists_twice_is_proved_like_any_other() -> None:
    file = "capabilities/navigate_to.yaml"
    gait = "    gait: {type: string, enum: [slow, fast, fast], default: slow}\n    corridor: {type"
    slow = '  - {id: slow, says: So., applies_to: [navigate_to], always: params.gait == "slow"}\n'
    report = proved(edited(file, "    corridor: {type", gait), f"properties:\n{slow}")
    assert {(fault.kind, fault.rule) for fault in report.faults} == {(Kind.PROPERTY, "slow")}


@pytest.mark.parametrize("name", ["third", "another-agent"])
def test_an_agent_is_proved_about_whatever_it_is_called(name: str) -> None:
    slow = f'id: slow, applies_to: [navigate_to], when: \'!(agent.name in ["planner", "{name}"])\', then: deny'
    planted = rule(slow)
    declared = f"  {name}: {{permissions: [navigation]}}\n  planner: {{"
    planted[ORGANIZATION] = planted[ORGANIZATION].replace("  planner: {", declared, 1)
    only = '  - {id: only, says: So., applies_to: [navigate_to], when: agent.name != "planner", never: [allowed]}\n'
    report = proved(planted, f"properties:\n{only}")
    assert {(fault.kind, fault.rule) for fault in report.faults} == {(Kind.PROPERTY, "only")}
    assert all(f"agent: {name}" in fault.example for fault in report.faults)


def test_what_no_proposal_has_is_no_fault_of_the_encoding() -> None:
    gait = "    gait: {type: string, enum: [slow, fast], maxLength: 4, not: {const: fast}, default: slow}\n"
    gait += "    lane: {type: string, enum: [left, middle], maxLength: 4, default: left}\n    corridor: {type"
    planted = edited("capabilities/navigate_to.yaml", "    corridor: {type", gait) | with_rules("""
  - {id: fast, applies_to: [navigate_to], when: 'params.gait == "fast"', then: deny, because: So.}
  - {id: middle, applies_to: [navigate_to], when: 'params.lane == "middle"', then: deny, because: So.}
  - {id: nobody, applies_to: [navigate_to], when: 'agent.name == ""', then: deny, because: So.}
""")
    found = {fault.rule: (fault.kind, fault.weight) for fault in proved(planted, "order: []\n").faults}
    assert found == {
        "organization/fast": (Kind.DEAD, Weight.UNDECIDED),
        "organization/middle": (Kind.DEAD, Weight.REFUTED),
        "organization/nobody": (Kind.DEAD, Weight.REFUTED),
    }


def test_what_an_earlier_release_let_a_schema_list_is_left_out() -> None:
    """A version that was in force once is compared with what comes after it, whatever stands in its lists."""
    file = "capabilities/grasp_object.yaml"
    text = edited(file, "x-ref: object", "x-ref: object, enum: [mug_1, 3, [box_1]]")[file]
    text = text.replace("unit: N,", "unit: N, enum: [40, 20, true, few],").replace(
        "  properties:\n", "  properties:\n    wet: {type: boolean, const: never}\n"
    )
    policy = bundle.load_kept({**files(), file: text})
    space = Space(policy, policy.capabilities["grasp_object"])
    assert [name for _, name in space.params["object_id"].value.cases] == ["mug_1"]
