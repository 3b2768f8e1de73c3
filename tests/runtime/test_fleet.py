"""Cells and their links: greeting, reports, coming and going."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import pytest

from app.audit.errors import RecordUnavailable
from app.audit.event import EventDraft, RowWrite
from app.audit.telemetry import TelemetryFile, TelemetryWriter
from app.audit.telemetry_reading import read_telemetry
from app.clock import monotonic_s
from app.protocol import (
    BEAT_MS,
    CHANNELS,
    MOST_ROWS,
    ROW,
    VERSION,
    Beat,
    Hello,
    Sighting,
    encode,
    pack_batch,
    pack_poses,
)
from app.runtime import cells as cells_module
from app.runtime import register as register_module
from app.runtime import roster as roster_module
from app.runtime import sessions as sessions_module
from app.runtime.assembly import Runtime
from app.runtime.broadcast import TICK_S
from app.runtime.budget import Budget
from app.runtime.errors import Conflict
from app.runtime.link import BATCH, MAX_READ, MAX_SHOWN, MAX_WAITING, MOST_VALUES, PROTOCOL_VIOLATION, RETRY_S
from app.runtime.outlet import Outlet

from .conftest import (
    AGENT,
    AT_BENCH,
    AUDITOR,
    CELL,
    ENGINEER,
    OPERATOR,
    OPERATOR_2,
    HandCell,
    House,
    grasp,
    navigate,
    until,
)

pytestmark = pytest.mark.anyio


async def running(runtime: Runtime, cell: HandCell) -> str:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.launched(document["id"])
    return str(document["id"])


async def outcome_codes(runtime: Runtime, invocation: str) -> list[str]:
    trace = await runtime.governor.trace(invocation, AUDITOR)
    return [
        reason["code"] for event in trace if event["kind"] == "outcome" for reason in event["body"].get("reasons", [])
    ]


def row(progress: float) -> bytes:
    return ROW.pack(progress, *([progress] * (len(CHANNELS) - 1)))


# -- greeting --------------------------------------------------------------------------------------------------------


async def test_welcomes_with_key_policy_and_progress(runtime: Runtime) -> None:
    cell = await HandCell(runtime).dial()
    welcome = await cell.expect("welcome")
    assert cell.heard[0] is welcome
    assert welcome.kernel_key == runtime.fleet.kernel_key
    assert welcome.profile == "human-shared"
    assert welcome.acknowledged == 0
    policy = await cell.expect("policy")
    assert policy.digest == welcome.policy_digest
    assert dict(policy.files) == dict(runtime.kernel.policy.files)


async def test_sends_no_policy_that_the_cell_has_already(runtime: Runtime) -> None:
    cell = await HandCell(runtime).dial(policy_digest=runtime.kernel.policy.digest)
    await cell.expect("beat")
    assert not cell.all("policy")


async def test_beats_well_within_the_lease(runtime: Runtime, cell: HandCell) -> None:
    began = asyncio.get_running_loop().time()
    await cell.expect("beat", 5)
    assert asyncio.get_running_loop().time() - began >= 3 * BEAT_MS / 1000, "it paces itself"


@pytest.mark.parametrize(
    ("frame", "why"),
    [
        ("{", "bad message"),
        ('{"type": "beat"}', "begins with `hello`"),
        (b"RTM1", "begins with `hello`"),
        (encode(Hello(cell="other", boot="b", robot="r", policy_digest=None, profile=None, invocation=None,
                      latched=False, journal="j", last_seq=0)), "says it is `other`"),
        (encode(Hello(version=99, cell=CELL, boot="b", robot="r", policy_digest=None, profile=None, invocation=None,
                      latched=False, journal="j", last_seq=0)), "version `99`"),
    ],
)  # fmt: skip
async def test_a_bad_first_word_closes_the_link(runtime: Runtime, frame: str | bytes, why: str) -> None:
    cell = HandCell(runtime)
    attachment = await runtime.fleet.attach(CELL, cell)
    await attachment.receive(frame)
    await until(lambda: cell.closed is not None)
    assert cell.closed is not None
    assert why in cell.closed[1]
    await attachment.detach()


HELLO: dict[str, Any] = {
    "type": "hello", "version": VERSION, "cell": CELL, "boot": "b", "robot": "r", "policy_digest": None,
    "profile": None, "invocation": None, "latched": False, "journal": "j", "last_seq": 0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("field", "value"),
    [("last_seq", 10**30), ("last_seq", -1), ("last_seq", True), ("robot", "x" * 5_000), ("invocation", "x" * 300)],
)
async def test_a_first_word_holds_nothing_that_the_record_cannot(runtime: Runtime, field: str, value: object) -> None:
    cell = HandCell(runtime)
    attachment = await runtime.fleet.attach(CELL, cell)
    await attachment.receive(json.dumps({**HELLO, field: value}))
    await until(lambda: cell.closed is not None)
    assert cell.closed is not None
    assert (cell.closed[0], f"hello.{field}" in cell.closed[1]) == (PROTOCOL_VIOLATION, True)
    assert not runtime.fleet.knows(CELL)
    await attachment.detach()


@pytest.mark.parametrize("change", [{"tick": 10**30}, {"tick": -1}, {"body": {"n": 10**30}}])
async def test_a_report_that_cannot_be_recorded_ends_the_link_and_says_why(
    runtime: Runtime, cell: HandCell, change: dict[str, Any]
) -> None:
    assert cell.attachment is not None
    await cell.attachment.receive(json.dumps({**cell.event("cell").model_dump(), **change}))
    await until(lambda: cell.closed is not None)
    assert cell.closed is not None
    assert cell.closed[0] == PROTOCOL_VIOLATION
    assert runtime.fleet.cell(CELL).up_seq == 0


STATE: dict[str, Any] = {
    "type": "state", "at_s": 1.0, "tick": 1, "invocation": None, "status": None, "latched": False, "holding": False,
    "policy_digest": None, "profile": None, "facts": AT_BENCH, "gauges": {},
}  # fmt: skip


@pytest.mark.parametrize(
    ("facts", "why"),
    [
        ({"people_count": 10**30}, "state.facts"),
        ({"tools": {"lever": [-(2**64)]}}, "state.facts"),
        ({"tools": {f"lever_{number}": "x" * 1000 for number in range(400)}}, "a `state` of `4"),
    ],
)
async def test_a_state_that_nobody_can_be_told_of_ends_its_link_and_keeps_no_console_out(
    runtime: Runtime, cell: HandCell, facts: dict[str, Any], why: str
) -> None:
    assert cell.attachment is not None
    await cell.attachment.receive(json.dumps({**STATE, "facts": {**AT_BENCH, **facts}}))
    console = Outlet()
    runtime.broadcast.join(console, None)
    async with asyncio.timeout(10.0):
        assert '"type":"snapshot"' in str(await console.next())
    await until(lambda: cell.closed is not None)
    assert cell.closed is not None
    assert (cell.closed[0], why in cell.closed[1]) == (PROTOCOL_VIOLATION, True)


async def test_consoles_are_told_later_of_a_cell_whose_states_are_long_and_are_not_cut_off(
    runtime: Runtime, cell: HandCell
) -> None:
    console, told = Outlet(), ""
    runtime.broadcast.join(console, None)
    runtime.fleet.cell(CELL).shown = Budget(most=1_000_000.0, per_s=200_000.0)
    for number in range(100):
        await cell.state(status="x" * 200_000 + f" {number}")
        await asyncio.sleep(1.1 * TICK_S)
    assert console.ended is None
    async with asyncio.timeout(10.0):
        while not told.endswith(f" {number}"):
            for document in json.loads(str(await console.next())).get("cells", ()):
                told = document["status"] or ""


async def test_a_cell_has_one_link(runtime: Runtime, cell: HandCell) -> None:
    second = await HandCell(runtime, boot="boot-2").dial()
    await until(lambda: second.closed is not None)
    assert "live link already" in second.closed[1]
    assert cell.closed is None
    await second.hang_up()
    assert runtime.fleet.attached(runtime.fleet.cell(CELL))


async def test_a_dead_link_is_replaced(runtime: Runtime, cell: HandCell) -> None:
    assert cell.attachment is not None
    cell.attachment.heard_s -= 2.0
    second = await HandCell(runtime).dial()
    await second.expect("welcome")
    await until(lambda: cell.closed is not None)
    await cell.attachment.detach()
    assert runtime.fleet.cell(CELL).attachment is second.attachment
    told = [event.payload()["link"] for event in await runtime.store.events(kind="cell")]
    assert told == ["attached", "lost", "attached"]


async def test_what_a_replaced_link_brought_counts_in_no_other_journal(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    append = runtime.store.append

    async def full(*_: Any) -> None:
        raise RecordUnavailable("the disk is full")

    await cell.report("cell", what="started")
    monkeypatch.setattr(runtime.store, "append", full)
    for _ in range(3):
        await cell.say(cell.event("cell", what="started"))
    assert cell.attachment is not None
    cell.attachment.heard_s -= 2.0
    second = await HandCell(runtime, journal="jrn-2").dial(waits=False)
    await second.expect("welcome")
    monkeypatch.setattr(runtime.store, "append", append)
    await second.report("cell", what="started")
    await asyncio.sleep(1.5 * RETRY_S)
    await cell.attachment.detach()
    assert runtime.fleet.cell(CELL).taken == {"jrn-1": 1, "jrn-2": 1}
    # and the log says so: see `House.open`


async def test_what_a_link_brought_that_was_replaced_twice_counts_in_its_own_journal(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    append, go, tried = runtime.store.append, asyncio.Event(), asyncio.Event()

    async def full(*_: Any) -> None:
        tried.set()
        raise RecordUnavailable("the disk is full")

    async def slow(drafts: Sequence[EventDraft], rows: Sequence[RowWrite]) -> list[int]:
        if rows:
            await go.wait()
        return await append(drafts, rows)

    await cell.report("cell", what="started")
    monkeypatch.setattr(runtime.store, "append", full)
    unsent = cell.event("cell", what="started")
    await cell.say(unsent)
    await tried.wait()
    monkeypatch.setattr(runtime.store, "append", slow)
    links = [cell, HandCell(runtime, journal="jrn-2"), HandCell(runtime, seq=cell.seq)]
    dialling: list[asyncio.Future[HandCell]] = []
    for former, link in pairwise(links):
        assert former.attachment is not None
        former.attachment.heard_s -= 2.0
        dialling.append(asyncio.ensure_future(link.dial()))
        await until(lambda link=link: bool(link.all("welcome")))
        await asyncio.sleep(1.5 * RETRY_S)  # by then the first has tried again
    go.set()
    await asyncio.gather(*dialling)
    await links[-1].say(unsent)
    await links[-1].acknowledged(unsent.seq)
    for former in links[:-1]:
        assert former.attachment is not None
        await former.attachment.detach()
    assert runtime.fleet.cell(CELL).taken == {"jrn-1": 2}
    # and the log says so: see `House.open`


async def test_a_word_is_not_lost_whose_speaker_is_gone_while_it_is_recorded(
    runtime: Runtime, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried, go = asyncio.Event(), asyncio.Event()

    async def full(*_: Any) -> None:
        tried.set()
        await go.wait()
        raise RecordUnavailable("the disk is full")

    with monkeypatch.context() as disk:
        disk.setattr(runtime.store, "append", full)
        said = EventDraft(kind="cell", actor="server", body={"what": "told"})
        saying = asyncio.ensure_future(runtime.register.say(said))
        await tried.wait()
        saying.cancel()
        await asyncio.wait({saying})
        go.set()
        await until(lambda: runtime.register.unsaid() == ["cell"])
    assert await runtime.register.say_unsaid()
    assert [event for event in await runtime.store.events(kind="cell") if event.payload().get("what") == "told"]


async def test_cells_that_come_and_go_push_nothing_out_of_what_waits_for_the_record(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def full(*_: Any) -> None:
        raise RecordUnavailable("the disk is full")

    monkeypatch.setattr(register_module, "MAX_UNSAID", 3)
    async with house.open() as runtime:
        first = await HandCell(runtime).dial()
        await first.report("cell", what="started")
        await first.hang_up()
        with monkeypatch.context() as disk:
            disk.setattr(runtime.store, "append", full)
            second = await HandCell(runtime, journal="jrn-2").dial(waits=False)
            await runtime.governor.estop(CELL, OPERATOR)
            for number in range(5):
                other = await HandCell(runtime, id=f"workcell-{number + 2}").dial(waits=False)
                await other.hang_up()
        await second.report("cell", what="started")
        assert len(await runtime.store.events(kind="human")) == 1
        assert runtime.fleet.cell(CELL).taken == {"jrn-1": 1, "jrn-2": 1}
        told = [(event.actor, body["link"], body.get("journal")) for event in await runtime.store.events(kind="cell")
                if "link" in (body := event.payload())]  # fmt: skip
        assert told == [(CELL, "attached", "jrn-1"), ("server", "lost", None), (CELL, "attached", "jrn-2")]
    # and the log counts the reports in their journals: see `House.open`
    async with house.open() as runtime:
        assert runtime.fleet.cell(CELL).taken == {"jrn-1": 1, "jrn-2": 1}


async def test_links_that_come_and_go_faster_than_the_record_takes_it_are_recorded_in_order(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with house.open() as runtime:
        append, go = runtime.store.append, asyncio.Event()

        async def slow(drafts: Sequence[EventDraft], rows: Sequence[RowWrite] = ()) -> list[int]:
            await go.wait()
            return await append(drafts, rows)

        with monkeypatch.context() as disk:
            disk.setattr(runtime.store, "append", slow)
            links = [
                HandCell(runtime, invocation="inv_of_long_ago"),  # which the record is asked about
                HandCell(runtime, journal="jrn-2"),
            ]
            leaving: list[asyncio.Future[None]] = []
            for link in links:
                dialling = asyncio.ensure_future(link.dial())
                await until(lambda link=link: bool(link.all("welcome")))
                if link is links[0]:
                    leaving += [dialling, asyncio.ensure_future(link.hang_up())]
                    await until(lambda: not runtime.fleet.attached(runtime.fleet.cell(CELL)))
            go.set()
            await asyncio.gather(*leaving, dialling)
        await links[1].report("cell", what="started")
        told = [(one["link"], one.get("journal")) for event in await runtime.store.events(kind="cell")
                if "link" in (one := event.payload())]  # fmt: skip
        assert told == [("attached", "jrn-1"), ("lost", None), ("attached", "jrn-2")]
    # and the log counts the report in its journal: see `House.open`


async def test_a_link_that_hangs_is_closed(runtime: Runtime, cell: HandCell) -> None:
    assert cell.attachment is not None
    cell.attachment.heard_s -= 60.0
    await runtime.fleet.tend_once()
    await until(lambda: cell.closed is not None)


async def test_a_stale_state_says_nothing(runtime: Runtime, cell: HandCell) -> None:
    known = runtime.fleet.cell(CELL)
    assert runtime.fleet.facts(known).online
    known.state_at_s -= cells_module.FRESH_S + 0.1
    facts = runtime.fleet.facts(known)
    assert not facts.online
    assert facts.facts is None


async def test_after_a_session_nothing_is_decided_on_what_the_cell_said_before_its_end(
    runtime: Runtime, cell: HandCell, lasting: pytest.MonkeyPatch
) -> None:
    lasting.undo()
    name = (await runtime.governor.propose(AGENT, navigate()))[0]["id"]
    await cell.launched(name)
    await cell.report("outcome", name, outcome="succeeded", code="done")  # and no word on where it stands now
    silent, _ = await runtime.governor.propose(AGENT, navigate())
    assert (silent["status"], silent["admission"]["reasons"][0]["code"]) == ("deferred", "cell_offline")
    with pytest.raises(Conflict) as refused:
        await runtime.governor.take_cell(CELL, OPERATOR)
    assert refused.value.code == "takeover_refused"
    assert len(cell.all("launch")) == 1


async def test_after_a_session_a_decision_waits_for_what_the_cell_says_next(runtime: Runtime, cell: HandCell) -> None:
    name = (await runtime.governor.propose(AGENT, navigate()))[0]["id"]
    await cell.launched(name)
    await cell.report("outcome", name, outcome="succeeded", code="done")
    next_one = asyncio.ensure_future(runtime.governor.propose(AGENT, navigate()))
    await asyncio.sleep(0)
    cell.invocation = cell.status = None
    await cell.state(facts={**AT_BENCH, "sensors_fresh": False})
    decided, _ = await next_one
    assert decided["admission"]["reasons"][0]["code"] == "precondition_unmet"


async def test_a_beat_counts_as_life(runtime: Runtime, cell: HandCell) -> None:
    assert cell.attachment is not None
    cell.attachment.heard_s -= 5.0
    await cell.attachment.receive(encode(Beat()))
    assert cell.attachment.silent_s() < 1.0


# -- reports ---------------------------------------------------------------------------------------------------------


async def test_reports_are_recorded_once_and_in_order(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    alert = cell.event("alert", name, signal="WARNING", rule="human-shared/separation")
    for _ in range(3):
        await cell.say(alert)
    await cell.report("intervention", name, intervention="PAUSE")
    await cell.say(alert)
    trace = await runtime.governor.trace(name, AUDITOR)
    assert [event["kind"] for event in trace[-2:]] == ["alert", "intervention"]
    assert [event["kind"] for event in trace].count("alert") == 1
    assert trace[-1]["actor"] == CELL
    assert trace[-1]["body"]["tick"] == 7
    assert trace[-1]["body"]["cell_seq"] == cell.seq


async def test_what_was_not_acknowledged_is_taken_after_a_reconnect(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    recorded = cell.seq
    unsent = cell.event("alert", name, signal="WARNING", rule="r")
    await cell.hang_up()
    back = await HandCell(runtime, seq=cell.seq, invocation=name, status="running").dial()
    assert (await back.expect("welcome")).acknowledged == recorded
    await back.say(unsent)
    await back.acknowledged(unsent.seq)


async def test_launches_nothing_before_the_older_reports_of_a_cell_are_in(runtime: Runtime) -> None:
    cell = HandCell(runtime)
    older = cell.event("alert", signal="WARNING", rule="r")
    await cell.dial()
    await cell.state()
    refused, _ = await runtime.governor.propose(AGENT, navigate())
    assert (refused["status"], refused["admission"]["reasons"][0]["code"]) == ("deferred", "cell_offline")
    assert runtime.governor.ready() == {f"cell/{CELL}": "its older reports are not in the log yet"}
    assert not runtime.fleet.faults()
    await cell.say(older)
    await until(lambda: not runtime.governor.ready())
    name = await running(runtime, cell)
    await runtime.fleet.tend_once()
    assert (await runtime.governor.invocation(name, AGENT))["status"] == "running", "its `Hello` knew nothing of it"


@pytest.mark.parametrize(("off_s", "how"), [(3600.0, "3600 s ahead of"), (-3600.0, "3600 s behind")])
async def test_a_cell_with_another_clock_is_named_before_its_first_launch(
    runtime: Runtime, off_s: float, how: str
) -> None:
    cell = HandCell(runtime)
    await cell.dial()
    await cell.state(at_s=runtime.register.now_s() + off_s)
    why = runtime.fleet.faults()[f"cell/{CELL}"]
    assert why.startswith(f"its clock is {how} the server's: ")
    assert runtime.fleet.document(runtime.fleet.cell(CELL))["fault"] == why
    assert runtime.governor.ready() == {f"cell/{CELL}": why}
    await cell.state()
    assert not runtime.fleet.faults()
    assert not runtime.governor.ready()


@pytest.mark.parametrize("off_s", [9.0, -3.0])
async def test_a_clock_by_which_a_launch_may_be_taken_is_no_fault(runtime: Runtime, off_s: float) -> None:
    cell = HandCell(runtime)
    await cell.dial()
    await cell.state(at_s=runtime.register.now_s() + off_s)
    assert not runtime.fleet.faults()


async def test_a_session_that_runs_is_not_said_to_stand_where_its_cell_s_clock_leapt(runtime: Runtime) -> None:
    cell = HandCell(runtime)
    await cell.dial()
    await cell.state()
    name = await running(runtime, cell)
    await cell.state(at_s=runtime.register.now_s() + 3600.0, invocation=name, status="running")
    assert not runtime.fleet.faults()


async def test_a_cell_that_has_not_kept_what_the_log_lacks_launches_nothing_and_is_named(runtime: Runtime) -> None:
    cell = HandCell(runtime, seq=16)
    await cell.dial(first_seq=16)
    await cell.state()
    why = runtime.fleet.faults()[f"cell/{CELL}"]
    assert why.startswith("the log lacks its reports `1` to `15`, which it has not kept: the record was put back to an")
    assert runtime.fleet.document(runtime.fleet.cell(CELL))["fault"] == why
    assert runtime.governor.ready() == {f"cell/{CELL}": why}
    refused, _ = await runtime.governor.propose(AGENT, navigate())
    assert (refused["status"], cell.all("launch"), cell.closed) == ("deferred", [], None)
    await cell.hang_up()
    anew = await HandCell(runtime, journal="jrn-2").dial()
    await anew.state()
    assert not runtime.fleet.faults()
    await running(runtime, anew)


async def test_a_number_that_no_file_can_hold_costs_no_session_its_telemetry(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    assert cell.attachment is not None
    await cell.attachment.receive(pack_batch(name, row(0.0)))
    seen = {"type": "sighting", "invocation": name, "time_s": 0.0, "people": [[2**70, 1.0, 2.0]], "bodies": {}}
    await cell.attachment.receive(json.dumps(seen))
    await until(lambda: cell.closed is not None)
    back = await HandCell(runtime, seq=cell.seq, invocation=name, status="running").dial()
    await back.ended(name, "succeeded")
    assert (await sealed_telemetry(runtime))["rows"] == 1


async def test_what_waits_for_the_record_is_bounded(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def full(*_: Any) -> None:
        raise RecordUnavailable("the disk is full")

    monkeypatch.setattr(runtime.store, "append", full)
    for _ in range(MAX_WAITING // 200_000 + 1):
        await cell.say(cell.event("cell", what="started", detail="x" * 200_000))
    await until(lambda: cell.closed is not None)
    assert cell.closed is not None
    assert "wait for the record" in cell.closed[1]


async def test_a_report_has_only_so_many_characters(cell: HandCell) -> None:
    await cell.say(cell.event("cell", what="started", detail="x" * MAX_SHOWN))
    await until(lambda: cell.closed is not None)
    assert cell.closed is not None
    assert f"valid are `{MAX_SHOWN}`" in cell.closed[1]


@pytest.mark.parametrize("kind", ["hello", "state", "scene"])
async def test_what_is_too_long_is_not_read_at_all(runtime: Runtime, cell: HandCell, kind: str) -> None:
    """Reading 15 MB of numbers took ten seconds, in which nobody could stop any cell."""
    dialling = HandCell(runtime, id="workcell-2")
    link = await runtime.fleet.attach(dialling.id, dialling) if kind == "hello" else cell.attachment
    assert link is not None
    await link.receive(json.dumps({"type": kind, "scene": {"a": [0] * MAX_READ}}))
    told = dialling if kind == "hello" else cell
    await until(lambda: told.closed is not None)
    assert told.closed is not None
    assert f"valid are `{MAX_READ}`" in told.closed[1]


@pytest.mark.parametrize(
    "message",
    [
        {"type": "scene", "scene": {}, "bodies": [1] * 10_000, "gauges": []},
        {**STATE, "gauges": {str(number): "" for number in range(10_000)}},
        {"type": "beat", **{str(number): "" for number in range(10_000)}},
    ],
)
async def test_what_is_wrong_in_many_places_is_not_listed(cell: HandCell, message: dict[str, Any]) -> None:
    """To list a quarter of a million of them took three seconds, in which nobody could stop any cell."""
    assert cell.attachment is not None
    await cell.attachment.receive(json.dumps(message))
    await until(lambda: cell.closed is not None)
    assert cell.closed is not None
    assert "bad message at `10000` places" in cell.closed[1]


async def test_facts_that_are_wrong_in_many_places_are_not_listed(runtime: Runtime, cell: HandCell) -> None:
    cell.facts = {**AT_BENCH, "tools": {str(number): number for number in range(10_000)}}
    await cell.state()
    known = runtime.fleet.cell(CELL)
    assert runtime.fleet.facts(known).facts is None
    assert "`10000` places" in str(known.trouble)


async def test_a_message_holds_only_so_many_values(cell: HandCell) -> None:
    assert cell.attachment is not None
    await cell.attachment.receive(json.dumps({"type": "scene", "scene": {}, "bodies": [1] * MOST_VALUES, "gauges": []}))
    await until(lambda: cell.closed is not None)
    assert cell.closed is not None
    assert f"more than `{MOST_VALUES}` values" in cell.closed[1]


async def test_poses_that_are_too_many_are_not_passed_on(cell: HandCell) -> None:
    assert cell.attachment is not None
    await cell.attachment.receive(pack_poses(1, 0.0, bytes(28 * 20_000), b""))
    await until(lambda: cell.closed is not None)
    assert cell.closed is not None
    assert f"valid are `{MAX_READ}`" in cell.closed[1]


async def test_only_so_much_is_recorded_at_once(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    append, go, lengths = runtime.store.append, asyncio.Event(), list[int]()

    async def slow(drafts: Sequence[EventDraft], rows: Sequence[RowWrite] = ()) -> list[int]:
        await go.wait()
        lengths.append(sum(len(str(draft.body)) for draft in drafts))
        return await append(drafts, rows)

    monkeypatch.setattr(runtime.store, "append", slow)
    said = [cell.event("cell", what="started", detail="x" * 200_000) for _ in range(20)]
    for event in said:
        await cell.say(event)
    go.set()
    await cell.acknowledged(said[-1].seq)
    assert BATCH // 2 < max(lengths) < 1.1 * BATCH
    recorded = [event.payload()["cell_seq"] for event in await runtime.store.events(actor=CELL) if b"xxx" in event.body]
    assert recorded == [event.seq for event in said]


async def test_beyond_what_is_recorded_of_one_cell_its_reports_wait_and_nothing_else_does(
    runtime: Runtime, cell: HandCell
) -> None:
    known, other = runtime.fleet.cell(CELL), await HandCell(runtime, id="workcell-2").dial()
    known.records = Budget(most=1.0, per_s=300_000.0)
    for _ in range(4):
        await cell.say(cell.event("cell", what="started", detail="x" * 200_000))
    await cell.acknowledged(4)
    late = cell.event("cell", what="started")
    await cell.say(late)
    await cell.state(gauges={"speed_mps": 0.5})
    await other.report("cell", what="started")
    beats = len(cell.all("beat"))
    await cell.expect("beat", beats + 3)
    assert known.records.owed_s() > 0
    assert known.state is not None
    assert known.state.gauges == {"speed_mps": 0.5}
    assert "reports more than is recorded" in runtime.fleet.unusable()[f"cell/{CELL}"]
    assert (known.up_seq, cell.closed) == (4, None)
    await cell.acknowledged(late.seq)
    assert known.records.owed_s() < 0.1


async def test_nothing_begins_on_a_cell_whose_reports_wait_and_what_runs_goes_on(
    runtime: Runtime, cell: HandCell
) -> None:
    name = await running(runtime, cell)
    known = runtime.fleet.cell(CELL)
    known.records = Budget(most=1.0, per_s=1.0)
    known.records.spend(100.0)
    await runtime.governor.pause(name, OPERATOR)
    assert cell.ops() == ["pause"]
    assert runtime.fleet.facts(known).online
    known.records = Budget(most=10_000.0, per_s=1.0)
    await cell.ended(name, "stopped")
    known.records.spend(20_000.0)
    late, _ = await runtime.governor.propose(AGENT, navigate(cell=CELL))
    assert (late["status"], late["admission"]["reasons"][0]["code"]) == ("deferred", "cell_offline")


async def test_another_link_is_recorded_of_a_cell_once_what_it_reported_is_paid_for(
    runtime: Runtime, cell: HandCell
) -> None:
    known = runtime.fleet.cell(CELL)
    known.records = Budget(most=1.0, per_s=500.0)
    known.records.spend(1_500.0)
    for _ in range(3):
        await cell.hang_up()
        cell = await HandCell(runtime).dial(waits=False)
    await cell.state()
    assert runtime.fleet.cell(CELL).fresh
    await cell.report("cell", what="started")
    told = [body["link"] for event in await runtime.store.events(kind="cell") if "link" in (body := event.payload())]
    assert told == ["attached", "lost", "attached"]


async def test_a_cell_that_leaves_while_it_is_recorded_has_spent_what_that_costs(
    runtime: Runtime, cell: HandCell
) -> None:
    known, long = runtime.fleet.cell(CELL), cell.event("cell", what="started", detail="x" * 200_000)
    known.records = Budget(most=1.0, per_s=1.0)
    slow = threading.Event()
    runtime.register.store._committer.submit(slow.wait)
    await cell.say(long)
    await until(known.recording.locked)
    leaving = asyncio.create_task(cell.hang_up())
    await until(lambda: not runtime.fleet.facts(known).online)
    slow.set()
    await leaving
    await until(lambda: known.up_seq == long.seq)
    assert known.records.owed_s() > 200_000.0


def test_a_budget_comes_back_with_time_and_never_beyond_its_most() -> None:
    budget = Budget(most=10.0, per_s=1e9)
    budget.spend(5.0)
    assert budget.owed_s() == 0.0
    slow = Budget(most=10.0, per_s=0.001)
    slow.spend(10.0)
    slow.spend(1.0)
    assert 900.0 < slow.owed_s() <= 1000.0


async def test_only_so_many_cells_are_known_and_one_that_left_nothing_makes_room_and_comes_back(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(roster_module, "MOST_CELLS", 3)
    async with house.open() as runtime:
        cells = [HandCell(runtime, id=f"workcell-{number}") for number in (1, 2, 3)]
        for cell in cells:
            await cell.dial()
            await cell.report("cell", what="started")
            await cell.hang_up()
        await runtime.governor.estop("workcell-1", OPERATOR)
        refused = await HandCell(runtime, id="workcell-4").dial()
        await until(lambda: refused.closed is not None)
        assert refused.closed == (
            PROTOCOL_VIOLATION, "`3` cells are known, and none may be forgotten: valid is one of them"
        )  # fmt: skip
        await refused.hang_up()
        for cell in runtime.fleet.cells():
            assert cell.absent_since_s is not None
            cell.absent_since_s -= roster_module.FORGOTTEN_S
        four = await HandCell(runtime, id="workcell-4").dial()
        assert [cell.id for cell in runtime.fleet.cells()] == ["workcell-1", "workcell-3", "workcell-4"]
        back = await HandCell(runtime, id="workcell-2", seq=1).dial()
        assert [cell.id for cell in runtime.fleet.cells()] == ["workcell-1", "workcell-2", "workcell-4"]
        assert (await back.expect("welcome")).acknowledged == 1
        await back.report("cell", what="and on")
        assert runtime.fleet.cell("workcell-2").taken == {"jrn-1": 2}
        await four.hang_up()
    # and the log counts all reports once: see `House.open`
    async with house.open() as runtime:
        assert "workcell-1" in [cell.id for cell in runtime.fleet.cells()]
        assert len(runtime.fleet.cells()) <= 3


async def test_cells_that_were_there_come_back_after_a_restart_however_many_came_and_went(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(roster_module, "MOST_CELLS", 3)
    async with house.open() as runtime:
        for name in ("workcell-1", "workcell-2"):
            await HandCell(runtime, id=name).dial()
        for number in range(3):
            await (await HandCell(runtime, id=f"trial-{number}").dial()).hang_up()
            runtime.fleet.cell(f"trial-{number}").absent_since_s = float("-inf")
    async with house.open() as runtime:
        for name in ("workcell-1", "workcell-2"):
            await HandCell(runtime, id=name).dial()
        assert {"workcell-1", "workcell-2"} < {cell.id for cell in runtime.fleet.cells()}
        new = await HandCell(runtime, id="trial-3").dial()
        await until(lambda: new.closed is not None)


async def test_a_cell_is_not_forgotten_while_it_is_put_under_another_profile(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    await cell.hang_up()
    await (await HandCell(runtime, id="workcell-2").dial()).hang_up()
    monkeypatch.setattr(roster_module, "MOST_CELLS", 2)
    monkeypatch.setattr(roster_module, "FORGOTTEN_S", 0.0)
    slow = threading.Event()
    runtime.register.store._committer.submit(slow.wait)
    putting = asyncio.create_task(runtime.governor.set_profile(CELL, "real-restricted", ENGINEER))
    await until(runtime.fleet.cell(CELL).profiling.locked)
    await HandCell(runtime, id="workcell-3").dial(waits=False)
    await HandCell(runtime).dial(waits=False)  # the record cannot say yet what it is put under
    slow.set()
    await putting
    assert runtime.fleet.cell(CELL).profile == "real-restricted"


async def test_a_gap_closes_the_link(runtime: Runtime, cell: HandCell) -> None:
    cell.seq += 5
    await cell.say(cell.event("cell", what="started"))
    await until(lambda: cell.closed is not None)
    assert cell.closed is not None
    assert "gap" in cell.closed[1]
    assert runtime.fleet.cell(CELL).up_seq == 0


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        ("authorization", {}),
        ("approval", {}),
        ("boot", {}),
        ("nonsense", {}),
        ("status", {"status": "awaiting_approval"}),
        ("status", {}),
        ("outcome", {"outcome": "fine"}),
        ("outcome", {"outcome": "denied"}),
        ("alert", {"escalation": {"id": "esc_1", "status": "pending"}}),
        ("alert", {"withdrawn": "esc_1"}),
        ("human", {"op": ["pause"]}),
        ("human", {"op": "pause", "role": "operator"}),
        ("human", {"op": "reset", "cell": "workcell-2"}),
        ("status", {"status": "running", "reason": {"handed": "back"}}),
        ("launch", {"refused": True}),
    ],
)
async def test_a_cell_reports_only_what_a_cell_may(
    runtime: Runtime, cell: HandCell, kind: str, body: dict[str, Any]
) -> None:
    name = await running(runtime, cell)
    before = runtime.fleet.cell(CELL).up_seq
    await cell.say(cell.event(kind, name, **body))
    await until(lambda: cell.closed is not None)
    assert runtime.fleet.cell(CELL).up_seq == before
    assert (await runtime.governor.invocation(name, AGENT))["status"] == "running"


async def test_an_outcome_has_the_status_that_the_server_gives_it(runtime: Runtime, cell: HandCell) -> None:
    for claimed in ("running", "no status"):
        name = await running(runtime, cell)
        await cell.report("outcome", name, outcome="succeeded", status=claimed)
        cell.invocation = cell.status = None
        await cell.state()
        assert (await runtime.governor.invocation(name, AGENT))["status"] == "completed"
    # and the log says so: see `House.open`


async def test_the_log_knows_of_a_session_that_is_held_again_in_the_tick_of_an_answered_question(
    runtime: Runtime, cell: HandCell
) -> None:
    name = await running(runtime, cell)
    await cell.report("status", name, status="escalated", reason="stall")
    question = runtime.desk.pending_for(name)
    assert question is not None
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    await cell.report("status", name, status="running", reason="operator")
    await cell.report("escalation", name, reason="stall")
    assert (await runtime.governor.invocation(name, AGENT))["status"] == "escalated"


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        ("launch", {}),
        ("launch", {"refused": "busy"}),
        ("status", {"status": "running"}),
        ("escalation", {"reason": "stall"}),
        ("outcome", {"outcome": "succeeded"}),
    ],
)
async def test_what_waits_for_people_is_nothing_that_a_cell_has(
    runtime: Runtime, cell: HandCell, kind: str, body: dict[str, Any]
) -> None:
    document, _ = await runtime.governor.propose(AGENT, grasp())
    before = await runtime.register.load(document["id"])
    await cell.report(kind, before.id, **body)
    assert await runtime.register.load(before.id) == before
    question = runtime.desk.pending_for(before.id)
    assert question is not None
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    assert {event["actor"] for event in await runtime.governor.trace(before.id, AUDITOR)} == {
        "server", AGENT.name, OPERATOR.name,
    }  # fmt: skip


async def test_a_cell_that_holds_what_waits_for_people_is_told_to_stop_it(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, grasp())
    cell.invocation, cell.status = document["id"], "running"
    await cell.state()
    runtime.fleet.look()
    await until(lambda: cell.ops() == ["stop"])
    await cell.hang_up()
    back = await HandCell(runtime, seq=cell.seq, invocation=document["id"]).dial()
    await until(lambda: back.ops() == ["stop"])


async def test_a_cell_cannot_speak_for_anothers_session(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    other = await HandCell(runtime, id="workcell-2").dial()
    await other.say(other.event("outcome", name, outcome="succeeded"))
    await until(lambda: other.closed is not None)
    third = await HandCell(runtime, id="workcell-3").dial()
    assert third.attachment is not None
    await third.attachment.receive(pack_batch(name, row(0.0)))
    await until(lambda: third.closed is not None)
    assert (await runtime.governor.invocation(name, AGENT))["status"] == "running"


async def test_a_trace_holds_no_word_of_a_cell_that_never_had_the_invocation(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    other = await HandCell(runtime, id="workcell-2", invocation=name).dial()
    await cell.ended(name, "succeeded")
    await other.report("human", name, op="resume", actor="operator")
    await other.report("outcome", "inv_made_up", outcome="succeeded")
    assert other.closed is None, "it goes on, whatever it reports of a record that was lost"
    assert "workcell-2" not in {event["actor"] for event in await runtime.governor.trace(name, AUDITOR)}
    assert not await runtime.register.store.events(invocation="inv_made_up")
    said = await runtime.register.store.events(actor="workcell-2")
    assert {event.kind for event in said} == {"cell"}
    bodies = [event.payload() for event in said]
    assert [body.get("invocation") for body in bodies if body.get("link") == "attached"] == [name]
    strays = [(body["stray"], body["session"], body["cell_seq"]) for body in bodies if "stray" in body]
    assert strays == [("human", name, 1), ("outcome", "inv_made_up", 2)]


async def test_what_a_cell_reports_of_a_session_that_the_log_lost_stands_there_word_by_word(
    runtime: Runtime, cell: HandCell
) -> None:
    told = {"signal": "COMPLETION", "rule": "watch/completion", "of": "attempt", "verified": ["at_target"]}
    await cell.report("alert", "inv_lost", **told)
    said = await runtime.register.store.events(actor=CELL, kind="cell")
    (kept,) = [body for body in (event.payload() for event in said) if "stray" in body]
    assert (kept["stray"], kept["session"]) == ("alert", "inv_lost")
    assert told.items() <= kept.items()


async def test_what_a_cell_reports_again_of_an_invocation_that_is_over_is_in_its_trace(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.state()
        name = await running(first, cell)
        await cell.ended(name, "succeeded")
        await cell.hang_up()
    async with house.open() as second:
        back = await HandCell(second, boot="boot-2", seq=cell.seq, invocation=name).dial()
        await back.report("alert", name, signal="warning", rule="separation")
        trace = await second.governor.trace(name, AUDITOR)
    assert [(event["kind"], event["actor"]) for event in trace[-2:]] == [("cell", CELL), ("alert", CELL)]


async def test_terminal_statuses_absorb_late_words(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await cell.report("status", name, status="completed")
    assert (await runtime.governor.invocation(name, AGENT))["status"] == "running", "the outcome says it"
    await cell.ended(name, "succeeded")
    await cell.report("status", name, status="running")
    await cell.report("outcome", name, outcome="stopped")
    final = await runtime.governor.invocation(name, AGENT)
    assert (final["status"], final["outcome"]) == ("completed", "succeeded")


@pytest.mark.parametrize(
    ("outcome", "status"),
    [
        ("succeeded", "completed"),
        ("recovered", "completed"),
        ("rolled_back", "failed"),
        ("terminated", "failed"),
        ("stopped", "failed"),
        ("cancelled", "failed"),
        ("fault", "failed"),
    ],
)
async def test_every_outcome_ends_in_its_status(runtime: Runtime, cell: HandCell, outcome: str, status: str) -> None:
    name = await running(runtime, cell)
    for step in ("paused", "running", "recovering", "running"):
        await cell.report("status", name, status=step)
        assert (await runtime.governor.invocation(name, AGENT))["status"] == step
    await cell.ended(name, outcome)
    final = await runtime.governor.invocation(name, AGENT)
    assert (final["status"], final["outcome"]) == (status, outcome)
    assert runtime.fleet.busy(runtime.fleet.cell(CELL)) is None


@pytest.mark.parametrize(("code", "outcome"), [("holding", "fault"), ("estop_latched", "stopped")])
async def test_a_refused_launch_ends_as_a_fault_or_by_the_stop_that_came_first(
    runtime: Runtime, cell: HandCell, code: str, outcome: str
) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.report("launch", document["id"], refused=code, detail="the cell says why")
    final = await runtime.governor.invocation(document["id"], AGENT)
    assert (final["status"], final["outcome"]) == ("failed", outcome)
    assert await outcome_codes(runtime, document["id"]) == [code]
    assert runtime.fleet.cell(CELL).claim is None


async def test_reports_wait_for_a_record_that_fails_and_the_link_stays(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = await running(runtime, cell)
    tried = asyncio.Event()

    async def broken(*_: Any) -> list[int]:
        tried.set()
        raise RecordUnavailable("disk full")

    monkeypatch.setattr(runtime.store, "append", broken)
    event = cell.event("status", name, status="paused")
    await cell.say(event)
    await asyncio.wait_for(tried.wait(), 5.0)
    assert (await runtime.governor.invocation(name, AGENT))["status"] == "running"
    assert cell.closed is None
    monkeypatch.undo()
    await cell.acknowledged(event.seq)
    assert (await runtime.governor.invocation(name, AGENT))["status"] == "paused"


async def test_a_link_that_drops_while_reports_are_recorded_leaves_nothing_half_known(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = await running(runtime, cell)
    append, written, goes_on = runtime.store.append, asyncio.Event(), asyncio.Event()

    async def slow(*args: Any) -> Any:
        seqs = await append(*args)
        written.set()
        await goes_on.wait()
        return seqs

    monkeypatch.setattr(runtime.store, "append", slow)
    held = cell.event("escalation", name, reason="link")
    await cell.say(held)
    await asyncio.wait_for(written.wait(), 5.0)
    leaving = asyncio.create_task(cell.hang_up())
    await until(lambda: runtime.fleet.cell(CELL).attachment is None)
    monkeypatch.undo()
    goes_on.set()
    await leaving
    back = await HandCell(runtime, seq=cell.seq, invocation=name, status="escalated").dial()
    await back.say(held)
    await back.acknowledged(held.seq)
    document = await runtime.governor.invocation(name, AGENT)
    assert document["status"] == "escalated"
    question = await runtime.desk.get(document["escalation"]["id"])
    closed = await runtime.desk.resolve(question["id"], OPERATOR, "deny", question["digest"])
    assert closed["status"] == "denied"
    trace = await runtime.governor.trace(name, AUDITOR)
    assert [event["kind"] for event in trace].count("escalation") == 1


# -- telemetry -------------------------------------------------------------------------------------------------------


async def test_telemetry_is_sealed_after_the_outcome_and_vouched_for(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    assert cell.attachment is not None
    await cell.attachment.receive(pack_batch(name, row(0.1) + row(0.2)))
    await cell.report("outcome", name, outcome="succeeded", code="done")
    await cell.attachment.receive(pack_batch(name, row(0.3)))  # the last rows follow the outcome
    cell.invocation = cell.status = None
    await cell.state()
    async with asyncio.timeout(5.0):
        while not (sealed := await runtime.store.events(kind="telemetry")):
            await asyncio.sleep(0.005)
    body = sealed[0].payload()
    assert body["rows"] == 3
    assert (runtime.store.places.telemetry / str(body["file"])).is_file()
    await cell.attachment.receive(pack_batch(name, row(0.4)))
    assert runtime.telemetry.open() == []


async def sealed_telemetry(runtime: Runtime) -> dict[str, Any]:
    async with asyncio.timeout(5.0):
        while not (sealed := await runtime.store.events(kind="telemetry")):
            await asyncio.sleep(0.005)
    return dict(sealed[0].payload())


@pytest.mark.parametrize("end", ["session_lost", "cell_restarted"])
async def test_what_was_sent_before_a_cell_was_lost_is_kept_and_the_rest_said_to_be_missing(
    runtime: Runtime, cell: HandCell, end: str
) -> None:
    name = await running(runtime, cell)
    assert cell.attachment is not None
    await cell.attachment.receive(pack_batch(name, row(0.1) + row(0.2)))
    if end == "session_lost":
        await cell.hang_up()
        await HandCell(runtime, boot="boot-2", seq=cell.seq).dial()
    else:
        await cell.report("outcome", name, outcome="fault", code=end)
    body = await sealed_telemetry(runtime)
    assert body["rows"] == 2
    assert "not sent" in body["missing"]
    (event,) = await runtime.store.events(kind="telemetry")
    found = read_telemetry(runtime.store.places.telemetry, event, limit=9)
    assert found is not None
    assert found.rows == 2


async def test_a_cell_that_was_lost_before_it_sent_anything_leaves_word_of_it(runtime: Runtime, cell: HandCell) -> None:
    await running(runtime, cell)
    await cell.hang_up()
    await HandCell(runtime, boot="boot-2", seq=cell.seq).dial()
    body = await sealed_telemetry(runtime)
    assert "nothing had come of it" in body["failed"]
    assert "file" not in body


async def test_what_is_overdue_of_one_cell_waits_for_no_telemetry_of_another(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    go, close = threading.Event(), TelemetryWriter.close

    def stalled(writer: TelemetryWriter) -> TelemetryFile:
        go.wait(60.0)
        return close(writer)

    monkeypatch.setattr(TelemetryWriter, "close", stalled)
    other = await HandCell(runtime, id="workcell-2").dial()
    await other.state()
    name, (document, _) = await running(runtime, cell), await runtime.governor.propose(AGENT, navigate(cell=other.id))
    await other.launched(document["id"])
    assert cell.attachment is not None
    await cell.attachment.receive(pack_batch(name, row(0.1)))
    away_s = monotonic_s() - 60.0
    for link in (cell, other):
        await link.hang_up()
    runtime.fleet.cell(CELL).absent_since_s = away_s
    await until(lambda: runtime.register.newest(name) is None)
    try:
        await until(lambda: runtime.desk.pending_for(document["id"]) is not None)
    finally:
        go.set()
    assert (await sealed_telemetry(runtime))["rows"] == 1


async def test_where_people_and_things_were_goes_into_the_telemetry(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    assert cell.attachment is not None
    seen = Sighting(invocation=name, time_s=0.05, people=[(1, 2.0, 3.0)], bodies={"mug_1": (1, 2, 3, 1, 0, 0, 0)})
    await cell.attachment.receive(encode(seen))
    await cell.attachment.receive(pack_batch(name, row(0.1)))
    await cell.attachment.receive(encode(seen.model_copy(update={"invocation": "inv_other"})))
    await cell.ended(name, "succeeded")
    async with asyncio.timeout(5.0):
        while not (sealed := await runtime.store.events(kind="telemetry")):
            await asyncio.sleep(0.005)
    found = read_telemetry(runtime.store.places.telemetry, sealed[0], limit=10)
    assert found is not None
    assert (found.people.time_s, found.people.tracks) == ([0.05], [[(1, 2.0, 3.0)]])
    assert found.bodies["mug_1"].pose == [[1, 2, 3, 1, 0, 0, 0]]


async def test_what_waits_for_people_has_no_telemetry(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, grasp())
    assert cell.attachment is not None
    await cell.attachment.receive(pack_batch(document["id"], row(0.0)))
    seen = {"type": "sighting", "invocation": document["id"], "time_s": 0.0, "people": [], "bodies": {}}
    await cell.attachment.receive(json.dumps(seen))
    assert (cell.closed, runtime.telemetry.open()) == (None, [])


async def test_nobody_else_writes_into_the_telemetry_of_a_session_that_has_just_ended(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sessions_module, "LAST_ROWS_S", 20.0)
    name = await running(runtime, cell)
    other = await HandCell(runtime, id="workcell-2").dial()
    assert cell.attachment is not None
    await cell.attachment.receive(pack_batch(name, row(0.0)))
    await cell.report("outcome", name, outcome="succeeded")
    await other.report("alert", name, signal="VIOLATION", rule="speed")
    assert runtime.telemetry.open() == [name]
    await cell.state()
    assert (await sealed_telemetry(runtime))["events"] == 0


async def test_bad_telemetry_closes_the_link(runtime: Runtime, cell: HandCell) -> None:
    assert cell.attachment is not None
    await cell.attachment.receive(b"RTM1" + bytes(60))
    await until(lambda: cell.closed is not None)


async def test_a_frame_of_telemetry_has_only_so_many_rows(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    assert cell.attachment is not None
    await cell.attachment.receive(pack_batch(name, MOST_ROWS * row(0.0)))
    assert cell.closed is None
    await cell.attachment.receive(pack_batch(name, (MOST_ROWS + 1) * row(0.0)))
    await until(lambda: cell.closed is not None)
    assert cell.closed is not None
    assert f"valid are `{MOST_ROWS}`" in cell.closed[1]


# -- coming and going ------------------------------------------------------------------------------------------------


async def test_a_cell_that_restarted_without_the_session_is_a_fault(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await cell.hang_up()
    await HandCell(runtime, boot="boot-2", seq=cell.seq).dial()
    final = await runtime.governor.invocation(name, AGENT)
    assert (final["status"], final["outcome"]) == ("failed", "fault")
    assert await outcome_codes(runtime, name) == ["session_lost"]


async def test_a_session_that_ended_while_away_is_told_and_no_fault(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    end = cell.event("outcome", name, outcome="succeeded", code="done")
    await cell.hang_up()
    back = await HandCell(runtime, seq=cell.seq).dial()
    assert (await runtime.governor.invocation(name, AGENT))["status"] == "running", "its reports are not in yet"
    await back.say(end)
    await back.acknowledged(end.seq)
    assert (await runtime.governor.invocation(name, AGENT))["outcome"] == "succeeded"


async def test_a_cell_that_held_its_session_waits_for_a_human(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await cell.hang_up()
    away = runtime.fleet.cell(CELL)
    assert away.absent_since_s is not None
    away.absent_since_s -= 0.5
    back = await HandCell(runtime, seq=cell.seq, invocation=name, status="escalated").dial()
    document = await runtime.governor.invocation(name, AGENT)
    assert document["status"] == "escalated"
    question = await runtime.desk.get(document["escalation"]["id"])
    assert question["kind"] == "session"
    assert question["reasons"][0]["code"] == "link_returned"
    assert not back.all("human")
    await runtime.desk.resolve(question["id"], OPERATOR, "approve", question["digest"])
    await until(lambda: back.ops() == ["resolve_continue"])


async def test_a_blink_within_the_lease_changes_nothing(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await cell.hang_up()
    back = await HandCell(runtime, seq=cell.seq, invocation=name, status="running").dial()
    await back.state()
    assert (await runtime.governor.invocation(name, AGENT))["status"] == "running"


async def test_a_cell_that_stays_away_is_shown_and_then_given_up(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await cell.hang_up()
    away = runtime.fleet.cell(CELL)
    assert away.absent_since_s is not None
    away.absent_since_s -= sessions_module.LOST_S + 0.1
    await runtime.fleet.tend_once()
    document = await runtime.governor.invocation(name, AGENT)
    assert document["status"] == "escalated"
    assert (await runtime.desk.get(document["escalation"]["id"]))["reasons"][0]["code"] == "link_lost"
    away.absent_since_s -= sessions_module.ABSENT_S
    await runtime.fleet.tend_once()
    final = await runtime.governor.invocation(name, AGENT)
    assert (final["status"], final["outcome"]) == ("failed", "fault")
    assert final["escalation"]["status"] == "withdrawn"
    assert await outcome_codes(runtime, name) == ["cell_lost"]
    late = await HandCell(runtime, seq=cell.seq, invocation=name, status="escalated").dial()
    await until(lambda: late.ops() == ["stop"])


async def test_nobody_is_asked_about_a_session_whose_cell_is_being_started(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await cell.hang_up()
    runtime.fleet.expect(CELL, True)
    away = runtime.fleet.cell(CELL)
    assert away.absent_since_s is not None
    away.absent_since_s -= sessions_module.LOST_S + 0.1
    await runtime.fleet.tend_once()
    assert (await runtime.governor.invocation(name, AGENT))["status"] == "running"
    runtime.fleet.expect(CELL, False)
    await runtime.fleet.tend_once()
    assert (await runtime.governor.invocation(name, AGENT))["status"] == "escalated", "nobody starts it any more"


async def test_an_invocation_has_one_outcome_and_a_later_word_of_the_cell_is_kept_as_such(
    runtime: Runtime, cell: HandCell
) -> None:
    name = await running(runtime, cell)
    await cell.hang_up()
    await HandCell(runtime, boot="boot-2", seq=cell.seq).dial()
    assert (await runtime.governor.invocation(name, AGENT))["outcome"] == "fault"
    back = runtime.fleet.cell(CELL).attachment
    assert back is not None
    late = cell.event("outcome", name, outcome="stopped", code="operator")
    await back.receive(encode(late))
    await until(lambda: runtime.fleet.cell(CELL).up_seq == late.seq)
    trace = await runtime.governor.trace(name, AUDITOR)
    assert [event["body"]["outcome"] for event in trace if event["kind"] == "outcome"] == ["fault"]
    assert (trace[-1]["kind"], trace[-1]["body"]["late"], trace[-1]["body"]["outcome"]) == (
        "cell",
        "outcome",
        "stopped",
    )


async def test_a_launch_nobody_confirms_is_a_fault(house: House, runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await runtime.fleet.tend_once()
    assert (await runtime.governor.invocation(document["id"], AGENT))["status"] == "running"
    house.wall_s.offset_s = sessions_module.UNCONFIRMED_S + 1.0
    await runtime.fleet.tend_once()
    final = await runtime.governor.invocation(document["id"], AGENT)
    assert (final["status"], final["outcome"]) == ("failed", "fault")
    assert await outcome_codes(runtime, document["id"]) == ["launch_unconfirmed"]
    await until(lambda: cell.ops() == ["stop"])


def unrecorded(*ended: tuple[str, str, str]) -> dict[str, Any]:
    said = [{"invocation": name, "outcome": outcome, "code": code} for name, outcome, code in ended]
    return {"why": "no room for journal `journal`", "ended": said}


async def test_what_a_cell_cannot_write_down_ends_all_the_same_and_its_report_comes_late(
    runtime: Runtime, cell: HandCell
) -> None:
    name = await running(runtime, cell)
    cell.invocation = cell.status = None
    await cell.state(fault=unrecorded((name, "stopped", "operator"), ("inv_unheard_of", "fault", "estop")))
    await runtime.fleet.tend_once()
    ended = await runtime.governor.invocation(name, AGENT)
    assert (ended["status"], ended["outcome"]) == ("failed", "stopped")
    assert [why["code"] for why in ended["failure"]["reasons"]] == ["operator", "journal_unavailable"]
    assert await outcome_codes(runtime, name) == ["journal_unavailable"]
    shown = runtime.fleet.document(runtime.fleet.cell(CELL))
    assert (shown["busy"], shown["status"], shown["fault"]) == (None, None, "no room for journal `journal`")
    await cell.report("outcome", name, outcome="stopped", code="operator")
    trace = await runtime.governor.trace(name, AUDITOR)
    assert [event["kind"] for event in trace if event["body"].get("outcome") == "stopped"] == ["outcome", "cell"]


@pytest.mark.parametrize("end", ["unrecorded", "lost", "restarted"])
async def test_why_a_human_let_a_session_not_go_on_is_said_whoever_says_that_it_is_over(
    runtime: Runtime, cell: HandCell, end: str
) -> None:
    name = await running(runtime, cell)
    await cell.report("escalation", name, reason="separation_m")
    question = runtime.desk.pending_for(name)
    assert question is not None
    await runtime.desk.resolve(question.id, OPERATOR, "deny", question.digest, code="person_in_the_way")
    cell.invocation = cell.status = None
    if end == "unrecorded":
        await cell.state(fault=unrecorded((name, "terminated", "operator")))
    else:
        await cell.hang_up()
    if end == "restarted":
        await HandCell(runtime, boot="boot-2", seq=cell.seq).dial()
    elif end == "lost":
        runtime.fleet.cell(CELL).absent_since_s = monotonic_s() - 2 * sessions_module.ABSENT_S
    await runtime.fleet.tend_once()
    codes = [why["code"] for why in (await runtime.governor.invocation(name, AGENT))["failure"]["reasons"]]
    ends = {"unrecorded": ["operator", "journal_unavailable"], "lost": ["cell_lost"], "restarted": ["session_lost"]}
    assert codes == ["person_in_the_way", *ends[end]]


async def test_a_denial_is_no_reason_of_what_went_on_after_all(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await cell.report("status", name, status="escalated", reason="separation_m")
    question = runtime.desk.pending_for(name)
    assert question is not None
    runtime.desk.hold(replace(question, on_deny="rollback"))
    await runtime.desk.resolve(question.id, OPERATOR, "deny", question.digest, code="person_in_the_way")
    await cell.report("status", name, status="recovering", reason="ROLLBACK")
    await cell.report("status", name, status="running", reason="taken_over")  # and handed back
    await cell.report("outcome", name, outcome="terminated", code="blocked")
    ended = await runtime.governor.invocation(name, AGENT)
    assert [why["code"] for why in ended["failure"]["reasons"]] == ["blocked"]


async def test_a_refused_launch_that_cannot_be_written_down_is_a_fault(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.state(fault=unrecorded((document["id"], "fault", "journal_unavailable")))
    await runtime.fleet.tend_once()
    assert (await runtime.governor.invocation(document["id"], AGENT))["outcome"] == "fault"


async def test_what_came_before_the_full_disk_is_recorded_before_the_end_that_only_the_state_tells(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = await running(runtime, cell)
    append = runtime.register.append
    gate = asyncio.Event()

    async def slow(*args: Any, **kwargs: Any) -> Any:
        await gate.wait()
        return await append(*args, **kwargs)

    monkeypatch.setattr(runtime.register, "append", slow)
    alert = cell.event("alert", name, signal="WARNING", rule="watch/timeout")
    await cell.say(alert)
    await cell.state(fault=unrecorded((name, "stopped", "operator")))
    await runtime.fleet.tend_once()
    gate.set()
    await cell.acknowledged(alert.seq)
    await runtime.fleet.tend_once()
    trace = await runtime.governor.trace(name, AUDITOR)
    assert [event["kind"] for event in trace][-2:] == ["alert", "outcome"]


async def test_nothing_is_proposed_to_a_cell_that_cannot_record(runtime: Runtime, cell: HandCell) -> None:
    assert runtime.governor.ready() == {}
    await cell.state(fault=unrecorded())
    assert runtime.governor.ready() == {f"cell/{CELL}": "no room for journal `journal`"}
    document, _ = await runtime.governor.propose(AGENT, navigate(cell=CELL))
    assert document["status"] == "deferred"
    assert [reason["code"] for reason in document["admission"]["reasons"]] == ["journal_unavailable"]
    other = await HandCell(runtime, id="workcell-2").dial()
    await other.state()
    document, _ = await runtime.governor.propose(AGENT, navigate())
    assert (document["status"], document["cell"]) == ("running", "workcell-2")
    await cell.state()
    assert runtime.governor.ready() == {}


async def test_a_session_shows_the_profile_it_was_authorized_under(runtime: Runtime, cell: HandCell) -> None:
    await running(runtime, cell)
    sitting = {"profile": "human-shared", "phase": "drive", "doing": "attempt", "violated": [], "paused_by": []}
    await runtime.governor.set_profile(CELL, "sim-relaxed", OPERATOR)
    await cell.state(session={**sitting, "waits_for": ""})
    shown = runtime.fleet.document(runtime.fleet.cell(CELL))
    assert (shown["profile"], shown["session"]["profile"]) == ("sim-relaxed", "human-shared")


async def test_a_stop_reaches_a_cell_that_was_away(runtime: Runtime, cell: HandCell) -> None:
    name = await running(runtime, cell)
    await cell.hang_up()
    await runtime.governor.stop(name, OPERATOR)
    await runtime.governor.estop(CELL, OPERATOR)
    back = await HandCell(runtime, seq=cell.seq, invocation=name, status="escalated").dial()
    await back.expect("estop")
    await until(lambda: back.ops() == ["stop"])


async def test_a_stop_that_was_lost_with_its_link_is_said_again_until_the_session_is_over(
    runtime: Runtime, cell: HandCell
) -> None:
    name = await running(runtime, cell)
    await runtime.governor.stop(name, OPERATOR)
    await cell.hang_up()
    back = await HandCell(runtime, seq=cell.seq, invocation=name, status="running").dial()
    await until(lambda: back.ops() == ["stop"])
    await back.ended(name, "stopped")
    await back.hang_up()
    idle = await HandCell(runtime, seq=back.seq).dial()
    await idle.expect("beat")
    assert idle.ops() == []


@dataclass
class SlowCell(HandCell):
    """A cell whose socket takes nothing while its gate is shut."""

    gate: asyncio.Event = field(default_factory=asyncio.Event)
    stuck: int = 0

    async def send(self, frame: str) -> None:
        self.stuck += 1
        await self.gate.wait()
        self.stuck -= 1
        await super().send(frame)


async def test_a_stop_overtakes_a_reset_that_waits_and_has_the_last_word(runtime: Runtime) -> None:
    cell = SlowCell(runtime)
    cell.gate.set()
    await cell.dial()
    await cell.state()
    await runtime.governor.estop(CELL, OPERATOR)
    await cell.expect("estop")
    await cell.state(latched=True)
    cell.gate.clear()
    await until(lambda: cell.stuck == 1)  # a beat: what comes now waits behind it
    resetting = asyncio.create_task(runtime.governor.reset(CELL, OPERATOR))
    await until(lambda: not runtime.fleet.cell(CELL).latched)
    await runtime.governor.estop(CELL, OPERATOR)
    cell.gate.set()
    await resetting
    await cell.expect("estop", 3)
    assert [word.type for word in cell.heard if word.type in {"estop", "reset"}] == ["estop", "estop", "reset", "estop"]
    assert runtime.fleet.cell(CELL).latched


class Late:
    """Holds what records back just when it is in, until it is let go."""

    def __init__(self, runtime: Runtime, monkeypatch: pytest.MonkeyPatch) -> None:
        self.recorded, self.go = asyncio.Event(), asyncio.Event()
        self._append = runtime.register.append
        monkeypatch.setattr(runtime.register, "append", self.append)

    async def append(self, *arguments: Any, **named: Any) -> Any:
        done = await self._append(*arguments, **named)
        if not self.recorded.is_set():
            self.recorded.set()
            await self.go.wait()
        return done


async def test_a_stop_has_the_last_word_on_a_launch_that_is_being_recorded(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = Late(runtime, monkeypatch)
    proposing = asyncio.create_task(runtime.governor.propose(AGENT, navigate()))
    await late.recorded.wait()
    (name,) = [entry.id for entry in runtime.register.live()]
    await runtime.governor.stop(name, OPERATOR)
    late.go.set()
    await proposing
    await cell.expect("human", 2)
    assert [word.type for word in cell.heard if word.type in {"human", "launch"}] == ["human", "launch", "human"]


@pytest.mark.parametrize("loosening", ["resume", "rollback"])
async def test_a_pause_has_the_last_word_on_what_lets_a_session_go_on_while_it_is_recorded(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch, loosening: str
) -> None:
    name = await running(runtime, cell)
    await cell.report("status", name, status="paused")
    late = Late(runtime, monkeypatch)
    word = {"resume": runtime.governor.resume, "rollback": runtime.governor.rollback}[loosening]
    going_on = asyncio.create_task(word(name, OPERATOR))
    await late.recorded.wait()
    await runtime.governor.pause(name, OPERATOR_2)
    assert cell.ops() == ["pause"], "it waits for no record"
    late.go.set()
    await going_on
    await until(lambda: cell.ops() == ["pause", loosening, "pause"])


async def test_an_emptied_journal_counts_from_the_start(runtime: Runtime, cell: HandCell) -> None:
    for _ in range(3):
        await cell.report("cell", what="something")
    await cell.hang_up()
    fresh = await HandCell(runtime, boot="boot-2", journal="jrn-2").dial()
    assert (await fresh.expect("welcome")).acknowledged == 0
    await fresh.report("cell", what="started")
    said = [event.payload().get("what") for event in await runtime.store.events(kind="cell")]
    assert said.count("started") == 1


async def test_a_journal_whose_end_was_lost_is_told_how_far_the_log_has_come(runtime: Runtime, cell: HandCell) -> None:
    reported = [await cell.report("cell", what=f"news {number}") for number in range(3)]
    await cell.hang_up()
    back = await HandCell(runtime, boot="boot-2", seq=1).dial()
    assert (await back.expect("welcome")).acknowledged == 3
    for event in reported:
        await back.say(event)
    await back.acknowledged(3)
    said = [event.payload().get("what") for event in await runtime.store.events(kind="cell")]
    assert [said.count(f"news {number}") for number in range(3)] == [1, 1, 1]


async def test_a_former_journal_that_comes_back_is_not_taken_twice(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        old = [await cell.report("cell", what=f"old {number}") for number in range(3)]
        await cell.hang_up()
        other = await HandCell(first, journal="jrn-2").dial()
        await other.report("cell", what="new")
    async with house.open() as second:
        back = await HandCell(second, seq=3).dial()
        assert (await back.expect("welcome")).acknowledged == 3
        for event in old:
            await back.say(event)
        await back.report("cell", what="and on")
        said = [event.payload().get("what") for event in await second.store.events(kind="cell")]
        assert [word for word in said if word] == ["old 0", "old 1", "old 2", "new", "and on"]


async def test_of_many_journals_of_a_cell_the_newest_are_known(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cells_module, "MOST_JOURNALS", 3)
    async with house.open() as runtime:
        for journal in ("jrn-1", "jrn-2", "jrn-3", "jrn-1", "jrn-4"):
            cell = HandCell(runtime, journal=journal)
            cell.seq = runtime.fleet.cell(CELL).taken.get(journal, 0) if runtime.fleet.knows(CELL) else 0
            await cell.dial()
            await cell.report("cell", what="started")
            await cell.hang_up()
        assert runtime.fleet.cell(CELL).taken == {"jrn-3": 1, "jrn-1": 2, "jrn-4": 1}
    async with house.open() as runtime:
        assert runtime.fleet.cell(CELL).taken == {"jrn-3": 1, "jrn-1": 2, "jrn-4": 1}
        assert runtime.register.trouble() is None
        cell = await HandCell(runtime, journal="jrn-5").dial()
        await cell.report("cell", what="started")
        assert set(runtime.fleet.cell(CELL).taken) == {"jrn-1", "jrn-4", "jrn-5"}


async def test_a_count_from_before_journals_had_names_goes_on_in_the_first_named(house: House) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await cell.report("cell", what="started")
        values = {"cell": CELL, "up_seq": 1, "journal": "", "updated_at": first.register.now()}
        await first.store.append([], [RowWrite(table="cell_progress", values=values)])
    async with house.open() as second:
        back = await HandCell(second, journal="jrn-named", seq=1).dial()
        assert (await back.expect("welcome")).acknowledged == 1
        await back.report("cell", what="and on")


async def test_a_reunion_that_cannot_be_recorded_is_seen_to_later(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = await running(runtime, cell)
    await cell.hang_up()

    async def broken(*_: Any) -> list[int]:
        raise RecordUnavailable("disk full")

    monkeypatch.setattr(runtime.store, "append", broken)
    await HandCell(runtime, boot="boot-2", seq=cell.seq).dial(waits=False)
    monkeypatch.undo()
    assert (await runtime.governor.invocation(name, AGENT))["status"] == "running"
    await runtime.fleet.tend_once()
    assert (await runtime.governor.invocation(name, AGENT))["outcome"] == "fault"
    assert "attached" in [event.payload().get("link") for event in await runtime.store.events(kind="cell")]


async def test_a_proposal_that_names_no_cell_passes_a_latched_one_by(runtime: Runtime, cell: HandCell) -> None:
    other = await HandCell(runtime, id="workcell-2").dial()
    await other.state()
    latched = runtime.fleet.cell(cell.id)
    latched.latched = True
    chosen = runtime.fleet.choose()
    assert chosen is not None
    assert chosen.id == "workcell-2"
    chosen.claim = "inv_1"
    waited_for = runtime.fleet.choose()
    assert waited_for is not None
    assert waited_for.id == "workcell-2", "a busy cell is worth waiting for, a latched one is not"
