"""`reins policy check`, from outside: what it prints, its exit code, SARIF, and who does without the solver."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import yaml
from typer.testing import CliRunner

from app.cli import app
from app.governance import bundle, cases
from tests.governance.policy_world import POLICIES

if TYPE_CHECKING:
    from typer.testing import Result

PLANT = "\nrules:\n  - {id: huge, applies_to: [grasp_object], when: target.mass_kg > 50.0, then: deny, because: So.}\n"
FAILS = "\nrules:\n  - {id: far, applies_to: [navigate_to], when: params.x_m > 7.5, then: escalate, because: So.}\n"


def check(folder: Path, *flags: str) -> Result:
    return CliRunner().invoke(app, ["policy", "check", str(folder), *flags])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return Path(shutil.copytree(POLICIES, tmp_path / "policies"))


def plant(folder: Path, rules: str) -> None:
    file = folder / "organization.yaml"
    file.write_text(file.read_text().replace("\nrules:\n", rules, 1))


def test_the_shipped_policy_is_proved():
    """As a process, as a user starts it; all others ask the same command in this one."""
    words = [sys.executable, "-m", "app.cli", "policy", "check", str(POLICIES)]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "proved of 48 pairs" in done.stdout
    assert "36 comparisons of profiles" in done.stdout


def test_a_dead_rule_is_named_with_file_and_line(folder: Path):
    plant(folder, PLANT)
    done = check(folder)
    line = (folder / "organization.yaml").read_text()[
        : (folder / "organization.yaml").read_text().index("id: huge")
    ].count("\n") + 1
    assert done.exit_code == 1
    assert f"organization.yaml:{line}: refuted: a dead rule: `organization/huge` never holds" in done.stderr
    assert "1 not proved" in done.stdout


def test_the_example_that_is_printed_runs_as_a_case(folder: Path):
    plant(folder, FAILS)
    done = check(folder)
    assert done.exit_code == 1
    shown = done.stderr.partition("    cases:")[2].partition("\norganization.yaml")[0]
    text = "cases:" + "\n".join(line.removeprefix("    ") for line in shown.splitlines())
    (case,) = yaml.safe_load(text)["cases"]
    assert (case["expect"]["status"], case["params"]) == ("denied", {"target": case["params"]["target"]})
    (result,) = cases.run(bundle.load(folder), {"tests/shown.yaml": text})
    assert result.passed


def test_findings_come_as_sarif(folder: Path):
    plant(folder, FAILS)
    done = check(folder, "--format", "sarif")
    log = json.loads(done.stdout)
    assert (done.exit_code, log["version"]) == (1, "2.1.0")
    results = log["runs"][0]["results"]
    found = [result for result in results if result["level"] == "error"]
    assert {result["ruleId"] for result in found} == {"error"}
    place = found[0]["locations"][0]["physicalLocation"]
    assert place["artifactLocation"]["uri"] == "organization.yaml"
    assert place["region"]["startLine"] > 1
    assert found[0]["properties"]["check"]["capability"] == "navigate_to"
    assert {rule["id"] for rule in log["runs"][0]["tool"]["driver"]["rules"]} >= {
        result["ruleId"] for result in results
    }


def test_what_cannot_be_loaded_comes_as_sarif_too(folder: Path):
    plant(folder, "\nrules:\n  - {id: odd, when: target.weight > 1.0, then: deny, because: So.}\n")
    done = check(folder, "--format", "sarif")
    (result, *_) = json.loads(done.stdout)["runs"][0]["results"]
    assert (done.exit_code, result["ruleId"], result["level"]) == (1, "load", "error")
    assert "no field `weight`" in result["message"]["text"]


def test_without_effort_nothing_is_proved():
    done = check(POLICIES, "--effort", "1")
    assert done.exit_code == 1
    assert "undecided" in done.stderr
    assert "proved of" not in done.stdout


def test_a_time_limit_leaves_undecided_what_it_cuts_off():
    done = check(POLICIES, "--time-limit", "0.01")
    assert done.exit_code == 1
    assert "undecided" in done.stderr


def test_proofs_can_be_left_out(folder: Path):
    plant(folder, PLANT)
    assert check(folder, "--no-proofs").exit_code == 0


@pytest.mark.parametrize("flag", ["--proofs", "--no-proofs"])
def test_what_is_promised_is_read_whether_it_is_proved_or_not(folder: Path, flag: str):
    promise = "{id: a, says: So., never: [allowed], when: target.weight > 1.0}"
    (folder / "properties.yaml").write_text(f"properties:\n  - {promise}\n")
    done = check(folder, flag)
    assert done.exit_code == 1
    assert "properties.yaml:2: properties[0].when: column 8: " in done.stderr
    assert "no field `weight`" in done.stderr
    log = json.loads(check(folder, "--no-proofs", "--format", "sarif").stdout)
    assert [one["ruleId"] for one in log["runs"][0]["results"]] == ["load"]


def test_without_properties_none_are_proved(folder: Path):
    (folder / "properties.yaml").unlink()
    done = check(folder)
    assert done.exit_code == 0
    assert "no properties stated" in done.stdout


def test_properties_are_no_part_of_the_digest(folder: Path):
    before = bundle.load(folder).digest
    (folder / "properties.yaml").write_text("order: []\n")
    assert bundle.load(folder).digest == before


@pytest.mark.parametrize("module", ["app.main", "app.workcell", "app.cli"])
def test_what_serves_and_moves_does_without_the_solver(module: str):
    text = f"import sys, {module}; sys.exit('z3' in sys.modules or 'app.proofs' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", text]).returncode == 0


@pytest.mark.parametrize(
    ("bound", "promise"),
    [
        ("exclusiveMaximum: 2.5", "params.looks <= 1"),
        ("exclusiveMinimum: -2.5", "params.looks >= -1"),
        ("maximum: 2.5", "params.looks <= 1"),
        ("minimum: -2.5", "params.looks >= -1"),
    ],
)
def test_an_integer_reaches_as_far_as_a_bound_between_two_integers_lets_it(folder: Path, bound: str, promise: str):
    file = folder / "capabilities" / "inspect_area.yaml"
    text = file.read_text().replace("required: [area]", "required: [area, looks]")
    file.write_text(text.replace("\nphases:", f"\n    looks: {{type: integer, {bound}}}\nphases:"))
    (folder / "properties.yaml").write_text(
        "properties:\n"
        f"  - {{id: few, says: Few., applies_to: [inspect_area], profiles: [sim-relaxed], always: {promise}}}\n"
    )
    done = check(folder)
    assert done.exit_code == 1
    assert "refuted: `few` does not hold of `inspect_area` in sim-relaxed" in done.stderr


@pytest.mark.parametrize(
    "declared",
    [
        "type: boolean, const: true",
        "type: boolean, enum: [true]",
        "type: boolean, not: {const: false}",
    ],
)
def test_what_nothing_gets_through_is_a_gap_or_undecided_though_no_rule_alone_says_so(folder: Path, declared: str):
    """What the schema says of a single parameter may be more than proofs know: they do not take the rest for a way."""
    file = folder / "capabilities" / "inspect_area.yaml"
    text = file.read_text().replace("required: [area]", "required: [area, sure]")
    file.write_text(text.replace("\nphases:", f"\n    sure: {{{declared}}}\nphases:"))
    plant(folder, "\nrules:\n  - {id: no, applies_to: [inspect_area], when: params.sure, then: deny, because: So.}\n")
    done = check(folder)
    assert done.exit_code == 1
    assert "`inspect_area` in sim-relaxed" in done.stderr
    assert "through" in done.stderr
