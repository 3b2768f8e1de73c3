from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any
from urllib.parse import quote

import orjson
import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Frame, Opcode

from app.api import links
from app.api.auth import issue_token
from app.api.sockets import PIECE_BYTES, Sockets
from app.governance.model import Role
from app.protocol import ROW, Policy, ProtocolError, pack_batch, unpack_batch
from app.runtime.link import Attachment
from tests.api.conftest import CELL, House

pytestmark = pytest.mark.anyio


def link_url(house: House, name: str = CELL) -> str:
    return house.url.replace("http:", "ws:") + f"/v1/cells/{name}/link"


def greeting(name: str) -> str:
    hello = {
        "type": "hello", "cell": name, "boot": "b", "robot": "r", "policy_digest": None, "profile": None,
        "invocation": None, "latched": False, "journal": "j", "last_seq": 0,
    }  # fmt: skip
    return orjson.dumps(hello).decode()


@pytest.mark.parametrize("key", ["agent", "operator", "operator_2", "engineer", "auditor", None])
async def test_only_a_cell_may_dial_in(house: House, key: str | None) -> None:
    headers = {} if key is None else {"Authorization": f"Bearer {house.tokens[key]}"}
    with pytest.raises(InvalidStatus) as refused:
        async with connect(link_url(house), additional_headers=headers, proxy=None):
            pass
    assert refused.value.response.status_code == (401 if key is None else 403)


async def test_a_token_of_one_cell_lets_in_nobody_by_another_name(house: House) -> None:
    token = issue_token(house.folder, name="cell", role=Role.CELL, station="workcell-2")
    principals = house.app.state.parts.principals
    principals.admit(principals.look())
    headers = {"Authorization": f"Bearer {token}"}
    with pytest.raises(InvalidStatus) as refused:
        async with connect(link_url(house), additional_headers=headers, proxy=None):
            pass
    problem = orjson.loads(refused.value.response.body or b"")
    assert (refused.value.response.status_code, problem["code"]) == (403, "role_forbidden")
    assert problem["detail"] == "the token is of the cell `workcell-2`: valid is that name"
    async with connect(link_url(house, "workcell-2"), additional_headers=headers, proxy=None) as socket:
        await socket.send(greeting("workcell-2"))
        assert '"type":"welcome"' in str(await socket.recv())


@pytest.mark.parametrize("frame", ["{", '{"type": "state"}', b"\x00", '{"type": "beat"}'])
async def test_a_frame_that_is_no_greeting_ends_the_link(house: House, frame: str | bytes) -> None:
    headers = {"Authorization": f"Bearer {house.cell_token}"}
    async with connect(link_url(house, "stranger"), additional_headers=headers, proxy=None) as socket:
        await socket.send(frame)
        with pytest.raises(ConnectionClosed) as ended:
            await socket.recv()
    assert ended.value.rcvd is not None
    assert ended.value.rcvd.code == 1002
    assert not house.runtime.fleet.knows("stranger")


async def test_a_link_on_which_nothing_is_said_ends(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(links, "SILENT_S", 0.2)
    headers = {"Authorization": f"Bearer {house.cell_token}"}
    async with connect(link_url(house, "silent"), additional_headers=headers, proxy=None) as socket:
        with pytest.raises(ConnectionClosed) as ended:
            async with asyncio.timeout(10.0):
                await socket.recv()
    assert ended.value.rcvd is not None
    assert (ended.value.rcvd.code, ended.value.rcvd.reason) == (4408, "no `hello` came within 0.2 s")


async def test_a_link_ends_with_why_in_whatever_letters_it_was_wrong(house: House) -> None:
    headers = {"Authorization": f"Bearer {house.cell_token}"}
    event = {"type": "event", "seq": 1, "at_s": 0.0, "tick": 0, "kind": "ü" * 200, "actor": "cell"}
    async with connect(link_url(house, "stranger"), additional_headers=headers, proxy=None) as socket:
        await socket.send(greeting("stranger"))
        await socket.send(orjson.dumps({**event, "invocation": None, "body": {}}).decode())
        await asyncio.wait_for(socket.wait_closed(), 10.0)
    assert (socket.close_code, (socket.close_reason or "")[:26]) == (1002, "a cell does not report `üü")


async def test_however_much_a_cell_says_at_once_it_is_read_little_by_little(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting, hand_on = list[int](), Sockets.send_receive_event_to_app

    def handing_on(socket: Sockets) -> None:
        waiting.append(socket.queue.qsize())
        hand_on(socket)

    monkeypatch.setattr(Sockets, "send_receive_event_to_app", handing_on)
    headers = {"Authorization": f"Bearer {house.cell_token}"}
    async with connect(link_url(house, "flood"), additional_headers=headers, proxy=None, ping_interval=None) as socket:
        await socket.send(greeting("flood"))
        await socket.recv()
        beats = [Frame(Opcode.TEXT, b'{"type":"beat","n":%d}' % n).serialize(mask=True) for n in range(7_500)]
        socket.transport.write(b"".join(beats))
        async with asyncio.timeout(20.0):
            while '"n":7499' not in str(await socket.recv()):
                pass
    assert len(waiting) > 7_500
    assert max(waiting) <= PIECE_BYTES / len(beats[0])


async def test_what_waits_of_one_link_leaves_the_others_their_turn(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    order, receive = list[str](), Attachment.receive

    async def taking(attachment: Attachment, frame: str | bytes) -> None:
        order.append("m")
        await receive(attachment, frame)

    async def beside() -> None:
        while True:
            order.append(" ")
            await asyncio.sleep(0)

    monkeypatch.setattr(links, "TURN_S", -1.0)  # which every message takes
    monkeypatch.setattr(Attachment, "receive", taking)
    headers = {"Authorization": f"Bearer {house.cell_token}"}
    async with connect(link_url(house, "turns"), additional_headers=headers, proxy=None) as socket:
        await socket.send(greeting("turns"))
        await socket.recv()
        other = asyncio.create_task(beside())
        order.clear()
        socket.transport.write(1000 * Frame(Opcode.TEXT, b'{"type":"beat","n":1}').serialize(mask=True))
        async with asyncio.timeout(20.0):
            while order.count("m") < 1000:
                await asyncio.sleep(0.01)
        taken = "".join(order)  # and not what comes once nobody else is there
        other.cancel()
    assert max(map(len, taken.split(" "))) < 10


async def test_others_come_in_between_however_quickly_it_is_taken_what_a_cell_says(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    order = list[str]()

    async def taking(attachment: Attachment, frame: str | bytes) -> None:
        order.append("m")

    async def beside() -> None:
        while True:
            order.append(" ")
            await asyncio.sleep(0)

    headers = {"Authorization": f"Bearer {house.cell_token}"}
    beat = Frame(Opcode.TEXT, b'{"type":"beat","n":1}').serialize(mask=True)
    async with connect(link_url(house, "between"), additional_headers=headers, proxy=None) as socket:
        await socket.send(greeting("between"))
        await socket.recv()
        monkeypatch.setattr(Attachment, "receive", taking)
        other = asyncio.create_task(beside())
        socket.transport.write(5000 * beat)
        async with asyncio.timeout(20.0):
            while order.count("m") < 5000:
                await asyncio.sleep(0.01)
        taken = "".join(order)
        other.cancel()
    assert max(map(len, taken.split(" "))) <= 2 * PIECE_BYTES / len(beat)


async def test_a_link_whose_cell_reads_nothing_is_over_once_it_is_shut(house: House) -> None:
    headers = {"Authorization": f"Bearer {house.cell_token}"}
    fleet = house.runtime.fleet
    policy = Policy(digest=fleet.policy_digest, files=dict(fleet.policy_files))
    async with connect(link_url(house, "deaf"), additional_headers=headers, proxy=None, ping_interval=None) as socket:
        await socket.send(greeting("deaf"))
        await socket.recv()
        attachment = fleet.cell("deaf").attachment
        assert attachment is not None
        while not attachment.closed:  # until so much waits that it is shut for that
            attachment.post(policy)
            await asyncio.sleep(0)
        async with asyncio.timeout(10.0):
            while fleet.cell("deaf").attachment is not None:
                await asyncio.sleep(0.01)


async def test_a_cell_is_heard_while_the_record_takes_its_time_for_its_coming(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    append, go = house.runtime.store.append, asyncio.Event()

    async def slow(*given: Any) -> list[int]:
        await go.wait()
        return await append(*given)

    monkeypatch.setattr(house.runtime.store, "append", slow)
    headers = {"Authorization": f"Bearer {house.cell_token}"}
    try:
        async with connect(link_url(house, "slow"), additional_headers=headers, proxy=None) as socket:
            await socket.send(greeting("slow"))
            await socket.send('{"type":"beat","n":7}')
            async with asyncio.timeout(10.0):
                while '"n":7' not in str(await socket.recv()):
                    pass
    finally:
        go.set()


@pytest.mark.parametrize("name", [b"inv_\xff", "übung".encode()])
def test_a_frame_of_telemetry_that_names_no_invocation_is_malformed(name: bytes) -> None:
    frame = bytearray(pack_batch("", bytes(ROW.size)))
    assert unpack_batch(bytes(frame))[0] == ""
    frame[8 : 8 + len(name)] = name
    with pytest.raises(ProtocolError, match="valid are ASCII characters"):
        unpack_batch(bytes(frame))


async def refusal(house: House, name: str) -> str:
    """Dial in under a name and return why that was refused."""
    headers = {"Authorization": f"Bearer {house.cell_token}"}
    with pytest.raises(InvalidStatus) as refused:
        async with connect(link_url(house, quote(name, safe="")), additional_headers=headers, proxy=None):
            pass
    problem = orjson.loads(refused.value.response.body or b"")
    assert (refused.value.response.status_code, problem["code"]) == (422, "request_invalid")
    assert not house.runtime.fleet.knows(name)
    return problem["detail"]


@pytest.mark.parametrize(
    "name",
    ["x" * 41, "..", "Workcell-1", "café", "work\N{RIGHT-TO-LEFT OVERRIDE}cell", "a b", "-x", "workcell-1\n", "a.b"],
)
async def test_refuses_a_cell_whose_name_is_none(house: House, name: str) -> None:
    assert "no name of a cell: valid are lower-case letters" in await refusal(house, name)


@pytest.mark.parametrize("name", ["operator", "operator_2", "auditor", "planner", "server", "cell"])
async def test_refuses_a_cell_in_the_name_of_a_person_an_agent_or_the_server(house: House, name: str) -> None:
    before = await house.runtime.register.store.events(actor=name, limit=1000)
    assert f"reads like `{name}`" in await refusal(house, name)
    assert await house.runtime.register.store.events(actor=name, limit=1000) == before, "nothing is recorded under it"


async def test_refuses_a_cell_in_the_name_of_an_agent_that_has_no_token(house: House) -> None:
    parts, policy = house.app.state.parts, house.runtime.kernel.policy
    other = replace(policy, agents={"mover": policy.agents["planner"]})
    house.app.state.parts = replace(parts, policy=lambda: other)
    try:
        assert "reads like `mover`" in await refusal(house, "mover")
    finally:
        house.app.state.parts = parts


async def test_refuses_a_cell_in_a_name_that_reads_like_somebodys(house: House) -> None:
    issue_token(house.folder, name="Lena", role=Role.OPERATOR)
    assert "reads like `Lena`" in await refusal(house, "lena")
