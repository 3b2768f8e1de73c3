"""A data directory, and drafts to fill it with."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from app.audit.event import EventDraft, RowWrite
from app.audit.store import AuditStore

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


async def fill(store: AuditStore, batches: int = 4, each: int = 3) -> None:
    """Append batch after batch, so that each has its checkpoint."""
    for batch in range(batches):
        await store.append([draft(n=batch * each + number) for number in range(each)])
