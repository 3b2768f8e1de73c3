"""The report's tables: ours beside the paper's, metrics, tests and classes, as text in cells."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from app.evaluation import published
from app.evaluation.counted import HULL_M
from app.evaluation.methods import ABLATIONS, SECOND_PASS
from app.evaluation.metrics import METRICS
from app.evaluation.report_names import BETTER, CALLED, decimals_of, heading_of, measured_as, metrics_of, title_of

if TYPE_CHECKING:
    from app.evaluation.published import PublishedTable

DASH: Final = "–"
MINUS: Final = "−"
_SATURATED_M: Final = 5e-4
_SENTENCE: Final = 30
"""A cell of more characters than these wraps."""
_TESTS: Final = {"t": "t", "t_p": "p", "wilcoxon_p": "Wilcoxon p"}

_PART_METRICS: Final = (
    *("UAIR", "FRR", "FAS", "RVDR", "UCR", "RSR", "RPC", "TSR", "TSR_CLEAN", "TUR", "TASK_STEPS", "TASK_S"),
)
_COMPARED: Final = ("TSR", "TUR", "RVDR", "UCR")

Results = Mapping[str, Any]


class Grid(NamedTuple):
    """A table as it is printed.

    Attributes:
        id: Anchor.
        caption: What it shows.
        stub: Heading of the row names.
        groups: Upper headings and how many columns each spans; empty for one row of headings.
        headings: One for each column.
        rows: Row name and one text for each column.
        remark: Printed under it.
    """

    id: str
    caption: str
    stub: str
    groups: tuple[tuple[str, int], ...]
    headings: tuple[str, ...]
    rows: tuple[tuple[str, tuple[str, ...]], ...]
    remark: str = ""

    @property
    def wordy(self) -> tuple[bool, ...]:
        """Whether each column holds sentences rather than numbers: those are read from the left."""
        return tuple(
            any(len(line) > _SENTENCE for _, cells in self.rows for line in cells[place].split("\n"))
            for place in range(len(self.headings))
        )

    @property
    def named_at_length(self) -> bool:
        """Whether its row names are sentences rather than names: those wrap."""
        return any(len(name) > _SENTENCE for name, _ in self.rows)


def paper_grid(table: PublishedTable, results: Results) -> Grid:
    """Put our numbers beside a published table's: ours, the paper's, the difference."""
    alike = not _of_another_policy(table, results)
    rows = [
        (name, tuple(text for cell in _cells(table, results, key, figures, alike=alike) for text in cell))
        for key, (name, figures) in table.rows.items()
    ]
    return Grid(
        id=table.label.replace(":", "-"),
        caption=f"{table.title} ({table.label})",
        stub=table.stub,
        groups=tuple((f"{column.heading} {column.better}".strip(), 3) for column in table.columns),
        headings=("ours", "paper", "diff.") * len(table.columns),
        rows=tuple(rows),
        remark=" ".join(filter(None, (table.remark, _also(table, results)))),
    )


def _of_another_policy(table: PublishedTable, results: Results) -> bool:
    return table is published.SENSITIVITY and results.get("protocol") == "physical"


def _also(table: PublishedTable, results: Results) -> str:
    """Say what a reader should know of our numbers, of this protocol, before comparing."""
    said = _ABOUT_OURS.get(str(results.get("protocol")), {}).get(table.label)
    return "" if said is None else said(results)


def _of_reins(results: Results, metric: str) -> str:
    """Write the mean of a metric of Reins."""
    mean = mean_of(mapping(mapping(mapping(results.get("methods")).get("reins")).get(metric)))
    return DASH if mean is None else number_text(mean)


def _rows_of_reins(results: Results, metric: str) -> int:
    return mapping(mapping(mapping(results.get("methods")).get("reins")).get(metric)).get("n", 0)


def _pooled_of_reins(results: Results, metric: str) -> str:
    """Write the share of a metric of Reins, and the rows of all seeds that it is of."""
    pooled = mapping(mapping(mapping(results.get("methods")).get("reins")).get(metric)).get("pooled")
    return f"{DASH if pooled is None else number_text(pooled)} of {_rows_of_reins(results, metric):,}"


def _nearest(results: Results) -> str:
    """Say what our rate of rollbacks is over the rows that the paper's is of."""
    return (
        "Like the paper's, over all failures that were not recovered, whatever their capability, the RBSR of Reins is "
        f"{_pooled_of_reins(results, 'RBSR_ALL')}"
    )


def _about_internal(results: Results) -> str:
    if not has_mean(mapping(mapping(results.get("methods")).get("capability-internal")), "RVDR"):
        return ""
    return (
        "What a capability notices by itself here, contact force and a lost grip, is two of the six types, which are "
        "drawn evenly, and is seen with the same odds s as the watcher's, .6 in the mean of the shipped profiles: .2 "
        "is what that can give. What the paper's .351 is of it does not say."
    )


def _about_untimed(results: Results) -> str:
    return f"{_nearest(results)}. No time passes in this protocol, so it has no MRT of ours."


def _about_second_pass(results: Results) -> str:
    rate = mean_of(mapping(mapping(mapping(results.get("methods")).get("roboguard-style")).get("FRR")))
    if rate is None:
        return ""
    return (
        f"RoboGuard-style refuses {number_text(rate)} of the authorized proposals here, by its second pass: that "
        f"refuses above {SECOND_PASS:g} of a limit, and authorized speeds and forces are drawn at 0.5 to 1 of theirs, "
        "all of which policy allows. How close to its limits the paper's requests come it does not say; those of "
        "protocol paper stay below 0.8, where the pass refuses none."
    )


def _about_violations(results: Results) -> str:
    return (
        f"Our RVDR is of the {_rows_of_reins(results, 'RVDR'):,} violations beyond the boundary band; within it, where "
        f"sensor noise alone decides, Reins detects {_pooled_of_reins(results, 'RVDR_BOUNDARY')}. "
        "Our UCR and CEF leave out violations of which policy asks no more than a warning, for every method. "
        f"Counting each of those as unsafe, the UCR of Reins is {_of_reins(results, 'UCR_STRICT')}."
    )


def _about_recovery(results: Results) -> str:
    return (
        "Our RBSR is of rollbacks after withdrawals, failures and violations; its parts stand among the goals. "
        f"{_nearest(results)}; over all rollbacks that were tried, capable or not, whatever for, it is "
        f"{_pooled_of_reins(results, 'RBSR_TRIED')}; {_rows_of_reins(results, 'RBSR'):,} were capable. Our MRT is "
        "simulated seconds, in which a body had to move; it runs from the first recovery step to the end of the "
        "session, the rest of the task included, and is of each method's own successes: compared over the same trials "
        "it stands under recovery times."
    )


def _about_types(results: Results) -> str:
    types = mapping(mapping(results.get("per_type")).get("reins"))
    counts = (f"{name} {mapping(types.get(name)).get('n', 0)}" for name in published.PER_TYPE.rows)
    return f"Rows of ours, beyond the boundary band: {', '.join(counts)}; their intervals stand under all metrics."


def _about_ablations(_: Results) -> str:
    return (
        "Without admission or the guard, sessions here are those of the full framework: what runs was drawn from "
        "within policy, so every gate lets it through, and what a gate should have stopped is counted there and not "
        "executed. The paper's differ from each other by their draws. Which of the two costs more UAIR follows from "
        "the four kinds of unauthorized proposals: admission alone stops one (permission), the guard two (zone, "
        "object), and a human's missing approval the last. Without a watcher nobody notices what takes too long, so "
        "those failures are not recovered. Without recovery a session ends at its first failure: RSR is 0, less than "
        "of direct execution, whose skills try again by themselves; where the paper's .311 comes from it does not say. "
        "Its RPC is explained under what the paper does not publish."
    )


def _about_sweep(_: Results) -> str:
    return f"{SWEPT} {UNLIKE} Ours begins at 0.1, and has no failures to recover from, so it has no RSR."


_ABOUT_OURS: Final[Mapping[str, Mapping[str, Callable[[Results], str]]]] = {
    "paper": {
        published.VIOLATION.label: _about_internal,
        published.RECOVERY.label: _about_untimed,
    },
    "physical": {
        published.INTERCEPTION.label: _about_second_pass,
        published.VIOLATION.label: _about_violations,
        published.RECOVERY.label: _about_recovery,
        published.PER_TYPE.label: _about_types,
        published.ABLATION.label: _about_ablations,
        published.SENSITIVITY.label: _about_sweep,
    },
}

SWEPT: Final = (
    "Not the shipped policy: ours are of one made so that s matters (250 ms of debouncing, stops at 0.97 of a speed "
    "limit), with sensors of twice their noise and brief faults of force and speed near their limit alone. What is "
    "neither seen nor in UCR was over within 250 ms."
)
UNLIKE: Final = "The paper's are of all types, so there is no difference to show."


def has_ours(table: PublishedTable, results: Results) -> bool:
    """Say whether a campaign has a number for any cell of a published table."""
    return any(_ours(table, results, key, column.key) is not None for key in table.rows for column in table.columns)


def unsafe_grids(results: Results) -> Iterator[Grid]:
    """Show the share of violations that was acted under, by their type; a column for each method."""
    found: Mapping[str, Mapping[str, Any]] = {
        name: types for name, types in mapping(results.get("unsafe_per_type")).items() if name not in ABLATIONS
    }
    rows = tuple(
        (called, tuple(_of_rows(types.get(key)) for types in found.values()))
        for key, (called, _) in published.PER_TYPE.rows.items()
    )
    if any(cell != DASH for _, cells in rows for cell in cells):
        yield Grid(
            "unsafe-by-type",
            f"Unsafe continuation by type of violation (UCR {BETTER['lower']})",
            published.PER_TYPE.stub,
            (),
            tuple(map(title_of, found)),
            rows,
            "The paper prints none. Below each: Wilson's 95 % interval, and the rows that it is of.",
        )


def _of_rows(entry: Mapping[str, Any] | None) -> str:
    """Write an entry, and of how many rows it is."""
    text = entry_text(entry, "1")
    return text if entry is None or text == DASH else f"{text} of {entry.get('n', 0):,}"


def sweep_grids(results: Results) -> Iterator[Grid]:
    """Show every step of the sensitivity sweep; the paper prints seven of eleven."""
    points: Sequence[Mapping[str, Any]] = results.get("sensitivity", ())
    keys = [key for key in dict.fromkeys(key for point in points for key in point) if key != "s"]
    if points:
        yield Grid(
            "sweep",
            "Every step of the sensitivity sweep",
            "Sensitivity",
            (),
            tuple(heading_of(CALLED.get(key, key)) for key in keys),
            tuple((f"{point['s']:.1f}", tuple(_entry_or_number(point.get(key)) for key in keys)) for point in points),
            ("FAS: clean sessions with an alarm. " if "FAR" in keys else "")
            + (SWEPT if results.get("protocol") == "physical" else ""),
        )


def _entry_or_number(value: object) -> str:
    entry = mapping(value)
    return entry_text(entry, "1") if "mean" in entry else plain_text(value)


def test_grids(results: Results) -> Iterator[Grid]:
    """Show the tests of significance that the paper reports in its text."""
    baselines: Mapping[str, Mapping[str, Any]] = results.get("effect_sizes", {})
    metrics = tuple(dict.fromkeys(metric for found in baselines.values() for metric in found))
    rows = tuple(
        (title_of(name), tuple(_test_text(key, found.get(metric, {}).get(key)) for metric in metrics for key in _TESTS))
        for name, found in baselines.items()
    )
    paper = ", ".join(f"t {number_text(t, 2)} ({metric})" for metric, t in published.T_TESTS.items())
    if metrics:
        yield Grid(
            "tests",
            "Significance of Reins's difference to each baseline",
            "Baseline",
            tuple((metric, len(_TESTS)) for metric in metrics),
            tuple(_TESTS.values()) * len(metrics),
            rows,
            "Paired over seeds; positive means that Reins is better. t and its p: paired t-test, two-sided. Wilcoxon "
            "p: signed-rank test, one-sided (Reins is better), exact by enumerating signs; a seed in which both agree "
            "drops "
            f"out. The paper against RoboGuard-style: {paper}, each p < 0.001; Wilcoxon p {published.WILCOXON_P} for "
            f"every baseline. {published.T_REMARK}",
        )


def _test_text(key: str, value: object) -> str:
    """Write t with two decimals, a p with three or its order."""
    return number_text(value, 2) if key == "t" and isinstance(value, float) else plain_text(value)


def metrics_grid(key: str, caption: str, methods: Mapping[str, Mapping[str, Any]], protocol: str) -> Grid:
    """Show every metric that any of these methods has; a row for each metric, a column for each method."""
    measured = [name for name in metrics_of(protocol) if any(has_mean(metrics, name) for metrics in methods.values())]
    rows = tuple(
        (measured_as(name, protocol), tuple(metric_text(name, metrics.get(name)) for metrics in methods.values()))
        for name in measured
    )
    return Grid(f"{key}-table", caption, "Metric", (), tuple(map(title_of, methods)), rows)


def class_grid(kind: str, of: str, shares: Mapping[str, Mapping[str, float]]) -> Grid:
    """Show the classes of one kind of trial; the shares of a method add up to 1."""
    names = list(dict.fromkeys(name for classes in shares.values() for name in classes))
    rows = [
        (name.replace("_", " "), tuple(number_text(classes.get(name, 0.0)) for classes in shares.values()))
        for name in names
    ]
    rows.append(("all classes", tuple(number_text(sum(classes.values())) for classes in shares.values())))
    caption = f"{kind.capitalize()} trials{of}: share of each class"
    return Grid(
        f"classes-{kind}{'-ablations' if of else ''}", caption, "Class", (), tuple(map(title_of, shares)), tuple(rows)
    )


def parted_grids(key: str, stub: str, by: str, parts: Mapping[str, Mapping[str, Any]]) -> Iterator[Grid]:
    """Show parts of a campaign, each measured by itself: Reins's metrics, then methods side by side.

    Args:
        key: What anchors begin with.
        stub: Heading of the parts' names.
        by: What a caption says of them.
        parts: part → method → metric → entry.
    """
    ours = {name: methods["reins"] for name, methods in parts.items() if "reins" in methods}
    measured = [name for name in _PART_METRICS if any(has_mean(metrics, name) for metrics in ours.values())]
    if measured:
        rows = [
            (part.replace("_", " "), tuple(entry_text(found.get(name), METRICS[name].unit) for name in measured))
            for part, found in ours.items()
        ]
        caption, headings = f"Reins {by}: mean ± std over seeds", tuple(map(heading_of, measured))
        yield Grid(f"{key}-table", caption, stub, (), headings, tuple(rows))
    methods = list(dict.fromkeys(method for found in parts.values() for method in found))
    for name in _COMPARED if len(methods) > 1 else ():
        if not any(has_mean(metrics, name) for found in parts.values() for metrics in found.values()):
            continue
        rows = [
            (
                part.replace("_", " "),
                tuple(entry_text(found.get(one, {}).get(name), METRICS[name].unit) for one in methods),
            )
            for part, found in parts.items()
        ]
        caption = f"{METRICS[name].title} {by} ({name} {BETTER[METRICS[name].better]})"
        yield Grid(f"{key}-{name.lower()}", caption, stub, (), tuple(map(title_of, methods)), tuple(rows))


def figure_at(results: Results, *places: Sequence[str]) -> published.Figure | None:
    """Return the figure at the first place that holds one, None if none does; a bare number has no std."""
    for place in places:
        found: object = results
        for key in place:
            found = mapping(found).get(key)
        if (mean := mean_of(found)) is not None:
            return published.Figure(mean, mapping(found).get("std"))
    return None


def mapping(value: object) -> Mapping[str, Any]:
    """Return a mapping as it is, a sweep's points by their sensitivity, and nothing for anything else."""
    if isinstance(value, list):
        return {f"{point['s']:.1f}": point for point in cast("list[dict[str, Any]]", value)}
    return cast("Mapping[str, Any]", value) if isinstance(value, Mapping) else {}


def mean_of(value: object) -> float | None:
    """Return the mean of an entry, or the number that stands there by itself."""
    mean: object = mapping(value).get("mean", value)
    return float(mean) if isinstance(mean, (int, float)) else None


def has_mean(metrics: Mapping[str, Any], name: str) -> bool:
    """Say whether a metric was measured."""
    return metrics.get(name, {}).get("mean") is not None


def entry_text(entry: Mapping[str, Any] | None, unit: str) -> str:
    """Write mean and std of an entry, and small below them its interval."""
    if entry is None or entry.get("mean") is None:
        return DASH
    decimals = decimals_of(unit)
    text = figure_text(published.Figure(entry["mean"], entry.get("std")), decimals, " ")
    low, high = entry.get("low"), entry.get("high")
    return text if low is None or high is None else f"{text}\n{number_text(low)}{DASH}{number_text(high)}"


def metric_text(name: str, entry: Mapping[str, Any] | None) -> str:
    """Write an entry of a metric."""
    return f"{at_least(name, mean_of(entry))}{entry_text(entry, METRICS[name].unit)}"


def at_least(name: str, value: object) -> str:
    """Return `≥ ` before a depth that can be no deeper: counted until the middle of the robot is at the edge."""
    full = name == "ZONE_DEPTH_P95" and isinstance(value, float) and value >= HULL_M - _SATURATED_M
    return "≥ " if full else ""


def figure_text(figure: published.Figure | None, decimals: int, gap: str = "\n") -> str:
    """Write a figure; what follows a line break stands small under the number."""
    if figure is None:
        return DASH
    return number_text(figure.mean, decimals) + (
        "" if figure.std is None else f"{gap}±{number_text(figure.std, decimals)}"
    )


def number_text(value: float, decimals: int = 3) -> str:
    """Write a number, with a real minus sign."""
    return f"{value:.{decimals}f}".replace("-", MINUS)


def plain_text(value: object) -> str:
    """Write whatever stands in results."""
    match value:
        case None:
            return DASH
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.0e}".replace("-", MINUS) if 0.0 < abs(value) < 0.001 else number_text(value)
        case Mapping():
            return "; ".join(f"{key} {plain_text(part)}" for key, part in mapping(cast("object", value)).items())
        case _:
            return str(value)


def _cells(
    table: PublishedTable, results: Results, row: str, figures: Iterable[published.Figure | None], *, alike: bool
) -> Iterator[tuple[str, str, str]]:
    for column, figure in zip(table.columns, figures, strict=True):
        ours = _ours(table, results, row, column.key)
        difference = DASH
        if alike and column.alike and ours is not None and figure is not None:
            difference = _signed(ours.mean - figure.mean, column.decimals)
        yield figure_text(ours, column.decimals), figure_text(figure, column.decimals), difference


def _ours(table: PublishedTable, results: Results, row: str, column: str) -> published.Figure | None:
    """Return our figure for a cell; counts are brought to as many trials as the paper counts."""
    ours = figure_at(results, *published.places_of(table, row, column))
    if ours is None or table is not published.CONFUSION:
        return ours
    cells = [(row, column.key) for row in table.rows for column in table.columns]
    counts = [figure_at(results, *published.places_of(table, *cell)) for cell in cells]
    return published.Figure(published.CONFUSION_TRIALS * ours.mean / sum(count.mean for count in counts if count))


def _signed(value: float, decimals: int) -> str:
    text = f"{value:+.{decimals}f}"
    return "0" if float(text) == 0 else text.replace("-", MINUS)
