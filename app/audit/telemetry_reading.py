"""Reading a session's telemetry file back, thinned out evenly so that a long session still fits on a screen.

The file is compared with the digest its event holds; what does not agree is still shown, and said not to be what was
recorded. It is read twice, first for how much it holds: so no more of it is held than what is kept.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from time import sleep
from typing import TYPE_CHECKING, Final, NamedTuple

import orjson
from mcap.reader import make_reader

from app.audit.archive import telemetry_problem
from app.audit.errors import RecordDamaged
from app.audit.telemetry import channels
from app.audit.telemetry_messages import NANOSECONDS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from app.audit.event import Event

TOPIC: Final = "/telemetry"
SCENE: Final = "/scene"
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
        extent = _extent(path)
        taken = _taken(path, extent, limit)
    except Exception as error:  # of bytes that anybody may have put there, parsers that are not ours raise anything
        problem = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise RecordDamaged(path, f"cannot be read as telemetry: {problem}") from error
    return Recording(
        file=path.name,
        sha256=str(said.get("sha256", "")),
        intact=problem is None,
        start_s=taken.start_ns / NANOSECONDS,
        rows=extent.rows,
        every=taken.every,
        units={channel.name: channel.unit for channel in channels(tuple(taken.columns))},
        columns=taken.columns,
        people=taken.people,
        bodies=taken.bodies,
    )


class _Extent(NamedTuple):
    """How much a file holds: rows, sightings, and poses by name of the thing."""

    rows: int
    sightings: int
    poses: Mapping[str, int]


class _Thinning:
    """Says which of so many things to keep, one after the other, so that what is left out is never held."""

    def __init__(self, total: int, limit: int) -> None:
        self.every = max(1, math.ceil(total / limit))
        self._total = total
        self.count = 0

    def keeps(self) -> bool:
        """Say whether the next one is kept."""
        self.count += 1
        return (self.count - 1) % self.every == 0 or self.count == self._total


class _Taken:
    """What is kept of a file: of each kind every so-manieth and the last one, at most so many and one."""

    def __init__(self, extent: _Extent, limit: int) -> None:
        self.start_ns = 0
        self.columns: dict[str, list[float | None]] = {}
        self.people = People([], [])
        self.bodies = {name: Way([], []) for name in extent.poses}
        self._rows = _Thinning(extent.rows, limit)
        self._sightings = _Thinning(extent.sightings, limit)
        self._poses = {name: _Thinning(total, limit) for name, total in extent.poses.items()}
        self.every = self._rows.every

    def row(self, at_ns: int, data: bytes) -> None:
        first = self._rows.count == 0
        if not self._rows.keeps():
            return
        row = orjson.loads(data)
        if first:
            self.start_ns, self.columns = at_ns, {name: [] for name in row}
        for name, values in self.columns.items():
            value = row.get(name)
            values.append(None if value is None else number(value))

    def sighting(self, data: bytes) -> None:
        moment = orjson.loads(data)
        time_s = number(moment["time_s"])
        if self._sightings.keeps():
            seen = [(int(one["id"]), number(one["x_m"]), number(one["y_m"])) for one in moment["people"]]
            self.people.time_s.append(time_s)
            self.people.tracks.append(seen)
        for name, pose in moment["bodies"].items():
            if self._poses[name].keeps():
                self.bodies[name].time_s.append(time_s)
                self.bodies[name].pose.append([number(part) for part in pose])


def _extent(path: Path) -> _Extent:
    rows = sightings = 0
    poses: Counter[str] = Counter()
    for topic, _, data in _messages(path):
        if topic == TOPIC:
            rows += 1
        else:
            sightings += 1
            poses.update(dict.fromkeys(orjson.loads(data)["bodies"], 1))
    return _Extent(rows, sightings, poses)


def _taken(path: Path, extent: _Extent, limit: int) -> _Taken:
    taken = _Taken(extent, limit)
    for topic, at_ns, data in _messages(path):
        if topic == TOPIC:
            taken.row(at_ns, data)
        else:
            taken.sighting(data)
    return taken


def number(value: object) -> float:
    """Return a number as it stands.

    Raises:
        TypeError: it is none.
    """
    if type(value) is float or type(value) is int:
        return value
    raise TypeError(f"`{str(value)[:40]}` is no number")


def _messages(path: Path) -> Iterator[tuple[str, int, bytes]]:
    with path.open("rb") as file:
        found = make_reader(file).iter_messages(topics=[TOPIC, SCENE])
        for place, (_, channel, message) in enumerate(found):
            if place % PAUSE_EVERY == 0:
                sleep(PAUSE_S)
            yield channel.topic, message.log_time, message.data
