"""`report.html`: every table of the paper with our number, the paper's and the difference, and what else was measured.

One file, readable without a network. A section whose data are absent says so in a sentence, so that a reader can tell
"not measured" from "forgotten". Everything it prints follows from `results.json`, `published` and the definitions of
the metrics.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined

from app.evaluation import published
from app.evaluation.circumstances import NOMINAL
from app.evaluation.methods import ABLATIONS
from app.evaluation.metrics import METRICS, Metric
from app.evaluation.model import TUNING_SEEDS
from app.evaluation.report_counts import (
    asked_grids,
    common_grids,
    ended_text,
    latency_grids,
    redraw_grids,
    rollback_grids,
)
from app.evaluation.report_floor import ABOUT as FLOOR_ABOUT
from app.evaluation.report_floor import floor_grids, floor_plots
from app.evaluation.report_goals import ABOUT as GOALS_ABOUT
from app.evaluation.report_goals import goal_grids
from app.evaluation.report_names import BETTER, in_words, metrics_of, name_of, row_name
from app.evaluation.report_plots import drawn
from app.evaluation.report_profiles import profile_grids, profile_plots
from app.evaluation.report_studies import study_grids, study_plots
from app.evaluation.report_tables import (
    Grid,
    Results,
    class_grid,
    has_ours,
    mapping,
    metrics_grid,
    paper_grid,
    parted_grids,
    plain_text,
    sweep_grids,
    test_grids,
    unsafe_grids,
)

if TYPE_CHECKING:
    from app.evaluation.plots import Plot
    from app.evaluation.published import PublishedTable

_TEMPLATE: Final = "report.html.j2"


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

    pictures_first: bool = False
    """Whether plots stand above the tables, as where a table only says more of the same."""

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
        *_goals(results),
        *_safe_state(results),
        *_counts(results),
        _paper_tables(results),
        _plots(results),
        _overview(results),
        _by_task(results),
        *_by_fault(results),
        _classes(results),
        _cross_profile(results),
        _scorecard(results),
        *_studies(results),
        _unpublished(results),
        _definitions(results),
    ]


def _facts(results: Results) -> list[tuple[str, str]]:
    configuration = results.get("configuration", {})
    facts = [
        ("Protocol", str(results["protocol"])),
        ("Reported seeds", ", ".join(map(str, results["seeds"]))),
        (f"Trials per method{', task' if results.get('per_task') else ''} and seed", str(results["trials"])),
        ("Seeds used for tuning, never reported", ", ".join(map(str, TUNING_SEEDS))),
    ]
    facts += [
        (name.capitalize(), f"{configuration[name]}{_DIGESTS.get(name, '')}")
        for name in ("version", "policy", "code")
        if name in configuration
    ]
    if libraries := configuration.get("libraries"):
        facts.append(("Libraries", ", ".join(f"{name} {version}" for name, version in libraries.items())))
    if configuration.get("circumstances"):
        told = "; ".join(part.replace("_", " ").replace("=", " ") for part in configuration["circumstances"].split(","))
        nominal = f". {NOMINAL}" if "noise=" in configuration["circumstances"] else ""
        facts.append(("Circumstances", f"other than reported: {told}{nominal}"))
    if shared := sorted(set(results["seeds"]) & set(TUNING_SEEDS)):
        facts.append(("Warning", f"seeds {', '.join(map(str, shared))} were used for tuning: these are no results"))
    facts.append(("Means and pooled figures", _POOLED))
    return facts


_DIGESTS: Final = {
    "policy": " (digest of the policy that was in force)",
    "code": " (digest of the Python files that rows may follow from: what only counts rows, shows them or serves is "
    "left out, so that a report that was mended keeps it)",
}
_POOLED: Final = (
    "What has a ± is a mean over seeds and its standard deviation, and so are the bars of detection by type, the "
    "points of a sweep, and the ticks in the studies of sensitivity and of what no threshold was set on; effect sizes "
    "and tests are over the seeds' values. The rest is pooled, over the rows of all seeds together: intervals (Wilson, "
    "95 %), counts, classes, other medians and percentiles, worst cases, and the shares of studies without a ±."
)


def _command(results: Results, options: str, protocol: str = "") -> str:
    """Return the command that fills an empty section; a campaign of its own needs a folder of its own."""
    return f"reins evaluate --protocol {protocol or results['protocol']} {options} --out FOLDER"


def _goals(results: Results) -> Iterator[Section]:
    if grids := tuple(goal_grids(results)):
        yield Section(
            "goals",
            "What Reins must reach in the workcell",
            GOALS_ABOUT,
            "",
            grids=grids,
        )


def _safe_state(results: Results) -> Iterator[Section]:
    if grids := tuple(floor_grids(results)):
        yield Section(
            "safe-state", "Time to safe state", FLOOR_ABOUT, "", grids=grids, plots=tuple(floor_plots(results))
        )


def _counts(results: Results) -> Iterator[Section]:
    if grids := tuple(latency_grids(results)):
        yield Section("latency", "Latencies", "What a decision takes, and how late a violation is told of.", "", grids)
    if grids := tuple(asked_grids(results)):
        about = "Sessions that went wrong, and waited for a human. " + ended_text(results)
        yield Section("asked-midway", "Humans midway", about, "", grids)
    if grids := tuple(rollback_grids(results)):
        yield Section("rollback", "Rollbacks", "Which went back, which did not, and after what.", "", grids)
    if grids := tuple(common_grids(results)):
        yield Section("recovery-time", "Recovery times", "Compared over the same trials.", "", grids)
    if grids := tuple(redraw_grids(results)):
        yield Section("drawn-again", "Faults that did nothing", "What was drawn again, and how often.", "", grids)


def _overview(results: Results) -> Section:
    grids = [
        metrics_grid(key, caption, results.get(key, {}), results["protocol"])
        for key, caption in (("methods", "Every method"), ("ablations", "Reins with one part left out"))
        if results.get(key)
    ]
    return Section(
        "overview",
        "All metrics",
        "Mean and standard deviation over seeds; below, where the metric is a proportion, Wilson's 95 % interval over "
        "all rows. ↑ higher is better, ↓ lower. A dash: no trial could show it.",
        f"No method was measured; {_command(results, '--methods all')} does.",
        grids=tuple(grids),
    )


def _paper_tables(results: Results) -> Section:
    return Section(
        "paper",
        "The paper's tables",
        "Each with our number, the paper's, and the difference (ours less the paper's). ± is the standard deviation "
        "over seeds. A dash: not measured in this campaign, or not printed in the paper." + _left_out(results),
        "This campaign has no number for any table of the paper; "
        f"{_command(results, '--methods all --ablations')} has.",
        grids=(
            *(grid for table in published.TABLES for grid in _grids_of(table, results)),
            *sweep_grids(results),
            *test_grids(results),
        ),
    )


def _grids_of(table: PublishedTable, results: Results) -> Iterator[Grid]:
    """Yield a published table beside our numbers, and after the one of types what the paper does not print of them."""
    if has_ours(table, results):
        yield paper_grid(table, results)
    if table is published.PER_TYPE:
        yield from unsafe_grids(results)


_WHY_NOT: Final = {
    published.HUMAN_OVERRIDE.label: "it compares Reins with its ablation without a human: --ablations",
    published.LATENCY.label: "protocol paper times the components one by one; here decisions are, under latencies",
    published.SENSITIVITY.label: "in the workcell the sweep is a study: --studies sensitivity",
}


def _left_out(results: Results) -> str:
    """Name the tables of which this campaign has no number, and why."""
    missing = [table for table in published.TABLES if not has_ours(table, results)]
    said = (
        f"{table.title[:1].lower()}{table.title[1:]} ({table.label})"
        + (f", {_WHY_NOT[table.label]}" if table.label in _WHY_NOT else "")
        for table in missing
    )
    return f" Not shown, because this campaign has no number for it: {'; '.join(said)}." if missing else ""


def _plots(results: Results) -> Section:
    return Section(
        "plots",
        "Plots",
        "",
        "Nothing that this campaign measured can be drawn: it has no types, no sensitivity sweep and no distributions; "
        f"{_command(results, '--methods reins')} has some.",
        plots=tuple(drawn(results)),
    )


def _by_task(results: Results) -> Section:
    return Section(
        "tasks",
        "By task type",
        "",
        "This campaign's trials are single capabilities; it has no task types. Whole tasks are a campaign of their "
        f"own: {_command(results, '--tasks all')}.",
        grids=tuple(parted_grids("task", "Task", "by task type", results.get("per_task", {}))),
    )


def _by_fault(results: Results) -> Iterator[Section]:
    if grids := tuple(parted_grids("fault", "Fault", "by fault of a plugin", results.get("per_fault", {}))):
        yield Section("faults", "Faults of plugins", "Trials of their own, judged by the violation each provokes.", "",
                      grids=grids)  # fmt: skip


def _classes(results: Results) -> Section:
    kinds: Mapping[str, Mapping[str, Mapping[str, float]]] = results.get("classes", {})
    grids = tuple(
        class_grid(kind, of, {name: kinds[name].get(kind, {}) for name in names})
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
        f"This campaign has not sorted its trials into classes; {_command(results, '--methods all')} does.",
        grids=grids,
        items=tuple(
            (name.replace("_", " "), "", meaning) for name, meaning in results.get("class_meanings", {}).items()
        ),
    )


def _cross_profile(results: Results) -> Section:
    return Section(
        "cross-profile",
        "Across environment profiles",
        "The same agent, the same proposals: what changes is policy alone.",
        "This campaign has not run the same proposals in all profiles; "
        f"{_command(results, '--studies profiles --trials 0', 'physical')} does.",
        grids=profile_grids(results),
        plots=profile_plots(results),
        pictures_first=True,
    )


def _scorecard(results: Results) -> Section:
    found: Mapping[str, Any] = results.get("scorecard", {})
    items = tuple(
        (name.replace("_", " "), _score_text(score), str(mapping(score).get("how", "")))
        for name, score in found.items()
    )
    return Section(
        "scorecard",
        "Scorecard",
        "The seven dimensions of EmbodiedGovBench (arXiv 2604.11174).",
        f"This campaign has no scorecard; {_command(results, '--studies all --trials 0', 'physical')} has.",
        items=items,
    )


def _score_text(score: object) -> str:
    """Write a value of the card with its unit and which way is better: not every dimension is a share."""
    found = mapping(score)
    value = plain_text(found.get("value", score))
    if "unit" not in found:
        return value
    return f"{value} {found['unit']} ({BETTER[found['better']]} {found['better']} is better)"


def _studies(results: Results) -> Iterator[Section]:
    for name, title, about, grids in study_grids(results):
        yield Section(f"study-{name}", title, about, "Nothing was measured.", grids, study_plots(name, results),
                      pictures_first=True)  # fmt: skip


def _unpublished(results: Results) -> Section:
    return Section(
        "unpublished",
        "What the paper does not publish",
        "Nothing here was fitted to the paper's numbers; where they differ, this is one reason.",
        "This protocol takes no parameter from the paper that the paper does not publish.",
        items=tuple(
            (
                one["parameter"],
                f"affects {', '.join(_affected(name) for name in one['affects'])}",
                in_words(f"Paper: {one['paper']}. Here: {one['here']}."),
            )
            for one in results.get("unpublished", ())
        ),
    )


def _affected(name: str) -> str:
    """Return what a parameter affects in words: a metric, or a table of the paper."""
    return name_of(name) if name in METRICS else name.replace("_", " ")


def _definitions(results: Results) -> Section:
    protocol = results["protocol"]
    items = tuple(
        (
            row_name(name, protocol),
            "share" if METRICS[name].unit == "1" else METRICS[name].unit,
            _meaning(METRICS[name]),
        )
        for name in metrics_of(protocol)
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
    meaning = f"{metric.says[:1].upper()}{metric.says[1:]}." + (f" {told}" if told else "")
    return in_words(meaning)
