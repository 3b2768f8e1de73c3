from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator
from typing import Any, TypeAlias, cast
from urllib.parse import urlsplit

import pytest
import uvicorn
from websockets.asyncio.client import connect

from app.api import exchange
from app.api.exchange import HEAD_BYTES, Answer, Exchanges
from tests.api.conftest import Door, House, eventually

pytestmark = pytest.mark.anyio

Visit: TypeAlias = tuple[asyncio.StreamReader, asyncio.StreamWriter]

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
        self.ended = ""

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "lifespan" or scope["path"] == "/long":
            await (self.live if scope["type"] == "lifespan" else self.drown)(receive, send)
            return
        if scope["path"] == "/refused":
            await send({"type": "http.response.start", "status": 401, "headers": [(b"content-length", b"0")]})
            await send({"type": "http.response.body", "body": b""})
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

    async def drown(self, receive: Any, send: Any) -> None:
        """Send more than any system takes for a peer that reads nothing."""
        await send({"type": "http.response.start", "status": 200, "headers": []})
        for _ in range(2):
            await send({"type": "http.response.body", "body": b"x" * 16_000_000, "more_body": True})
        while (message := await receive())["type"] == "http.request":
            pass
        self.ended = message["type"]

    async def live(self, receive: Any, send: Any) -> None:
        for _ in range(2):
            await send({"type": (await receive())["type"] + ".complete"})


class Hasty(Exchanges):
    """Has little time for who lets others wait."""

    look_s = 0.02


@contextlib.asynccontextmanager
async def served(
    site: Site, http: type[Exchanges] = Exchanges
) -> AsyncGenerator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    """Connect to a server of its own."""
    server = Door(uvicorn.Config(site, port=0, log_level="warning", http=http))
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


async def test_whoever_takes_nothing_of_a_long_answer_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exchange, "MOST_STUCK", 10)
    site = Site()
    async with served(site, Hasty) as (reader, writer):
        writer.transport.pause_reading()
        writer.write(request("GET", "/long"))
        await eventually(lambda: site.ended == "http.disconnect")
        assert not reader.at_eof()


@pytest.mark.parametrize("hosts", ["", "Host: a\r\nHost: b\r\n"])
async def test_who_does_not_say_once_which_host_is_meant_is_refused(hosts: str) -> None:
    async with served(Site()) as (reader, writer):
        writer.write(f"GET / HTTP/1.1\r\n{hosts}\r\n".encode())
        answer = (await reader.read()).decode()
    assert answer.startswith("HTTP/1.1 400")
    assert "`Host` is given never, or twice; valid: once" in answer


async def test_http_1_0_knows_no_host() -> None:
    async with served(Site()) as (reader, writer):
        writer.write(b"GET / HTTP/1.0" + END)
        assert (await reader.read()).startswith(b"HTTP/1.1 200")


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
    [
        b"GET / HTTP/1.1\r\nHost: here\r\nX: ",
        b"POST / HTTP/1.1\r\nHost: here\r\nTransfer-Encoding: chunked" + END + b"0\r\nX: ",
    ],
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


# -- who lets others wait --------------------------------------------------------------------------------------------

BODY_TO_COME = b"POST / HTTP/1.1\r\nHost: here\r\nContent-Length: 100" + END


@contextlib.asynccontextmanager
async def dripping(writer: asyncio.StreamWriter, what: bytes) -> AsyncGenerator[None]:
    """Send something again and again, as long as the connection takes it."""

    async def drip() -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                writer.write(what)
                await writer.drain()
                await asyncio.sleep(Hasty.look_s / 2)

    dropping = asyncio.create_task(drip())
    try:
        yield
    finally:
        dropping.cancel()
        await asyncio.wait({dropping})


async def until_a_silent_one_was_cut_off(writer: asyncio.StreamWriter) -> None:
    """Wait for as long as nobody may let others wait, twice."""
    for _ in range(2):
        reader, silent = await asyncio.open_connection(*writer.get_extra_info("peername")[:2])
        assert await reader.read() == b""
        silent.close()


@pytest.mark.parametrize("begun", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: here\r\nX: "])
@pytest.mark.parametrize("first", [b"", request("POST", "/", b"first")], ids=["at once", "behind another"])
async def test_who_does_not_end_a_head_is_cut_off(first: bytes, begun: bytes) -> None:
    async with served(Site(), Hasty) as (reader, writer):
        if first:
            writer.write(first)
            await reader.readuntil(END)
            assert await reader.readexactly(5) == b"first"
        writer.write(begun or (b"\r\n" if first else b""))
        assert await reader.read() == b""


async def test_a_head_that_drips_is_cut_off_as_well() -> None:
    async with served(Site(), Hasty) as (reader, writer):
        writer.write(b"GET / HTTP/1.1\r\nX: ")
        async with dripping(writer, b"y"):
            with contextlib.suppress(ConnectionResetError):  # what was sent last found nobody
                assert await reader.read() == b""


async def test_a_body_that_stops_coming_is_refused() -> None:
    async with served(Site(), Hasty) as (reader, writer):
        writer.write(BODY_TO_COME + b"be")
        head, _, problem = (await reader.read()).partition(END)
    assert head.startswith(b"HTTP/1.1 408")
    assert b"connection: close" in head
    assert b"body_late" in problem


async def test_a_body_that_stops_coming_ends_an_answer_that_has_begun() -> None:
    async with served(Site(), Hasty) as (reader, writer):
        writer.write(BODY_TO_COME.replace(b"/ ", b"/early ", 1))
        assert (await reader.read()).count(b"HTTP/1.1 ") == 1


async def test_nobody_is_waited_for_who_drips_a_body_behind_its_answer() -> None:
    async with served(Site(), Hasty) as (reader, writer):
        writer.write(BODY_TO_COME.replace(b"/ ", b"/refused ", 1).replace(b"100", b"1000000"))
        assert (await reader.readuntil(END)).startswith(b"HTTP/1.1 401")
        async with dripping(writer, b"y"):
            with contextlib.suppress(ConnectionResetError):
                assert await reader.read() == b""


async def test_who_is_cut_off_keeps_nothing_open_by_not_reading() -> None:
    size = 32 * 1024 * 1024  # more than the sockets hold
    async with served(Site(), Hasty) as (reader, writer):
        writer.write(request("POST", "/", bytes(size)) + b"GET / HT")
        assert (await reader.readuntil(END)).startswith(b"HTTP/1.1 200")
        await until_a_silent_one_was_cut_off(writer)
        with contextlib.suppress(ConnectionResetError):
            assert len(await reader.read()) < size


async def test_a_body_that_comes_slowly_is_waited_for() -> None:
    async with served(Site(), Hasty) as (reader, writer):
        writer.write(b"POST / HTTP/1.1\r\nHost: here\r\nTransfer-Encoding: chunked" + END)
        async with dripping(writer, b"1\r\ny\r\n"):
            await until_a_silent_one_was_cut_off(writer)
        writer.write(b"0" + END)
        assert (await reader.readuntil(END)).startswith(b"HTTP/1.1 200")


async def test_an_answer_takes_its_time_whatever_has_come_of_the_next_request() -> None:
    site = Site()
    async with served(site, Hasty) as (reader, writer):
        writer.write(request("GET", "/stream") + b"GET / HT")
        await until_a_silent_one_was_cut_off(writer)
        site.go_on.set()
        assert (await reader.readuntil(END)).startswith(b"HTTP/1.1 200")
        assert await reader.readuntil(b"0" + END) == b"4\r\nlate\r\n0" + END
        writer.write(b"TP/1.1\r\nHost: here" + END)
        assert (await reader.readuntil(END)).startswith(b"HTTP/1.1 200")


async def test_a_connection_may_rest_between_requests() -> None:
    async with served(Site(), Hasty) as (reader, writer):
        for _ in range(2):
            writer.write(request("POST", "/", b"body"))
            assert (await reader.readuntil(END)).startswith(b"HTTP/1.1 200")
            assert await reader.readexactly(4) == b"body"
            await until_a_silent_one_was_cut_off(writer)


async def test_a_websocket_may_be_silent(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Exchanges, "look_s", Hasty.look_s)
    url = urlsplit(house.url)
    headers = {"Authorization": f"Bearer {house.tokens['operator']}"}
    async with connect(f"ws://{url.netloc}/v1/console", additional_headers=headers, proxy=None) as console:
        for _ in range(2):
            reader, silent = await asyncio.open_connection(url.hostname, url.port)
            assert await reader.read() == b""
            silent.close()
        await (await console.ping())


# -- where there is no room ------------------------------------------------------------------------------------------


class Crowded(Exchanges):
    """Has room for few."""

    most = 8


@contextlib.asynccontextmanager
async def crowd(writer: asyncio.StreamWriter, size: int) -> AsyncGenerator[list[Visit]]:
    """Connect so many times more to whom somebody is connected to."""
    came = [await asyncio.open_connection(*writer.get_extra_info("peername")[:2]) for _ in range(size)]
    try:
        yield came
    finally:
        for _, one in came:
            one.close()


async def answered(visit: Visit, asked: bytes = request("POST", "/")) -> bool:
    """Say whether a connection answers, and is not cut off instead."""
    reader, writer = visit
    with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
        writer.write(asked)
        return (await reader.readuntil(END)).startswith(b"HTTP/1.1 200")
    return False


async def test_who_comes_where_there_is_no_room_takes_the_place_of_who_lets_others_wait_for_longest() -> None:
    site = Site()
    async with served(site, Crowded) as (reader, writer), crowd(writer, 1) as (resting,):
        assert await answered((reader, writer), request("GET", "/stream"))
        assert await answered(resting)
        async with crowd(writer, 20) as silent:
            for _, one in silent:
                one.write(b"GET / HT")
            async with crowd(writer, 1) as (newcomer,):
                assert await answered(newcomer)
            rest = b"TP/1.1\r\nHost: here" + END
            stayed = [await answered(one, rest) for one in silent]
        assert stayed == sorted(stayed), "the oldest went first"
        assert not stayed[0]
        assert stayed[-1]
        assert await answered(resting)
        site.go_on.set()
        assert await reader.readuntil(b"0" + END) == b"4\r\nlate\r\n0" + END


async def test_where_all_rest_who_comes_takes_the_place_of_the_oldest() -> None:
    async with served(Site(), Crowded) as first, contextlib.AsyncExitStack() as came:
        visits = [first]
        for _ in range(12):
            assert await answered(visits[-1])
            visits += await came.enter_async_context(crowd(first[1], 1))
        assert await answered(visits[-1])
        assert not await answered(first)


async def test_who_is_still_sent_an_answer_makes_no_room() -> None:
    size = 32 * 1024 * 1024  # more than the sockets hold
    async with served(Site(), Crowded) as (reader, writer), contextlib.AsyncExitStack() as came:
        writer.write(request("POST", "/", bytes(size)))
        assert (await reader.readuntil(END)).startswith(b"HTTP/1.1 200")
        visits = []
        for _ in range(12):
            visits += await came.enter_async_context(crowd(writer, 1))
            assert await answered(visits[-1])
        assert not await answered(visits[0])
        assert len(await reader.readexactly(size)) == size
