"""Streams and links of somebody who was let in, and would not be any more."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from itertools import chain, repeat
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

import pytest

from app import clock
from app.api import access, audits, links, staying
from app.api.access import authorize
from app.api.auth import issue_token
from app.governance.model import Role
from tests.api.conftest import CELL, House, eventually
from tests.api.test_operators import ask

pytestmark = pytest.mark.anyio
PATIENCE_S = 30.0
HOUR_S = 3600.0
ENDS = ["withdrawn", "expired"]


@asynccontextmanager
async def ending(house: House, monkeypatch: pytest.MonkeyPatch, how: str, name: str) -> AsyncIterator[None]:
    """Have a token withdrawn, or its hour over, meanwhile."""
    if how == "withdrawn":
        async with house.withdrawn(name):
            yield
        return
    later_s = clock.wall_s() + HOUR_S
    with monkeypatch.context() as patched:
        patched.setattr(clock, "wall_s", lambda: later_s)
        yield


async def visited(house: House, name: str, role: Role) -> House:
    """Return the house with a token in it that holds for an hour."""
    token = issue_token(house.folder, name=name, role=role, ttl_s=HOUR_S)
    opened = replace(house, tokens={**house.tokens, name: token}, cell_token=token)
    await eventually(lambda: opened.knows(name))
    return opened


@pytest.mark.parametrize("how", ENDS)
async def test_a_stream_ends_with_its_token(house: House, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    name = f"visitor-{how}"
    visited_house = await visited(house, name, Role.AUDITOR)
    async with (
        visited_house.client(name) as visitor,
        visitor.stream("GET", "/v1/events?after=0") as answer,
        asyncio.timeout(PATIENCE_S),
    ):
        lines = answer.aiter_lines()
        while not (await anext(lines)).startswith("data: "):
            pass
        async with ending(visited_house, monkeypatch, how, name):
            async for _ in lines:
                pass  # to its end: the answer is whole
            refused = await visitor.get("/v1/events")
            assert (refused.status_code, refused.json()["code"]) in {(401, "token_invalid"), (401, "token_expired")}
    await eventually(lambda: not house.app.state.parts.streams.taken)


async def test_a_stream_that_nobody_reads_is_cut_with_its_token(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    said = chain([b": " + b"x" * 16_000_000 + b"\n\n"], repeat(b":\n\n"))  # more than any socket holds, and once
    monkeypatch.setattr(audits, "as_sse", lambda _: next(said))
    monkeypatch.setattr(audits, "LEAVE_S", 0.1)
    name = "visitor-who-sleeps"
    visited_house = await visited(house, name, Role.AUDITOR)
    address, streams = urlsplit(house.url), house.app.state.parts.streams
    _, writer = await asyncio.open_connection(address.hostname, address.port, limit=1)  # reads no further
    bearer = f"Authorization: Bearer {visited_house.tokens[name]}"
    writer.write(f"GET /v1/events?after=0 HTTP/1.1\r\nHost: x\r\n{bearer}\r\n\r\n".encode())
    try:
        await eventually(lambda: streams.taken == 1)
        async with visited_house.withdrawn(name):
            await eventually(lambda: streams.taken == 0)
    finally:
        writer.transport.abort()


@pytest.mark.parametrize("how", ENDS)
async def test_a_link_is_shut_with_its_token(house: House, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    visited_house = await visited(house, "cell", Role.CELL)
    async with visited_house.cell() as puppet:
        place = house.runtime.fleet.cell(CELL)
        async with ending(visited_house, monkeypatch, how, "cell"), asyncio.timeout(PATIENCE_S):
            await puppet.socket.wait_closed()
            assert puppet.socket.close_code == 4401
            assert "token" in (puppet.socket.close_reason or "")
            await eventually(lambda: not house.runtime.fleet.attached(place))
            async with house.client() as agent:
                drive = {"capability": "navigate_to", "params": {"target": "dock"}}
                answer = (await agent.post("/v1/invocations", json=drive)).json()
            assert answer["status"] == "deferred"
            assert puppet.launches == []


def counting(monkeypatch: pytest.MonkeyPatch, door: ModuleType) -> list[object]:
    """Have who stays asked a hundred times a second; returns who was let in, each time."""
    found: list[object] = []

    def counted(*given: Any) -> object:
        found.append(authorize(*given))
        return found[-1]

    monkeypatch.setattr(door, "authorize", counted)
    monkeypatch.setattr(staying, "STILL_KNOWN_S", 0.01)
    return found


async def test_a_stream_goes_on_while_its_token_counts(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = counting(monkeypatch, audits)
    async with house.client("auditor") as auditor, auditor.stream("GET", "/v1/events") as answer:
        lines = answer.aiter_lines()
        assert (await anext(lines)).startswith("retry")
        await eventually(lambda: len(asked) > 20)
        async with house.client() as agent:
            name = (await agent.post("/v1/invocations", json={"capability": "fly_to"})).json()["id"]
        async with asyncio.timeout(PATIENCE_S):
            while name not in await anext(lines):
                pass


async def test_a_link_stays_while_its_token_counts(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = counting(monkeypatch, links)
    async with house.cell() as puppet:
        await eventually(lambda: len(asked) > 20)
        assert house.runtime.fleet.attached(house.runtime.fleet.cell(CELL))
        assert puppet.socket.close_code is None


@asynccontextmanager
async def dragging(house: House, name: str, path: str, body: bytes) -> AsyncIterator[Callable[[], Awaitable[bytes]]]:
    """Have somebody let in who keeps the last byte of a body back; yields what says it, and returns the answer."""
    address = urlsplit(house.url)
    reader, writer = await asyncio.open_connection(address.hostname, address.port)
    head = f"PUT {path} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {house.tokens[name]}\r\n"
    writer.write(f"{head}Content-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode() + body[:-1])

    async def end() -> bytes:
        writer.write(body[-1:])
        return await reader.read()

    try:
        yield end
    finally:
        writer.transport.abort()


@pytest.mark.parametrize("how", ENDS)
async def test_who_drags_out_what_they_say_says_it_with_a_token_that_still_counts(
    house: House, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    monkeypatch.setattr(access, "STILL_KNOWN_S", 0.0)  # or whoever says it within a second is believed
    name = f"dragging-{how}"
    visited_house = await visited(house, name, Role.OPERATOR)
    heard = house.runtime.kernel.heard
    let_in = asyncio.Event()
    monkeypatch.setattr(house.runtime.kernel, "heard", lambda who: (heard(who), who.name == name and let_in.set()))
    async with house.cell(), house.client("auditor") as auditor, asyncio.timeout(PATIENCE_S):
        before = house.runtime.fleet.cell(CELL).profile
        body = b'{"profile": "sim-relaxed"}'
        path = f"/v1/cells/{CELL}/profile"
        async with dragging(visited_house, name, path, body) as end:
            await let_in.wait()
            async with ending(visited_house, monkeypatch, how, name):
                await eventually(lambda: not visited_house.knows(name))
                assert b" 401 " in await end()
        (found,) = (await auditor.get("/v1/cells")).json()["items"]
        assert found["profile"] == before


@pytest.mark.parametrize("how", ENDS)
async def test_who_waits_is_answered_while_their_token_counts(
    shared_house: House, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    monkeypatch.setattr(access, "STILL_KNOWN_S", 0.0)
    name = f"waiting-{how}"
    visited_house, waits = await visited(shared_house, name, Role.AUDITOR), shared_house.app.state.parts.waits
    async with shared_house.cell(), shared_house.client() as agent, visited_house.client(name) as visitor:
        asked = (await ask(shared_house))["invocation"]
        waiting = asyncio.create_task(visitor.get(f"/v1/invocations/{asked}?wait=30"))
        await eventually(lambda: waits.taken == 1)
        async with ending(visited_house, monkeypatch, how, name):
            await eventually(lambda: not visited_house.knows(name))
            await agent.post(f"/v1/invocations/{asked}/cancel")
            assert (await waiting).status_code == 401


async def test_no_websocket_is_opened_where_something_else_is_still_being_answered(house: House) -> None:
    address, streams = urlsplit(house.url), house.app.state.parts.streams
    reader, writer = await asyncio.open_connection(address.hostname, address.port)
    head = f"HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {house.token('operator')}\r\n"
    wish = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    async with asyncio.timeout(PATIENCE_S):
        writer.write(f"GET /v1/events {head}\r\n".encode())
        await eventually(lambda: streams.taken)
        writer.write(f"GET /v1/console {head}{wish}Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode())
        answers = await reader.read()
    assert b"\r\n0\r\n\r\nHTTP/1.1 404" in answers  # as if it had not wished for one
    writer.close()
    await eventually(lambda: not streams.taken)


@pytest.mark.parametrize("waited_for", ["/v1/events", "/v1/invocations/{id}?wait=60"])
@pytest.mark.parametrize("goes", [True, False], ids=["goes", "stays"])
async def test_what_restrains_does_not_wait_for_what_was_waited_for_before_it(
    shared_house: House, waited_for: str, goes: bool
) -> None:
    address, parts = urlsplit(shared_house.url), shared_house.app.state.parts
    async with shared_house.cell(), asyncio.timeout(PATIENCE_S):
        asked = (await ask(shared_house))["invocation"]
        reader, writer = await asyncio.open_connection(address.hostname, address.port)
        head = f"HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {shared_house.token('operator')}\r\n"
        writer.write(f"GET {waited_for.format(id=asked)} {head}\r\n".encode())
        if not goes:
            await eventually(lambda: parts.streams.taken + parts.waits.taken)
        writer.write(f"POST /v1/invocations/{asked}/cancel {head}Content-Length: 0\r\n\r\n".encode())
        if goes:
            writer.close()
        await eventually(lambda: shared_house.runtime.register.newest(asked) is None)
        await eventually(lambda: not parts.streams.taken + parts.waits.taken)
        if not goes:
            await reader.readuntil(b"HTTP/1.1 200")
            await reader.readuntil(b"HTTP/1.1 200")
            writer.close()
