from __future__ import annotations

import asyncio

import pytest

from app.runtime import outlet as module
from app.runtime.outlet import BUDGET_BYTES, FELL_BEHIND, MAX_FRAMES, Outlet

pytestmark = pytest.mark.anyio


async def drained(outlet: Outlet) -> list[str | bytes]:
    """Return everything that may leave now."""
    found: list[str | bytes] = []
    while True:
        try:
            async with asyncio.timeout(0.01):
                item = await outlet.next()
        except TimeoutError:
            return found
        assert item is not None
        found.append(item)


async def test_text_leaves_in_order_and_ahead_of_frames() -> None:
    outlet = Outlet()
    outlet.show(0, 1, b"frame")
    outlet.say("one")
    outlet.say("two")
    assert await drained(outlet) == ["one", "two", b"frame"]


async def test_of_the_frames_that_wait_only_the_newest_leaves() -> None:
    outlet = Outlet()
    outlet.show(0, 1, b"old")
    outlet.show(0, 2, b"new")
    outlet.show(1, 1, b"other")
    assert sorted(await drained(outlet)) == [b"new", b"other"]  # type: ignore[type-var]


async def test_no_more_frames_of_a_cell_are_under_way_than_may_be() -> None:
    outlet = Outlet()
    for number in range(MAX_FRAMES + 2):
        outlet.show(0, number, b"%d" % number)
        await drained(outlet)
    outlet.acknowledged((0, 0))
    assert await drained(outlet) == [b"%d" % (MAX_FRAMES + 1)]


async def test_a_frame_waits_behind_much_text_until_that_is_acknowledged() -> None:
    outlet = Outlet()
    outlet.say("x" * BUDGET_BYTES)
    outlet.say("beat", ("beat", 1))
    outlet.show(0, 1, b"frame")
    assert b"frame" not in await drained(outlet)
    outlet.acknowledged(("beat", 1))
    assert await drained(outlet) == [b"frame"]


async def test_what_was_never_sent_cannot_be_acknowledged() -> None:
    outlet = Outlet()
    outlet.say("x" * BUDGET_BYTES)
    outlet.say("beat", ("beat", 1))
    outlet.show(0, 1, b"frame")
    await drained(outlet)
    outlet.acknowledged(("beat", 2))
    outlet.acknowledged((0, 9))
    assert await drained(outlet) == []


async def test_a_frame_that_has_become_old_is_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    outlet = Outlet()
    monkeypatch.setattr(module, "MAX_FRAME_AGE_S", -1.0)
    outlet.show(0, 1, b"frame")
    assert await drained(outlet) == []


async def test_a_console_that_is_too_far_behind_ends_and_nothing_is_left_out_silently() -> None:
    outlet = Outlet()
    outlet.say("x" * module.MAX_BEHIND_BYTES)
    assert outlet.ended is None
    outlet.say("y")
    assert outlet.ended is not None
    assert outlet.ended[0] == FELL_BEHIND
    assert await outlet.next() is None


async def test_what_is_under_way_counts_until_it_is_acknowledged() -> None:
    outlet = Outlet()
    outlet.say("x" * module.MAX_BEHIND_BYTES, ("beat", 1))
    await drained(outlet)
    outlet.acknowledged(("beat", 1))
    outlet.say("y" * module.MAX_BEHIND_BYTES, ("beat", 2))
    assert outlet.ended is None
    await drained(outlet)
    outlet.say("z")
    assert outlet.ended is not None


async def test_a_console_that_acknowledges_nothing_for_long_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    outlet = Outlet()
    outlet.say("beat", ("beat", 1))
    await drained(outlet)
    monkeypatch.setattr(module, "MAX_SILENT_S", -1.0)
    outlet.say("beat", ("beat", 2))
    assert outlet.ended is not None
