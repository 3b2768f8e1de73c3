"""The report's part on time to safe state: what it took, next to the least that it could have taken (`floor`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from app.evaluation.floor import ALL
from app.evaluation.plots import against_floor
from app.evaluation.report_tables import DASH, Grid, Results, number_text, title_of

if TYPE_CHECKING:
    from app.evaluation.plots import Plot

_NUMBERS: Final = {
    "safe_s_median": "time, median (s)",
    "safe_s_p95": "p95 (s)",
    "floor_s_median": "floor, median (s)",
    "floor_s_p95": "p95 (s)",
    "ratio_median": "ratio, median",
    "ratio_p95": "p95",
    "above_s_p95": "above the floor, p95 (s)",
}
_COUNTS: Final = {"n": "rows", "prevented": "did not come about", "never": "never safe"}
_REMARK: Final = (
    "From the onset in truth, where policy asks for more than a warning. Ratio: each row's time by its own floor. Rows "
    "have both; a violation that did not come about, because the robot was stopped before, has neither."
)
ABOUT: Final = (
    "Safe state: standstill with the skill held back, after the retreat or the rollback where one follows by itself. "
    "The floor is worked out for every trial from exact facts: the period and delay of the sensor in which the "
    "violation shows, the time to brake from the speeds at the onset (base at the profile's deceleration, arm at its "
    "own), and the way of the retreat at the speed policy allows. It leaves out computing, debouncing, the drives' "
    "lag, gripping and coming up to speed. A watcher that predicts can be below it."
)


def floor_grids(results: Results) -> Iterator[Grid]:
    """Show Reins by type of violation, then every method that came to a safe state at all."""
    methods: Mapping[str, Mapping[str, Mapping[str, Any]]] = results.get("safe_state", {})
    headings = (*_COUNTS.values(), *_NUMBERS.values())
    if ours := methods.get("reins"):
        rows = tuple((name, _cells(found)) for name, found in ours.items())
        yield Grid("safe-state-types", "Reins, by type of violation", "Violation", (), headings, rows, _REMARK)
    reached = {name: found[ALL] for name, found in methods.items() if found.get(ALL, {}).get("n")}
    if reached:
        rows = tuple((title_of(name), _cells(found)) for name, found in reached.items())
        yield Grid("safe-state-methods", "Methods that come to a safe state, all types", "Method", (), headings, rows,
                   "A method that stops on fewer violations has fewer rows: compare counts first.")  # fmt: skip


def floor_plots(results: Results) -> Iterator[Plot]:
    """Draw Reins's times and floors by type."""
    pairs: Mapping[str, Sequence[Sequence[float]]] = results.get("distributions", {}).get("safe_state_s", {})
    groups = {name: [(safe, floor) for safe, floor in found] for name, found in pairs.items() if found and name != ALL}
    if groups:
        yield against_floor(groups)


def _cells(found: Mapping[str, Any]) -> tuple[str, ...]:
    counts = (str(found.get(key, 0)) for key in _COUNTS)
    return (*counts, *(DASH if found.get(key) is None else number_text(found[key], 2) for key in _NUMBERS))
