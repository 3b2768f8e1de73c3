"""Recorded decisions made again: the same under what was in force, and every change named under a candidate."""

from __future__ import annotations

import asyncio
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import orjson
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from app.audit.replay import Replay, replay, then_in_force
from app.audit.replaying import replay_in_processes
from app.governance.bundle import load_files, load_kept
from app.governance.errors import PolicyErrors
from app.governance.model import Mode
from app.runtime import questions
from app.runtime.assembly import Runtime
from app.runtime.errors import InvalidParams
from app.runtime.invocation import ProposalRequest
from tests.runtime.conftest import (
    AGENT,
    AT_BENCH,
    AT_TOOLS,
    CELL,
    ENGINEER,
    OPERATOR,
    STRANGER,
    HandCell,
    House,
    grasp,
    navigate,
)  # fmt: skip
from tests.runtime.test_versions import FILES, ORGANIZATION, SLOWER, edited

PROFILES = ("sim-relaxed", "test-audit", "real-restricted", "human-shared")
LEAST = 2000
NUMBERS = st.floats(min_value=0.02, max_value=2.0)
OBJECTS = st.sampled_from(("mug_1", "glass_1", "driver_1", "box_1", "solvent_1", "nothing_1"))
TARGETS = st.sampled_from(("dock", "bench_a_stand", "tool_stand", "nowhere"))
FACTS = st.fixed_dictionaries(
    {},
    optional={
        "arm_ready": st.sampled_from((True, True, False)),
        "gripper_empty": st.sampled_from((True, True, False)),
        "holding": st.sampled_from((None, "mug_1", "glass_1", "box_1")),
        "people_count": st.integers(0, 4),
        "people_nearest_m": st.floats(min_value=0.0, max_value=9.0),
        "sensors_fresh": st.sampled_from((True, True, True, False)),
        "inspected": st.just({"bench_a": 3.5}),
    },
)
METADATA = st.fixed_dictionaries(
    {}, optional={"confidence": st.sampled_from((0.1, 0.9, 1, 7.5, "high")), "task": st.text("abc", max_size=3)}
)
PARAMS = st.one_of(
    st.tuples(
        st.just("grasp_object"),
        st.fixed_dictionaries({"object_id": OBJECTS}, optional={"force_n": st.floats(2, 140), "speed_mps": NUMBERS}),
    ),
    st.tuples(
        st.just("navigate_to"),
        st.one_of(
            st.fixed_dictionaries({"target": TARGETS}, optional={"speed_mps": NUMBERS}),
            st.fixed_dictionaries({"x_m": st.floats(0, 8), "y_m": st.floats(0, 6), "yaw_rad": st.just(0.0)}),
        ),
    ),
    st.tuples(st.just("operate_tool"), st.just({"tool": "press", "action": "press"})),
    st.tuples(st.sampled_from(("fly", "safe_retreat")), st.just({})),
)


@st.composite
def requests(draw: st.DrawFn) -> ProposalRequest:
    capability, params = draw(PARAMS)
    return ProposalRequest(
        capability=capability,
        params=params,
        mode=draw(st.sampled_from((Mode.NORMAL, Mode.NORMAL, Mode.CAREFUL))),
        preconditions=draw(st.sampled_from(((), (), ("gripper_empty",), ("the_moon_is_full",)))),
        metadata=draw(METADATA),
    )


class Floor:
    """A governor that proposals come to, with a cell whose facts are other ones in every round."""

    def __init__(self, runtime: Runtime, cell: HandCell) -> None:
        self.runtime, self.cell = runtime, cell

    async def round(self, profile: str, facts: dict[str, Any], asked: list[ProposalRequest], latched: bool) -> None:
        self.cell.facts = {**(AT_TOOLS if latched or "inspected" in facts else AT_BENCH), **facts}
        self.runtime.fleet.cell(CELL).profile = profile
        await self.cell.state(latched=latched)
        for made in await asyncio.gather(*(self.propose(one, place) for place, one in enumerate(asked))):
            if made is not None and made["status"] == "running":
                await self.cell.ended(made["id"], "succeeded")

    async def propose(self, request: ProposalRequest, place: int) -> dict[str, Any] | None:
        self.runtime.kernel.heard(OPERATOR if place % 2 else AGENT)
        try:
            made, _ = await self.runtime.governor.propose(STRANGER if place % 9 == 8 else AGENT, request)
        except InvalidParams:
            return None
        return made


@pytest.mark.timeout(300)
def test_what_was_in_force_reproduces_thousands_of_decisions(house: House) -> None:
    with asyncio.Runner() as runner:
        opened = house.open()
        runtime = runner.run(opened.__aenter__())
        floor = Floor(runtime, runner.run(HandCell(runtime).dial()))

        @given(
            profile=st.sampled_from(PROFILES),
            facts=FACTS,
            asked=st.lists(requests(), min_size=60, max_size=60),
            latched=st.sampled_from((False, False, False, True)),
        )
        @settings(
            max_examples=60, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
        )
        def propose(profile: str, facts: dict[str, Any], asked: list[ProposalRequest], latched: bool) -> None:
            runner.run(floor.round(profile, facts, asked, latched))

        propose()
        runner.run(opened.__aexit__(None, None, None))
    found = replay(house.folder, then_in_force(house.folder))
    assert found.changed == []
    assert (found.without_context, found.without_policy) == (0, 0)
    assert found.decisions >= LEAST
    assert statuses(house.folder) >= {"rejected", "denied", "deferred", "awaiting_approval", "allowed"}


def statuses(folder: Path) -> set[str]:
    with closing(sqlite3.connect(folder / "reins.db")) as connection:
        rows = connection.execute("SELECT body FROM events WHERE kind = 'admission'").fetchall()
    return {orjson.loads(raw)["body"]["context"]["decided"] for (raw,) in rows}


@pytest.mark.anyio
async def test_a_candidate_changes_what_it_would_have_changed_and_says_by_which_rule(house: House) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        made, _ = await runtime.governor.propose(AGENT, navigate())
        await cell.ended(made["id"], "succeeded")
        await runtime.governor.propose(AGENT, grasp())
    mug = "\n  - {id: no-mug, applies_to: [grasp_object], then: deny, because: It stays.}\n"
    stricter = edited(ORGANIZATION, "rules:\n", f"rules:{mug}", SLOWER)
    found = replay_in_processes(house.folder, stricter)
    groups = {group: [one.invocation for one in members] for group, members in found.groups()}
    slower = ("navigate_to", "human-shared", "allowed (modify)", "allowed (modify)")
    assert groups[next(group for group in groups if group[:4] == slower)] == [made["id"]]
    assert next(group for group in groups if group[3] == "denied (deny)")[4].startswith("+organization/no-mug")
    assert found.decisions == len(found.changed) == 2
    assert found.document()["groups"][0]["count"] == 1
    nothing = replay_in_processes(house.folder, FILES)
    assert (nothing.decisions, nothing.changed) == (2, [])


@pytest.mark.anyio
async def test_a_version_of_an_earlier_release_that_is_refused_now_reproduces_what_it_decided(house: House) -> None:
    named = "\n  - {id: no-moon, when: 'target.name != \"moon\"', then: deny, because: It is none.}\n"
    files = edited(ORGANIZATION, "rules:\n", f"rules:{named}")
    with pytest.raises(PolicyErrors, match="`moon` is compared with what is never that"):
        load_files(files)
    async with replace(house, policy=load_kept(files)).open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        made, _ = await runtime.governor.propose(AGENT, navigate())
    assert made["status"] == "denied"
    found = replay_in_processes(house.folder, None)
    assert (found.decisions, found.without_policy, found.changed) == (1, 0, [])


@pytest.mark.anyio
async def test_an_approval_is_a_second_decision_with_its_own_context(house: House) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        hard = ProposalRequest(capability="grasp_object", params={"object_id": "mug_1", "force_n": 80})
        made, late = [(await runtime.governor.propose(AGENT, one))[0] for one in (grasp(), hard)]
        question, other = (runtime.desk.pending_for(one["id"]) for one in (made, late))
        assert question is not None
        assert other is not None
        await cell.state()
        await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest, params={"force_n": 20})
        await runtime.desk.resolve(other.id, OPERATOR, "approve", other.digest)  # the cell is busy: it ends by that
        trace = await runtime.governor.trace(made["id"], ENGINEER)
        shown = await runtime.governor.trace(made["id"], AGENT)
    kept = [event["body"]["context"]["proposal"]["params"] for event in trace if event["kind"] == "admission"]
    assert [params["force_n"] for params in kept] == [40.0, 20.0]
    assert not any("context" in event["body"] for event in shown)
    found = replay(house.folder, then_in_force(house.folder))
    assert (found.decisions, found.changed) == (4, [])


@pytest.mark.anyio
async def test_who_takes_over_a_session_is_decided_on_in_the_record(house: House) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        made, _ = await runtime.governor.propose(AGENT, navigate())
        await cell.launched(made["id"])
        await runtime.governor.take_over(made["id"], OPERATOR)
        await cell.expect("launch", 2)
        trace = await runtime.governor.trace(made["id"], ENGINEER)
        shown = await runtime.governor.invocation(made["id"], AGENT)
    taking = [event for event in trace if event["body"].get("takeover")]
    assert [event["kind"] for event in taking] == ["admission", "policy"]
    assert taking[0]["body"]["context"]["proposal"]["capability"] == "takeover"
    assert taking[1]["body"]["effective"] == {"base_speed_mps": 0.3, "tcp_speed_mps": 0.25, "grip_force_n": 60.0}
    assert shown["effective"] == made["effective"], "what the session does is what it did"
    found = replay(house.folder, then_in_force(house.folder))
    assert (found.decisions, found.without_context, found.changed) == (2, 0, [])


@pytest.mark.anyio
async def test_a_question_for_which_people_had_no_room_is_decided_alike(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "MOST_OF_AGENT", 1)
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        made = await asyncio.gather(*(runtime.governor.propose(AGENT, grasp()) for _ in range(2)))
    assert [document["status"] for document, _ in made] == ["awaiting_approval", "deferred"]
    found = replay(house.folder, then_in_force(house.folder))
    assert (found.decisions, found.changed) == (2, [])
    mug = "\n  - {id: no-mug, applies_to: [grasp_object], then: deny, because: It stays.}\n"
    assert len(replay_in_processes(house.folder, edited(ORGANIZATION, "rules:\n", f"rules:{mug}")).changed) == 2


def test_a_decision_recorded_without_its_context_is_counted_and_left_out(tmp_path: Path) -> None:
    body = {"outcome": "accept", "reasons": [], "cell": None, "profile": "human-shared", "status": "running"}
    record = orjson.dumps({"seq": 1, "body": body})
    with closing(sqlite3.connect(tmp_path / "reins.db")) as connection:
        connection.execute("CREATE TABLE events (seq, at, kind, invocation, actor, body)")
        connection.execute("INSERT INTO events VALUES (1, '', 'admission', 'inv_1', 'server', ?)", (record,))
        connection.commit()
    assert replay(tmp_path, lambda _: None) == Replay(without_context=1)
