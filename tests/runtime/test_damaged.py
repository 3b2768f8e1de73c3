"""Rows of state that a disk or a hand damaged: a server starts on them, says which, and lets nothing come of them."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace

import pytest

from app.audit.errors import RecordUnreadable, RowUnreadable
from app.audit.places import Places
from app.audit.reader import Row
from app.governance.model import GrantScope
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict, ExaminationFailed
from app.runtime.escalation import Escalation
from app.runtime.examining import Candidate, Examined
from app.runtime.grant import GrantRequest
from tests.examining import examine_here

from .conftest import AGENT, CELL, ENGINEER, OPERATOR, HandCell, House, grasp, navigate, until
from .test_fleet import running
from .test_versions import FASTER, SLOWER, put_in_force

pytestmark = pytest.mark.anyio

NONSENSE: dict[str, object] = {
    "no bytes": "a text",
    "no JSON": b"\xff\x00{",
    "no object": b"5",
    "nothing": b"null",
    "of another kind": b'{"id": "x"}',
}
WRONG: dict[str, object] = {**NONSENSE, "gone": None}
COMPARED = {"invocations", "escalations", "grants", "reviews"}  # with the log, by a verification


def damage(house: House, table: str, content: object, where: str = "true") -> None:
    """Write something else over what a table holds, as nothing of ours would."""
    column = {"settings": "value", "policy_files": "files"}.get(table, "document")
    with closing(sqlite3.connect(Places(house.folder).database)) as database, database:
        statement = f"UPDATE {table} SET {column} = ? WHERE {where}"  # noqa: S608
        assert database.execute(statement, (content,)).rowcount > 0
    house.sound = table not in COMPARED


def spoil(house: House, question: str, wrong: str) -> None:
    """Damage the row of a question, or have it gone."""
    if WRONG[wrong] is not None:
        damage(house, "escalations", WRONG[wrong], f"id = '{question}'")
        return
    with closing(sqlite3.connect(Places(house.folder).database)) as database, database:
        assert database.execute("DELETE FROM escalations WHERE id = ?", (question,)).rowcount == 1
    house.sound = False


async def lived_in(house: House) -> tuple[str, str, str]:
    """Leave a refusal, a question and a grant behind; returns their invocations, and the grant."""
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        refused, _ = await first.governor.propose(AGENT, navigate(version="9.0.0"))
        asked, _ = await first.governor.propose(AGENT, grasp())
        wanted = GrantRequest(capability="grasp_object", agent=AGENT.name, cell=CELL, scope=GrantScope.TIME, minutes=15)
        given = await first.desk.grants.give(OPERATOR, wanted)
    return refused["id"], asked["id"], given["id"]


@pytest.mark.parametrize("nonsense", NONSENSE.values(), ids=NONSENSE)
@pytest.mark.parametrize("table", ["invocations", "escalations", "grants", "policies"])
async def test_a_start_on_damaged_rows_says_which_and_lets_nothing_come_of_them(
    house: House, table: str, nonsense: object
) -> None:
    _, asked, _ = await lived_in(house)
    damage(house, table, nonsense)
    async with house.open() as second:
        assert second.kernel.policy.digest == house.policy.digest
        for listed in (
            second.governor.list(OPERATOR, {}),
            second.desk.list(),
            second.desk.grants.list(),
            second.desk.reviews.list(),
            second.versions.list(),
        ):
            found, _ = await listed
            assert all(isinstance(document, dict) for document in found)
        assert isinstance(await second.register.newest_ones(20), list)
        told = f"{second.register.trouble()} {second.register.stored.trouble()} {second.desk.grants.trouble()}"
        assert "audit verify" in told
        assert (second.desk.grants.active() == []) is (table == "grants")
        # What nobody can read any more is not asked; a question whose own row alone is damaged is, as the log has it.
        await second.desk.expire_due()
        assert ([question.invocation for question in second.desk.pending()] == [asked]) is (table != "invocations")


async def test_a_question_is_withdrawn_once_the_disk_can_say_what_became_of_its_invocation(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = await running(runtime, cell)
    await cell.report("escalation", name, reason="contact")
    question = runtime.desk.pending_for(name)
    assert question is not None
    await cell.ended(name, "stopped")
    row = runtime.store.row
    asked: list[str] = []

    async def unread(table: str, **key: str) -> Row | None:
        asked.append(table)
        raise RecordUnreadable(runtime.store.places.database, "disk I/O error")

    monkeypatch.setattr(runtime.store, "row", unread)
    runtime.desk.hold(question)
    await until(lambda: asked.count("invocations") > 1)
    assert not runtime.governor.broken
    assert runtime.desk.pending() == [question]
    monkeypatch.setattr(runtime.store, "row", row)
    await until(lambda: not runtime.desk.pending())
    assert (await runtime.desk.get(question.id))["status"] == "withdrawn"


async def test_a_question_about_an_invocation_that_is_gone_is_withdrawn(house: House) -> None:
    _, asked, _ = await lived_in(house)
    with closing(sqlite3.connect(Places(house.folder).database)) as database, database:
        assert database.execute("DELETE FROM invocations WHERE id = ?", (asked,)).rowcount == 1
    house.sound = False
    async with house.open() as second:
        await second.desk.expire_due()
        assert second.desk.pending() == []
        (question, *_), _ = await second.desk.list()
        assert question["status"] == "withdrawn"


async def test_one_damaged_row_stops_only_who_asks_for_it(house: House) -> None:
    refused, asked, _ = await lived_in(house)
    damage(house, "invocations", b"{", f"id = '{refused}'")
    async with house.open() as second:
        with pytest.raises(RowUnreadable, match=f"`{refused}` of the table `invocations`"):
            await second.governor.invocation(refused, OPERATOR)
        found, _ = await second.governor.list(OPERATOR, {})
        assert [document["id"] for document in found] == [asked]
        assert f"`{refused}` in the table `invocations`: its content is no JSON" in (
            second.register.stored.trouble() or ""
        )
        cell = await HandCell(second).dial()
        await cell.state()
        assert (await second.governor.propose(AGENT, navigate()))[0]["status"] == "running"


@pytest.mark.parametrize("nonsense", NONSENSE.values(), ids=NONSENSE)
async def test_settings_that_are_damaged_decide_nothing(house: House, nonsense: object) -> None:
    async with house.open() as first:
        await HandCell(first).dial()
        await first.governor.set_profile(CELL, "real-restricted", ENGINEER)
    damage(house, "settings", nonsense)
    async with house.open() as second:
        assert second.fleet.profile(second.fleet.cell(CELL)) == "real-restricted"
        assert second.kernel.policy.digest == house.policy.digest
        assert f"`profile/{CELL}` in the table `settings`" in (second.register.stored.trouble() or "")


async def test_a_stop_whose_row_is_damaged_stays_latched(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        await first.governor.estop(CELL, OPERATOR)
        await first.governor.reset(CELL, OPERATOR)
    damage(house, "settings", b"\xff", f"name = 'estop/{CELL}'")
    house.sound = False
    async with house.open() as second:
        assert second.fleet.cell(CELL).latched


async def held(house_cell: HandCell, reason: str) -> Escalation:
    """Have a session ask a human."""
    runtime = house_cell.runtime
    await house_cell.state()
    name = await running(runtime, house_cell)
    await house_cell.report("escalation", name, reason=reason)
    question = runtime.desk.pending_for(name)
    assert question is not None
    return question


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("answer", ["denied", "expired"])
async def test_a_session_that_was_to_end_while_its_cell_was_away_ends_whatever_became_of_its_questions_row(
    house: House, answer: str, wrong: str
) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        question = await held(cell, "separation_m")
        await cell.hang_up()
        if answer == "denied":
            await first.desk.resolve(question.id, OPERATOR, "deny", question.digest)
        else:
            house.wall_s.offset_s = 3600.0
            await first.desk.expire_due()
        assert (await first.desk.get(question.id))["status"] == answer
    spoil(house, question.id, wrong)
    async with house.open() as second:
        assert f"`{question.id}`" in (second.register.trouble() or "")
        back = await HandCell(second, seq=cell.seq, invocation=question.invocation, status="escalated").dial()
        await back.state(status="escalated")
        await until(lambda: back.ops() == ["resolve_terminate"])
        assert [word.expired for word in back.all("human")] == [answer == "expired"]
        assert second.desk.pending_for(question.invocation) is None, "nobody could let it go on"
        await back.report("status", question.invocation, status="escalated", reason="zone_margin_m")
        anew = second.desk.pending_for(question.invocation)
        assert anew is not None
        with pytest.raises(Conflict) as refusal:
            await second.desk.resolve(anew.id, OPERATOR, "approve", anew.digest)
        assert refusal.value.code == "ending"
        assert not back.all("launch")


@pytest.mark.parametrize("wrong", WRONG)
async def test_a_session_that_waits_although_it_was_answered_is_asked_about_whatever_became_of_its_questions_row(
    house: House, wrong: str
) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        question = await held(cell, "confirm:release")
        await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
        spoil(house, question.id, wrong)
        house.wall_s.offset_s = 3.0
        await until(lambda: runtime.desk.pending_for(question.invocation) is not None or bool(runtime.governor.broken))
        assert not runtime.governor.broken
        anew = runtime.desk.pending_for(question.invocation)
        assert anew is not None
        assert (anew.reasons[0]["code"], anew.phase) == ("not_gone_on", "release")
        assert cell.ops() == ["confirm"]


@pytest.mark.parametrize("wrong", NONSENSE)
async def test_a_session_departs_from_any_policy_when_nobody_can_read_its_own(house: House, wrong: str) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        name, under = await running(first, cell), first.kernel.policy.digest
        await put_in_force(first, FASTER)
        assert cell.ops() == []
        await cell.hang_up()
    damage(house, "policy_files", NONSENSE[wrong], f"digest = '{under}'")
    house.sound = False
    async with house.open() as second:
        back = await HandCell(second, seq=cell.seq, invocation=name, status="escalated").dial()
        await back.state()

        def asked() -> bool:
            question = second.desk.pending_for(name)
            return question is not None and "its_policy_is_gone" in {why["code"] for why in question.reasons}

        await until(asked)
        assert await put_in_force(second, SLOWER) == second.kernel.policy.digest


async def test_a_session_departs_from_any_policy_when_its_own_cannot_be_compiled(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        name = await running(first, cell)
        await put_in_force(first, FASTER)
        await cell.hang_up()

    async def broken(candidate: Candidate, against: Candidate | None) -> Examined:
        if candidate.files == house.policy.files:
            raise ExaminationFailed("it ended with `1`: TypeError")
        return await examine_here(candidate, against)

    async with replace(house, examine=broken).open() as second:
        assert {why["code"] for why in second.desk.departures.standing(name)} == {"its_policy_is_gone"}
        assert await put_in_force(second, SLOWER) == second.kernel.policy.digest
