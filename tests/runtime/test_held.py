"""What is held: whoever may have it go on answers what is asked now, and nothing goes on without a record."""

from __future__ import annotations

from typing import Any

import pytest

from app.audit.errors import RecordUnavailable
from app.audit.event import Event, EventDraft
from app.governance.model import EventKind
from app.protocol import LEASE_MS
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict
from app.runtime.recollection import PAGE, last_phase

from .conftest import AGENT, CELL, ENGINEER, OPERATOR, HandCell, House, grasp, navigate, until
from .test_desk import held
from .test_fleet import running
from .test_races import left_and_asked_about
from .test_versions import SLOWER, brought

pytestmark = pytest.mark.anyio


async def test_an_answer_to_a_lost_link_is_none_to_what_has_failed_since(house: House) -> None:
    async with house.open() as runtime:
        cell, name, shown = await left_and_asked_about(runtime)
        again = HandCell(runtime, seq=cell.seq, invocation=name, status="escalated")
        await again.dial()
        await again.state()
        await again.report("status", name, status="escalated", reason="object_lost")
        await again.report("escalation", name, reason="object_lost", failure="object_lost")
        now = runtime.desk.pending_for(name)
        assert now is not None
        with pytest.raises(Conflict) as refused:
            await runtime.desk.resolve(shown.id, OPERATOR, "approve", shown.digest)
        assert (now.id, refused.value.code, again.ops()) == (shown.id, "digest_mismatch", [])
        await runtime.desk.resolve(now.id, OPERATOR, "approve", now.digest)
        await until(lambda: again.ops() == ["resolve_continue"])


async def test_what_is_said_in_more_words_is_the_same_question(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await cell.report("status", name, status="escalated", reason="zone")
    first = runtime.desk.pending_for(name)
    await cell.report("escalation", name, reason="zone", failure="zone")
    second = runtime.desk.pending_for(name)
    assert first is not None
    assert second is not None
    assert (first.digest, first.reasons == second.reasons) == (second.digest, False)


async def test_what_is_to_hold_is_told_again_although_the_clock_was_put_back(house: House) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        made, _ = await runtime.governor.propose(AGENT, navigate())
        digest = await brought(runtime, SLOWER)
        await runtime.versions.activate(digest, ENGINEER, "a visitor")
        await until(lambda: cell.ops() == ["escalate"])
        house.wall_s.offset_s = -3600.0
        await cell.launched(made["id"])  # it was on its way when it was told
        await until(lambda: len(cell.ops()) > 1)
        assert set(cell.ops()) == {"escalate"}


@pytest.mark.parametrize("op", ["resume", "rollback", "approve"])
async def test_nothing_that_is_held_goes_on_while_the_log_is_damaged(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch, op: str
) -> None:
    if op == "approve":
        _, question = await held(runtime, cell)
        doing = runtime.desk.resolve(question["id"], OPERATOR, "approve", question["digest"])
    else:
        name = await running(runtime, cell)
        await runtime.governor.pause(name, OPERATOR)
        await cell.report("status", name, status="paused", reason="operator")
        doing = getattr(runtime.governor, op)(name, OPERATOR)
    before = cell.ops()
    monkeypatch.setattr(runtime.store, "damage", "the event `7` was changed")
    with pytest.raises(RecordUnavailable, match="the log is damaged, so nothing moves"):
        await doing
    assert cell.ops() == before


async def test_a_session_that_is_asked_about_and_still_recovers_may_be_paused(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    cell.status = "recovering"
    await cell.report("status", name, status="recovering", reason="retry")
    await cell.hang_up()
    away = runtime.fleet.cell(CELL)
    assert away.absent_since_s is not None
    away.absent_since_s -= LEASE_MS / 1000 + 0.1
    again = HandCell(runtime, seq=cell.seq, invocation=name, status="recovering")
    await again.dial()
    await again.state()
    await until(lambda: runtime.desk.pending_for(name) is not None)
    await runtime.governor.pause(name, OPERATOR)
    await until(lambda: again.ops()[-1:] == ["pause"])


async def test_silence_ends_a_session_although_another_question_cannot_be_recorded(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with house.open() as runtime:
        two = await HandCell(runtime, id="workcell-2").dial()
        await two.state()
        asked, _ = await runtime.governor.propose(AGENT, grasp(cell="workcell-2"))
        assert asked["status"] == "awaiting_approval"  # the older question, and so the first that is over
        one = await HandCell(runtime).dial()
        await one.state()
        made, _ = await runtime.governor.propose(AGENT, navigate(cell=CELL))
        await one.expect("launch")
        await one.launched(made["id"])
        await one.report("status", made["id"], status="escalated", reason="contact")
        append = runtime.register.append

        async def full(*_: Any, **__: Any) -> None:
            raise RecordUnavailable("no space left")

        monkeypatch.setattr(runtime.register, "append", full)
        house.wall_s.offset_s = 3600.0
        with pytest.raises(RecordUnavailable):
            await runtime.desk.expire_due()
        assert one.ops() == ["resolve_terminate"]
        monkeypatch.setattr(runtime.register, "append", append)
        house.wall_s.offset_s = 0.0


async def test_who_is_asked_again_waits_for_what_was_asked_last_and_not_for_all_that_was_said(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        name = await running(runtime, cell)
        alert = EventDraft(kind=EventKind.ALERT, actor=CELL, invocation=name, body={"rule": "separation"})
        await runtime.register.append([alert] * (2 * PAGE))
        await cell.report("escalation", name, reason="confirm:release")
        question = runtime.desk.pending_for(name)
        assert question is not None
        await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
        read: list[int] = []
        events = runtime.store.events

        async def counted(**asked: Any) -> list[Event]:
            found = await events(**asked)
            read.append(len(found))
            return found

        monkeypatch.setattr(runtime.store, "events", counted)
        house.wall_s.offset_s = 3.0
        await until(lambda: runtime.desk.pending_for(name) is not None)
        assert sum(read) <= PAGE
        anew = runtime.desk.pending_for(name)
        assert anew is not None
        assert (anew.reasons[0]["code"], anew.phase) == ("not_gone_on", "release")


async def test_a_question_is_found_however_much_was_said_since(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await cell.report("escalation", name, reason="confirm:release")
    alert = EventDraft(kind=EventKind.ALERT, actor=CELL, invocation=name, body={"rule": "separation"})
    await runtime.register.append([alert] * (PAGE + 1))
    assert await last_phase(runtime.store, name) == "release"
    assert await last_phase(runtime.store, "inv_nothing") is None
