"""Durable `POST /v1/invocations` of refused proposals against a bare FastAPI echo of the same body, 32 connections.

Starts the real server (`reins serve`, no cell, synchronous=FULL) and an echo server on free ports, drives them in turn
with the same client, and prints the median over rounds of both ratios. Reaches: at least 0.50 of the echo's requests
per second, p99 at most 3 × the echo's.

    python benchmarks/bench_post.py [--rounds 5] [--seconds 3]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

CONNECTIONS = 32
ROOT = Path(__file__).resolve().parents[1]
BODY = json.dumps(
    {
        "capability": "grasp_object",
        "params": {"object_id": "solvent_1", "force_n": 80, "speed_mps": 0.5},
        "metadata": {"confidence": 0.9, "goal": "fetch"},
    }
).encode()
REFUSALS = {"rejected", "denied", "deferred"}


class Connection(asyncio.Protocol):
    """One keep-alive connection that sends the same request again as soon as it is answered."""

    def __init__(self, request: bytes, latencies_s: list[float], deadline_s: float, status: bytes) -> None:
        self.request, self.latencies_s, self.deadline_s, self.status = request, latencies_s, deadline_s, status
        self.buffer = b""
        self.expected = -1
        self.sent_s = 0.0
        self.done: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport
        self._send()

    def _send(self) -> None:
        self.buffer, self.expected = b"", -1
        self.sent_s = time.perf_counter()
        self.transport.write(self.request)

    def data_received(self, data: bytes) -> None:
        self.buffer += data
        if self.expected < 0:
            end = self.buffer.find(b"\r\n\r\n")
            if end < 0:
                return
            head = self.buffer[:end].lower()
            assert head.startswith(self.status), self.buffer[:600]
            start = head.index(b"content-length:") + 15
            self.expected = end + 4 + int(head[start:].split(b"\r\n", 1)[0])
        if len(self.buffer) < self.expected:
            return
        now_s = time.perf_counter()
        self.latencies_s.append(now_s - self.sent_s)
        if now_s >= self.deadline_s:
            self.transport.close()
            if not self.done.done():
                self.done.set_result(None)
        else:
            self._send()

    def connection_lost(self, error: Exception | None) -> None:
        if not self.done.done():
            self.done.set_exception(error or ConnectionError("the server closed the connection"))


def request_bytes(path: str, token: str) -> bytes:
    head = (
        f"POST {path} HTTP/1.1\r\nHost: bench\r\nAuthorization: Bearer {token}\r\n"
        f"Content-Type: application/json\r\nContent-Length: {len(BODY)}\r\n\r\n"
    )
    return head.encode() + BODY


async def drive(port: int, request: bytes, seconds: float, status: bytes) -> tuple[float, float]:
    """Return requests per second and the p99 latency in milliseconds."""
    loop = asyncio.get_running_loop()
    latencies_s: list[float] = []
    start_s = time.perf_counter()
    connections = [
        (
            await loop.create_connection(
                lambda: Connection(request, latencies_s, start_s + seconds, status), "127.0.0.1", port
            )
        )[1]
        for _ in range(CONNECTIONS)
    ]
    await asyncio.gather(*(connection.done for connection in connections))
    elapsed_s = time.perf_counter() - start_s
    return len(latencies_s) / elapsed_s, statistics.quantiles(latencies_s, n=100)[98] * 1000


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def wait_until_up(port: int, path: str, process: subprocess.Popen[bytes]) -> None:
    deadline_s = time.perf_counter() + 30
    while True:
        try:
            urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=1)
        except OSError:
            assert process.poll() is None, f"`{process.args}` ended with {process.returncode}"
            assert time.perf_counter() < deadline_s, f"`{process.args}` does not answer"
            time.sleep(0.05)
        else:
            return


def refused_status(port: int, token: str) -> str:
    request = urllib.request.Request(
        f"http://127.0.0.1:{port}/v1/invocations",
        BODY,
        {"Authorization": f"Bearer {token}", "Content-Type": "application/json"},
    )
    with urllib.request.urlopen(request) as response:  # noqa: S310
        return json.load(response)["status"]


def serve_echo(port: int) -> None:
    """Serve what the figure is held against: FastAPI as its tutorial shows it, echoing a typed body."""
    import uvicorn
    from fastapi import FastAPI
    from pydantic import BaseModel

    class Proposal(BaseModel):
        capability: str
        params: dict[str, str | float]
        metadata: dict[str, str | float] = {}

    app = FastAPI()

    async def echo(proposal: Proposal) -> Proposal:
        return proposal

    echo.__annotations__.update({"proposal": Proposal, "return": Proposal})
    app.post("/echo")(echo)

    async def healthz() -> dict[str, str]:
        return {"status": "ok"}

    app.get("/healthz")(healthz)
    uvicorn.run(app, host="127.0.0.1", port=port, log_level="warning", access_log=False)


def bench(rounds: int, seconds: float) -> None:
    import uvloop

    with tempfile.TemporaryDirectory() as folder:
        ports = free_port(), free_port()
        echo = subprocess.Popen([sys.executable, __file__, "--echo", str(ports[0])], cwd=ROOT)
        serve = [sys.executable, "-m", "app.cli", "serve", "--port", str(ports[1]), "--data", folder, "--cells", "0"]
        serve += ["--no-prove"]  # measured is serving alone
        server = subprocess.Popen(serve, cwd=ROOT, stdout=subprocess.DEVNULL)
        try:
            wait_until_up(ports[0], "/healthz", echo)
            wait_until_up(ports[1], "/healthz", server)
            token = json.loads((Path(folder) / "tokens.json").read_text())["agent"]
            status = refused_status(ports[1], token)
            assert status in REFUSALS, f"the proposal was not refused: `{status}`"
            targets = {
                "echo": (ports[0], request_bytes("/echo", token), b"http/1.1 200"),
                "post": (ports[1], request_bytes("/v1/invocations", token), b"http/1.1 201"),
            }
            results: dict[str, list[tuple[float, float]]] = {"echo": [], "post": []}
            with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
                for port, request, code in targets.values():  # warm up
                    runner.run(drive(port, request, 1.0, code))
                for _ in range(rounds):
                    for name, (port, request, code) in targets.items():
                        results[name].append(runner.run(drive(port, request, seconds, code)))
        finally:
            for process in (echo, server):
                process.terminate()
            for process in (echo, server):
                process.wait(10)
    report(status, results)


def report(status: str, results: dict[str, list[tuple[float, float]]]) -> None:
    pairs = list(zip(results["echo"], results["post"], strict=True))
    for name, rows in results.items():
        rps, p99 = (statistics.median(column) for column in zip(*rows, strict=True))
        print(f"{name}: {rps:8.0f} requests/s   p99 {p99:6.1f} ms   (median of {len(rows)} rounds)")
    rate = statistics.median(post[0] / echo[0] for echo, post in pairs)
    tail = statistics.median(post[1] / echo[1] for echo, post in pairs)
    print(f"POST /v1/invocations ({status}, durable) / echo, {CONNECTIONS} connections:")
    print(f"  requests per second {rate:.2f} (at least 0.50)   p99 {tail:.2f} × (at most 3)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--echo", type=int, metavar="PORT", help="only serve the echo")
    chosen = parser.parse_args()
    if chosen.echo is not None:
        serve_echo(chosen.echo)
    else:
        bench(chosen.rounds, chosen.seconds)


if __name__ == "__main__":
    main()
