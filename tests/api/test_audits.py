from __future__ import annotations

import asyncio
import json
import math
import sqlite3
from collections import Counter
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
from mcap.writer import Writer

from app.api import audits
from app.audit import reader, searching
from app.audit.event import EventDraft
from app.audit.telemetry import TelemetryWriter, channels
from app.protocol import ROW, pack_batch
from tests.api.conftest import House, eventually, open_house
from tests.audit.conftest import without_descriptors

pytestmark = pytest.mark.anyio

UNKNOWN: dict[str, Any] = {"capability": "fly_to"}


async def refuse(house: House, times: int = 1) -> list[str]:
    async with house.client() as agent:
        return [(await agent.post("/v1/invocations", json=UNKNOWN)).json()["id"] for _ in range(times)]


async def events_of(answer: httpx.Response) -> AsyncIterator[dict[str, Any]]:
    """Yield what a stream of server-sent events says, comments as `{}`."""
    event: dict[str, Any] = {}
    async for line in answer.aiter_lines():
        name, _, value = line.partition(": ")
        if name == "id":
            event["id"] = int(value)
        elif name == "data":
            event["data"] = json.loads(value)
        elif line.startswith(":"):
            yield {}
        elif not line and event:
            yield event
            event = {}


@pytest.mark.parametrize("most", [1, 2_000])
@pytest.mark.parametrize("order", ["oldest", "newest"])
async def test_what_is_long_comes_in_more_pages_without_gap(
    house: House, monkeypatch: pytest.MonkeyPatch, most: int, order: str
) -> None:
    names = await refuse(house, 5)
    last = house.runtime.store.size
    monkeypatch.setattr(reader, "MAX_PAGE_BYTES", most)
    bound = "after" if order == "oldest" else "before"
    listed: list[str] = []
    seen: list[int] = []
    async with house.client("auditor") as auditor:
        page = (await auditor.get(f"/v1/audit/events?order={order}")).json()
        assert 1 <= len(page["items"]) < last
        while True:
            seen += [event["seq"] for event in page["items"]]
            if page["next"] is None:
                break
            page = (await auditor.get(f"/v1/audit/events?order={order}&{bound}={page['next']}")).json()
        page = (await auditor.get("/v1/invocations")).json()
        assert 1 <= len(page["items"]) < len(names)
        while True:
            listed += [one["id"] for one in page["items"]]
            if page["next"] is None:
                break
            page = (await auditor.get(f"/v1/invocations?cursor={page['next']}")).json()
        async with auditor.stream("GET", "/v1/events?after=0") as answer:
            told = events_of(answer)
            streamed = [(await anext(told))["id"] for _ in range(last)]
    everything = list(range(1, last + 1))
    assert seen == (everything if order == "oldest" else everything[::-1])
    assert (listed[: len(names)], len(set(listed))) == (names[::-1], len(listed))
    assert streamed == everything


async def test_pages_through_the_log_without_gap(house: House) -> None:
    await refuse(house, 3)
    async with house.client("auditor") as auditor:
        seen: list[int] = []
        page = (await auditor.get("/v1/audit/events?limit=4")).json()
        while page["items"]:
            seen += [event["seq"] for event in page["items"]]
            if page["next"] is None:
                break
            page = (await auditor.get(f"/v1/audit/events?limit=4&after={page['next']}")).json()
    assert seen == list(range(1, len(seen) + 1))


async def test_a_page_that_ends_where_the_log_does_is_the_last(house: House) -> None:
    (name,) = await refuse(house)
    async with house.client("auditor") as auditor:
        under = f"/v1/audit/events?invocation={name}"
        everything = (await auditor.get(under)).json()
        count, last = len(everything["items"]), everything["items"][-1]["seq"]
        exact = (await auditor.get(f"{under}&limit={count}")).json()
        short = (await auditor.get(f"{under}&limit={count - 1}")).json()
        rest = (await auditor.get(f"{under}&limit=1&after={short['next']}")).json()
        most = (await auditor.get(f"/v1/audit/events?limit={audits.MAX_EVENTS}&after={last - 1}")).json()
    assert count > 1
    assert exact == everything
    assert everything["next"] is None
    assert [event["seq"] for event in short["items"] + rest["items"]] == [e["seq"] for e in everything["items"]]
    assert rest["next"] is None
    assert most["next"] is None


async def test_pages_from_the_newest_event_on_and_what_is_recorded_meanwhile_moves_no_page(house: House) -> None:
    await refuse(house, 3)
    last = house.runtime.store.size
    seen: list[int] = []
    async with house.client("auditor") as auditor:
        page = (await auditor.get("/v1/audit/events?order=newest&limit=4")).json()
        await refuse(house)
        seen += [event["seq"] for event in page["items"]]
        while page["next"] is not None:
            assert page["next"] == seen[-1]
            page = (await auditor.get(f"/v1/audit/events?order=newest&limit=4&before={page['next']}")).json()
            seen += [event["seq"] for event in page["items"]]
        within = [f"/v1/audit/events?after=2&before=6&limit=3&order={order}" for order in ("oldest", "newest")]
        oldest, newest = [(await auditor.get(path)).json() for path in within]
    assert seen == list(range(last, 0, -1))
    assert [event["seq"] for event in oldest["items"]] == [3, 4, 5]
    assert newest == {"items": oldest["items"][::-1], "next": None}
    assert oldest["next"] is None


async def test_searches_the_log_for_words_in_pieces_from_either_end(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(searching, "MOST", 5)
    before = house.runtime.store.size
    names = await refuse(house, 4)
    last = house.runtime.store.size
    async with house.client("auditor") as auditor:

        async def all_of(order: str, cursor: str, begin: str) -> tuple[list[str], int]:
            found: list[str] = []
            looked = 0
            where = begin
            while True:
                words = f"/v1/audit/events?text=FLY_to%20Planner&order={order}&limit=3"
                page = (await auditor.get(f"{words}{where}")).json()
                found += [event["invocation"] for event in page["items"] if event["kind"] == "proposal"]
                looked += page["searched"]["events"]
                if page["next"] is None:
                    return found, looked
                where = f"{begin if order == 'newest' else ''}&{cursor}={page['next']}"

        assert await all_of("oldest", "after", f"&after={before}") == (names, last - before)
        assert await all_of("newest", "before", f"&after={before}") == (names[::-1], last - before)
        nothing = (await auditor.get("/v1/audit/events?text=nobody%20wrote&order=newest")).json()
        fifth, *_ = (await auditor.get(f"/v1/audit/events?after={last - 5}")).json()["items"]
    assert nothing == {
        "items": [], "next": last - 4, "searched": {"events": 5, "seq": last - 4, "at": fifth["at"]},
    }  # fmt: skip


async def test_filters_the_log(house: House) -> None:
    (name,) = await refuse(house)
    async with house.client("auditor") as auditor:
        mine = (await auditor.get(f"/v1/audit/events?invocation={name}&kind=proposal&actor=planner")).json()["items"]
        future = (await auditor.get("/v1/audit/events?since=2999-01-01T00:00:00Z")).json()["items"]
        past = (await auditor.get("/v1/audit/events?until=2001-01-01T00:00:00%2B01:00")).json()["items"]
        small = (await auditor.get(f"/v1/audit/events?invocation={name}&since=2001-01-01t00:00:00z")).json()["items"]
    assert [(event["invocation"], event["kind"]) for event in mine] == [(name, "proposal")]
    assert (future, past) == ([], [])
    assert {event["invocation"] for event in small} == {name}


@pytest.mark.parametrize(
    "query",
    [
        "since=yesterday",
        "until=2026-01-01T00:00:00",
        "until=9999-12-31T23:59:59-00:01",
        "after=-1",
        "after=9223372036854775808",
        "limit=1001",
        "after=1_0",
        "before=0",
        "before=x",
        "order=latest",
        "text=",
        "text=%20%09",
        f"text={'x' * 201}",
        "order=",
        "a=b",
    ],
)
async def test_refuses_a_filter_it_cannot_read(house: House, query: str) -> None:
    async with house.client("auditor") as auditor:
        answer = await auditor.get(f"/v1/audit/events?{query}")
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
    assert "Value error" not in answer.text


async def test_the_checkpoint_is_that_of_the_verified_log(house: House) -> None:
    await refuse(house)
    async with house.client("auditor") as auditor:
        verdict = (await auditor.get("/v1/audit/verify")).json()
        head = (await auditor.get("/v1/audit/checkpoint")).json()
    assert verdict["ok"]
    assert (head["size"], head["root"], head["checkpoint"]) == (verdict["size"], verdict["root"], verdict["checkpoint"])
    assert house.runtime.store.verifier.open(head["checkpoint"]).size == head["size"]


async def test_streams_events_as_they_are_recorded(house: House) -> None:
    async with house.client("operator") as operator, operator.stream("GET", "/v1/events") as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        (name,) = await refuse(house)
        async with asyncio.timeout(10):
            async for event in events_of(answer):
                if event:
                    assert event["data"]["invocation"] == name
                    assert event["id"] == event["data"]["seq"]
                    break


async def test_a_stream_resumes_behind_the_last_event_seen(house: House) -> None:
    await refuse(house, 4)
    last = house.runtime.store.size
    after = last - 7
    headers = {"Last-Event-ID": str(after)}
    seen: list[int] = []
    async with (
        house.client("auditor") as auditor,
        auditor.stream("GET", "/v1/events?after=0", headers=headers) as answer,
        asyncio.timeout(10),
    ):
        async for event in events_of(answer):
            seen += [event["id"]] if event else []
            if len(seen) == 7:
                break
    assert seen == list(range(after + 1, last + 1))


async def test_blanks_around_the_last_event_are_none_of_it(house: House) -> None:
    (name,) = await refuse(house)
    address = urlsplit(house.url)
    reader, writer = await asyncio.open_connection(address.hostname, address.port)
    bearer = f"Authorization: Bearer {house.tokens['auditor']}"
    last = house.runtime.store.size - 1
    writer.write(f"GET /v1/events HTTP/1.1\r\nHost: x\r\n{bearer}\r\nLast-Event-ID: \t {last} \t\r\n\r\n".encode())
    async with asyncio.timeout(10):
        assert (await reader.readline()).startswith(b"HTTP/1.1 200")
        await reader.readuntil(f"id: {last + 1}\n".encode())
        assert name in (await reader.readuntil(b"\n\n")).decode()
    writer.close()
    await writer.wait_closed()


@pytest.mark.parametrize("last", ["x", "-1", "1" * 19, "1.5", "", "1 1"])
async def test_refuses_a_last_event_that_is_none(house: House, last: str) -> None:
    async with house.client("auditor") as auditor:
        answer = await auditor.get("/v1/events", headers={"Last-Event-ID": last})
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")


async def test_two_last_events_are_none(house: House) -> None:
    async with house.client("auditor") as auditor:
        answer = await auditor.get("/v1/events", headers=[("Last-Event-ID", "0"), ("Last-Event-ID", "1")])
    assert (answer.status_code, answer.json()["code"]) == (400, "given_twice")
    assert "`Last-Event-ID`" in answer.json()["detail"]


@pytest.mark.parametrize(
    "where", ["Last-Event-ID", "/v1/events?after", "/v1/audit/events?after", "/v1/audit/events?before"]
)
async def test_refuses_a_place_that_this_log_has_not_reached(house: House, where: str) -> None:
    await refuse(house)
    size = house.runtime.store.size
    headers = {where: str(size + 1)} if where == "Last-Event-ID" else {}
    path = "/v1/events" if headers else f"{where}={size + 1}"
    async with house.client("auditor") as auditor:
        answer = await auditor.get(path, headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
    (fault,) = answer.json()["errors"]
    assert fault["field"] == where.rpartition("?")[2]
    assert f"`{size + 1}`" in fault["message"]
    assert f"`{size}` events" in fault["message"]


async def test_the_end_of_the_log_is_a_place_in_it(house: House) -> None:
    await refuse(house)
    async with house.client("auditor") as auditor:
        answer = await auditor.get(f"/v1/audit/events?after={house.runtime.store.size}")
        assert (answer.status_code, answer.json()["items"]) == (200, [])


async def test_a_quiet_stream_says_that_it_is_there(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audits, "HEARTBEAT_S", 0.05)
    async with (
        house.client("auditor") as auditor,
        auditor.stream("GET", "/v1/events") as answer,
        asyncio.timeout(10),
    ):
        async for event in events_of(answer):
            if not event:
                break
        else:
            pytest.fail("the stream ended without having said that it is there")


async def record(house: House, invocation: str, rows: int) -> Path:
    """Leave a telemetry file and the event that vouches for it, as a finished session does."""
    path = house.runtime.store.places.telemetry / f"{invocation}.mcap"
    writer = TelemetryWriter(path, channels(("time_s", "base_x_m", "separation_m")), start_wall_s=1_700_000_000.25)
    writer.write_rows([(5 + n / 100, n / 10, math.inf) for n in range(rows)])
    body = (await writer.aclose()).body()
    await house.runtime.store.append([EventDraft(kind="telemetry", actor="server", invocation=invocation, body=body)])
    return path


async def test_telemetry_comes_as_columns_thinned_out_evenly_to_the_last_row(house: House) -> None:
    await record(house, "inv_thin", 100)
    async with house.client("auditor") as auditor:
        found = (await auditor.get("/v1/audit/telemetry/inv_thin?rows=10")).json()
    assert (found["rows"], found["every"], found["parts"], found["intact"]) == (100, 10, 1, True)
    assert found["start_at"] == "2023-11-14T22:13:20.250Z"
    assert found["columns"]["base_x_m"] == [*range(10), pytest.approx(9.9)]
    assert found["columns"]["separation_m"] == [None] * 11
    assert found["units"] == {"time_s": "s", "base_x_m": "m", "separation_m": "m"}


async def test_telemetry_says_where_people_and_things_were(house: House) -> None:
    path = house.runtime.store.places.telemetry / "inv_seen.mcap"
    writer = TelemetryWriter(path, channels(("time_s", "q1_rad")), start_wall_s=0)
    writer.write_rows([(0.0, 1.0), (1.0, 1.0)])
    for number in range(11):
        moved = {"mug_1": (number, 0, 0, 1, 0, 0, 0)} if number in (0, 4) else {}
        writer.sighting(number / 10, [(1, number / 2, 2.0)] if number > 5 else [], moved)
    body = (await writer.aclose()).body()
    await house.runtime.store.append([EventDraft(kind="telemetry", actor="server", invocation="inv_seen", body=body)])
    async with house.client("auditor") as auditor:
        found = (await auditor.get("/v1/audit/telemetry/inv_seen?rows=5")).json()
    assert found["people"]["time_s"] == [0.0, 0.3, 0.6, 0.9, 1.0]
    assert found["people"]["tracks"] == [[], [], [[1, 3.0, 2.0]], [[1, 4.5, 2.0]], [[1, 5.0, 2.0]]]
    assert found["bodies"] == {"mug_1": {"time_s": [0.0, 0.4], "pose": [[0, 0, 0, 1, 0, 0, 0], [4, 0, 0, 1, 0, 0, 0]]}}


async def test_telemetry_says_when_its_file_is_not_the_one_recorded(house: House) -> None:
    path = await record(house, "inv_swapped", 20)
    other = await record(house, "inv_other", 30)
    other.replace(path)
    async with house.client("operator") as operator:
        found = (await operator.get("/v1/audit/telemetry/inv_swapped")).json()
        path.write_bytes(b"nothing of the kind")
        broken = await operator.get("/v1/audit/telemetry/inv_swapped")
    assert (found["rows"], found["intact"]) == (30, False)
    assert (broken.status_code, broken.json()["code"]) == (500, "telemetry_damaged")
    assert str(house.folder) not in broken.text


@pytest.mark.parametrize("topic", ["/telemetry", "/scene"])
@pytest.mark.parametrize("message", [b"[1]", b"7", b"{", b'{"bodies": [], "people": [1], "time_s": 0}', b'{"a": 1}'])
async def test_telemetry_of_another_make_is_called_damaged(house: House, topic: str, message: bytes) -> None:
    path = await record(house, "inv_foreign", 20)
    with path.open("wb") as file:
        foreign = Writer(file)
        foreign.start()
        said = foreign.register_channel(topic, "json", foreign.register_schema("any", "jsonschema", b"{}"))
        for _ in range(2):
            foreign.add_message(said, log_time=0, data=message, publish_time=0)
        foreign.finish()
    async with house.client("auditor") as auditor:
        answer = await auditor.get("/v1/audit/telemetry/inv_foreign")
    code = None if (topic, message) == ("/telemetry", b'{"a": 1}') else "telemetry_damaged"
    assert (answer.status_code, answer.json().get("code")) == (500 if code else 200, code)


@pytest.mark.parametrize("wiped", [1, 8, 200])
async def test_telemetry_with_bytes_wiped_out_anywhere_is_read_or_called_damaged(house: House, wiped: int) -> None:
    path = await record(house, "inv_wiped", 20)
    whole = path.read_bytes()
    codes: Counter[str | None] = Counter()
    async with house.client("auditor") as auditor:
        for start in range(0, len(whole), 41):
            path.write_bytes(whole[:start] + bytes(wiped) + whole[start + wiped :])
            answer = await auditor.get("/v1/audit/telemetry/inv_wiped?rows=5")
            assert answer.status_code == 200 or answer.json()["code"] == "telemetry_damaged", start
            codes[answer.json().get("code")] += 1
    assert codes["telemetry_damaged"] > 10, "a file is no longer damaged by what was wiped out"


async def test_telemetry_is_downloaded_byte_for_byte(house: House) -> None:
    path = await record(house, "inv_whole", 20)
    async with house.client("engineer") as engineer:
        answer = await engineer.get("/v1/audit/telemetry/inv_whole/mcap")
    assert answer.content == path.read_bytes()
    assert answer.headers["content-disposition"] == 'attachment; filename="inv_whole.mcap"'


@pytest.mark.parametrize(
    "range", ["bytes=0-9", "bytes=900000000-", "bytes=9-0", "bytes=0-1,5-6", "bytes=x", "rows=1-2"]
)
async def test_a_part_of_telemetry_is_answered_with_all_of_it(house: House, range: str) -> None:
    path = await record(house, "inv_part", 20)
    async with house.client("engineer") as engineer:
        answer = await engineer.get("/v1/audit/telemetry/inv_part/mcap", headers={"Range": range})
    assert (answer.status_code, answer.headers["accept-ranges"]) == (200, "none")
    assert answer.content == path.read_bytes()


@pytest.mark.parametrize(
    "path", ["inv_none", "inv_none/mcap", "inv_thin?part=900", "inv_lost", "inv_lost/mcap", "inv_out", "inv_out/mcap"]
)
async def test_says_where_there_is_no_telemetry(house: House, path: str) -> None:
    (await record(house, "inv_lost", 5)).unlink()
    outside = EventDraft(kind="telemetry", actor="server", invocation="inv_out", body={"file": "../log.key"})
    await house.runtime.store.append([outside])
    async with house.client("auditor") as auditor:
        answer = await auditor.get(f"/v1/audit/telemetry/{path}")
    assert (answer.status_code, answer.json()["code"]) == (404, "telemetry_unknown")


async def test_telemetry_of_a_session_that_has_just_ended_is_waited_for(house: House) -> None:
    drive = {"capability": "navigate_to", "params": {"x_m": 1.0, "y_m": 1.0, "yaw_rad": 0.0}}
    async with house.cell() as cell, house.client() as agent, house.client("auditor") as auditor:
        made = (await agent.post("/v1/invocations", json=drive)).json()
        await eventually(lambda: cell.invocation == made["id"])
        await cell.socket.send(pack_batch(made["id"], bytes(ROW.size) * 3))
        await cell.tell("outcome", outcome="succeeded")  # and what it measured last comes before its next state
        cell.invocation = None
        await eventually(lambda: house.runtime.register.newest(made["id"]) is None)
        found = await auditor.get(f"/v1/audit/telemetry/{made['id']}")
    assert (found.status_code, found.json().get("rows")) == (200, 3), found.text


async def test_where_telemetry_was_not_kept_it_says_why_as_the_record_does(house: House) -> None:
    failed = EventDraft(kind="telemetry", actor="server", invocation="inv_1", body={"failed": "no room on the disk"})
    await house.runtime.store.append([failed])
    async with house.client("auditor") as auditor:
        answers = [await auditor.get(f"/v1/audit/telemetry/inv_1{rest}") for rest in ("", "/mcap")]
    for answer in answers:
        assert (answer.status_code, answer.json()["code"]) == (404, "telemetry_unknown")
        assert "not kept: no room on the disk" in answer.json()["detail"]
        assert "nothing ran" not in answer.json()["detail"]
        assert "its part" not in answer.json()["detail"], "there is one alone"


async def test_where_one_part_of_telemetry_was_not_kept_it_says_that_there_are_others(house: House) -> None:
    failed = {"failed": "the server ended before it was complete"}
    await house.runtime.store.append([EventDraft(kind="telemetry", actor="server", invocation="inv_2", body=failed)])
    await record(house, "inv_2", 5)
    async with house.client("auditor") as auditor:
        answers = [await auditor.get(f"/v1/audit/telemetry/inv_2{rest}") for rest in ("", "/mcap")]
        there = await auditor.get("/v1/audit/telemetry/inv_2?part=2")
    for answer in answers:
        assert (answer.status_code, "(its part `1` of `2`)" in answer.json()["detail"]) == (404, True)
    assert there.json()["parts"] == 2


async def test_nothing_moves_on_a_log_that_was_found_damaged(tmp_path: Path) -> None:
    drive = {"capability": "navigate_to", "params": {"target": "dock"}}
    async with open_house(tmp_path / "data", "sim-relaxed") as house, house.cell() as cell:
        await refuse(house)
        with sqlite3.connect(house.runtime.store.places.database) as database:
            database.execute("DROP TRIGGER events_refuse_update")
            database.execute("UPDATE events SET kind = 'cell' WHERE seq = 1")
        async with house.client("auditor") as auditor, house.client() as agent:
            verdict = (await auditor.get("/v1/audit/verify")).json()
            health, ready = await agent.get("/healthz"), await agent.get("/readyz")
            refused, again = [await agent.post("/v1/invocations", json=drive) for _ in range(2)]
        assert (verdict["ok"], verdict["first_bad"]) == (False, 1)
        assert health.json()["broken"]["record"] == ready.json()["broken"]["record"] == verdict["problem"]
        assert (health.json()["status"], ready.status_code) == ("degraded", 503)
        assert (refused.status_code, refused.json()["code"]) == (503, "record_unavailable")
        assert (again.status_code, again.json()["code"]) == (503, "record_unavailable")  # no claim was left behind
        assert not cell.launches


@pytest.mark.parametrize("body", [b'{"cut":', b"\xff\x00", b"[]"])
async def test_whoever_meets_a_damaged_event_is_told_and_nothing_moves_from_then_on(
    tmp_path: Path, body: bytes
) -> None:
    drive = {"capability": "navigate_to", "params": {"target": "dock"}}
    async with open_house(tmp_path / "data", "sim-relaxed") as house, house.cell() as cell:
        [refused] = await refuse(house)
        with sqlite3.connect(house.runtime.store.places.database) as database:
            database.execute("DROP TRIGGER events_refuse_update")
            (seq,) = database.execute("SELECT max(seq) FROM events WHERE invocation = ?", (refused,)).fetchone()
            database.execute("UPDATE events SET body = ? WHERE seq = ?", (body, seq))
        async with house.client("auditor") as auditor, house.client() as agent:
            listed = await auditor.get("/v1/audit/events")
            trace = await agent.get(f"/v1/invocations/{refused}/trace")
            health = await agent.get("/healthz")
            launch = await agent.post("/v1/invocations", json=drive)
        for answer in (listed, trace):
            assert (answer.status_code, answer.json()["code"]) == (500, "record_damaged")
        assert f"event `{seq}` cannot be read" in health.json()["broken"]["record"]
        assert (launch.status_code, launch.json()["code"]) == (503, "record_unavailable")
        assert not cell.launches


async def test_a_stream_says_what_is_readable_and_then_why_it_goes_no_further(tmp_path: Path) -> None:
    async with open_house(tmp_path / "data", "sim-relaxed") as house:
        await refuse(house, 3)
        damaged = house.runtime.store.size - 2
        with sqlite3.connect(house.runtime.store.places.database) as database:
            database.execute("DROP TRIGGER events_refuse_update")
            database.execute("UPDATE events SET body = x'ff' WHERE seq = ?", (damaged,))
        async with (
            house.client("auditor") as auditor,
            auditor.stream("GET", "/v1/events?after=0") as answer,
            asyncio.timeout(10),
        ):
            *events, last = [event async for event in events_of(answer)]
        assert [event["id"] for event in events] == list(range(1, damaged))
        assert (last.keys(), last["data"]["code"]) == ({"data"}, "record_damaged")


async def test_a_log_that_cannot_be_read_now_is_not_called_damaged_and_lets_move(tmp_path: Path) -> None:
    drive = {"capability": "navigate_to", "params": {"target": "dock"}}
    async with (
        open_house(tmp_path / "data", "sim-relaxed") as house,
        house.cell(),
        house.client("auditor") as auditor,
        house.client() as agent,
    ):
        await agent.get("/healthz")
        assert (await auditor.get("/v1/audit/verify")).json()["ok"]
        with without_descriptors():
            refused = await auditor.get("/v1/audit/verify")
        health = await agent.get("/healthz")
        launched = await agent.post("/v1/invocations", json=drive)
        again = await auditor.get("/v1/audit/verify")
    assert (refused.status_code, refused.json()["code"]) == (503, "record_unavailable")
    assert refused.headers["Retry-After"] == "5"
    assert "`reins.db`: unable to open database file" in refused.json()["detail"]
    assert str(tmp_path) not in refused.text
    assert "record" not in health.json()["broken"]
    assert launched.status_code == 201
    assert again.json()["ok"]


async def test_a_damaged_row_is_refused_by_name_and_stands_in_healthz(tmp_path: Path) -> None:
    async with open_house(tmp_path / "data", "sim-relaxed") as house, house.client() as agent:
        damaged, sound = await refuse(house, 2)
        with sqlite3.connect(house.runtime.store.places.database) as database:
            database.execute("UPDATE invocations SET document = ? WHERE id = ?", (b"\xff{", damaged))
        refused = await agent.get(f"/v1/invocations/{damaged}")
        listed = (await agent.get("/v1/invocations")).json()["items"]
        health = (await agent.get("/healthz")).json()
    assert (refused.status_code, refused.json()["code"]) == (500, "row_unreadable")
    assert damaged in refused.json()["detail"]
    assert [document["id"] for document in listed] == [sound]
    assert health["status"] == "degraded"
    assert f"`{damaged}` in the table `invocations`" in health["broken"]["rows"]
