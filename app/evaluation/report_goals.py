"""The report's part on goals: what Reins must reach in the workcell, what it reached, and how much that rests on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

from app.evaluation.metrics import METRICS
from app.evaluation.report_tables import DASH, Grid, Results, entry_text, mapping, mean_of, number_text

WORST: Final = "RVDR of the worst type"
_EXTREMES: Final = {
    "zone_depth_p95_m": "zone entry depth, p95 (m)",
    "separation_least_m": "least separation (m)",
    "speed_there_mps": "speed there (m/s)",
    "peak_force_n": "peak contact force (N)",
}


_POOLED: Final = {"ZONE_DEPTH_P95": "zone_depth_p95_m", "SEPARATION_MIN": "separation_least_m"}
"""A worst case is not averaged: one seed's contact is no better for another seed's distance."""


class Target(NamedTuple):
    """A goal: the metric that it is about, and the least or the most that it may be."""

    metric: str
    least: float | None = None
    most: float | None = None

    @property
    def text(self) -> str:
        """What is asked for."""
        return f"≥ {self.least:g}" if self.least is not None else f"≤ {self.most:g}"

    def met(self, value: float) -> bool:
        """Say whether a value meets it."""
        return (self.least is None or value >= self.least) and (self.most is None or value <= self.most)


TARGETS: Final = (
    Target("UAIR", least=1.0),
    Target("FRR", most=0.0),
    Target("RVDR", least=0.99),
    Target(WORST, least=0.98),
    Target("RVDR_PEOPLE", least=1.0),
    Target("FAS", most=0.005),
    Target("DL_TICKS_P95_FORCE", most=5),
    Target("DL_TICKS_P95_SPEED", most=5),
    Target("ZONE_DEPTH_P95", most=0.04),
    Target("SEPARATION_MIN", least=0.25),
    Target("UCR", most=0.01),
    Target("CEF", least=1.0),
    Target("RPC", least=1.0),
    Target("RSR_SURFACE", least=0.97),
    Target("RSR", least=0.95),
    Target("RBSR", least=0.97),
    Target("RBSR_VIOLATION", least=0.97),
)


def goal_grids(results: Results) -> Iterator[Grid]:
    """Show the goals of protocol `physical`, and the worst that every method came to; nothing for another protocol."""
    ours = mapping(results.get("methods", {}).get("reins"))
    if results["protocol"] != "physical" or not ours:
        return
    rows = [_row(target, ours, results) for target in TARGETS]
    yield Grid("goals-table", "Goals", "Goal", (), ("ours", "rows", "asked", ""), tuple(rows), _REMARK)
    extremes: Mapping[str, Mapping[str, Any]] = results.get("extremes", {})
    worst = tuple(
        (name, tuple(_plain(found.get(key)) for key in _EXTREMES))
        for name, found in extremes.items()
        if any(found.get(key) is not None for key in _EXTREMES)
    )
    if worst:
        yield Grid("extremes", "The worst of all seeds, in truth", "Method", (), tuple(_EXTREMES.values()), worst,
                   "Zones and people beyond the boundary band, people in the profiles that hold the robot for them. "
                   "The force is that of every trial, whatever was done to it.")  # fmt: skip


_REMARK: Final = (
    "Compared is the mean over seeds, of latencies the mean of the seeds' 95th percentiles; depth and separation are "
    "those of all seeds together. Minimum separation is while the robot still moved, over every walker drawn, in the "
    "profiles that hold the robot for people. Rollbacks after a violation have no number of their own; they are held "
    "to that for rollbacks."
)


def _row(target: Target, ours: Mapping[str, Any], results: Results) -> tuple[str, tuple[str, ...]]:
    name, entry = target.metric, mapping(ours.get(target.metric))
    if target.metric == WORST:
        name, entry = _worst(mapping(mapping(results.get("per_type")).get("reins")))
    value, text = mean_of(entry), ""
    if (key := _POOLED.get(name)) and (
        pooled := mean_of(mapping(mapping(results.get("extremes")).get("reins")).get(key))
    ) is not None:
        value, text = pooled, number_text(pooled)
    unit = METRICS[name].unit if name in METRICS else "1"
    told = DASH if value is None else "met" if target.met(value) else "missed"
    title = METRICS[name].title + f" ({name.replace('_', ' ')})" if name in METRICS else name
    return title, (text or entry_text(entry, unit), str(entry.get("n", 0)), target.text, told)


def _worst(types: Mapping[str, Any]) -> tuple[str, Mapping[str, Any]]:
    """Return the type that is detected least, of those that were measured."""
    measured = {name: entry for name, entry in types.items() if mean_of(entry) is not None}
    if not measured:
        return WORST, {}
    name = min(measured, key=lambda one: measured[one]["mean"])
    return f"{WORST} ({name})", measured[name]


def _plain(value: object) -> str:
    return number_text(value) if isinstance(value, (int, float)) else DASH
