"""The modes of authority over sessions: what a profile leaves to operators, and what is refused elsewhere."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import orjson
import pytest

from app.governance.model import AuthorityMode, EventKind
from app.governance.policy import PolicySet
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict
from app.runtime.recollection import events_of

from .conftest import AGENT, OPERATOR, HandCell, House, navigate

pytestmark = pytest.mark.anyio


def without(policy: PolicySet, profile: str, mode: AuthorityMode) -> PolicySet:
    changed = replace(policy.profiles[profile], authority=policy.profiles[profile].authority - {mode})
    return replace(policy, profiles={**policy.profiles, profile: changed})


async def running(runtime: Runtime, cell: HandCell) -> str:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.launched(document["id"])
    return str(document["id"])


async def test_a_session_that_may_not_be_interrupted_may_be_stopped(house: House, policy: PolicySet) -> None:
    house.policy = without(policy, house.profile, AuthorityMode.INTERRUPT_ENABLED)
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        session = await running(runtime, cell)
        for op in ("pause", "rollback"):
            with pytest.raises(Conflict) as refused:
                await getattr(runtime.governor, op)(session, OPERATOR)
            assert (refused.value.code, refused.value.status) == ("interrupt_not_enabled", 409)
            assert refused.value.reasons[0]["rule"] == f"{house.profile}/authority"
        await cell.report("status", session, status="paused")  # the watcher paused it; only a stop ends that
        with pytest.raises(Conflict, match="stop it"):
            await runtime.governor.resume(session, OPERATOR)
        assert cell.ops() == []
        await runtime.governor.stop(session, OPERATOR)
        await cell.expect("human")
        assert cell.ops() == ["stop"]


async def test_the_profile_a_session_was_launched_under_says_what_may_be_done_to_it(
    house: House, policy: PolicySet
) -> None:
    house.policy = without(policy, "sim-relaxed", AuthorityMode.INTERRUPT_ENABLED)
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        session = await running(runtime, cell)
        await runtime.governor.set_profile(cell.id, "sim-relaxed", OPERATOR)
        await runtime.governor.pause(session, OPERATOR)
        await cell.expect("human")
        assert cell.ops() == ["pause"]


async def test_of_two_who_put_a_cell_under_a_profile_at_once_the_second_follows_the_first(
    runtime: Runtime, cell: HandCell
) -> None:
    wanted = ("sim-relaxed", "real-restricted")
    await asyncio.gather(*(runtime.governor.set_profile(cell.id, profile, OPERATOR) for profile in wanted))
    changes = [
        orjson.loads(event.body)["body"] for event in await events_of(runtime.store, kind=EventKind.PROFILE_CHANGED)
    ]
    assert [(body["before"], body["profile"]) for body in changes] == [
        ("human-shared", "sim-relaxed"),
        ("sim-relaxed", "real-restricted"),
    ]
    told = [order.profile for order in cell.all("profile")]
    assert told[-1] == runtime.fleet.cell(cell.id).profile == "real-restricted"
