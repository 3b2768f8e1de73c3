"""Review afterwards: what waits for a verdict, who gives it, and that it is given once."""

from __future__ import annotations

import asyncio
from typing import Any

import orjson
import pytest

from app.governance.model import Role
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict, Forbidden, NotFound
from app.runtime.invocation import Principal

from .conftest import AGENT, AUDITOR, ENGINEER, OPERATOR, HandCell, House, navigate

pytestmark = pytest.mark.anyio


@pytest.fixture
def house(house: House) -> House:
    house.profile = "sim-relaxed"
    return house


async def finished(runtime: Runtime, cell: HandCell, outcome: str) -> str:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    assert document["status"] == "running", document
    await cell.launched(document["id"])
    await cell.ended(document["id"], outcome)
    return str(document["id"])


async def refused(words: Any) -> str:
    with pytest.raises(Conflict) as found:
        await words
    assert found.value.status == 409
    return found.value.code


async def test_a_session_that_ended_badly_waits_for_a_verdict_recorded_with_its_end(
    runtime: Runtime, cell: HandCell
) -> None:
    shown: list[str] = []
    runtime.desk.reviews.on_changed = lambda review: shown.append(review.status)
    session = await finished(runtime, cell, "terminated")
    (review,), _ = await runtime.desk.reviews.list(status="waiting")
    assert (review["invocation"], review["outcome"], review["profile"]) == (session, "terminated", "sim-relaxed")
    assert [reason["code"] for reason in review["reasons"]] == ["reviewed_for_outcome"]
    assert ([one.public() for one in runtime.desk.reviews.waiting()], shown) == ([review], ["waiting"])
    kinds = [event["kind"] for event in await runtime.governor.trace(session, AUDITOR)]
    assert kinds[kinds.index("outcome") + 1] == "review"


async def test_what_went_well_or_never_ran_waits_for_nobody(runtime: Runtime, cell: HandCell) -> None:
    await finished(runtime, cell, "succeeded")
    document, _ = await runtime.governor.propose(Principal(name="stranger", role=Role.AGENT), navigate())
    assert document["status"] == "rejected"
    assert await runtime.desk.reviews.list() == ([], None)


async def test_a_verdict_is_recorded_once_and_its_note_stays_among_people(runtime: Runtime, cell: HandCell) -> None:
    session = await finished(runtime, cell, "stopped")
    (review,), _ = await runtime.desk.reviews.list()
    closed = await runtime.desk.reviews.resolve(review["id"], ENGINEER, "objected", "why on earth did it turn left")
    assert (closed["status"], closed["verdict"]["by"]) == ("objected", "erin")
    assert await refused(runtime.desk.reviews.resolve(review["id"], AUDITOR, "accepted")) == "already_reviewed"
    assert runtime.desk.reviews.waiting() == []
    assert (await runtime.desk.reviews.list(status="objected"))[0] == [closed]
    assert b"turn left" in orjson.dumps(await runtime.governor.trace(session, AUDITOR))
    theirs = orjson.dumps(await runtime.governor.trace(session, AGENT))
    assert b"objected" in theirs
    assert b"turn left" not in theirs


async def test_two_verdicts_at_once_are_one_verdict(runtime: Runtime, cell: HandCell) -> None:
    await finished(runtime, cell, "stopped")
    (review,), _ = await runtime.desk.reviews.list()
    both = await asyncio.gather(
        runtime.desk.reviews.resolve(review["id"], ENGINEER, "objected"),
        runtime.desk.reviews.resolve(review["id"], AUDITOR, "accepted"),
        return_exceptions=True,
    )
    assert [isinstance(one, Conflict) for one in both].count(True) == 1


async def test_nobody_reviews_what_they_proposed(runtime: Runtime, cell: HandCell) -> None:
    await finished(runtime, cell, "stopped")
    (review,), _ = await runtime.desk.reviews.list()
    with pytest.raises(Forbidden, match="themselves"):
        await runtime.desk.reviews.resolve(review["id"], Principal(name="planner", role=Role.OPERATOR), "accepted")
    with pytest.raises(NotFound):
        await runtime.desk.reviews.resolve("rev_none", ENGINEER, "accepted")


async def test_a_person_may_ask_for_a_review_where_the_profile_has_them(runtime: Runtime, cell: HandCell) -> None:
    session = await finished(runtime, cell, "succeeded")
    review = await runtime.desk.reviews.request(session, OPERATOR)
    assert [reason["code"] for reason in review["reasons"]] == ["review_requested"]
    assert await refused(runtime.desk.reviews.request(session, OPERATOR)) == "already_reviewed"
    await runtime.governor.set_profile(cell.id, "human-shared", OPERATOR)
    elsewhere = await finished(runtime, cell, "stopped")
    assert await refused(runtime.desk.reviews.request(elsewhere, OPERATOR)) == "review_not_enabled"
    assert (await runtime.desk.reviews.list())[0] == [review], "nothing else waits: the profile is not reviewed"
    document, _ = await runtime.governor.propose(AGENT, navigate())
    assert await refused(runtime.desk.reviews.request(document["id"], OPERATOR)) == "wrong_status"


async def test_reviews_that_wait_survive_a_restart(house: House) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        for _ in range(2):
            await finished(runtime, cell, "stopped")
        waiting = [one.public() for one in runtime.desk.reviews.waiting()]
    async with house.open() as runtime:
        assert [one.public() for one in runtime.desk.reviews.waiting()] == waiting
        await runtime.desk.reviews.resolve(waiting[0]["id"], ENGINEER, "accepted")
        assert [one.public() for one in runtime.desk.reviews.waiting()] == waiting[1:]
