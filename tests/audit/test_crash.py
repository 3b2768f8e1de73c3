"""Real processes that are killed, and one that fills its disk."""

from __future__ import annotations

import asyncio
import json
import random
import subprocess
import sys
from pathlib import Path

import pytest

from app.audit.archive import verify_file, walk
from app.audit.reader import Reader
from app.audit.store import AuditStore
from tests.audit.conftest import draft
from tests.audit.unsynced_writer import NOT_HERE

pytestmark = [pytest.mark.process, pytest.mark.anyio]

RUNS = 4


def run_until_killed(data: Path, run: str, acknowledgements: int) -> dict[str, list[int]]:
    """Let a writer live until it has acknowledged so many appends, kill it, and return all that it acknowledged."""
    command = [sys.executable, "-m", "tests.audit.crashing_writer", str(data), run]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        said = [process.stdout.readline() for _ in range(acknowledgements)]
        process.kill()
        said += process.stdout.read().splitlines(keepends=True)
    assert process.returncode == -9
    words = [line.decode().split() for line in said if line.endswith(b"\n")]
    return {token: [int(seq) for seq in seqs] for token, *seqs in words}


async def test_every_acknowledged_event_survives_a_kill(data: Path) -> None:
    moments = random.Random(7)  # noqa: S311  # when to kill is no secret
    acknowledged: dict[str, list[int]] = {}
    for run in range(RUNS):
        said = await asyncio.to_thread(run_until_killed, data, f"run{run}", moments.randint(1, 400))
        assert said
        acknowledged |= said
        store = AuditStore.open(data)
        result = await store.verify()
        assert result.problem is None
        assert result.size == store.size
        await store.close()
    reader = Reader(data / "reins.db")
    stored: dict[str, list[int]] = {}
    for event in walk(reader):
        stored.setdefault(str(event.payload()["token"]), []).append(event.seq)
    rows = {row["name"] for row in reader_settings(reader)}
    reader.close()
    assert {token: stored.get(token) for token in acknowledged} == acknowledged
    assert rows == set(stored)  # rows and events come and go together


def reader_settings(reader: Reader) -> list[dict[str, str]]:
    found: list[dict[str, str]] = []
    with reader._engine.connect() as connection:
        found.extend({"name": name} for (name,) in connection.exec_driver_sql("SELECT name FROM settings"))
    return found


async def test_a_full_disk_refuses_and_recovers(data: Path) -> None:
    command = [sys.executable, "-m", "tests.audit.filling_writer", str(data)]
    process = await asyncio.to_thread(subprocess.run, command, capture_output=True, text=True, timeout=170)
    assert process.returncode == 0, process.stderr
    seen = json.loads(process.stdout)
    assert seen["acknowledged"] > 10
    assert len(seen["refusals"]) == 3
    assert all(seen["refusals"])
    assert (seen["healthy"], bool(seen["reason"])) == (False, True)
    assert seen["size"] == seen["readable"] == seen["acknowledged"]
    assert seen["verified"]
    assert seen["healthy_again"]
    assert seen["next"] == seen["acknowledged"] + 1
    assert seen["verified_again"] is None


async def test_what_was_refused_because_no_sync_succeeds_is_not_there_at_the_next_start(data: Path) -> None:
    """SQLite leaves such a transaction whole in its WAL, where its next start takes it for committed."""
    command = [sys.executable, "-m", "tests.audit.unsynced_writer", str(data)]
    process = await asyncio.to_thread(subprocess.run, command, capture_output=True, text=True, timeout=60)
    if process.returncode == NOT_HERE:
        pytest.skip("this system lets nobody filter system calls")
    assert (process.returncode, process.stdout) == (0, "disk I/O error"), process.stderr
    store = AuditStore.open(data)
    assert [event.payload()["said"] for event in await store.events()] == ["acknowledged"]
    assert (await store.row("settings", name="profile") or {})["value"] == b"strict"
    await store.append([draft(said="afterwards")])
    assert (await store.verify()).ok
    await store.close()
    assert verify_file(data).ok
