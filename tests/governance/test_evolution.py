"""How a capability may change: the class of every change, and what it demands of the version."""

from __future__ import annotations

from dataclasses import replace

import pytest

from app.governance import bundle
from app.governance.admission import admit
from app.governance.comparison import compare
from app.governance.errors import PolicyErrors
from app.governance.evolution import Class, Evolution, evolve, outgrown
from app.governance.model import AdmissionOutcome
from app.governance.semver import Version
from tests.governance.policy_world import context, files, proposal, shipped

GRASP = "capabilities/grasp_object.yaml"
MAJOR, MINOR, PATCH, NONE = Class.MAJOR, Class.MINOR, Class.PATCH, Class.NONE

# what is written otherwise in grasp_object's manifest, which class that has, and what is said of it
ROWS = [
    ("force_n: {type: number, unit: N, minimum: 2, maximum: 140, default: 40, x-limit: grip_force_n}\n    ", "", MAJOR,
     "input `force_n` is gone"),
    ("  properties:\n", "  properties:\n    soft: {type: boolean, default: false}\n", MINOR, "input `soft` is new"),
    ("  properties:\n", "  properties:\n    soft: {type: boolean}\n", MINOR, "input `soft` is new"),
    ("object_id]\n  properties:\n", "object_id, soft]\n  properties:\n    soft: {type: boolean}\n", MAJOR,
     "input `soft` is new and has to be given"),
    ("object_id]\n  properties:\n", "object_id, soft]\n  properties:\n    soft: {type: boolean, default: true}\n",
     MINOR, "input `soft` is new"),
    ("minimum: 2,", "minimum: 1,", MINOR, "input `force_n`: minimum is `1` instead of `2`"),
    ("minimum: 2,", "minimum: 3,", MAJOR, "input `force_n`: minimum is `3` instead of `2`"),
    ("maximum: 140", "maximum: 150", MINOR, "input `force_n`: maximum is `150` instead of `140`"),
    ("maximum: 140", "maximum: 130", MAJOR, "input `force_n`: maximum is `130` instead of `140`"),
    ("maxLength: 64, ", "", MINOR, "input `object_id`: maxLength is gone"),
    ("unit: N, minimum: 2", "unit: N, exclusiveMinimum: 1, minimum: 2", MAJOR,
     "input `force_n`: exclusiveMinimum is `1` now"),
    ("default: 40", "default: 41", MAJOR, "input `force_n`: default is `41` instead of `40`"),
    ("x-limit: tcp_speed_mps", "x-limit: base_speed_mps", MINOR,
     "input `speed_mps` is held by `base_speed_mps` instead of `tcp_speed_mps`"),
    ("x-ref: object}", "x-ref: object, description: which}", PATCH,
     "input `object_id`: its description reads otherwise"),
    ("  type: object\n", "  type: object\n  minProperties: 1\n", MAJOR, "inputs: `minProperties` is another"),
    ("  type: object\n", "  type: object\n  title: Grasp\n", PATCH, "inputs: `title` is another"),
    ("gripper_empty, arm_ready]", "gripper_empty]", MINOR, "precondition `arm_ready` is gone"),
    ("gripper_empty, arm_ready]", "gripper_empty, arm_ready, arm_retracted]", MAJOR,
     "precondition `arm_retracted` is new"),
    ("gripper_empty, arm_ready]", "arm_ready, gripper_empty]", PATCH, "preconditions stand in another order"),
    ("postconditions: [object_secured]", "postconditions: []", MAJOR, "postcondition `object_secured` is gone"),
    ("postconditions: [object_secured]", "postconditions: [object_secured, arm_ready]", MINOR,
     "postcondition `arm_ready` is new"),
    ("lift, verify]", "lift]", MAJOR, "phase `verify` is gone"),
    ("lift, verify]", "lift, verify, show]", MINOR, "phase `show` is new"),
    ("permissions: [manipulation]", "permissions: [manipulation, perception]", MAJOR, "permission `perception` is new"),
    ("risk: medium", "risk: high", MAJOR, "risk is high instead of medium"),
    ("risk: medium", "risk: low", MINOR, "risk is low instead of medium"),
    ("rollback: release_and_retract", "rollback: retrace", MAJOR,
     "rollback is `retrace` instead of `release_and_retract`"),
    ("timeout_s: 20", "timeout_s: 21", MINOR, "time limit is 21 s instead of 20 s"),
    ("timeout_s: 20", "timeout_s: 19", MAJOR, "time limit is 19 s instead of 20 s"),
    ("summary: Close the gripper", "summary: Close the fingers", PATCH, "the summary reads otherwise"),
]  # fmt: skip


def changed(old: str, new: str, file: str = GRASP):
    text = files()
    assert old in text[file]
    return bundle.load_files({**text, file: text[file].replace(old, new)})


def as_version(version: str) -> str:
    return f"version: {version}\n"


@pytest.mark.parametrize(("old", "new", "demands", "said"), ROWS)
def test_every_change_has_its_class_and_its_words(old, new, demands, said):
    found = evolve(shipped().capabilities["grasp_object"], changed(old, new).capabilities["grasp_object"])
    assert [(change.what, change.demands) for change in found.changes if change.what == said] == [(said, demands)]
    assert found.demands is demands
    assert not found.enough


def test_what_cannot_stand_in_a_manifest_alone_is_classified_as_well():
    old = shipped().capabilities["grasp_object"]
    inputs = {**old.inputs, "properties": {**old.inputs["properties"], "hand": {"type": "string", "enum": ["left"]}}}  # type: ignore[dict-item]
    wider = {**inputs, "properties": {**inputs["properties"], "hand": {"type": "string", "enum": ["left", "right"]}}}  # type: ignore[dict-item]
    one, two = replace(old, inputs=inputs), replace(old, inputs=wider)
    assert (evolve(one, two).demands, evolve(two, one).demands) == (MINOR, MAJOR)
    given = replace(old, inputs={**old.inputs, "required": ["object_id", "speed_mps"]})
    assert evolve(old, given).demands is NONE  # it has a default: nobody has to give it
    bare = {**old.inputs["properties"], "speed_mps": {"type": "number"}}  # type: ignore[dict-item]
    without = replace(old, inputs={**old.inputs, "properties": bare})
    asked = replace(without, inputs={**without.inputs, "required": ["object_id", "speed_mps"]})
    assert [change.what for change in evolve(without, asked).changes] == ["input `speed_mps` has to be given now"]
    assert [change.what for change in evolve(asked, without).changes] == ["input `speed_mps` may be left out now"]
    defaulted = {**bare, "speed_mps": {"type": "number", "default": 0.3}}
    assert evolve(without, replace(old, inputs={**old.inputs, "properties": defaulted})).demands is MINOR
    assert evolve(replace(old, rollback=None), old).demands is MINOR
    assert evolve(replace(old, recovery=True), old).demands is MAJOR


def test_where_it_is_enabled_demands_nothing():
    policy = changed("sim-relaxed: allowed", "sim-relaxed: guarded")
    found = evolve(shipped().capabilities["grasp_object"], policy.capabilities["grasp_object"])
    assert (found.changes, found.demands, found.enough) == ((), NONE, True)


@pytest.mark.parametrize(
    ("before", "demands", "least"),
    [
        ((1, 2, 3), MAJOR, (2, 0, 0)),
        ((1, 2, 3), MINOR, (1, 3, 0)),
        ((1, 2, 3), PATCH, (1, 2, 4)),
        ((1, 2, 3), NONE, (1, 2, 3)),
        ((0, 2, 3), MAJOR, (0, 3, 0)),
    ],
)
def test_a_version_grows_as_its_changes_demand(before, demands, least):
    changes = () if demands is NONE else (evolve_row(demands),)
    found = Evolution(changes=changes, before=Version(*before), after=Version(*least))
    assert found.least == least
    assert found.enough
    assert not replace(found, after=Version(0, 0, 1)).enough


def evolve_row(demands: Class):
    old, new = next((old, new) for old, new, wanted, _ in ROWS if wanted is demands)
    found = evolve(shipped().capabilities["grasp_object"], changed(old, new).capabilities["grasp_object"])
    return next(change for change in found.changes if change.demands is demands)


@pytest.mark.parametrize(
    ("version", "change", "said"),
    [
        ("1.0.0", ("risk: medium", "risk: high"),
         "1.0.0 in force became 1.0.0, and what changed demands a major step: risk is high instead of medium"),
        ("1.9.0", ("default: 40", "default: 50"),
         "demands a major step: input `force_n`: default is `50` instead of `40`; valid: `2.0.0 or later`"),
        ("1.0.1", ("timeout_s: 20", "timeout_s: 30"), "demands a minor step"),
        ("0.9.0", ("timeout_s: 20", "timeout_s: 20"), "the version goes back from 1.0.0 to 0.9.0"),
    ],
)  # fmt: skip
def test_a_candidate_whose_version_does_not_say_what_changed_is_told_where_and_how(version, change, said):
    text = files()
    manifest = text[GRASP].replace(*change).replace("version: 1.0.0\n", as_version(version))
    problems = outgrown(shipped(), bundle.load_files({**text, GRASP: manifest}))
    assert [(problem.file, problem.line) for problem in problems] == [(GRASP, 3)]
    assert said in str(problems[0])


@pytest.mark.parametrize("version", ["2.0.0", "2.1.0", "3.0.0"])
def test_a_version_that_grew_enough_is_taken(version):
    text = files()
    manifest = text[GRASP].replace("risk: medium", "risk: high").replace("version: 1.0.0\n", as_version(version))
    assert outgrown(shipped(), bundle.load_files({**text, GRASP: manifest})) == []


def test_a_capability_that_is_new_or_as_it_was_is_no_matter():
    text = {name: said for name, said in files().items() if name != "capabilities/inspect_area.yaml"}
    assert outgrown(shipped(), shipped()) == []
    assert outgrown(bundle.load_files(text), shipped()) == []


def test_what_is_said_of_a_version_is_no_change_of_what_is_allowed():
    policy = changed("version: 1.0.0\n", "version: 1.1.0\nchanges: {1.1.0: Says what is new.}\n")
    assert not compare(shipped(), policy).loosens


def test_what_is_said_of_no_version_is_refused():
    with pytest.raises(PolicyErrors, match="changes"):
        changed("version: 1.0.0\n", "version: 1.0.0\nchanges: {next: Says what is new.}\n")


# An agent that asks for a version -------------------------------------------------------------------------------------


def test_an_agent_that_asks_for_what_is_in_force_is_admitted():
    asked = replace(proposal("grasp_object", object_id="mug_1"), version="^1.0.0")
    assert admit(shipped(), asked, context("sim-relaxed")).outcome is AdmissionOutcome.ACCEPT


def test_an_agent_that_asks_for_an_older_version_is_told_which_is_in_force_and_what_changed():
    told = "changes: {2.0.0: '`force_n` is gone.', 2.1.0: It may be slower., 1.0.0: The first.}\n"
    policy = changed("version: 1.0.0\n", f"version: 2.1.0\n{told}")
    params = policy.validate_params("grasp_object", {"object_id": 1}, "^1.0.0")
    assert params == {"object_id": 1}  # those of another version are not held against this one's schema
    asked = replace(proposal("grasp_object", object_id="mug_1"), params=params, version="^1.0.0")
    found = admit(policy, asked, context("sim-relaxed"))
    assert found.outcome is AdmissionOutcome.REJECT
    (reason,) = found.reasons
    assert (reason.rule, reason.code) == ("admission", "capability_version")
    assert reason.message == (
        "`grasp_object` is in force as 2.1.0, and `^1.0.0` was asked for; 2.0.0: `force_n` is gone.; "
        "2.1.0: It may be slower."
    )
    assert "2.1.0" in reason.remedy


def test_an_agent_that_is_ahead_of_what_is_in_force_is_told_as_well():
    asked = replace(proposal("grasp_object", object_id="mug_1"), version="1.1.0")
    found = admit(shipped(), asked, context("sim-relaxed"))
    assert found.reasons[0].message == "`grasp_object` is in force as 1.0.0, and `1.1.0` was asked for"
