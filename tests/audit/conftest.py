"""A data directory, and drafts to fill it with."""

from __future__ import annotations

import asyncio
import os
import resource
import sqlite3
from collections.abc import AsyncIterator, Callable, Generator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from app.audit.event import EventDraft, RowWrite
from app.audit.store import AuditStore
from app.clock import monotonic_s

DEADLINE_S = 10.0
TIME = "2026-03-01T09:30:00.000Z"


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return tmp_path / "data"


@pytest.fixture
async def store(data: Path) -> AsyncIterator[AuditStore]:
    opened = AuditStore.open(data)
    yield opened
    await opened.close()


async def until(condition: Callable[[], bool]) -> None:
    deadline = monotonic_s() + DEADLINE_S
    while not condition():
        assert monotonic_s() < deadline
        await asyncio.sleep(0.01)


@contextmanager
def without_descriptors() -> Generator[None]:
    """Let this process open nothing more, as a server has it that holds too many connections."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    lowest = os.open(os.devnull, os.O_RDONLY)  # all below it are taken
    os.close(lowest)
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowest, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def draft(kind: str = "proposal", invocation: str | None = "inv_1", actor: str = "planner", **body: Any) -> EventDraft:
    return EventDraft(kind=kind, actor=actor, invocation=invocation, body=body)


def invocation_row(key: str, **changes: Any) -> RowWrite:
    values = {
        "id": key,
        "status": "running",
        "capability": "grasp_object",
        "agent": "planner",
        "cell": "workcell-1",
        "profile": "human-shared",
        "document": b"{}",
        "created_at": TIME,
        "updated_at": TIME,
    }
    return RowWrite(table="invocations", values={**values, **changes})


def permit_row(permit: str) -> RowWrite:
    return RowWrite(table="permits_used", values={"permit": permit, "invocation": "inv_1", "used_at": TIME}, once=True)


def hide_from_index(database: Path, invocation: str) -> None:
    """Raise one byte of a closed database: the end of an invocation's name, in the index's entry for its last event."""
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        query = "SELECT rootpage FROM sqlite_master WHERE name = 'events_by_invocation'"
        ((page,),) = connection.execute(query).fetchall()
        ((size,),) = connection.execute("PRAGMA page_size").fetchall()
    content = bytearray(database.read_bytes())
    at = content.index(invocation.encode(), (page - 1) * size, page * size)
    content[at + len(invocation) - 1] += 1
    database.write_bytes(content)


async def fill(store: AuditStore, batches: int = 4, each: int = 3) -> None:
    """Append batch after batch, so that each has its checkpoint."""
    for batch in range(batches):
        await store.append([draft(n=batch * each + number) for number in range(each)])
