"""Reading a session's telemetry file back, thinned out evenly so that a long session still fits on a screen.

The file is compared with the digest its event holds; what does not agree is still shown, and said not to be what was
recorded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from time import sleep
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

import orjson
from mcap.reader import make_reader

from app.audit.archive import telemetry_problem
from app.audit.errors import RecordDamaged
from app.audit.telemetry import channels
from app.audit.telemetry_messages import NANOSECONDS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from app.audit.event import Event

TOPIC: Final = "/telemetry"
SCENE: Final = "/scene"
PAUSE_EVERY: Final = 200  # rows: decoding shares the interpreter with whoever presses a stop meanwhile
PAUSE_S: Final = 0.001
T = TypeVar("T")


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
        people: where the tracker saw people, at most so many moments as rows; no moments, where none were recorded.
        bodies: where things were, by name, from each of their `time_s` on.
    """

    file: str
    sha256: str
    intact: bool
    start_s: float
    rows: int
    every: int
    units: dict[str, str]
    columns: dict[str, list[float | None]]
    people: People
    bodies: dict[str, Way]


@dataclass(frozen=True, slots=True)
class People:
    """Who was seen at each `time_s` (the rows' clock): `tracks` are (number, x, y), metres in the world frame."""

    time_s: list[float]
    tracks: list[list[tuple[int, float, float]]]


@dataclass(frozen=True, slots=True)
class Way:
    """A thing's poses, each from its `time_s` (the rows' clock) until the next.

    A pose is x, y, z, qw, qx, qy, qz in the world frame.
    """

    time_s: list[float]
    pose: list[list[float]]


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
        for place, (at_ns, row) in enumerate(_messages(path, TOPIC)):
            taken.take(place, at_ns, row)
        seen = [moment for _, moment in _messages(path, SCENE)]
        people, bodies = _people(seen, limit), _ways(seen, limit)
    except Exception as error:  # of bytes that anybody may have put there, parsers that are not ours raise anything
        problem = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise RecordDamaged(path, f"cannot be read as telemetry: {problem}") from error
    return Recording(
        file=path.name,
        sha256=str(said.get("sha256", "")),
        intact=problem is None,
        start_s=taken.start_ns / NANOSECONDS,
        rows=taken.count,
        every=taken.every,
        units={channel.name: channel.unit for channel in channels(tuple(taken.columns))},
        columns=taken.columns,
        people=people,
        bodies=bodies,
    )


def _people(seen: Sequence[Mapping[str, Any]], limit: int) -> People:
    kept = _thinned(seen, limit)
    tracks = [[(int(one["id"]), number(one["x_m"]), number(one["y_m"])) for one in moment["people"]] for moment in kept]
    return People([number(moment["time_s"]) for moment in kept], tracks)


def _ways(seen: Sequence[Mapping[str, Any]], limit: int) -> dict[str, Way]:
    moves: dict[str, list[tuple[float, list[float]]]] = {}
    for moment in seen:
        for name, pose in moment["bodies"].items():
            moves.setdefault(name, []).append((moment["time_s"], pose))
    kept = {name: _thinned(found, limit) for name, found in moves.items()}
    return {
        name: Way([number(at) for at, _ in found], [[number(part) for part in pose] for _, pose in found])
        for name, found in kept.items()
    }


def _thinned(items: Sequence[T], limit: int) -> list[T]:
    """Return every so-manieth item and the last one, at most `limit` + 1."""
    every = max(1, math.ceil(len(items) / limit))
    return [item for place, item in enumerate(items) if place % every == 0 or place == len(items) - 1]


class _Taken:
    """Every so-manieth row and the last one, as columns."""

    def __init__(self, limit: int, expected: int) -> None:
        self.every = max(1, math.ceil(expected / limit))
        self.start_ns = 0
        self.count = 0
        self.columns: dict[str, list[float | None]] = {}
        self._expected = expected

    def take(self, place: int, at_ns: int, row: dict[str, float | None]) -> None:
        if place == 0:
            self.start_ns = at_ns
            self.columns = {name: [] for name in row}
        self.count = place + 1
        if place % self.every and self.count != self._expected:
            return
        for name, values in self.columns.items():
            value = row.get(name)
            values.append(None if value is None else number(value))


def number(value: object) -> float:
    """Return a number as it stands.

    Raises:
        TypeError: it is none.
    """
    if type(value) is float or type(value) is int:
        return value
    raise TypeError(f"`{str(value)[:40]}` is no number")


def _messages(path: Path, topic: str) -> Iterator[tuple[int, dict[str, Any]]]:
    with path.open("rb") as file:
        for place, (_, _, message) in enumerate(make_reader(file).iter_messages(topics=[topic])):
            if place % PAUSE_EVERY == 0:
                sleep(PAUSE_S)
            yield message.log_time, cast("dict[str, Any]", orjson.loads(message.data))
