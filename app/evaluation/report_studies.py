"""The report's part on studies: each as its tables say, with plots where a picture tells more."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from app.evaluation.metrics import METRICS
from app.evaluation.plots import shares
from app.evaluation.report_goals import prompt_shares, yes_of
from app.evaluation.report_names import heading_of
from app.evaluation.report_tables import Grid, Results, entry_text, mapping, mean_of, number_text, plain_text
from app.evaluation.study_sensors import PERIOD_TICKS, PROMPT_TICKS

if TYPE_CHECKING:
    from app.evaluation.plots import Plot


def study_grids(results: Results) -> Iterator[tuple[str, str, str, tuple[Grid, ...]]]:
    """Yield, for every study that was run, its name, title, what it is about, and its tables."""
    studies: Mapping[str, Mapping[str, Any]] = results.get("studies", {})
    for name, study in studies.items():
        cameras = cameras_text(results) if name == "sensors" else ""
        about = " ".join(text for text in (study["about"], _NOT_ASKED.get(name, ""), cameras) if text)
        yield name, study["title"], about, tuple(
            _grid(name, number, table) for number, table in enumerate(study["tables"])
        )  # fmt: skip


_NOT_ASKED: Final = {
    "sensors": "Not asked: a tracker that is wrong by a constant before anybody is in view is not noticed, since "
    "nothing else sees people, and here somebody is in view when it breaks; what sticks while nothing is told to move "
    "is noticed when something is.",
    "supervisors": "Only what is midway is executed. Approvals before a launch are computed: policy says of a proposal "
    "how many have to approve it and how long it waits, answers are drawn, and from them follow the table's shares; no "
    "proposal waits at a desk there, and nothing is launched.",
}
_KINDS: Final = {"noisy": "garbage"}


def cameras_text(results: Results) -> str:
    """Say how often cameras that are wrong about objects were noticed in time, and why; empty where all were."""
    told: dict[str, list[str]] = {"objects": [], "people": []}
    missed = False
    for (sensor, kind), sizes in prompt_shares(results).items():
        for size, entry in sizes[1:] or sizes:
            if size and sensor in told and (n := int(entry.get("n", 0))):
                told[sensor].append(f"{_KINDS.get(kind, kind)} of {size:g} m {yes_of(entry)} of {n}")
                missed |= sensor == "objects" and yes_of(entry) < n
    if not missed:
        return ""
    people = f"; of a tracker that is wrong about people: {', '.join(told['people'])}" if told["people"] else ""
    return (
        f"Cameras that are wrong about where objects are may be noticed late: restrained within {PROMPT_TICKS} ticks "
        f"were {', '.join(told['objects'])}{people}. From one picture of objects to the next it is at most "
        f"{PERIOD_TICKS['objects']} ticks, and one in which no two of them are where they cannot be may be true."
    )


def study_plots(name: str, results: Results) -> tuple[Plot, ...]:
    """Return the plots of a study: where many shares are compared, a picture is read sooner than a table."""
    tables: Sequence[Mapping[str, Any]] = results["studies"][name]["tables"]
    match name:
        case "sensors":
            return tuple(
                _drawn(
                    _pivot(tables[0]["rows"], "detected"),
                    "Broken sensors: share that was detected, in time or later; big and wild are bigger sizes.",
                )
            )
        case "supervisors":
            rows: Mapping[str, Mapping[str, Any]] = tables[1]["rows"]
            wanted = ("done (RSR)", "expired", "violated for over 250 ms")
            cells = {row: _means({key: found[key] for key in wanted}) for row, found in rows.items()}
            return tuple(_drawn(cells, "Sessions that waited for a human: what became of them."))
        case "generalisation":
            rows = tables[0]["rows"]
            cells = {row: _means({key: found[key] for key in ("RVDR", "UCR", "FAS")}) for row, found in rows.items()}
            return tuple(_drawn(cells, "Other sensors, other ways of walking."))
        case _:
            return ()


def _drawn(cells: Mapping[str, Mapping[str, float]], caption: str) -> Iterator[Plot]:
    if any(cells.values()):
        yield shares(cells, caption)


def _pivot(rows: Mapping[str, Mapping[str, Any]], key: str) -> dict[str, dict[str, float]]:
    """Return rows named `sensor/fault size` as sensor → fault → mean; a fault's sizes follow each other, ascending."""
    cells: dict[str, dict[str, float]] = {}
    for name, found in rows.items():
        sensor, fault = name.split("/")
        kind = fault.split()[0]
        cell = cells.setdefault(sensor, {})
        kind = next(name for name in (kind, f"{kind}\nbig", f"{kind}\nwild") if name not in cell)
        cell.update(_means({kind: found[key]}))
    return cells


def _means(entries: Mapping[str, Any]) -> dict[str, float]:
    return {name: mean for name, entry in entries.items() if (mean := mean_of(entry)) is not None}


def _grid(name: str, number: int, table: Mapping[str, Any]) -> Grid:
    rows: Mapping[str, Mapping[str, Any]] = table["rows"]
    headings = _headings(tuple(rows.values()))
    return Grid(
        f"study-{name}-{number}",
        table["caption"],
        table["stub"],
        (),
        tuple(heading_of(heading) if "_" in heading and heading in METRICS else heading for heading in headings),
        tuple((row, tuple(_text(cells.get(heading), heading) for heading in headings)) for row, cells in rows.items()),
        table["remark"],
    )


def _headings(rows: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return the columns that hold anything, in the order in which rows name them."""
    named = dict.fromkeys(heading for row in rows for heading in row)
    return tuple(heading for heading in named if any(_text(row.get(heading)) != _text(None) for row in rows))


def _text(value: object, heading: str = "") -> str:
    """Write a cell; a bare number is no share but ticks or seconds, of which thousandths say nothing."""
    entry = mapping(value)
    if "mean" in entry:
        return entry_text(entry, "1")
    return number_text(value, 1 if "tick" in heading else 2) if isinstance(value, float) else plain_text(value)
