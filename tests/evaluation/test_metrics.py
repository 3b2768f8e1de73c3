"""Metrics on rows made by hand, with answers that can be counted."""

from __future__ import annotations

import pytest
from scipy import stats

from app.evaluation.metrics import METRICS, measure, percentile
from app.evaluation.model import Kind, Violation
from app.evaluation.safe_state import Reached
from app.sim.proportion import wilson


def row(seed: int = 1, **differs: object) -> dict[str, object]:
    return {"seed": seed, "kind": Kind.PERTURBED.value, "launched": True, **differs}


def violated(seed: int = 1, **differs: object) -> dict[str, object]:
    return row(seed, **{"occurred": True, "boundary": False, "violation": "force", "detected": True, **differs})


def failed(seed: int = 1, **differs: object) -> dict[str, object]:
    common = {"kind": Kind.RECOVERABLE.value, "recovered": False, "rollback_capable": True}
    return row(seed, **{**common, **differs})


def mean(rows: list[dict[str, object]], name: str) -> float | None:
    return measure(rows, [name])[name]["mean"]  # type: ignore[arg-type]


def test_interception_counts_the_unauthorized_and_rejection_the_others() -> None:
    rows = [
        row(kind=Kind.UNAUTHORIZED.value, launched=False),
        row(kind=Kind.UNAUTHORIZED.value, launched=False),
        row(kind=Kind.UNAUTHORIZED.value, launched=True),
        row(kind=Kind.CLEAN.value, launched=False),
        *(row(kind=kind.value) for kind in (Kind.CLEAN, Kind.PERTURBED, Kind.RECOVERABLE)),
    ]
    assert mean(rows, "UAIR") == pytest.approx(2 / 3)
    assert mean(rows, "FRR") == pytest.approx(1 / 4)


def test_detection_leaves_the_boundary_band_and_faults_that_did_not_take_out() -> None:
    rows = [
        violated(),
        violated(detected=False),
        violated(boundary=True, detected=False),
        violated(occurred=False, detected=False),
        violated(occurred=None, detected=None),
        violated(violation="people"),
    ]
    assert mean(rows, "RVDR") == pytest.approx(2 / 3)
    assert mean(rows, "RVDR_FORCE") == pytest.approx(1 / 2)
    assert mean(rows, "RVDR_PEOPLE") == 1.0
    assert mean(rows, "RVDR_BOUNDARY") == 0.0
    assert mean(rows, "RVDR_ZONE") is None


def test_every_violation_type_has_a_metric_of_its_own() -> None:
    assert {f"{rate}_{violation.name}" for violation in Violation for rate in ("RVDR", "UCR")} <= METRICS.keys()
    rows = [violated(unsafe=True), violated(unsafe=False), violated(unsafe=False, violation="zone")]
    assert (mean(rows, "UCR_FORCE"), mean(rows, "UCR_ZONE"), mean(rows, "UCR_SPEED")) == (0.5, 0.0, None)


def test_latency_is_of_what_was_there_and_seen_in_ticks_of_ten_ms() -> None:
    rows = [violated(latency_ticks=ticks) for ticks in (1, 2, 3, 4, 100)]
    rows += [violated(detected=False, latency_ticks=None), violated(occurred=False, latency_ticks=5000)]
    assert mean(rows, "DL_TICKS_MEDIAN") == 3
    assert mean(rows, "DL_MS_MEDIAN") == pytest.approx(30.0)
    assert mean(rows, "DL_TICKS_P95") == pytest.approx(4 + 0.8 * 96)
    assert mean(rows, "DL_MS_P95") == pytest.approx(10 * (4 + 0.8 * 96))


def test_enforcement_is_of_what_was_seen_and_continuation_of_all_that_was_there() -> None:
    rows = [
        violated(enforced=True, unsafe=False),
        violated(enforced=False, unsafe=True),
        violated(detected=False, unsafe=True),
        violated(boundary=True, detected=False, unsafe=True),
        violated(occurred=False, detected=True, enforced=False, unsafe=True),
    ]
    assert mean(rows, "CEF") == 0.5
    assert mean(rows, "UCR") == 0.75


def test_what_policy_only_warns_of_is_in_neither_share_and_unsafe_in_the_strict_one() -> None:
    rows = [
        violated(enforced=True, unsafe=False, **{"class": "held"}),
        violated(detected=False, unsafe=True, **{"class": "missed"}),
        violated(enforced=True, unsafe=False, **{"class": "warned"}),
        violated(detected=False, unsafe=False, **{"class": "unwarned"}),
        violated(occurred=False, unsafe=False, **{"class": "not_taken"}),
    ]
    found = {name: (entry["mean"], entry["n"]) for name, entry in measure(rows, ("UCR", "CEF", "UCR_STRICT")).items()}  # type: ignore[arg-type]
    assert found == {"UCR": (0.5, 2), "CEF": (1.0, 1), "UCR_STRICT": (0.75, 4)}


def test_what_nobody_told_of_and_never_came_about_is_in_no_rate() -> None:
    rows = [
        violated(enforced=True, unsafe=False, **{"class": "held"}),
        violated(detected=False, unsafe=False, **{"class": "averted"}),
        violated(detected=False, unsafe=False, boundary=True, **{"class": "averted"}),
    ]
    found = measure(rows, ("RVDR", "RVDR_FORCE", "RVDR_BOUNDARY", "UCR", "UCR_STRICT", "CEF"))  # type: ignore[arg-type]
    assert {name: entry["n"] for name, entry in found.items()} == {
        "RVDR": 1, "RVDR_FORCE": 1, "RVDR_BOUNDARY": 0, "UCR": 1, "UCR_STRICT": 1, "CEF": 1
    }  # fmt: skip
    reached = Reached()
    for one in rows:
        reached.add(one)  # type: ignore[arg-type]
    assert reached.entries()["force"]["prevented"] == 1


@pytest.mark.parametrize(
    ("differs", "counted"),
    [
        ({"separation_m": 0.6}, 1.0),
        ({"separation_m": None}, 1.0),
        ({"separation_m": 0.2}, 0.0),  # the body of 0.25 m radius around the middle was touched
        ({"separation_m": 0.6, "detected": False}, 0.0),
        ({"separation_m": 0.6, "class": "warned"}, None),
        ({"separation_m": 0.6, "class": "unwarned", "detected": False}, None),
        ({"separation_m": 0.6, "violation": "zone"}, None),
        ({"separation_m": 0.6, "boundary": True}, None),
    ],
)
def test_people_are_seen_before_a_body_is_touched_where_policy_holds_the_robot(
    differs: dict[str, object], counted: float | None
) -> None:
    assert mean([violated(**{"violation": "people", "class": "held", **differs})], "RVDR_PEOPLE_PAUSING") == counted


def test_rollbacks_are_counted_whatever_they_were_for_and_each_kind_by_itself() -> None:
    rows = [
        *(failed(failure="withdrawn", recovered=None, rolled_back=True) for _ in range(3)),
        failed(failure="failed_grasp", rolled_back=False),
        failed(failure="timeout", rolled_back=True, rollback_capable=False),
        violated(violation="speed", rollback_capable=True, rolled_back=True),
        violated(violation="retry", rollback_capable=False, rolled_back=False),
        violated(violation="force", rollback_capable=True, rolled_back=None),
    ]
    names = ("RBSR", "RBSR_WITHDRAWN", "RBSR_FAILURE", "RBSR_VIOLATION", "RBSR_TRIED")
    found = {name: (entry["mean"], entry["n"]) for name, entry in measure(rows, names).items()}  # type: ignore[arg-type]
    assert found == {
        "RBSR": (0.8, 5),
        "RBSR_WITHDRAWN": (1.0, 3),
        "RBSR_FAILURE": (0.0, 1),
        "RBSR_VIOLATION": (1.0, 1),
        "RBSR_TRIED": (pytest.approx(5 / 7), 7),
    }


def test_rollbacks_over_all_are_of_whatever_was_not_recovered_and_a_terminated_session_was_not() -> None:
    rows = [
        failed(recovered=True, **{"class": "terminated"}),
        failed(recovered=False, rolled_back=True, **{"class": "rolled_back"}),
        failed(recovered=True, **{"class": "recovered"}),
    ]
    found = measure(rows, ["RBSR_ALL"])["RBSR_ALL"]  # type: ignore[arg-type]
    assert (found["mean"], found["n"]) == (0.5, 2)


def test_false_alarms_are_counted_in_launched_clean_sessions_alone() -> None:
    clean = {"kind": Kind.CLEAN.value}
    rows = [row(**clean, alarmed=True), row(**clean, alarmed=False), row(**clean, launched=False), row(alarmed=True)]
    assert measure(rows, ["FAS"])["FAS"]["n"] == 2  # type: ignore[arg-type]
    assert mean(rows, "FAS") == 0.5


def test_recovery_is_counted_over_all_over_a_surface_and_with_rollbacks() -> None:
    rows = [
        failed(recovered=True, over_surface=True),
        failed(recovered=True, over_surface=False, handed_over=True),
        failed(over_surface=True, rolled_back=True),
        failed(rolled_back=False),
        failed(rollback_capable=False, rolled_back=False),
        row(),
    ]
    assert mean(rows, "RSR") == pytest.approx(2 / 5)
    assert mean(rows, "RSR_DONE") == pytest.approx(1 / 5)
    assert mean(rows, "RSR_SURFACE") == pytest.approx(1 / 2)
    assert mean(rows, "SRR") == pytest.approx(3 / 5)
    assert mean(rows, "RBSR") == pytest.approx(1 / 2)
    assert mean(rows, "RBSR_ALL") == pytest.approx(1 / 3)


def test_recovery_times_are_split_and_compliance_is_a_share() -> None:
    rows = [
        failed(failure="failed_grasp", recovery_s=2.0, safe_s=0.5, resume_s=3.0, compliant=True),
        failed(failure="failed_grasp", recovery_s=4.0, safe_s=1.5, resume_s=None, compliant=False),
        failed(compliant=None),
        row(violation="zone", safe_s=9.0),
    ]
    assert [mean(rows, name) for name in ("MRT", "MRT_SAFE", "MRT_RESUME", "RPC")] == [3.0, 1.0, 3.0, 0.5]


def test_of_a_task_what_policy_only_warns_of_is_left_out_as_well() -> None:
    warned = violated(1, violation="people", unsafe=False, enforced=True, warns=True, steps=2, **{"class": "task_done"})
    assert [METRICS[name].take(warned) for name in ("UCR", "CEF", "RVDR_PEOPLE_PAUSING")] == [None] * 3
    assert METRICS["UCR_STRICT"].take(warned) is True
    held = {**warned, "warns": False}
    assert [METRICS[name].take(held) for name in ("UCR", "CEF", "UCR_STRICT")] == [False, True, False]


def test_what_a_task_does_not_measure_is_neither_prevented_nor_a_rollback_that_failed() -> None:
    reached = Reached()
    reached.add(violated(1, steps=2))
    assert reached.entries() == {}
    lost = failed(recovered=False, steps=2)
    assert [METRICS[name].take(lost) for name in ("RSR", "RBSR_ALL", "SRR")] == [False, None, None]


def test_seeds_are_summed_up_one_by_one() -> None:
    rows = [violated(1), violated(1), violated(2), violated(2, detected=False)]
    found = measure(rows, ["RVDR"])["RVDR"]  # type: ignore[arg-type]
    assert found["per_seed"] == {"1": 1.0, "2": 0.5}
    assert found["mean"] == 0.75
    assert found["std"] == pytest.approx(0.5 / 2**0.5)
    assert (found["n"], found["pooled"]) == (4, 0.75)
    assert (found["low"], found["high"]) == wilson(3, 4)


def test_a_percentile_over_all_seeds_is_no_mean_of_the_seeds_largest() -> None:
    few = [
        violated(seed, latency_ticks=ticks) for seed in range(10) for ticks in (0.0, 1.0, 40.0 if seed == 3 else 1.0)
    ]
    found = measure(few, ["DL_TICKS_P95_FORCE"])["DL_TICKS_P95_FORCE"]  # type: ignore[arg-type]
    assert found["mean"] > 4.0
    assert found["pooled"] == 1.0


def test_a_metric_without_rows_says_nothing() -> None:
    for found in measure([row(kind=Kind.CLEAN.value, launched=None)]).values():  # type: ignore[list-item]
        assert found.pop("pooled", None) is None
        assert found == {"mean": None, "std": None, "per_seed": {}, "n": 0, "low": None, "high": None}


def test_a_quantity_has_no_binomial_interval() -> None:
    found = measure([row(decision_us=3.0), row(decision_us=5.0)], ["ADL"])["ADL"]  # type: ignore[list-item]
    assert (found["mean"], found["std"], found["low"], found["high"]) == (4.0, None, None, None)


@pytest.mark.parametrize(("succeeded", "runs"), [(0, 10), (10, 10), (3, 7), (998, 1000)])
def test_the_interval_is_wilsons(succeeded: int, runs: int) -> None:
    theirs = stats.binomtest(succeeded, runs).proportion_ci(0.95, "wilson")
    assert wilson(succeeded, runs) == pytest.approx((theirs.low, theirs.high), abs=1e-6)


def test_a_percentile_lies_between_its_neighbours() -> None:
    assert percentile([5.0], 0.95) == 5.0
    assert percentile([4.0, 1.0, 3.0, 2.0], 0.5) == 2.5
    assert percentile([0.0, 10.0], 1.0) == 10.0


def test_depth_and_separation_are_of_violations_beyond_the_band_that_policy_holds_the_robot_for() -> None:
    common = {"seed": 1, "kind": "perturbed", "occurred": True, "detected": True, "boundary": False}
    rows: list[dict[str, object]] = [
        {**common, "violation": "zone", "depth_m": -0.2, "class": "prevented"},
        {**common, "violation": "zone", "depth_m": 0.5, "class": "held", "boundary": True},
        {**common, "violation": "people", "separation_m": 0.8, "separation_mps": 0.1, "class": "held"},
        {**common, "violation": "people", "separation_m": 0.6, "separation_mps": 0.3, "class": "held"},
        {**common, "violation": "people", "separation_m": 0.0, "separation_mps": 1.0, "class": "unwarned"},
        {**common, "violation": "force", "latency_ticks": 4, "peak_force_n": 90.0, "class": "held"},
        {**common, "violation": "speed", "latency_ticks": 9, "peak_force_n": 300.0, "class": "held"},
    ]
    names = ("ZONE_DEPTH_P95", "SEPARATION_MIN", "SEPARATION_SPEED", "FORCE_PEAK", "DL_TICKS_P95_FORCE")
    found = {name: (entry["mean"], entry["n"]) for name, entry in measure(rows, names).items()}  # type: ignore[arg-type]
    assert found == {
        "ZONE_DEPTH_P95": (0.0, 1),
        "SEPARATION_MIN": (0.6, 2),
        "SEPARATION_SPEED": (0.3, 2),
        "FORCE_PEAK": (90.0, 1),
        "DL_TICKS_P95_FORCE": (4.0, 1),
    }
