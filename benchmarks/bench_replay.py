"""Recorded decisions made again per second: a log of a real governor, grown to a size, replayed under a policy.

The log's decisions are those of a governor over the shipped policy, with contexts as a cell states them; they are
written again and again, with other facts each time, until there are as many as asked for. Counted is all of it: reading
the log, building the context, deciding, comparing; the start of the processes and the loading of the policy too, and
without them. Reaches: at least 50,000 decisions per second.

    python benchmarks/bench_replay.py [--decisions 400000] [--rounds 3]
"""

from __future__ import annotations

import argparse
import asyncio
import os
import sqlite3
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import orjson
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.assayer import Assayer
from app.audit.replay import Replay, replay
from app.audit.replaying import replay_in_processes
from app.audit.store import AuditStore
from app.governance.bundle import load_files, read_files
from app.governance.model import Role
from app.protocol import Hello, State, encode
from app.runtime.assembly import Runtime
from app.runtime.invocation import Principal, ProposalRequest

POLICIES = Path(__file__).resolve().parents[1] / "policies"
TARGET_PER_S = 50_000
AGENT = Principal(name="planner", role=Role.AGENT)
FACTS: dict[str, Any] = {
    "stamp_s": 1.0, "arm_ready": True, "arm_retracted": True, "gripper_empty": True, "holding": None,
    "base": [1.6, 4.6, 1.5708],
    "objects": {
        name: {"visible": True, "reachable": True, "x_m": 1.5, "y_m": 5.25, "z_m": 0.8, "stamp_s": 1.0}
        for name in ("mug_1", "glass_1", "driver_1")
    },
    "tools": {"lever": "up", "press": "raised"}, "inspected": {}, "people_count": 1, "people_nearest_m": 3.5,
    "sensors_fresh": True,
}  # fmt: skip
ASKED: tuple[tuple[str, dict[str, Any], dict[str, Any]], ...] = (
    ("grasp_object", {"object_id": "mug_1", "force_n": 80.0, "speed_mps": 0.5}, {"confidence": 0.9}),
    ("grasp_object", {"object_id": "glass_1"}, {}),
    ("grasp_object", {"object_id": "mug_1"}, {"confidence": 0.3}),
    ("grasp_object", {"object_id": "solvent_1"}, {}),
    ("operate_tool", {"tool": "press", "action": "press"}, {}),
    ("navigate_to", {"target": "dock", "speed_mps": 1.0}, {}),
    ("navigate_to", {"target": "nowhere"}, {}),
    ("inspect_area", {"area": "bench_a"}, {}),
)


class Silent:
    """A link that nobody reads."""

    async def send(self, frame: str) -> None:
        pass

    async def close(self, code: int, reason: str) -> None:
        pass


async def record(folder: Path) -> None:
    """Have a governor decide once on everything that is asked."""
    store = AuditStore.open(folder)
    policy = load_files(read_files(POLICIES))
    runtime = Runtime(
        store, policy, Ed25519PrivateKey.generate(), default_profile="human-shared", examine=Assayer()
    )  # fmt: skip
    async with runtime.running():
        link = await runtime.fleet.attach("workcell-1", Silent())
        hello = Hello(cell="workcell-1", boot="b", robot="r", policy_digest=policy.digest, profile=None,
                      invocation=None, latched=False, journal="j", last_seq=0)  # fmt: skip
        state = State(at_s=1.0, tick=1, invocation=None, status=None, latched=False, holding=False,
                      policy_digest=policy.digest, profile="human-shared", facts=FACTS, gauges={})  # fmt: skip
        await link.receive(encode(hello))
        for capability, params, metadata in ASKED:
            await link.receive(encode(state))
            request = ProposalRequest(capability=capability, params=params, metadata=metadata)
            await runtime.governor.propose(AGENT, request)
        await link.detach()
    await store.close()


def grow(folder: Path, decisions: int) -> None:
    """Write what was recorded again and again, each time with the robot somewhere else."""
    drops: list[str] = []
    with closing(sqlite3.connect(folder / "reins.db")) as connection:
        # Nothing is verified or queried here: what keeps the record slow to write is not asked for.
        known = connection.execute("SELECT type, name FROM sqlite_master WHERE type IN ('trigger', 'index')").fetchall()
        for kind, name in known:
            if not name.startswith("sqlite_"):
                drops.append(f"DROP {kind} {name}")
        for drop in drops:
            connection.execute(drop)
        rows = connection.execute(
            "SELECT at, kind, invocation, actor, body FROM events WHERE kind IN ('proposal', 'admission', 'policy') "
            "ORDER BY seq"
        ).fetchall()
        records = [(at, kind, invocation, actor, orjson.loads(body)) for at, kind, invocation, actor, body in rows]
        connection.execute("PRAGMA synchronous=OFF")
        seq = connection.execute("SELECT max(seq) FROM events").fetchone()[0]
        for turn in range(-(-decisions // len(ASKED)) - 1):
            batch: list[tuple[Any, ...]] = []
            for at, kind, invocation, actor, body in records:
                seq += 1
                body["seq"] = seq
                context = body["body"].get("context")
                if context is not None:
                    context["cell"]["facts"]["base"] = [1.6 + turn % 97 / 1000, 4.6, 1.5708]
                batch.append((seq, at, kind, invocation, actor, orjson.dumps(body)))
            connection.executemany("INSERT INTO events VALUES (?, ?, ?, ?, ?, ?)", batch)
        connection.commit()


def bench(decisions: int, rounds: int) -> None:
    files = read_files(POLICIES)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        asyncio.run(record(folder))
        grow(folder, decisions)
        policy = load_files(files)
        alone: list[float] = []
        whole: list[float] = []
        found = Replay()
        for _ in range(rounds):
            start_s = time.perf_counter()
            found = replay(folder, lambda _: policy, until=200_000)
            alone.append(found.decisions / (time.perf_counter() - start_s))
            start_s = time.perf_counter()
            found = replay_in_processes(folder, files)
            whole.append(found.decisions / (time.perf_counter() - start_s))
            assert not found.changed, found.groups()[0]
    cores = os.cpu_count() or 1
    print(f"{found.decisions} decisions, none changed; best of {rounds}")
    print(f"  one process:              {max(alone):8.0f} decisions/s")
    print(f"  {cores} processes, start included: {max(whole):8.0f} decisions/s (at least {TARGET_PER_S})")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--decisions", type=int, default=400_000)
    parser.add_argument("--rounds", type=int, default=3)
    chosen = parser.parse_args()
    bench(chosen.decisions, chosen.rounds)
