"""`reins policy schemas` and `new`, as the command line runs them."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import orjson
import pytest
from typer.testing import CliRunner

from app.cli import app
from app.governance import bundle, cases
from app.governance.bundle_schema import KINDS, SUFFIX, schema

POLICIES = Path(__file__).resolve().parents[1] / "policies"


def test_schemas_are_written_where_the_files_look_for_them(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["policy", "schemas", str(tmp_path / "schemas")])
    assert done.exit_code == 0, done.output
    written = {path.name: orjson.loads(path.read_bytes()) for path in (tmp_path / "schemas").iterdir()}
    assert written == {f"{kind}{SUFFIX}": schema(kind) for kind in KINDS}


def test_schemas_that_cannot_be_written_are_misuse(tmp_path: Path) -> None:
    (tmp_path / "schemas").write_text("in the way")
    assert CliRunner().invoke(app, ["policy", "schemas", str(tmp_path / "schemas")]).exit_code == 2


REDUCED = ["--template", "reduced-speed", "--set", "base_speed_mps=0.2", "--set", "assessment=RA 7, 3.2"]


def new(place: Path, *words: str, typed: str | None = None) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["policy", "new", str(place), *words], input=typed)
    return done.exit_code, done.output


def shown() -> list[str]:
    """Return the words after `reins policy new candidate` that the documentation shows."""
    page = (POLICIES.parent / "docs" / "policy.md").read_text().replace("\\\n", " ")
    lines = [shlex.split(line) for line in page.splitlines() if line.startswith("    reins policy new candidate ")]
    assert len(lines) == 1
    return lines[0][4:]


def test_what_the_documentation_shows_is_proved_and_written_where_nobody_is_asked_and_says_what_next(
    tmp_path: Path,
) -> None:
    place = tmp_path / "deep" / "candidate"
    code, said = new(place, *shown(), "--no-ask")
    assert code == 0, said
    assert "proved of" in said
    assert "reins policy propose" in said
    assert bundle.load(place).profiles["speed-and-separation"].limits["tcp_speed_mps"].maximum == 0.25
    found = bundle.read_cases(place)
    assert found.keys() - bundle.read_cases(POLICIES).keys() == {"tests/speed-and-separation.yaml"}
    assert found.items() >= bundle.read_cases(POLICIES).items()
    assert all(result.passed for result in cases.run(bundle.load(place), found))
    assert [path.name for path in place.parent.iterdir()] == ["candidate"]
    code, said = new(place, *REDUCED)
    assert code == 2
    assert "nothing is written over" in said


def test_what_is_not_given_is_asked_for_until_it_can_be_taken(tmp_path: Path) -> None:
    words = ["--template", "reduced-speed", "--ask", "--set", "profile=hall", "--set", "like=human-shared"]
    typed = "no\nRA 7\n0.3\n0.2\n0.1\n"  # strictest, assessment, too fast an arm, the arm, the base
    code, said = new(tmp_path / "candidate", *words, typed=typed)
    assert code == 0, said
    assert "`0.3` is no answer to `tcp_speed_mps`" in said
    assert "ISO 10218-1:2011 (reduced speed control" in said
    limits = bundle.load(tmp_path / "candidate").profiles["hall"].limits
    assert (limits["tcp_speed_mps"].maximum, limits["base_speed_mps"].maximum) == (0.2, 0.1)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--template", "reduced-speed"], "--set base_speed_mps="),
        ([*REDUCED, "--set", "speed=1"], "nothing is asked called `speed`"),
        ([*REDUCED, "--set", "tcp_speed_mps"], "`tcp_speed_mps` is no answer"),
        ([*REDUCED, "--set", "tcp_speed_mps=0.5"], "at most 0.25"),
        ([*REDUCED, "--set", "base_speed_mps=0.25"], "`base_speed_mps` is answered twice, `0.2` and `0.25`"),
        (["--template", "wish"], "reduced-speed | speed-and-separation"),
        (["--template", "wish"], "there is no template `wish`"),
    ],
)
def test_answers_that_are_missing_or_wrong_are_misuse_and_write_nothing(
    tmp_path: Path, words: list[str], said: str
) -> None:
    code, found = new(tmp_path / "candidate", *words)
    assert code == 2
    assert said in found
    assert not (tmp_path / "candidate").exists()


def test_answers_that_break_a_promise_of_the_policy_write_nothing_and_show_the_proposal(tmp_path: Path) -> None:
    given = {
        "reaction_s": "0.1", "stopping_s": "0.3", "intrusion_m": "0.2", "position_uncertainty_m": "0.08",
        "robot_uncertainty_m": "0.05", "tcp_speed_mps": "0.4", "base_speed_mps": "0.3", "assessment": "RA 7",
    }  # fmt: skip
    words = [word for key, value in given.items() for word in ("--set", f"{key}={value}")]
    code, found = new(tmp_path / "candidate", "--template", "speed-and-separation", *words)
    assert code == 1
    assert "`slow-arm-among-people` does not hold of `grasp_object`" in found
    assert "speed_mps" in found
    assert not (tmp_path / "candidate").exists()


def test_what_may_be_zero_is_asked_for_as_at_least_zero() -> None:
    done = CliRunner().invoke(app, ["policy", "new", "--list"])
    for key in ("intrusion_m", "position_uncertainty_m", "robot_uncertainty_m"):
        (asked,) = (line for line in done.output.splitlines() if line.split()[:1] == [key])
        assert "(a number at least 0; " in asked


def test_the_templates_are_explained_with_their_clauses() -> None:
    done = CliRunner().invoke(app, ["policy", "new", "--list"])
    assert done.exit_code == 0
    for word in ("ISO/TS 15066:2016, 5.5.4", "ISO 13482:2014", "(EU) 2024/1689", "no standard fixes it"):
        assert word in done.output


def test_a_candidate_is_checked_against_the_policy_that_agents_know(tmp_path: Path) -> None:
    shutil.copytree(POLICIES, tmp_path / "candidate")
    manifest = tmp_path / "candidate" / "capabilities" / "grasp_object.yaml"
    manifest.write_text(manifest.read_text().replace("default: 40", "default: 50"))
    words = ["policy", "check", str(tmp_path / "candidate"), "--no-proofs", "--against", str(POLICIES)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 1
    assert "grasp_object.yaml:3: version: 1.0.0 in force became 1.0.0, and what changed demands a major" in done.output
    manifest.write_text(manifest.read_text().replace("version: 1.0.0", "version: 2.0.0"))
    assert CliRunner().invoke(app, words).exit_code == 0


def test_what_is_wrong_with_the_policy_that_agents_know_is_written_as_other_findings_are(tmp_path: Path) -> None:
    shutil.copytree(POLICIES, tmp_path / "known")
    broken = tmp_path / "known" / "organization.yaml"
    broken.write_text(broken.read_text() + "nonsense: 1\n")
    words = ["policy", "check", str(POLICIES), "--no-proofs", "--against", str(tmp_path / "known")]
    done = CliRunner().invoke(app, [*words, "--format", "sarif"])
    assert done.exit_code == 1
    (found,) = orjson.loads(done.stdout)["runs"][0]["results"]
    assert "nonsense" in found["message"]["text"]
    assert str(broken) in orjson.dumps(found).decode()
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 1
    assert f"{broken}:" in done.output.replace("\n", "")
