"""Telemetry files, read back with MCAP's own reader."""

from __future__ import annotations

import hashlib
import json
import os
import struct
import threading
import tracemalloc
from math import inf, nan, pi
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from app.audit.errors import RecordUnavailable
from app.audit.event import Event, EventDraft, prepare
from app.audit.telemetry import Channel, TelemetryFile, TelemetryWriter, channels
from app.audit.telemetry_reading import read_telemetry
from tests.audit.conftest import TIME
from tests.conftest import until

NAMES = ("time_s", "base_x_m", "base_y_m", "base_yaw_rad", "tcp_x_m", "tcp_y_m", "tcp_z_m", "grip_force_n", "progress")
ROW = struct.Struct("<d8f")
START_S = 1_700_000_000.25


def pack(count: int, start: int = 0) -> bytes:
    """Rows of a robot that drives along x and turns."""
    rows = [(5 + n / 100, n / 4, 0.5, pi / 2, 1.0, 2.0, 0.75, 40.0, n / 100) for n in range(start, start + count)]
    return b"".join(ROW.pack(*row) for row in rows)


def vouching(file: TelemetryFile) -> Event:
    return prepare(EventDraft(kind="telemetry", actor="server", body=file.body()), TIME).seal(1)


def open_writer(path: Path) -> TelemetryWriter:
    return TelemetryWriter(path, channels(NAMES), start_wall_s=START_S)


def read(path: Path) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    topics: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            topics.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
    return topics


def test_every_row_comes_back_with_its_time(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "a.mcap")
    for batch in range(10):
        writer.write(pack(20, batch * 20))
    summary = writer.close()
    assert (summary.rows, summary.events, summary.dropped) == (200, 0, 0)
    messages = read(tmp_path / "a.mcap")["/telemetry"]
    assert len(messages) == 200
    assert [message["base_x_m"] for _, message in messages] == [n / 4 for n in range(200)]
    assert tuple(messages[0][1]) == NAMES
    times = [time for time, _ in messages]
    assert times[0] == 1_700_000_000_250_000_000
    assert times[-1] - times[0] == pytest.approx(1.99e9, abs=1000)


def test_the_digest_is_that_of_the_file(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "a.mcap")
    writer.write(pack(20))
    summary = writer.close()
    data = (tmp_path / "a.mcap").read_bytes()
    assert (summary.sha256, summary.bytes, summary.file) == (hashlib.sha256(data).hexdigest(), len(data), "a.mcap")
    assert summary.body()["sha256"] == summary.sha256
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_foxglove_finds_schemas_for_every_topic(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "a.mcap")
    writer.write(pack(1))
    writer.close()
    with (tmp_path / "a.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    found = {
        channel.topic: (channel.message_encoding, summary.schemas[channel.schema_id])
        for channel in summary.channels.values()
    }
    assert {topic: (encoding, schema.name, schema.encoding) for topic, (encoding, schema) in found.items()} == {
        "/telemetry": ("json", "reins.Telemetry", "jsonschema"),
        "/events": ("json", "foxglove.Log", "jsonschema"),
        "/scene": ("json", "reins.Scene", "jsonschema"),
        "/tf": ("json", "foxglove.FrameTransform", "jsonschema"),
        "/base": ("json", "foxglove.PoseInFrame", "jsonschema"),
        "/tcp": ("json", "foxglove.PoseInFrame", "jsonschema"),
    }
    properties = json.loads(found["/telemetry"][1].data)["properties"]
    assert properties["grip_force_n"] == {"type": "number", "description": "N"}


def test_poses_name_the_frame_they_are_in(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "a.mcap")
    writer.write(pack(11))
    writer.close()
    topics = read(tmp_path / "a.mcap")
    assert len(topics["/base"]) == len(topics["/tcp"]) == 3
    time, base = topics["/base"][2]
    assert base["pose"]["position"] == {"x": 2.5, "y": 0.5, "z": 0.0}
    assert base["pose"]["orientation"] == pytest.approx({"x": 0, "y": 0, "z": 0.5**0.5, "w": 0.5**0.5}, abs=1e-6)
    assert base["timestamp"]["sec"] * 1_000_000_000 + base["timestamp"]["nsec"] == time
    tool = topics["/tcp"][0][1]
    assert tool["pose"]["position"] == {"x": 1.0, "y": 2.0, "z": 0.75}
    assert (base["frame_id"], tool["frame_id"]) == ("world", "base")
    led = topics["/tf"][2][1]
    assert (led["parent_frame_id"], led["child_frame_id"]) == ("world", "base")
    assert (led["translation"], led["rotation"]) == (base["pose"]["position"], base["pose"]["orientation"])


def test_people_and_things_stand_beside_the_rows_on_their_clock(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "a.mcap")
    writer.write(pack(20))
    writer.sighting(5.1, [(3, 1.5, 2.5)], {"mug_1": (1, 2, 3, 1, 0, 0, 0)})
    assert writer.close().rows == 20
    ((at, seen),) = read(tmp_path / "a.mcap")["/scene"]
    assert at - 1_700_000_000_250_000_000 == pytest.approx(0.1e9, abs=1000)
    assert (seen["time_s"], seen["frame_id"]) == (5.1, "world")
    assert seen["people"] == [{"id": 3, "x_m": 1.5, "y_m": 2.5}]
    assert seen["bodies"] == {"mug_1": [1, 2, 3, 1, 0, 0, 0]}


def test_without_pose_channels_there_are_no_pose_topics(tmp_path: Path) -> None:
    writer = TelemetryWriter(tmp_path / "a.mcap", [Channel("time_s", "s"), Channel("q1_rad", "rad")], start_wall_s=0)
    writer.write_rows([(0.0, 1.0), (0.01, 2.0)])
    writer.close()
    topics = read(tmp_path / "a.mcap")
    assert topics.keys() == {"/telemetry"}
    assert [message for _, message in topics["/telemetry"]] == [
        {"time_s": 0.0, "q1_rad": 1.0},
        {"time_s": 0.01, "q1_rad": 2.0},
    ]


def test_events_stand_at_their_tick(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "a.mcap")
    writer.event("launch", "launched")
    writer.write(pack(20))
    writer.event("separation", "pause", time_s=5.1, level="warning", detail={"value": 0.4})
    writer.event("outcome", "succeeded")
    assert writer.close().events == 3
    (first, launched), (second, paused), (third, _) = read(tmp_path / "a.mcap")["/events"]
    assert (launched["level"], launched["message"]) == (2, "launched")
    assert [first, second, third] == sorted([first, second, third])
    assert second == pytest.approx(first + 100_000_000, abs=1000)
    assert (launched["level"], paused["level"], paused["name"], paused["detail"]) == (
        2,
        3,
        "separation",
        {"value": 0.4},
    )


def test_what_is_not_finite_is_null(tmp_path: Path) -> None:
    writer = TelemetryWriter(tmp_path / "a.mcap", channels(("time_s", "a_m", "b_m")), start_wall_s=0)
    writer.write_rows([(0.0, nan, inf)])
    writer.close()
    assert read(tmp_path / "a.mcap")["/telemetry"][0][1] == {"time_s": 0.0, "a_m": None, "b_m": None}


@pytest.mark.parametrize("value", [nan, inf, -inf])
@pytest.mark.parametrize("axis", [1, 2, 3])
def test_a_pose_that_is_not_finite_is_left_out(tmp_path: Path, axis: int, value: float) -> None:
    rows = [(n / 100, *[1.0] * 8) for n in range(15)]
    rows[5] = (*rows[5][:axis], value, *rows[5][axis + 1 :])
    writer = open_writer(tmp_path / "a.mcap")
    writer.write_rows(rows)
    assert writer.close().rows == 15
    topics = read(tmp_path / "a.mcap")
    assert [len(topics[name]) for name in ("/telemetry", "/base", "/tf", "/tcp")] == [15, 2, 2, 3]
    assert topics["/telemetry"][5][1][NAMES[axis]] is None


@pytest.mark.parametrize("time_s", [nan, inf, -inf, 1e12, -1e12, 1e300, 6e8])
@pytest.mark.parametrize("place", [0, 2])
def test_a_time_that_is_none_counts_as_the_last_good_one(tmp_path: Path, time_s: float, place: int) -> None:
    times = [5.0, 5.1, 5.2, 5.3]
    times[place] = time_s
    writer = open_writer(tmp_path / "a.mcap")
    if place:
        writer.write_rows([(at, *[1.0] * 8) for at in times])
    else:
        writer.sighting(
            time_s, [(1, nan, 0), (2, 1, 2)], {"mug_1": (1, 2, 3, 1, 0, 0, nan), "cup": (1, 2, 3, 1, 0, 0, 0)}
        )
        writer.event("outcome", "succeeded", time_s=time_s)
        writer.write_rows([(at, *[1.0] * 8) for at in times[1:]])
    file = writer.close()
    whole = read_telemetry(tmp_path, vouching(file), limit=9)
    assert whole is not None
    assert (file.rows, whole.rows) == (len(times) - (place == 0),) * 2
    if place:
        first, second, bad, last = [at for at, _ in read(tmp_path / "a.mcap")["/telemetry"]]
        assert (bad, second - first, last - first) == (second, 100_000_000, 300_000_000)
    else:
        assert whole.people.tracks == [[(2, 1, 2)]]
        assert whole.bodies.keys() == {"cup"}


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("time_s", "s"),
        ("tcp_speed_mps", "m/s"),
        ("residual_nm", "N·m"),
        ("q1_rad", "rad"),
        ("lag_ms", "ms"),
        ("rate", "1"),
    ],
)
def test_a_name_tells_its_unit(name: str, unit: str) -> None:
    assert channels([name]) == (Channel(name, unit),)


def test_refuses_rows_that_do_not_fit(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "a.mcap")
    with pytest.raises(ValueError, match="rows of `40` bytes"):
        writer.write(pack(1)[:-1])
    with pytest.raises(ValueError, match="`9` values"):
        writer.write_rows([(0.0, 1.0)])
    assert writer.close().rows == 0


@pytest.mark.parametrize(
    ("names", "row_format"), [(("time_s", "time_s"), None), (("time_s", "a"), "<d"), (("a",), "<ff")]
)
def test_refuses_a_format_for_other_channels(tmp_path: Path, names: tuple[str, ...], row_format: str | None) -> None:
    with pytest.raises(ValueError, match="pack one value"):
        TelemetryWriter(tmp_path / "a.mcap", channels(names), start_wall_s=0, row_format=row_format)


def test_a_folder_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordUnavailable, match=r"telemetry file: File exists$"):  # and not where, on the server
        open_writer(tmp_path / "file" / "a.mcap").close()


def test_a_disk_that_takes_its_time_to_make_the_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.mcap.partial")  # whoever opens that waits until somebody reads
    made: list[TelemetryWriter] = []
    beginning = threading.Thread(target=lambda: made.append(open_writer(tmp_path / "a.mcap")), daemon=True)
    beginning.start()
    beginning.join(10.0)
    waited = beginning.is_alive()
    reader = os.open(tmp_path / "a.mcap.partial", os.O_RDONLY)
    beginning.join()
    os.close(reader)
    with pytest.raises(RecordUnavailable, match="telemetry"):
        made[0].close()
    assert not waited


@pytest.mark.parametrize("rows", [4000, 20], ids=["while it is written", "when it is finished"])
def test_a_full_disk_is_reported_at_the_end(tmp_path: Path, rows: int) -> None:
    draft = tmp_path / "a.mcap.partial"
    draft.symlink_to("/dev/full")
    writer = open_writer(tmp_path / "a.mcap")
    for start in range(0, rows, 20):
        writer.write(pack(20, start))
    with pytest.raises(RecordUnavailable, match=r"telemetry file: No space left on device$"):
        writer.close()
    assert not (tmp_path / "a.mcap").exists()


def test_what_is_left_of_a_disk_that_runs_out_is_left_to_the_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = os.statvfs(tmp_path)
    writer = open_writer(tmp_path / "a.mcap")
    for free, homeless in ((65_536, 0), (65_535, 20), (0, 40), (65_536, 40)):  # blocks; of 100 GB so many are kept
        now = os.statvfs_result((4096, 4096, 25_000_000, free, free, *disk[5:]))
        monkeypatch.setattr(os, "statvfs", lambda _, now=now: now)
        writer.write(pack(20))
        until(lambda: writer._written == writer._taken)
        assert writer._homeless == homeless
    summary = writer.close()
    assert (summary.rows, summary.dropped) == (40, 40)
    assert len(read(tmp_path / "a.mcap")["/telemetry"]) == 40


@pytest.mark.parametrize(("bound", "most"), [("MAX_WAITING", 3), ("MAX_WAITING_ROWS", 3000)])
def test_rows_beyond_what_may_wait_are_dropped_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bound: str, most: int
) -> None:
    monkeypatch.setattr(f"app.audit.telemetry.{bound}", most)
    os.mkfifo(tmp_path / "a.mcap.partial")
    reader = os.open(tmp_path / "a.mcap.partial", os.O_RDONLY | os.O_NONBLOCK)  # takes 64 kB, then stalls
    writer = open_writer(tmp_path / "a.mcap")
    for start in range(0, 40_000, 1000):
        writer.write(pack(1000, start))
    assert writer._dropped > 0
    assert writer._dropped % 1000 == 0
    os.close(reader)
    with pytest.raises(RecordUnavailable, match="telemetry"):
        writer.close()


def test_sightings_of_much_wait_as_the_rows_that_hold_as_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.audit.telemetry.MAX_WAITING_ROWS", 1000)
    os.mkfifo(tmp_path / "a.mcap.partial")  # which nobody reads yet
    writer = open_writer(tmp_path / "a.mcap")
    for _ in range(10):
        writer.sighting(0.0, [], {f"box_{number}": (0.0,) * 7 for number in range(256)})
    assert writer._dropped == 7
    os.close(os.open(tmp_path / "a.mcap.partial", os.O_RDONLY))
    with pytest.raises(RecordUnavailable, match="telemetry"):
        writer.close()


def test_of_a_long_session_no_more_is_held_than_is_shown(tmp_path: Path) -> None:
    held: list[int] = []
    for count in (200, 2000):
        writer = open_writer(tmp_path / f"{count}.mcap")
        for n in range(count):
            writer.sighting(5 + n / 10, [(1, n / 10, 2)], {"mug_1": (n, 2, 3, 1, 0, 0, 0)})
        event = vouching(writer.close())
        tracemalloc.start()
        found = read_telemetry(tmp_path, event, limit=10)
        held.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert found is not None
        assert len(found.people.time_s) == len(found.bodies["mug_1"].pose) == 11
        assert found.bodies["mug_1"].pose[-1][0] == count - 1
    assert held[1] < 2 * held[0]


@pytest.mark.anyio
async def test_closing_does_not_block_the_loop(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "a.mcap")
    writer.write(pack(20))
    assert (await writer.aclose()).rows == 20
