from __future__ import annotations

import pytest

from app.governance import bundle
from app.governance.errors import PolicyErrors
from tests.governance.policy_world import files, shipped

GRASP, HUMAN, ORG, SITE, H = (
    "capabilities/grasp_object.yaml", "profiles/human-shared.yaml", "organization.yaml", "site.yaml", "authority.yaml",
)  # fmt: skip

BROKEN = [
    ("unknown key", GRASP, "risk: medium", "risk: medium\nspeed: fast", "unknown key `speed`"),
    ("missing key", GRASP, "risk: medium\n", "", "`risk` is missing"),
    ("wrong type", GRASP, "timeout_s: 20", "timeout_s: soon", "`soon`"),
    ("duplicate key", GRASP, "risk: medium", "risk: medium\nrisk: low", "stands twice"),
    ("not YAML", GRASP, "name: grasp_object", "name: [", "not readable as YAML"),
    ("not finite", HUMAN, "{max: 0.25,", "{max: .inf,", "not a finite number"),
    ("unit mismatch", GRASP, "unit: N,", "unit: m/s,", "unit mismatch"),
    ("limit of another unit", GRASP, "x-limit: grip_force_n", "x-limit: payload_kg", "unit mismatch"),
    ("bad schema", GRASP, "type: object", "type: thing", "not a valid JSON Schema"),
    ("open schema", GRASP, "additionalProperties: false", "additionalProperties: true", "closed object"),
    ("default out of range", GRASP, "default: 40", "default: 400", "default `400"),
    ("inverted range", GRASP, "minimum: 2,", "minimum: 200,", "empty range"),
    ("unknown reference", GRASP, "x-ref: object", "x-ref: wish", "kind of reference `wish`"),
    ("unknown condition", GRASP, "gripper_empty", "gripper_clean", "condition `gripper_clean`"),
    ("unknown permission", GRASP, "[manipulation]", "[juggling]", "permission `juggling`"),
    ("unknown rollback", GRASP, "rollback: release_and_retract", "rollback: undo", "recovery capability `undo`"),
    ("uncovered profile", GRASP, "sim-relaxed: allowed, ", "", "`sim-relaxed` is not covered"),
    ("unknown profile", GRASP, "sim-relaxed: allowed", "sim-relaxed: allowed, moon: allowed", "profile `moon`"),
    ("no rollback where required", GRASP, "rollback: release_and_retract", "rollback: null", "rollback is required"),
    ("unknown variable", ORG, "when: place.forbidden", "when: plaze.forbidden", "unknown variable `plaze`"),
    ("unknown field", ORG, "when: place.forbidden", "when: place.forbiden", "no field `forbiden`"),
    ("bad CEL", ORG, "when: place.forbidden", "when: place. &&", "unexpected"),
    ("units compared", ORG, "target.mass_kg > limits", "target.mass_kg > limits.tcp_speed_mps + limits",
     "units differ"),
    ("unknown capability", ORG, "[operate_tool]", "[operate_tol]", "capability `operate_tol`"),
    ("unknown parameter", ORG, "{force_n: {max: 20}", "{farce_n: {max: 20}", "parameter `farce_n`"),
    ("empty bound", ORG, "{force_n: {max: 20}", "{force_n: {}", "empty bound"),
    ("inverted bound", ORG, "{force_n: {max: 20}", "{force_n: {max: 20, min: 30}", "inverted bound"),
    ("set without modify", ORG, "then: modify", "then: deny", "`set` belongs to"),
    ("approvers without escalate", ORG, "then: escalate\n    approvers: 2", "then: deny\n    approvers: 2",
     "`approvers`"),
    ("rule twice", ORG, "id: forbidden-zone", "id: hazardous", "stands twice"),
    ("reserved agent", ORG, "planner:", "governance:", "reserved"),
    ("unknown signal", HUMAN, "signal: stall_s", "signal: stall_h", "signal `stall_h`"),
    ("unknown failure", HUMAN, "failure: stall", "failure: boredom", "failure `boredom`"),
    ("unknown strategy", HUMAN, "do: [retry, terminate]", "do: [retry, pray]", "`pray` is not valid"),
    ("unknown threshold", HUMAN, "above: timeout_s", "above: bedtime", "`bedtime`"),
    ("threshold of another unit", HUMAN, "signal: stall_s\n    above: 5",
     "signal: stall_s\n    above: {limit: tcp_speed_mps}",
     "unit mismatch"),
    ("two thresholds", HUMAN, "above: 5\n", "above: 5\n    below: 3\n", "one threshold"),
    ("else without persist_ms", HUMAN, "persist_ms: 5000, ", "", "`else` follows"),
    ("recovery without capability", HUMAN, "    capability: safe_retreat\n", "", "needs `capability`"),
    ("uncovered failures", HUMAN, "on: any", "on: stall", "uncovered"),
    ("no approval", HUMAN, "  approval: {risk", "  # approval: {risk", "need `approval`"),
    ("no room", HUMAN, "{max: 60,", "{max: 1,", "no room"),
    ("unknown sensor", HUMAN, "stale_after_ms: {arm", "stale_after_ms: {leg", "sensor `leg`"),
    ("unknown start", SITE, "start: bench_a_stand", "start: mars", "target `mars`"),
    ("unknown surface", SITE, "surface: bench_a,", "surface: bench_z,", "surface `bench_z`"),
    ("clockwise zone", SITE, "[[4.6, 0.4], [6.2, 0.4], [6.2, 1.6], [4.6, 1.6]]",
     "[[4.6, 1.6], [6.2, 1.6], [6.2, 0.4], [4.6, 0.4]]", "counter-clockwise"),
    ("confirmation of nothing", H, "confirm_before: []",
     "confirm_before: [{capability: dance, profile: human-shared, phases: [spin]}]", "capability `dance`"),
]  # fmt: skip


@pytest.mark.parametrize(("file", "old", "new", "said"), [row[1:] for row in BROKEN], ids=[row[0] for row in BROKEN])
def test_says_what_is_wrong_with_a_broken_directory(file, old, new, said):
    text = files()
    assert old in text[file]
    with pytest.raises(PolicyErrors) as caught:
        bundle.load_files({**text, file: text[file].replace(old, new)})
    told = [problem for problem in caught.value.problems if said in str(problem)]
    assert told, str(caught.value)
    assert all(problem.line > 0 for problem in told)


def test_reports_all_problems_together_in_order():
    text = files()
    text[GRASP] = text[GRASP].replace("risk: medium", "risk: enormous")
    text[SITE] = text[SITE].replace("fragile: true", "fragile: maybe")
    with pytest.raises(PolicyErrors) as caught:
        bundle.load_files(text)
    assert [problem.file for problem in caught.value.problems] == [GRASP, SITE]


@pytest.mark.parametrize("name", ["organization.yaml", "authority.yaml", "site.yaml"])
def test_a_missing_file_is_named(name):
    text = files()
    del text[name]
    with pytest.raises(PolicyErrors, match=name):
        bundle.load_files(text)


def test_a_file_nothing_would_read_is_an_error():
    with pytest.raises(PolicyErrors, match="nothing would read it"):
        bundle.load_files({**files(), "profile/typo.yaml": "{}"})


def test_a_directory_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(PolicyErrors, match="no such directory"):
        bundle.load(tmp_path / "nowhere")


def test_a_file_that_is_no_text_is_an_error(tmp_path):
    (tmp_path / "site.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(PolicyErrors, match="UTF-8"):
        bundle.load(tmp_path)


def test_the_same_files_make_the_same_digest_and_another_byte_another():
    assert bundle.load_files(dict(reversed(files().items()))).digest == shipped().digest
    changed = {**files(), H: files()[H] + "\n"}
    assert bundle.digest(changed) != shipped().digest
