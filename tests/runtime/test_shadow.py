"""A candidate beside the live policy: what would differ is recorded and shown, and nothing else happens."""

from __future__ import annotations

import pytest

from app.runtime.assembly import Runtime
from tests.runtime.conftest import AGENT, ENGINEER, HandCell, House, grasp, navigate
from tests.runtime.test_versions import FORBIDDEN, ORGANIZATION, SLOWER, bodies, brought, edited

pytestmark = pytest.mark.anyio


async def test_what_a_candidate_would_decide_is_recorded_and_changes_nothing(runtime: Runtime, cell: HandCell) -> None:
    digest = await brought(runtime, FORBIDDEN)
    await runtime.shadow.set(digest, ENGINEER, "a look", on=True)
    await cell.state()
    made, _ = await runtime.governor.propose(AGENT, grasp())
    other, _ = await runtime.governor.propose(AGENT, navigate())
    assert (made["status"], other["status"]) == ("awaiting_approval", "running")
    found = runtime.shadow.document(digest)
    assert (found["decisions"], found["differing"]) == (2, 1)
    (group,) = found["groups"]
    assert (group["live"], group["candidate"]) == ("awaiting_approval (modify)", "denied (deny)")
    assert group["examples"] == [made["id"]]
    (said,) = await bodies(runtime, "shadow")
    assert (said["policy_version"], said["invocation"]) == (digest, made["id"])
    assert "organization/no-mug" in {one["rule"] for one in said["reasons"]}
    assert "shadow" not in {event["kind"] for event in await runtime.governor.trace(made["id"], ENGINEER)}


async def test_an_agent_is_permitted_what_the_candidate_permits(runtime: Runtime, cell: HandCell) -> None:
    less = edited(
        ORGANIZATION, "permissions: [navigation, perception, manipulation", "permissions: [navigation, perception"
    )
    digest = await brought(runtime, less)
    await runtime.shadow.set(digest, ENGINEER, "a look", on=True)
    await cell.state()
    await runtime.governor.propose(AGENT, grasp())
    await runtime.governor.propose(AGENT, navigate())
    (group,) = runtime.shadow.document(digest)["groups"]
    assert (group["capability"], group["candidate"]) == ("grasp_object", "rejected (unchecked)")


async def test_a_candidate_that_breaks_reaches_nobody(runtime: Runtime, cell: HandCell) -> None:
    digest = await brought(runtime, SLOWER)
    await runtime.shadow.set(digest, ENGINEER, "a look", on=True)
    candidate = await runtime.versions.compiled(digest)
    object.__setattr__(candidate, "gates", None)
    await cell.state()
    made, _ = await runtime.governor.propose(AGENT, navigate())
    assert made["status"] == "running"
    assert runtime.shadow.document(digest)["groups"][0]["candidate"] == "error (AttributeError)"


async def test_a_shadow_goes_on_after_a_restart_and_ends_when_told(house: House) -> None:
    async with house.open() as runtime:
        digest = await brought(runtime, SLOWER)
        await runtime.shadow.set(digest, ENGINEER, "a look", on=True)
    async with house.open() as runtime:
        assert runtime.shadow.document(digest)["on"]
        ended = await runtime.shadow.set(digest, ENGINEER, "seen enough", on=False)
        assert not ended["on"]
    async with house.open() as runtime:
        assert not runtime.shadow.document(digest)["on"]
