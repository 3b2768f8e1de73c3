"""The report's part on studies: each as its tables say, with plots where a picture tells more."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from app.evaluation.report_tables import Grid, Results, entry_text, mapping, plain_text


def study_grids(results: Results) -> Iterator[tuple[str, str, str, tuple[Grid, ...]]]:
    """Yield, for every study that was run, its name, title, what it is about, and its tables."""
    studies: Mapping[str, Mapping[str, Any]] = results.get("studies", {})
    for name, study in studies.items():
        yield name, study["title"], study["about"], tuple(
            _grid(name, number, table) for number, table in enumerate(study["tables"])
        )  # fmt: skip


def _grid(name: str, number: int, table: Mapping[str, Any]) -> Grid:
    rows: Mapping[str, Mapping[str, Any]] = table["rows"]
    headings = _headings(tuple(rows.values()))
    return Grid(
        f"study-{name}-{number}",
        table["caption"],
        table["stub"],
        (),
        headings,
        tuple((row, tuple(_text(cells.get(heading)) for heading in headings)) for row, cells in rows.items()),
        table["remark"],
    )


def _headings(rows: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return the columns that hold anything, in the order in which rows name them."""
    named = dict.fromkeys(heading for row in rows for heading in row)
    return tuple(heading for heading in named if any(_text(row.get(heading)) != _text(None) for row in rows))


def _text(value: object) -> str:
    entry = mapping(value)
    return entry_text(entry, "1") if "mean" in entry else plain_text(value)
