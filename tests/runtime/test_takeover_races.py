"""Taking over, and handing back, while something else comes: a pause, an end, a disk that stalls, another hand."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

import pytest

from app.audit.errors import RecordUnavailable
from app.clock import monotonic_s
from app.governance.control import LAPSE_S, Phase
from app.governance.model import EventKind
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict, Forbidden

from .conftest import AGENT, CELL, OPERATOR, OPERATOR_2, HandCell, House, navigate, stating, until
from .test_races import Gate
from .test_takeover import LOCAL, driving, jog, permit, refused

pytestmark = pytest.mark.anyio
__all__ = ["driving"]


async def test_what_is_paused_on_its_way_back_can_still_be_ended(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    back = asyncio.ensure_future(runtime.governor.release(driving, OPERATOR, "resume"))
    async with stating(cell):
        await cell.expect("launch", 3)
    await runtime.governor.pause(driving, OPERATOR_2)
    await cell.report("status", driving, status="paused", before="recovering", reason="operator")
    ending = asyncio.ensure_future(runtime.governor.release(driving, OPERATOR, "end"))
    await until(lambda: cell.ops() == ["pause", "end_takeover"])
    await cell.report("outcome", driving, outcome="taken_over", code="operator")
    assert [(await one)["outcome"] for one in (ending, back)] == ["taken_over", "taken_over"]


@pytest.mark.parametrize("then", ["resume", "rollback"])
async def test_a_session_that_ends_while_it_is_handed_back_is_given_back_to_nobody(
    runtime: Runtime, cell: HandCell, driving: str, then: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    lease = runtime.fleet.cell(CELL).control
    assert lease is not None
    await cell.report("launch", driving, capability="takeover")
    append, reached, go_on = runtime.register.append, asyncio.Event(), asyncio.Event()

    async def slow(drafts: Any, *args: Any, **named: Any) -> None:
        if any(draft.kind == "outcome" for draft in drafts):
            reached.set()
            await go_on.wait()
        await append(drafts, *args, **named)

    monkeypatch.setattr(runtime.register, "append", slow)
    back = asyncio.create_task(runtime.governor.release(driving, OPERATOR, then))
    await cell.say(cell.event("outcome", driving, outcome="stopped", code="contact"))
    await reached.wait()
    async with stating(cell):  # it says what it was: on its way before its end
        await until(lambda: (runtime.fleet.cell(CELL).control or lease).phase is Phase.RETURNING)
    go_on.set()
    assert (await refused(back)).code == "wrong_status"
    assert runtime.fleet.cell(CELL).claim is None
    assert len(cell.all("launch")) == 2


async def test_a_rollback_by_hand_ends_no_pause_that_its_holder_had_not_seen(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    seen = runtime.store.size
    await runtime.governor.pause(driving, OPERATOR_2)
    error = await refused(runtime.governor.release(driving, OPERATOR, "rollback", after=seen))
    assert (error.code, cell.ops()) == ("overtaken", ["pause"])
    await cell.report("human", driving, op="pause")
    back = asyncio.ensure_future(runtime.governor.release(driving, OPERATOR, "rollback", after=runtime.store.size))
    async with stating(cell):
        await until(lambda: cell.ops() == ["pause", "rollback"])
    await cell.report("status", driving, status="recovering", reason="ROLLBACK")
    assert (await back)["takeover"]["state"] == "returned"


async def test_a_takeover_ends_no_pause_that_its_taker_had_not_seen(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    seen, launched = runtime.store.size, len(cell.all("launch"))
    await runtime.governor.pause(driving, OPERATOR_2)
    error = await refused(runtime.governor.take_over(driving, OPERATOR, seen))
    assert (error.code, OPERATOR_2.name in str(error), runtime.fleet.cell(CELL).control) == ("overtaken", True, None)
    await cell.report("human", driving, op="pause")
    await cell.report("status", driving, status="paused", reason="operator")
    assert (await refused(runtime.governor.take_cell(CELL, OPERATOR, seen))).code == "cell_busy"
    assert (await refused(runtime.governor.take_over(driving, OPERATOR, seen))).code == "overtaken"
    assert len(cell.all("launch")) == launched
    await runtime.governor.take_over(driving, OPERATOR, runtime.store.size)
    assert runtime.fleet.cell(CELL).control is not None


async def test_a_takeover_that_ends_no_pause_needs_to_have_seen_nothing(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    seen = runtime.store.size
    await runtime.governor.pause(driving, OPERATOR_2)
    await cell.report("human", driving, op="pause")
    await cell.report("status", driving, status="paused", reason="operator")
    await runtime.governor.resume(driving, OPERATOR_2)
    await cell.report("human", driving, op="resume")
    await cell.report("status", driving, status="running", reason="operator")
    assert (await runtime.governor.take_over(driving, OPERATOR, seen))["invocation"] == driving


@pytest.mark.parametrize("how", ["link", "estop"])
@pytest.mark.parametrize("idle", [True, False])
async def test_nobody_is_told_that_they_have_what_was_taken_from_them_while_that_was_recorded(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch, how: str, idle: bool
) -> None:
    if not idle:
        document, _ = await runtime.governor.propose(AGENT, navigate())
        await cell.launched(document["id"])
    gate = Gate(runtime, monkeypatch)
    name = None if idle else runtime.fleet.cell(CELL).claim
    governor = runtime.governor
    taking = asyncio.create_task(
        governor.take_cell(CELL, OPERATOR) if name is None else governor.take_over(name, OPERATOR)
    )
    await gate.reached.wait()
    if how == "link":
        aside = asyncio.create_task(cell.hang_up())
    else:
        aside = asyncio.create_task(governor.estop(CELL, OPERATOR_2))
    await until(lambda: runtime.fleet.cell(CELL).control is None)
    gate.open.set()
    lost = await refused(taking)
    assert (lost.code, str(lost)) == ("takeover_refused", f"the controls of `{CELL}` were let go of meanwhile")
    await asyncio.wait({aside})


async def test_what_was_launched_before_a_takeover_and_is_told_of_after_it_ends_no_takeover(
    runtime: Runtime, cell: HandCell
) -> None:
    made, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.expect("launch")
    cell.invocation, cell.status = made["id"], "running"
    earlier = permit(cell)["id"]
    await runtime.governor.take_over(made["id"], OPERATOR)
    await cell.expect("launch", 2)
    await cell.report("launch", made["id"], capability="navigate_to", permit=earlier)
    await cell.report("status", made["id"], status="running", reason="launched")
    await cell.report("status", made["id"], status="escalated", reason="separation")
    await cell.report("escalation", made["id"], reason="separation")
    await cell.report("launch", made["id"], capability="takeover", permit=permit(cell)["id"])
    await cell.report("status", made["id"], status="running", reason="taken_over")
    document = await runtime.governor.invocation(made["id"], OPERATOR)
    assert document["takeover"]["state"] == "held"
    assert runtime.fleet.cell(CELL).control is not None


async def test_nothing_is_undone_under_a_hand_that_took_over_while_that_was_looked_into(
    runtime: Runtime, cell: HandCell, driving: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, reached, go_on = runtime.store.events, asyncio.Event(), asyncio.Event()

    async def slow(**wanted: Any) -> Any:
        reached.set()
        await go_on.wait()
        return await read(**wanted)

    monkeypatch.setattr(runtime.store, "events", slow)
    undoing = asyncio.create_task(runtime.governor.rollback(driving, OPERATOR_2, runtime.store.size))
    await reached.wait()
    taking = asyncio.create_task(runtime.governor.take_over(driving, OPERATOR))
    await until(lambda: runtime.fleet.cell(CELL).control is not None)
    go_on.set()
    assert (await refused(undoing)).code in {"control_held", "overtaken"}
    await taking
    assert cell.ops() == []


async def test_who_takes_the_controls_from_another_drives_once_that_is_recorded(
    runtime: Runtime, cell: HandCell, driving: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    gate = Gate(runtime, monkeypatch)
    taking = asyncio.create_task(runtime.governor.take_over(driving, LOCAL))
    await gate.reached.wait()
    shown = runtime.governor.cells()[0]["control"]
    assert jog(runtime, LOCAL, shown, 1) == "not_holder"
    gate.open.set()
    assert jog(runtime, LOCAL, await taking, 2) is None


async def test_who_takes_the_controls_from_another_and_says_so_twice_drives_once_that_is_recorded(
    runtime: Runtime, cell: HandCell, driving: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    gate = Gate(runtime, monkeypatch)
    first = asyncio.create_task(runtime.governor.take_over(driving, LOCAL))
    await gate.reached.wait()
    shown = runtime.governor.cells()[0]["control"]
    again = asyncio.create_task(runtime.governor.take_over(driving, LOCAL))
    await until(lambda: runtime.governor.cells()[0]["control"]["lease"] != shown["lease"])
    assert jog(runtime, LOCAL, runtime.governor.cells()[0]["control"], 1) == "not_holder"
    gate.open.set()
    lost = await refused(first)
    assert (lost.code, str(lost)) == ("takeover_refused", f"`{LOCAL.name}` has taken the controls of `{CELL}` since")
    assert jog(runtime, LOCAL, await again, 2) is None
    told = await runtime.store.events(invocation=driving, kind=EventKind.HUMAN)
    said = [(event.actor, how) for event in told if (how := event.payload().get("how"))]
    assert said == [("olivia", "granted"), (LOCAL.name, "preempted"), (LOCAL.name, "renewed")]


async def test_who_takes_the_controls_from_another_twice_has_nothing_where_neither_is_recorded(
    runtime: Runtime, cell: HandCell, driving: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lease = await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    reached, go_on = asyncio.Event(), asyncio.Event()

    async def full(*_: Any, **__: Any) -> None:
        reached.set()
        await go_on.wait()
        raise RecordUnavailable("the disk is full")

    monkeypatch.setattr(runtime.register, "append", full)
    taking = [asyncio.create_task(runtime.governor.take_over(driving, LOCAL)) for _ in range(2)]
    await reached.wait()
    go_on.set()
    await asyncio.wait(taking)
    assert [type(one.exception()) for one in taking] == [RecordUnavailable, Conflict]
    assert jog(runtime, OPERATOR, lease, 1) is None


async def test_who_takes_the_controls_from_another_has_them_from_nowhere_else_before_that_is_recorded(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    lease = await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    entry = runtime.register.entry(driving)
    assert entry is not None
    async with entry.lock:  # as a report has it that is being recorded
        gone = asyncio.create_task(runtime.governor.take_over(driving, replace(LOCAL, waits=lambda: False)))
        await until(lambda: runtime.governor.cells()[0]["control"]["holder"] == LOCAL.name)
        elsewhere = asyncio.create_task(runtime.governor.take_over(driving, replace(LOCAL, station=None)))
        await asyncio.wait({elsewhere}, timeout=0.1)
    assert [(await refused(one)).code for one in (gone, elsewhere)] == ["given_up", "takeover_refused"]
    assert jog(runtime, OPERATOR, lease, 1) is None
    told = await runtime.store.events(invocation=driving, kind=EventKind.HUMAN)
    assert [event.actor for event in told if event.payload().get("how")] == [OPERATOR.name]


async def test_who_has_given_up_on_taking_them_again_leaves_the_controls_by_the_lease_they_have(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    lease = await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    gone = runtime.governor.take_over(driving, replace(OPERATOR, waits=lambda: False))
    assert (await refused(gone)).code == "given_up"
    assert jog(runtime, OPERATOR, lease, 1) is None


async def test_a_hand_that_falls_silent_is_let_go_of_while_another_is_being_recorded(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = await HandCell(runtime, id="workcell-2").dial()
    await other.state()
    for name, who in ((CELL, OPERATOR), ("workcell-2", OPERATOR_2)):
        await runtime.governor.take_cell(name, who)
    gate = Gate(runtime, monkeypatch)  # a disk that stalls
    for driven in (cell, other):
        place = runtime.fleet.cell(driven.id)
        assert place.control is not None
        place.control = replace(place.control, heard_s=monotonic_s() - LAPSE_S - 0.1)
        await until(lambda driven=driven: driven.ops() == ["let_go"])
    gate.open.set()


@pytest.mark.parametrize("then", ["resume", "rollback"])
async def test_nobody_hands_back_whose_token_is_withdrawn_while_the_cell_is_waited_for(
    house: House, runtime: Runtime, cell: HandCell, driving: str, then: str
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    back = asyncio.ensure_future(runtime.governor.release(driving, OPERATOR, then))
    await asyncio.sleep(0.05)
    house.withdrawn.add(OPERATOR.name)
    async with stating(cell):
        with pytest.raises(Forbidden):
            await back
    assert (cell.ops(), len(cell.all("launch"))) == ([], 2)
    assert (await runtime.governor.invocation(driving, OPERATOR))["takeover"]["state"] == "held"


@pytest.mark.parametrize("then", ["resume", "rollback"])
async def test_what_was_said_by_one_lease_hands_back_none_that_was_given_while_the_cell_was_waited_for(
    runtime: Runtime, cell: HandCell, driving: str, then: str
) -> None:
    lease = await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    back = asyncio.ensure_future(runtime.governor.release(driving, OPERATOR, then, lease["lease"]))
    await asyncio.sleep(0.05)
    await runtime.governor.take_over(driving, OPERATOR)  # in another window
    async with stating(cell):
        assert (await refused(back)).code == "overtaken"
    assert (cell.ops(), len(cell.all("launch"))) == ([], 2)


@pytest.mark.parametrize(
    ("then", "waiting"), [("resume", "its turn"), ("resume", "what is read"), ("rollback", "its turn")]
)
async def test_nobody_hands_back_what_another_has_taken_while_that_was_waited_for(
    runtime: Runtime, cell: HandCell, driving: str, monkeypatch: pytest.MonkeyPatch, then: str, waiting: str
) -> None:
    """Who fell silent has the controls no more, and who has them by now hands nothing back."""
    await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    place, entry = runtime.fleet.cell(CELL), runtime.register.entry(driving)
    assert entry is not None
    go_on = asyncio.Event()
    if waiting == "its turn":
        await entry.lock.acquire()  # something of it is being recorded
    else:
        events = runtime.store.events

        async def slow(**of: Any) -> Any:
            if of.get("kind") == EventKind.AUTHORIZATION:  # who approved it
                await go_on.wait()
            return await events(**of)

        monkeypatch.setattr(runtime.store, "events", slow)
    back = asyncio.ensure_future(runtime.governor.release(driving, OPERATOR, then))
    async with stating(cell):
        await until(lambda: place.control is not None and place.control.phase is Phase.RETURNING)
        assert place.control is not None
        place.control = replace(place.control, heard_s=monotonic_s() - LAPSE_S - 0.1)
        taking = asyncio.ensure_future(runtime.governor.take_over(driving, OPERATOR_2))
        await until(lambda: place.control is not None and place.control.holder == OPERATOR_2.name)
        go_on.set()
        if waiting == "its turn":
            entry.lock.release()
        assert (await refused(back)).code == "not_taken_over"
        assert (await taking)["holder"] == OPERATOR_2.name
    assert (set(cell.ops()), permit(cell)["capability"]) == ({"let_go"}, "takeover")
    assert place.control is not None
    assert (place.control.holder, place.control.phase) == (OPERATOR_2.name, Phase.HELD)


async def test_a_rollback_by_hand_is_overtaken_by_what_others_say_while_the_cell_is_waited_for(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    back = asyncio.ensure_future(runtime.governor.release(driving, OPERATOR, "rollback", after=runtime.store.size))
    await asyncio.sleep(0.05)
    await runtime.governor.pause(driving, OPERATOR_2)
    async with stating(cell):
        assert (await refused(back)).code == "overtaken"


async def test_who_hands_back_is_heard_by_that(runtime: Runtime, cell: HandCell, driving: str) -> None:
    """A client that never jogs says nothing else: its lease does not lapse under the way back that it ordered."""
    await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    place = runtime.fleet.cell(CELL)
    assert place.control is not None
    place.control = replace(place.control, heard_s=monotonic_s() - LAPSE_S + 0.5)
    back = asyncio.ensure_future(runtime.governor.release(driving, OPERATOR, "rollback"))
    async with stating(cell):
        await until(lambda: cell.ops() == ["rollback"])
        await asyncio.sleep(0.7)  # it comes to rest first
        await cell.report("status", driving, status="recovering", reason="ROLLBACK")
    assert (await back)["takeover"]["state"] == "returned"
    assert cell.ops() == ["rollback"]


@pytest.mark.parametrize("op", ["resume", "rollback"])
async def test_nothing_goes_on_by_the_word_of_who_may_say_it_no_more_once_it_is_their_turn(
    house: House, runtime: Runtime, cell: HandCell, driving: str, op: str
) -> None:
    await cell.report("status", driving, status="paused", reason="operator")
    entry = runtime.register.entry(driving)
    assert entry is not None
    async with entry.lock:  # something of it is being recorded
        word = asyncio.ensure_future(getattr(runtime.governor, op)(driving, OPERATOR))
        await asyncio.sleep(0.05)
        house.withdrawn.add(OPERATOR.name)
    with pytest.raises(Forbidden):
        await word
    assert cell.ops() == []


@pytest.mark.parametrize("held", [False, True])
async def test_nobody_takes_over_who_may_no_more_once_it_is_their_turn(
    house: House, runtime: Runtime, cell: HandCell, driving: str, held: bool
) -> None:
    entry, place = runtime.register.entry(driving), runtime.fleet.cell(CELL)
    assert entry is not None
    if held:  # by somebody remote, whom somebody local takes the controls from
        await runtime.governor.take_over(driving, OPERATOR)
    before, launches = place.control, 1 + held
    async with entry.lock:
        taking = asyncio.ensure_future(runtime.governor.take_over(driving, LOCAL))
        await asyncio.sleep(0.05)
        house.withdrawn.add(LOCAL.name)
    with pytest.raises(Forbidden):
        await taking
    assert (place.control, len(cell.all("launch"))) == (before, launches)
