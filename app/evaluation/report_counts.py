"""The report's part on humans who were asked midway, on latencies, and on rollbacks by what went wrong."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from app.evaluation.report_names import title_of
from app.evaluation.report_tables import DASH, Grid, Results, number_text

_ASKED: Final = ("sessions", "asked", "times", "waited, mean (s)", "waited, p95 (s)", "answers", "ended as")
_ASKED_REMARK: Final = (
    "Of the sessions in which the violation or the failure was really there. A scripted supervisor answers every "
    "question after two seconds, and ends the session: what other people do to it is the study of supervisors. "
    "Waiting includes the two ticks that the end takes. Profiles that only review ask nobody; what is asked there ends "
    "at once, by policy."
)
_LATENCY: Final = ("decisions", "p50 (µs)", "p95 (µs)", "p99 (µs)", "detections", "p50 (ticks)", "p95", "p99")
_LATENCY_REMARK: Final = (
    "Decision: admission, guard and authority, over every proposal. Each gate is passed once untimed, then three "
    "times, all methods of a trial in an order drawn anew for each round, and the median counts: what remains is the "
    "method's own work and not its place in a list. Detection: control ticks of 10 ms from the onset in truth to the "
    "alert, the boundary band included; below 0 where it was told of before. What was prevented has no onset, and is "
    "not here."
)
_ROLLBACKS: Final = ("tried", "capable", "verified", "capable, not verified", "beyond rolling back")
_ROLLBACKS_REMARK: Final = (
    "Capable: by the exact state when the rollback begins there was still something to go back to. RBSR misses those "
    "of the fourth column; those of the last had lost what they should have brought back, and are in the rate over all "
    "that were tried alone. Both count as failed rollbacks in the session's own record. Withdrawn: an operator took "
    "back a task in which nothing had failed; that is the easiest there is to undo."
)
_REDRAWS: Final = ("trials", "drawn again", "redraws in all", "never took")
_REDRAWS_REMARK: Final = (
    "A fault that shows no violation in the ungoverned twin, or no failure, is drawn again as the same type in other "
    "circumstances, up to six times in all, so that rates are of faults that do something. What never took is in none. "
    "The trials are the same for every method."
)
_COMMON: Final = ("trials in common", "theirs, mean (s)", "Reins's, mean (s)")
_COMMON_REMARK: Final = (
    "MRT is of each method's own successes, and so compares other trials: who gives up where it is hard is quick. Here "
    "are those that both brought to an end. It contains the stop, every attempt, its verification and the rest of "
    "the task, and no waiting for a human: the scripted supervisor ends what it is asked about."
)


def asked_grids(results: Results) -> Iterator[Grid]:
    """Show who asked a human midway, why, and what came of it: Reins by what went wrong, then the methods."""
    methods: Mapping[str, Mapping[str, Mapping[str, Any]]] = results.get("escalations", {})
    if ours := methods.get("reins"):
        rows = tuple((name.replace("_", " "), _asked(found)) for name, found in ours.items())
        yield Grid("asked", "Humans asked midway: Reins, by what went wrong", "What", (), _ASKED, rows, _ASKED_REMARK)
    if len(methods) > 1:
        rows = tuple((title_of(name), _asked(found["all"])) for name, found in methods.items())
        yield Grid("asked-methods", "Humans asked midway, by method", "Method", (), _ASKED, rows)


def latency_grids(results: Results) -> Iterator[Grid]:
    """Show what decisions take and how late detections are, for every method."""
    methods: Mapping[str, Mapping[str, Mapping[str, Any]]] = results.get("latencies", {})
    rows = tuple((title_of(name), (*_decided(found), *_detected(found))) for name, found in methods.items())
    if rows:
        yield Grid("latencies", "Latencies, by method", "Method", (), _LATENCY, rows, _LATENCY_REMARK)


def rollback_grids(results: Results) -> Iterator[Grid]:
    """Show which rollbacks were tried and which were not verified, by what went wrong."""
    ours: Mapping[str, Mapping[str, int]] = results.get("rollbacks", {}).get("reins", {})
    names = ("tried", "capable", "verified", "missed", "beyond")
    rows = tuple((what.replace("_", " "), tuple(str(found[one]) for one in names)) for what, found in ours.items())
    if rows:
        yield Grid("rollbacks", "Rollbacks of Reins, by what went wrong", "What", (), _ROLLBACKS, rows,
                   _ROLLBACKS_REMARK)  # fmt: skip


def redraw_grids(results: Results) -> Iterator[Grid]:
    """Show how many faults did not take and were drawn again, by what was to go wrong."""
    found: Mapping[str, Mapping[str, int]] = results.get("redraws", {})
    names = ("trials", "again", "redraws", "never")
    rows = tuple((what.replace("_", " "), tuple(str(counts[one]) for one in names)) for what, counts in found.items())
    if rows:
        yield Grid("redraws", "Faults that were drawn again", "What", (), _REDRAWS, rows, _REDRAWS_REMARK)


def common_grids(results: Results) -> Iterator[Grid]:
    """Show recovery times over the trials that a method and Reins both recovered."""
    found: Mapping[str, Mapping[str, float]] = results.get("common_recoveries", {})
    rows = tuple(
        (title_of(name), (str(one["n"]), number_text(one["theirs_s"], 2), number_text(one["ours_s"], 2)))
        for name, one in found.items()
    )
    if rows:
        yield Grid("common-recoveries", "Recovery time over common successes", "Method", (), _COMMON, rows,
                   _COMMON_REMARK)  # fmt: skip


def ended_text(results: Results) -> str:
    """Say how many governed sessions had not ended when the evaluation let go of them."""
    left: int | None = results.get("unended", {}).get("reins")
    if left is None:
        return ""
    return (
        "Every session of Reins came to an end by itself."
        if not left
        else f"{left} sessions of Reins had not ended after 120 s, when the evaluation let go of them."
    )


def _asked(found: Mapping[str, Any]) -> tuple[str, ...]:
    return (
        *(str(found[name]) for name in ("sessions", "asked", "times")),
        *(number_text(found[name], 2) for name in ("waited_s_mean", "waited_s_p95")),
        *(_counted(found[name]) for name in ("answers", "outcomes")),
    )


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name.removeprefix('resolve_').replace('_', ' ')} {count}" for name, count in counts.items())


def _decided(found: Mapping[str, Any]) -> tuple[str, ...]:
    return _spread(found["decision_us"], 1)


def _detected(found: Mapping[str, Any]) -> tuple[str, ...]:
    return _spread(found["detection_ticks"], 1)


def _spread(found: Mapping[str, Any], decimals: int) -> tuple[str, ...]:
    shown = (DASH if found[name] is None else number_text(found[name], decimals) for name in ("p50", "p95", "p99"))
    return (str(found["n"]), *shown)
