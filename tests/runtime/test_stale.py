"""What comes after an event may have been said before it: no such word, state or link answers for what is newer."""

from __future__ import annotations

import asyncio
import base64
import contextlib
from collections.abc import AsyncGenerator
from dataclasses import replace
from typing import Any

import orjson
import pytest

from app.audit.event import Event
from app.clock import monotonic_s
from app.governance.control import LAPSE_S
from app.protocol import LEASE_MS, Launch
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict

from .conftest import AGENT, AT_BENCH, CELL, OPERATOR, OPERATOR_2, HandCell, grasp, navigate, until
from .test_fleet import Late, running

pytestmark = pytest.mark.anyio

WORDS = ("launch", "human")
ELSEWHERE = {**AT_BENCH, "base": [5.0, 1.0, 0.0], "objects": {}}


async def driven(runtime: Runtime, cell: HandCell) -> str:
    """Begin a session, and have an operator drive it; the cell has said so."""
    name = await running(runtime, cell)
    await runtime.governor.take_over(name, OPERATOR)
    await cell.report("launch", name, capability="takeover")
    await cell.report("status", name, status="running", reason="taken_over")
    return name


async def fall_silent(runtime: Runtime) -> None:
    """Let whoever drives be silent for as long as that ends a lease."""
    place = runtime.fleet.cell(CELL)
    assert place.control is not None
    place.control = replace(place.control, heard_s=monotonic_s() - LAPSE_S - 0.1)
    await runtime.register.say(*runtime.governor.loosen_hands())


async def ended(runtime: Runtime, cell: HandCell) -> str:
    """Begin a session, and end it; no newer state of the cell has come since."""
    name = await running(runtime, cell)
    await cell.report("outcome", name, outcome="succeeded", code="done")
    return name


def launches(cell: HandCell) -> int:
    return len(cell.all("launch"))


async def test_an_approval_that_waited_while_a_session_ended_is_of_the_world_after_it(
    runtime: Runtime, cell: HandCell
) -> None:
    made, _ = await runtime.governor.propose(AGENT, grasp())
    before, question = await running(runtime, cell), runtime.desk.pending_for(made["id"])
    entry = runtime.register.entry(made["id"])
    assert question is not None
    assert entry is not None
    async with entry.lock:  # something else about the question is being recorded
        approving = asyncio.create_task(runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest))
        await settled()
        await cell.report("outcome", before, outcome="succeeded", code="done")
    await settled()
    cell.invocation, cell.facts = None, {**AT_BENCH, "gripper_empty": False, "holding": "glass_1"}
    await cell.state()
    await approving
    late = await runtime.governor.invocation(made["id"], AGENT)
    assert (late["status"], launches(cell)) == ("deferred", 1)


async def settled() -> None:
    """Let everything that waits for nothing else be done."""
    for _ in range(50):
        await asyncio.sleep(0)


async def test_a_question_is_not_approved_once_somebody_has_taken_over(runtime: Runtime, cell: HandCell) -> None:
    name = await driven(runtime, cell)
    await fall_silent(runtime)
    await cell.report("status", name, status="escalated", reason="control_lapsed")
    await cell.report("escalation", name, reason="control_lapsed", failure="taken_over")
    question = runtime.desk.pending_for(name)
    assert question is not None
    await runtime.governor.take_over(name, OPERATOR_2)
    before = launches(cell)
    with pytest.raises(Conflict) as refusal:
        await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    assert refusal.value.code == "control_held"
    await settled()
    assert launches(cell) == before


async def test_a_denial_that_undoes_undoes_nothing_under_somebodys_hand(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await cell.report("status", name, status="escalated", reason="confirm:release")
    await cell.report("escalation", name, reason="confirm:release")
    question = runtime.desk.pending_for(name)
    assert question is not None
    runtime.desk.hold(replace(question, on_deny="rollback"))
    await runtime.governor.take_over(name, OPERATOR_2)
    await runtime.desk.resolve(question.id, OPERATOR, "deny", question.digest)
    await until(lambda: "resolve_terminate" in cell.ops())
    assert "rollback" not in cell.ops()


async def test_a_lost_takeover_ends_none_that_was_taken_on_the_new_link(runtime: Runtime, cell: HandCell) -> None:
    name = await driven(runtime, cell)
    await cell.hang_up()
    again = HandCell(runtime, seq=cell.seq, invocation=name, status="running")
    owed = again.event("status", name, status="paused", reason="watch")  # said before the link was lost
    await again.dial()
    await again.state()
    await runtime.governor.take_over(name, OPERATOR)
    await again.expect("launch")
    await again.say(owed)
    await again.acknowledged(owed.seq)
    await settled()
    words = [
        message.type if message.type == "launch" else message.op for message in again.heard if message.type in WORDS
    ]
    assert "let_go" not in words[words.index("launch") :]
    assert runtime.fleet.cell(CELL).driven(name)


async def test_a_link_that_is_replaced_takes_the_lease_along_that_was_given_on_it(
    runtime: Runtime, cell: HandCell
) -> None:
    name = await driven(runtime, cell)
    assert cell.attachment is not None
    cell.attachment.heard_s -= 2.0  # silent, and open
    again = await HandCell(runtime, seq=cell.seq, invocation=name, status="running").dial()
    assert not runtime.fleet.cell(CELL).driven(name)
    await until(lambda: "let_go" in again.ops())


async def test_nobody_is_given_the_controls_of_a_cell_whose_driver_has_let_go(runtime: Runtime, cell: HandCell) -> None:
    lease = await runtime.governor.take_cell(CELL, OPERATOR)
    cell.invocation, cell.status = lease["invocation"], "running"
    await cell.report("launch", cell.invocation, capability="takeover")
    await cell.report("status", cell.invocation, status="running")
    await cell.state()
    await fall_silent(runtime)
    await until(lambda: "let_go" in cell.ops())  # with which it ends
    with pytest.raises(Conflict) as refusal:
        await runtime.governor.take_cell(CELL, OPERATOR_2)
    assert refusal.value.code == "ending"
    await cell.ended(lease["invocation"], "taken_over")
    assert (await runtime.governor.take_cell(CELL, OPERATOR_2))["invocation"] != lease["invocation"]


async def test_an_approval_right_after_an_outcome_waits_for_what_the_session_changed(
    runtime: Runtime, cell: HandCell
) -> None:
    asked, _ = await runtime.governor.propose(AGENT, grasp())
    assert asked["status"] == "awaiting_approval"
    await ended(runtime, cell)
    question = runtime.desk.pending_for(asked["id"])
    assert question is not None
    before = launches(cell)
    answering = asyncio.create_task(runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest))
    await settled()
    assert not answering.done()
    cell.facts, cell.invocation, cell.status = ELSEWHERE, None, None
    await cell.state()
    await answering
    await settled()
    assert launches(cell) == before


async def test_a_state_that_names_the_session_that_ended_is_older_than_its_end(
    runtime: Runtime, cell: HandCell
) -> None:
    await ended(runtime, cell)
    shown = runtime.governor.cells()[0]
    assert (shown["busy"], shown["status"], shown["session"]) == (None, None, None)
    proposing = asyncio.create_task(runtime.governor.propose(AGENT, grasp()))
    await settled()
    await cell.state()  # of the tick before
    await settled()
    assert not proposing.done()
    cell.facts, cell.invocation, cell.status = ELSEWHERE, None, None
    await cell.state()
    document, _ = await proposing
    assert document["status"] not in ("awaiting_approval", "running")


async def test_a_pause_stands_although_a_state_from_before_it_comes(runtime: Runtime, cell: HandCell) -> None:
    name = await driven(runtime, cell)
    await runtime.governor.pause(name, OPERATOR_2)
    await cell.report("human", name, op="pause", refused=None)
    before = launches(cell)
    releasing = asyncio.create_task(runtime.governor.release(name, OPERATOR, "resume"))
    await settled()
    await cell.state()
    with pytest.raises(Conflict) as refusal:
        await releasing
    assert refusal.value.code == "paused"
    assert launches(cell) == before
    assert runtime.fleet.cell(CELL).driven(name)


async def test_a_pause_that_the_cell_refused_or_somebody_lifted_is_none(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    place = runtime.fleet.cell(CELL)
    await runtime.governor.pause(name, OPERATOR)
    assert place.paused(name)
    await cell.report("human", name, op="pause", refused="no_such_session")
    assert not place.paused(name)
    await runtime.governor.pause(name, OPERATOR)
    await cell.report("human", name, op="pause", refused=None)
    await cell.report("status", name, status="paused", reason="operator")
    assert place.paused(name)
    await runtime.governor.resume(name, OPERATOR)
    assert not place.paused(name)


@pytest.mark.parametrize("word", ["approve", "resume", "rollback", "take over", "hand back", "hand back undone"])
async def test_what_moves_a_session_is_sent_on_no_other_link_than_it_was_said_on(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch, word: str
) -> None:
    governor = runtime.governor
    name = await (driven(runtime, cell) if word.startswith("hand") else running(runtime, cell))
    status = {"approve": "escalated", "resume": "paused"}.get(word, "running")
    await cell.report("status", name, status=status, reason="separation_m")
    await cell.report("escalation", name, reason="separation_m") if word == "approve" else None
    question = runtime.desk.pending_for(name)
    late = Late(runtime, monkeypatch)

    async def say() -> Any:
        match word:
            case "approve":
                assert question is not None
                return await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
            case "resume":
                return await governor.resume(name, OPERATOR)
            case "rollback":
                return await governor.rollback(name, OPERATOR)
            case "take over":
                return await governor.take_over(name, OPERATOR)
            case _:
                then = "rollback" if word.endswith("undone") else "resume"
                return await governor.release(name, OPERATOR, then)

    saying = asyncio.create_task(say())
    if word.startswith("hand"):  # it is decided from where the robot is by then
        await settled()
        await cell.state()
    await until(lambda: late.recorded.is_set() or saying.done())
    assert not saying.done(), saying.result()
    await cell.hang_up()
    await asyncio.sleep(LEASE_MS / 1000 + 0.05)  # longer than a lease: the cell holds, and waits for a human
    again = HandCell(runtime, seq=cell.seq, invocation=name, status=status)
    dialling = asyncio.create_task(again.dial())
    await until(lambda: runtime.fleet.cell(CELL).attachment is again.attachment is not None)
    late.go.set()
    with contextlib.suppress(Conflict):
        await saying
    await dialling
    await again.state()
    await settled()
    assert not {"resolve_continue", "resume", "rollback"} & set(again.ops())
    assert launches(again) == 0


@pytest.mark.parametrize("word", ["hand back", "approve"])
async def test_what_waits_for_its_turn_is_said_on_no_other_link_either(
    runtime: Runtime, cell: HandCell, word: str
) -> None:
    name = await driven(runtime, cell)
    entry = runtime.register.entry(name)
    assert entry is not None
    if word == "approve":
        await fall_silent(runtime)
        await cell.report("status", name, status="escalated", reason="control_lapsed")
        await cell.report("escalation", name, reason="control_lapsed")
    question = runtime.desk.pending_for(name)

    async def say() -> Any:
        if question is None:
            return await runtime.governor.release(name, OPERATOR, "resume")
        return await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)

    async with entry.lock:  # something about the session is being recorded
        saying = asyncio.create_task(say())
        await settled()
        await cell.state()
        await settled()
        await cell.hang_up()
        again = HandCell(runtime, seq=cell.seq, invocation=name, status="escalated")
        dialling = asyncio.create_task(again.dial())
        await until(lambda: runtime.fleet.cell(CELL).attachment is again.attachment is not None)
    with pytest.raises(Conflict):
        await saying
    await dialling
    await again.state()
    await settled()
    assert launches(again) == 0


@contextlib.asynccontextmanager
async def taking_over(runtime: Runtime, cell: HandCell) -> AsyncGenerator[tuple[str, asyncio.Task[Any]]]:
    """Somebody has the lease of a session, and what is recorded of it waits: something else about it is, just then."""
    name = await running(runtime, cell)
    entry = runtime.register.entry(name)
    assert entry is not None
    async with entry.lock:
        first = asyncio.create_task(runtime.governor.take_over(name, OPERATOR))
        await until(lambda: runtime.fleet.cell(CELL).driven(name))
        yield name, first


async def test_of_two_presses_that_take_over_none_keeps_the_lease_of_a_takeover_that_was_refused(
    runtime: Runtime, cell: HandCell
) -> None:
    async with taking_over(runtime, cell) as (name, first):
        await runtime.governor.take_over(name, OPERATOR)
        await cell.state(holding=True)  # its link lapsed: nobody may drive now
    with pytest.raises(Conflict):
        await first
    assert runtime.fleet.cell(CELL).control is None


async def test_who_pre_empts_a_hand_that_is_let_go_of_meanwhile_has_taken_nothing(
    runtime: Runtime, cell: HandCell
) -> None:
    async with taking_over(runtime, cell) as (name, first):
        second = asyncio.create_task(runtime.governor.take_over(name, replace(OPERATOR_2, station=CELL)))
        await settled()
        await cell.state(holding=True)  # its link lapsed: nobody may drive now
        await fall_silent(runtime)
    for taking in (first, second):
        with pytest.raises(Conflict) as refused:
            await taking
        assert refused.value.code == "takeover_refused"
    assert runtime.fleet.cell(CELL).control is None


async def test_a_refusal_of_an_earlier_authorization_takes_nothing_of_a_later_one(
    runtime: Runtime, cell: HandCell
) -> None:
    name = await running(runtime, cell)
    await runtime.governor.take_over(name, OPERATOR)
    first = permit_of(await cell.expect("launch", 2))
    await fall_silent(runtime)
    await runtime.governor.take_over(name, OPERATOR_2)
    await cell.report("launch", name, permit=first, refused="holding", detail="")
    await cell.report("human", name, op="let_go", refused="not_taken_over")
    await cell.report("launch", name, capability="takeover")
    await cell.report("status", name, status="running", reason="taken_over")
    place = runtime.fleet.cell(CELL)
    assert place.control is not None
    assert place.control.holder == OPERATOR_2.name
    assert (await runtime.governor.invocation(name, AGENT))["takeover"]["state"] == "held"
    second = permit_of(await cell.expect("launch", 3))
    await cell.report("launch", name, permit=second, refused="unreachable", detail="")
    assert (await runtime.governor.invocation(name, AGENT))["takeover"]["state"] == "lapsed"


def permit_of(launch: Launch) -> str:
    return str(orjson.loads(base64.b64decode(launch.body))["id"])


async def test_a_stop_that_comes_while_one_reset_waits_for_another_is_left_by_neither(
    runtime: Runtime, cell: HandCell
) -> None:
    cell.obeys = False
    await runtime.governor.estop(CELL, AGENT)
    first = asyncio.create_task(runtime.governor.reset(CELL, OPERATOR))
    told, recorded = await cell.expect("reset"), runtime.store.size
    second = asyncio.create_task(runtime.governor.reset(CELL, OPERATOR_2))
    await until(lambda: runtime.store.size > recorded)
    await runtime.governor.estop(CELL, AGENT)
    cell.latched, cell.reset = True, told.id
    await cell.state()
    assert (await first)["latched"]
    assert (await second)["latched"]
    assert len(cell.all("reset")) == 1


async def test_a_stop_that_the_cell_sets_by_itself_between_two_resets_is_left_by_neither(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its watch broke in a session that began after the first: nobody had seen that when the second was said."""
    await runtime.governor.estop(CELL, AGENT)
    append, goes_on = runtime.store.append, asyncio.Event()

    async def slow(drafts: Any, *more: Any) -> Any:
        if any(draft.actor == OPERATOR_2.name for draft in drafts):
            await goes_on.wait()
        return await append(drafts, *more)

    monkeypatch.setattr(runtime.store, "append", slow)
    second = asyncio.create_task(runtime.governor.reset(CELL, OPERATOR_2))
    assert not (await runtime.governor.reset(CELL, OPERATOR))["latched"]
    cell.trip(tick=50)
    goes_on.set()  # while what the cell says of that is on its way
    await second
    assert (len(cell.all("reset")), cell.latched) == (2, True)


async def test_a_reset_that_was_armed_leaves_no_stop_that_the_cell_set_by_itself_since(
    runtime: Runtime, cell: HandCell
) -> None:
    await runtime.governor.estop(CELL, AGENT)
    code = runtime.governor.arm_reset(CELL, OPERATOR)["arming"]["code"]
    cell.trip(tick=50)
    await cell.state(tick=50)
    assert (await runtime.governor.reset(CELL, OPERATOR, code))["latched"]
    assert not (await runtime.governor.reset(CELL, OPERATOR))["latched"]


async def test_a_reset_that_was_armed_leaves_no_stop_of_a_run_of_the_cell_that_began_since(
    runtime: Runtime, cell: HandCell
) -> None:
    """Each run counts its ticks anew: one of the run before is of nothing that this one has said."""
    cell.trip(tick=50)
    await cell.state(tick=50)
    code = runtime.governor.arm_reset(CELL, OPERATOR)["arming"]["code"]
    await cell.hang_up()
    cell.boot, cell.closed, cell.tripped = "boot-2", None, 1
    await cell.dial()
    await cell.state(tick=1)
    with pytest.raises(Conflict) as refused:
        await runtime.governor.reset(CELL, OPERATOR, code)
    assert (refused.value.code, cell.all("reset"), cell.latched) == ("not_armed", [], True)
    assert not (await runtime.governor.reset(CELL, OPERATOR))["latched"]


async def test_two_resets_at_once_are_heard_one_after_the_other(runtime: Runtime, cell: HandCell) -> None:
    await runtime.governor.estop(CELL, AGENT)
    both = await asyncio.gather(
        runtime.governor.reset(CELL, OPERATOR), runtime.governor.reset(CELL, OPERATOR_2), return_exceptions=True
    )
    assert all(isinstance(one, Conflict) or not one["latched"] for one in both)
    assert not any(event.kind == "cell" and "not_confirmed" in event.body.decode() for event in await history(runtime))


async def test_an_idle_cell_is_taken_again_whose_session_stands_after_it_was_given_back(
    runtime: Runtime, cell: HandCell
) -> None:
    lease = await runtime.governor.take_cell(CELL, OPERATOR)
    name = cell.invocation = lease["invocation"]
    cell.status = "running"
    await cell.report("launch", name, capability="takeover")
    await cell.report("status", name, status="running")
    await cell.state()
    releasing = asyncio.create_task(runtime.governor.release(name, OPERATOR, "rollback"))
    await until(lambda: "rollback" in cell.ops())
    await cell.report("status", name, status="recovering", reason="ROLLBACK")
    await releasing
    await cell.report("status", name, status="escalated", reason="no_path")  # and stands halfway
    await cell.report("escalation", name, reason="no_path")
    assert runtime.fleet.cell(CELL).control is None
    assert (await runtime.governor.take_cell(CELL, OPERATOR_2))["invocation"] == name


async def history(runtime: Runtime) -> list[Event]:
    return await runtime.store.events(limit=1000)


@pytest.mark.parametrize(("said", "code"), [("expired", "permit_expired"), ("not_yet_valid", "not_yet_valid")])
async def test_a_clock_that_refused_an_authorization_is_no_person_who_did_not_answer(
    runtime: Runtime, cell: HandCell, said: str, code: str
) -> None:
    made, _ = await runtime.governor.propose(AGENT, navigate())
    name = str(made["id"])
    await cell.report("launch", name, refused=said, detail="the clock")
    document = await runtime.governor.invocation(name, AGENT)
    (why,) = document["failure"]["reasons"]
    assert (document["outcome"], why["code"]) == ("fault", code)
    assert "by the cell's clock" in why["message"]
    assert "clocks of server and cell" in why["remedy"]
