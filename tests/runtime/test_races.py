"""What may happen between a check and its effect: nothing that was restrained moves, and no word is lost."""

from __future__ import annotations

import asyncio
import sqlite3
from contextlib import closing
from dataclasses import replace
from typing import Any

import pytest

from app.audit.errors import RecordUnavailable, RecordUnreadable
from app.audit.places import Places
from app.clock import monotonic_s
from app.governance.control import LAPSE_S
from app.protocol import BEAT_MS
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict
from app.runtime.escalation import Escalation
from app.runtime.invocation import Principal
from app.runtime.link import SILENT_S
from app.runtime.sessions import LOST_S
from app.runtime.succession import AGAIN_S

from .conftest import AGENT, CELL, ENGINEER, OPERATOR, OPERATOR_2, HandCell, House, grasp, navigate, until
from .test_fleet import Late, SlowCell, running
from .test_versions import SLOWER, put_in_force

pytestmark = pytest.mark.anyio


class Gate:
    """Lets nothing into the record until it is opened."""

    def __init__(self, runtime: Runtime, monkeypatch: pytest.MonkeyPatch) -> None:
        self.reached, self.open = asyncio.Event(), asyncio.Event()
        self._append = runtime.register.append
        monkeypatch.setattr(runtime.register, "append", self.append)

    async def append(self, *arguments: Any, **named: Any) -> Any:
        self.reached.set()
        await self.open.wait()
        return await self._append(*arguments, **named)


async def slow_cell(runtime: Runtime) -> SlowCell:
    cell = SlowCell(runtime)
    cell.gate.set()
    await cell.dial()
    await cell.state()
    return cell


async def stuck(cell: SlowCell) -> None:
    """Let the socket take nothing from here on."""
    cell.gate.clear()
    await until(lambda: cell.stuck == 1)  # a beat: what comes now waits behind it


async def heard(cell: HandCell, name: str, op: str, status: str) -> None:
    """Have the cell do a word, and say so as cells do."""
    await until(lambda: cell.ops()[-1:] == [op])
    await cell.report("status", name, status=status, reason="operator")
    await cell.report("human", name, op=op)


async def back(runtime: Runtime, cell: HandCell, status: str | None = None) -> HandCell:
    """Have the cell come back at once, within its lease."""
    again = HandCell(runtime, seq=cell.seq, invocation=cell.invocation, status=status or cell.status)
    return await again.dial()


async def held(runtime: Runtime, cell: HandCell) -> tuple[str, Escalation]:
    """Have a session hold for a human; return it, and what is asked."""
    name = await running(runtime, cell)
    await cell.report("escalation", name, reason="separation_m")
    await cell.state(status="escalated")
    question = runtime.desk.pending_for(name)
    assert question is not None
    return name, question


async def left_and_asked_about(runtime: Runtime) -> tuple[HandCell, str, Escalation]:
    """Have a cell leave in a session for so long that a human is asked; return both, and what is asked."""
    cell = await HandCell(runtime).dial()
    await cell.state()
    name = await running(runtime, cell)
    await cell.hang_up()
    away = runtime.fleet.cell(CELL)
    assert away.absent_since_s is not None
    away.absent_since_s -= LOST_S + 0.1
    await runtime.fleet.tend_once()
    question = runtime.desk.pending_for(name)
    assert question is not None
    return cell, name, question


# -- restraints that are lost with their link --------------------------------------------------------------------------


async def test_a_pause_that_is_lost_with_its_link_is_said_again(runtime: Runtime) -> None:
    cell = await slow_cell(runtime)
    name = await running(runtime, cell)
    await stuck(cell)
    assert (await runtime.governor.pause(name, OPERATOR))["recorded"]
    await cell.hang_up()
    again = await back(runtime, cell)
    await until(lambda: again.ops() == ["pause"])


async def test_a_pause_that_was_heard_is_not_said_again(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await runtime.governor.pause(name, OPERATOR)
    await cell.report("human", name, op="pause", done=True, refused=None)
    await cell.report("status", name, status="paused")
    await runtime.governor.resume(name, OPERATOR)
    await cell.hang_up()
    again = await back(runtime, cell)
    await again.expect("beat")
    assert again.ops() == []


async def test_whoever_is_asked_of_a_paused_session_is_told_who_paused_it(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await runtime.governor.pause(name, OPERATOR)
    await cell.report("human", name, op="pause", done=True, refused=None)
    await cell.report("status", name, status="paused")
    await cell.report("status", name, status="escalated", reason="link")
    await cell.report("escalation", name, reason="link", failure=None, paused=True)
    question = runtime.desk.pending_for(name)
    assert question is not None
    assert [why["code"] for why in question.reasons] == ["link", "paused"]
    message = f"it was paused by `{OPERATOR.name}`; whoever lets it go on lifts that pause"
    assert question.reasons[-1]["message"] == message
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    await cell.report("human", name, op="resolve_continue", done=True, refused=None)
    await cell.report("status", name, status="running")
    await cell.report("status", name, status="escalated", reason="zone")
    await cell.report("escalation", name, reason="zone", failure=None)
    again = runtime.desk.pending_for(name)
    assert again is not None
    assert [why["code"] for why in again.reasons] == ["zone"]


async def test_a_pause_from_before_a_start_is_told_of_without_its_name(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        name = await running(first, cell)
        await first.governor.pause(name, OPERATOR)
        await cell.report("human", name, op="pause", done=True, refused=None)
        await cell.report("status", name, status="paused")
        await cell.hang_up()
    async with house.open() as second:
        again = await back(second, cell, status="escalated")
        await again.report("escalation", name, reason="link", failure=None, paused=True)
        question = second.desk.pending_for(name)
        assert question is not None
        assert [why["code"] for why in question.reasons][-1] == "paused"
        assert question.reasons[-1]["message"].startswith("it was paused by an operator;")


async def test_a_pause_that_somebody_lifted_is_not_said_again(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await cell.report("status", name, status="paused")
    await runtime.governor.pause(name, OPERATOR)
    await runtime.governor.resume(name, OPERATOR)
    await cell.hang_up()
    again = await back(runtime, cell)
    await again.expect("beat")
    assert again.ops() == []


async def test_an_emergency_stop_that_is_lost_with_its_link_ends_the_session_even_after_a_reset(
    runtime: Runtime,
) -> None:
    cell = await slow_cell(runtime)
    await running(runtime, cell)
    await stuck(cell)
    await runtime.governor.estop(CELL, OPERATOR)
    resetting = asyncio.create_task(runtime.governor.reset(CELL, OPERATOR))
    await until(lambda: not runtime.fleet.cell(CELL).latched)
    await cell.hang_up()
    again = await back(runtime, cell)
    await until(lambda: again.ops() == ["stop"])
    await again.state()
    await resetting


async def test_what_was_decided_before_an_emergency_stop_is_stopped_even_after_a_reset(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = Late(runtime, monkeypatch)
    proposing = asyncio.create_task(runtime.governor.propose(AGENT, navigate()))
    await late.recorded.wait()
    await runtime.governor.estop(CELL, OPERATOR)
    resetting = asyncio.create_task(runtime.governor.reset(CELL, OPERATOR))
    await cell.expect("reset")
    late.go.set()
    await proposing
    await cell.expect("human")
    said = [word.type for word in cell.heard if word.type in {"estop", "reset", "launch", "human"}]
    assert said == ["estop", "reset", "launch", "human"]
    assert cell.ops() == ["stop"]
    await cell.state()
    await resetting


@pytest.mark.parametrize("op", ["stop", "cancel"])
async def test_a_stop_to_a_cell_that_is_away_outlives_the_server(house: House, op: str) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        name = await running(first, cell)
        await cell.hang_up()
        word = {"stop": first.governor.stop, "cancel": first.governor.cancel}[op]
        assert (await word(name, OPERATOR))["recorded"]
    async with house.open() as second:
        again = await back(second, cell, status="escalated")
        await until(lambda: again.ops() == [op])
        assert second.desk.pending_for(name) is None, "nobody could let it go on"
        await again.report("status", name, status="escalated", reason="link")
        question = second.desk.pending_for(name)
        assert question is not None
        with pytest.raises(Conflict) as refusal:
            await second.desk.resolve(question.id, OPERATOR, "approve", question.digest)
        assert refusal.value.code == "ending"


async def test_a_stop_after_a_cancel_is_what_outlives_the_server(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        name = await running(first, cell)
        await cell.hang_up()
        await first.governor.cancel(name, AGENT)
        await first.governor.stop(name, OPERATOR)
        with pytest.raises(Conflict) as refusal:
            await first.governor.cancel(name, AGENT)
        assert refusal.value.code == "ending"
    async with house.open() as second:
        again = await back(second, cell, status="escalated")
        await until(lambda: again.ops() == ["stop"])


async def test_a_denial_that_ends_a_session_outlives_the_server(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        name = await running(first, cell)
        await cell.report("escalation", name, reason="separation_m")
        question = first.desk.pending_for(name)
        assert question is not None
        await cell.hang_up()
        await first.desk.resolve(question.id, OPERATOR, "deny", question.digest)
    async with house.open() as second:
        again = await back(second, cell, status="escalated")
        await until(lambda: again.ops() == ["resolve_terminate"])


@pytest.mark.parametrize("word", ["deny", "silence", "stop"])
async def test_nobody_is_asked_again_about_a_session_that_comes_to_its_end_while_its_cell_is_away(
    house: House, word: str
) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        name = await running(runtime, cell)
        if word != "stop":
            await cell.report("escalation", name, reason="separation_m")
        question = runtime.desk.pending_for(name)
        await cell.hang_up()
        if question is None:
            await runtime.governor.stop(name, OPERATOR)
        elif word == "deny":
            await runtime.desk.resolve(question.id, OPERATOR, "deny", question.digest, code="unsafe_now")
        else:
            house.wall_s.offset_s = 3600.0
            await runtime.desk.expire_due()
        said = (await runtime.governor.invocation(name, AGENT)).get("escalation")
        away = runtime.fleet.cell(CELL)
        assert away.absent_since_s is not None
        away.absent_since_s -= LOST_S + 0.1
        await runtime.fleet.tend_once()
        again = await back(runtime, cell, status="escalated")
        await until(lambda: again.ops() == ["stop" if word == "stop" else "resolve_terminate"])
        assert runtime.desk.pending_for(name) is None
        assert (await runtime.governor.invocation(name, AGENT)).get("escalation") == said


# -- what a cell holds, and what the server believes -------------------------------------------------------------------


async def test_a_session_that_the_server_gave_up_is_told_to_stop_whenever_the_cell_says_it_has_it(
    runtime: Runtime, cell: HandCell
) -> None:
    await cell.state(invocation="inv_gone", status="running")
    await runtime.fleet.tend_once()
    await until(lambda: cell.ops() == ["stop"])
    assert cell.all("human")[0].invocation == "inv_gone"


async def test_a_session_whose_end_the_cell_has_just_reported_is_told_nothing(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await cell.report("outcome", name, outcome="succeeded", code="done")
    await cell.state()  # a little older than the report
    await runtime.fleet.tend_once()
    await cell.expect("beat", 2)
    assert cell.ops() == []


async def test_a_launch_that_was_being_recorded_when_its_cell_came_back_is_not_held_against_it(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = Gate(runtime, monkeypatch)
    proposing = asyncio.create_task(runtime.governor.propose(AGENT, navigate()))
    await gate.reached.wait()
    cell.closed = (1006, "gone")
    assert cell.attachment is not None
    leaving = asyncio.create_task(cell.attachment.detach())
    await until(lambda: runtime.fleet.cell(CELL).attachment is None)
    again = HandCell(runtime, seq=cell.seq)
    dialling = asyncio.create_task(again.dial())
    await until(lambda: runtime.fleet.attached(runtime.fleet.cell(CELL)))
    gate.open.set()
    document, _ = await proposing
    await asyncio.gather(leaving, dialling)
    await again.expect("launch")
    await again.launched(document["id"])
    assert (await runtime.governor.invocation(document["id"], AGENT))["status"] == "running"


async def test_a_launch_whose_confirmation_waits_for_the_record_is_not_given_up(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        document, _ = await runtime.governor.propose(AGENT, navigate())
        gate = Gate(runtime, monkeypatch)
        confirmation = cell.event("launch", document["id"])
        await cell.say(confirmation)
        await gate.reached.wait()
        house.wall_s.offset_s = 12.0
        tending = asyncio.create_task(runtime.fleet.tend_once())
        await asyncio.wait({tending}, timeout=0.2)
        gate.open.set()
        await tending
        await cell.acknowledged(confirmation.seq)
        assert (await runtime.governor.invocation(document["id"], AGENT))["status"] == "running"
        assert cell.ops() == []


async def answered_unheard(runtime: Runtime, cell: SlowCell, question: Escalation) -> HandCell:
    """Have a session let go on by a word that its cell does not hear; return the cell, back on a new link."""
    await stuck(cell)
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    await cell.hang_up()
    again = await back(runtime, cell, status="escalated")
    await again.state()
    await runtime.fleet.tend_once()
    assert runtime.desk.pending_for(question.invocation) is None, "it has just been told, for all anybody knows"
    return again


@pytest.mark.parametrize(("why", "phase"), [("separation_m", None), ("confirm:release", "release")])
async def test_whoever_lets_a_session_go_on_that_does_not_is_asked_again(
    house: House, why: str, phase: str | None
) -> None:
    async with house.open() as runtime:
        cell = await slow_cell(runtime)
        name = await running(runtime, cell)
        await cell.report("escalation", name, reason=why)
        question = runtime.desk.pending_for(name)
        assert question is not None
        again = await answered_unheard(runtime, cell, question)
        house.wall_s.offset_s = 3.0
        await runtime.fleet.tend_once()
        asked = runtime.desk.pending_for(name)
        assert asked is not None
        assert (asked.reasons[0]["code"], asked.phase) == ("not_gone_on", phase)
        assert again.ops() == [], "what lets something move is never kept"


async def test_who_let_a_session_go_on_is_asked_again_though_the_clock_was_put_back(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with house.open() as runtime:
        cell = await slow_cell(runtime)
        name = await running(runtime, cell)
        await cell.report("escalation", name, reason="separation_m")
        question = runtime.desk.pending_for(name)
        assert question is not None
        house.wall_s.offset_s = -3600.0
        await answered_unheard(runtime, cell, question)
        monkeypatch.setattr("app.runtime.sessions.GOES_ON_S", 0.0)
        await runtime.fleet.tend_once()
        asked = runtime.desk.pending_for(name)
        assert asked is not None
        assert asked.reasons[0]["code"] == "not_gone_on"


async def test_whoever_is_to_be_asked_again_is_asked_once_the_record_can_be_read(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def unreadable(**_: Any) -> Any:
        raise RecordUnreadable(Places(house.folder).database, "disk I/O error")

    async with house.open() as runtime:
        cell = await slow_cell(runtime)
        name = await running(runtime, cell)
        await cell.report("escalation", name, reason="separation_m")
        question = runtime.desk.pending_for(name)
        assert question is not None
        await answered_unheard(runtime, cell, question)
        with monkeypatch.context() as disk:
            disk.setattr(runtime.store, "events", unreadable)
            disk.setattr("app.runtime.sessions.GOES_ON_S", 0.0)
            await runtime.fleet.tend_once()
        assert runtime.governor.broken == ""
        monkeypatch.setattr("app.runtime.sessions.GOES_ON_S", 0.0)
        await runtime.fleet.tend_once()
        asked = runtime.desk.pending_for(name)
        assert asked is not None
        assert asked.reasons[0]["code"] == "not_gone_on"


async def test_a_launch_nobody_confirms_is_a_fault_though_the_clock_was_put_back(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with house.open() as runtime:
        cell = await slow_cell(runtime)
        document, _ = await runtime.governor.propose(AGENT, navigate())
        house.wall_s.offset_s = -3600.0
        await runtime.fleet.tend_once()
        assert (await runtime.governor.invocation(document["id"], AGENT))["status"] == "running"
        monkeypatch.setattr("app.runtime.sessions.UNCONFIRMED_S", 0.0)
        await runtime.fleet.tend_once()
        assert (await runtime.governor.invocation(document["id"], AGENT))["outcome"] == "fault"
        await until(lambda: cell.ops() == ["stop"])


@pytest.mark.parametrize("decision", ["approve", "deny"])
async def test_who_answers_before_the_cell_has_said_why_it_asks_is_not_asked_again(
    runtime: Runtime, cell: HandCell, decision: str
) -> None:
    name = await running(runtime, cell)
    await cell.report("status", name, status="escalated", reason="separation_m")
    question = runtime.desk.pending_for(name)
    assert question is not None
    await runtime.desk.resolve(question.id, OPERATOR, decision, question.digest)
    await cell.report("escalation", name, reason="separation_m")
    assert runtime.desk.pending_for(name) is None
    later = cell.event("escalation", name, reason="zone_margin_m").model_copy(update={"tick": 8})
    await cell.say(later)
    await cell.acknowledged(later.seq)
    again = runtime.desk.pending_for(name)
    assert again is not None, "what it asks later is another question"
    assert again.reasons[0]["code"] == "zone_margin_m"


@pytest.mark.parametrize("decision", ["approve", "deny"])
async def test_who_answers_for_a_lost_link_is_not_asked_by_the_cell_as_well(house: House, decision: str) -> None:
    async with house.open() as runtime:
        first, name, question = await left_and_asked_about(runtime)
        assert question.reasons[0]["code"] == "link_lost"
        cell = await back(runtime, first, status="escalated")
        await runtime.desk.resolve(question.id, OPERATOR, decision, question.digest)
        for then in ("recovering", "escalated"):  # what it did while it was away comes after the answer
            await cell.report("status", name, status=then, reason="link")
        await cell.report("escalation", name, reason="link")
        assert runtime.desk.pending_for(name) is None
        assert (await runtime.governor.invocation(name, AGENT))["status"] == "escalated"
        if decision == "approve":
            await cell.report("status", name, status="running", reason="operator")
            await cell.report("human", name, op="resolve_continue")
            await cell.report("status", name, status="escalated", reason="link")
            assert runtime.desk.pending_for(name) is not None, "a link that is lost later is another question"


@pytest.mark.parametrize("decision", ["approve", "deny"])
async def test_who_answers_before_the_cell_is_compared_with_the_record_is_not_asked_again(
    house: House, decision: str
) -> None:
    async with house.open() as runtime:
        first, name, question = await left_and_asked_about(runtime)
        cell = HandCell(runtime, seq=first.seq, invocation=name, status="recovering")
        unsent = cell.event("alert", name, signal="clearance_m")  # its `Hello` says that there is more to come
        await cell.dial()
        await runtime.desk.resolve(question.id, OPERATOR, decision, question.digest)
        await cell.say(unsent)
        await cell.acknowledged(unsent.seq)
        await until(lambda: runtime.fleet.cell(CELL).unreconciled is None)
        assert runtime.desk.pending_for(name) is None
        if decision == "approve":  # the word is lost: it is asked about again, for want of the cell's own
            await cell.report("status", name, status="escalated", reason="link")
            house.wall_s.offset_s = 3.0
            await runtime.fleet.tend_once()
            asked = runtime.desk.pending_for(name)
            assert asked is not None
            assert asked.reasons[0]["code"] == "not_gone_on"


async def test_a_proposal_that_is_said_again_while_its_first_is_recorded_gets_the_same_answer(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = Gate(runtime, monkeypatch)
    first = asyncio.create_task(runtime.governor.propose(AGENT, navigate(), "key-1"))
    await gate.reached.wait()
    first.cancel()  # its client hangs up
    await asyncio.wait({first})
    again = asyncio.create_task(runtime.governor.propose(AGENT, navigate(), "key-1"))
    await asyncio.wait({again}, timeout=0.1)
    gate.open.set()
    document, new = await again
    assert (document["status"], new) == ("running", False)
    assert len(cell.all("launch")) == 1


# -- what a link held back ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("op", ["resume", "rollback"])
@pytest.mark.parametrize("who", [OPERATOR, OPERATOR_2], ids=["by the same", "by another"])
async def test_a_word_that_comes_late_ends_no_pause_that_came_meanwhile(
    runtime: Runtime, cell: HandCell, op: str, who: Principal
) -> None:
    name = await running(runtime, cell)
    store = runtime.register.store
    await runtime.governor.pause(name, OPERATOR)
    await heard(cell, name, "pause", "paused")
    seen = store.size
    await runtime.governor.resume(name, who)
    await runtime.governor.pause(name, who)
    await until(lambda: cell.ops() == ["pause", "resume", "pause"])
    late = getattr(runtime.governor, op)
    with pytest.raises(Conflict) as unheard:  # the cell has not said yet that it has heard of any of it
        await late(name, OPERATOR, seen)
    await heard(cell, name, "pause", "paused")
    with pytest.raises(Conflict) as overtaken:
        await late(name, OPERATOR, seen)
    assert {unheard.value.code, overtaken.value.code} == {"overtaken"}
    assert f"`{who.name}` said `pause` after the event `{seen}`" in str(overtaken.value)
    assert cell.ops() == ["pause", "resume", "pause"]
    await late(name, OPERATOR, store.size)
    await until(lambda: cell.ops()[-1] == op)


async def test_a_rollback_that_comes_late_undoes_nothing_that_another_let_go_on(
    runtime: Runtime, cell: HandCell
) -> None:
    name = await running(runtime, cell)
    await cell.report("escalation", name, reason="separation_m")
    seen = runtime.register.store.size
    question = runtime.desk.pending_for(name)
    assert question is not None
    await runtime.desk.resolve(question.id, OPERATOR_2, "approve", question.digest)
    with pytest.raises(Conflict, match="`oskar` said `approve` after the event"):
        await runtime.governor.rollback(name, OPERATOR, seen)
    assert cell.ops() == ["resolve_continue"]


@pytest.mark.parametrize("decision", ["approve", "deny"])
async def test_a_pause_that_comes_while_an_answer_is_recorded_waits_for_that_and_holds_what_goes_on_by_it(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch, decision: str
) -> None:
    name, question = await held(runtime, cell)
    gate = Gate(runtime, monkeypatch)
    answering = asyncio.create_task(runtime.desk.resolve(question.id, OPERATOR_2, decision, question.digest))
    await gate.reached.wait()
    pausing = asyncio.create_task(runtime.governor.pause(name, OPERATOR))
    await asyncio.wait({pausing}, timeout=0.1)
    assert not pausing.done()
    gate.open.set()
    await answering
    if decision == "approve":
        assert (await pausing)["recorded"]
        await until(lambda: cell.ops()[-2:] == ["resolve_continue", "pause"])
    else:
        with pytest.raises(Conflict) as refused:
            await pausing
        assert refused.value.code == "ending"


async def test_a_pause_waits_for_no_report_that_is_recorded_behind_the_answer(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, question = await held(runtime, cell)
    gate = Gate(runtime, monkeypatch)
    answering = asyncio.create_task(runtime.desk.resolve(question.id, OPERATOR_2, "approve", question.digest))
    await gate.reached.wait()
    stalled = Gate(runtime, monkeypatch)  # of whatever comes behind
    reporting = asyncio.create_task(cell.report("alert", name, rule="grip", signal="SLIP"))
    entry = runtime.register.entry(name)
    assert entry is not None
    await until(lambda: bool(entry.lock._waiters))
    pausing = asyncio.create_task(runtime.governor.pause(name, OPERATOR))
    await asyncio.wait({pausing}, timeout=0.1)
    gate.open.set()
    await stalled.reached.wait()
    await until(lambda: cell.ops()[-2:] == ["resolve_continue", "pause"])
    stalled.open.set()
    await asyncio.gather(answering, pausing, reporting)


async def test_a_pause_waits_for_an_answer_whose_turn_comes_just_then(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = await running(runtime, cell)
    await cell.report("escalation", name, reason="separation_m")
    await cell.state(status="escalated")
    question, entry = runtime.desk.pending_for(name), runtime.register.entry(name)
    assert question is not None
    assert entry is not None
    gate = Gate(runtime, monkeypatch)
    await entry.lock.acquire()  # as a report has it that is being recorded
    answering = asyncio.create_task(runtime.desk.resolve(question.id, OPERATOR_2, "approve", question.digest))
    await until(lambda: bool(entry.lock._waiters))
    pausing = asyncio.create_task(runtime.governor.pause(name, OPERATOR))
    await asyncio.sleep(0)  # it is about to look
    entry.lock.release()
    await gate.reached.wait()
    gate.open.set()
    assert (await pausing)["recorded"]
    await until(lambda: cell.ops()[-2:] == ["resolve_continue", "pause"])
    await answering


async def test_that_somebody_looks_at_a_question_overtakes_no_word(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await cell.report("escalation", name, reason="separation_m")
    seen = runtime.register.store.size
    question = runtime.desk.pending_for(name)
    assert question is not None
    await runtime.desk.acknowledge(question.id, OPERATOR_2)
    await runtime.governor.rollback(name, OPERATOR, seen)
    await until(lambda: cell.ops() == ["rollback"])


async def test_a_profile_is_put_in_the_place_of_the_one_it_was_compared_with_alone(runtime: Runtime) -> None:
    await HandCell(runtime).dial()
    await runtime.governor.set_profile(CELL, "test-audit", OPERATOR_2)
    with pytest.raises(Conflict, match="under `test-audit`, not `human-shared` any more") as refused:
        await runtime.governor.set_profile(CELL, "sim-relaxed", OPERATOR, "human-shared")
    assert (refused.value.code, runtime.fleet.cell(CELL).profile) == ("profile_changed", "test-audit")
    await runtime.governor.set_profile(CELL, "sim-relaxed", OPERATOR, "test-audit")
    assert runtime.fleet.cell(CELL).profile == "sim-relaxed"


async def test_nothing_goes_on_by_a_word_that_is_recorded_behind_the_end(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = await running(runtime, cell)
    await runtime.governor.pause(name, OPERATOR)
    await heard(cell, name, "pause", "paused")
    gate = Gate(runtime, monkeypatch)
    ending = asyncio.create_task(cell.ended(name, "stopped"))
    await gate.reached.wait()
    resuming = asyncio.create_task(runtime.governor.resume(name, OPERATOR))
    await asyncio.wait({resuming}, timeout=0.1)
    gate.open.set()
    await ending
    with pytest.raises(Conflict, match="not possible while the invocation is `failed`"):
        await resuming
    assert cell.ops() == ["pause"]


# -- what was decided under something else -----------------------------------------------------------------------------


async def test_nothing_launches_under_a_profile_that_gave_way_while_it_was_recorded(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with replace(house, profile="sim-relaxed").open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        late = Late(runtime, monkeypatch)
        proposing = asyncio.create_task(runtime.governor.propose(AGENT, navigate()))
        await late.recorded.wait()
        await runtime.governor.set_profile(CELL, "human-shared", OPERATOR)
        late.go.set()
        document, _ = await proposing
        await runtime.succession.close()
        ended = await runtime.governor.invocation(document["id"], AGENT)
        assert not cell.all("launch")
        assert (ended["status"], ended["failure"]["reasons"][0]["code"]) == ("failed", "profile_changed")
        assert runtime.fleet.busy(runtime.fleet.cell(CELL)) is None


async def test_what_lets_a_held_session_go_on_confirms_no_phase_that_waits_meanwhile(
    runtime: Runtime, cell: HandCell
) -> None:
    name = await running(runtime, cell)
    await cell.report("escalation", name, reason="separation_m")
    shown = runtime.desk.pending_for(name)
    assert shown is not None
    await cell.report("escalation", name, reason="confirm:release")
    with pytest.raises(Conflict) as refusal:
        await runtime.desk.resolve(shown.id, OPERATOR, "approve", shown.digest)
    assert refusal.value.code == "digest_mismatch"
    asked = runtime.desk.pending_for(name)
    assert asked is not None
    assert asked.phase == "release"
    await runtime.desk.resolve(asked.id, OPERATOR, "approve", asked.digest)
    await until(lambda: cell.ops() == ["confirm"])


# -- whose hands a session is in ---------------------------------------------------------------------------------------


async def test_a_report_that_comes_while_somebody_takes_over_does_not_take_the_controls_from_them(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = await running(runtime, cell)
    late = Late(runtime, monkeypatch)
    paused = cell.event("status", name, status="paused")
    await cell.say(paused)
    await late.recorded.wait()
    taking = asyncio.create_task(runtime.governor.take_over(name, OPERATOR))
    await until(lambda: runtime.fleet.cell(CELL).control is not None)
    late.go.set()
    lease = await taking
    await cell.acknowledged(paused.seq)
    control = runtime.fleet.cell(CELL).control
    assert control is not None
    assert control.lease == lease["lease"]


async def test_nobody_takes_over_by_a_lease_that_was_lost_while_they_waited(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = await running(runtime, cell)
    late = Late(runtime, monkeypatch)
    await cell.say(cell.event("status", name, status="paused"))
    await late.recorded.wait()
    taking = asyncio.create_task(runtime.governor.take_over(name, OPERATOR))
    await until(lambda: runtime.fleet.cell(CELL).control is not None)
    runtime.fleet.loosen(runtime.fleet.cell(CELL), "server")
    late.go.set()
    with pytest.raises(Conflict) as refusal:
        await taking
    assert refusal.value.code == "takeover_refused"
    assert len(cell.all("launch")) == 1
    assert (await runtime.governor.invocation(name, AGENT)).get("takeover") is None


async def test_the_hand_that_takes_over_from_one_that_fell_silent_does_not_lose_the_controls_by_that(
    runtime: Runtime, cell: HandCell
) -> None:
    name = await running(runtime, cell)
    await runtime.governor.take_over(name, OPERATOR)
    await cell.report("launch", name, capability="takeover")
    await cell.report("status", name, status="running", reason="taken_over")
    place = runtime.fleet.cell(CELL)
    assert place.control is not None
    place.control = replace(place.control, heard_s=monotonic_s() - LAPSE_S - 0.1)
    lease = await runtime.governor.take_over(name, OPERATOR_2)  # the silent hand is let go by this
    assert "let_go" in cell.ops()
    await cell.report("status", name, status="escalated", reason="control_lapsed")
    await cell.report("escalation", name, reason="control_lapsed", failure="taken_over")
    await cell.report("launch", name, capability="takeover")
    await cell.report("status", name, status="running", reason="taken_over")
    assert place.control is not None
    assert place.control.lease == lease["lease"]
    document = await runtime.governor.invocation(name, AGENT)
    assert (document["status"], document["takeover"]["state"]) == ("running", "held")
    await cell.report("status", name, status="escalated", reason="control_lapsed")
    await cell.report("escalation", name, reason="control_lapsed", failure="taken_over")
    assert place.control is None, "this time it is theirs that lapsed"


async def test_nobody_has_the_controls_of_a_session_that_the_server_ended(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await runtime.governor.take_over(name, OPERATOR)
    await cell.state(fault={"why": "no room", "ended": [{"invocation": name, "outcome": "stopped", "code": "x"}]})
    await runtime.fleet.tend_once()
    assert (await runtime.governor.invocation(name, AGENT))["status"] == "failed"
    assert runtime.fleet.cell(CELL).control is None


async def test_a_session_changes_hands_only_while_its_cell_has_it(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    assert not cell.all("launch")[-1].anew
    await runtime.governor.take_over(name, OPERATOR)
    assert (await cell.expect("launch", 2)).anew


async def test_a_takeover_whose_launch_is_lost_with_its_link_leaves_the_session_to_itself(runtime: Runtime) -> None:
    cell = await slow_cell(runtime)
    name = await running(runtime, cell)
    await stuck(cell)
    await runtime.governor.take_over(name, OPERATOR)
    await cell.hang_up()
    again = await back(runtime, cell)
    await until(lambda: "let_go" in again.ops())
    await again.report("human", name, op="let_go", refused="not_taken_over")
    assert (await runtime.governor.invocation(name, AGENT)).get("takeover") is None
    await again.report("escalation", name, reason="separation_m")
    question = runtime.desk.pending_for(name)
    assert question is not None
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    await until(lambda: again.ops()[-1] == "resolve_continue")


@pytest.mark.parametrize("lost", [True, False])
async def test_a_session_that_was_driven_once_goes_on_only_anew_whatever_became_of_a_second_takeover(
    runtime: Runtime, lost: bool
) -> None:
    cell = await slow_cell(runtime)
    name = await running(runtime, cell)
    await runtime.governor.take_over(name, OPERATOR)
    await cell.report("launch", name, capability="takeover")
    await cell.report("escalation", name, reason="control_lapsed", failure="taken_over")
    runtime.fleet.loosen(runtime.fleet.cell(CELL), "server")
    if lost:
        await stuck(cell)
        await runtime.governor.take_over(name, OPERATOR_2)
        await cell.hang_up()
        cell = SlowCell(runtime, seq=cell.seq, invocation=name, status="escalated")
        cell.gate.set()
        await cell.dial()
        await cell.expect("human")
        await cell.state()
    else:
        await runtime.governor.take_over(name, OPERATOR_2)
        await cell.report("launch", name, refused="holding")
    document = await runtime.governor.invocation(name, AGENT)
    assert document["takeover"]["state"] == "lapsed"
    question = runtime.desk.pending_for(name)
    assert question is not None
    before = len(cell.all("launch"))
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    assert (await cell.expect("launch", before + 1)).anew
    assert "resolve_continue" not in cell.ops()


async def test_of_three_who_take_over_only_the_one_who_has_the_controls_launches(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = await running(runtime, cell)
    late, place = Late(runtime, monkeypatch), runtime.fleet.cell(CELL)
    await cell.say(cell.event("status", name, status="paused"))
    await late.recorded.wait()
    first = asyncio.create_task(runtime.governor.take_over(name, OPERATOR))
    await until(lambda: place.control is not None)
    runtime.fleet.loosen(place, "server")
    second = asyncio.create_task(runtime.governor.take_over(name, OPERATOR_2))
    await until(lambda: place.control is not None)
    late.go.set()
    lease = await second
    with pytest.raises(Conflict) as refusal:
        await first
    assert refusal.value.code == "takeover_refused"
    assert len(cell.all("launch")) == 2
    assert place.control is not None
    assert place.control.lease == lease["lease"]


@pytest.mark.parametrize("word", ["end_takeover", "pause"])
async def test_what_is_said_while_a_takeover_waits_for_the_record_has_the_last_word(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch, word: str
) -> None:
    name = await running(runtime, cell)
    late = Late(runtime, monkeypatch)
    await cell.say(cell.event("alert", name, signal="NORMAL"))
    await late.recorded.wait()  # whoever changes the session has to wait for that
    taking = asyncio.create_task(runtime.governor.take_over(name, OPERATOR))
    await until(lambda: runtime.fleet.cell(CELL).control is not None)
    saying = {
        "end_takeover": lambda: runtime.governor.release(name, OPERATOR, "end"),
        "pause": lambda: runtime.governor.pause(name, OPERATOR_2),
    }[word]
    said = asyncio.create_task(saying())
    await until(lambda: cell.ops() == [word])
    late.go.set()
    await taking
    await until(lambda: cell.ops() == [word, word])
    told = [message.type for message in cell.heard if message.type in {"launch", "human"}]
    assert told == ["launch", "human", "launch", "human"]
    await cell.ended(name, "taken_over")
    await said


async def test_the_end_of_a_takeover_that_never_was_leaves_the_session_to_others(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = await running(runtime, cell)
    late = Late(runtime, monkeypatch)
    await cell.say(cell.event("alert", name, signal="NORMAL"))
    await late.recorded.wait()
    taking = asyncio.create_task(runtime.governor.take_over(name, OPERATOR))
    await until(lambda: runtime.fleet.cell(CELL).control is not None)
    ending = asyncio.create_task(runtime.governor.release(name, OPERATOR, "end"))
    await until(lambda: cell.ops() == ["end_takeover"])
    runtime.fleet.loosen(runtime.fleet.cell(CELL), "server")
    late.go.set()
    with pytest.raises(Conflict):
        await taking
    await ending
    await cell.report("human", name, op="end_takeover", refused="not_taken_over")
    assert (await runtime.governor.cancel(name, AGENT))["recorded"]


# -- what is answered, and what is in the record -----------------------------------------------------------------------


async def test_a_rollback_whose_cell_left_while_it_was_recorded_leaves_the_session_to_its_agent(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = await running(runtime, cell)
    late = Late(runtime, monkeypatch)
    undoing = asyncio.create_task(runtime.governor.rollback(name, OPERATOR))
    await late.recorded.wait()
    await cell.hang_up()
    late.go.set()
    with pytest.raises(Conflict) as refusal:
        await undoing
    assert refusal.value.code == "cell_offline"
    told = [event.payload() for event in await runtime.store.events(invocation=name, kind="cell")]
    assert {"what": "not_sent", "op": "rollback", "code": "cell_offline"}.items() <= told[-1].items()
    assert (await runtime.governor.cancel(name, AGENT))["recorded"], "nothing is undone that it could call off"


async def test_a_rollback_that_the_cell_refuses_leaves_the_session_to_its_agent(
    runtime: Runtime, cell: HandCell
) -> None:
    name = await running(runtime, cell)
    await runtime.governor.rollback(name, OPERATOR)
    with pytest.raises(Conflict) as refusal:
        await runtime.governor.cancel(name, AGENT)
    assert refusal.value.code == "rollback_ordered"
    unavailable = "rollback_unavailable"
    await cell.report("status", name, status="escalated", reason=unavailable)
    await cell.report("escalation", name, reason=unavailable)
    await cell.report("human", name, op="rollback", done=False, refused=unavailable, actor=OPERATOR.name)
    assert (await runtime.governor.cancel(name, AGENT))["status"] == "escalated"
    await until(lambda: "cancel" in cell.ops())


async def test_a_rollback_that_is_not_said_again_is_under_way_all_the_same(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = await running(runtime, cell)
    await runtime.governor.rollback(name, OPERATOR)
    await cell.report("status", name, status="recovering")
    late = Late(runtime, monkeypatch)
    again = asyncio.create_task(runtime.governor.rollback(name, OPERATOR_2))
    await late.recorded.wait()
    await cell.hang_up()
    late.go.set()
    with pytest.raises(Conflict) as refusal:
        await again
    assert refusal.value.code == "cell_offline"
    with pytest.raises(Conflict) as refusal:
        await runtime.governor.cancel(name, AGENT)
    assert refusal.value.code == "rollback_ordered"


async def test_an_approval_that_was_recorded_is_answered_so_although_its_cell_has_left(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        name = await running(runtime, cell)
        await cell.report("escalation", name, reason="separation_m")
        question = runtime.desk.pending_for(name)
        assert question is not None
        late = Late(runtime, monkeypatch)
        answering = asyncio.create_task(runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest))
        await late.recorded.wait()
        await cell.hang_up()
        late.go.set()
        assert (await answering)["status"] == "approved"
        again = await back(runtime, cell, status="escalated")
        await again.state()
        house.wall_s.offset_s = 3.0
        await runtime.fleet.tend_once()
        assert runtime.desk.pending_for(name) is not None
        assert again.ops() == []


async def test_a_reset_that_was_recorded_is_answered_so_although_its_cell_has_left(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    await runtime.governor.estop(CELL, OPERATOR)
    late = Late(runtime, monkeypatch)
    resetting = asyncio.create_task(runtime.governor.reset(CELL, OPERATOR))
    await late.recorded.wait()
    await cell.hang_up()
    late.go.set()
    assert (await resetting)["latched"], "as it last said itself"
    assert not runtime.fleet.cell(CELL).latched
    again = await HandCell(runtime, seq=cell.seq, latched=True).dial()
    await again.state()
    assert runtime.governor.cells()[0]["latched"], "a cell that latched it says so itself"


@pytest.mark.parametrize("tended", [True, False])
async def test_a_stop_that_was_latched_while_the_disk_was_full_outlives_the_server(
    house: House, monkeypatch: pytest.MonkeyPatch, tended: bool
) -> None:
    async def full(*_: object, **__: object) -> list[int]:
        raise RecordUnavailable("no space left on device")

    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.hang_up()
        with monkeypatch.context() as disk:
            disk.setattr(first.store, "append", full)
            assert not (await first.governor.estop(CELL, OPERATOR))["recorded"]
            await first.fleet.tend_once()
        if tended:
            await first.fleet.tend_once()
    async with house.open() as second:
        assert second.governor.cells()[0]["latched"]
        back = await HandCell(second).dial()
        await back.expect("estop")


async def test_a_stop_of_a_cell_that_came_while_the_disk_was_full_outlives_the_server(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def full(*_: object, **__: object) -> list[int]:
        raise RecordUnavailable("no space left on device")

    async with house.open() as first:
        with monkeypatch.context() as disk:
            disk.setattr(first.store, "append", full)
            cell = await HandCell(first).dial(waits=False)
            await cell.hang_up()
        assert (await first.governor.estop(CELL, OPERATOR))["recorded"]
        await first.fleet.tend_once()
        assert not await first.store.rows("cell_progress")
    async with house.open() as second:
        assert second.governor.cells()[0]["latched"]
        back = await HandCell(second).dial()
        await back.expect("estop")


async def test_a_stop_to_a_session_whose_cell_was_never_recorded_outlives_the_server(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        document, _ = await first.governor.propose(AGENT, navigate())
        await cell.hang_up()
        await first.governor.stop(document["id"], OPERATOR)
    forget_cells(house)
    async with house.open() as second:
        assert second.fleet.busy(second.fleet.cell(CELL)) == document["id"]
        again = await HandCell(second, invocation=document["id"], status="escalated").dial()
        await until(lambda: again.ops() == ["stop"])


def forget_cells(house: House) -> None:
    """Leave what a server leaves that ended before the record took which cells there are."""
    with closing(sqlite3.connect(Places(house.folder).database)) as database, database:
        assert database.execute("DELETE FROM cell_progress").rowcount == 1


async def test_a_stop_that_was_latched_while_the_disk_was_full_does_not_come_back_after_a_reset(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def full(*_: object, **__: object) -> list[int]:
        raise RecordUnavailable("no space left on device")

    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        with monkeypatch.context() as disk:
            disk.setattr(first.store, "append", full)
            await first.governor.estop(CELL, OPERATOR)
            with pytest.raises(RecordUnavailable):
                await first.governor.reset(CELL, OPERATOR)
        await cell.state()
        await first.governor.reset(CELL, OPERATOR)
        await first.fleet.tend_once()
    async with house.open() as second:
        assert not second.governor.cells()[0]["latched"]


async def test_what_is_not_admitted_any_more_after_a_change_of_policy_says_so_in_the_log(house: House) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        document, _ = await runtime.governor.propose(AGENT, grasp())
        await runtime.governor.estop(CELL, OPERATOR)
        await put_in_force(runtime, SLOWER)
        ended = await runtime.governor.invocation(document["id"], AGENT)
        assert (ended["status"], ended["policy_version"]) == ("rejected", runtime.kernel.policy.digest)
    # the house examines what it leaves against the log


async def test_a_server_whose_work_in_the_background_breaks_is_not_ready_and_lets_its_cells_hold(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: heard.append(context))

    async def broken() -> None:
        raise KeyError("a bug")

    monkeypatch.setattr(runtime.fleet, "tend_once", broken)
    await until(lambda: "background" in runtime.governor.ready())
    assert runtime.governor.ready()["background"] == "`tend` broke: KeyError('a bug')"
    assert [context["message"] for context in heard] == ["`tend` broke, and all work in the background ends with it"]
    beats = len(cell.all("beat"))
    await asyncio.sleep(3 * BEAT_MS / 1000)
    assert len(cell.all("beat")) == beats, "the lease of every cell lapses by that"


# -- what waits for nothing --------------------------------------------------------------------------------------------


async def test_a_stray_session_is_stopped_and_a_silent_link_closed_while_the_record_takes_nothing(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = await running(runtime, cell)
    other = await HandCell(runtime, id="workcell-2").dial()
    await cell.hang_up()
    gate = Gate(runtime, monkeypatch)
    away = runtime.fleet.cell(CELL)
    away.absent_since_s = monotonic_s() - LOST_S - 0.1
    await gate.reached.wait()  # somebody is to be asked
    await other.state(invocation="inv_gone", status="running")
    await until(lambda: other.ops() == ["stop"])
    assert other.attachment is not None
    other.attachment.heard_s -= SILENT_S
    await until(lambda: other.closed is not None)
    gate.open.set()
    await until(lambda: runtime.desk.pending_for(name) is not None)


async def test_what_departs_is_held_however_long_it_takes_to_decide_again_on_what_waits(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    stuck = asyncio.Event()
    monkeypatch.setattr(runtime.succession, "decide_again", stuck.wait)
    document, _ = await runtime.governor.propose(AGENT, navigate())
    digest, _ = await runtime.versions.propose(SLOWER, ENGINEER, "a visitor")
    changing = asyncio.create_task(runtime.versions.activate(digest["digest"], ENGINEER, "a visitor"))
    await until(lambda: cell.ops().count("escalate") == 1)  # it knows of no session yet, and cannot hold it
    await asyncio.sleep(2 * AGAIN_S)
    await cell.launched(document["id"])
    await until(lambda: cell.ops().count("escalate") >= 2)
    stuck.set()
    await changing
