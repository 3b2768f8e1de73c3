"""The report's part on time to safe state: what it took, next to the least that it could have taken (`floor`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from app.evaluation.plots import against_floor
from app.evaluation.report_names import title_of
from app.evaluation.report_tables import DASH, Grid, Results, number_text
from app.evaluation.safe_state import ALL

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
_PARTS: Final = {
    "told_s": "held back",
    "stopped_s": "stop",
    "floor_stop_s": "stop: drives' best",
    "declared_stop_s": "stop: as declared",
    "back_s": "way back",
    "floor_back_s": "way back: at allowed speed",
}
_COUNTS: Final = {"n": "rows", "below": "below floor", "prevented": "did not come about", "never": "never safe"}
_REMARK: Final = (
    "From the onset in truth, where policy asks for more than a warning. Ratio: each row's time by its own floor; a "
    "row whose robot stood still already has a floor of 0, and no ratio. A violation that did not come about, because "
    "the robot was stopped before, has neither time nor floor. Below the floor is nobody unless the floor is wrong."
)
_PARTS_REMARK: Final = (
    "Median, and after the slash the 95th percentile, in s. Held back: from the onset to the skill being held back, "
    "one tick at least where nothing was seen coming. Stop: from there to standstill; beside it the least that it "
    "could be with the drives at their force limit, and what it takes at the decelerations that policy and cell "
    "declare. A controlled stop is to take the declared time: braking harder tips over what is carried. Way back: "
    "retreat or rollback with its verification; beside it the way that was gone, at the speed that policy allows there."
)
ABOUT: Final = (
    "Safe state: standstill with the skill held back, after the retreat or the rollback where one follows by itself. "
    "The floor is worked out for every trial from exact facts: one control tick to see it, none where the skill was "
    "held back by then; braking from the speeds at that moment as hard as the drives can (6.1 m/s² for the base, 47 "
    "m/s² for the hand, nothing for an arm that met something stiff); and the way of the retreat or rollback that "
    "was really gone, at the speed policy allows there, with its ramps: a detour raises the floor with the time, so "
    "that a ratio of 1 says nothing about whether the way was a short one. It leaves out debouncing, gripping and "
    "putting down, planning and verification. A ratio of 1 is as good as physics permits on that way. Stops lie above "
    "it because they are controlled: they take what policy declares. Rollbacks lie above it because a recovery goes at "
    "a slower speed than policy would allow, stands still at its corners, and has to put back what was taken."
)


def floor_grids(results: Results) -> Iterator[Grid]:
    """Show Reins by type of violation, then every method that came to a safe state at all."""
    methods: Mapping[str, Mapping[str, Mapping[str, Any]]] = results.get("safe_state", {})
    headings = (*_COUNTS.values(), *_NUMBERS.values())
    if ours := methods.get("reins"):
        rows = tuple((name, _cells(found)) for name, found in ours.items())
        yield Grid("safe-state-types", "Reins, by type of violation", "Violation", (), headings, rows, _REMARK)
        parts = tuple((name, tuple(_spread(found, part) for part in _PARTS)) for name, found in ours.items())
        yield Grid("safe-state-parts", "What the time goes into: Reins, by type", "Violation", (),
                   tuple(_PARTS.values()), parts, _PARTS_REMARK)  # fmt: skip
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


def _spread(found: Mapping[str, Any], part: str) -> str:
    middle, high = found.get(f"{part}_median"), found.get(f"{part}_p95")
    return DASH if middle is None or high is None else f"{number_text(middle, 2)} / {number_text(high, 2)}"
