from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.api.problems import MEDIA_TYPE
from app.runtime.errors import Conflict
from tests.api.conftest import CELL, House, eventually, open_house

pytestmark = pytest.mark.anyio

DRIVE: dict[str, Any] = {"capability": "navigate_to", "params": {"target": "dock"}}
GRASP: dict[str, Any] = {"capability": "grasp_object", "params": {"object_id": "mug_1"}}


async def ask(house: House) -> dict[str, Any]:
    async with house.client() as agent:
        document = (await agent.post("/v1/invocations", json=GRASP)).json()
    assert document["status"] == "awaiting_approval", document
    async with house.client("operator") as operator:
        return (await operator.get(f"/v1/escalations/{document['escalation']['id']}")).json()


async def resolve(operator: httpx.AsyncClient, question: dict[str, Any], **answer: Any) -> httpx.Response:
    body = {"digest": question["digest"], "decision": "approve", **answer}
    return await operator.post(f"/v1/escalations/{question['id']}/resolve", json=body)


async def test_an_approval_launches_what_was_shown(shared_house: House) -> None:
    async with shared_house.cell() as cell, shared_house.client("operator") as operator:
        question = await ask(shared_house)
        pending = (await operator.get("/v1/escalations?status=pending")).json()["items"]
        assert question in pending
        answer = await resolve(operator, question)
        assert (answer.status_code, answer.json()["status"]) == (200, "approved")
        await eventually(lambda: cell.launches)
        assert cell.launches[0]["params"] == question["effective"]
        second = await resolve(operator, question)
        assert (second.status_code, second.json()["code"]) == (409, "already_resolved")
        await cell.end("succeeded")
        await eventually(lambda: shared_house.runtime.register.newest(question["invocation"]) is None)


async def test_a_denial_ends_it_and_its_words_never_reach_the_agent(shared_house: House) -> None:
    async with shared_house.cell() as cell, shared_house.client("operator") as operator:
        question = await ask(shared_house)
        wrong = await resolve(operator, {**question, "digest": "sha256:00"})
        assert (wrong.status_code, wrong.json()["code"]) == (409, "digest_mismatch")
        assert "the question has changed; valid is to read it again" in wrong.json()["detail"]
        assert question["digest"] not in wrong.text, "nobody answers by a digest that they were not shown"
        assert (await resolve(operator, question, decision="deny", comment="the boss is coming")).status_code == 200
        assert not cell.launches
    async with shared_house.client() as agent:
        final = (await agent.get(f"/v1/invocations/{question['invocation']}")).json()
        trace = await agent.get(f"/v1/invocations/{question['invocation']}/trace")
    assert (final["status"], final["outcome"]) == ("denied", "denied")
    assert "the boss" not in trace.text
    async with shared_house.client("auditor") as auditor:
        assert "the boss" in (await auditor.get(f"/v1/invocations/{question['invocation']}/trace")).text


async def test_a_denial_names_one_of_policys_codes(shared_house: House) -> None:
    async with shared_house.cell(), shared_house.client("operator") as operator:
        active = (await operator.get("/v1/policies/active")).json()["authority"]
        codes = [known["code"] for known in active["denials"]]
        assert codes[0] == "unspecified"
        question = await ask(shared_house)
        unknown = await resolve(operator, question, decision="deny", code="bad_hair_day")
        assert (unknown.status_code, unknown.json()["code"]) == (422, "params_invalid")
        assert all(code in unknown.json()["errors"][0]["message"] for code in codes)
        denied = await resolve(operator, question, decision="deny", code="wrong_target")
        assert denied.json()["denial"]["code"] == "wrong_target"
    async with shared_house.client() as agent:
        final = (await agent.get(f"/v1/invocations/{question['invocation']}")).json()
    assert final["escalation"]["code"] == "wrong_target"


async def test_one_operator_sees_that_another_looks_at_it(shared_house: House) -> None:
    async with (
        shared_house.cell(),
        shared_house.client("operator") as one,
        shared_house.client("operator_2") as other,
    ):
        question = await ask(shared_house)
        place = f"/v1/escalations/{question['id']}"
        assert (await one.post(f"{place}/acknowledge")).status_code == 200
        urgent = (await other.get("/v1/escalations?status=pending&sort=urgency")).json()["items"]
        assert [[word["by"] for word in item["acknowledged"]] for item in urgent] == [["operator"]]
        misused = await other.get("/v1/escalations?sort=urgency")
        assert (misused.status_code, misused.json()["code"]) == (422, "request_invalid")
        assert (await resolve(other, question, decision="deny")).status_code == 200
        late = await one.post(f"{place}/acknowledge")
        assert (late.status_code, late.json()["code"]) == (409, "already_resolved")


async def test_who_looks_at_what_a_change_of_profile_withdrew_is_told_so(shared_house: House) -> None:
    async with shared_house.cell(), shared_house.client("operator") as one, shared_house.client("engineer") as engineer:
        question = await ask(shared_house)
        try:
            assert (await engineer.put(f"/v1/cells/{CELL}/profile", json={"profile": "sim-relaxed"})).status_code == 200
            late = await one.post(f"/v1/escalations/{question['id']}/acknowledge")
            assert (late.status_code, late.json()["code"]) == (409, "profile_changed")
        finally:
            await engineer.put(f"/v1/cells/{CELL}/profile", json={"profile": "human-shared"})


async def test_what_waits_for_approval_is_stopped_for_good(shared_house: House) -> None:
    house = shared_house
    async with house.cell() as cell, house.client() as agent, house.client("operator") as operator:
        question = await ask(house)
        place = f"/v1/invocations/{question['invocation']}"
        stopped = await operator.post(f"{place}/stop")
        assert (stopped.status_code, stopped.json()["status"], stopped.json()["outcome"]) == (200, "denied", "stopped")
        late = await resolve(operator, question)
        assert (late.status_code, late.json()["code"]) == (409, "already_resolved")
        trace = (await agent.get(f"{place}/trace")).json()["items"]
        assert "stop" in [event["body"].get("op") for event in trace if event["kind"] == "human"]
    assert cell.launches == []


async def test_an_operator_pauses_resumes_and_stops_what_runs(house: House) -> None:
    async with house.cell() as cell, house.client() as agent, house.client("operator") as operator:
        document = (await agent.post("/v1/invocations", json=DRIVE)).json()
        assert document["status"] == "running", document
        place = f"/v1/invocations/{document['id']}"
        newest = house.runtime.register.newest
        assert (await operator.post(f"{place}/pause", content=b"{ broken")).status_code == 200
        await eventually(lambda: newest(document["id"]).status == "paused")
        for body in ({"faster": True}, {"after": -1}, {"after": "3"}, {"after": 10**6}):
            refused = await operator.post(f"{place}/resume", json=body)
            assert (refused.status_code, refused.json()["code"]) == (422, "request_invalid"), body
        for then, code in (("resume", "request_invalid"), ("rollback", "request_invalid"), ("end", "not_taken_over")):
            refused = await operator.post(f"{place}/release", json={"then": then, "after": 10**6})
            assert refused.json()["code"] == code, then
        overtaken = await operator.post(f"{place}/resume", json={"after": 1})
        assert (overtaken.status_code, overtaken.json()["code"]) == (409, "overtaken")
        assert (await operator.post(f"{place}/resume")).status_code == 200
        await eventually(lambda: newest(document["id"]).status == "running")
        assert (await operator.post(f"{place}/stop")).status_code == 200
        await eventually(lambda: newest(document["id"]) is None)
        late = await operator.post(f"{place}/stop")
        assert (late.status_code, late.json()["code"]) == (409, "wrong_status")
    assert cell.words == ["pause", "resume", "stop"]


@pytest.mark.parametrize("key", ["agent", "operator", "engineer", "auditor", "cell"])
async def test_anyone_may_stop_a_cell_and_only_a_reset_leaves_it(house: House, key: str) -> None:
    async with house.cell() as cell, house.client() as agent, house.client("operator") as operator:
        async with house.client(key) as anyone:
            answer = await anyone.post(f"/v1/cells/{CELL}/estop", content=b"\xff not json")
        assert (answer.status_code, answer.json()["latched"], answer.json()["recorded"]) == (200, True, True)
        await eventually(lambda: cell.latched)
        refused = (await agent.post("/v1/invocations", json=DRIVE)).json()
        assert refused["status"] == "rejected"
        assert [reason["code"] for reason in refused["admission"]["reasons"]] == ["estop_latched"]
        assert (await operator.post(f"/v1/cells/{CELL}/reset", json={})).status_code == 200
        await eventually(lambda: not house.runtime.fleet.latched(house.runtime.fleet.cell(CELL)))
        again = await operator.post(f"/v1/cells/{CELL}/reset")
        assert (again.status_code, again.json()["code"]) == (409, "not_latched")
        assert not cell.launches


async def test_no_word_counts_without_the_body_that_came_with_it(house: House) -> None:
    # As clients say it that would rather speak HTTP/2; what follows is not read as HTTP then.
    wish = {"Connection": "Upgrade, HTTP2-Settings", "Upgrade": "h2c", "HTTP2-Settings": "AAMAAABkAAQAAP__"}

    async def in_chunks() -> AsyncIterator[bytes]:
        yield b'{"step": "arm"}'

    async with house.cell() as cell, house.client("operator") as operator:
        assert (await operator.post(f"/v1/cells/{CELL}/estop", json={}, headers=wish)).status_code == 200
        await eventually(lambda: cell.latched)
        reset = f"/v1/cells/{CELL}/reset"
        for body in (b'{"step": "arm"}', in_chunks()):
            refused = await operator.post(reset, content=body, headers={**wish, "Content-Type": "application/json"})
            assert (refused.status_code, refused.json()["code"]) == (400, "body_incomplete")
            assert "`Upgrade`" in refused.json()["detail"]
        assert cell.latched
        assert (await operator.post(reset, headers=wish)).status_code == 200
        await eventually(lambda: not cell.latched)


async def test_an_engineer_changes_the_profile_of_a_cell(house: House) -> None:
    async with house.cell(), house.client("engineer") as engineer:
        answer = await engineer.put(f"/v1/cells/{CELL}/profile", json={"profile": "human-shared"})
        assert (answer.status_code, answer.json()["profile"]) == (200, "human-shared")
        unknown = await engineer.put(f"/v1/cells/{CELL}/profile", json={"profile": "anything-goes"})
        assert (unknown.status_code, unknown.json()["code"]) == (404, "profile_unknown")
        assert "valid: `human-shared`, `real-restricted`, `sim-relaxed`, `test-audit`" in unknown.json()["detail"]
        assert (await engineer.put(f"/v1/cells/{CELL}/profile", json={"profile": "sim-relaxed"})).status_code == 200
        assert [cell["id"] for cell in (await engineer.get("/v1/cells")).json()["items"]] == [CELL]


async def test_says_what_is_broken_while_nothing_could_launch(house: House) -> None:
    async with house.client(None) as anyone:
        away = await anyone.get("/readyz")
        async with house.cell():
            there = await anyone.get("/readyz")
    assert (away.status_code, away.json()["ready"]) == (503, False)
    assert away.json()["broken"]
    assert (there.status_code, there.json()) == (200, {"ready": True, "broken": {}})


async def test_is_ready_without_a_cell_that_others_stand_in_for_and_names_it(tmp_path: Path) -> None:
    async with open_house(tmp_path / "data", "sim-relaxed") as house, house.client(None) as anyone:
        house.app.state.parts.checks["children"] = lambda: "`workcell-2` ended"
        async with house.cell("workcell-2"):
            pass
        async with house.cell():
            there = await anyone.get("/readyz")
            missing = {"cell/workcell-2": "not attached, or silent", "children": "`workcell-2` ended"}
            assert (there.status_code, there.json()) == (200, {"ready": True, "broken": {}, "impaired": missing})
        away = await anyone.get("/readyz")
    assert away.status_code == 503
    assert away.json() == {"ready": False, "broken": {"cell/workcell-1": "not attached, or silent", **missing}}


async def test_says_which_grants_and_rows_hold_for_nothing(house: House) -> None:
    async with house.client(None) as anyone:
        before = (await anyone.get("/healthz")).json()
        house.runtime.desk.grants.unfounded = frozenset({"grant_forged"})
        house.runtime.register.unfounded = {"esc_forged": "its row is not what was asked"}
        after = (await anyone.get("/healthz")).json()
    assert (before["status"], before["broken"]) == ("ok", {})
    assert after["status"] == "degraded"
    assert "`grant_forged`" in after["broken"]["grants"]
    assert "`esc_forged`: its row is not what was asked" in after["broken"]["rows"]


async def test_a_hand_back_that_is_refused_bears_the_digest_that_the_next_one_says(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[dict[str, Any]] = []

    async def refused(*_: Any, **of: Any) -> None:
        said.append(of)
        raise Conflict("resume_refused", "people are asked about this", digest="sha256:00")

    monkeypatch.setattr(house.runtime.governor, "release", refused)
    async with house.client("operator") as operator:
        body = {"then": "resume", "lease": "lease_1", "after": 0}
        for digest in (None, "sha256:00"):
            answer = await operator.post("/v1/invocations/inv_1/release", json={**body, "digest": digest})
            assert (answer.status_code, answer.json()["digest"]) == (409, "sha256:00")
    assert said == [{"lease": "lease_1", "after": 0, "digest": digest} for digest in (None, "sha256:00")]


@pytest.mark.parametrize("route", ["/v1/escalations/{id}/resolve", "/v1/invocations/{id}/resume"])
async def test_that_another_policy_lets_a_session_not_go_on_is_described(house: House, route: str) -> None:
    refusals = house.described.document["paths"][route]["post"]["responses"]["409"]["content"][MEDIA_TYPE]
    assert "resume_refused" in refusals["examples"]
