"""What consoles cost, and what a slow one gets, on a real server with one real cell.

Starts `reins serve` with one simulated cell and prints four figures:

- how much 20 consoles that watch it slow durable `POST /v1/invocations` of refused proposals (at most 15 %);
- how many frames of poses reach each of them (at least 25 a second);
- what one more of them costs the server (at most 0.5 % of a core);
- what a console on a line of 20 kB/s gets beside a fast one: fewer frames, none older than 0.5 s, every event.

Consoles run in a process of their own and acknowledge as a browser does. On a machine with few cores they take time
from the server that browsers elsewhere would not take.

    python benchmarks/bench_console.py [--rounds 5] [--seconds 3]
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import contextlib
import json
import os
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
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


def handshake(port: int) -> bytes:
    key = base64.b64encode(os.urandom(16)).decode()
    return (
        f"GET /v1/console HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Protocol: reins.console.1\r\n\r\n"
    ).encode()


def text_frame(message: dict[str, object]) -> bytes:
    payload = json.dumps(message).encode()
    assert len(payload) < 65536
    size = bytes([0x80 | len(payload)]) if len(payload) < 126 else b"\xfe" + struct.pack(">H", len(payload))
    return b"\x81" + size + bytes(4) + payload  # masked with zeros


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
    closed: str = ""

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
        while (frame := self._cut()) is not None:
            opcode, payload = frame
            if opcode == 8:
                self.closed = payload[2:].decode() or "closed"
            elif opcode == 2:
                cell, number, at_s = *struct.unpack_from("<4xH6xI", payload), struct.unpack_from("<d", payload, 20)[0]
                self.frames += 1
                self.ages_s.append(time.time() - at_s)
                yield text_frame({"type": "ack", "cell": cell, "frame": number})
            else:
                yield from self._text(payload)

    def _cut(self) -> tuple[int, bytes] | None:
        buffer = self.buffer
        if len(buffer) < 2:
            return None
        size, start = buffer[1], 2
        if size == 126:
            if len(buffer) < 4:
                return None
            size, start = struct.unpack_from(">H", buffer, 2)[0], 4
        elif size == 127:
            if len(buffer) < 10:
                return None
            size, start = struct.unpack_from(">Q", buffer, 2)[0], 10
        if len(buffer) < start + size:
            return None
        opcode, payload = buffer[0] & 15, bytes(buffer[start : start + size])
        del buffer[: start + size]
        return opcode, payload

    def _text(self, payload: bytes) -> Iterator[bytes]:
        if payload.startswith(b'{"type":"beat"'):
            yield text_frame({"type": "ack", "beat": json.loads(payload)["n"]})
            return
        self.snapshots += payload.startswith(b'{"type":"snapshot"')
        if self.keep_events:
            self.seqs.extend(event["seq"] for event in json.loads(payload).get("events", []))


class Console(asyncio.Protocol):
    """A fast console."""

    def __init__(self, port: int, token: str) -> None:
        self.port, self.reader = port, Reader(token)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport
        self.transport.write(handshake(self.port))

    def data_received(self, data: bytes) -> None:
        for answer in self.reader.feed(data):
            self.transport.write(answer)


async def keep_consoles(port: int, token: str, number: int) -> None:
    """Hold consoles open until standard input ends; say when all have their snapshot, then what they got."""
    loop = asyncio.get_running_loop()
    consoles = [
        (await loop.create_connection(lambda: Console(port, token), "127.0.0.1", port))[1] for _ in range(number)
    ]
    while not all(console.reader.snapshots and console.reader.frames for console in consoles):  # noqa: ASYNC110
        await asyncio.sleep(0.01)
    for console in consoles:
        console.reader.frames = 0
    since_s = time.perf_counter()
    print("ready", flush=True)
    await asyncio.to_thread(sys.stdin.read)
    spent_s = time.perf_counter() - since_s
    assert not any(console.reader.closed for console in consoles), [console.reader.closed for console in consoles]
    rates = [console.reader.frames / spent_s for console in consoles]
    print(json.dumps({"slowest": min(rates), "median": statistics.median(rates)}), flush=True)


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


def post_slowdown(port: int, tokens: dict[str, str], rounds: int, seconds: float, *, watching: int) -> None:
    import uvloop

    request = request_bytes("/v1/invocations", tokens["agent"])
    alone: list[float] = []
    watched: list[float] = []
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(drive(port, request, 1.0, CREATED))
        for _ in range(rounds):
            alone.append(runner.run(drive(port, request, seconds, CREATED))[0])
            with consoles(port, tokens["operator"], watching, []):
                watched.append(runner.run(drive(port, request, seconds, CREATED))[0])
    slower = statistics.median(1 - b / a for a, b in zip(alone, watched, strict=True))
    print(f"POST /v1/invocations, refused, durable, 32 connections ({rounds} rounds of {seconds:.0f} s):")
    print(f"  alone {statistics.median(alone):6.0f}/s   with {watching} consoles {statistics.median(watched):6.0f}/s")
    print(f"  slower by {slower:.1%} (at most 15 %)")


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
            assert not reader.closed, reader.closed
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
        server = subprocess.Popen(serve, cwd=ROOT, stdout=subprocess.DEVNULL)
        try:
            wait_until_up(port, "/readyz", server)
            tokens = json.loads((Path(folder) / "tokens.json").read_text())
            poses_and_cost(port, tokens, server.pid, 10.0)
            slow_console(port, tokens)
            post_slowdown(port, tokens, rounds, seconds, watching=CONSOLES)
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
