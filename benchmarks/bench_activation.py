"""Activation of 1,000 rules under 200 requests per second: failed requests, and p99 before and while it happens.

Starts the real server (`reins serve`, no cell) and sends `POST /v1/check` at a steady rate, each at its own time
whether or not those before it were answered, so that a stall shows in every request it delays. Meanwhile the engineers
bring a version of 1,000 further rules and put it in force. Reaches: no failed request, p99 during at most 1.5 × before.

    python benchmarks/bench_activation.py [--rules 1000] [--rate 200] [--seconds 10]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import httpx

from app.governance.bundle import PROPERTIES, read_files, read_properties

ROOT = Path(__file__).resolve().parents[1]
BODY = {"capability": "grasp_object", "params": {"object_id": "mug_1", "force_n": 80}, "agent": "planner"}
TARGET = 1.5


@dataclass
class Seen:
    """Latencies by when a request was due, and what failed."""

    latencies_s: list[tuple[float, float]] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)

    def p99_ms(self, start_s: float, end_s: float) -> float:
        found = [latency for due, latency in self.latencies_s if start_s <= due < end_s]
        if len(found) < 50:
            raise SystemExit(f"only {len(found)} requests were due: the client fell behind; the machine is too busy")
        return statistics.quantiles(found, n=100)[98] * 1000


def grown(rules: int) -> dict[str, str]:
    """Return the shipped policy with so many further rules, spread over its capabilities and profiles; it is sound.

    Each denies a slice of the speeds of its own, the same slice in every profile: none is dead, and stricter profiles
    stay stricter.
    """
    properties = read_properties(ROOT / "policies")
    assert properties is not None
    files = {**read_files(ROOT / "policies"), PROPERTIES: properties}
    names = ("grasp_object", "place_object", "transport_object", "navigate_to")
    profiles = ("human-shared", "real-restricted", "test-audit", "sim-relaxed")

    def rule(place: int) -> str:
        slice_mps = 1.5 + place // 16 * 0.001
        when = f"params.speed_mps > {slice_mps:.3f} && params.speed_mps <= {slice_mps + 0.001:.3f}"
        scope = f"applies_to: [{names[place % 4]}]\n    profiles: [{profiles[place // 4 % 4]}]"
        return f"\n  - id: more-{place}\n    {scope}\n    when: {when}\n    then: deny\n    because: Rule {place}.\n"

    more = "".join(rule(place) for place in range(rules))
    return {**files, "organization.yaml": files["organization.yaml"].replace("rules:\n", f"rules:{more}", 1)}


async def send(client: httpx.AsyncClient, seen: Seen, due_s: float) -> None:
    try:
        answer = await client.post("/v1/check", json=BODY)
        if answer.status_code != 200:
            seen.failed.append(f"{answer.status_code} {answer.text[:200]}")
    except httpx.HTTPError as error:
        seen.failed.append(repr(error))
    seen.latencies_s.append((due_s, time.perf_counter() - due_s))


async def drive(url: str, token: str, rate: float, seen: Seen, until: asyncio.Event) -> None:
    headers = {"Authorization": f"Bearer {token}"}
    limits = httpx.Limits(max_connections=64, max_keepalive_connections=64)
    async with httpx.AsyncClient(base_url=url, headers=headers, timeout=30, trust_env=False, limits=limits) as client:
        due_s, sending = time.perf_counter(), set[asyncio.Task[None]]()
        while not until.is_set():
            due_s += 1 / rate
            await asyncio.sleep(max(0.0, due_s - time.perf_counter()))
            task = asyncio.create_task(send(client, seen, due_s))
            sending.add(task)
            task.add_done_callback(sending.discard)
        await asyncio.gather(*sending)


async def change(url: str, token: str, files: dict[str, str]) -> tuple[float, float, float]:
    """Bring and activate; return when that began, when the version was kept, and when it was in force."""
    headers = {"Authorization": f"Bearer {token}"}
    async with httpx.AsyncClient(base_url=url, headers=headers, timeout=600, trust_env=False) as client:
        begun_s = time.perf_counter()
        made = await client.post("/v1/policies", json={"files": files, "why": "a measurement"})
        assert made.status_code == 201, made.text[:400]
        kept_s = time.perf_counter()
        done = await client.post(f"/v1/policies/{made.json()['digest']}/activate", json={"why": "a measurement"})
        assert done.status_code == 200, done.text[:400]
        return begun_s, kept_s, time.perf_counter()


async def measure(url: str, tokens: dict[str, str], rules: int, rate: float, seconds: float) -> None:
    seen, until, files = Seen(), asyncio.Event(), grown(rules)
    driving = asyncio.create_task(drive(url, tokens["engineer"], rate, seen, until))
    await asyncio.sleep(1.0)
    start_s = time.perf_counter()
    await asyncio.sleep(seconds)
    begun_s, kept_s, entered_s = await change(url, tokens["engineer"], files)
    await asyncio.sleep(0.5)
    until.set()
    await driving
    before, checked = seen.p99_ms(start_s, begun_s), seen.p99_ms(begun_s, kept_s)
    during = seen.p99_ms(kept_s, max(entered_s, kept_s + 0.5) + 0.5)
    print(f"{len(seen.latencies_s)} requests at {rate:g}/s, {len(seen.failed)} failed")
    for word in seen.failed[:3]:
        print(f"  {word}")
    print(f"  p99 before                   {before:7.1f} ms")
    print(f"  p99 while it was checked     {checked:7.1f} ms   {checked / before:5.2f} ×   ({kept_s - begun_s:.2f} s)")
    print(f"  p99 while it came into force {during:7.1f} ms   {during / before:5.2f} ×   ({entered_s - kept_s:.2f} s)")
    print(f"  at most {TARGET} ×, none failed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rules", type=int, default=1000)
    parser.add_argument("--rate", type=float, default=200.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "app.cli", "serve", "--port", "0", "--data", folder, "--cells", "0"]
        words += ["--no-prove"]  # measured is serving alone
        server = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL)
        try:
            note = Path(folder) / "server.json"
            deadline_s = time.perf_counter() + 60
            while not note.exists():
                assert server.poll() is None, "the server ended"
                assert time.perf_counter() < deadline_s, "the server does not start"
                time.sleep(0.05)
            url = json.loads(note.read_text())["url"]
            tokens = json.loads((Path(folder) / "tokens.json").read_text())
            asyncio.run(measure(url, tokens, chosen.rules, chosen.rate, chosen.seconds))
        finally:
            server.terminate()
            server.wait(20)


if __name__ == "__main__":
    main()
