"""`reins evaluate` on the command line: what it refuses, and what it says."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from app import cli_evaluate
from app.cli import app
from app.evaluation import physical_protocol
from app.evaluation.campaign import Request
from app.governance.model import Json
from tests.evaluation import toy

TOY = str(Path(toy.__file__))


def evaluate(*words: str, out: Path) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["evaluate", *words, "--plugin", TOY, "--out", str(out)])
    return result.exit_code, " ".join(result.output.split())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--protocol", "nix"], "no protocol `nix`: valid are"),
        (["--protocol", "toy", "--methods", "nix"], "no method `nix`: valid are direct, static-rule"),
        (["--protocol", "toy", "--tasks", "nix"], "no task `nix`: valid are waypoint_reaching"),
        (
            ["--protocol", "paper", "--tasks", "fault-toy_fault"],
            "no task `fault-toy_fault`: valid are waypoint_reaching",
        ),
        (["--protocol", "physical", "--tasks", "fault-nix"], "no fault `fault-nix`: valid are fault-"),
        (["--protocol", "physical", "--long", "--tasks", "all"], "--long with --tasks `all`: valid is one of them"),
        (
            ["--protocol", "physical", "--long", "--trials", "12"],
            "--long with --trials `12`: this long run has 1,000 for each seed, spread over 5; valid is one of them",
        ),
        *(
            (
                ["--protocol", "physical", "--long", *words],
                f"--long with methods `{named}`: the long run is of one method alone; valid is `reins`",
            )
            for words, named in (
                (["--methods", "direct,reins"], "direct,reins"),
                (["--methods", "direct"], "direct"),
                (["--ablations"], "reins,-admission,-policy,-watcher,-recovery,-human"),
            )
        ),
        (["--protocol", "paper", "--long"], "--long with protocol `paper`: it has no long run; valid is"),
        (["--protocol", "toy", "--seeds", "4,x"], "seed `x`: valid are integers from 0 on"),
        (["--protocol", "toy", "--seeds", "1,2,1"], "--seeds `1,2,1` names `1` twice: valid are seeds that differ"),
        (
            ["--methods", "reins,direct,reins"],
            "--methods `reins,direct,reins` names `reins` twice: valid are methods that",
        ),
        (["--protocol", "physical", "--studies", "drift,drift"], "--studies `drift,drift` names `drift` twice"),
        (["--protocol", "physical", "--tasks", "sorting, sorting"], "--tasks `sorting, sorting` names `sorting` twice"),
        (["--protocol", "toy", "--seeds", str(2**64)], f"seed `{2**64}`: valid are integers from 0 on, below 2⁶⁴"),
        (["--protocol", "toy", "--trials", "-1"], "--trials `-1`: valid is 0 or more"),
        (["--protocol", "toy", "--trials", "9" * 23], "valid is 0 or more, up to 1,000,000,000"),
        (["--protocol", "toy", "--jobs", "-2"], "--jobs `-2`: valid is 0 or more"),
        (["--protocol", "toy", "--seeds", "1,01"], "--seeds `1,01` names `1` twice"),
        (
            ["--protocol", "toy", "--fault-size", "2"],
            "with protocol `toy`: it has neither sensors nor faults of a size",
        ),
        (["--protocol", "physical", "--fault-size", "0"], "fault size `0.0`: valid is above 0"),
        (["--protocol", "physical", "--sensor-noise", "-1"], "sensor noise `-1.0`: valid is 0 (none) or more"),
        (["--protocol", "physical", "--tracker-dropout", "2"], "tracker dropout `2.0`: valid is 0 to 1"),
        (["--protocol", "physical", "--walks", "moon"], "walks `moon`: valid are usual, other"),
        (
            ["--protocol", "physical", "--walks", "other", "--studies", "all"],
            "circumstances `walks=other` with --studies: studies have circumstances of their own",
        ),
        (["--protocol", "toy", "--seeds", ""], "--seeds `` names nothing: valid are names"),
        (["--protocol", "toy", "--seeds", ","], "--seeds `,` names nothing: valid are names"),
        (["--protocol", "toy", "--methods", ""], "--methods `` names nothing: valid are names"),
        (["--protocol", "paper", "--studies", "all"], "--studies `all`: protocol `paper` has none"),
        (["--protocol", "toy", "--readme", __file__], "has no place for the table"),
        (["--protocol", "toy", "--plugin", "none.py"], "plugin `none.py` cannot be read"),
    ],
)
def test_misuse_names_what_is_valid(words: list[str], said: str, tmp_path: Path) -> None:
    code, text = evaluate(*words, out=tmp_path)
    assert code == 2
    assert said in text
    assert list(tmp_path.iterdir()) == []


def test_ends_with_a_table_of_what_was_measured(tmp_path: Path) -> None:
    words = ["--protocol", "toy", "--seeds", "1", "--trials", "4", "--jobs", "1", "--tasks", "sorting"]
    code, text = evaluate(*words, "--methods", "reins,toy-method", "--ablations", out=tmp_path)
    assert code == 0, text
    assert "UAIR" in text
    assert "RVDR" not in text
    assert all(name in text for name in ("reins", "toy-method", "-watcher"))
    assert (tmp_path / "trials.csv").is_file()
    code, text = evaluate(*words, "--methods", "reins", out=tmp_path)
    assert code == 2
    assert "another configuration: methods differ" in text
    code, _ = evaluate(*words, "--methods", "reins", "--fresh", out=tmp_path)
    assert code == 0


def test_the_long_run_says_how_many_trials_each_seed_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Request] = []

    def run(request: Request, _folder: Path, **_others: object) -> int:
        asked.append(request)
        return 0

    monkeypatch.setattr(cli_evaluate, "_run", run)
    for seeds in ((), ("--seeds", "5"), ("--seeds", "5,6"), ("--trials", "1000")):
        code, text = evaluate("--protocol", "physical", "--long", *seeds, out=tmp_path)
        assert code == 0, text
    assert [request.trials for request in asked] == [1000, 5000, 2497, 1000]
    for request in asked:
        long = physical_protocol.jobs(
            methods=request.methods, tasks=(), seeds=request.seeds, trials=request.trials, long=True
        )
        assert sum(job.count for job in long) == request.trials * len(request.seeds)


def test_studies_alone_end_without_an_empty_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def measured(*_words: object, **_others: object) -> dict[str, Json]:
        return {"protocol": "physical", "seeds": [1], "trials": 0, "methods": {}, "ablations": {}}

    monkeypatch.setattr(cli_evaluate, "_measured", measured)
    code, text = evaluate("--protocol", "physical", "--studies", "drift", "--trials", "0", out=tmp_path)
    assert code == 0, text
    assert "report.html, results.json" in text
    assert "method" not in text


def test_help_teaches_by_example() -> None:
    text = CliRunner().invoke(app, ["evaluate", "--help"], env={"COLUMNS": "200"}).output
    assert "reins evaluate --protocol physical --long" in text
    assert "--fresh" in text
    assert "The boundary band" in text


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--protocol", "physical", "--seeds", "7"], "--seeds `7`"),
        (["--protocol", "paper", "--seeds", "42,123,456,789"], "--seeds `42,123,456,789`"),
        (["--protocol", "paper", "--methods", "direct"], "--methods `direct`"),
        (["--protocol", "paper", "--trials", "200"], "--trials `200`"),
        (["--protocol", "physical", "--trials", "0", "--studies", "drift"], "--trials `0`"),
        (["--protocol", "physical", "--tasks", "sorting", "--trials", "200"], "--tasks `sorting`"),
        (["--protocol", "physical", "--long", "--trials", "1000"], "--long, --trials `1000`"),
        (
            ["--protocol", "physical", "--methods", "reins", "--seeds", "7", "--trials", "0", "--studies", "drift"],
            "--seeds `7`, --trials `0`",
        ),
    ],
)
def test_what_is_not_the_reported_configuration_is_kept_out_of_the_readme(
    words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli_evaluate, "_run", never)
    code, text = evaluate(*words, "--readme", str(tmp_path / "README.md"), out=tmp_path)
    assert code == 2
    assert f"--readme with {said}: the README quotes the reported configuration" in text


def test_another_policy_is_kept_out_of_the_readme(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli_evaluate, "_run", never)
    policies = shutil.copytree("policies", tmp_path / "policies")
    code, text = evaluate("--policies", str(policies), "--readme", str(tmp_path / "README.md"), out=tmp_path)
    assert code == 2
    assert f"--readme with --policies `{policies}`" in text


def never(*_words: object, **_others: object) -> int:
    raise AssertionError("nothing may be run")


@pytest.mark.parametrize(
    "words",
    [
        ["--protocol", "paper"],
        ["--protocol", "physical", "--methods", "all", "--trials", "200", "--studies", "all"],
        ["--protocol", "physical", "--methods", "direct,reins", "--seeds", "42,123,456,789,1024"],
    ],
)
def test_the_reported_configuration_goes_into_the_readme(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(*_words: object, **_others: object) -> int:
        return 0

    monkeypatch.setattr(cli_evaluate, "_run", run)
    code, text = evaluate(*words, "--readme", str(tmp_path / "README.md"), out=tmp_path)
    assert code == 0, text


@pytest.mark.parametrize(("place", "why"), [("file", "file exists"), ("file/deep/campaign", "not a directory")])
def test_a_folder_that_cannot_be_written_is_named_before_anything_is_run(place: str, why: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("kept")
    out = tmp_path / place
    code, text = evaluate("--protocol", "toy", "--seeds", "1", "--trials", "4", "--jobs", "1", out=out)
    assert code == 2
    assert f"--out `{out}` cannot be written to: {why} valid is a folder" in text
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_policy_that_does_not_load_is_told_of_by_file_before_anything_is_made(tmp_path: Path) -> None:
    policies, out = tmp_path / "policies", tmp_path / "out"
    shutil.copytree("policies", policies)
    (policies / "profiles" / "stray.yaml").write_text("nix: 1\n")
    words = ["--protocol", "toy", "--seeds", "1", "--trials", "1", "--jobs", "1", "--policies", str(policies)]
    code, text = evaluate(*words, out=out)
    assert code == 1
    assert "profiles/stray.yaml:1" in text
    assert f"in `{policies}`" in text
    assert not out.exists()
