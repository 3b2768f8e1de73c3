"""Rows on disk: one file per finished job, and the tables merged from them.

A part is JSON lines: a head that names the configuration and the job, the rows, and a tail with their number and
digest. It is written under another name and renamed when it is whole, so that a part that is there is a job that is
done; one that was damaged since counts as none, and is run again.

`trials.csv` holds what follows from the configuration alone, so it is the same byte for byte on every run;
`timings.csv` holds what a clock said.
"""

from __future__ import annotations

import csv
import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Final

import orjson

from app.evaluation.rows import COLUMNS

if TYPE_CHECKING:
    from app.evaluation.jobs import Job
    from app.evaluation.model import Row, Value

KEYS: Final = ("method", "task", "seed", "trial")
TIMINGS: Final = ("decision_us",)
"""Columns that a clock filled."""

_NAME: Final = re.compile(r"[A-Za-z0-9._+-]{1,200}")


class RowError(ValueError):
    """A row that the table has no place for."""


class Parts:
    """The parts of one campaign: a folder and the configuration they must belong to."""

    def __init__(self, folder: Path, configuration: str, columns: Mapping[str, str] = COLUMNS) -> None:
        """Take the folder, the configuration's digest, and the columns that rows may have."""
        self.folder, self.configuration, self.columns = folder, configuration, columns

    def path(self, job: Job) -> Path:
        """Return where a job's rows go.

        Raises:
            ValueError: the job's name is no file name.
        """
        if not _NAME.fullmatch(job.name):
            raise ValueError(f"job name `{job.name}`: valid are letters, digits, `.`, `_`, `+` and `-`")
        return self.folder / f"{job.name}.jsonl"

    def has(self, job: Job) -> bool:
        """Say whether a job is done: its part is there, whole, and of this configuration."""
        try:
            with self.path(job).open("rb") as file:
                head = orjson.loads(next(file))
                count, state, last = -1, hashlib.sha256(), b""
                for line in file:  # one behind, so that the tail is not taken for a row
                    state.update(last)
                    count, last = count + 1, line
        except (FileNotFoundError, StopIteration, orjson.JSONDecodeError):
            return False
        return head == self._head(job) and last == _tail(count, state.hexdigest())

    def write(self, job: Job, rows: Iterable[Row]) -> None:
        """Write a job's rows as they come, and let them count when all are there.

        Raises:
            RowError: a row has a column that the table has not.
        """
        path = self.path(job)
        partial = path.with_suffix(f".{os.getpid()}.partial")
        try:
            with partial.open("wb") as file:
                file.write(orjson.dumps(self._head(job)) + b"\n")
                count, state = 0, hashlib.sha256()
                for row in rows:
                    if not self.columns.keys() >= row.keys():
                        names = ", ".join(sorted(row.keys() - self.columns.keys()))
                        raise RowError(f"a row has the columns `{names}`: valid are those that the protocol declares")
                    line = orjson.dumps(row) + b"\n"
                    file.write(line)
                    state.update(line)
                    count += 1
                file.write(_tail(count, state.hexdigest()))
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)

    def read(self, job: Job) -> Iterator[Row]:
        """Yield a job's rows."""
        with self.path(job).open("rb") as file:
            lines = iter(file)
            next(lines)
            before = next(lines)
            for line in lines:  # one behind, so that the tail is not taken for a row
                yield orjson.loads(before)
                before = line

    def _head(self, job: Job) -> dict[str, str | list[str | int]]:
        return {"configuration": self.configuration, "job": list(job)}


class Rows(Iterable["Row"]):
    """All rows of a campaign, in the order of its jobs; read anew from disk each time they are gone through."""

    def __init__(self, parts: Parts, jobs: Sequence[Job]) -> None:
        """Take the parts and the canonical order."""
        self._parts, self._jobs = parts, jobs

    def __iter__(self) -> Iterator[Row]:
        """Yield the rows."""
        for job in self._jobs:
            yield from self._parts.read(job)


def write_tables(rows: Iterable[Row], columns: Iterable[str], folder: Path) -> None:
    """Write `trials.csv`, and `timings.csv` of the rows that have any; each appears when it is whole."""
    stable = [name for name in columns if name not in TIMINGS]
    tables = {"trials.csv": stable, "timings.csv": [*KEYS, *TIMINGS]}
    with ExitStack() as stack:
        writers: list[tuple[list[str], csv.DictWriter[str]]] = []
        for name, fields in tables.items():
            file = stack.enter_context((folder / f"{name}.partial").open("w", encoding="utf-8", newline=""))
            writer = csv.DictWriter(file, fields, lineterminator="\n")
            writer.writeheader()
            writers.append((fields, writer))
        for row in rows:
            timed = any(row.get(name) is not None for name in TIMINGS)
            for fields, writer in writers[: 2 if timed else 1]:
                writer.writerow({name: _text(row.get(name)) for name in fields})
    for name in tables:
        (folder / f"{name}.partial").replace(folder / name)


def _text(value: Value) -> str:
    """Write a value as JSON does, texts bare: `true`, `0.25`, nothing for None."""
    match value:
        case None:
            return ""
        case bool():
            return "true" if value else "false"
        case int() | float() | str():
            return str(value)


def _tail(count: int, digest: str) -> bytes:
    return orjson.dumps({"rows": count, "sha256": digest}) + b"\n"
