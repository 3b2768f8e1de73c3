"""Telemetry of one session as an MCAP file that Foxglove opens and plots: JSON messages with their JSON Schemas.

    /telemetry   one message a row, a number for every channel; which ticks have a row is the profile's matter
    /events      what the watcher said and what was done about it, as `foxglove.Log`
    /base        the robot's base in the world at every fifth row, as `foxglove.PoseInFrame`, where channels make it up
    /tcp         the tool in the frame of the base, in the same way
    /tf          where the base's frame is in the world, as `foxglove.FrameTransform`, so that both can be shown in one
    /scene       where people (as the tracker saw them) and things were, in the world frame; a thing stands in the first
                 message and in those before which it has moved

Rows arrive packed in batches and are written by a thread of the file's own, so that the event loop never waits for
compression or the disk. What is left of a disk that runs out is the record's: rows are dropped, and counted. A channel
that was not finite at a tick is null there, a pose that was not is left out, and a time that is none counts as that of
the row before. The file appears under its name only when it is complete; its SHA-256
becomes an event, and the log vouches for it.
"""

from __future__ import annotations

import asyncio
import hashlib
import os
import queue
import struct
import threading
from dataclasses import asdict, dataclass
from math import isfinite
from typing import TYPE_CHECKING, Any, BinaryIO, Final, Literal, NamedTuple

import orjson
from mcap.writer import CompressionType, Writer

from app.audit.errors import RecordUnavailable
from app.audit.telemetry_messages import (
    BASE,
    LOG_SCHEMA,
    NANOSECONDS,
    POSE_SCHEMA,
    SCENE_SCHEMA,
    TRANSFORM_SCHEMA,
    WORLD,
    pose_of,
    stamp,
    transform_message,
)
from app.disk import scarce, sync_folder

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

Level = Literal["info", "warning", "error"]
Values = tuple[float, ...]

CHUNK_BYTES: Final = 64 * 1024  # a larger chunk stalls whoever shares the interpreter while it is compressed
MAX_WAITING: Final = 4096
MAX_WAITING_ROWS: Final = 100_000  # about 0.1 GB, however many of them come at once
LATEST_S: Final = 1e10  # on a cell's clock; what is later fits no file
LONGEST_S: Final = 1e8  # from the first row
POSE_EVERY: Final = 5  # rows; poses are for looking at, every row stands in /telemetry
LEVELS: Mapping[Level, int] = {"info": 2, "warning": 3, "error": 4}  # as foxglove.Log counts them

# The end of a channel's name tells its unit; the longest that fits counts.
UNITS: Mapping[str, str] = {
    "_s": "s",
    "_ms": "ms",
    "_m": "m",
    "_mps": "m/s",
    "_mps2": "m/s²",
    "_rad": "rad",
    "_radps": "rad/s",
    "_n": "N",
    "_nm": "N·m",
    "_kg": "kg",
}


class Channel(NamedTuple):
    """One telemetry channel; the first of a row is its time in seconds."""

    name: str
    unit: str


class PosePlan(NamedTuple):
    """Which channels make a pose; an axis without a channel is 0."""

    topic: str
    frame: str
    x: str
    y: str
    z: str | None = None
    yaw: str | None = None


POSES: Final = (
    PosePlan("/base", WORLD, "base_x_m", "base_y_m", yaw="base_yaw_rad"),
    PosePlan("/tcp", BASE, "tcp_x_m", "tcp_y_m", "tcp_z_m"),  # the arm's own kinematics: it knows no world
)


@dataclass(frozen=True, slots=True, kw_only=True)
class TelemetryFile:
    """A complete file: its name in the telemetry folder, its SHA-256 in hexadecimal, and what it holds."""

    file: str
    sha256: str
    bytes: int
    rows: int
    events: int
    dropped: int

    def body(self) -> dict[str, str | int]:
        """Return it as the body of a `telemetry` event."""
        return asdict(self)


def channels(names: Sequence[str]) -> tuple[Channel, ...]:
    """Return channels for names that end in their units."""
    return tuple(Channel(name, unit_of(name)) for name in names)


def unit_of(name: str) -> str:
    """Return the unit a channel's name ends in; 1 for a ratio."""
    endings = [ending for ending in UNITS if name.endswith(ending)]
    return UNITS[max(endings, key=len)] if endings else "1"


class TelemetryWriter:
    """Writes one session's telemetry in a thread of its own; its methods are for one thread, as the event loop's."""

    def __init__(
        self, path: Path, channels: Sequence[Channel], *, start_wall_s: float, row_format: str | None = None
    ) -> None:
        """Begin; the thread opens the file, which a disk may take its time for as well.

        Args:
            path: where the complete file will stand.
            channels: the values of a row, time first.
            start_wall_s: wall time of the first row; the rest follow by their own time.
            row_format: the `struct` format of a packed row; float64 for the time and float32 for the rest by default.

        Raises:
            ValueError: no channels, a name twice, or a format that packs another number of values.
        """
        self.path = path
        self._row = struct.Struct(row_format or f"<d{len(channels) - 1}f")
        names = [channel.name for channel in channels]
        if len(set(names)) != len(names) or len(self._row.unpack(bytes(self._row.size))) != len(names):
            raise ValueError(f"`{self._row.format}` does not pack one value for each of the channels {names}")
        self._draft = path.with_name(path.name + ".partial")
        self._waiting: queue.Queue[tuple[Callable[[_Tape], None], int, int] | None] = queue.Queue(MAX_WAITING)
        self._dropped, self._homeless = 0, 0  # as too much waited, and as the disk had no room for it
        self._taken, self._written = 0, 0  # rows, and what holds as much: each is counted in one thread alone
        self._error: Exception | None = None
        self._counts = (0, 0)
        arguments = (tuple(channels), start_wall_s)
        self._thread = threading.Thread(target=self._work, args=arguments, name=f"telemetry-{path.stem}", daemon=True)
        self._thread.start()

    def write(self, packed: bytes) -> None:
        """Take a batch of packed rows.

        Raises:
            ValueError: not a whole number of rows.
        """
        if len(packed) % self._row.size:
            raise ValueError(f"`{len(packed)}` bytes are no whole number of rows of `{self._row.size}` bytes")
        self._put(lambda tape: tape.rows(self._row.iter_unpack(packed)), len(packed) // self._row.size)

    def write_rows(self, rows: Sequence[Values]) -> None:
        """Take a batch of rows that are unpacked already.

        Raises:
            ValueError: a row has another number of values than there are channels.
        """
        width = len(self._row.unpack(bytes(self._row.size)))
        if any(len(row) != width for row in rows):
            raise ValueError(f"a row has `{width}` values, one for each channel")
        self._put(lambda tape: tape.rows(rows), len(rows))

    def event(
        self,
        name: str,
        message: str,
        *,
        time_s: float | None = None,
        level: Level = "info",
        detail: Mapping[str, Any] | None = None,
    ) -> None:
        """Note a signal or an intervention; without a time of its own it stands at the last row's."""
        body = dict(detail or {})
        self._put(lambda tape: tape.event(name, message, time_s, level, body), 1)

    def sighting(
        self, time_s: float, people: Sequence[tuple[int, float, float]], bodies: Mapping[str, Sequence[float]]
    ) -> None:
        """Note where people and things were, in the world frame.

        Args:
            time_s: on the rows' clock.
            people: (number, x, y) as the tracker said, metres.
            bodies: poses x, y, z, qw, qx, qy, qz of those that have moved.
        """
        self._put(lambda tape: tape.sighting(time_s, people, bodies), 1, holds=1 + len(people) + len(bodies))

    def close(self) -> TelemetryFile:
        """Write what is left, complete the file, and return its digest. Blocks; see `aclose`.

        Raises:
            RecordUnavailable: the file could not be made or written; what there is of it keeps the name `….partial`.
        """
        self._waiting.put(None)
        self._thread.join()
        if self._error is not None:
            raise _unwritten(self._error) from self._error
        try:
            with self._draft.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
                size = os.fstat(file.fileno()).st_size
            self._draft.replace(self.path)
            sync_folder(self.path.parent)
        except OSError as error:
            raise _unwritten(error) from error
        rows, events = self._counts
        return TelemetryFile(
            file=self.path.name,
            sha256=digest,
            bytes=size,
            rows=rows,
            events=events,
            dropped=self._dropped + self._homeless,
        )

    async def aclose(self) -> TelemetryFile:
        """Do what `close` does without blocking the event loop."""
        return await asyncio.to_thread(self.close)

    def _put(self, work: Callable[[_Tape], None], count: int, *, holds: int | None = None) -> None:
        """Have so many things written, which hold as much as so many rows; as many as they are unless said."""
        held = count if holds is None else holds
        if self._waiting.full() or self._taken - self._written + held > MAX_WAITING_ROWS:
            self._dropped += count  # the session goes first; the loss is counted and stands in the record
            return
        self._waiting.put_nowait((work, count, held))  # nobody else puts
        self._taken += held

    def _work(self, channels: tuple[Channel, ...], start_wall_s: float) -> None:
        closed = False
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self._draft.open("wb") as file:
                tape = _Tape(file, channels, start_wall_s)
                while (given := self._waiting.get()) is not None:
                    work, count, held = given
                    if scarce(file.fileno()):
                        self._homeless += count
                    else:
                        work(tape)
                    self._written += held
                closed = True
                tape.finish()
                file.flush()
                os.fsync(file.fileno())
                self._counts = (tape.row_count, tape.event_count)
        except Exception as error:  # kept for `close`, which raises it
            self._error = error
            while not closed:
                closed = self._waiting.get() is None


def _unwritten(error: Exception) -> RecordUnavailable:
    """Say why there is no file; where the server keeps its files concerns nobody who reads the record."""
    return RecordUnavailable(f"telemetry file: {getattr(error, 'strerror', None) or error}")


class _Tape:
    """The MCAP file as the writing thread sees it."""

    def __init__(self, file: BinaryIO, channels: tuple[Channel, ...], start_wall_s: float) -> None:
        self._names = tuple(channel.name for channel in channels)
        self._start_ns = round(start_wall_s * 1_000_000) * 1000  # wall times are good to the microsecond
        self._zero_s: float | None = None
        self._last_s: float | None = None
        self.row_count = 0
        self.event_count = 0
        self.sighting_count = 0
        self._mcap = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._mcap.start(profile="", library="reins")
        self._telemetry = self._topic("/telemetry", "reins.Telemetry", telemetry_schema(channels))
        self._log = self._topic("/events", "foxglove.Log", LOG_SCHEMA)
        self._scene = self._topic("/scene", "reins.Scene", SCENE_SCHEMA)
        self._poses = [
            (self._topic(plan.topic, "foxglove.PoseInFrame", POSE_SCHEMA), plan.frame, self._columns(plan))
            for plan in POSES
            if {plan.x, plan.y} <= set(self._names)
        ]
        self._transform = self._topic("/tf", "foxglove.FrameTransform", TRANSFORM_SCHEMA)

    def rows(self, rows: Any) -> None:  # noqa: ANN401  # any iterable of tuples of floats, as struct types it
        for row in rows:
            self._last_s = self._good(row[0])
            at = self._at(self._last_s)
            self._add(self._telemetry, at, self.row_count, dict(zip(self._names, row, strict=True)))
            for topic, frame, columns in self._poses if self.row_count % POSE_EVERY == 0 else ():
                pose = pose_of(row, columns)
                if pose is None:
                    continue
                self._add(topic, at, self.row_count, {"timestamp": stamp(at), "frame_id": frame, "pose": pose})
                if frame == WORLD:
                    self._add(self._transform, at, self.row_count, transform_message(at, pose))
            self.row_count += 1

    def sighting(
        self, time_s: float, people: Sequence[tuple[int, float, float]], bodies: Mapping[str, Sequence[float]]
    ) -> None:
        known_s = self._good(time_s)
        at = self._at(known_s)
        seen = [{"id": number, "x_m": x, "y_m": y} for number, x, y in people if isfinite(x) and isfinite(y)]
        moved = {name: pose for name, pose in bodies.items() if all(map(isfinite, pose))}
        moment = {"timestamp": stamp(at), "frame_id": WORLD, "time_s": known_s or 0.0}
        self._add(self._scene, at, self.sighting_count, {**moment, "people": seen, "bodies": moved})
        self.sighting_count += 1

    def event(self, name: str, message: str, time_s: float | None, level: Level, detail: Mapping[str, Any]) -> None:
        at = self._at(self._last_s if time_s is None else self._good(time_s))
        record = {"timestamp": stamp(at), "level": LEVELS[level], "message": message, "name": name}
        self._add(self._log, at, self.event_count, {**record, "file": "", "line": 0, "detail": detail})
        self.event_count += 1

    def finish(self) -> None:
        self._mcap.finish()

    def _topic(self, topic: str, name: str, schema: Mapping[str, Any]) -> int:
        schema_id = self._mcap.register_schema(name, "jsonschema", orjson.dumps(schema))
        return self._mcap.register_channel(topic, "json", schema_id)

    def _columns(self, plan: PosePlan) -> tuple[int | None, ...]:
        wanted = (plan.x, plan.y, plan.z, plan.yaw)
        return tuple(self._names.index(name) if name in self._names else None for name in wanted)

    def _good(self, time_s: float) -> float | None:
        """Return a time as it is; the last row's, if any, for one that is none or beyond any session."""
        zero_s = time_s if self._zero_s is None else self._zero_s
        good = abs(time_s) <= LATEST_S and abs(time_s - zero_s) <= LONGEST_S  # not so, where it is not finite
        return time_s if good else self._last_s

    def _at(self, time_s: float | None) -> int:
        if time_s is None:
            return self._start_ns
        if self._zero_s is None:
            self._zero_s = time_s
        return max(0, self._start_ns + round((time_s - self._zero_s) * NANOSECONDS))

    def _add(self, topic: int, at: int, number: int, message: Mapping[str, Any]) -> None:
        data = orjson.dumps(message, default=str)
        self._mcap.add_message(topic, log_time=at, data=data, publish_time=at, sequence=number & 0xFFFFFFFF)


def telemetry_schema(channels: Sequence[Channel]) -> dict[str, Any]:
    """Return the JSON Schema of a `/telemetry` message."""
    properties = {channel.name: {"type": "number", "description": channel.unit} for channel in channels}
    return {"title": "reins.Telemetry", "type": "object", "properties": properties}
