"""What consoles cost, and what a slow one gets, on a real server with one real cell.

Starts `reins serve` with one simulated cell and prints four figures:

- how much 20 consoles that watch it slow durable `POST /v1/invocations` of refused proposals (at most 15 %), and what
  of that is the server's own work for them;
- how many frames of poses reach each of them (at least 25 a second);
- what one more of them costs the server (at most 0.5 % of a core);
- what a console on a line of 20 kB/s gets beside a fast one: fewer frames, none older than 0.5 s, every event.

Consoles run in a process of their own. They acknowledge as a browser does, and come back for a snapshot as one does
where they fell behind; how often is printed. On a machine with few cores they take time from the server that browsers
elsewhere would not take: the server's own time for a proposal, poses for the consoles in it, is printed beside it.

    python benchmarks/bench_console.py [--rounds 5] [--seconds 3]
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import contextlib
import json
import os
import re
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from bench_post import BODY, drive, free_port, request_bytes, wait_until_up

CONSOLES = 20
SLOW_BYTES_S = 20_000
SLOW_S = 20.0
CELL = "workcell-1"
ROOT = Path(__file__).resolve().parents[1]
CREATED = b"http/1.1 201"
FELL_BEHIND = 4410
FRAMES_PER_ACK = 2
COMPRESSED = 0x40  # in a frame's first byte (RFC 7692)
HEAD = 200  # bytes of a message in which its kind and its beat stand
BEAT = re.compile(rb'\{"type":(?:"beat","n"|"update","seq":\d+,"beat"):(\d+)')


def handshake(port: int) -> bytes:
    key = base64.b64encode(os.urandom(16)).decode()
    return (
        f"GET /v1/console HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Protocol: reins.console.1\r\n"
        f"Sec-WebSocket-Extensions: permessage-deflate\r\n\r\n"  # as browsers do
    ).encode()


def text_frame(message: dict[str, object]) -> bytes:
    payload = json.dumps(message, separators=(",", ":")).encode()  # as browsers write it
    assert len(payload) < 65536
    size = bytes([0x80 | len(payload)]) if len(payload) < 126 else b"\xfe" + struct.pack(">H", len(payload))
    return b"\x81" + size + bytes(4) + payload  # masked with zeros


def inflate(payload: memoryview, at_most: int = 0) -> bytes:
    """Return a compressed message, whole or at most so many bytes; it refers to none before it."""
    reader = zlib.decompressobj(wbits=-15)
    return reader.decompress(payload, at_most) + (b"" if at_most else reader.decompress(b"\x00\x00\xff\xff"))


@dataclass
class Reader:
    """Takes a console's bytes apart; keeps figures, and says what is to be acknowledged."""

    token: str
    buffer: bytearray = field(default_factory=bytearray)
    greeted: bool = False
    snapshots: int = 0
    frames: int = 0
    ages_s: list[float] = field(default_factory=list)
    seqs: list[int] = field(default_factory=list)
    keep_events: bool = False
    closed: tuple[int, str] | None = None

    def feed(self, data: bytes) -> Iterator[bytes]:
        self.buffer += data
        if not self.greeted:
            end = self.buffer.find(b"\r\n\r\n")
            if end < 0:
                return
            assert self.buffer.startswith(b"HTTP/1.1 101"), bytes(self.buffer[:200])
            del self.buffer[: end + 4]
            self.greeted = True
            yield text_frame({"type": "hello", "token": self.token, "after": None})
            yield text_frame({"type": "watch", "cells": [CELL]})
        start = 0
        while (found := self._whole(start)) is not None:
            head, body, start = found
            yield from self._take(head, body, start)
        del self.buffer[:start]  # once for all that came: a console costs the server's machine little

    def _whole(self, start: int) -> tuple[int, int, int] | None:
        """Return the first byte of the frame that begins there, where its payload begins and where it ends."""
        buffer, body = self.buffer, start + 2
        if len(buffer) < body:
            return None
        size = buffer[start + 1]
        if size >= 126:
            form = ">H" if size == 126 else ">Q"
            body += struct.calcsize(form)
            if len(buffer) < body:
                return None
            size = struct.unpack_from(form, buffer, start + 2)[0]
        return None if len(buffer) < body + size else (buffer[start], body, body + size)

    def _take(self, head: int, body: int, end: int) -> Iterator[bytes]:
        opcode = head & 15
        if opcode == 8:
            code = struct.unpack_from(">H", self.buffer, body)[0] if end - body >= 2 else 1005
            self.closed = code, self.buffer[body + 2 : end].decode()
        elif opcode == 2:
            (cell, number), (at_s,) = (struct.unpack_from(form, self.buffer, body) for form in ("<4xH6xI", "<20xd"))
            self.frames += 1
            self.ages_s.append(time.time() - at_s)
            if self.frames % FRAMES_PER_ACK == 0:
                yield text_frame({"type": "ack", "cell": cell, "frame": number})
        else:
            text = memoryview(self.buffer)[body:end]
            # What the figures need stands at the beginning; a browser's work on the rest is done on its own machine.
            yield from self._text(inflate(text, 0 if self.keep_events else HEAD) if head & COMPRESSED else bytes(text))

    def _text(self, text: bytes) -> Iterator[bytes]:
        if beat := BEAT.match(text):
            yield text_frame({"type": "ack", "beat": int(beat[1])})
        self.snapshots += text.startswith(b'{"type":"snapshot"')
        if self.keep_events:
            self.seqs.extend(event["seq"] for event in json.loads(text).get("events", []))


class Console(asyncio.Protocol):
    """A fast console; where it fell behind it comes back for a snapshot."""

    def __init__(self, port: int, token: str) -> None:
        self.port, self.token = port, token
        self.reader = Reader(token)
        self.frames = self.returns = 0
        self.ended: str | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport
        self.transport.write(handshake(self.port))

    def data_received(self, data: bytes) -> None:
        before = self.reader.frames
        for answer in self.reader.feed(data):
            self.transport.write(answer)
        self.frames += self.reader.frames - before

    def connection_lost(self, error: Exception | None) -> None:
        if self.reader.closed is None or self.reader.closed[0] != FELL_BEHIND:
            self.ended = f"{self.reader.closed or error}"
            return
        self.returns += 1
        self.reader = Reader(self.token)
        self.coming = asyncio.ensure_future(
            asyncio.get_running_loop().create_connection(lambda: self, "127.0.0.1", self.port)
        )


async def keep_consoles(port: int, token: str, number: int) -> None:
    """Hold consoles open until standard input ends; say when all have their snapshot, then what they got."""
    loop = asyncio.get_running_loop()
    consoles = [
        (await loop.create_connection(lambda: Console(port, token), "127.0.0.1", port))[1] for _ in range(number)
    ]
    while not all(console.reader.snapshots and console.reader.frames for console in consoles):  # noqa: ASYNC110
        await asyncio.sleep(0.01)
    before = [console.frames for console in consoles]
    since_s = time.perf_counter()
    print("ready", flush=True)
    await asyncio.to_thread(sys.stdin.read)
    spent_s = time.perf_counter() - since_s
    ended = [console.ended for console in consoles if console.ended is not None]
    assert not ended, ended
    rates = [(console.frames - old) / spent_s for console, old in zip(consoles, before, strict=True)]
    returns = sum(console.returns for console in consoles)
    print(json.dumps({"slowest": min(rates), "median": statistics.median(rates), "returns": returns}), flush=True)


@contextlib.contextmanager
def consoles(port: int, token: str, number: int, found: list[dict[str, float]]) -> Iterator[None]:
    """Have consoles watch inside the context, in a process of their own; what they got is added to `found`."""
    words = [sys.executable, __file__, "--consoles", str(number), "--port", str(port)]
    process = subprocess.Popen(
        words, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={**os.environ, "BENCH_TOKEN": token}
    )
    assert process.stdin is not None
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n", "the consoles did not come in"
    try:
        yield
    finally:
        process.stdin.close()
        found.append(json.loads(process.stdout.readline()))
        process.wait(10)


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def post_slowdown(port: int, tokens: dict[str, str], pid: int, rounds: int, seconds: float) -> None:
    """Propose with and without consoles, round by round in turn: other work of the machine meets both alike."""
    import uvloop

    request = request_bytes("/v1/invocations", tokens["agent"])
    alone: list[tuple[float, float]] = []
    watched: list[tuple[float, float]] = []
    found: list[dict[str, float]] = []
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:

        def proposed() -> tuple[float, float]:
            """Return proposals a second, and the server's time for one, s."""
            before_s = cpu_s(pid)
            rate = runner.run(drive(port, request, seconds, CREATED))[0]
            return rate, (cpu_s(pid) - before_s) / (rate * seconds)

        proposed()
        for _ in range(rounds):
            alone.append(proposed())
            with consoles(port, tokens["operator"], CONSOLES, found):
                watched.append(proposed())
    rates, costs = ([one[place] for one in alone] for place in (0, 1))
    rates_watched, costs_watched = ([one[place] for one in watched] for place in (0, 1))
    slower = statistics.median(1 - b / a for a, b in zip(rates, rates_watched, strict=True))
    own_us, own_watched_us = (1e6 * statistics.median(one) for one in (costs, costs_watched))
    poses = statistics.median(one["slowest"] for one in found)
    print(f"POST /v1/invocations, refused, durable, 32 connections ({rounds} rounds of {seconds:.0f} s):")
    print(
        f"  alone {statistics.median(rates):.0f}/s, with {CONSOLES} consoles {statistics.median(rates_watched):.0f}/s"
    )
    print(f"  slower by {slower:.1%} (at most 15 %)")
    print(f"  server's own time for one: {own_us:.0f} us alone, {own_watched_us:.0f} us with consoles and their poses")
    print(f"  meanwhile {poses:.0f} frames/s of poses at the slowest console")
    print(f"  {sum(one['returns'] for one in found):.0f} times a console came back for a snapshot, over all rounds")


def poses_and_cost(port: int, tokens: dict[str, str], pid: int, seconds: float) -> None:
    spent: dict[int, float] = {}
    found: list[dict[str, float]] = []
    for number in (1, CONSOLES + 1):
        with consoles(port, tokens["operator"], number, found):
            time.sleep(0.5)
            before = cpu_s(pid)
            time.sleep(seconds)
            spent[number] = (cpu_s(pid) - before) / seconds
    each = (spent[CONSOLES + 1] - spent[1]) / CONSOLES
    print(f"poses of one watched cell, {CONSOLES + 1} consoles for {seconds:.0f} s:")
    print(f"  {found[1]['slowest']:.1f} frames/s at the slowest, {found[1]['median']:.1f} median (at least 25)")
    print(f"  server {spent[1]:.1%} of a core with one console, {each:.2%} for each further one (at most 0.5 %)")


def slow_console(port: int, tokens: dict[str, str]) -> None:
    """Read one console at 20 kB/s while a fast one watches too and proposals come in."""
    slow, stop = Reader(tokens["operator"], keep_events=True), threading.Event()
    taken = threading.Thread(target=read_slowly, args=(port, slow, stop))
    found: list[dict[str, float]] = []
    with consoles(port, tokens["operator_2"], 1, found):
        taken.start()
        wait_for(lambda: slow.snapshots, "the slow console's snapshot")
        since_s, frames, ages = time.perf_counter(), slow.frames, len(slow.ages_s)
        first = slow.seqs[-1]
        while time.perf_counter() - since_s < SLOW_S:
            propose(port, tokens["agent"])
            time.sleep(0.5)
        spent_s = time.perf_counter() - since_s
        rate, ages_s = (slow.frames - frames) / spent_s, slow.ages_s[ages:]
        last = propose(port, tokens["agent"])
        wait_for(lambda: slow.seqs[-1] >= last, "the last event")
    stop.set()
    taken.join()
    lost = [seq for seq in range(slow.seqs[0], slow.seqs[-1] + 1) if seq not in set(slow.seqs)]
    doubled = len(slow.seqs) - len(set(slow.seqs))
    print(f"a console at {SLOW_BYTES_S / 1000:.0f} kB/s beside a fast one, {SLOW_S:.0f} s with 2 proposals a second:")
    print(f"  {rate:.1f} frames/s, the fast one {found[0]['slowest']:.1f} (fewer, and at least 25)")
    print(f"  oldest frame {max(ages_s):.2f} s, median {statistics.median(ages_s):.2f} s (none over 0.5 s)")
    print(f"  {slow.seqs[-1] - first} events while it watched, {len(lost)} lost, {doubled} doubled (none)")


def read_slowly(port: int, reader: Reader, stop: threading.Event) -> None:
    line = socket.socket()
    line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    line.connect(("127.0.0.1", port))
    line.sendall(handshake(port))
    with line:
        due_s = time.perf_counter()
        while not stop.is_set():
            data = line.recv(500)
            for answer in reader.feed(data):
                line.sendall(answer)
            assert reader.closed is None, reader.closed
            due_s = max(due_s + len(data) / SLOW_BYTES_S, time.perf_counter() - 0.05)
            time.sleep(max(0.0, due_s - time.perf_counter()))


def propose(port: int, token: str) -> int:
    """Propose what is refused; return the last event's place."""
    headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
    base = f"http://127.0.0.1:{port}"
    with urllib.request.urlopen(urllib.request.Request(f"{base}/v1/invocations", BODY, headers)) as answer:  # noqa: S310
        made = json.load(answer)["id"]
    with urllib.request.urlopen(  # noqa: S310
        urllib.request.Request(f"{base}/v1/invocations/{made}/trace", headers=headers)  # noqa: S310
    ) as answer:
        return json.load(answer)["items"][-1]["seq"]


def wait_for(condition, what: str) -> None:
    deadline_s = time.perf_counter() + 60
    while not condition():
        assert time.perf_counter() < deadline_s, f"never came: {what}"
        time.sleep(0.02)


def bench(rounds: int, seconds: float) -> None:
    with tempfile.TemporaryDirectory() as folder:
        port = free_port()
        serve = [sys.executable, "-m", "app.cli", "serve", "--port", str(port), "--data", folder, "--cells", "1"]
        serve += ["--no-prove"]  # measured is serving alone
        server = subprocess.Popen(serve, cwd=ROOT, stdout=subprocess.DEVNULL)
        try:
            wait_until_up(port, "/readyz", server)
            tokens = json.loads((Path(folder) / "tokens.json").read_text())
            poses_and_cost(port, tokens, server.pid, 10.0)
            slow_console(port, tokens)
            post_slowdown(port, tokens, server.pid, rounds, seconds)
        finally:
            server.terminate()
            server.wait(10)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--consoles", type=int, metavar="N", help="only hold so many consoles open, for a parent")
    parser.add_argument("--port", type=int)
    chosen = parser.parse_args()
    if chosen.consoles is not None:
        import uvloop

        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(keep_consoles(chosen.port, os.environ["BENCH_TOKEN"], chosen.consoles))
    else:
        bench(chosen.rounds, chosen.seconds)


if __name__ == "__main__":
    main()
