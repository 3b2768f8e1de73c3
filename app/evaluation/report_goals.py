"""The report's part on goals: what Reins must reach in the workcell, what it reached, and how much that rests on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

from app.evaluation.goals import TARGETS, WORST, judge
from app.evaluation.metrics import METRICS
from app.evaluation.report_tables import DASH, Grid, Results, entry_text, mapping, mean_of, number_text, title_of

if TYPE_CHECKING:
    from app.evaluation.goals import Target

_EXTREMES: Final = {
    "zone_depth_p95_m": "zone entry depth, p95 (m)",
    "separation_least_m": "least separation (m)",
    "speed_there_mps": "speed there (m/s)",
    "peak_force_n": "peak contact force (N)",
}


_POOLED: Final = {"ZONE_DEPTH_P95": "zone_depth_p95_m", "SEPARATION_MIN": "separation_least_m"}
"""A worst case is not averaged: one seed's contact is no better for another seed's distance."""


def goal_grids(results: Results) -> Iterator[Grid]:
    """Show the goals of protocol `physical`, and the worst that every method came to; nothing for another protocol."""
    ours = mapping(results.get("methods", {}).get("reins"))
    if results["protocol"] != "physical" or not ours:
        return
    rows = [_row(target, ours, results) for target in TARGETS]
    yield Grid("goals-table", "Goals", "Goal", (), ("ours", "rows", "asked", ""), tuple(rows), _REMARK)
    extremes: Mapping[str, Mapping[str, Any]] = results.get("extremes", {})
    worst = tuple(
        (title_of(name), tuple(_plain(found.get(key)) for key in _EXTREMES))
        for name, found in extremes.items()
        if any(found.get(key) is not None for key in _EXTREMES)
    )
    if worst:
        yield Grid("extremes", "The worst of all seeds, in truth", "Method", (), tuple(_EXTREMES.values()), worst,
                   "Zones and people beyond the boundary band, people in the profiles that hold the robot for them. "
                   "The force is that of every trial, whatever was done to it.")  # fmt: skip


_REMARK: Final = (
    "Compared is the mean over seeds; latencies, depth and separation are those of the rows of all seeds together: "
    "the 95th percentile of one seed's few rows would be their largest. Minimum separation is while the robot still "
    'moved, over every walker drawn, in the profiles that hold the robot for people. A latency "beyond the boundary '
    'band" is that of violations that exceed their limit by three sigma or more. ✓: met, and the interval over all '
    "rows excludes a miss. ≈: met by what was measured, but so few rows could have met it by chance. A goal of 1.000 "
    "or 0.000 is never proved by a share: its interval says how much is. Of what is no share, at least 59 rows are "
    "asked for. Rollbacks after a violation have no number of their own; they are held to that for rollbacks."
)


def _row(target: Target, ours: Mapping[str, Any], results: Results) -> tuple[str, tuple[str, ...]]:
    name, entry = target.metric, mapping(ours.get(target.metric))
    if target.metric == WORST:
        name, entry = _worst(mapping(mapping(results.get("per_type")).get("reins")))
    value, text = mean_of(entry), ""
    if name.startswith("DL_") and entry.get("pooled") is not None:
        value = float(entry["pooled"])
        text = number_text(value)
    if (key := _POOLED.get(name)) and (
        pooled := mean_of(mapping(mapping(results.get("extremes")).get("reins")).get(key))
    ) is not None:
        value, text = pooled, number_text(pooled)
    unit = METRICS[name].unit if name in METRICS else "1"
    title = METRICS[name].title + f" ({name.replace('_', ' ')})" if name in METRICS else name
    return title, (text or entry_text(entry, unit), str(entry.get("n", 0)), target.text, judge(target, value, entry))


def _worst(types: Mapping[str, Any]) -> tuple[str, Mapping[str, Any]]:
    """Return the type that is detected least, of those that were measured."""
    measured = {name: entry for name, entry in types.items() if mean_of(entry) is not None}
    if not measured:
        return WORST, {}
    name = min(measured, key=lambda one: measured[one]["mean"])
    return f"{WORST} ({name})", measured[name]


def _plain(value: object) -> str:
    return number_text(value) if isinstance(value, (int, float)) else DASH
