"""Review afterwards: what waits for a verdict, who gives it, and that it is given once."""

from __future__ import annotations

import asyncio
import sqlite3
from typing import Any

import orjson
import pytest

from app.audit.errors import RecordUnreadable
from app.audit.places import Places
from app.governance.model import Role
from app.runtime import reviews as reviews_module
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict, Forbidden, NotFound
from app.runtime.invocation import Principal
from app.runtime.queue import Queue
from app.runtime.review import Review

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
    runtime.desk.reviews.on_changed = lambda changed: shown.extend(review.status for review in changed)
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


@pytest.mark.parametrize(
    "forged", [{"outcome": "succeeded", "agent": "nobody"}, {"verdict": None, "status": "waiting"}]
)
async def test_a_verdict_repeats_nothing_that_only_a_row_says(house: House, forged: dict[str, Any]) -> None:
    """What is signed with the verdict would be taken for what was reviewed."""
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        await finished(runtime, cell, "stopped")
        (review,), _ = await runtime.desk.reviews.list()
        if "verdict" in forged:
            await runtime.desk.reviews.resolve(review["id"], ENGINEER, "objected")
    with sqlite3.connect(Places(house.folder).database) as database:
        document = orjson.dumps({**review, **forged})
        values = document, str(forged.get("status", review["status"])), review["id"]
        database.execute("UPDATE reviews SET document = ?, status = ? WHERE id = ?", values)
    database.close()
    async with house.open() as runtime:
        if "verdict" in forged:
            assert await refused(runtime.desk.reviews.resolve(review["id"], AUDITOR, "accepted")) == "already_reviewed"
            house.sound = False
        else:
            closed = await runtime.desk.reviews.resolve(review["id"], AUDITOR, "accepted")
            assert (closed["outcome"], closed["agent"]) == (review["outcome"], review["agent"])


async def test_what_comes_up_for_review_is_what_the_log_says_ended(house: House) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        session = await finished(runtime, cell, "succeeded")
        row = await runtime.store.row("invocations", id=session)
    assert row is not None
    with sqlite3.connect(Places(house.folder).database) as database:
        forged = orjson.dumps({**orjson.loads(row["document"]), "outcome": "stopped", "agent": "nobody"})
        database.execute("UPDATE invocations SET document = ? WHERE id = ?", (forged, session))
    database.close()
    house.sound = False
    async with house.open() as runtime:
        review = await runtime.desk.reviews.request(session, ENGINEER)
        assert (review["outcome"], review["agent"]) == ("succeeded", AGENT.name)


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


def review(name: str, risk: str = "low", at: str = "2026-11-22T10:00:00.000Z") -> Review:
    return Review(
        id=name,
        invocation=f"inv_{name}",
        status="waiting",
        capability="navigate_to",
        agent="planner",
        cell=None,
        profile="sim-relaxed",
        risk=risk,
        outcome="stopped",
        reasons=(),
        verdict=None,
        created_at=at,
        updated_at=at,
    )


def named(queue: Queue, count: int = 9) -> list[str]:
    return [one.id for one in queue.first(count)]


def test_a_queue_begins_with_the_higher_risk_then_with_what_waits_longest() -> None:
    queue = Queue(9)
    for one in (review("late", at="2026-11-22T11:00:00.000Z"), review("b"), review("grave", "critical"), review("a")):
        queue.add(one)
    queue.add(review("high", "high"))
    queue.add(review("medium", "medium"))
    assert named(queue) == ["grave", "high", "medium", "a", "b", "late"]
    assert (named(queue, 2), len(queue)) == (["grave", "high"], 6)


def test_a_queue_holds_no_more_than_it_may_and_counts_all() -> None:
    queue = Queue(2)
    everything = [review(f"r{place}", at=f"2026-11-22T10:00:0{place}.000Z") for place in range(5)]
    for one in everything:
        queue.add(one)
    assert (named(queue), len(queue), queue.short_of(2)) == (["r0", "r1"], 5, False)
    queue.remove(everything[0])
    queue.add(review("newest", at="2026-11-22T10:00:09.000Z"))  # it may come behind what is not held: there it stays
    assert (named(queue), len(queue), queue.short_of(2)) == (["r1"], 5, True)
    queue.remove(everything[4])
    assert (named(queue), len(queue)) == (["r1"], 4)
    queue.add(review("grave", "high"))
    assert (named(queue), len(queue)) == (["grave", "r1"], 5)
    queue.replace(everything[1:3], [f"r{place}" for place in range(1, 5)])
    assert (named(queue), len(queue), queue.short_of(3)) == (["r1", "r2"], 4, True)


async def test_of_more_than_are_shown_the_rest_slides_in_and_all_are_counted(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reviews_module, "SHOWN", 2)
    monkeypatch.setattr(reviews_module, "HELD", 3)
    monkeypatch.setattr(reviews_module, "PAGE", 2)
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        sessions = [await finished(runtime, cell, "stopped") for _ in range(7)]
        reviews = runtime.desk.reviews
        told: list[list[str]] = []
        reviews.on_changed = lambda changed: told.append([one.invocation for one in changed])
        for place, session in enumerate(sessions):
            assert [one.invocation for one in reviews.waiting()] == sessions[place : place + 2], "the oldest first"
            assert reviews.count == len(sessions) - place
            told.clear()
            await reviews.resolve(reviews.waiting()[0].id, ENGINEER, "accepted")
            slid_in = sessions[place + 2 : place + 3]
            heard = [name for changed in told for name in changed]
            assert (heard[0], heard[1:]) == (session, slid_in)
        assert (reviews.waiting(), reviews.count) == ([], 0)


@pytest.mark.parametrize("when", ["before", "behind"])
async def test_what_comes_while_the_record_is_read_is_counted_once(
    house: House, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        sessions = [await finished(runtime, cell, "stopped")]
        reviews, page = runtime.desk.reviews, runtime.store.page

        async def meanwhile(*args: Any, **how: Any) -> Any:
            if when == "before":
                sessions.append(await finished(runtime, cell, "stopped"))
            found = await page(*args, **how)
            if when == "behind":
                sessions.append(await finished(runtime, cell, "stopped"))
            return found

        monkeypatch.setattr(runtime.store, "page", meanwhile)
        await reviews.recall()
        assert [one.invocation for one in reviews.waiting()] == sessions
        assert reviews.count == 2


async def test_a_verdict_stands_whatever_reading_on_says(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reviews_module, "SHOWN", 1)
    monkeypatch.setattr(reviews_module, "HELD", 1)
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        for _ in range(3):
            await finished(runtime, cell, "stopped")
        reviews, page = runtime.desk.reviews, runtime.store.page

        async def fails(*_: Any, **__: Any) -> None:
            raise RecordUnreadable(house.folder, "disk I/O error")

        monkeypatch.setattr(runtime.store, "page", fails)
        closed = await reviews.resolve(reviews.waiting()[0].id, ENGINEER, "accepted")
        assert (closed["status"], reviews.waiting(), reviews.count) == ("accepted", [], 2)
        monkeypatch.setattr(runtime.store, "page", page)
        (other, _), _ = await reviews.list(status="waiting")
        await reviews.resolve(other["id"], ENGINEER, "accepted")
        assert (len(reviews.waiting()), reviews.count) == (1, 1), "the next verdict reads again"


async def test_what_is_judged_is_listed_whatever_waits(runtime: Runtime, cell: HandCell) -> None:
    sessions = [await finished(runtime, cell, "stopped") for _ in range(4)]
    reviews = runtime.desk.reviews
    for one, verdict in zip(reviews.waiting()[:2], ("accepted", "objected"), strict=True):
        await reviews.resolve(one.id, ENGINEER, verdict)
    judged, following = await reviews.list(status="judged", limit=1)
    assert [one["invocation"] for one in judged] == [sessions[1]]
    judged, following = await reviews.list(status="judged", limit=1, cursor=following)
    assert ([one["invocation"] for one in judged], following) == ([sessions[0]], None)
    (asked,), _ = await reviews.list(invocation=sessions[3])
    assert asked["status"] == "waiting"
    assert await reviews.list(status="judged", invocation=sessions[3]) == ([], None)
