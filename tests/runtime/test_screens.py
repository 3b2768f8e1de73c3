"""What consoles are shown of cells: whoever comes later sees what those see who were there."""

from __future__ import annotations

from typing import Any

import orjson
import pytest

from app.protocol import Path, Scene
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
