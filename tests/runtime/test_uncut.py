"""What runs to its end although its caller has gone."""

from __future__ import annotations

import asyncio
import gc
from typing import Any

import pytest

from app.audit.errors import RecordUnavailable
from app.runtime.uncut import uncut

pytestmark = pytest.mark.anyio


class Doing:
    def __init__(self, error: Exception) -> None:
        self.error, self.go, self.ended = error, asyncio.Event(), asyncio.Event()

    @uncut
    async def do(self) -> None:
        try:
            await self.go.wait()
            raise self.error
        finally:
            self.ended.set()


async def told_once_nobody_waits(error: Exception) -> list[dict[str, Any]]:
    """Return what the event loop is told of an error whose caller was cancelled before it."""
    told: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: told.append(context))
    doing = Doing(error)
    caller = asyncio.ensure_future(doing.do())
    await asyncio.sleep(0)
    caller.cancel()
    await asyncio.wait({caller})
    assert caller.cancelled()
    doing.go.set()
    await doing.ended.wait()
    await asyncio.sleep(0)
    gc.collect()
    return told


async def test_nobody_is_told_of_a_refusal_whose_caller_has_gone() -> None:
    assert await told_once_nobody_waits(RecordUnavailable("the disk is full")) == []


async def test_a_bug_is_told_of_also_where_its_caller_has_gone() -> None:
    bug = KeyError("a bug")
    assert [context["exception"] for context in await told_once_nobody_waits(bug)] == [bug]
