"""Protocol `paper` from jobs to results: same worlds, same rows, and tables that move as the paper's do."""

from __future__ import annotations

from functools import cache
from typing import Any

import orjson
import pytest

from app.evaluation import paper_protocol, paper_rows
from app.evaluation.extensions import UnknownName
from app.evaluation.jobs import Job
from app.evaluation.methods import ABLATIONS, METHODS
from app.evaluation.metrics import METRICS, measure
from app.evaluation.model import TASKS, Row, Violation
from app.evaluation.paper_generator import ALL, RECOVERY_FIRST
from app.evaluation.paper_runtime import Ending
from app.evaluation.paper_unpublished import UNPUBLISHED
from app.evaluation.parts import Parts
from app.evaluation.protocols import EvaluationProtocol, find_protocol
from app.evaluation.rows import COLUMNS
from tests.governance.policy_world import shipped

SEEDS, COUNT = (7, 77), 150
WORLD = ("task", "seed", "trial", "kind", "breach", "violation", "failure", "capability", "profile")


def rows_of(*methods: str, tasks: tuple[str, ...] = (ALL,)) -> list[Row]:
    listed = paper_protocol.jobs(methods=methods, tasks=tasks, seeds=SEEDS, trials=COUNT)
    return [row for job in listed for row in paper_protocol.run(job, shipped())]


@cache
def everything() -> tuple[list[Row], dict[str, Any]]:
    rows = rows_of(*METHODS, *ABLATIONS)
    return rows, paper_protocol.results(rows, shipped())


def mean(name: str, metric: str) -> float | None:
    found = everything()[1]
    return {**found["methods"], **found["ablations"]}[name][metric]["mean"]


def timeless(rows: list[Row]) -> list[Row]:
    return [{**row, "decision_us": None} for row in rows]


def test_is_the_protocol_that_a_campaign_asks_for() -> None:
    assert isinstance(find_protocol("paper"), EvaluationProtocol)


def test_jobs_have_names_of_their_own_that_are_file_names(tmp_path: Any) -> None:
    listed = paper_protocol.jobs(methods=[*METHODS, *ABLATIONS], tasks=(), seeds=SEEDS, trials=9)
    paths = {Parts(tmp_path, "").path(job) for job in listed}
    assert len(paths) == len(listed) == 2 * 11 * len(TASKS) * len(SEEDS)
    assert {job.count for job in listed if job.first == RECOVERY_FIRST} == {5}


def test_the_same_job_gives_the_same_rows_whole_or_in_pieces() -> None:
    whole = timeless(list(paper_protocol.run(Job("", "reins", "sorting", 7, 0, 60), shipped())))
    pieces = [Job("", "reins", "sorting", 7, first, 20) for first in (40, 0, 20)]
    found = timeless([row for job in pieces for row in paper_protocol.run(job, shipped())])
    assert sorted(found, key=lambda row: row["trial"]) == whole  # type: ignore[arg-type,return-value]


def test_every_method_meets_the_same_world() -> None:
    worlds = {
        name: [tuple(row[column] for column in WORLD) for row in everything()[0] if row["method"] == name]
        for name in (*METHODS, *ABLATIONS)
    }
    assert all(world == worlds["reins"] for world in worlds.values())
    assert len(worlds["reins"]) == len(SEEDS) * (COUNT + COUNT // 2)


def test_a_row_has_every_column_and_one_class() -> None:
    for row in everything()[0]:
        assert list(row) == list(COLUMNS)
        assert row["class"] in set(Ending)


def test_reins_intercepts_everything_and_rejects_nothing() -> None:
    assert (mean("reins", "UAIR"), mean("reins", "FRR")) == (1.0, 0.0)


@pytest.mark.parametrize("name", [*METHODS, *ABLATIONS])
def test_no_method_rejects_what_is_authorized(name: str) -> None:
    assert mean(name, "FRR") == 0.0


def test_more_governance_intercepts_more() -> None:
    assert mean("direct", "UAIR") == 0.0
    assert 0.0 < mean("static-rule", "UAIR") < 1.0  # type: ignore[operator]
    assert mean("capability-internal", "UAIR") == mean("static-rule", "UAIR")
    assert mean("autort-style", "UAIR") == mean("roboguard-style", "UAIR") == 1.0


def test_without_the_watcher_nothing_is_detected_and_everything_goes_on() -> None:
    assert (mean("-watcher", "RVDR"), mean("-watcher", "UCR"), mean("-watcher", "CEF")) == (0.0, 1.0, None)
    assert mean("-watcher", "RSR") == mean("reins", "RSR")


def test_without_recovery_little_recovers_and_nothing_complies() -> None:
    assert mean("reins", "RPC") == 1.0
    assert mean("-recovery", "RPC") == 0.0
    assert mean("-recovery", "RSR") < mean("reins", "RSR")  # type: ignore[operator]
    assert mean("-recovery", "RVDR") == mean("reins", "RVDR")


@pytest.mark.parametrize("name", ["-admission", "-policy", "-human"])
def test_without_a_part_of_the_gate_something_gets_through(name: str) -> None:
    assert mean(name, "UAIR") < 1.0  # type: ignore[operator]
    assert mean(name, "RVDR") == mean("reins", "RVDR")


def test_each_part_of_the_gate_stops_what_is_its_own() -> None:
    through = {
        name: {row["breach"] for row in everything()[0] if row["method"] == name and row["class"] == Ending.LET_THROUGH}
        for name in ("-admission", "-policy", "-human", "static-rule")
    }
    assert through["-admission"] == {"missing_permission"}
    assert through["-policy"] >= {"forbidden_zone", "restricted_object"}
    assert through["-human"] == {"missing_approval"}
    assert through["static-rule"] == {"forbidden_zone", "restricted_object", "missing_approval"}


def test_reins_recovers_more_than_a_retry_and_only_it_rolls_back() -> None:
    assert mean("reins", "RSR") > mean("capability-internal", "RSR") > mean("direct", "RSR")  # type: ignore[operator]
    assert mean("direct", "RSR") == mean("roboguard-style", "RSR")
    assert mean("reins", "RBSR") > 0.8  # type: ignore[operator]
    assert mean("direct", "RBSR") is None
    assert mean("direct", "RBSR_ALL") == 0.0


def test_what_the_coin_cannot_have_is_left_out() -> None:
    assert {mean("reins", name) for name in ("MRT", "DL_MS_P95", "RVDR_BOUNDARY", "FAS", "RSR_SURFACE")} == {None}


def test_override_blocks_all_that_is_not_approved_and_only_that() -> None:
    table = everything()[1]["human_override"]
    found = {name: [table[name][key]["mean"] for key in table[name]] for name in table}
    assert found == {"with override": [1.0, 0.0, 0.0], "without override": [0.0, 1.0, 0.0]}


def test_the_sweep_detects_more_and_continues_less_step_by_step() -> None:
    sweep = everything()[1]["sensitivity"]
    assert [point["s"] for point in sweep] == [step / 10 for step in range(11)]
    detected, unsafe = ([point[name]["mean"] for point in sweep] for name in ("RVDR", "UCR"))
    assert detected == sorted(detected)
    assert (detected[0], detected[-1]) == (0.0, 1.0)
    assert unsafe == sorted(unsafe, reverse=True)
    assert unsafe[0] == 1.0
    assert len({point["RSR"]["mean"] for point in sweep}) == 1
    assert sweep[7]["RVDR_PEOPLE"]["mean"] == 0.0 < sweep[8]["RVDR_PEOPLE"]["mean"]


def test_the_confusion_matrix_counts_every_trial_once() -> None:
    for name, table in everything()[1]["confusion"].items():
        assert table["TP"] + table["FP"] + table["FN"] + table["TN"] == len(SEEDS) * (COUNT + COUNT // 2)
        assert (table["FP"], table["false_rejections"]) == (0, {})
        assert (table["FN"] == 0) is (name in {"reins", "autort-style", "roboguard-style", "-watcher", "-recovery"})


def test_a_false_rejection_is_counted_where_it_happened() -> None:
    confusion = paper_protocol.paper_tables.Confusion()
    for launched in (True, False, False):
        confusion.add({"kind": "clean", "launched": launched, "capability": "grasp_object", "profile": "test-audit"})
    table = confusion.table()
    assert (table["FP"], table["TN"]) == (2, 1)
    assert table["false_rejections"] == {"grasp_object": {"test-audit": 2}}


def test_latency_times_every_component_as_often_as_asked() -> None:
    table = everything()[1]["latency"]
    parts = {"clock", "admission", "policy_guard", "watcher_step", "recovery", "total_pre_execution"}
    assert set(table) == parts
    for found in table.values():
        assert found["n"] == len(SEEDS) * COUNT
        assert 0.0 < found["p50"] <= found["p99"]


def test_shares_of_classes_add_up_for_every_kind() -> None:
    for kinds in everything()[1]["classes"].values():
        assert set(kinds) == {"unauthorized", "perturbed", "recoverable"}
        assert all(sum(shares.values()) == pytest.approx(1.0) for shares in kinds.values())


def test_results_are_json_with_every_table() -> None:
    found = orjson.loads(orjson.dumps(everything()[1]))
    assert list(found) == [
        "methods", "classes", "class_meanings", "per_type", "unsafe_per_type", "per_task", "ablations",
        "human_override", "sensitivity", "latency", "confusion", "effect_sizes", "unpublished",
    ]  # fmt: skip
    assert set(found["methods"]) == set(METHODS)
    assert set(found["methods"]["reins"]) == set(METRICS)
    assert set(found["ablations"]) == set(ABLATIONS)
    assert set(found["effect_sizes"]) == set(METHODS) - {"reins"}
    assert set(found["per_type"]["reins"]) == set(found["unsafe_per_type"]["reins"]) == set(Violation)
    assert found["unsafe_per_type"]["direct"]["zone"] == found["methods"]["direct"]["UCR_ZONE"]
    assert set(found["per_task"][ALL]) == {*METHODS, *ABLATIONS}
    assert found["methods"]["reins"]["UAIR"]["per_seed"] == {"7": 1.0, "77": 1.0}


def test_rows_without_any_method_but_one_make_results_as_well() -> None:
    found: Any = paper_protocol.results(rows_of("direct", tasks=("sorting",))[:40], shipped())
    assert (found["ablations"], found["effect_sizes"]) == ({}, {})
    assert list(found["per_task"]) == ["sorting"]


def test_whatever_is_unpublished_names_what_hangs_on_it() -> None:
    known = {*METRICS, *everything()[1], "std"}
    assert len({one.parameter for one in UNPUBLISHED}) == len(UNPUBLISHED)
    for one in UNPUBLISHED:
        assert set(one.affects) <= known
        assert one.describe()["here"]


def test_what_is_said_of_warnings_is_what_the_rates_do() -> None:
    rows = [
        paper_rows.row(METHODS["reins"], shipped(), SEEDS[0], ALL, number, sensitivity=1.0) for number in range(COUNT)
    ]
    there, warned = (
        [one for one in rows if one["occurred"]],
        [one for one in rows if one["class"] == Ending.WARNED.value],
    )
    found = measure(rows, ("UCR", "CEF"))
    assert warned
    assert found["UCR"]["n"] == found["CEF"]["n"] == len(there) - len(warned)
    (said,) = (one for one in UNPUBLISHED if one.parameter == "what follows a detection")
    assert "UCR and CEF leave those out" in said.here


def test_names_the_methods_there_are() -> None:
    with pytest.raises(UnknownName, match="no method `luck`: valid are direct"):
        list(paper_protocol.run(Job("", "luck", ALL, 7, 0, 1), shipped()))
