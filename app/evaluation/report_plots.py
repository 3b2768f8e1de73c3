"""The report's plots: what of a campaign's results goes into which."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

from app.evaluation import plots, published
from app.evaluation.report_names import title_of
from app.evaluation.report_tables import SWEPT, UNLIKE, Results, mapping, mean_of

if TYPE_CHECKING:
    from app.evaluation.plots import Plot


def drawn(results: Results) -> Iterator[Plot]:
    """Yield what of a campaign can be drawn: types, sweep and distributions."""
    if bars := _bars(results.get("per_type", {}).get("reins", {})):
        yield plots.per_type(bars, ", beyond the boundary band" if results["protocol"] == "physical" else "")
    ours = [point for p in results.get("sensitivity", ()) if (point := _point(p["s"], p)) is not None]
    shipped = _point(0.0, results.get("sensitivity_shipped", {}))
    of = f" {SWEPT}" if results["protocol"] == "physical" else ""
    unlike = f"{of} {UNLIKE}" if of else ""
    if ours:
        yield plots.frontier(ours, _published_points(), shipped, unlike)
        yield plots.sweep(ours, of)
    if any(point.far is not None for point in ours):
        yield plots.roc(ours, shipped, of)
    spreads = results.get("distributions", {})
    for key, unit, caption, names, counted in (
        ("latency_ticks", "control ticks of 10 ms from onset", _LATENCY, _violation_name, "detected violations"),
        ("recovery_s", "s from the first recovery step or the failure", _RECOVERY, title_of, "recovered trials"),
    ):
        found: Mapping[str, Any] = spreads.get(key, {})
        groups = {names(name): values for name, values in _in_order(found).items() if values}
        if groups:
            yield plots.spread(groups, unit, caption, counted)


_LATENCY: Final = (
    "Detection latency by type of violation, beyond the boundary band. What was prevented has no onset, and is not "
    "drawn."
)
_RECOVERY: Final = "Recovery time by method, each over its own successes."


def _point(s: float, found: Mapping[str, Any]) -> plots.Point | None:
    """Return what was measured at a sensitivity as a point; None where it was not."""
    rvdr, ucr = mean_of(found.get("RVDR")), mean_of(found.get("UCR"))
    if rvdr is None or ucr is None:
        return None
    return plots.Point(s, rvdr, ucr, mean_of(found.get("RSR")), mean_of(found.get("FAR")),
                       _count(found, "RVDR"), _count(found, "FAR"))  # fmt: skip


def _count(found: Mapping[str, Any], metric: str) -> int | None:
    """Return how many rows a metric was counted over; None where a bare number stands for it."""
    return mapping(found.get(metric)).get("n")


def _bars(types: Mapping[str, Any]) -> list[plots.Bar]:
    bars: list[plots.Bar] = []
    for key, (name, (figure, *_)) in published.PER_TYPE.rows.items():
        entry = types.get(key, {})
        if entry.get("mean") is not None:
            named = f"{name} ({entry['n']})" if entry.get("n") else name
            bars.append(plots.Bar(named, entry["mean"], entry.get("low"), entry.get("high"), figure and figure.mean))
    return bars


def _published_points() -> list[plots.Point]:
    points: list[plots.Point] = []
    for key, (_, figures) in published.SENSITIVITY.rows.items():
        rvdr, ucr, rsr = (figure.mean for figure in figures if figure is not None)
        points.append(plots.Point(float(key), rvdr, ucr, rsr, None))
    return points


def _in_order(found: Mapping[str, Any]) -> dict[str, Any]:
    """Put types of violation in the order of the paper's table, as everywhere else; what is none keeps its place."""
    order = {name: place for place, name in enumerate(published.PER_TYPE.rows)}
    return dict(sorted(found.items(), key=lambda one: order.get(one[0], len(order))))


def _violation_name(key: str) -> str:
    return published.PER_TYPE.rows[key][0] if key in published.PER_TYPE.rows else key
