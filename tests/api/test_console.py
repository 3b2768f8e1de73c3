"""The console's door over a real socket, with a real record; only the cell is a puppet."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

import httpx
import orjson
import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.typing import Subprotocol

from app.api import console as door
from app.api.auth import PRINCIPALS_FILE
from app.protocol import pack_poses
from app.runtime import broadcast, outlet, roster
from app.runtime.broadcast import SHOWN_INVOCATIONS
from tests.api.conftest import CELL, House, Puppet, eventually

pytestmark = pytest.mark.anyio
PATIENCE_S = 40.0
NOTHING = {"capability": "no_such_thing", "params": {}}


class Frame(NamedTuple):
    """A frame of poses as docs/design/console.md lays it out."""

    cell: int
    number: int
    tick: int
    at_s: float
    poses: list[tuple[float, ...]]
    gauges: tuple[float, ...]

    @classmethod
    def read(cls, frame: bytes) -> Frame:
        magic, cell, bodies, gauges, _, number, tick, at_s = struct.unpack_from("<4sHHHHIId", frame)
        assert magic == b"RPF1"
        values = struct.unpack_from(f"<{bodies * 7 + gauges}f", frame, 28)
        assert len(frame) == 28 + 4 * len(values)
        poses = [values[place : place + 7] for place in range(0, bodies * 7, 7)]
        return cls(cell, number, tick, at_s, poses, values[bodies * 7 :])


class Screen:
    """A console without a browser: reads everything, acknowledges as it reads."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.heard: list[dict[str, Any]] = []
        self.frames: list[Frame] = []
        self.acknowledges = True

    async def say(self, **message: Any) -> None:
        await self.socket.send(orjson.dumps(message).decode())

    async def next(self, within_s: float = PATIENCE_S) -> dict[str, Any]:
        async with asyncio.timeout(within_s):
            while (message := await self._hear()) is None:
                pass
            return message

    async def _hear(self) -> dict[str, Any] | None:
        """Take the next that comes: return a message, and keep a frame."""
        frame = await self.socket.recv()
        if isinstance(frame, bytes):
            self.frames.append(Frame.read(frame))
            return None
        message: dict[str, Any] = orjson.loads(frame)
        self.heard.append(message)
        beat = message["n"] if message["type"] == "beat" else message.get("beat")
        if beat is not None and self.acknowledges:
            await self.say(type="ack", beat=beat)
        return message

    async def until_frames(self, number: int) -> list[Frame]:
        """Read on until so many frames have come, and return them."""
        async with asyncio.timeout(PATIENCE_S):
            while len(self.frames) < number:
                await self._hear()
        return self.frames

    async def until(self, condition: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
        """Return the next message that fits."""
        async with asyncio.timeout(PATIENCE_S):
            while not condition(message := await self.next()):
                pass
            return message

    async def until_type(self, kind: str) -> dict[str, Any]:
        return await self.until(lambda message: message["type"] == kind)

    async def ended(self) -> tuple[int, str]:
        """Read to the end and return the close code and why."""
        try:
            while True:
                await self.next()
        except ConnectionClosed as end:
            return (0, "") if end.rcvd is None else (end.rcvd.code, end.rcvd.reason)

    def seqs(self) -> list[int]:
        """Return the `seq` of every event heard, in order."""
        return [event["seq"] for message in self.heard for event in message.get("events", [])]


def console_url(house: House) -> str:
    return house.url.replace("http:", "ws:") + door.PATH


@asynccontextmanager
async def dial(house: House, **options: Any) -> AsyncIterator[Screen]:
    given: dict[str, Any] = {"subprotocols": [Subprotocol(door.SUBPROTOCOL)], "proxy": None, "compression": None}
    async with connect(console_url(house), **(given | options)) as socket:
        yield Screen(socket)


def bearing(house: House, key: str) -> dict[str, str]:
    known = {**house.tokens, "cell": house.cell_token}
    return {"Authorization": f"Bearer {known.get(key, key)}"}


@asynccontextmanager
async def signed_in(house: House, key: str = "operator", after: int | None = None) -> AsyncIterator[Screen]:
    async with dial(house) as screen:
        await screen.say(type="hello", token=house.tokens[key], after=after)
        yield screen


@asynccontextmanager
async def showing(puppet: Puppet) -> AsyncIterator[None]:
    """Show a pose again and again, as a cell does: one that waits too long for its turn is left out."""

    async def show() -> None:
        while True:
            await puppet.show(3.5, 1.0)
            await asyncio.sleep(0.05)

    shown = asyncio.ensure_future(show())
    try:
        yield
    finally:
        shown.cancel()
        await asyncio.wait({shown})


async def propose(house: House, times: int = 1) -> list[dict[str, Any]]:
    async with house.client() as client:
        answers = await asyncio.gather(*(client.post("/v1/invocations", json=NOTHING) for _ in range(times)))
    return [answer.json() for answer in answers]


@pytest.mark.parametrize(("key", "role"), [("operator", "operator"), ("engineer", "engineer"), ("auditor", "auditor")])
async def test_people_sign_in_and_are_shown_a_snapshot(house: House, key: str, role: str) -> None:
    async with signed_in(house, key) as screen:
        welcome, snapshot = await screen.next(), await screen.next()
    assert screen.socket.subprotocol == door.SUBPROTOCOL
    assert (welcome["type"], welcome["version"], welcome["role"]) == ("welcome", 1, role)
    assert snapshot["type"] == "snapshot"
    assert snapshot.keys() >= {"seq", "cells", "invocations", "escalations", "grants", "reviews", "events"}
    assert snapshot["events"][-1]["seq"] == snapshot["seq"]


@pytest.mark.parametrize(("token", "code"), [("nobody's", 4401), ("agent", 4403), ("cell", 4403)])
async def test_nobody_else_comes_in(house: House, token: str, code: int) -> None:
    async with dial(house) as screen:
        await screen.say(type="hello", token=bearing(house, token)["Authorization"].removeprefix("Bearer "))
        assert (await screen.ended())[0] == code
    assert screen.heard == []


async def test_who_can_set_a_header_signs_in_by_it(house: House) -> None:
    async with dial(house, additional_headers=bearing(house, "operator")) as screen:
        welcome, snapshot = await screen.next(), await screen.next()
        assert (welcome["type"], welcome["name"], snapshot["type"]) == ("welcome", "operator", "snapshot")
        await screen.say(type="hello", token=house.tokens["operator"])
        assert await screen.ended() == (4400, "`hello` was said already: valid once, first")


@pytest.mark.parametrize(("key", "status"), [("nobody's", 401), ("agent", 403), ("cell", 403)])
async def test_whose_header_is_refused_gets_the_problems_own_status(house: House, key: str, status: int) -> None:
    with pytest.raises(InvalidStatus) as refusal:
        async with dial(house, additional_headers=bearing(house, key)):
            pass
    assert refusal.value.response.status_code == status
    assert orjson.loads(refusal.value.response.body or b"")["status"] == status


async def test_a_page_of_another_origin_is_refused_whatever_header_it_sends(house: House) -> None:
    async with dial(house, origin="https://elsewhere.example", additional_headers=bearing(house, "operator")) as screen:
        assert (await screen.ended())[0] == 4403
    assert screen.heard == []


async def test_who_does_not_sign_in_in_time_is_shown_out(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(door, "HELLO_S", 0.1)
    async with dial(house) as screen:
        assert (await screen.ended())[0] == 4408


@pytest.mark.parametrize(
    "origin", ["https://elsewhere.example", "null", "http://127.0.0.1:1", "http://[", "http://[::1"]
)
async def test_a_page_of_another_origin_is_refused(house: House, origin: str) -> None:
    async with dial(house, origin=origin) as screen:
        with contextlib.suppress(ConnectionClosed):
            await screen.say(type="hello", token=house.tokens["operator"])
        assert (await screen.ended())[0] == 4403


async def test_the_servers_own_page_comes_in(house: House) -> None:
    async with dial(house, origin=house.url) as screen:
        await screen.say(type="hello", token=house.tokens["operator"])
        assert (await screen.next())["type"] == "welcome"


@pytest.mark.parametrize(
    "frame",
    [
        "{",
        "[]",
        '{"type": "nothing"}',
        '{"type": "ack"}',
        '{"type": "ack", "beat": 1, "cell": 0, "frame": 2}',
        '{"type":"ack","beat":1,"cell":0,"frame":2}',
        '{"type":"ack","beat":01}',
        '{"type":"ack","beat":-1}',
        '{"type":"ack","beat":1,"beat":2}',
        '{"type": "watch", "cells": "all"}',
        '{"type": "ping", "at_ms": NaN}',
        '{"type": "jog", "cell": "c", "lease": "l", "n": 1, "base": [0, 0], "tool": [0, 0, 0], "grip": null}',
        '{"type": "hello", "token": "again"}',
        '{"type": "ping", "at_ms": 1, "more": 1}',
        '{"type": "ping", "at_ms": 1, "at_ms": 2}',
        "x" * 9000,
        b"\x00\x01",
    ],
)
async def test_a_frame_that_is_no_message_ends_the_console_and_says_why(house: House, frame: str | bytes) -> None:
    async with signed_in(house) as screen:
        await screen.until_type("snapshot")
        await screen.socket.send(frame)
        code, reason = await screen.ended()
    assert code == 4400
    assert reason


async def test_a_console_that_floods_the_server_is_shown_out(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(door, "MOST_FRAMES", 8)
    monkeypatch.setattr(door, "WITHIN_S", 3600.0)
    async with signed_in(house) as screen:
        await screen.until_type("snapshot")
        for _ in range(8):
            await screen.socket.send('{"type": "ping", "at_ms": 1}')
        assert await screen.ended() == (4400, "a console says at most 8 frames in 3600 s")
    async with signed_in(house) as screen:  # and may come back
        await screen.until_type("snapshot")


@pytest.mark.parametrize("key", ["auditor", "engineer", "operator"])
async def test_a_console_that_names_what_it_does_not_drive_is_answered_and_nothing_of_it_is_kept(
    house: House, monkeypatch: pytest.MonkeyPatch, key: str
) -> None:
    seated: list[Remembering] = []

    class Remembering(door.Console):
        def __init__(self, *parts: Any) -> None:
            super().__init__(*parts)
            seated.append(self)

        def remembers(self) -> int:
            return len(self._jogged)

    monkeypatch.setattr(door, "Console", Remembering)
    names = [f"cell-{number}" for number in range(50)] if key == "operator" else [CELL] * 50
    async with signed_in(house, key) as screen:
        for number, name in enumerate(names):
            resting = [0.0, 0.0, 0.0]
            await screen.say(type="jog", cell=name, lease=f"lea_{number}", n=number, base=resting, tool=resting)
            told = await screen.until_type("jogged")
            assert (told["cell"], told["n"], told["refused"]) == (name, number, "not_holder")
    assert [one.remembers() for one in seated] == [0]


@pytest.mark.parametrize(
    ("frame", "why"),
    [
        ("{}", "no message: 'type' is missing"),
        ("[]", "no message: valid is an object"),
        ('{"type": "stop"}', "no message: valid types are 'hello', 'watch', 'ack', 'ping', 'jog', 'estop'"),
        ('{"type": "watch", "cells": 5}', "no message at `watch.cells`: valid is a list"),
        ('{"type": "estop"}', "no message at `estop.cell`: is missing"),
    ],
)
async def test_a_bad_frame_is_told_what_would_be_valid(house: House, frame: str, why: str) -> None:
    async with signed_in(house) as screen:
        await screen.until_type("snapshot")
        await screen.socket.send(frame)
        assert await screen.ended() == (4400, why)


async def test_a_token_in_a_bad_frame_is_not_echoed(house: House) -> None:
    async with dial(house) as screen:
        await screen.socket.send('{"type": "hello", "token": {"secret": 1}}')
        code, reason = await screen.ended()
    assert code == 4400
    assert "secret" not in reason


async def test_what_happens_is_neither_lost_nor_doubled_between_snapshot_and_updates(house: House) -> None:
    stop = asyncio.Event()

    async def keep_proposing() -> None:
        while not stop.is_set():
            await propose(house, 5)

    proposing = asyncio.create_task(keep_proposing())
    try:
        for _ in range(5):
            async with signed_in(house) as screen:
                snapshot = await screen.until_type("snapshot")
                target = snapshot["seq"] + 30
                await screen.until(lambda message, target=target: message.get("seq", 0) >= target)
            seqs = screen.seqs()
            assert seqs == list(range(seqs[0], seqs[0] + len(seqs)))
            assert seqs[-1] >= target
    finally:
        stop.set()
        await proposing


async def test_many_events_come_in_few_updates(house: House) -> None:
    async with signed_in(house) as screen:
        await screen.until_type("snapshot")
        before = len(screen.heard)
        proposed = {one["id"] for one in await propose(house, 60)}
        told: set[str] = set()

        def all_told(message: dict[str, Any]) -> bool:
            told.update(event["invocation"] for event in message.get("events", []))
            return proposed <= told

        await screen.until(all_told)
        updates = [message for message in screen.heard[before:] if message["type"] == "update"]
    assert len(updates) < 30


async def test_of_a_flood_of_refusals_events_tell_all_and_documents_the_newest(house: House) -> None:
    async with signed_in(house) as screen, signed_in(house, "operator_2") as other:
        await screen.until_type("snapshot")
        await other.until_type("snapshot")
        proposed: list[str] = []
        for _ in range(5):
            proposed += [one["id"] for one in await propose(house, 80)]
            for one in (screen, other):  # who acknowledges nothing for 15 s is let go of
                await one.until(lambda message: message.get("seq", 0) >= house.runtime.store.size)
        last = (await propose(house))[0]["id"]
        for one in (screen, other):
            await one.until(lambda message: any(known["id"] == last for known in message.get("invocations", [])))
        updates = [message for message in screen.heard if message["type"] == "update"]
        assert screen.seqs() == list(range(screen.seqs()[0], screen.seqs()[-1] + 1))
        assert {event["invocation"] for one in updates for event in one.get("events", [])} >= {*proposed, last}
        assert max(len(one.get("invocations", [])) for one in updates) == SHOWN_INVOCATIONS
        assert screen.seqs()[-1] == other.seqs()[-1]


async def test_an_agent_that_says_a_lot_keeps_no_console_out(house: House) -> None:
    lot = {f"word_{number}": "x" * 4_000 for number in range(58)}
    async with signed_in(house) as there, house.client() as agent, house.client("auditor") as auditor:
        await there.until(lambda message: message["type"] == "snapshot")
        for _ in range(20):
            assert (await agent.post("/v1/invocations", json={**NOTHING, "metadata": lot})).status_code == 201
            assert (await agent.post("/v1/invocations", json={**NOTHING, "params": lot})).status_code == 201
        last = house.runtime.store.size
        await there.until(lambda message: message.get("seq") == last)
        async with signed_in(house) as late:
            snapshot = await late.until(lambda message: message["type"] == "snapshot")
        proposals = [event for event in snapshot["events"] if event["kind"] == "proposal"]
        assert [event["body"]["left_out"] for event in proposals[-2:]] == [["metadata"], ["filled", "params"]]
        assert [len(one["requested"]) for one in snapshot["invocations"]] == [0] * SHOWN_INVOCATIONS
        assert [event["seq"] for event in snapshot["events"]][-1] == last
        whole = await auditor.get(f"/v1/audit/events?after={proposals[-2]['seq'] - 1}&limit=1")
        assert whole.json()["items"][0]["body"]["metadata"] == lot


@pytest.mark.parametrize(("room", "shown"), [(10**6, 6), (0, 0)])
async def test_a_snapshot_holds_no_more_than_a_console_can_take(
    house: House, monkeypatch: pytest.MonkeyPatch, room: int, shown: int
) -> None:
    seen = house.runtime.store.size
    await propose(house, 3)
    monkeypatch.setattr(broadcast, "SNAPSHOT_BYTES", room)
    async with signed_in(house, after=seen) as screen:
        snapshot = await screen.until(lambda message: message["type"] == "snapshot")
    assert (len(snapshot["events"]), snapshot["seq"]) == (shown, seen + 6)


async def test_a_console_that_comes_back_misses_nothing(house: House) -> None:
    async with signed_in(house) as screen:
        seen = (await screen.until_type("snapshot"))["seq"]
    await propose(house, 100)  # more than a snapshot shows to a newcomer
    async with signed_in(house, after=seen) as back:
        snapshot = await back.until_type("snapshot")
    assert back.seqs() == list(range(seen + 1, snapshot["seq"] + 1))
    assert len(back.seqs()) >= 200


async def test_a_seq_of_another_log_is_no_place_to_go_on_from(house: House) -> None:
    async with signed_in(house, after=10**12) as screen:
        snapshot = await screen.until_type("snapshot")
    assert snapshot["events"][-1]["seq"] == snapshot["seq"]


async def test_beats_come_at_least_four_times_a_second_and_a_ping_is_answered(house: House) -> None:
    async with signed_in(house) as screen:
        await screen.until_type("snapshot")
        await screen.say(type="ping", at_ms=12.5)
        assert (await screen.until_type("pong"))["at_ms"] == 12.5
        first, *_, last = [await screen.until_type("beat") for _ in range(6)]
    assert last["n"] == first["n"] + 5
    assert last["at"] - first["at"] < 5 / 4


async def test_two_consoles_are_told_the_same(house: House) -> None:
    async with signed_in(house) as one, signed_in(house, "operator_2") as two:
        await one.until_type("snapshot")
        await two.until_type("snapshot")
        (proposed,) = await propose(house)
        for screen in (one, two):
            shown = await screen.until(
                lambda message: any(known["id"] == proposed["id"] for known in message.get("invocations", []))
            )
            assert shown["invocations"] == [proposed]


async def test_a_cell_that_comes_and_goes_and_latches_is_shown(house: House) -> None:
    def says(message: dict[str, Any], **facts: Any) -> bool:
        cells = [cell for cell in message.get("cells", []) if cell["id"] == CELL]
        return any(all(cell[name] == value for name, value in facts.items()) for cell in cells)

    async with signed_in(house) as screen, house.client("operator") as operator:
        await screen.until_type("snapshot")
        async with house.cell():
            await screen.until(lambda message: says(message, online=True, latched=False))
            await operator.post(f"/v1/cells/{CELL}/estop")
            await screen.until(lambda message: says(message, latched=True))
            await operator.post(f"/v1/cells/{CELL}/reset")
            await screen.until(lambda message: says(message, latched=False))
        await screen.until(lambda message: says(message, online=False))


async def test_a_cell_that_makes_room_for_another_is_said_to_be_gone_and_comes_back(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(roster, "MOST_CELLS", 1)
    monkeypatch.setattr(roster, "FORGOTTEN_S", 0.0)
    other = f"{CELL}-too"
    async with house.cell():
        pass
    async with signed_in(house) as screen:
        assert cells_in(await screen.until_type("snapshot")) == [CELL]
        for name, gone in ((other, CELL), (CELL, other), (other, CELL)):
            async with house.cell(name):
                await screen.until(lambda message, name=name: name in cells_in(message))
                await screen.until_type("beat")
            assert screen.heard.pop()["type"] == "beat"
            assert [cell for message in screen.heard for cell in message.get("cells_gone", [])] == [gone]
            screen.heard.clear()
        async with signed_in(house) as later:
            assert cells_in(await later.until_type("snapshot")) == [other]


def cells_in(message: dict[str, Any]) -> list[str]:
    return [cell["id"] for cell in message.get("cells", [])]


@pytest.mark.parametrize("key", ["operator", "engineer", "auditor"])
async def test_a_stop_said_here_is_that_of_http_and_said_again_changes_nothing(house: House, key: str) -> None:
    async def stops(operator: httpx.AsyncClient) -> list[dict[str, Any]]:
        events = (await operator.get(f"/v1/audit/events?kind=human&after={before}")).json()["items"]
        return [event for event in events if event["body"]["op"] == "estop"]

    async with house.cell() as cell, signed_in(house, key) as screen, house.client("operator") as operator:
        before = (await screen.until_type("snapshot"))["seq"]
        await screen.say(type="estop", cell="workcell-9")  # there is none: the console stays
        for _ in range(3):
            await screen.say(type="estop", cell=CELL)
        await eventually(lambda: cell.latched)
        await screen.say(type="ping", at_ms=0.0)
        await screen.until_type("pong")
        async with asyncio.timeout(PATIENCE_S):
            while not (found := await stops(operator)):
                await asyncio.sleep(0.01)
        (said,) = found
        assert (await operator.post(f"/v1/cells/{CELL}/reset")).status_code == 200
        async with house.client(key) as anyone:
            assert (await anyone.post(f"/v1/cells/{CELL}/estop")).status_code == 200
        _, posted = await stops(operator)
        assert [said[name] for name in ("kind", "actor", "invocation", "body")] == [
            posted[name] for name in ("kind", "actor", "invocation", "body")
        ]
        assert (await operator.post(f"/v1/cells/{CELL}/reset")).status_code == 200


async def test_a_stop_said_here_does_not_wait_for_the_record_of_the_one_before(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    roster, go_on = house.runtime.fleet.roster, asyncio.Event()
    keep = roster.keep

    async def slow(*args: Any, **how: Any) -> None:
        await go_on.wait()
        await keep(*args, **how)

    async with house.cell() as cell, house.cell("workcell-2") as other, signed_in(house) as screen:
        await screen.until_type("snapshot")
        monkeypatch.setattr(roster, "keep", slow)
        await screen.say(type="estop", cell=CELL)
        await screen.say(type="estop", cell="workcell-2")
        await eventually(lambda: cell.latched and other.latched)
        go_on.set()
        monkeypatch.setattr(roster, "keep", keep)
        async with house.client("operator") as operator:
            for name in (CELL, "workcell-2"):
                assert (await operator.post(f"/v1/cells/{name}/reset")).status_code == 200


async def test_a_stop_said_here_while_somebody_resets_keeps_the_cell_stopped(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    reset = f"/v1/cells/{CELL}/reset"
    cell = house.runtime.fleet

    async def said(screen: Screen) -> None:
        stops = cell.cell(CELL).stops
        await screen.say(type="estop", cell=CELL)
        await eventually(lambda: cell.cell(CELL).stops == stops + 1)

    async with house.cell(), signed_in(house, "auditor") as screen, house.client("operator") as operator:
        await screen.until_type("snapshot")
        await operator.post(f"/v1/cells/{CELL}/estop")
        armed = (await operator.post(reset, json={"step": "arm"})).json()
        assert armed["armed_by"] == "operator"
        await said(screen)
        answer = await operator.post(reset, json={"step": "confirm", "code": armed["arming"]["code"]})
        assert (answer.status_code, answer.json()["code"]) == (409, "not_armed")
        keep, reached, goes_on = cell.roster.keep, asyncio.Event(), asyncio.Event()

        async def slow(*args: Any, **how: Any) -> None:
            if not how["estop"]:
                reached.set()
                await goes_on.wait()
            await keep(*args, **how)

        monkeypatch.setattr(cell.roster, "keep", slow)
        resetting = asyncio.create_task(operator.post(reset))
        await reached.wait()
        await said(screen)
        goes_on.set()
        assert (await resetting).json()["latched"]
        async with cell.cell(CELL).unlatching:  # another reset of which the cell says nothing for a second
            size = house.runtime.store.size
            resetting = asyncio.create_task(operator.post(reset))
            await eventually(lambda: house.runtime.store.size > size)
            await said(screen)
        assert (await resetting).json()["latched"]


async def test_an_escalation_appears_and_its_answer_too(shared_house: House) -> None:
    def about(message: dict[str, Any], status: str) -> bool:
        return any(question["status"] == status for question in message.get("escalations", []))

    async with shared_house.cell(), signed_in(shared_house) as screen, shared_house.client("operator") as operator:
        await screen.until_type("snapshot")
        async with shared_house.client() as agent:
            wish = {"capability": "grasp_object", "params": {"object_id": "mug_1"}}
            proposed = (await agent.post("/v1/invocations", json=wish)).json()
        shown = await screen.until(lambda message: about(message, "pending"))
        (question,) = shown["escalations"]
        assert question["id"] == proposed["escalation"]["id"]
        async with signed_in(shared_house) as late:
            assert (await late.until_type("snapshot"))["escalations"] == [question]
        answer = {"decision": "deny", "digest": question["digest"]}
        await operator.post(f"/v1/escalations/{question['id']}/resolve", json=answer)
        await screen.until(lambda message: about(message, "denied"))
        async with signed_in(shared_house) as late:
            assert (await late.until_type("snapshot"))["escalations"] == []


async def test_the_end_of_what_consoles_follow_is_told_whatever_floods_in_beside_it(shared_house: House) -> None:
    """One that came with the snapshot, and one that came later, are both told of as over."""

    def tells_end(of: str) -> Callable[[dict[str, Any]], bool]:
        return lambda message: any(one["id"] == of and one["outcome"] for one in message.get("invocations", []))

    async with shared_house.cell(), shared_house.client() as agent, shared_house.client("operator") as operator:
        wish = {"capability": "grasp_object", "params": {"object_id": "mug_1"}}
        await agent.post("/v1/invocations", json=wish)
        async with signed_in(shared_house) as screen:
            (early,) = (await screen.until_type("snapshot"))["escalations"]
            await agent.post("/v1/invocations", json=wish)
            (late,) = (await screen.until(lambda message: message.get("escalations")))["escalations"]
            for asked in (early, late):
                denial = {"decision": "deny", "code": "other", "digest": asked["digest"]}
                _, answer = await asyncio.gather(
                    propose(shared_house, 100),
                    operator.post(f"/v1/escalations/{asked['id']}/resolve", json=denial),
                )
                assert answer.status_code == 200, answer.text
                await screen.until(tells_end(asked["invocation"]))


@pytest.mark.parametrize("by", ["hello", "header"])
async def test_a_console_whose_token_is_withdrawn_is_shown_out(house: House, by: str) -> None:
    headed = dial(house, additional_headers=bearing(house, "auditor"))
    async with signed_in(house, "auditor") if by == "hello" else headed as screen:
        await screen.until_type("snapshot")
        async with house.withdrawn("auditor"), asyncio.timeout(PATIENCE_S):
            assert (await screen.ended())[0] == 4401


async def test_a_console_whose_token_comes_to_stand_for_another_role_has_to_sign_in_again(house: House) -> None:
    listed = house.folder / PRINCIPALS_FILE
    everyone = listed.read_bytes()
    rows = orjson.loads(everyone)["principals"]
    demoted = [{**row, "role": "auditor"} if row["name"] == "operator" else row for row in rows]
    assert demoted != rows
    async with signed_in(house, "operator") as screen:
        await screen.until_type("snapshot")
        listed.write_bytes(orjson.dumps({"principals": demoted}))
        try:
            async with asyncio.timeout(PATIENCE_S):
                assert (await screen.ended())[0] == 4401
        finally:
            listed.write_bytes(everyone)
    recognize, token = house.app.state.parts.principals.recognize, house.tokens["operator"]
    await eventually(lambda: house.knows("operator") and recognize(token).role == "operator")


async def test_poses_come_to_whoever_watches_and_stop_when_nobody_does(house: House) -> None:
    async with house.cell() as puppet:
        async with signed_in(house) as one, signed_in(house, "auditor") as two:
            await one.say(type="watch", cells=["elsewhere", CELL])
            scene = await one.until_type("scene")
            assert (scene["cell"], scene["bodies"], scene["gauges"]) == (CELL, ["mug_1"], ["progress"])
            await puppet.show(1.5, 0.25)
            (frame,) = await one.until_frames(1)
            assert (frame.cell, frame.tick) == (1, 7)
            assert frame.poses == [(1.5, 0.0, pytest.approx(0.8), 1.0, 0.0, 0.0, 0.0)]
            assert frame.gauges == (0.25,)
            await two.say(type="watch", cells=[CELL])
            assert (await two.until_type("scene")) == scene
            await puppet.show(2.5, 0.5)
            assert (await two.until_frames(1))[0].cell == 0
            assert (await one.until_frames(2))[1].poses[0][0] == 2.5
            await one.say(type="watch", cells=[])
            await two.say(type="watch", cells=[])
            await eventually(lambda: puppet.watched == [True, False])
        assert house.runtime.fleet.attached(house.runtime.fleet.cell(CELL))


async def test_a_console_that_leaves_watches_no_more(house: House) -> None:
    async with house.cell() as puppet:
        async with signed_in(house) as screen:
            await screen.say(type="watch", cells=[CELL])
            await eventually(lambda: puppet.watched == [True])
        await eventually(lambda: puppet.watched == [True, False])


async def test_a_cell_that_comes_back_is_watched_again(house: House) -> None:
    async with signed_in(house) as screen:
        async with house.cell():
            await screen.say(type="watch", cells=[CELL])
            await screen.until_type("scene")
        async with house.cell() as again:
            await screen.until_type("scene")
            await again.show(3.5, 1.0)
            assert (await screen.until_frames(1))[0].poses[0][0] == 3.5


async def test_a_frame_that_does_not_fit_its_scene_is_a_fault_of_the_cell(house: House) -> None:
    async with house.cell() as puppet, signed_in(house) as screen:
        await screen.say(type="watch", cells=[CELL])
        await screen.until_type("scene")
        await puppet.socket.send(pack_poses(7, 1.0, b"", b""))
        await puppet.socket.wait_closed()
        assert puppet.socket.close_code == 1002


async def test_a_console_that_falls_behind_is_closed_slows_nobody_and_comes_back_complete(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outlet, "MAX_BEHIND_BYTES", 300_000)
    async with signed_in(house) as slow, signed_in(house, "operator_2") as fast:
        seen = (await slow.until_type("snapshot"))["seq"]
        await fast.until_type("snapshot")
        async with house.client() as client:
            while house.app.state.parts.consoles.taken == 2:
                answers = await asyncio.gather(*(client.post("/v1/invocations", json=NOTHING) for _ in range(20)))
                last = answers[-1].json()["id"]
                await fast.until(
                    lambda message, last=last: any(one["id"] == last for one in message.get("invocations", []))
                )
        slow.acknowledges = False  # there is nobody left to tell
        assert (await slow.ended())[0] in {4410, 0}  # 0: the line did not drain in time, and was cut
    before = slow.seqs()
    assert before == list(range(before[0], before[0] + len(before)))
    async with signed_in(house, after=before[-1]) as back:
        snapshot = await back.until_type("snapshot")
    assert before[-1] >= seen
    assert back.seqs() == list(range(before[-1] + 1, snapshot["seq"] + 1))


async def test_a_long_update_is_acknowledged_itself_and_poses_wait_for_no_beat(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(house.runtime.broadcast, "beat", lambda: None)  # none by the clock
    monkeypatch.setattr(broadcast, "LONG_UPDATE", 64)  # so that a proposal is long, however it falls into updates
    monkeypatch.setattr(outlet, "BUDGET_BYTES", 64)  # and that nothing but its acknowledgement lets a frame through
    async with house.cell() as puppet, signed_in(house) as screen:
        await screen.until_type("snapshot")
        await screen.say(type="watch", cells=[CELL])
        await screen.until_type("scene")
        proposed = (await propose(house))[0]["id"]
        long = await screen.until(lambda message: any(one["id"] == proposed for one in message.get("invocations", [])))
        assert "beat" in long
        assert len(orjson.dumps(long)) > outlet.BUDGET_BYTES
        async with showing(puppet):
            assert (await screen.until_frames(1))[0].poses[0][0] == 3.5


async def test_what_cannot_be_told_ends_every_console_and_whoever_comes_back_sees_what_is(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with signed_in(house) as one, signed_in(house, "auditor") as two:
        await one.until_type("snapshot")
        await two.until_type("snapshot")
        loud: list[dict[str, Any]] = []
        loop = asyncio.get_running_loop()
        loud_before = loop.get_exception_handler()
        loop.set_exception_handler(lambda _loop, context: loud.append(context))
        with monkeypatch.context() as broken:
            broken.setattr(broadcast, "_events", len)  # no JSON text: it cannot be put behind any other
            proposed = (await propose(house))[0]["id"]
            async with asyncio.timeout(PATIENCE_S):
                for screen in (one, two):
                    code, why = await screen.ended()
                    assert (code, "TypeError" in why) == (1011, True)
        loop.set_exception_handler(loud_before)
        assert [type(context["exception"]) for context in loud] == [TypeError]
    async with signed_in(house) as back:
        snapshot = await back.until_type("snapshot")
        assert proposed in [shown["id"] for shown in snapshot["invocations"]]


async def test_a_console_may_be_opened_only_so_often(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(house.app.state.parts.consoles, "_each", 1)
    async with signed_in(house, "engineer") as first:
        await first.until_type("snapshot")
        async with signed_in(house, "engineer") as second:
            assert (await second.ended())[0] == 4429
        await first.until_type("beat")
