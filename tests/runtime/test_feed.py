"""The feed: none lost, none twice, nobody slow in the way."""

from __future__ import annotations

import asyncio

import pytest

from app.audit.event import EventDraft
from app.runtime import feed as feed_module
from app.runtime.assembly import Runtime
from app.runtime.feed import Subscription

pytestmark = pytest.mark.anyio


def drafts(count: int) -> list[EventDraft]:
    return [EventDraft(kind="cell", actor="test", body={"n": n}) for n in range(count)]


async def collect(subscription: Subscription, last: int) -> list[int]:
    seen: list[int] = []
    async with asyncio.timeout(5.0):
        async for batch in subscription:
            seen += [event.seq for event in batch]
            if seen and seen[-1] >= last:
                return seen
    return seen


async def test_a_listener_gets_what_is_committed_from_now_on(runtime: Runtime) -> None:
    with runtime.feed.subscribe() as subscription:
        seqs = await runtime.store.append(drafts(3))
        assert await collect(subscription, seqs[-1]) == seqs


async def test_a_listener_that_comes_back_misses_nothing(runtime: Runtime) -> None:
    await runtime.store.append(drafts(700))
    with runtime.feed.subscribe(after=2) as subscription:
        reading = asyncio.create_task(collect(subscription, runtime.store.size + 40))
        for _ in range(8):
            await runtime.store.append(drafts(5))
        assert await reading == list(range(3, runtime.store.size + 1))


@pytest.mark.parametrize(("bound", "most"), [("MAX_WAITING", 10), ("MAX_WAITING_BYTES", 1200)])
async def test_a_slow_listener_is_closed_and_resumes_where_it_was(
    runtime: Runtime, monkeypatch: pytest.MonkeyPatch, bound: str, most: int
) -> None:
    monkeypatch.setattr(feed_module, bound, most)
    with runtime.feed.subscribe() as slow, runtime.feed.subscribe() as quick:
        first = await runtime.store.append(drafts(5))
        assert await collect(quick, first[-1]) == first
        second = await runtime.store.append(drafts(8))
        assert slow.closed
        assert await collect(quick, second[-1]) == second
        assert await collect(slow, second[-1]) == []
    with runtime.feed.subscribe(after=first[0]) as resumed:
        assert await collect(resumed, second[-1]) == list(range(first[0] + 1, second[-1] + 1))


async def test_closing_the_feed_ends_every_listener(runtime: Runtime) -> None:
    with runtime.feed.subscribe() as subscription:
        reading = asyncio.create_task(collect(subscription, 10**9))
        await asyncio.sleep(0)
        runtime.feed.close()
        assert await reading == []


async def test_who_comes_to_a_closed_feed_is_ended_at_once(runtime: Runtime) -> None:
    """A stream that ended with the server is asked for anew, on a connection that is still open."""
    await runtime.store.append(drafts(1))
    runtime.feed.close()
    for after in (None, 0):
        with runtime.feed.subscribe(after=after) as subscription:
            async with asyncio.timeout(5.0):
                assert [batch async for batch in subscription] == []
