"""A campaign gives the same tables however it was run, and loses nothing silently."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from importlib import metadata
from pathlib import Path, PurePath

import orjson
import pytest

from app.evaluation.campaign import (
    CampaignError,
    FolderBusy,
    OtherConfiguration,
    Request,
    makes_rows,
    run_campaign,
)
from app.evaluation.extensions import UnknownName
from app.evaluation.jobs import Job
from app.evaluation.parts import Parts, RowError
from app.evaluation.workers import JobFailed
from tests.conftest import PATIENCE_S, until

THREADS = os.environ.get("OMP_NUM_THREADS")
TOY = Path(__file__).with_name("toy.py")
POLICIES = Path("policies").resolve()
REQUEST = Request(
    protocol="toy",
    methods=("direct", "reins"),
    seeds=(3, 1),
    trials=8,
    policies=POLICIES,
    tasks=("sorting", "toy_task"),
    plugins=(TOY,),
)
SMALL = replace(REQUEST, methods=("direct",), tasks=("sorting",), seeds=(3,), trials=2)
JOB = Job("a", "reins", "sorting", 1, 0, 2)


def campaign(out: Path, request: Request = REQUEST, *, workers: int = 1, fresh: bool = False) -> list[tuple[int, int]]:
    seen: list[tuple[int, int]] = []
    run_campaign(request, out, workers=workers, progress=lambda done, total: seen.append((done, total)), fresh=fresh)
    return seen


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign that one process ran without interruption."""
    out = tmp_path_factory.mktemp("reference")
    assert campaign(out, workers=1)[-1] == (64, 64)
    return out


@pytest.fixture
def finished(reference: Path, tmp_path: Path) -> Path:
    """A folder of its own with that campaign in it."""
    return Path(shutil.copytree(reference, tmp_path / "finished"))


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign of one job, and beside it a plugin that adds nothing."""
    folder = tmp_path_factory.mktemp("small")
    plugin = folder / "more.py"
    plugin.write_text("def register(registry): pass\n", encoding="utf-8")
    campaign(folder / "out", plugged(SMALL, plugin))
    return folder


@pytest.fixture
def done(small: Path, tmp_path: Path) -> Path:
    """A folder of its own with both."""
    return Path(shutil.copytree(small, tmp_path / "small"))


def plugged(request: Request, plugin: Path) -> Request:
    return replace(request, plugins=(TOY, plugin))


def same(one: Path, other: Path) -> bool:
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in ("trials.csv", "results.json"))


def test_tables_are_the_same_whatever_the_number_of_processes(reference: Path, tmp_path: Path) -> None:
    campaign(tmp_path / "out", workers=3)
    assert same(reference, tmp_path / "out")


def test_rows_stand_in_the_order_of_the_request(reference: Path) -> None:
    with (reference / "trials.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    keys = [(row["method"], row["task"], int(row["seed"]), int(row["trial"])) for row in rows]
    assert keys == [
        (method, task, seed, trial)
        for method in REQUEST.methods
        for task in REQUEST.tasks
        for seed in REQUEST.seeds
        for trial in range(8)
    ]
    assert {row["launched"] for row in rows} == {"true", "false"}
    assert {row["class"] for row in rows if row["method"] == "reins"} == {"governed"}


def test_workers_use_one_thread_each_and_the_parent_what_it_did(reference: Path) -> None:
    with (reference / "trials.csv").open(encoding="utf-8") as file:
        assert {row["breach"] for row in csv.DictReader(file)} == {"1"}
    assert os.environ.get("OMP_NUM_THREADS") == THREADS


def test_clock_readings_stay_out_of_the_trials(reference: Path) -> None:
    assert "decision_us" not in (reference / "trials.csv").read_text(encoding="utf-8").splitlines()[0]
    with (reference / "timings.csv").open(encoding="utf-8") as file:
        timings = list(csv.DictReader(file))
    assert len(timings) == 48  # the toy times three trials of four
    assert all(float(row["decision_us"]) > 0 for row in timings)


def test_finished_jobs_are_not_run_again(finished: Path, reference: Path) -> None:
    kept = {path: path.stat().st_mtime_ns for path in (finished / "parts").iterdir()}
    lost = min(kept)
    lost.unlink()
    seen = campaign(finished)
    assert seen == [(59, 64), (64, 64)]
    assert {path for path, at in kept.items() if path.stat().st_mtime_ns != at} == {lost}
    assert same(reference, finished)


def test_a_part_that_is_cut_short_is_run_again(finished: Path, reference: Path) -> None:
    part = min((finished / "parts").iterdir())
    part.write_bytes(part.read_bytes()[:-20])
    assert campaign(finished)[0] == (59, 64)
    assert same(reference, finished)


def test_a_worker_that_dies_once_is_replaced_and_its_job_given_out_again(
    tmp_path: Path, reference: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trigger = tmp_path / "die"
    trigger.touch()
    monkeypatch.setenv("TOY_DIE_ONCE", str(trigger))
    campaign(tmp_path / "out", workers=2)
    assert not trigger.exists()
    assert same(reference, tmp_path / "out")


def test_a_job_that_kills_every_worker_ends_the_campaign_by_name(
    tmp_path: Path, reference: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setenv("TOY_DIE", "reins-toy_task-1-5")
        with pytest.raises(JobFailed, match=r"job `reins-toy_task-1-5` failed: .* exit code `-9`"):
            campaign(tmp_path, workers=2)
    assert not (tmp_path / "results.json").exists()
    campaign(tmp_path)
    assert same(reference, tmp_path)


def test_a_job_that_raises_ends_the_campaign_with_its_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TOY_RAISE", "direct-sorting-3-0")
    with pytest.raises(JobFailed, match="ArithmeticError: as asked") as caught:
        campaign(tmp_path)
    assert "misbehave" in caught.value.trace


def test_a_disk_without_room_ends_the_campaign_in_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TOY_FULL", "direct-sorting-3-0")
    with pytest.raises(JobFailed, match=r"job `direct-sorting-3-0` failed: .*File too large") as caught:
        campaign(tmp_path)
    assert caught.value.trace == ""


@pytest.mark.process
def test_an_interrupted_campaign_goes_on_where_it_was(
    tmp_path: Path, reference: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, gate, aside = tmp_path / "out", tmp_path / "gate", tmp_path / "aside"
    aside.mkdir()
    words = ["--protocol", "toy", "--methods", "direct,reins", "--seeds", "3,1", "--trials", "8", "--jobs", "1"]
    words += ["--no-ablations", "--tasks", "sorting,toy_task", "--plugin", str(TOY), "--out", str(out)]
    command = [sys.executable, "-m", "app.cli", "evaluate", *words]
    environment = {**os.environ, "TOY_GATE": str(gate), "NO_COLOR": "1", "TMPDIR": str(aside)}
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        until(lambda: list(out.glob("parts/*.jsonl")), what="a first part")
        assert list(aside.glob("reins-evaluation-*/*.journal"))
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, said
    assert b"the same command goes on from there" in said
    assert not list(aside.iterdir()), "an interrupted campaign leaves folders behind"
    assert not (out / "results.json").exists()
    assert 0 < len(list(out.glob("parts/*.jsonl"))) < 16
    gate.touch()
    ended = subprocess.run(command, env=environment, capture_output=True, timeout=PATIENCE_S, text=True)
    assert ended.returncode == 0, ended.stderr
    assert "UAIR" in ended.stdout
    assert not list(aside.iterdir()), "a campaign leaves folders behind"
    assert same(reference, out)


@pytest.mark.parametrize(
    ("field", "request_"),
    [("seeds", replace(SMALL, seeds=(4,))), ("trials", replace(SMALL, trials=3)), ("plugins", SMALL)],
)
def test_refuses_a_folder_of_another_configuration(field: str, request_: Request, done: Path) -> None:
    plugin = done / "more.py"
    if field == "plugins":
        plugin.write_text("def register(registry): ...\n", encoding="utf-8")
    other = plugged(request_, plugin)
    with pytest.raises(OtherConfiguration) as caught:
        campaign(done / "out", other)
    assert caught.value.differing == (field,)
    assert campaign(done / "out", other, fresh=True)[0][0] == 0


def test_a_campaign_that_finished_nothing_is_nothing_to_lose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setenv("TOY_RAISE", "direct-sorting-3-0")
        with pytest.raises(JobFailed):
            campaign(tmp_path, SMALL)
    assert campaign(tmp_path, replace(SMALL, seeds=(4,)))[-1] == (2, 2)


def test_rows_of_other_libraries_are_other_rows(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    was = orjson.loads((done / "out" / "results.json").read_bytes())["configuration"]["libraries"]
    assert was["mujoco"] == metadata.version("mujoco")
    versions = {**was, "mujoco": "4.9"}
    monkeypatch.setattr("app.evaluation.campaign.version", versions.__getitem__)
    with pytest.raises(OtherConfiguration) as caught:
        campaign(done / "out", plugged(SMALL, done / "more.py"))
    assert caught.value.differing == ("libraries",)


@pytest.mark.parametrize("removed", range(4))
def test_fresh_that_was_interrupted_is_gone_on_with(removed: int, done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = plugged(SMALL, done / "more.py")
    still, unlink = removed, Path.unlink

    def broken_off(path: Path, missing_ok: bool = False) -> None:
        nonlocal still
        if not path.exists() and missing_ok:
            return
        if still == 0:
            raise KeyboardInterrupt
        still -= 1
        unlink(path)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", broken_off)
        with pytest.raises(KeyboardInterrupt):
            campaign(done / "out", one, fresh=True)
    assert campaign(done / "out", one, fresh=True)[0][0] == 0


def test_fresh_leaves_a_folder_that_is_no_campaign_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(CampaignError, match=r"holds no campaign, but thesis\.txt: .*--fresh removes only"):
        campaign(tmp_path, fresh=True)
    assert (tmp_path / "thesis.txt").read_text(encoding="utf-8") == "mine"


def test_one_process_for_each_folder(tmp_path: Path) -> None:
    def meanwhile(done: int, total: int) -> None:
        with pytest.raises(FolderBusy):
            campaign(tmp_path)

    run_campaign(replace(REQUEST, trials=1), tmp_path, workers=1, progress=meanwhile)


@pytest.mark.parametrize("change", [{"methods": ("nix",)}, {"tasks": ("nix",)}, {"protocol": "nix"}])
def test_unknown_names_are_refused_with_the_valid_ones(change: dict[str, tuple[str, ...]], tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match=r"no \w+ `nix`: valid are .*toy"):
        campaign(tmp_path, replace(REQUEST, **change))


def test_a_row_with_an_unknown_column_leaves_no_part(tmp_path: Path) -> None:
    parts = Parts(tmp_path, "sha256:0")
    with pytest.raises(RowError, match="`colour`"):
        parts.write(JOB, [{"method": "reins"}, {"colour": "red"}])
    assert list(tmp_path.iterdir()) == []


def test_a_part_of_another_configuration_does_not_count(tmp_path: Path) -> None:
    Parts(tmp_path, "sha256:0").write(JOB, [{"method": "reins"}, {"trial": 1}])
    assert Parts(tmp_path, "sha256:0").has(JOB)
    assert list(Parts(tmp_path, "sha256:0").read(JOB)) == [{"method": "reins"}, {"trial": 1}]
    assert not Parts(tmp_path, "sha256:1").has(JOB)
    assert not Parts(tmp_path, "sha256:0").has(JOB._replace(seed=2))


def test_a_part_that_was_changed_since_does_not_count(tmp_path: Path) -> None:
    parts = Parts(tmp_path, "sha256:0")
    parts.write(JOB, [{"method": "reins", "launched": True}, {"trial": 1}])
    whole = parts.path(JOB).read_text(encoding="utf-8")
    for damaged in (
        whole.replace("true", "null"),
        whole.replace('"trial"', '"tri'),
        whole.replace('{"trial":1}\n', ""),
    ):
        assert damaged != whole
        parts.path(JOB).write_text(damaged, encoding="utf-8")
        assert not parts.has(JOB)
    parts.path(JOB).write_text(whole, encoding="utf-8")
    assert parts.has(JOB)


def test_a_job_name_is_a_file_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"job name `\.\./a`"):
        Parts(tmp_path, "sha256:0").path(JOB._replace(name="../a"))


def test_results_say_what_they_follow_from(reference: Path) -> None:
    results = json.loads((reference / "results.json").read_text(encoding="utf-8"))
    assert (results["protocol"], results["seeds"], results["trials"]) == ("toy", [3, 1], 8)
    assert results["configuration"]["policy"].startswith("sha256:")
    assert set(results["methods"]) == {"direct", "reins"}


COUNTS = frozenset(
    f"evaluation/{name}.py"
    for name in (
        *("counted", "metrics", "statistics", "safe_state", "paper_tables", "paper_unpublished"),
        *("physical_choices", "physical_counts", "physical_sums"),
    )
)
"""What protocols import to sum rows up; it makes none."""


def test_whatever_an_episode_imports_belongs_to_the_digest_of_the_code_and_the_server_does_not() -> None:
    """A protocol is imported in a process of its own, and by hand what it takes in says what rows can follow from."""
    asked = (
        "import sys, app.evaluation.workers, app.evaluation.protocols as protocols\n"
        "for name in ('paper', 'physical'): protocols.find_protocol(name)\n"
        "print(*(one.__file__ for name, one in sys.modules.items() if name.split('.')[0] == 'app'), sep='\\n')"
    )
    said = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True).stdout
    app = Path("app").resolve()
    imported = {Path(line).relative_to(app).as_posix() for line in said.splitlines()}
    assert {"evaluation/episode.py", "cell/runner.py", "governance/watcher.py", "sim/world.py"} <= imported
    assert {name for name in imported if not makes_rows(PurePath(name))} == COUNTS
    server = ("api/documents/cells.py", "audit/store.py", "runtime/kernel.py", "children.py", "proofs/prove.py")
    assert not [name for name in server if makes_rows(PurePath(name))]
    assert all((app / name).is_file() for name in server)
    assert makes_rows(PurePath("a_new_room/a_new_file.py"))
    assert makes_rows(PurePath("sim/workcell.py"))  # not the one beside it, which starts processes
