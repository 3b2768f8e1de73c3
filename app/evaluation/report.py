"""`report.html`: every table of the paper with our number, the paper's and the difference, and what else was measured.

One file, readable without a network. A section whose data are absent says so in a sentence, so that a reader can tell
"not measured" from "forgotten". Everything it prints follows from `results.json`, `published` and the definitions of
the metrics.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from jinja2 import Environment, PackageLoader, StrictUndefined

from app.evaluation import plots, published
from app.evaluation.extensions import all_methods
from app.evaluation.methods import ABLATIONS
from app.evaluation.metrics import METRICS, Metric
from app.evaluation.model import TUNING_SEEDS

if TYPE_CHECKING:
    from app.evaluation.plots import Plot
    from app.evaluation.published import PublishedTable

DASH: Final = "–"
MINUS: Final = "−"
_TEMPLATE: Final = "report.html.j2"
_BETTER: Final = {"higher": "↑", "lower": "↓"}
_TASK_METRICS: Final = ("UAIR", "FRR", "RVDR", "UCR", "RSR", "RPC")

_TESTS: Final = {"t": "t", "t_p": "p", "wilcoxon_p": "Wilcoxon p"}

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


class Section(NamedTuple):
    """A part of the page; one without grids, plots and items says `absent` instead."""

    id: str
    title: str
    intro: str
    absent: str
    grids: tuple[Grid, ...] = ()
    plots: tuple[Plot, ...] = ()
    items: tuple[tuple[str, str, str], ...] = ()
    """Term, what it is called, what it means."""

    @property
    def empty(self) -> bool:
        """Whether there is nothing to show."""
        return not (self.grids or self.plots or self.items)


def write_report(results: Results, path: Path) -> None:
    """Render the report; the file appears when it is whole."""
    partial = path.with_suffix(".partial")
    partial.write_text(render(results), encoding="utf-8")
    partial.replace(path)


def render(results: Results) -> str:
    """Return the report of some results as HTML."""
    environment = Environment(
        loader=PackageLoader("app.evaluation", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page: str = environment.get_template(_TEMPLATE).render(
        protocol=results["protocol"], facts=_facts(results), sections=sections(results)
    )
    return page


def sections(results: Results) -> list[Section]:
    """Return the parts of the page, in order."""
    return [
        _paper_tables(results),
        _plots(results),
        _overview(results),
        _by_task(results),
        _classes(results),
        _cross_profile(results),
        _scorecard(results),
        _unpublished(results),
        _definitions(),
    ]


def paper_grid(table: PublishedTable, results: Results) -> Grid:
    """Put our numbers beside a published table's: ours, the paper's, the difference."""
    rows = [
        (name, tuple(text for cell in _cells(table, results, key, figures) for text in cell))
        for key, (name, figures) in table.rows.items()
    ]
    return Grid(
        id=table.label.replace(":", "-"),
        caption=f"{table.title} ({table.label})",
        stub=table.stub,
        groups=tuple((f"{column.heading} {column.better}".strip(), 3) for column in table.columns),
        headings=("ours", "paper", "diff.") * len(table.columns),
        rows=tuple(rows),
        remark=table.remark,
    )


def figure_at(results: Results, *places: Sequence[str]) -> published.Figure | None:
    """Return the figure at the first place that holds one, None if none does; a bare number has no std."""
    for place in places:
        found: object = results
        for key in place:
            found = _mapping(found).get(key)
        if (mean := _mean(found)) is not None:
            return published.Figure(mean, _mapping(found).get("std"))
    return None


def _mapping(value: object) -> Mapping[str, Any]:
    """Return a mapping as it is, a sweep's points by their sensitivity, and nothing for anything else."""
    if isinstance(value, list):
        return {f"{point['s']:.1f}": point for point in cast("list[dict[str, Any]]", value)}
    return cast("Mapping[str, Any]", value) if isinstance(value, Mapping) else {}


def _cells(
    table: PublishedTable, results: Results, row: str, figures: Iterable[published.Figure | None]
) -> Iterator[tuple[str, str, str]]:
    for column, figure in zip(table.columns, figures, strict=True):
        ours = _ours(table, results, row, column.key)
        difference = DASH if ours is None or figure is None else _signed(ours.mean - figure.mean, column.decimals)
        yield _figure(ours, column.decimals), _figure(figure, column.decimals), difference


def _ours(table: PublishedTable, results: Results, row: str, column: str) -> published.Figure | None:
    """Return our figure for a cell; counts are brought to as many trials as the paper counts."""
    ours = figure_at(results, *published.places_of(table, row, column))
    if ours is None or table is not published.CONFUSION:
        return ours
    cells = [(row, column.key) for row in table.rows for column in table.columns]
    counts = [figure_at(results, *published.places_of(table, *cell)) for cell in cells]
    return published.Figure(published.CONFUSION_TRIALS * ours.mean / sum(count.mean for count in counts if count))


def _figure(figure: published.Figure | None, decimals: int, gap: str = "\n") -> str:
    """Write a figure; what follows a line break stands small under the number."""
    if figure is None:
        return DASH
    return _number(figure.mean, decimals) + ("" if figure.std is None else f"{gap}±{_number(figure.std, decimals)}")


def _number(value: float, decimals: int = 3) -> str:
    return f"{value:.{decimals}f}".replace("-", MINUS)


def _signed(value: float, decimals: int) -> str:
    text = f"{value:+.{decimals}f}"
    return "0" if float(text) == 0 else text.replace("-", MINUS)


def _title(method: str) -> str:
    known = all_methods()
    return known[method].title if method in known else method


def _facts(results: Results) -> list[tuple[str, str]]:
    configuration = results.get("configuration", {})
    facts = [
        ("Protocol", str(results["protocol"])),
        ("Reported seeds", ", ".join(map(str, results["seeds"]))),
        ("Trials per method, task and seed", str(results["trials"])),
        ("Seeds used for tuning, never reported", ", ".join(map(str, TUNING_SEEDS))),
    ]
    facts += [(name.capitalize(), str(configuration[name])) for name in ("version", "policy") if name in configuration]
    if shared := sorted(set(results["seeds"]) & set(TUNING_SEEDS)):
        facts.append(("Warning", f"seeds {', '.join(map(str, shared))} were used for tuning: these are no results"))
    return facts


def _overview(results: Results) -> Section:
    grids = [
        _metrics_grid(key, caption, results.get(key, {}))
        for key, caption in (("methods", "Every method"), ("ablations", "Reins with one part left out"))
        if results.get(key)
    ]
    return Section(
        "overview",
        "All metrics",
        "Mean and standard deviation over seeds; below, where the metric is a proportion, Wilson's 95 % interval over "
        "all rows. ↑ higher is better, ↓ lower. A dash: no trial could show it.",
        "No method was measured.",
        grids=tuple(grids),
    )


def _metrics_grid(key: str, caption: str, methods: Mapping[str, Mapping[str, Any]]) -> Grid:
    measured = [name for name in METRICS if any(_has(metrics, name) for metrics in methods.values())]
    rows = tuple(
        (_heading(name), tuple(_entry(metrics.get(name), METRICS[name].unit) for metrics in methods.values()))
        for name in measured
    )
    return Grid(f"{key}-table", caption, "Metric", (), tuple(map(_title, methods)), rows)


def _heading(name: str) -> str:
    metric = METRICS[name]
    unit = "" if metric.unit == "1" else f", {metric.unit}"
    return f"{name.replace('_', ' ')}{unit} {_BETTER[metric.better]}"


def _has(metrics: Mapping[str, Any], name: str) -> bool:
    return metrics.get(name, {}).get("mean") is not None


def _entry(entry: Mapping[str, Any] | None, unit: str) -> str:
    if entry is None or entry.get("mean") is None:
        return DASH
    decimals = 3 if unit == "1" else 2
    text = _figure(published.Figure(entry["mean"], entry.get("std")), decimals, " ")
    low, high = entry.get("low"), entry.get("high")
    return text if low is None or high is None else f"{text}\n{_number(low)}{DASH}{_number(high)}"


def _paper_tables(results: Results) -> Section:
    return Section(
        "paper",
        "The paper's tables",
        "Each with our number, the paper's, and the difference (ours less the paper's). ± is the standard deviation "
        "over seeds. A dash: not measured in this campaign, or not printed in the paper.",
        "",
        grids=(*(paper_grid(table, results) for table in published.TABLES), *_tests(results)),
    )


def _tests(results: Results) -> Iterator[Grid]:
    """Show the tests of significance that the paper reports in its text."""
    baselines: Mapping[str, Mapping[str, Any]] = results.get("effect_sizes", {})
    metrics = tuple(dict.fromkeys(metric for found in baselines.values() for metric in found))
    rows = tuple(
        (_title(name), tuple(_plain(found.get(metric, {}).get(key)) for metric in metrics for key in _TESTS))
        for name, found in baselines.items()
    )
    paper = ", ".join(f"t {_number(t, 2)} ({metric})" for metric, t in published.T_TESTS.items())
    if rows:
        yield Grid(
            "tests",
            "Significance of Reins's difference to each baseline",
            "Baseline",
            tuple((metric, len(_TESTS)) for metric in metrics),
            tuple(_TESTS.values()) * len(metrics),
            rows,
            f"Paired over seeds; positive means that Reins is better. The paper against RoboGuard-style: {paper}, "
            f"each p < 0.001; Wilcoxon p {published.WILCOXON_P} for every baseline, the least that five seeds give.",
        )


def _plots(results: Results) -> Section:
    return Section(
        "plots",
        "Plots",
        "",
        "Nothing that this campaign measured can be drawn: it has no types, no sensitivity sweep and no distributions.",
        plots=tuple(_drawn(results)),
    )


def _drawn(results: Results) -> Iterator[Plot]:
    if bars := _bars(results.get("per_type", {}).get("reins", {})):
        yield plots.per_type(bars)
    ours = [
        plots.Point(p["s"], rvdr, ucr, _mean(p.get("RSR")), _mean(p.get("FAR")))
        for p in results.get("sensitivity", ())
        if (rvdr := _mean(p.get("RVDR"))) is not None and (ucr := _mean(p.get("UCR"))) is not None
    ]
    if ours:
        yield plots.frontier(ours, _published_points())
        yield plots.sweep(ours)
    if any(point.far is not None for point in ours):
        yield plots.roc(ours)
    spreads = results.get("distributions", {})
    for key, unit, caption, names in (
        ("latency_ticks", "control ticks", "Detection latency by type of violation.", _violation_name),
        ("recovery_s", "s", "Recovery time by method.", _title),
    ):
        groups = {names(name): values for name, values in spreads.get(key, {}).items() if values}
        if groups:
            yield plots.spread(groups, unit, caption)


def _bars(types: Mapping[str, Any]) -> list[plots.Bar]:
    bars: list[plots.Bar] = []
    for key, (name, (figure, *_)) in published.PER_TYPE.rows.items():
        entry = types.get(key, {})
        if entry.get("mean") is not None:
            bars.append(plots.Bar(name, entry["mean"], entry.get("low"), entry.get("high"), figure and figure.mean))
    return bars


def _published_points() -> list[plots.Point]:
    points: list[plots.Point] = []
    for key, (_, figures) in published.SENSITIVITY.rows.items():
        rvdr, ucr, rsr = (figure.mean for figure in figures if figure is not None)
        points.append(plots.Point(float(key), rvdr, ucr, rsr, None))
    return points


def _mean(value: object) -> float | None:
    """Return the mean of an entry, or the number that stands there by itself."""
    mean: object = _mapping(value).get("mean", value)
    return float(mean) if isinstance(mean, (int, float)) else None


def _violation_name(key: str) -> str:
    return published.PER_TYPE.rows[key][0] if key in published.PER_TYPE.rows else key


def _by_task(results: Results) -> Section:
    found: Mapping[str, Mapping[str, Any]] = results.get("per_task", {})
    tasks = {task: methods["reins"] for task, methods in found.items() if "reins" in methods}
    measured = [name for name in _TASK_METRICS if any(_has(metrics, name) for metrics in tasks.values())]
    rows = tuple(
        (task.replace("_", " "), tuple(_entry(metrics.get(name), METRICS[name].unit) for name in measured))
        for task, metrics in tasks.items()
    )
    headings = tuple(map(_heading, measured))
    grid = Grid("task-table", "Reins by task type: mean ± std over seeds", "Task", (), headings, rows)
    return Section(
        "tasks",
        "By task type",
        "",
        "This campaign's trials are single capabilities; it has no task types.",
        grids=(grid,) if rows and measured else (),
    )


def _classes(results: Results) -> Section:
    kinds: Mapping[str, Mapping[str, Mapping[str, float]]] = results.get("classes", {})
    grids = tuple(
        _class_grid(kind, of, {name: kinds[name].get(kind, {}) for name in names})
        for kind in dict.fromkeys(kind for of_method in kinds.values() for kind in of_method)
        for of, names in (
            ("", [name for name in kinds if name not in ABLATIONS]),
            (", ablations", [name for name in kinds if name in ABLATIONS]),
        )
        if names
    )
    return Section(
        "classes",
        "What became of every trial",
        "Each trial falls into exactly one class, so that nothing stays unexplained.",
        "This campaign has not sorted its trials into classes.",
        grids=grids,
    )


def _class_grid(kind: str, of: str, shares: Mapping[str, Mapping[str, float]]) -> Grid:
    """Show the classes of one kind of trial; the shares of a method add up to 1."""
    names = list(dict.fromkeys(name for classes in shares.values() for name in classes))
    rows = [
        (name.replace("_", " "), tuple(_number(classes.get(name, 0.0)) for classes in shares.values()))
        for name in names
    ]
    rows.append(("all classes", tuple(_number(sum(classes.values())) for classes in shares.values())))
    caption = f"{kind.capitalize()} trials{of}: share of each class"
    return Grid(
        f"classes-{kind}{'-ablations' if of else ''}", caption, "Class", (), tuple(map(_title, shares)), tuple(rows)
    )


def _cross_profile(results: Results) -> Section:
    found: Mapping[str, Mapping[str, Any]] = results.get("cross_profile", {})
    profiles = tuple(dict.fromkeys(profile for row in found.values() for profile in row))
    rows = tuple((name, tuple(_plain(row.get(profile)) for profile in profiles)) for name, row in found.items())
    grid = Grid("matrix", "The same proposals in four environment profiles", "Proposal", (), profiles, rows)
    return Section(
        "cross-profile",
        "Across environment profiles",
        "The same agent, the same proposals: what changes is policy alone.",
        "This campaign has not run the same proposals in all profiles.",
        grids=(grid,) if rows else (),
    )


def _scorecard(results: Results) -> Section:
    found: Mapping[str, Any] = results.get("scorecard", {})
    items = tuple(
        (name.replace("_", " "), _plain(_mapping(score).get("value", score)), str(_mapping(score).get("how", "")))
        for name, score in found.items()
    )
    return Section(
        "scorecard",
        "Scorecard",
        "The seven dimensions of EmbodiedGovBench (arXiv 2604.11174).",
        "This campaign has no scorecard.",
        items=items,
    )


def _plain(value: object) -> str:
    match value:
        case None:
            return DASH
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.0e}".replace("-", MINUS) if 0.0 < abs(value) < 0.001 else _number(value)
        case Mapping():
            return "; ".join(f"{key} {_plain(part)}" for key, part in _mapping(cast("object", value)).items())
        case _:
            return str(value)


def _unpublished(results: Results) -> Section:
    return Section(
        "unpublished",
        "What the paper does not publish",
        "Nothing here was fitted to the paper's numbers; where they differ, this is one reason.",
        "This protocol takes no parameter from the paper that the paper does not publish.",
        items=tuple(
            (
                one["parameter"],
                f"affects {', '.join(one['affects'])}",
                f"The paper {one['paper']}. Here: {one['here']}.",
            )
            for one in results.get("unpublished", ())
        ),
    )


def _definitions() -> Section:
    items = tuple(
        (metric.name, f"{metric.title}, {'share' if metric.unit == '1' else metric.unit}", _meaning(metric))
        for metric in METRICS.values()
    )
    return Section(
        "definitions",
        "Definitions",
        "As the code defines them. A metric is computed for each seed from the rows that say something about it, then "
        "averaged over seeds.",
        "",
        items=items,
    )


def _meaning(metric: Metric) -> str:
    """Say what a metric counts, and what the docstring of the function that takes it from a row adds."""
    told = " ".join((metric.take.__doc__ or "").split())
    return f"{metric.says[:1].upper()}{metric.says[1:]}." + (f" {told}" if told else "")
