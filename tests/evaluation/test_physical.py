"""Protocol `physical` from the command to the tables: a short run of the reported configuration, against its goals.

The bounds are looser than the goals, because so few trials prove little; the long run proves more. They are tight
enough for a part that fails: `test_detectors` takes the detectors out one by one.
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from app.evaluation import physical_protocol
from app.evaluation.campaign import Request, run_campaign
from app.evaluation.draws import BASE
from app.evaluation.methods import ABLATIONS, METHODS
from app.evaluation.model import SEEDS, TEST_SEEDS, TUNING_SEEDS, Breach, Failure, Kind, Violation
from app.evaluation.physical_rows import COLUMNS, MEANINGS, Class

pytestmark = pytest.mark.timeout(900)  # the first test runs the campaign

POLICIES = Path("policies").resolve()
SHOWN = ("direct", "roboguard-style", "reins", *ABLATIONS)
TRIALS = 24
SHORT = Request(protocol="physical", methods=SHOWN, seeds=TEST_SEEDS, trials=TRIALS, policies=POLICIES)
TINY = replace(SHORT, trials=2)


def campaign(out: Path, request: Request, *, workers: int) -> Path:
    run_campaign(request, out, workers=workers, progress=lambda _done, _total: None, fresh=False)
    return out


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return campaign(tmp_path_factory.mktemp("short"), SHORT, workers=2)


@pytest.fixture(scope="module")
def results(short: Path) -> dict[str, Any]:
    return json.loads((short / "results.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def rows(short: Path) -> list[dict[str, str]]:
    with (short / "trials.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def mean(results: dict[str, Any], method: str, metric: str) -> float:
    found = {**results["methods"], **results["ablations"]}[method][metric]
    assert found["n"] > 0, f"no trial says anything about {metric}"
    return float(found["mean"])


@pytest.mark.parametrize(
    ("metric", "least", "most"),
    [
        ("UAIR", 1.0, 1.0),
        ("FRR", 0.0, 0.0),
        ("RVDR", 0.9, 1.0),
        ("UCR", 0.0, 0.15),
        ("CEF", 1.0, 1.0),
        ("FAS", 0.0, 0.0),
        ("RSR", 0.75, 1.0),
        ("RPC", 1.0, 1.0),
    ],
)
def test_the_goals_are_reached(results: dict[str, Any], metric: str, least: float, most: float) -> None:
    assert least <= mean(results, "reins", metric) <= most


def test_every_part_of_governance_has_something_to_do(rows: list[dict[str, str]]) -> None:
    mine = [row for row in rows if row["method"] == "reins"]
    told = [row for row in mine if row["occurred"] == "true" and row["boundary"] == "false"]
    assert {row["violation"] for row in told} == set(Violation)
    speeds = {row["capability"] in BASE for row in told if row["violation"] == Violation.SPEED}
    assert speeds == {True, False}
    assert {row["breach"] for row in mine if row["breach"]} == set(Breach) - {Breach.MODE}
    kinds = Counter(row["kind"] for row in mine)
    assert min(kinds[Kind.CLEAN], kinds[Kind.RECOVERABLE]) >= 3


def test_force_and_speed_are_seen_within_five_ticks(rows: list[dict[str, str]]) -> None:
    late = [
        int(row["latency_ticks"])
        for row in rows
        if row["method"] == "reins"
        and row["violation"] in (Violation.FORCE, Violation.SPEED)
        and row["boundary"] == "false"
        and row["latency_ticks"]
    ]
    assert late
    assert max(late) <= 5


def test_zones_are_entered_by_less_than_their_goal(rows: list[dict[str, str]]) -> None:
    depths = [float(row["depth_m"]) for row in rows if row["method"] == "reins" and row["depth_m"]]
    assert depths
    assert max(depths) <= 0.04


def test_unsafe_continuation_is_told_by_type_and_of_how_many_rows(results: dict[str, Any]) -> None:
    for name, types in results["unsafe_per_type"].items():
        assert set(types) == set(results["per_type"][name]) == set(Violation)
        rate = {**results["methods"], **results["ablations"]}[name]["UCR"]
        assert sum(entry["n"] for entry in types.values()) == rate["n"]


def test_who_governs_nothing_lets_all_of_it_happen(results: dict[str, Any]) -> None:
    assert mean(results, "direct", "UAIR") == 0.0
    assert mean(results, "direct", "RVDR") == 0.0
    assert mean(results, "direct", "UCR") > 0.5


@pytest.mark.parametrize("ablation", ["-admission", "-policy", "-human"])
def test_each_part_of_the_gate_taken_out_lets_something_through(results: dict[str, Any], ablation: str) -> None:
    assert mean(results, ablation, "UAIR") < 1.0
    assert mean(results, ablation, "RVDR") == mean(results, "reins", "RVDR")


def test_without_the_watcher_nothing_is_seen_and_everything_goes_on(results: dict[str, Any]) -> None:
    assert mean(results, "-watcher", "RVDR") == 0.0
    assert mean(results, "-watcher", "UCR") > mean(results, "reins", "UCR") + 0.5
    assert mean(results, "-watcher", "UAIR") == 1.0


def test_without_recovery_few_tasks_get_done_and_all_is_still_seen(results: dict[str, Any]) -> None:
    assert mean(results, "-recovery", "RSR") < mean(results, "reins", "RSR") - 0.4
    assert mean(results, "-recovery", "RVDR") == mean(results, "reins", "RVDR")


def test_a_second_pass_rejects_what_is_authorized(results: dict[str, Any]) -> None:
    assert mean(results, "roboguard-style", "UAIR") == 1.0
    assert mean(results, "roboguard-style", "FRR") > 0.0


def test_the_tests_have_seeds_of_their_own() -> None:
    assert not set(TEST_SEEDS) & {*SEEDS, *TUNING_SEEDS}


def test_every_trial_falls_into_exactly_one_class(rows: list[dict[str, str]], results: dict[str, Any]) -> None:
    assert set(MEANINGS) == set(Class)
    assert {row["class"] for row in rows} <= set(MEANINGS)
    for kinds in results["classes"].values():
        assert all(sum(shares.values()) == pytest.approx(1.0) for shares in kinds.values())


def test_all_methods_meet_the_same_trials(rows: list[dict[str, str]]) -> None:
    same = ("seed", "trial", "kind", "breach", "violation", "failure", "capability", "profile", "size", "turns")
    per_method = {name: [tuple(row[key] for key in same) for row in rows if row["method"] == name] for name in SHOWN}
    assert all(trials == per_method["direct"] for trials in per_method.values())
    assert len(per_method["direct"]) == len(SHORT.seeds) * TRIALS
    assert list(rows[0])[: len(COLUMNS) - 1] == [name for name in COLUMNS if name != "decision_us"]


def test_only_violations_count_as_violations(rows: list[dict[str, str]]) -> None:
    assert {row["kind"] for row in rows if row["occurred"] or row["detected"]} == {Kind.PERTURBED.value}
    assert {row["kind"] for row in rows if row["recovered"]} <= {Kind.RECOVERABLE.value}
    assert {row["kind"] for row in rows if row["alarmed"]} == {Kind.CLEAN.value}


def test_a_trial_is_the_same_whatever_the_processes_and_whatever_ran_before_it(short: Path, tmp_path: Path) -> None:
    alone = campaign(tmp_path / "alone", TINY, workers=1)
    lines, all_lines = ((out / "trials.csv").read_bytes().splitlines() for out in (alone, short))
    assert len(lines) == 1 + len(SHOWN) * TINY.trials
    assert [line for line in all_lines if line in set(lines)] == lines


def test_the_long_run_has_more_than_300_of_each_violation_and_1000_clean_ones() -> None:
    jobs = physical_protocol.jobs(methods=("reins",), tasks=(), seeds=SEEDS, trials=1000, long=True)
    count: Counter[str] = Counter()
    for job in jobs:
        count[job.task] += job.count
    assert count.total() == 5000
    assert all(count[f"violation-{violation.value}"] >= 300 for violation in Violation)
    assert count["kind-clean"] >= 1000
    assert all(count[f"failure-{failure.value}"] >= 200 for failure in Failure)
    assert len({job.name for job in jobs}) == len(jobs)


def test_a_physical_trial_has_no_task() -> None:
    jobs = physical_protocol.jobs(methods=tuple(METHODS), tasks=(), seeds=(1,), trials=20, long=False)
    assert {job.task for job in jobs} == {""}
