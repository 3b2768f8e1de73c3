"""Humans asked midway, rollbacks, latencies and overrides: counted from rows, and shown where there is anything."""

from __future__ import annotations

from typing import Any

import pytest

from app.evaluation.metrics import Tally
from app.evaluation.model import Row
from app.evaluation.physical_counts import Escalations, Latencies, Redraws, Rollbacks, common_recoveries, overridden
from app.evaluation.report_counts import (
    asked_grids,
    common_grids,
    ended_text,
    latency_grids,
    redraw_grids,
    rollback_grids,
)


def row(**columns: Any) -> Row:
    return {"launched": True, "class": "held", "violation": "force", **columns}


def asked(*rows: Row) -> dict[str, dict[str, Any]]:
    counts = Escalations()
    for one in rows:
        counts.add(one)
    return counts.entries()


def undone(*rows: Row) -> dict[str, dict[str, int]]:
    counts = Rollbacks()
    for one in rows:
        counts.add(one)
    return counts.entries()


def test_sessions_that_asked_are_counted_by_what_went_wrong_with_waits_answers_and_outcomes() -> None:
    found = asked(
        row(asked=1, midway_s=2.0, answers="resolve_terminate", outcome="terminated"),
        row(asked=2, midway_s=4.0, answers="resolve_continue resolve_terminate", outcome="terminated"),
        row(asked=0, outcome="succeeded"),
        row(violation=None, failure="timeout", asked=1, midway_s=3.0, outcome=None),
        row(asked=1, launched=False),
        row(asked=1, **{"class": "not_taken"}),
        row(asked=1, violation=None),
    )
    assert list(found) == ["force", "timeout", "all"]
    assert (found["force"]["sessions"], found["force"]["asked"], found["force"]["times"]) == (3, 2, 3)
    assert found["force"]["waited_s_mean"] == pytest.approx(3.0)
    assert found["force"]["answers"] == {"resolve_terminate": 2, "resolve_continue": 1}
    assert found["all"]["outcomes"] == {"terminated": 2, "not ended": 1}


def test_where_nobody_is_ever_asked_there_is_nothing_to_show() -> None:
    assert asked(row(asked=0)) == {}
    assert list(asked_grids({"escalations": {}})) == []


def test_rollbacks_that_miss_are_told_from_those_that_had_nothing_to_bring_back() -> None:
    found = undone(
        row(rolled_back=True, rollback_capable=True),
        row(rolled_back=False, rollback_capable=True),
        row(rolled_back=False, rollback_capable=False),
        row(rolled_back=None),
        row(violation=None, failure="withdrawn", rolled_back=True, rollback_capable=True),
    )
    assert found["force"] == {"tried": 3, "capable": 2, "verified": 1, "missed": 1, "beyond": 1}
    assert found["all"]["tried"] == 4
    assert list(found) == ["force", "withdrawn", "all"]
    assert undone() == {}


def test_latencies_are_of_every_decision_and_of_what_was_detected() -> None:
    told = Latencies()
    for one in (
        row(decision_us=2.0, occurred=True, detected=True, latency_ticks=1),
        row(decision_us=4.0, occurred=True, detected=False),
        row(occurred=False),
    ):
        told.add(one)
    found = told.entries()
    assert (found["decision_us"]["n"], found["decision_us"]["p50"]) == (2, 3.0)
    assert (found["detection_ticks"]["n"], found["detection_ticks"]["p99"]) == (1, 1.0)
    assert Latencies().entries()["decision_us"] == {"n": 0, "p50": None, "p95": None, "p99": None}


def test_requests_without_approval_are_blocked_by_the_override_and_by_nothing_else() -> None:
    approvals = {name: Tally(["UAIR"]) for name in ("reins", "-human", "direct")}
    for name, tally in approvals.items():
        for seed in (1, 2):
            tally.add({"seed": seed, "kind": "unauthorized", "launched": name != "reins"})
    found = overridden(approvals)
    assert set(found) == {"with override", "without override"}
    assert (found["with override"]["BLOCK_RATE"]["mean"], found["with override"]["INCORRECT_ALLOW"]["mean"]) == (1, 0)
    assert (found["without override"]["BLOCK_RATE"]["mean"], found["without override"]["INCORRECT_ALLOW"]["n"]) == (
        0,
        2,
    )
    assert overridden({}) == {}


def test_faults_that_were_drawn_again_are_counted_and_shown_by_what_was_to_go_wrong() -> None:
    counts = Redraws()
    for one in (
        row(turns=0),
        row(turns=2),
        row(turns=5, **{"class": "not_taken"}),
        row(violation=None, failure="timeout", turns=1),
        row(violation=None, turns=0),
    ):
        counts.add(one)
    found = counts.entries()
    assert found["force"] == {"trials": 3, "again": 2, "redraws": 7, "never": 1}
    assert (list(found), found["all"]["trials"], found["all"]["redraws"]) == (["force", "timeout", "all"], 4, 8)
    (grid,) = redraw_grids({"redraws": found})
    assert dict(grid.rows)["all"] == ("4", "3", "8", "1")
    assert [*redraw_grids({"redraws": Redraws().entries()})] == []


def test_recovery_times_are_compared_over_the_trials_that_both_recovered() -> None:
    took = {
        "direct": {("", 7, 1): 3.0, ("", 7, 2): 5.0},
        "reins": {("", 7, 2): 8.0, ("", 7, 3): 100.0},
        "static-rule": {("", 7, 1): 1.0},
    }
    found = common_recoveries(took, "reins")
    assert found == {"direct": {"n": 1, "theirs_s": 5.0, "ours_s": 8.0}}
    (grid,) = common_grids({"common_recoveries": found})
    assert dict(grid.rows)["Direct execution"] == ("1", "5.00", "8.00")
    assert common_recoveries({"direct": took["direct"]}, "reins") == {}


def test_tables_say_what_was_counted() -> None:
    results = {
        "escalations": {
            name: asked(row(asked=1, midway_s=2.0, answers="resolve_terminate", outcome="terminated"))
            for name in ("reins", "-recovery")
        },
        "rollbacks": {"reins": undone(row(rolled_back=True, rollback_capable=True))},
        "latencies": {"direct": Latencies().entries()},
    }
    first, second = asked_grids(results)
    assert dict(first.rows)["force"] == ("1", "1", "1", "2.00", "2.00", "terminate 1", "terminated 1")
    assert [name for name, _ in second.rows] == ["Reins", "− recovery"]
    (undone_grid,) = rollback_grids(results)
    assert dict(undone_grid.rows)["force"] == ("1", "1", "1", "0", "0")
    (latencies,) = latency_grids(results)
    assert dict(latencies.rows)["Direct execution"] == ("0", "–", "–", "–", "0", "–", "–", "–")


@pytest.mark.parametrize(
    ("unended", "said"),
    [
        ({}, ""),
        ({"reins": 0}, "Every session of Reins came to an end by itself."),
        ({"reins": 2}, "2 sessions of Reins had not ended after 120 s"),
    ],
)
def test_says_whether_every_session_ended(unended: dict[str, int], said: str) -> None:
    assert ended_text({"unended": unended}).startswith(said)
