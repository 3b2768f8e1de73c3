"""Reading a session's telemetry file back, thinned out evenly so that a long session still fits on a screen.

The file is compared with the digest its event holds; what does not agree is still shown, and said not to be what was
recorded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from time import sleep
from typing import TYPE_CHECKING, Any, Final, cast

import orjson
from mcap.exceptions import McapError
from mcap.reader import make_reader

from app.audit.archive import telemetry_problem
from app.audit.errors import RecordDamaged
from app.audit.telemetry import NANOSECONDS, channels

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from app.audit.event import Event

TOPIC: Final = "/telemetry"
PAUSE_EVERY: Final = 200  # rows: decoding shares the interpreter with whoever presses a stop meanwhile
PAUSE_S: Final = 0.001


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """Telemetry of one session as columns.

    Attributes:
        file: the file's name in the telemetry folder.
        sha256: what the log holds of it.
        intact: whether the file is the one that was recorded.
        start_s: wall time of the first row; the rest follow by their own `time_s`.
        rows: how many rows the file has; the columns hold every `every`-th of them and the last one.
        units: of each channel, an empty text where it has none.
        columns: values by channel; None where one was not known.
    """

    file: str
    sha256: str
    intact: bool
    start_s: float
    rows: int
    every: int
    units: dict[str, str]
    columns: dict[str, list[float | None]]


def telemetry_file(folder: Path, event: Event) -> Path | None:
    """Return the file a `telemetry` event vouches for; None where it names none or there is none any more."""
    name = event.payload().get("file")
    if not isinstance(name, str) or name in ("", ".", "..") or "/" in name or "\\" in name:
        return None
    path = folder / name
    return path if path.is_file() else None


def read_telemetry(folder: Path, event: Event, *, limit: int) -> Recording | None:
    """Return what a `telemetry` event vouches for, at most `limit` + 1 rows of it; blocks. None without a file.

    Raises:
        ValueError: a limit below 1.
        RecordDamaged: the file cannot be read as telemetry.
    """
    if limit < 1:
        raise ValueError(f"a limit of `{limit}` rows: valid is at least 1")
    path = telemetry_file(folder, event)
    if path is None:
        return None
    said = event.payload()
    problem = telemetry_problem(folder, event)
    try:
        rows = said.get("rows")
        taken = _Taken(limit, rows if isinstance(rows, int) else 0)
        for number, (at_ns, row) in enumerate(_rows(path)):
            taken.take(number, at_ns, row)
    except (McapError, OSError, ValueError, TypeError, EOFError) as error:
        raise RecordDamaged(path, f"cannot be read as telemetry: {error}") from error
    return Recording(
        file=path.name,
        sha256=str(said.get("sha256", "")),
        intact=problem is None,
        start_s=taken.start_ns / NANOSECONDS,
        rows=taken.count,
        every=taken.every,
        units={channel.name: channel.unit for channel in channels(tuple(taken.columns))},
        columns=taken.columns,
    )


class _Taken:
    """Every so-manieth row and the last one, as columns."""

    def __init__(self, limit: int, expected: int) -> None:
        self.every = max(1, math.ceil(expected / limit))
        self.start_ns = 0
        self.count = 0
        self.columns: dict[str, list[float | None]] = {}
        self._expected = expected

    def take(self, number: int, at_ns: int, row: dict[str, float | None]) -> None:
        if number == 0:
            self.start_ns = at_ns
            self.columns = {name: [] for name in row}
        self.count = number + 1
        if number % self.every and self.count != self._expected:
            return
        for name, values in self.columns.items():
            values.append(row.get(name))


def _rows(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    with path.open("rb") as file:
        for number, (_, _, message) in enumerate(make_reader(file).iter_messages(topics=[TOPIC])):
            if number % PAUSE_EVERY == 0:
                sleep(PAUSE_S)
            yield message.log_time, cast("dict[str, Any]", orjson.loads(message.data))
