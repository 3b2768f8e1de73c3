"""What changes is found, shown by a case that both real policies confirm, and never called a tightening that is not."""

from __future__ import annotations

import json
import re
from functools import cache
from random import Random
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from app.api.wire import CheckBody
from app.cli import app
from app.governance import bundle, cases
from app.governance.changes import Comparison, Direction
from app.proofs.difference import difference
from app.proofs.joint import told
from app.proofs.witness import decided
from tests.governance.policy_world import POLICIES, files
from tests.proofs.planted import standing
from tests.proofs.random_rules import compiled, drawn, proposed

SAME, TIGHTENS, LOOSENS, BOTH = Direction.SAME, Direction.TIGHTENS, Direction.LOOSENS, Direction.BOTH
ORGANIZATION, HUMAN, REAL, SITE = (
    "organization.yaml", "profiles/human-shared.yaml", "profiles/real-restricted.yaml", "site.yaml",
)  # fmt: skip
GRASP, NAVIGATE = "capabilities/grasp_object.yaml", "capabilities/navigate_to.yaml"
Edit = tuple[str, str, str]


@cache
def loaded(*edits: Edit) -> Any:
    changed = files()
    for name, before, after in edits:
        found = re.sub(before, after, changed[name], count=1, flags=re.DOTALL)
        assert found != changed[name], (name, before)
        changed[name] = found
    return bundle.load_files(changed)


@cache
def compared(*edits: Edit, back: bool = False) -> Comparison:
    policies = [loaded(), loaded(*edits)]
    old, new = reversed(policies) if back else policies
    return difference(old, new, now=standing)


def changes(found: Comparison) -> set[tuple[str, str, str]]:
    return {(one.capability, one.profile, one.change) for one in found.decisions}


# Planted loosenings: what is changed, the way back, and one decision that has to be among those found.
PLANTED: dict[str, tuple[Edit, Direction, tuple[str, str, str] | None]] = {
    "a bound raised in one profile": (
        (HUMAN, r"clearance_m: \{min: 0.3\}", "clearance_m: {min: 0.25}"), TIGHTENS, ("navigate_to", "human-shared", "looser clearance_m")),
    "a bound raised by the least there is": (
        (ORGANIZATION, r"speed_mps: \{max: 0.15\}", "speed_mps: {max: 0.15000000000000002}"), TIGHTENS,
        ("grasp_object", "sim-relaxed", "looser speed_mps")),
    "a limit raised": (
        (REAL, r"grip_force_n: \{max: 80", "grip_force_n: {max: 81"), TIGHTENS, ("grasp_object", "real-restricted", "looser force_n")),
    "a condition narrowed": (
        (ORGANIZATION, "when: target.hazardous &&", "when: target.hazardous && target.mass_kg > 1.0 &&"), TIGHTENS,
        ("grasp_object", "sim-relaxed", "deny -> allow")),
    "a condition turned by a factor": (
        (ORGANIZATION, "target.mass_kg > limits.payload_kg\n", "target.mass_kg > 1.2 * limits.payload_kg\n"), TIGHTENS,
        ("grasp_object", "human-shared", "deny -> approve")),
    "a rule deleted": (
        (ORGANIZATION, r"  - id: low-confidence.*?(?=  - id: press)", ""), TIGHTENS, ("grasp_object", "real-restricted", "approve -> allow")),
    "a rule for fewer capabilities": (
        (ORGANIZATION, r"\[grasp_object, transport_object, place_object, regrasp\]", "[grasp_object, transport_object, regrasp]"), TIGHTENS,
        ("place_object", "sim-relaxed", "looser speed_mps")),
    "another default": (
        (GRASP, r"(force_n: .*?)default: 40", r"\1default: 50"), LOOSENS, ("grasp_object", "sim-relaxed", "another default of force_n")),
    "approval dropped": (
        (HUMAN, r"risk: \[medium, high, critical\]", "risk: [high, critical]"), TIGHTENS, None),
    "a quorum lowered": (
        (ORGANIZATION, "approvers: 2", "approvers: 1"), TIGHTENS, ("operate_tool", "human-shared", "fewer approvers")),
    "a longer deadline": ((HUMAN, "within_s: 120", "within_s: 121"), TIGHTENS, None),
    "a longer wait in mid-execution": (("authority.yaml", "within_s: 600", "within_s: 900"), TIGHTENS, None),
    "a zone moved": (
        (SITE, r"press_area: \{kind: forbidden, polygon: .*?\}", "press_area: {kind: forbidden, polygon: [[4.7, 0.4], [6.3, 0.4], [6.3, 1.6], [4.7, 1.6]]}"),
        BOTH, ("navigate_to", "sim-relaxed", "deny -> allow")),
    "a zone shrunk": (
        (SITE, r"press_area: \{kind: forbidden, polygon: .*?\}", "press_area: {kind: forbidden, polygon: [[4.6, 0.4], [6.2, 0.4], [6.2, 1.5], [4.6, 1.5]]}"),
        TIGHTENS, ("navigate_to", "sim-relaxed", "deny -> allow")),
    "a zone that is none any more": ((SITE, "press_area: {kind: forbidden", "press_area: {kind: shared"), TIGHTENS, ("", "", "forbidden ground -> free")),
    "a hazard dropped": (
        (SITE, r"(solvent_1: .*?)hazardous: true", r"\1hazardous: false"), TIGHTENS, ("grasp_object", "sim-relaxed", "deny -> allow")),
    "a press that is none": ((SITE, "press: true", "press: false"), TIGHTENS, ("operate_tool", "human-shared", "fewer approvers")),
    "a permission given": (
        (ORGANIZATION, r"tool_operation\]\}", "tool_operation, hazmat]}"), TIGHTENS, ("grasp_object", "sim-relaxed", "deny -> allow")),
    "a condition met no more": ((GRASP, "gripper_empty, ", ""), TIGHTENS, None),
    "a watch rule gone": ((HUMAN, r"  - id: stall\n.*?(?=  - id: timeout)", ""), TIGHTENS, None),
    "a watch threshold raised": ((HUMAN, "above: 25", "above: 26"), TIGHTENS, None),
    "another answer to an alarm": ((HUMAN, "failure: contact\n    response: {enter: stop}", "failure: contact\n    response: {enter: pause}"), LOOSENS, None),
    "another recovery": ((HUMAN, r"- on: blocked\n    do: \[recovery_capability, retry", "- on: blocked\n    do: [retry, recovery_capability"), LOOSENS, None),
    "more attempts": ((HUMAN, "retry_budget: 1", "retry_budget: 2"), TIGHTENS, None),
    "less sensitive": ((HUMAN, "sensitivity: 0.9", "sensitivity: 0.85"), TIGHTENS, None),
    "more to ask for": ((GRASP, "maximum: 140", "maximum: 150"), TIGHTENS, None),
    "a longer run": ((GRASP, "timeout_s: 20", "timeout_s: 30"), TIGHTENS, None),
}  # fmt: skip


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_loosening_is_found_and_shown(name: str) -> None:
    edit, way_back, shown = PLANTED[name]
    found = compared(edit)
    assert found.loosens
    assert all(one.decided for one in found.decisions)
    if shown is not None:
        assert shown in changes(found)
    assert compared(edit, back=True).direction is way_back


def test_approval_that_is_really_dropped_is_shown() -> None:
    found = compared(
        (HUMAN, r"risk: \[medium, high, critical\]", "risk: [high, critical]"),
        (GRASP, "human-shared: approval-required", "human-shared: guarded"),
    )
    assert found.direction is LOOSENS
    assert ("grasp_object", "human-shared", "approve -> allow") in changes(found)
    (shown,) = (one for one in found.decisions if one.change == "approve -> allow" and one.capability == "grasp_object")
    before, after = shown.before, shown.after
    assert before is not None
    assert after is not None
    assert [(one["what"], one["approvers"]) for one in (before, after)] == [("approve", 1), ("allow", 0)]
    assert before["values"] == after["values"]
    assert all(one.after is None for one in Comparison.read(found.brief()).decisions)
    assert Comparison.read(json.loads(json.dumps(found.document()))) == found


def test_a_confirmation_that_goes_or_answers_silence_otherwise_loosens() -> None:
    entry = "confirm_before: [{{capability: place_object, profile: human-shared, phases: [release], within_s: 60, on_deny: rollback, on_timeout: {}}}]"
    one, other = (
        loaded(("authority.yaml", r"confirm_before: \[\]", entry.format(silence)))
        for silence in ("terminate", "rollback")
    )
    for old, new, way in (
        (loaded(), one, TIGHTENS),
        (one, loaded(), LOOSENS),
        (one, other, LOOSENS),
        (other, one, LOOSENS),
    ):
        assert difference(old, new, now=standing).direction is way


def test_what_is_enabled_anew_loosens_and_is_shown() -> None:
    edit = (GRASP, "human-shared: [a-z-]+", "human-shared: forbidden")
    assert compared(edit).direction is TIGHTENS
    found = compared(edit, back=True)
    assert found.direction is LOOSENS
    assert ("grasp_object", "human-shared", "not enabled -> approve") in changes(found)


# Written otherwise, and the same: equal units, another order, another name, the same said twice.
HARMLESS: dict[str, tuple[Edit, ...]] = {
    "another spelling of a number": ((HUMAN, r"\{max: 60,", "{max: 6.0e+1,"),),
    "the operands the other way round": (
        (ORGANIZATION, r'when: target.hazardous && !\("hazmat" in agent.permissions\)', "when: '!(\"hazmat\" in agent.permissions) && target.hazardous'"),),
    "another form of a condition": ((ORGANIZATION, r"0\.8 \* limits\.payload_kg", "limits.payload_kg * 0.8"),),
    "rules in another order": (
        (ORGANIZATION, r"(  - id: hazardous.*?)(  - id: forbidden-zone.*?)(?=  - id: outside)", r"\2\1"),),
    "another name for a rule": ((ORGANIZATION, "- id: outside-site", "- id: beyond-site"),),
    "one rule as two": (
        (ORGANIZATION, r"  - id: forbidden-zone\n", "  - id: forbidden-too\n    applies_to: [navigate_to]\n    when: place.forbidden\n    then: deny\n    because: So.\n  - id: forbidden-zone\n"),),
    "other words": ((ORGANIZATION, "because: Hazardous objects", "because: Such objects"),),
    "conditions in another order": ((GRASP, "object_visible, object_reachable", "object_reachable, object_visible"),),
    "a condition that never mattered": ((ORGANIZATION, r"\(\"hazmat\" in agent.permissions\)\n", '("hazmat" in agent.permissions) && target.mass_kg >= 0.0\n'),),
    "a number twice, and twice the bound": ((ORGANIZATION, r"metadata.confidence < 0.5", "metadata.confidence * 2.0 < 1.0"),),
    "the corners of a zone from another one on": (
        (SITE, r"\[\[4.6, 0.4\], \[6.2, 0.4\], \[6.2, 1.6\], \[4.6, 1.6\]\]", "[[6.2, 0.4], [6.2, 1.6], [4.6, 1.6], [4.6, 0.4]]"),),
}  # fmt: skip


@pytest.mark.parametrize("name", HARMLESS)
def test_what_is_only_written_otherwise_has_no_effect(name: str) -> None:
    found = compared(*HARMLESS[name])
    assert (found.direction, found.decisions) == (SAME, ())


def test_a_tightening_alone_is_one_and_is_shown() -> None:
    found = compared((ORGANIZATION, r"force_n: \{max: 20\}", "force_n: {max: 18}"))
    assert found.direction is TIGHTENS
    assert ("grasp_object", "sim-relaxed", "tighter force_n") in changes(found)
    more = '\n  - id: no-mug\n    when: target.name == "mug_1"\n    then: deny\n    because: It stays.\n'
    assert compared((ORGANIZATION, "\nrules:\n", f"\nrules:{more}")).direction is TIGHTENS


def test_a_lower_limit_that_lets_a_rule_stop_asking_is_both() -> None:
    ask = "\n  - id: strong\n    applies_to: [grasp_object]\n    when: limits.grip_force_n > 55.0\n    then: escalate\n    approvers: 2\n    because: So.\n"
    asking = loaded((ORGANIZATION, "\nrules:\n", f"\nrules:{ask}"))
    lower = loaded(
        (ORGANIZATION, "\nrules:\n", f"\nrules:{ask}"), (HUMAN, r"grip_force_n: \{max: 60", "grip_force_n: {max: 50")
    )
    found = difference(asking, lower, now=standing)
    assert found.direction is BOTH
    assert ("grasp_object", "human-shared", "fewer approvers") in changes(found)


def test_every_example_holds_as_a_case_of_the_new_policy_and_its_body_is_a_proposal() -> None:
    edit = PLANTED["a condition narrowed"][0]
    found = compared(edit)
    assert len(found.decisions) > 20
    for one in found.decisions:
        (result,) = cases.run(loaded(edit), {"tests/shown.yaml": one.example})
        assert result.passed, (one.message, result.differences)
        (was,) = cases.run(loaded(), {"tests/shown.yaml": one.example})
        assert not was.passed, one.message
        assert one.body["capability"] == one.capability
        (case,) = yaml.safe_load(one.example)["cases"]
        assert case.get("params", {}) == one.body["params"]
        body = CheckBody.model_validate(dict(one.body))
        assert body.agent == case.get("context", {}).get("agent", "planner"), "people have to name one"


def test_what_cannot_be_decided_is_said_so_and_loosens() -> None:
    edit = (ORGANIZATION, "when: target.hazardous &&", "when: target.hazardous && target.mass_kg >= 0.0 &&")
    found = difference(loaded(), loaded(edit), now=standing, all_s=0.0)
    assert found.loosens
    assert {one.decided for one in found.decisions} == {False}
    assert compared(edit).direction is SAME


def test_a_comparison_survives_being_written_down() -> None:
    found = compared(PLANTED["a quorum lowered"][0])
    assert Comparison.read(json.loads(json.dumps(found.document()))) == found


# Against the real code -------------------------------------------------------------------------------------------------


def changed(random: Random, rules: list[Any], capability: str) -> list[Any]:
    """Return the rules with one left out, one more, or one changed for another."""
    from tests.proofs.random_rules import Drawing

    other = Drawing(random, capability).rule(99)
    place = random.randrange(len(rules))
    match random.randrange(3):
        case 0:
            return rules[:place] + rules[place + 1 :]
        case 1:
            return [*rules, other]
        case _:
            return [*rules[:place], other, *rules[place + 1 :]]


@pytest.mark.parametrize("seed", range(8000, 8003))
def test_random_decisions_show_nothing_that_a_comparison_does_not_say(seed: int) -> None:
    random = Random(seed)
    looser = 0
    for _ in range(10):
        capability, profile, rules = drawn(random)
        policies = [compiled(capability, profile, found) for found in (rules, changed(random, rules, capability))]
        found = difference(*policies, now=standing, effort=3_000_000)
        assert not [one for one in found.decisions if "report it" in one.message]
        for _ in range(40):
            case = proposed(random, capability, profile)
            sides = [told(policy, seen) for policy in policies if (seen := decided(policy, case)) is not None]
            if len(sides) < 2 or None in sides or sides[0] == sides[1]:
                continue
            if sides[0].what == sides[1].what == "deny":
                continue
            assert found.direction is not SAME, case
            rank = [("deny", "approve", "allow").index(side.what) for side in sides]
            fewer = rank[0] == rank[1] == 1 and sides[1].approvers < sides[0].approvers
            if rank[1] > rank[0] or fewer:
                looser += 1
                assert found.loosens, case
    assert looser


# The command -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("edit", "code"),
    [
        (None, 0),
        ((ORGANIZATION, r"force_n: \{max: 20\}", "force_n: {max: 18}"), 10),
        ((HUMAN, r"grip_force_n: \{max: 60", "grip_force_n: {max: 61"), 11),
        (
            (
                ORGANIZATION,
                r"force_n: \{max: 20\}, speed_mps: \{max: 0.15\}",
                "force_n: {max: 18}, speed_mps: {max: 0.2}",
            ),
            12,
        ),
    ],
)
def test_the_exit_code_says_which_way_it_goes(tmp_path: Any, edit: Edit | None, code: int) -> None:
    for name, text in (loaded() if edit is None else loaded(edit)).files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    done = CliRunner().invoke(app, ["policy", "diff", str(POLICIES), str(tmp_path), "--json"])
    assert done.exit_code == code, done.output
    document = json.loads(done.stdout)
    assert document["direction"] == {0: "same", 10: "tightens", 11: "loosens", 12: "both"}[code]
    words = CliRunner().invoke(app, ["policy", "diff", str(POLICIES), str(tmp_path)])
    assert words.exit_code == code
    assert {0: "no effect", 10: "tightens", 11: "loosens", 12: "tightens and loosens"}[
        code
    ] in words.stdout.splitlines()[-1]
    assert ("expect:" in words.stdout) is (code != 0)


def test_what_is_undecided_has_a_code_of_its_own(tmp_path: Any) -> None:
    edit = (ORGANIZATION, "when: target.hazardous &&", "when: target.hazardous && target.mass_kg >= 0.0 &&")
    for name, text in loaded(edit).files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    done = CliRunner().invoke(app, ["policy", "diff", str(POLICIES), str(tmp_path), "--effort", "1"])
    assert done.exit_code == 13, done.output
    assert "could not be decided" in done.stdout


def test_a_directory_that_is_none_is_named_as_the_argument_it_is() -> None:
    for called, words in (("NEW", [str(POLICIES), "nowhere"]), ("OLD", ["nowhere", str(POLICIES)])):
        done = CliRunner().invoke(app, ["policy", "diff", *words])
        assert done.exit_code != 0
        assert f"`{called}` is `nowhere`" in f"{done.output}{done.exception}"
