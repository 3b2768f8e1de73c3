from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator
from typing import Any, cast

import pytest
import uvicorn

from app.api.exchange import HEAD_BYTES, Answer, Exchanges
from tests.api.conftest import Door, eventually

pytestmark = pytest.mark.anyio

END = b"\r\n\r\n"


class Written:
    """A transport that keeps what is written."""

    def __init__(self) -> None:
        self.writes: list[bytes] = []
        self.closed = False

    def write(self, data: bytes) -> None:
        assert not self.closed
        self.writes.append(data)

    def is_closing(self) -> bool:
        return self.closed

    def close(self) -> None:
        self.closed = True


def answer_on(transport: Written) -> Answer:
    return Answer(cast("asyncio.Transport", transport), asyncio.get_running_loop())


async def turn() -> None:
    """Let the event loop come round."""
    done = asyncio.Event()
    asyncio.get_running_loop().call_soon(done.set)
    await done.wait()


async def test_a_head_and_the_body_behind_it_leave_as_one() -> None:
    transport = Written()
    answer = answer_on(transport)
    answer.write(b"head")
    answer.write(b"body")
    answer.write(b"more")
    await turn()
    assert transport.writes == [b"headbody", b"more"]


async def test_a_head_waits_no_longer_than_for_the_loop_to_come_round() -> None:
    transport = Written()
    answer = answer_on(transport)
    answer.write(b"head")
    assert transport.writes == []
    await turn()
    answer.write(b"body")
    assert transport.writes == [b"head", b"body"]


async def test_closing_writes_the_head_first() -> None:
    transport = Written()
    answer = answer_on(transport)
    answer.write(b"head")
    answer.close()
    await turn()
    assert transport.writes == [b"head"]
    assert answer.is_closing()


async def test_nothing_is_written_into_a_connection_that_is_gone() -> None:
    transport = Written()
    answer_on(transport).write(b"head")
    transport.close()
    await turn()
    assert transport.writes == []


class Site:
    """A small application: answers at once, before it is asked, or begins a stream and goes on when it is let."""

    def __init__(self) -> None:
        self.go_on = asyncio.Event()

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "lifespan":
            for _ in range(2):
                await send({"type": (await receive())["type"] + ".complete"})
            return
        if scope["path"] == "/early":
            await send({"type": "http.response.start", "status": 200, "headers": []})
        body = b""
        while (message := await receive())["type"] == "http.request":
            body += message["body"]
            if not message["more_body"]:
                break
        if scope["path"] == "/early":
            return
        streams = scope["path"] == "/stream"
        headers = [] if streams else [(b"content-length", b"%d" % len(body))]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        if streams:
            await self.go_on.wait()
        await send({"type": "http.response.body", "body": body or b"late" if streams else body})


@contextlib.asynccontextmanager
async def served(site: Site) -> AsyncGenerator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    """Connect to a server of its own."""
    server = Door(uvicorn.Config(site, port=0, log_level="warning", http=Exchanges))
    serving = asyncio.create_task(server.serve())
    await eventually(lambda: server.started)
    reader, writer = await asyncio.open_connection(*server.servers[0].sockets[0].getsockname()[:2])
    try:
        async with asyncio.timeout(10):
            yield reader, writer
    finally:
        writer.close()
        server.should_exit = True
        await serving


def request(method: str, path: str, body: bytes = b"", *headers: str) -> bytes:
    lines = [f"{method} {path} HTTP/1.1", "Host: here", f"Content-Length: {len(body)}", *headers]
    return "\r\n".join(lines).encode() + END + body


async def test_a_stream_begins_before_it_has_anything_to_say() -> None:
    site = Site()
    async with served(site) as (reader, writer):
        writer.write(request("GET", "/stream"))
        assert (await reader.readuntil(END)).startswith(b"HTTP/1.1 200")
        site.go_on.set()
        assert await reader.readuntil(b"0" + END) == b"4\r\nlate\r\n0" + END


async def test_requests_sent_in_one_go_are_answered_in_order() -> None:
    async with served(Site()) as (reader, writer):
        writer.write(request("POST", "/", b"first") + request("POST", "/", b"second"))
        for body in (b"first", b"second"):
            await reader.readuntil(END)
            assert await reader.readexactly(len(body)) == body


async def test_whoever_asks_before_sending_a_body_is_told_to_go_on() -> None:
    async with served(Site()) as (reader, writer):
        writer.write(request("POST", "/", b"body", "Expect: 100-continue").removesuffix(b"body"))
        assert await reader.readuntil(END) == b"HTTP/1.1 100 Continue" + END
        writer.write(b"body")
        assert (await reader.readuntil(END)).startswith(b"HTTP/1.1 200")
        assert await reader.readexactly(4) == b"body"


@pytest.mark.parametrize("method", ["HEAD", "POST"])
async def test_a_last_answer_is_whole_before_the_connection_ends(method: str) -> None:
    async with served(Site()) as (reader, writer):
        writer.write(request(method, "/", b"body", "Connection: close"))
        head, _, body = (await reader.read()).partition(END)
        assert head.startswith(b"HTTP/1.1 200")
        assert body == (b"" if method == "HEAD" else b"body")


async def test_what_came_whole_is_answered_before_what_is_no_http_ends_the_connection() -> None:
    async with served(Site()) as (reader, writer):
        writer.write(request("POST", "/", b"first") + request("POST", "/", b"second") + b"no request" + END)
        for body in (b"first", b"second"):
            assert (await reader.readuntil(END)).startswith(b"HTTP/1.1 200")
            assert await reader.readexactly(len(body)) == body
        assert await reader.read() == b""


async def test_a_body_that_is_none_does_not_end_a_stream_with_a_second_answer() -> None:
    site = Site()
    async with served(site) as (reader, writer):
        writer.write(b"POST /early HTTP/1.1\r\nHost: here\r\nTransfer-Encoding: chunked" + END)
        await reader.readuntil(END)
        writer.write(b"no chunk" + END)
        assert b"HTTP/1.1" not in await reader.read()


@pytest.mark.parametrize(
    "begun",
    [b"GET / HTTP/1.1\r\nHost: here\r\nX: ", b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked" + END + b"0\r\nX: "],
    ids=["a header field", "a field behind a body"],
)
async def test_what_has_no_end_is_not_kept_without_one(begun: bytes) -> None:
    async with served(Site()) as (reader, writer):
        writer.write(request("POST", "/", b"first") + begun)
        await reader.readuntil(END)
        assert await reader.readexactly(5) == b"first"  # and the beginning of the next one was read with it
        writer.write(b"y" * (HEAD_BYTES + 1))
        head, _, problem = (await reader.read()).partition(END)
        assert head.startswith(b"HTTP/1.1 431")
        assert b"head_too_large" in problem


async def test_a_large_body_is_no_large_head() -> None:
    async with served(Site()) as (reader, writer):
        writer.write(request("POST", "/", b"x" * 3 * HEAD_BYTES) + request("POST", "/", b"next"))
        for size in (3 * HEAD_BYTES, 4):
            assert (await reader.readuntil(END)).startswith(b"HTTP/1.1 200")
            await reader.readexactly(size)
