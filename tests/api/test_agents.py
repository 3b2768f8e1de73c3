from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import httpx
import pytest

from app.api.auth import issue_token
from app.clock import monotonic_s, parse_rfc3339
from app.governance.model import Role
from tests.api.conftest import House, eventually

pytestmark = pytest.mark.anyio

DRIVE: dict[str, Any] = {"capability": "navigate_to", "params": {"target": "dock", "speed_mps": 1.9}}
UNKNOWN: dict[str, Any] = {"capability": "fly_to", "params": {"height_m": 3}}
SHARED = "human-shared/authority"


@asynccontextmanager
async def another_agent(house: House, name: str) -> AsyncIterator[httpx.AsyncClient]:
    token = issue_token(house.folder, name=name, role=Role.AGENT)
    async with house.client(None) as client:
        client.headers["authorization"] = f"Bearer {token}"
        while (await client.get("/v1/capabilities")).status_code == 401:  # the server looks once a second
            await asyncio.sleep(0.05)
        yield client


async def refused(agent: httpx.AsyncClient, **headers: str) -> dict[str, Any]:
    answer = await agent.post("/v1/invocations", json=UNKNOWN, headers=headers)
    assert answer.status_code == 201, answer.text
    return answer.json()


async def test_answers_a_refused_proposal_with_201_and_its_place(house: House) -> None:
    async with house.client() as agent:
        answer = await agent.post("/v1/invocations", json=UNKNOWN)
        assert (answer.status_code, answer.json()["status"]) == (201, "rejected")
        again = await agent.get(answer.headers["location"])
    assert again.json() == answer.json()


async def test_a_trace_keeps_what_its_agent_said_itself(house: House) -> None:
    said = {"note": "the left one", "comment": {"of": "mine"}}
    async with house.client() as agent:
        made = (await agent.post("/v1/invocations", json={**UNKNOWN, "metadata": said})).json()
        trace = (await agent.get(f"/v1/invocations/{made['id']}/trace")).json()["items"]
    assert trace[0]["body"]["metadata"] == said


async def test_launches_what_policy_allows_with_the_effective_parameters(house: House) -> None:
    async with house.cell() as cell, house.client() as agent:
        answer = await agent.post("/v1/invocations", json=DRIVE)
        document = answer.json()
        assert (answer.status_code, document["status"]) == (201, "running"), answer.text
        await eventually(lambda: cell.launches)
        assert document["requested"]["speed_mps"] > document["effective"]["speed_mps"]
        assert cell.launches[0]["params"] == document["effective"]
        await cell.end("succeeded")
        while document["status"] == "running":
            seen = document["updated_at"]
            document = (await agent.get(f"/v1/invocations/{document['id']}?wait=10&seen={seen}")).json()
    assert (document["status"], document["outcome"]) == ("completed", "succeeded")


async def test_a_long_poll_returns_at_the_next_change(house: House) -> None:
    async with house.cell() as cell, house.client() as agent:
        document = (await agent.post("/v1/invocations", json=DRIVE)).json()
        await eventually(lambda: cell.launches)
        await eventually(lambda: house.runtime.register.newest(document["id"]).terms.confirmed)
        began_s = monotonic_s()
        polling = asyncio.create_task(agent.get(f"/v1/invocations/{document['id']}?wait=25"))
        done, _ = await asyncio.wait({polling}, timeout=0.2)
        assert not done
        await cell.tell("status", status="paused")
        answer = await polling
        assert (answer.json()["status"], monotonic_s() - began_s < 20) == ("paused", True)
        await cell.end("terminated")
        await eventually(lambda: house.runtime.register.newest(document["id"]) is None)


async def test_whoever_hung_up_waits_no_longer(house: House) -> None:
    waits = house.app.state.parts.waits
    async with house.cell() as cell, house.client() as agent:
        document = (await agent.post("/v1/invocations", json=DRIVE)).json()
        await eventually(lambda: house.runtime.register.newest(document["id"]).terms.confirmed)
        polling = asyncio.create_task(agent.get(f"/v1/invocations/{document['id']}?wait=60"))
        await eventually(lambda: waits.taken)
        polling.cancel()
        await eventually(lambda: not waits.taken)
        await cell.end("succeeded")
        await eventually(lambda: house.runtime.register.newest(document["id"]) is None)


async def test_whoever_waits_when_the_server_stops_is_answered_with_what_there_is(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(house.runtime.governor, "_letting_go", False)  # and again, after this
    async with house.cell() as cell, house.client() as agent:
        document = (await agent.post("/v1/invocations", json=DRIVE)).json()
        await eventually(lambda: house.runtime.register.newest(document["id"]).terms.confirmed)
        path = f"/v1/invocations/{document['id']}?wait=60"
        polling = asyncio.create_task(agent.get(path))
        await eventually(lambda: house.app.state.parts.waits.taken)
        house.runtime.governor.let_go()
        began_s = monotonic_s()
        for answer in (await polling, await agent.get(path)):
            assert (answer.status_code, answer.json()["status"]) == (200, "running")
        assert monotonic_s() - began_s < 20
        await cell.end("succeeded")
        await eventually(lambda: house.runtime.register.newest(document["id"]) is None)


async def test_a_long_poll_returns_what_is_final_at_once(house: House) -> None:
    async with house.client() as agent:
        document = await refused(agent)
        began_s = monotonic_s()
        answer = await agent.get(f"/v1/invocations/{document['id']}?wait=60")
    assert answer.json() == document
    assert monotonic_s() - began_s < 20


@pytest.mark.parametrize("query", ["wait=61", "wait=-1", "wait=nan", "wait=inf", "wait=soon", "wait=1e999", "until=1"])
async def test_refuses_to_wait_for_ever(house: House, query: str) -> None:
    async with house.client() as agent:
        answer = await agent.get(f"/v1/invocations/inv_1?{query}")
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")


@pytest.mark.parametrize(
    "seen",
    ["garbage", "1", "2026-03-01", "2026-03-01 09:30:00.250Z", "2026-13-01T09:30:00.250Z", "2026-03-01T09:30:00.25Z"],
)
@pytest.mark.parametrize("wait", ["", "wait=25&"])
async def test_refuses_what_is_no_time_of_a_version(house: House, seen: str, wait: str) -> None:
    async with house.client() as agent:
        document = await refused(agent)
        answer = await agent.get(f"/v1/invocations/{document['id']}?{wait}seen={seen}")
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
    assert f"`{seen}`" in answer.text
    assert "`2026-03-01T09:30:00.250Z`" in answer.text


async def test_the_same_key_and_body_get_the_same_invocation(house: House) -> None:
    async with house.client() as agent:
        key = {"Idempotency-Key": "fetch the mug, first try"}
        first = await agent.post("/v1/invocations", json=UNKNOWN, headers=key)
        second = await agent.post("/v1/invocations", json=UNKNOWN, headers=key)
    assert (first.status_code, second.status_code) == (201, 201)
    assert first.json() == second.json()
    assert first.headers["location"] == second.headers["location"]
    assert "idempotency-replayed" not in first.headers
    assert second.headers["idempotency-replayed"] == "true"


async def test_the_same_key_with_another_body_is_refused(house: House) -> None:
    async with house.client() as agent:
        key = {"Idempotency-Key": "another"}
        await agent.post("/v1/invocations", json=UNKNOWN, headers=key)
        answer = await agent.post("/v1/invocations", json={"capability": "swim_to"}, headers=key)
    assert (answer.status_code, answer.json()["code"]) == (422, "idempotency_mismatch")


async def test_requests_with_one_key_at_once_become_one_invocation(house: House) -> None:
    async with house.client() as agent:
        key = {"Idempotency-Key": "at once"}
        answers = await asyncio.gather(*(agent.post("/v1/invocations", json=UNKNOWN, headers=key) for _ in range(8)))
    assert {answer.status_code for answer in answers} <= {201, 409}
    assert {answer.json()["code"] for answer in answers if answer.status_code == 409} <= {"in_flight"}
    assert len({answer.json()["id"] for answer in answers if answer.status_code == 201}) == 1


async def test_agents_do_not_share_keys(house: House) -> None:
    async with house.client() as agent, another_agent(house, "other-keys") as other:
        key = {"Idempotency-Key": "shared"}
        assert (await refused(agent, **key))["id"] != (await refused(other, **key))["id"]


@pytest.mark.parametrize("key", ["", "x" * 256, "tab\there", "caf\xe9"])
async def test_refuses_a_key_that_is_not_printable(house: House, key: str) -> None:
    async with house.client() as agent:
        answer = await agent.post("/v1/invocations", json=UNKNOWN, headers={"Idempotency-Key": key.encode("latin-1")})
    assert (answer.status_code, answer.json()["code"]) == (422, "idempotency_key_invalid")


async def test_a_list_is_paged_newest_first_without_gap_or_repetition(house: House) -> None:
    async with house.client() as agent:
        made = [(await refused(agent))["id"] for _ in range(5)]
        listed: list[str] = []
        query = "/v1/invocations?capability=fly_to&limit=2"
        page = (await agent.get(query)).json()
        while True:
            listed += [item["id"] for item in page["items"]]
            if page["next"] is None:
                break
            page = (await agent.get(f"{query}&cursor={page['next']}")).json()
    assert listed[:5] == made[::-1]
    assert len(set(listed)) == len(listed)


@pytest.mark.parametrize("path", ["escalations", "grants", "reviews", "policies"])
async def test_a_cursor_counts_for_the_list_that_gave_it_alone(house: House, path: str) -> None:
    async with house.client() as agent, house.client("engineer" if path == "policies" else "operator") as person:
        for _ in range(2):
            await refused(agent)
        cursor = (await agent.get("/v1/invocations?limit=1")).json()["next"]
        assert (await person.get(f"/v1/{path}")).status_code == 200
        answer = await person.get(f"/v1/{path}", params={"cursor": cursor})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"].endswith("cursor")


@pytest.mark.parametrize(
    "query",
    [
        "limit=0",
        "limit=201",
        "limit=many",
        "limit=1_0",
        "limit=+5",
        "cursor=zz",
        "cursor=",
        "cursor=-1.x",
        "status=odd",
        "agent=",
        "colour=red",
    ],
)
async def test_refuses_a_filter_it_does_not_know(house: House, query: str) -> None:
    async with house.client() as agent:
        answer = await agent.get(f"/v1/invocations?{query}")
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
    assert answer.json()["errors"][0]["field"] == f"query.{query.partition('=')[0]}"


async def test_an_agent_sees_its_own_invocations_alone(house: House) -> None:
    async with house.client() as agent, another_agent(house, "other") as other:
        mine = await refused(agent)
        for path in ("", "/trace", "?wait=1"):
            answer = await other.get(f"/v1/invocations/{mine['id']}{path}")
            assert (answer.status_code, answer.json()["code"]) == (404, "invocation_unknown")
        assert (await other.post(f"/v1/invocations/{mine['id']}/cancel")).status_code == 404
        assert (await other.get("/v1/invocations")).json()["items"] == []
        assert (await other.get("/v1/invocations?agent=planner")).json()["items"] == []


async def test_everybody_else_sees_them_all(house: House) -> None:
    async with house.client() as agent:
        document = await refused(agent)
    for key in ("operator", "engineer", "auditor"):
        async with house.client(key) as reader:
            assert (await reader.get(f"/v1/invocations/{document['id']}")).json() == document


async def test_a_trace_holds_every_event_in_order(house: House) -> None:
    async with house.client() as agent:
        document = await refused(agent)
        trace = (await agent.get(f"/v1/invocations/{document['id']}/trace")).json()
    assert [event["kind"] for event in trace["items"]][:2] == ["proposal", "admission"]
    assert {event["invocation"] for event in trace["items"]} == {document["id"]}
    assert [event["seq"] for event in trace["items"]] == sorted(event["seq"] for event in trace["items"])


async def test_a_check_says_what_would_become_of_it_and_records_nothing(house: House) -> None:
    async with house.cell() as cell, house.client() as agent:
        await eventually(lambda: house.runtime.store.size)
        before = house.runtime.store.size
        allowed = (await agent.post("/v1/check", json=DRIVE)).json()
        denied = (await agent.post("/v1/check", json=UNKNOWN)).json()
        assert (allowed["status"], denied["status"]) == ("allowed", "rejected")
        assert not {"id", "created_at", "updated_at"} & allowed.keys()
        assert house.runtime.store.size == before
        assert not cell.launches


async def test_a_check_says_why_people_would_be_asked_as_their_question_does(shared_house: House) -> None:
    async with shared_house.cell(), shared_house.client() as agent, shared_house.client("operator") as operator:
        await eventually(lambda: shared_house.runtime.store.size)
        unsure = ["organization/low-confidence", "human-shared/tcp_speed_mps", SHARED]
        for metadata, rules in (({}, [SHARED]), ({"confidence": 0.3}, unsure)):
            grasp = {"capability": "grasp_object", "params": {"object_id": "mug_1"}, "metadata": metadata}
            checked = (await agent.post("/v1/check", json=grasp)).json()
            proposed = (await agent.post("/v1/invocations", json=grasp)).json()
            asked = (await operator.get(f"/v1/escalations/{proposed['escalation']['id']}")).json()
            asks = checked.pop("asks")
            assert [reason["rule"] for reason in asks["reasons"]] == rules
            assert (asks["reasons"], asks["needed"]) == (asked["reasons"], asked["needed"])
            within_s = parse_rfc3339(asked["expires_at"]) - parse_rfc3339(asked["created_at"])
            assert asks["within_s"] == pytest.approx(within_s, abs=0.01)
            for of_its_own in ("id", "created_at", "updated_at"):
                del proposed[of_its_own]
            assert checked == {**proposed, "escalation": None}  # and nothing else
            await agent.post(f"/v1/invocations/{asked['invocation']}/cancel")
        for other in (DRIVE, UNKNOWN):
            assert "asks" not in (await agent.post("/v1/check", json=other)).json()


async def test_a_person_checks_for_an_agent_and_an_agent_for_itself_alone(house: House) -> None:
    async with house.cell(), house.client() as agent, house.client("operator") as operator:
        await eventually(lambda: house.runtime.store.size)
        asked = (await agent.post("/v1/check", json=DRIVE)).json()
        assert (await operator.post("/v1/check", json={**DRIVE, "agent": asked["agent"]})).json() == asked
        stranger = (await operator.post("/v1/check", json={**DRIVE, "agent": "nobody"})).json()
        nameless = await operator.post("/v1/check", json=DRIVE)
        other = await agent.post("/v1/check", json={**DRIVE, "agent": "nobody"})
    assert (stranger["status"], stranger["agent"]) == ("rejected", "nobody")
    assert (nameless.status_code, nameless.json()["errors"][0]["field"]) == (422, "agent")
    assert (other.status_code, other.json()["code"]) == (403, "not_yours")


async def test_what_is_over_cannot_be_cancelled(house: House) -> None:
    async with house.client() as agent:
        document = await refused(agent)
        answer = await agent.post(f"/v1/invocations/{document['id']}/cancel", json={})
    assert (answer.status_code, answer.json()["code"]) == (409, "wrong_status")


async def test_the_agent_that_proposed_it_may_cancel_what_runs(house: House) -> None:
    async with house.cell() as cell, house.client() as agent:
        document = (await agent.post("/v1/invocations", json=DRIVE)).json()
        await eventually(lambda: cell.launches)
        answer = await agent.post(f"/v1/invocations/{document['id']}/cancel")
        assert answer.status_code == 200
        await eventually(lambda: house.runtime.register.newest(document["id"]) is None)
        final = (await agent.get(f"/v1/invocations/{document['id']}")).json()
    assert final["outcome"] == "cancelled"


async def test_lists_capabilities_with_their_input_schemas(house: House) -> None:
    async with house.client() as agent:
        listed = (await agent.get("/v1/capabilities")).json()
        active = (await agent.get("/v1/policies/active")).json()
    names = [item["name"] for item in listed["items"]]
    assert {"navigate_to", "grasp_object", "operate_tool"} <= set(names)
    assert all(item["inputs"]["type"] == "object" for item in listed["items"])
    assert active["version"] == house.runtime.kernel.policy.digest


@pytest.mark.parametrize("path", ["/v1/capabilities", "/v1/policies/active"])
async def test_what_policy_says_is_sent_compressed_to_whoever_takes_it(house: House, path: str) -> None:
    async with house.client() as agent:
        whole = await agent.get(path, headers={"Accept-Encoding": "identity"})
        packed = await agent.get(path, headers={"Accept-Encoding": "br, gzip"})
    assert [one.headers.get("content-encoding") for one in (whole, packed)] == [None, "gzip"]
    assert [one.headers["vary"] for one in (whole, packed)] == ["Accept-Encoding"] * 2
    assert [one.headers["cache-control"] for one in (whole, packed)] == ["no-store"] * 2
    assert packed.json() == whole.json()
    assert int(packed.headers["content-length"]) < int(whole.headers["content-length"]) / 2
