"""A candidate beside the live policy: what would differ is recorded and shown, and nothing else happens."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest

from app.governance.errors import PolicyError, PolicyErrors
from app.runtime.assembly import Runtime
from app.runtime.errors import ExaminationFailed
from app.runtime.examining import Candidate, Examined
from app.runtime.versions import candidate_of
from tests.examining import examine_here
from tests.runtime.conftest import AGENT, ENGINEER, HandCell, House, grasp, navigate
from tests.runtime.test_versions import FORBIDDEN, ORGANIZATION, SLOWER, bodies, brought, edited

pytestmark = pytest.mark.anyio
SLOWER_FILES = candidate_of(SLOWER).files


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


async def test_a_shadow_that_is_begun_once_more_keeps_what_it_has_found(runtime: Runtime, cell: HandCell) -> None:
    digest = await brought(runtime, FORBIDDEN)
    await runtime.shadow.set(digest, ENGINEER, "a look", on=True)
    await cell.state()
    await runtime.governor.propose(AGENT, grasp())
    before = runtime.shadow.document(digest)
    again = await runtime.shadow.set(digest, replace(ENGINEER, name="another"), "a look too", on=True)
    assert again == before == runtime.shadow.document(digest)
    assert (again["decisions"], again["differing"]) == (1, 1)
    begun = [body for body in await bodies(runtime, "policy_version") if body["op"] == "shadow_begun"]
    assert len(begun) == 1


async def test_who_begins_the_same_at_once_begins_it_once_and_who_ends_another_ends_nothing_else(
    runtime: Runtime,
) -> None:
    digest, other = await brought(runtime, FORBIDDEN), await brought(runtime, SLOWER)
    shadow, second = runtime.shadow, replace(ENGINEER, name="another")
    await asyncio.gather(*(shadow.set(digest, who, "a look", on=True) for who in (ENGINEER, second)))
    begun = [body for body in await bodies(runtime, "policy_version") if body["op"] == "shadow_begun"]
    assert len(begun) == 1
    await asyncio.gather(
        shadow.set(other, ENGINEER, "this", on=True), shadow.set(digest, second, "no more of that", on=False)
    )
    assert shadow.document(other)["on"]


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


REFUSED = PolicyErrors([PolicyError(file=ORGANIZATION, line=1, key="", message="is not valid any more")])


@pytest.mark.parametrize(
    "error", [REFUSED, ExaminationFailed("it ended with `1`: TypeError")], ids=["refused", "broke"]
)
async def test_a_shadow_that_a_newer_release_cannot_read_keeps_nobody_from_starting(
    house: House, error: Exception
) -> None:
    async def newer(candidate: Candidate, against: Candidate | None) -> Examined:
        if candidate.files == SLOWER_FILES:
            raise error
        return await examine_here(candidate, against)

    async with house.open() as runtime:
        digest = await brought(runtime, SLOWER)
        await runtime.shadow.set(digest, ENGINEER, "a look", on=True)
    async with replace(house, examine=newer).open() as runtime:
        assert not runtime.shadow.document(digest)["on"]
        said = (await bodies(runtime, "policy_version"))[-1]
        assert (said["op"], said["policy_version"]) == ("shadow_ended", digest)
        assert str(error) in said["reason"]
    async with house.open() as runtime:
        assert not runtime.shadow.document(digest)["on"]
