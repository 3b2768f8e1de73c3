"""What consoles are shown of cells: whoever comes later sees what those see who were there."""

from __future__ import annotations

import asyncio
from typing import Any

import orjson
import pytest

from app.protocol import POSE_BYTES, Path, Scene, pack_poses
from app.runtime.budget import Budget
from app.runtime.outlet import Outlet
from app.runtime.screens import Screens

pytestmark = pytest.mark.anyio

SCENE = Scene(scene={"zones": []}, bodies=["base"], gauges=[])


async def told(outlet: Outlet, count: int) -> list[dict[str, Any]]:
    said = [await outlet.next() for _ in range(count)]
    outlet.say(orjson.dumps({"type": "last"}).decode())
    assert orjson.loads(await outlet.next() or b"") == {"type": "last"}
    return [orjson.loads(text or b"") for text in said]


async def test_a_cell_that_is_described_anew_has_no_way_planned_before() -> None:
    screens, first, later = Screens(lambda _cell, _so: None), Outlet(), Outlet()
    screens.watch(first, ["workcell-1"])
    screens.draw("workcell-1", SCENE)
    screens.draw("workcell-1", Path(invocation="inv_1", points=[(0.0, 0.0), (1.0, 1.0)]))
    assert [word["type"] for word in await told(first, 2)] == ["scene", "path"]

    screens.draw("workcell-1", SCENE)  # its link was away; where nothing is planned, nothing is said of it
    screens.watch(later, ["workcell-1"])
    assert [word["type"] for word in await told(later, 1)] == ["scene"]


async def test_whoever_watches_a_cell_that_draws_without_end_sees_how_it_looks_last_and_is_not_cut_off() -> None:
    screens, outlet = Screens(lambda _cell, _so: None), Outlet()
    screens.watch(outlet, ["workcell-1"])
    screen = screens._screens["workcell-1"]
    screen.drawings = Budget(most=1_000_000.0, per_s=1_000_000.0)
    pose = bytes(POSE_BYTES)
    for number in range(100):
        screens.draw("workcell-1", Scene(scene={"n": number, "pad": "x" * 400_000}, bodies=["base"], gauges=[]))
        screens.draw("workcell-1", Path(invocation="inv_1", points=[(0.0, float(number))]))
        screens.show("workcell-1", pack_poses(1, 0.0, pose, b""))
    assert outlet.ended is None
    shown: list[int] = []
    async with asyncio.timeout(20.0):
        while 99 not in shown:
            word = await outlet.next()
            assert isinstance(word, str), "no frame comes before the scene it fits"
            document = orjson.loads(word)
            shown += [document["scene"]["n"]] if document["type"] == "scene" else []
        assert orjson.loads(await outlet.next() or b"")["points"] == [[0.0, 99.0]]
        while screen.due is not None:
            await asyncio.sleep(0.01)
    assert len(shown) < 6
