"""A server that ends at any moment, and another that comes up on what it left."""

from __future__ import annotations

import asyncio
import sqlite3
from base64 import b64decode
from collections.abc import Callable
from contextlib import closing
from typing import Any, TypeAlias

import orjson
import pytest

from app.audit.cells import latches
from app.audit.errors import RecordUnavailable
from app.audit.event import EventDraft
from app.audit.examination import examine_file
from app.audit.places import Places
from app.audit.store import AuditStore
from app.runtime import fleet as fleet_module
from app.runtime.assembly import Runtime
from app.runtime.drafts import escalation_event
from app.runtime.errors import Conflict

from .conftest import AGENT, CELL, ENGINEER, OPERATOR, OPERATOR_2, HandCell, House, grasp, navigate, until

pytestmark = pytest.mark.anyio

Document: TypeAlias = dict[str, Any]


async def test_a_pending_approval_survives_and_can_be_answered(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, grasp())
        question = await first.desk.get(document["escalation"]["id"])
    async with house.open() as second:
        assert (await second.desk.list(status="pending"))[0] == [question]
        cell = await HandCell(second).dial()
        await cell.state()
        closed = await second.desk.resolve(question["id"], OPERATOR, "approve", question["digest"])
        assert closed["status"] == "approved"
        await cell.expect("launch")
        assert (await second.governor.invocation(document["id"], AGENT))["status"] == "running"


async def test_what_is_overdue_at_start_has_expired(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, grasp())
    house.wall_s.offset_s = 121.0
    async with house.open() as second:
        ended = await second.governor.invocation(document["id"], AGENT)
        assert (ended["status"], ended["outcome"]) == ("denied", "expired")
        with pytest.raises(Conflict) as refusal:
            await second.desk.resolve(document["escalation"]["id"], OPERATOR, "approve", "sha256:0")
        assert refusal.value.code == "escalation_expired"


async def test_a_session_whose_cell_held_on_waits_for_a_human_and_nothing_moves(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, navigate())
        await cell.launched(document["id"])
    async with house.open() as second:
        assert (await second.governor.invocation(document["id"], AGENT))["status"] == "running"
        back = await HandCell(second, seq=cell.seq, invocation=document["id"], status="escalated").dial()
        await back.state()
        now = await second.governor.invocation(document["id"], AGENT)
        assert now["status"] == "escalated"
        busy, _ = await second.governor.propose(AGENT, navigate())
        assert busy["admission"]["reasons"][0]["code"] == "cell_busy"
        assert not back.all("launch")
        assert not back.all("human")


async def test_a_pause_that_its_cell_may_not_have_heard_stands_after_a_start(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, navigate())
        await cell.launched(document["id"])
        await first.governor.pause(document["id"], OPERATOR)
    async with house.open() as second:
        back = await HandCell(second, seq=cell.seq, invocation=document["id"], status="escalated").dial()
        assert back.ops() == ["pause"]
        question = second.desk.pending_for(document["id"])
        assert question is not None
        assert "it was paused by `olivia`" in question.reasons[-1]["message"]
        await back.report("human", document["id"], op="pause", done=True, refused=None)
    async with house.open() as third:
        again = await HandCell(third, seq=back.seq, invocation=document["id"], status="escalated").dial()
        assert again.ops() == []


async def test_a_word_that_is_none_keeps_no_server_from_starting(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, navigate())
        await cell.launched(document["id"])
        strange = EventDraft(kind="human", actor=CELL, invocation=document["id"], body={"op": ["resume"]})
        await first.register.append([strange])
    async with house.open() as second:
        assert (await second.governor.invocation(document["id"], AGENT))["status"] == "running"


async def test_the_end_of_a_takeover_that_its_cell_refused_ends_no_other_after_a_start(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        name = (await first.governor.propose(AGENT, navigate()))[0]["id"]
        await cell.launched(name)
        await first.governor.take_over(name, OPERATOR)
        await cell.report("launch", name, capability="takeover")
        back = asyncio.create_task(first.governor.release(name, OPERATOR, "resume"))
        while len(cell.all("launch")) < 3:
            await cell.state()
            await asyncio.sleep(0.01)
        ending = asyncio.create_task(first.governor.release(name, OPERATOR, "end"))
        await until(lambda: cell.ops() == ["end_takeover"])
        await cell.report("status", name, status="running", before="recovering", reason="handed_back")
        await cell.report("human", name, op="end_takeover", refused="not_taken_over")  # the session has it by then
        await asyncio.gather(back, ending)
        assert first.fleet.cell(CELL).ending(name) is None
        await first.governor.take_over(name, OPERATOR_2)
        await cell.report("launch", name, capability="takeover")
    async with house.open() as second:
        again = await HandCell(second, seq=cell.seq, invocation=name, status="escalated").dial()
        assert "end_takeover" not in again.ops()


async def test_no_cell_says_of_its_session_that_what_it_is_bound_by_was_not_sent(house: House) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        document, _ = await runtime.governor.propose(AGENT, navigate())
        await cell.launched(document["id"])
        bound = runtime.register.newest(document["id"])
        assert bound is not None
        assert bound.terms.recoveries
        said = {"authorization": bound.terms.authorization, "policy_version": "sha256:another"}
        await cell.report("cell", document["id"], what="not_sent", **said)
        await cell.hang_up()
    async with house.open() as runtime:
        after = runtime.register.newest(document["id"])
        assert after is not None
        assert (after.policy_version, after.terms.recoveries) == (bound.policy_version, bound.terms.recoveries)


async def test_a_session_whose_cell_died_is_a_fault(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, navigate())
        await cell.launched(document["id"])
    async with house.open() as second:
        back = await HandCell(second, boot="boot-2", seq=cell.seq).dial()
        await back.state()
        final = await second.governor.invocation(document["id"], AGENT)
        assert (final["status"], final["outcome"]) == ("failed", "fault")
        again, _ = await second.governor.propose(AGENT, navigate())
        assert again["status"] == "running", "the cell is free"


async def test_a_launch_the_cell_never_got_is_a_fault_when_the_cell_says_so(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, navigate())
    async with house.open() as second:
        back = await HandCell(second).dial()
        final = await second.governor.invocation(document["id"], AGENT)
        assert (final["status"], final["outcome"]) == ("failed", "fault")
        assert not back.all("launch"), "an old authorization is never sent again"


async def test_a_question_about_what_has_ended_is_withdrawn_at_the_next_start(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, navigate())
        await cell.launched(document["id"])
        await cell.report("escalation", document["id"], reason="link")
        question = first.desk.pending_for(document["id"])
        assert question is not None
        await cell.ended(document["id"], "stopped")
    store = AuditStore.open(house.folder)
    await store.append([escalation_event(question)], [question.row()])  # one that stays open
    await store.close()
    async with house.open() as second:
        assert (await second.desk.list(status="pending"))[0] == []
        assert (await second.desk.get(question.id))["status"] == "withdrawn"
        (*_, said) = await second.store.events(kind="escalation")
        assert said.payload()["escalation"]["status"] == "withdrawn"
        assert (await second.governor.invocation(document["id"], AGENT))["escalation"]["status"] == "withdrawn"


async def test_nobody_answers_a_question_about_what_has_ended(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, navigate())
        await cell.launched(document["id"])
        await cell.report("escalation", document["id"], reason="link")
        question = first.desk.pending_for(document["id"])
        assert question is not None
        await cell.ended(document["id"], "stopped")
        first.desk.hold(question)
        with pytest.raises(Conflict) as refusal:
            await first.desk.resolve(question.id, OPERATOR, "deny", question.digest)
        assert refusal.value.code == "already_resolved"
        assert (await first.desk.get(question.id))["status"] == "withdrawn"


async def test_profile_latch_and_progress_survive(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        await cell.report("cell", what="started")
        await first.governor.set_profile(CELL, "test-audit", OPERATOR)
        await first.governor.estop(CELL, OPERATOR)
    async with house.open() as second:
        (known,) = second.governor.cells()
        assert (known["id"], known["profile"], known["latched"], known["online"]) == (CELL, "test-audit", True, False)
        back = await HandCell(second, seq=cell.seq).dial()
        welcome = await back.expect("welcome")
        assert (welcome.profile, welcome.acknowledged) == ("test-audit", cell.seq)
        await back.expect("estop")


async def test_an_idempotency_key_survives(house: House) -> None:
    async with house.open() as first:
        document, _ = await first.governor.propose(AGENT, navigate(), "key-1")
    async with house.open() as second:
        again, created = await second.governor.propose(AGENT, navigate(), "key-1")
        assert not created
        assert again == document
        with pytest.raises(Conflict) as refusal:
            await second.governor.propose(AGENT, grasp(), "key-1")
        assert refusal.value.code == "idempotency_mismatch"


async def test_every_start_is_recorded_and_the_log_verifies(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, navigate())
    async with house.open() as second:
        boots = await second.store.events(kind="boot")
        assert [event.payload()["unfinished"] for event in boots] == [[], [document["id"]]]
        assert (await second.store.verify()).ok


async def test_the_record_says_what_telemetry_was_lost_with_the_server(house: House) -> None:
    async with house.open() as first:
        await (await HandCell(first).dial()).state()
        name = (await first.governor.propose(AGENT, navigate()))[0]["id"]
        folder = first.store.places.telemetry
    folder.mkdir(exist_ok=True)
    for left in (f"{name}.mcap.partial", f"{name}-2.mcap.partial", "inv_of_another_log.mcap.partial"):
        (folder / left).write_bytes(b"unfinished")  # as a server leaves it that is killed
    for _ in range(2):  # once for each
        async with house.open() as later:
            told = [event.payload()["failed"] for event in await later.store.events(kind="telemetry")]
            assert told == ["the server ended before it was complete"] * 2


async def test_a_second_file_of_telemetry_does_not_overwrite_the_first(house: House) -> None:
    async with house.open() as first:
        first.telemetry.write("inv_1", [])
    async with house.open() as second:
        second.telemetry.write("inv_1", [])
        await until(lambda: len(list(second.store.places.telemetry.iterdir())) == 2)


def rewrite(house: House, table: str, name: str, forge: Callable[[Document], object]) -> None:
    """Change a row's document, and its status with it, as somebody would who has the file."""
    with closing(sqlite3.connect(Places(house.folder).database)) as database, database:
        (kept,) = database.execute(f"SELECT document FROM {table} WHERE id = ?", (name,)).fetchone()  # noqa: S608
        document = orjson.loads(kept)
        forge(document)
        values = orjson.dumps(document), document["status"], name
        database.execute(f"UPDATE {table} SET document = ?, status = ? WHERE id = ?", values)  # noqa: S608


FORGED: dict[str, tuple[str, Callable[[Document], object]]] = {
    "another object": ("escalations", lambda row: row["effective"].update(object_id="driver_1")),
    "an approval": ("escalations", lambda row: row["approvals"].append({"by": "oskar", "at": row["created_at"]})),
    "a later deadline": ("escalations", lambda row: row.update(expires_at="2099-01-01T00:00:00.000Z")),
    "an answer": ("escalations", lambda row: row.update(status="approved")),
    "another proposal": ("invocations", lambda row: row["effective"].update(object_id="driver_1")),
    "another capability": ("invocations", lambda row: row.update(capability="place_object")),
    "another mode": ("invocations", lambda row: row["_"].update(mode="careful")),
}


@pytest.mark.parametrize("forged", FORGED)
async def test_what_is_asked_after_a_start_is_what_the_log_says_was_asked(house: House, forged: str) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, grasp())
        question = await first.desk.get(document["escalation"]["id"])
    table, forge = FORGED[forged]
    name = question["id"] if table == "escalations" else document["id"]
    rewrite(house, table, name, forge)
    async with house.open() as second:
        assert name in (second.register.trouble() or "")
        assert (await second.desk.get(question["id"])) == question
        cell = await HandCell(second).dial()
        await cell.state()
        await second.desk.resolve(question["id"], OPERATOR, "approve", question["digest"])
        permit = orjson.loads(b64decode((await cell.expect("launch")).body))
        assert (permit["capability"], permit["params"]) == ("grasp_object", question["effective"])
        assert permit["mode"] == "normal"
        assert [word["by"] for word in (await second.desk.get(question["id"]))["approvals"]] == [OPERATOR.name]
        boot: Document = (await second.store.events(kind="boot"))[-1].payload()
        assert list(boot["unfounded"]) == [name]


async def test_a_start_signs_nothing_about_a_question_that_only_its_row_has_open(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, grasp())
        asked = document["escalation"]["id"]
        await first.desk.resolve(asked, OPERATOR, "deny", (await first.desk.get(asked))["digest"])
        size = len(await first.store.events())
    rewrite(house, "escalations", asked, lambda row: row.update(status="pending", approvals=[]))
    house.sound = False
    async with house.open() as second:
        await second.desk.expire_due()
        assert list(second.register.unfounded) == [asked]
        assert second.desk.pending() == []
        assert "escalation" not in {event.kind for event in (await second.store.events())[size:]}


async def test_nothing_comes_of_a_row_that_the_log_does_not_know(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, grasp())
    asked = document["escalation"]["id"]
    with closing(sqlite3.connect(Places(house.folder).database)) as database, database:
        for table, name in (("invocations", document["id"]), ("escalations", asked)):
            columns = [row[1] for row in database.execute(f"PRAGMA table_info({table})")]
            copied = ", ".join("'forged'" if column == "id" else column for column in columns)
            database.execute(f"INSERT INTO {table} SELECT {copied} FROM {table} WHERE id = ?", (name,))  # noqa: S608
    house.sound = False
    async with house.open() as second:
        assert [known.id for known in second.register.live()] == [document["id"]]
        assert [question.id for question in second.desk.pending()] == [asked]
        assert list(second.register.unfounded) == ["forged"]


@pytest.mark.parametrize("setting", ["policy_active", f"profile/{CELL}"])
async def test_no_setting_that_was_changed_beside_the_log_decides(house: House, setting: str) -> None:
    async with house.open() as first:
        await HandCell(first).dial()
        await first.governor.set_profile(CELL, "real-restricted", ENGINEER)
    forged = orjson.dumps("sim-relaxed" if "/" in setting else {"digest": "sha256:0", "source": "request", "why": "?"})
    with closing(sqlite3.connect(Places(house.folder).database)) as database, database:
        values = forged, setting
        assert database.execute("UPDATE settings SET value = ? WHERE name = ?", values).rowcount == 1
    async with house.open() as second:
        assert list(second.register.unfounded) == [setting]
        assert second.kernel.policy.digest == house.policy.digest
        assert second.fleet.profile(second.fleet.cell(CELL)) == "real-restricted"
    async with house.open() as third:
        assert third.fleet.profile(third.fleet.cell(CELL)) == "real-restricted"


def set_row(house: House, name: str, value: object) -> None:
    """Change a setting as somebody would who has the file, or have it gone (None)."""
    with closing(sqlite3.connect(Places(house.folder).database)) as database, database:
        if value is None:
            changed = database.execute("DELETE FROM settings WHERE name = ?", (name,))
        else:
            put = "INSERT OR REPLACE INTO settings VALUES (?, ?, '2026-03-01T09:30:00.000Z')"
            changed = database.execute(put, (name, orjson.dumps(value)))
        assert changed.rowcount == 1


@pytest.mark.parametrize("forgets", ["false", "gone", "every row of the cell"])
async def test_a_stop_that_stands_in_the_log_is_latched_whatever_became_of_its_row(house: House, forgets: str) -> None:
    async with house.open() as first:
        for name in (CELL, "workcell-2", "workcell-3"):
            await (await HandCell(first, id=name).dial()).state()
        await first.governor.estop(CELL, OPERATOR)
        await first.governor.estop("workcell-2", OPERATOR)
        await first.governor.reset("workcell-2", OPERATOR)
    set_row(house, f"estop/{CELL}", False if forgets == "false" else None)
    if forgets == "every row of the cell":
        with closing(sqlite3.connect(Places(house.folder).database)) as database, database:
            database.execute("DELETE FROM cell_progress WHERE cell = ?", (CELL,))
    assert [f"`estop/{CELL}` in the table" in found for found in examine_file(house.folder).state] == [True]
    async with house.open() as second:
        assert {known["id"]: known["latched"] for known in second.governor.cells()} == {
            CELL: True, "workcell-2": False, "workcell-3": False
        }  # fmt: skip
        assert list(second.register.unfounded) == [f"estop/{CELL}"]
        assert "by the log a stop is latched" in second.register.unfounded[f"estop/{CELL}"]
        back = await HandCell(second, journal="jrn-new").dial()  # its folder is lost, and it knows of no stop
        await back.expect("estop")
        await back.state()
        await second.governor.reset(CELL, OPERATOR)
    async with house.open() as third:
        assert not any(known["latched"] for known in third.governor.cells())
        assert third.register.unfounded == {}


async def test_a_stop_that_only_its_row_knows_stays_latched_and_is_named(house: House) -> None:
    async with house.open() as first:
        await HandCell(first).dial()
    set_row(house, f"estop/{CELL}", True)
    house.sound = False
    async with house.open() as second:
        assert second.fleet.cell(CELL).latched
        assert "by the log no stop is latched: it stays so until a reset" in second.register.unfounded[f"estop/{CELL}"]


@pytest.mark.parametrize("resets", [True, False])
async def test_a_stop_that_a_cell_latched_by_itself_outlives_its_folder(house: House, resets: bool) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.report("cell", what="estop", detail="")
        if resets:
            await cell.report("cell", what="reset", detail="", actor=OPERATOR.name)
    async with house.open() as second:
        assert second.fleet.cell(CELL).latched is not resets
        assert second.register.unfounded == {}, "no row repeats it"


@pytest.mark.parametrize("reported", ["never", "before it was missed", "after it was missed"])
async def test_a_reset_of_which_its_cell_has_said_nothing_leaves_it_latched_at_a_start(
    house: House, monkeypatch: pytest.MonkeyPatch, reported: str
) -> None:
    monkeypatch.setattr(fleet_module, "RESET_S", 0.05)
    async with house.open() as first:
        cell = await HandCell(first, obeys=False).dial()
        await cell.state()
        await first.governor.estop(CELL, OPERATOR)
        resetting = asyncio.create_task(first.governor.reset(CELL, OPERATOR))
        await cell.expect("reset")
        if reported == "before it was missed":
            await cell.report("cell", what="reset")
        await resetting
        if reported == "after it was missed":
            await cell.report("cell", what="reset")
    async with house.open() as second:
        assert second.fleet.latched(second.fleet.cell(CELL)) is (reported == "never")
        assert second.register.unfounded == {}


@pytest.mark.parametrize("back", ["as it was", "without its folder", "stopped"])
@pytest.mark.parametrize("seen", [True, False])
async def test_a_stop_whose_reset_was_not_heard_is_left_where_its_cell_says_so_whichever_server_hears_that(
    house: House, monkeypatch: pytest.MonkeyPatch, back: str, seen: bool
) -> None:
    monkeypatch.setattr(fleet_module, "RESET_S", 0.05)
    journal, stopped = "jrn-2" if back == "without its folder" else "jrn-1", back != "as it was"

    async def returns(server: Runtime) -> HandCell:
        assert server.governor.cells()[0]["latched"], "it has not said yet how it is"
        cell = await HandCell(server, journal=journal, latched=back == "stopped").dial()
        assert server.governor.cells()[0]["latched"]
        await cell.state()
        await server.fleet.tend_once()
        await until(lambda: cell.latched is stopped)
        assert server.governor.cells()[0]["latched"] is stopped
        return cell

    async with house.open() as first:
        cell = await HandCell(first, obeys=False).dial()
        await cell.state()
        await first.governor.estop(CELL, OPERATOR)
        assert (await first.governor.reset(CELL, OPERATOR))["latched"]
        await cell.hang_up()
        name = ""
        if seen:
            cell = await returns(first)
        if seen and not stopped:
            document, _ = await first.governor.propose(AGENT, navigate())
            await cell.launched(name := document["id"])
    async with house.open() as second:
        if name:
            assert not second.governor.cells()[0]["latched"]
            cell = await HandCell(second, seq=2, invocation=name, status="escalated").dial()
            await cell.state()
            await until(lambda: not second.fleet.cell(CELL).behind)
            assert (cell.all("estop"), cell.ops()) == ([], [])
            return
        cell = await returns(second)
        if stopped:
            await second.governor.reset(CELL, OPERATOR)
        assert not second.governor.cells()[0]["latched"]
        assert not (await second.store.ask(latches))[CELL].latched


@pytest.mark.parametrize(
    "back",
    [("jrn-2", 0), ("jrn-1", 1), ("jrn-1", 2)],
    ids=["made anew", "an older copy", "an older copy that a run has begun with a report of its own"],
)
async def test_a_stop_that_a_cell_latched_by_itself_outlives_its_folder_while_the_server_runs(
    house: House, back: tuple[str, int]
) -> None:
    journal, seq = back
    async with house.open() as runtime:
        cell = await HandCell(runtime, latched=True).dial()
        await cell.report("cell", what="news", detail="")
        await cell.report("cell", what="estop", detail="")
        await cell.hang_up()
        again = await HandCell(runtime, journal=journal, seq=seq).dial()
        await again.expect("estop")
        again.seq = max(again.seq, runtime.fleet.cell(CELL).up_seq)  # what it says since is numbered behind the log
        await again.report("cell", what="estop", detail="")
        await runtime.governor.reset(CELL, OPERATOR)
        await again.report("cell", what="reset", detail="")
        await again.hang_up()
        third = await HandCell(runtime, journal="jrn-3").dial()
        await third.state()
        assert not runtime.governor.cells()[0]["latched"]


@pytest.mark.parametrize("restarts", [False, True])
async def test_a_session_that_a_stop_met_ends_by_it_also_where_the_cell_heard_neither_that_nor_its_reset(
    house: House, monkeypatch: pytest.MonkeyPatch, restarts: bool
) -> None:
    monkeypatch.setattr(fleet_module, "RESET_S", 0.05)

    async def returns(server: Runtime) -> None:
        back = await HandCell(server, seq=cell.seq, invocation=name, status="escalated").dial()
        await back.state()
        await until(lambda: not server.fleet.cell(CELL).behind)
        assert (back.all("estop"), back.ops()) == ([], ["stop"])

    async with house.open() as first:
        cell = await HandCell(first, obeys=False).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, navigate())
        await cell.launched(name := document["id"])
        await first.governor.estop(CELL, OPERATOR)
        assert (await first.governor.reset(CELL, OPERATOR))["latched"]
        await cell.hang_up()
        if not restarts:
            await returns(first)
    if restarts:
        async with house.open() as second:
            await returns(second)


async def test_a_stop_that_was_recorded_after_its_reset_was_said_before_it(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        await first.governor.estop(CELL, OPERATOR)
        await first.governor.reset(CELL, OPERATOR)
        (*_, stop, reset) = await first.store.events(kind="human")
        for said_at in (reset.at, None):
            body = stop.payload() if said_at is None else {**stop.payload(), "said_at": said_at}
            await first.store.append([EventDraft(kind="human", actor=OPERATOR.name, body=body)])
            latch = (await first.store.ask(latches))[CELL]
            assert latch.latched is (said_at is None)
        house.sound = False


@pytest.mark.parametrize("row", ["cell_progress", "journals"])
async def test_no_report_is_acknowledged_that_only_a_row_says_is_recorded(house: House, row: str) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        for number in range(3):
            await cell.report("cell", what=f"news {number}")
        await cell.report("alert", "inv_strange", signal="anomaly")  # kept as what it is, and numbered too
        if row == "journals":
            await cell.hang_up()
            other = await HandCell(first, journal="jrn-2").dial()
            await other.report("cell", what="other")
    if row == "journals":
        set_row(house, f"journals/{CELL}", {"jrn-1": 1000})
    else:
        with closing(sqlite3.connect(Places(house.folder).database)) as database, database:
            database.execute("UPDATE cell_progress SET up_seq = 1000")
    assert ["which holds them up to `4`" in found for found in examine_file(house.folder).state] == [True]
    async with house.open() as second:
        assert list(second.register.unfounded) == [f"{row}/{CELL}"]
        assert "`1000`" in second.register.unfounded[f"{row}/{CELL}"]
        back = await HandCell(second, seq=4).dial()
        assert (await back.expect("welcome")).acknowledged == 4
        await back.report("cell", what="and on")
        said = [event.payload().get("what") for event in await second.store.events(kind="cell", actor=CELL)]
        assert said.count("and on") == 1
    async with house.open() as third:
        assert third.register.unfounded == {}
        assert third.fleet.cell(CELL).taken["jrn-1"] == 5


async def test_reports_follow_the_word_that_says_in_which_journal_they_count(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[object] = []

    async def full(*given: object, **_: object) -> list[int]:
        tried.append(given)
        await asyncio.sleep(0.02)
        raise RecordUnavailable("no space left on device")

    async with house.open() as first:
        await (await HandCell(first).dial()).report("cell", what="old")
        assert first.fleet.cell(CELL).attachment is not None
        await first.fleet.leave(first.fleet.cell(CELL).attachment)  # pyright: ignore[reportArgumentType]
        with monkeypatch.context() as disk:
            disk.setattr(first.store, "append", full)
            cell = HandCell(first, journal="jrn-2")
            dialing = asyncio.create_task(cell.dial())
            await until(lambda: len(tried) == 2)  # that the cell is there is being said once more, in vain
        await cell.say(cell.event("cell", what="new"))
        await dialing
        await cell.acknowledged(1)
    async with house.open() as second:
        assert second.register.unfounded == {}
        assert second.fleet.cell(CELL).taken == {"jrn-1": 1, "jrn-2": 1}
