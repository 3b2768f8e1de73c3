"""The README's table of measured figures, written from `results.json` between two comments and never by hand."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from shutil import copymode
from typing import TYPE_CHECKING, Any, Final

from app.evaluation.goals import TARGETS
from app.evaluation.metrics import METRICS
from app.evaluation.published import TABLES, Figure
from app.evaluation.report_names import leaves_out

if TYPE_CHECKING:
    from pathlib import Path

    from app.evaluation.goals import Target

Results = Mapping[str, Any]


class ReadmeError(Exception):
    """A file without a place for the table, or results without a figure for it."""


def refresh(path: Path, results: Results) -> None:
    """Put the table of a protocol into a file, between `<!-- evaluate:NAME -->` and `<!-- /evaluate:NAME -->`.

    Raises:
        ReadmeError: the file has no such comments, or nothing was measured that its table shows.
        OSError: it cannot be read or written.
    """
    begin, end = _comments(results["protocol"])
    text = check_place(path, results["protocol"])
    rows = [*_rows(results)]
    if not rows:
        raise ReadmeError(f"`{path}` stays as it is: valid are results with figures of Reins, these have none")
    block = "\n".join([begin, *_head(results), *rows, end])
    _write(path.resolve(), _place(begin, end).sub(lambda _: block, text, count=1))


def _write(path: Path, text: str) -> None:
    """Put another text into a file, which stays as it is until all of it is written; a disk may be full."""
    partial = path.with_name(f"{path.name}.partial")
    try:
        partial.write_text(text, encoding="utf-8")
        copymode(path, partial)
        partial.replace(path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise


def check_place(path: Path, protocol: str) -> str:
    """Return the text of a file that has a place for the table of a protocol.

    Raises:
        ReadmeError: the file has no such comments.
        OSError: it cannot be read.
    """
    begin, end = _comments(protocol)
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ReadmeError(f"`{path}` is no text in UTF-8: valid is a file with `{begin}` and `{end}`") from error
    if not _place(begin, end).search(text):
        raise ReadmeError(f"`{path}` has no place for the table: valid is a file with `{begin}` and `{end}`")
    return text


def _comments(protocol: str) -> tuple[str, str]:
    return f"<!-- evaluate:{protocol} -->", f"<!-- /evaluate:{protocol} -->"


def _place(begin: str, end: str) -> re.Pattern[str]:
    return re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)


_OVER: Final = "mean ± standard deviation over seeds, the rest over the rows of all seeds together"


def _head(results: Results) -> Iterator[str]:
    seeds = ", ".join(map(str, results["seeds"]))
    each = "task and seed" if results.get("per_task") else "seed"
    yield f"Protocol `{results['protocol']}`, seeds {seeds}, {results['trials']} trials for each {each}; {_OVER}:"
    yield ""
    goals = _has_goals(results)
    yield "| metric | paper | Reins |" + (" goal |" if goals else "")
    yield "|---|---|---|" + ("---|" if goals else "")


def _has_goals(results: Results) -> bool:
    return results["protocol"] == "physical"


def _rows(results: Results) -> Iterator[str]:
    goals = _has_goals(results)
    measured: Mapping[str, Any] = results.get("methods", {}).get("reins", {})
    for target in TARGETS:
        metric = target.metric
        entry: Mapping[str, Any] = measured.get(metric) or {}
        if target.readme and entry.get("mean") is not None:
            told = _ours(entry) + (_beside(target, measured) if goals else "")
            title = f"{METRICS[metric].title} ({metric}){leaves_out(metric, results['protocol'])}"
            line = f"| {title} | {_paper(metric)} | {told} |"
            yield line + (f" {target.text} |" if goals else "")


_PRINTED_AS: Final = {"RBSR_ALL": "RBSR", "RBSR": ""}
"""The paper's RBSR counts what has no rollback as well."""


def _paper(metric: str) -> str:
    """Return what the paper prints for its framework; its ablation table says something else, and comes last."""
    key = _PRINTED_AS.get(metric, metric)
    for table in TABLES:
        for place, column in enumerate(table.columns):
            if column.key == key and "reins" in table.rows and (figure := table.rows["reins"][1][place]) is not None:
                return _text(figure)
    return "–"


def _ours(entry: Mapping[str, Any]) -> str:
    low, high = entry.get("low"), entry.get("high")
    interval = "" if low is None or high is None else f" ({low:.3f}–{high:.3f}) of {entry['n']:,}"
    return _text(Figure(entry["mean"], entry.get("std"))) + interval


def _beside(target: Target, measured: Mapping[str, Any]) -> str:
    """Say what stands beside a figure, and over how many rows: one share can hide what its parts are."""
    found: list[tuple[str, Mapping[str, Any]]] = [
        (name, measured.get(metric) or {}) for metric, name in target.beside.items()
    ]
    told = [
        f"{name} –" if entry.get("mean") is None else f"{name} {entry['pooled']:.3f} of {entry['n']:,}"
        for name, entry in found
    ]
    return f"; {', '.join(told)}" if any(entry.get("mean") is not None for _, entry in found) else ""


def _text(figure: Figure) -> str:
    return f"{figure.mean:.3f}" + ("" if figure.std is None else f" ± {figure.std:.3f}")
