from __future__ import annotations

from typing import Any

import pytest

from app.runtime import reviews
from tests.api.conftest import CELL, House, eventually
from tests.api.test_console import signed_in
from tests.api.test_operators import DRIVE, GRASP, ask, resolve

pytestmark = pytest.mark.anyio

GRANT: dict[str, Any] = {
    "capability": "grasp_object", "agent": "planner", "cell": CELL, "scope": "time", "minutes": 5,
}  # fmt: skip


async def test_a_grant_is_given_seen_used_and_revoked(shared_house: House) -> None:
    async with (
        shared_house.cell() as cell,
        shared_house.client("operator") as operator,
        shared_house.client("auditor") as auditor,
        shared_house.client() as agent,
    ):
        given = await operator.post("/v1/grants", json=GRANT)
        assert (given.status_code, given.json()["issued_by"]) == (201, "operator")
        assert (await agent.post("/v1/check", json=GRASP)).json()["grant"] == given.json()["id"]
        document = (await agent.post("/v1/invocations", json=GRASP)).json()
        assert (document["status"], document["grant"]) == ("running", given.json()["id"])
        await eventually(lambda: cell.launches)
        assert cell.launches[0]["approvals"] == [f"grant:{given.json()['id']}"]
        (standing,) = (await auditor.get("/v1/grants?status=active")).json()["items"]
        assert standing["uses"] == 1
        place = f"/v1/grants/{given.json()['id']}/revoke"
        assert (await operator.post(place)).json()["ended"]["code"] == "revoked"
        again = await operator.post(place)
        assert (again.status_code, again.json()["code"]) == (409, "grant_ended")
        unknown = await operator.post("/v1/grants/gr_none/revoke")
        assert (unknown.status_code, unknown.json()["code"]) == (404, "grant_unknown")
        assert (await auditor.get("/v1/grants?status=active")).json()["items"] == []
        await cell.end("succeeded")
        await eventually(lambda: shared_house.runtime.register.newest(document["id"]) is None)
        assert (await agent.post("/v1/check", json=GRASP)).json()["status"] == "awaiting_approval"


async def test_a_grant_ends_with_the_token_of_who_gave_it(shared_house: House) -> None:
    async with (
        shared_house.cell(),
        shared_house.client("operator_2") as operator,
        shared_house.client("auditor") as auditor,
        shared_house.client() as agent,
    ):
        given = (await operator.post("/v1/grants", json=GRANT)).json()
        assert (await agent.post("/v1/check", json=GRASP)).json()["grant"] == given["id"]
        async with shared_house.withdrawn("operator_2"):
            await eventually(lambda: not shared_house.runtime.desk.grants.active())
            assert (await agent.post("/v1/check", json=GRASP)).json()["status"] == "awaiting_approval"
        newest = (await auditor.get("/v1/grants")).json()["items"][0]
        assert (newest["id"], newest["ended"]["code"], newest["ended"]["by"]) == (
            given["id"],
            "giver_withdrawn",
            "server",
        )


async def test_a_grant_goes_with_an_approval(shared_house: House) -> None:
    async with shared_house.cell() as cell, shared_house.client("operator") as operator:
        question = await ask(shared_house)
        answer = await resolve(operator, question, grant={"scope": "object", "minutes": 2})
        (standing,) = (await operator.get("/v1/grants?status=active")).json()["items"]
        assert (answer.json()["grant"], standing["object"]) == (standing["id"], "mug_1")
        await operator.post(f"/v1/grants/{standing['id']}/revoke")
        await cell.end("succeeded")
        await eventually(lambda: shared_house.runtime.register.newest(question["invocation"]) is None)


@pytest.mark.parametrize(
    ("differs", "code"),
    [
        ({"minutes": 16}, "request_invalid"),
        ({"minutes": 0}, "request_invalid"),
        ({"scope": "for ever"}, "request_invalid"),
        ({"scope": "task"}, "params_invalid"),
    ],
)
async def test_a_grant_that_fits_nothing_is_refused(shared_house: House, differs: dict[str, Any], code: str) -> None:
    async with shared_house.cell(), shared_house.client("operator") as operator:
        refused = await operator.post("/v1/grants", json={**GRANT, **differs})
        assert (refused.status_code, refused.json()["code"]) == (422, code)
        refused = await operator.post("/v1/grants", json={**GRANT, "capability": "navigate_to"})
        assert (refused.status_code, refused.json()["code"]) == (409, "grant_refused")
        assert refused.json()["reasons"][0]["code"] == "nothing_to_grant"
        refused = await operator.post("/v1/grants", json={**GRANT, "agent": "nobody"})
        assert (refused.status_code, refused.json()["code"]) == (409, "grant_refused")
        assert refused.json()["reasons"][0]["code"] == "unknown_agent"


async def test_a_grant_that_is_over_as_it_begins_is_refused(shared_house: House) -> None:
    async with shared_house.cell() as cell, shared_house.client("operator") as operator:
        refused = await operator.post("/v1/grants", json={**GRANT, "minutes": 1e-9})
        assert (refused.status_code, refused.json()["errors"]) == (
            422,
            [{"field": "minutes", "message": "is `1e-09`: valid is at least 0.01"}],
        )
        question = await ask(shared_house)
        refused = await resolve(operator, question, grant={"scope": "object", "minutes": 1e-9})
        assert (refused.status_code, refused.json()["errors"]) == (
            422,
            [{"field": "grant.minutes", "message": "is `1e-09`: valid is at least 0.01"}],
        )
        answer = await resolve(operator, question, grant={"scope": "object", "minutes": 0.01})
        assert (answer.status_code, answer.json()["status"]) == (200, "approved")
        await eventually(lambda: cell.launches)
        await cell.end("succeeded")
        await eventually(lambda: shared_house.runtime.register.newest(question["invocation"]) is None)
        await eventually(lambda: not shared_house.runtime.desk.grants.active())


async def test_a_stopped_session_waits_for_one_verdict(house: House) -> None:
    async with house.cell(), house.client() as agent, house.client("operator") as operator:
        document = (await agent.post("/v1/invocations", json=DRIVE)).json()
        early = await operator.post("/v1/reviews", json={"invocation": document["id"]})
        assert (early.status_code, early.json()["code"]) == (409, "wrong_status")
        await operator.post(f"/v1/invocations/{document['id']}/stop")
        await eventually(lambda: house.runtime.register.newest(document["id"]) is None)
    async with house.client("auditor") as auditor, house.client() as agent:
        waiting = (await auditor.get("/v1/reviews?status=waiting")).json()["items"]
        review = next(one for one in waiting if one["invocation"] == document["id"])
        verdict = {"verdict": "accepted", "note": "the boss tripped over it"}
        place = f"/v1/reviews/{review['id']}/resolve"
        assert (await auditor.post(place, json=verdict)).json()["verdict"]["by"] == "auditor"
        second = await auditor.post(place, json=verdict)
        assert (second.status_code, second.json()["code"]) == (409, "already_reviewed")
        assert "the boss" not in (await agent.get(f"/v1/invocations/{document['id']}/trace")).text
        again = await auditor.post("/v1/reviews", json={"invocation": document["id"]})
        assert (again.status_code, again.json()["code"]) == (409, "already_reviewed")


async def test_every_console_is_told_how_many_reviews_wait_and_what_slides_in(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reviews, "SHOWN", 1)
    async with house.cell() as cell, house.client() as agent, house.client("operator") as operator:
        for _ in range(3):
            document = {"status": "deferred"}
            while document["status"] == "deferred":  # a puppet says how it is when it is told to
                await cell.say_state()
                document = (await agent.post("/v1/invocations", json=DRIVE)).json()
            await operator.post(f"/v1/invocations/{document['id']}/stop")
            await eventually(lambda name=document["id"]: house.runtime.register.newest(name) is None)
        newer, middle, oldest = (await operator.get("/v1/reviews?status=waiting")).json()["items"]
        async with signed_in(house) as screen:
            snapshot = await screen.until_type("snapshot")
            assert (snapshot["reviews"], snapshot["reviews_waiting"]) == ([oldest], 3)
            closed = (await operator.post(f"/v1/reviews/{oldest['id']}/resolve", json={"verdict": "accepted"})).json()
            update = await screen.until(lambda message: "reviews_waiting" in message)
            assert (update["reviews"], update["reviews_waiting"]) == ([closed, middle], 2)
        judged = (await operator.get("/v1/reviews?status=judged&limit=1")).json()["items"]
        assert judged == [closed]
        asked = await operator.get(f"/v1/reviews?invocation={newer['invocation']}")
        assert asked.json() == {"items": [newer], "next": None}


async def test_every_console_sees_grants_come_and_go(shared_house: House) -> None:
    async with shared_house.cell(), signed_in(shared_house, "operator_2") as screen:
        assert (await screen.until_type("snapshot"))["grants"] == []
        async with shared_house.client("operator") as operator:
            given = (await operator.post("/v1/grants", json=GRANT)).json()
            assert (await screen.until(lambda message: message.get("grants")))["grants"] == [given]
            async with signed_in(shared_house) as late:
                assert (await late.until_type("snapshot"))["grants"] == [given]
            await operator.post(f"/v1/grants/{given['id']}/revoke")
        shown = await screen.until(lambda message: message.get("grants", [given])[-1]["status"] == "ended")
        assert shown["grants"][0]["ended"]["by"] == "operator"
