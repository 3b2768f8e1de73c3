"""Clients at the console's door that want to keep others out of it, or from hearing anything."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Iterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from urllib.parse import urlsplit

import pytest
from websockets.exceptions import ConnectionClosed

from app.api import console, sockets
from app.api.console import MAX_FRAME_BYTES, PATH
from app.api.parts import EACH_CONSOLES, MAX_UNGREETED, Parts
from app.api.problems import Problem
from app.api.seats import Doorstep, Ration
from app.api.sockets import MOST_ASIDE
from app.runtime.outlet import MAX_BEHIND_BYTES, Outlet
from tests.api.conftest import House, eventually
from tests.api.test_console import PATIENCE_S, Screen, dial, propose, signed_in

pytestmark = pytest.mark.anyio
NO_SEAT, NO_MESSAGE, NO_TEXT, TOO_BIG = 4429, 4400, 1007, 1009
LONG_S = 600.0


@pytest.fixture
def parts(house: House) -> Parts:
    return house.app.state.parts


@pytest.fixture
def rationed(house: House, parts: Parts) -> Iterator[Ration]:
    """Let nobody say more than a few things."""
    words = Ration(most=500, within_s=LONG_S)
    house.app.state.parts = replace(parts, words=words)
    yield words
    house.app.state.parts = parts


@asynccontextmanager
async def silent(house: House, number: int) -> AsyncGenerator[list[Screen]]:
    """Open so many sockets, one after the other, that say nothing."""
    async with AsyncExitStack() as stack:
        yield [await stack.enter_async_context(dial(house)) for _ in range(number)]


async def is_served(screen: Screen) -> None:
    """Hear an answer, and of what happens."""
    await screen.say(type="ping", at_ms=1.5)
    await screen.until_type("pong")


async def test_silent_sockets_keep_no_operator_out_and_none_who_signed_in_has_to_go(house: House, parts: Parts) -> None:
    async with signed_in(house, "auditor") as before:
        await before.until_type("snapshot")
        async with silent(house, 200) as others:
            assert parts.ungreeted.standing == MAX_UNGREETED
            async with signed_in(house) as operator:
                assert (await operator.next())["type"] == "welcome"
                await is_served(operator)
            assert [code for code, _ in [await screen.ended() for screen in others[:136]]] == [NO_SEAT] * 136
        await is_served(before)
    await eventually(lambda: parts.ungreeted.standing == 0)


async def test_a_frame_no_console_says_is_not_read_to_its_end(house: House) -> None:
    async with dial(house) as screen:
        with contextlib.suppress(ConnectionClosed):  # it may be closed before all of it is sent
            await screen.socket.send("x" * 10 * MAX_FRAME_BYTES)
        assert (await screen.ended())[0] == TOO_BIG


def raw(head: int, content: bytes = b"") -> bytes:
    """Return a frame with this first byte, masked as a client has to, by zeros."""
    return bytes([head, 0x80 | len(content), 0, 0, 0, 0]) + content


async def cut(screen: Screen) -> bool:
    """Read to the end; say whether it came without a word."""
    async with asyncio.timeout(PATIENCE_S):
        return await screen.ended() == (0, "")


PING, PONG, BEGIN, PART, TEXT = 0x89, 0x8A, 0x01, 0x00, 0x81


@pytest.mark.parametrize("greeted", [True, False])
@pytest.mark.parametrize(
    "frames",
    [raw(PING) * 2 * MOST_ASIDE, raw(PONG) * 2 * MOST_ASIDE, raw(BEGIN) + raw(PART) * 2 * MOST_ASIDE],
    ids=["pings", "pongs", "parts of a message"],
)
async def test_one_who_floods_with_what_is_no_message_is_cut_off(house: House, frames: bytes, greeted: bool) -> None:
    async with signed_in(house) if greeted else dial(house) as screen:
        screen.socket.transport.write(frames)
        assert await cut(screen)


async def test_a_few_pings_and_a_message_in_parts_are_taken(house: House) -> None:
    async with signed_in(house) as screen:
        parts = [raw(BEGIN, b'{"type": "ping",'), raw(PING), raw(PONG), raw(0x80, b' "at_ms": 1.5}')]
        screen.socket.transport.write(b"".join(parts))
        assert (await screen.until_type("pong"))["at_ms"] == 1.5


async def test_one_who_says_more_in_one_breath_than_a_console_may_in_a_second_is_cut_off(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sockets, "MOST_FRAMES", 8)
    async with signed_in(house) as screen:
        await screen.until_type("snapshot")
        screen.socket.transport.write(raw(TEXT, b'{"type":"ack","beat":0}') * 50)
        assert await cut(screen)


async def test_one_who_goes_on_after_the_last_word_is_cut_off(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sockets, "LET_GO_S", LONG_S)
    port = urlsplit(house.url).port
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    ask = f"GET {PATH} HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    writer.write(f"{ask}Sec-WebSocket-Key: {'A' * 22}==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode())
    async with asyncio.timeout(PATIENCE_S):
        await reader.readuntil(b"\r\n\r\n")
        writer.write(raw(TEXT, b"no message"))
        await reader.readuntil(NO_MESSAGE.to_bytes(2, "big"))
        writer.write(raw(TEXT, b"nor this") * 2 * MOST_ASIDE)
        with contextlib.suppress(ConnectionResetError):
            await reader.read()
    writer.close()


@pytest.mark.parametrize("greeted", [True, False])
@pytest.mark.parametrize(
    "frames",
    [
        raw(TEXT, b'{"type": "\xff\xfe"}'),
        raw(TEXT, b"\xed\xa0\x80"),  # half a surrogate pair
        raw(BEGIN, b"\xe2\x82") + raw(0x80, b"("),  # begun in one part, broken in the next
        raw(TEXT, b"\xff") * 100,
    ],
    ids=["no byte of UTF-8", "a surrogate", "in parts", "many"],
)
async def test_one_whose_text_is_no_utf_8_is_shown_out_quietly_and_others_are_served(
    house: House, caplog: pytest.LogCaptureFixture, frames: bytes, greeted: bool
) -> None:
    async with signed_in(house) as other, signed_in(house, "auditor") if greeted else dial(house) as screen:
        await is_served(other)
        screen.socket.transport.write(frames)
        assert await screen.ended() == (NO_TEXT, "a text is UTF-8")
        await is_served(other)
    assert caplog.messages == []


async def test_text_that_is_no_utf_8_and_goodbye_in_one_breath_end_quietly(
    house: House, caplog: pytest.LogCaptureFixture
) -> None:
    async with signed_in(house) as screen:
        screen.socket.transport.write(raw(TEXT, b"\xff") + raw(0x88, b"\x03\xe8"))
        async with asyncio.timeout(PATIENCE_S):
            await screen.ended()
    assert caplog.messages == []


async def test_a_cell_whose_text_is_no_utf_8_is_shown_out_quietly(
    house: House, caplog: pytest.LogCaptureFixture
) -> None:
    async with house.cell() as puppet:
        puppet.socket.transport.write(raw(TEXT, b"\xff"))
        await puppet.socket.wait_closed()
        assert puppet.socket.close_code == NO_TEXT
    assert caplog.messages == []


async def test_a_cell_that_is_let_in_says_long_things(house: House) -> None:
    async with house.cell() as puppet:
        await puppet.socket.send("x" * 10 * MAX_FRAME_BYTES)
        await puppet.socket.wait_closed()
        assert puppet.socket.close_code == 1002  # read, and no message


@pytest.mark.parametrize("frame", ['{"type": "ping", "at_ms": 1}', '{"type": "watch", "cells": []}', "{", b"\x00" * 9])
async def test_one_who_floods_from_all_their_seats_is_shown_out_and_others_are_served(
    house: House, rationed: Ration, frame: str | bytes
) -> None:
    async def flood() -> set[int]:
        """Say the same over and over, coming back when shown out, until there is no way back."""
        codes: set[int] = set()
        while NO_SEAT not in codes:
            async with signed_in(house, "auditor") as screen:
                reading = asyncio.create_task(screen.ended())
                with contextlib.suppress(ConnectionClosed):
                    while not reading.done():
                        await screen.socket.send(frame)
                        await asyncio.sleep(0)  # the server is in this very loop
                codes.add((await reading)[0])
        return codes

    async with signed_in(house) as operator:
        await operator.until_type("snapshot")
        async with asyncio.TaskGroup() as group:
            floods = [group.create_task(flood()) for _ in range(3)]
            for _ in range(3):
                await is_served(operator)
            (proposed,) = await propose(house)
            await operator.until(
                lambda message: any(one["id"] == proposed["id"] for one in message.get("invocations", []))
            )
        await is_served(operator)
    assert {code for flooding in floods for code in flooding.result()} == {NO_MESSAGE, NO_SEAT}


async def test_one_persons_consoles_share_one_ration(house: House, rationed: Ration) -> None:
    async with signed_in(house, "auditor") as one, signed_in(house, "auditor") as two, signed_in(house) as other:
        for screen in (one, two, other):
            await screen.until_type("snapshot")
        while rationed.take("auditor"):
            pass
        await two.say(type="ping", at_ms=1.0)
        code, reason = await two.ended()
        assert (code, reason) == (NO_MESSAGE, "`auditor` says more than 500 frames in 600 s")
        async with signed_in(house, "auditor") as again:
            assert (await again.ended())[0] == NO_SEAT
        await is_served(other)


async def test_all_seats_of_one_who_may_only_look_leave_seats_for_operators(house: House) -> None:
    async with AsyncExitStack() as stack:
        for _ in range(EACH_CONSOLES):
            screen = await stack.enter_async_context(signed_in(house, "auditor"))
            await screen.until_type("snapshot")
        async with signed_in(house, "auditor") as one_more:
            assert (await one_more.ended())[0] == NO_SEAT
        async with signed_in(house) as operator:
            await is_served(operator)


async def test_the_longest_standing_of_the_busiest_address_makes_room() -> None:
    step, left = Doorstep(code="too_many_streams", limit=3), list[str]()

    async def stand(name: str, address: str) -> None:
        try:
            async with step.stand(address, LONG_S):
                await asyncio.Event().wait()
        except Problem as problem:
            left.append(f"{name}: {problem.code}")

    tasks: list[asyncio.Task[None]] = []
    for name, address in [("operator", "here"), ("a", "there"), ("b", "there"), ("c", "there"), ("d", "there")]:
        tasks.append(asyncio.create_task(stand(name, address)))
        await asyncio.sleep(0)
    await eventually(lambda: left == ["a: too_many_streams", "b: too_many_streams"])
    assert step.standing == 3
    for task in tasks:
        task.cancel()
    await asyncio.wait(tasks)
    assert step.standing == 0


async def test_who_has_to_go_twice_goes_once() -> None:
    step = Doorstep(code="too_many_streams", limit=1)

    async def stand() -> str:
        try:
            async with step.stand("", 0.0):
                await asyncio.Event().wait()
        except (Problem, TimeoutError) as end:
            return type(end).__name__
        return ""

    assert await asyncio.gather(stand(), stand()) == ["Problem", "TimeoutError"]
    assert step.standing == 0


def test_a_ration_is_one_persons_and_comes_back() -> None:
    ration = Ration(most=10, within_s=LONG_S)
    assert [ration.take("auditor", 6), ration.take("auditor", 5), ration.take("auditor", 4)] == [True, False, True]
    assert ration.take("operator", 10)
    ration.within_s = 0.0
    assert ration.take("auditor", 10)


async def test_a_console_that_reads_nothing_is_ended_although_nothing_can_be_said_to_it_any_more(
    house: House, parts: Parts, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Outlet] = []

    def outlet() -> Outlet:
        made.append(Outlet())
        return made[-1]

    monkeypatch.setattr(console, "Outlet", outlet)
    address = urlsplit(house.url)
    reader, writer = await asyncio.open_connection(address.hostname, address.port, limit=1)  # reads no further
    bearer = f"Authorization: Bearer {house.tokens['operator']}"
    upgrade = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: "
    writer.write(f"GET {PATH} HTTP/1.1\r\nHost: x\r\n{bearer}\r\n{upgrade}{'A' * 22}==\r\n\r\n".encode())
    try:
        await eventually(lambda: parts.consoles.taken == 1)
        many = MAX_BEHIND_BYTES * 5 // 8  # more than the system takes for a peer that reads nothing
        before = made[0]._sent + made[0]._waiting
        made[0].say("x" * many)
        await eventually(lambda: made[0]._sent > before + many)  # a beat behind it, which waits for the socket
        made[0].say("z" * (MAX_BEHIND_BYTES // 2))
        assert made[0].ended is not None
        await eventually(lambda: parts.consoles.taken == 0)
    finally:
        writer.transport.abort()
    assert reader.at_eof() is False
