"""Words whose speakers have gone by the time they are taken: what lets something move counts for nothing then."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import orjson
import pytest

from app.runtime.broadcast import BEAT_S, TICK_S
from tests.api.conftest import CELL, House, eventually, open_house
from tests.api.test_console import signed_in
from tests.api.test_grants import GRANT
from tests.api.test_operators import DRIVE, ask
from tests.api.test_policies import SLOWER

pytestmark = pytest.mark.anyio

MAY_BE_TAKEN_S = 0.3
CONSOLE_WAITS_S = 10.0


def goes(sender: socket.socket) -> None:
    sender.close()


def breaks_off(sender: socket.socket) -> None:
    sender.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    sender.close()


def half_closes(sender: socket.socket) -> None:
    sender.shutdown(socket.SHUT_WR)


def said(house: House, key: str, method: str, path: str, body: Any = None) -> socket.socket:
    """Say something, while the server cannot run, as if it stood still."""
    address, raw = urlsplit(house.url), orjson.dumps({} if body is None else body)
    sender = socket.create_connection((address.hostname, address.port))
    head = f"{method} {path} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {house.token(key)}\r\n"
    sender.sendall(f"{head}Content-Type: application/json\r\nContent-Length: {len(raw)}\r\n\r\n".encode() + raw)
    return sender


@pytest.mark.parametrize("ends", [goes, breaks_off, half_closes])
async def test_a_denial_counts_where_an_approval_was_given_up_before(
    shared_house: House, ends: Callable[[socket.socket], None]
) -> None:
    async with shared_house.cell() as cell, shared_house.client("auditor") as auditor:
        question = await ask(shared_house)
        place = f"/v1/escalations/{question['id']}/resolve"
        with (
            said(shared_house, "operator", "POST", place, {"decision": "approve", "digest": question["digest"]}) as one,
            said(shared_house, "operator_2", "POST", place, {"decision": "deny", "digest": question["digest"]}) as two,
        ):
            ends(one)
            goes(two)  # what restrains counts all the same
            await eventually(lambda: shared_house.runtime.register.newest(question["invocation"]) is None)
        trace = (await auditor.get(f"/v1/invocations/{question['invocation']}/trace")).json()["items"]
        words = [(event["actor"], event["body"]["decision"]) for event in trace if event["kind"] == "approval"]
        assert words == [("operator_2", "deny")]
        assert not cell.launches


async def test_an_approval_that_was_held_back_for_longer_than_its_sender_waits_is_none(shared_house: House) -> None:
    async with (
        shared_house.cell() as cell,
        shared_house.client("operator") as operator,
        signed_in(shared_house) as screen,
    ):
        question = await ask(shared_house)
        place = f"/v1/escalations/{question['id']}/resolve"

        async def says(decision: str, patience: str) -> tuple[int, str | None]:
            body = {"decision": decision, "digest": question["digest"]}
            answer = await operator.post(place, json=body, headers={"Reins-Patience": patience})
            return answer.status_code, answer.json().get("code")

        beat = (await screen.until_type("beat"))["n"]
        for over in (f"{beat} 0", f"{beat + 1_000_000} 60000", f"-{beat} 60000", "for long", ""):
            assert await says("approve", over) == (409, "given_up"), over
        assert (await says("deny", f"{beat} 0"))[0] == 200  # what restrains counts, however late it comes
        assert not cell.launches
        question = await ask(shared_house)
        place = f"/v1/escalations/{question['id']}/resolve"
        assert (await says("approve", f"{beat} 60000"))[0] == 200
        await eventually(lambda: cell.launches)
        await cell.end("succeeded")
        await eventually(lambda: shared_house.runtime.register.newest(question["invocation"]) is None)


async def test_an_approval_counts_for_as_long_as_its_sender_waits_however_much_is_told_meanwhile(
    shared_house: House,
) -> None:
    async with (
        shared_house.cell() as cell,
        shared_house.client("operator") as operator,
        signed_in(shared_house) as screen,
    ):
        question = await ask(shared_house)
        beat = (await screen.until_type("beat"))["n"]
        for _ in range(int(CONSOLE_WAITS_S * (1.0 / TICK_S + 1.0 / BEAT_S))):  # as if every update were long
            shared_house.runtime.broadcast._next_beat()
        body = {"decision": "approve", "digest": question["digest"]}
        said = {"Reins-Patience": f"{beat} {CONSOLE_WAITS_S * 1000:.0f}"}
        answer = await operator.post(f"/v1/escalations/{question['id']}/resolve", json=body, headers=said)
        assert answer.is_success, answer.text
        await eventually(lambda: cell.launches)
        await cell.end("succeeded")
        await eventually(lambda: shared_house.runtime.register.newest(question["invocation"]) is None)


async def counts_only_of_who_waits(
    house: House, operator: httpx.AsyncClient, method: str, path: str, body: Any = None, key: str = "operator"
) -> None:
    before = house.runtime.store.size
    goes(said(house, key, method, path, body))
    await asyncio.sleep(MAY_BE_TAKEN_S)
    since = await house.runtime.store.events(after=before)  # the cell may have had more to say of the word before
    assert [event.kind for event in since if event.actor == key] == []
    answer = await operator.request(method, path, json=body)
    assert answer.is_success, answer.text


async def test_what_lets_a_session_move_counts_only_of_who_waits(house: House) -> None:
    async with house.cell() as cell, house.client() as agent, house.client("operator") as operator:
        document = (await agent.post("/v1/invocations", json=DRIVE)).json()
        place = f"/v1/invocations/{document['id']}"

        def status() -> str | None:
            known = house.runtime.register.newest(document["id"])
            return known and known.status

        goes(said(house, "operator", "POST", f"{place}/pause"))
        await eventually(lambda: status() == "paused")
        await counts_only_of_who_waits(house, operator, "POST", f"{place}/resume")
        await eventually(lambda: status() == "running")
        goes(said(house, "operator", "POST", f"{place}/stop"))
        await eventually(lambda: status() is None)
        assert cell.words == ["pause", "resume", "stop"]


async def test_what_an_agent_proposes_counts_only_while_it_waits(house: House) -> None:
    async with house.cell() as cell, house.client() as agent:
        before = house.runtime.store.size
        goes(said(house, "agent", "POST", "/v1/invocations", DRIVE))
        await asyncio.sleep(MAY_BE_TAKEN_S)
        assert (house.runtime.store.size, cell.launches) == (before, [])
        goes(said(house, "agent", "POST", "/v1/invocations", {**DRIVE, "capability": "fly_to"}))
        await eventually(lambda: house.runtime.store.size > before)  # a refusal moves nothing, and is recorded
        assert (await agent.post("/v1/invocations", json=DRIVE)).json()["status"] == "running"


async def test_what_loosens_for_later_counts_only_of_who_waits(tmp_path: Path) -> None:
    async with (
        open_house(tmp_path, "human-shared") as house,
        house.cell() as cell,
        house.client("operator") as operator,
        house.client("engineer") as engineer,
    ):
        await counts_only_of_who_waits(house, operator, "POST", "/v1/grants", GRANT)
        brought = await engineer.post("/v1/policies", json={"files": SLOWER, "why": "because"})
        place, why = f"/v1/policies/{brought.json()['digest']}/activate", {"why": "it is time"}
        await counts_only_of_who_waits(house, engineer, "POST", place, why, key="engineer")
        goes(said(house, "auditor", "POST", f"/v1/cells/{CELL}/estop"))
        await eventually(lambda: cell.latched)
        await counts_only_of_who_waits(house, operator, "POST", f"/v1/cells/{CELL}/reset")
        await eventually(lambda: not cell.latched)
        profile = {"profile": "real-restricted"}
        await counts_only_of_who_waits(house, operator, "PUT", f"/v1/cells/{CELL}/profile", profile)
        await counts_only_of_who_waits(house, operator, "POST", f"/v1/cells/{CELL}/takeover")
