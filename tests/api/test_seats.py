"""Bounds on what is held open."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator

import pytest

from app.api.parts import Parts
from app.api.problems import Problem
from app.api.seats import LONG_BYTES, Seats, Turns
from tests.api.conftest import House, eventually

pytestmark = pytest.mark.anyio


@pytest.fixture
def narrow(house: House) -> Iterator[Parts]:
    """Have one seat of each kind."""
    parts: Parts = house.app.state.parts
    house.app.state.parts = narrow = Parts(
        **{name: getattr(parts, name) for name in Parts.__slots__ if name not in {"streams", "waits"}},
        streams=Seats(code="too_many_streams", limit=1, each=1),
        waits=Seats(code="too_many_waits", limit=1, each=1),
    )
    yield narrow
    house.app.state.parts = parts


def test_gives_every_seat_back_once() -> None:
    seats = Seats(code="too_many_waits", limit=2, each=2)
    with seats.take("planner"), seats.take("planner"):
        assert seats.taken == 2
    assert seats.taken == 0


@pytest.mark.parametrize(("limit", "each", "second"), [(2, 1, "planner"), (1, 1, "operator")])
def test_refuses_whoever_finds_no_seat(limit: int, each: int, second: str) -> None:
    seats = Seats(code="too_many_waits", limit=limit, each=each)
    with seats.take("planner"), pytest.raises(Problem, match="too_many_waits") as refused, seats.take(second):
        pass
    assert (refused.value.status, refused.value.headers) == (503, {"Retry-After": "5"})
    assert seats.taken == 0


def test_one_caller_leaves_seats_for_others() -> None:
    seats = Seats(code="too_many_waits", limit=2, each=1)
    with seats.take("planner"), seats.take("operator"):
        assert seats.taken == 2


async def test_one_stream_too_many_is_refused_and_the_seat_comes_back(house: House, narrow: Parts) -> None:
    async with house.client("auditor") as auditor:
        async with auditor.stream("GET", "/v1/events"):
            answer = await auditor.get("/v1/events")
            assert (answer.status_code, answer.json()["code"]) == (503, "too_many_streams")
            assert answer.headers["retry-after"] == "5"
        await eventually(lambda: narrow.streams.taken == 0)
        async with auditor.stream("GET", "/v1/events") as again:
            assert again.status_code == 200
    await eventually(lambda: narrow.streams.taken == 0)


async def test_one_long_poll_too_many_is_refused_and_one_that_ended_gives_its_seat_back(
    house: House, narrow: Parts
) -> None:
    async with house.client() as agent:
        refused = (await agent.post("/v1/invocations", json={"capability": "fly_to"})).json()
        path = f"/v1/invocations/{refused['id']}"
        with narrow.waits.take("planner"):
            answer = await agent.get(f"{path}?wait=1")
            assert (answer.status_code, answer.json()["code"]) == (503, "too_many_waits")
            assert (await agent.get(path)).status_code == 200
        assert (await agent.get(f"{path}?wait=1")).status_code == 200
        assert narrow.waits.taken == 0


async def test_turns_come_one_by_one_and_rest_for_as_long_as_each_took() -> None:
    turns, now = Turns(), asyncio.get_running_loop().time
    spans: list[tuple[float, float]] = []

    async def busy() -> None:
        async with turns.take():
            began_s = now()
            until_s = began_s + 0.02
            while now() < until_s:
                pass
            spans.append((began_s, now()))

    given_up = asyncio.ensure_future(busy())
    rest = asyncio.gather(busy(), busy())
    given_up.cancel()
    await rest
    (began_s, ended_s), (next_s, _) = spans
    assert next_s - ended_s >= ended_s - began_s


async def test_a_long_body_waits_for_its_turn_and_a_short_one_for_nobody(house: House) -> None:
    metadata = {f"k{i}": "x" * 4000 for i in range(1 + LONG_BYTES // 4000)}
    proposal = {"capability": "grasp_object", "params": {"object_id": "mug_1", "force_n": 40, "speed_mps": 0.2}}
    async with house.client("agent") as agent:
        async with house.app.state.parts.long_bodies.take():
            long = asyncio.ensure_future(agent.post("/v1/check", json={**proposal, "metadata": metadata}))
            for _ in range(5):
                assert (await agent.post("/v1/check", json=proposal)).status_code == 200
            assert not long.done()
        assert (await long).status_code == 200
