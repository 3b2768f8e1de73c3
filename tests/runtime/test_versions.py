"""Versions of policy over the real runtime and record: who may put what in force, and what follows from it."""

from __future__ import annotations

import asyncio
import base64
import json
import re
import sqlite3
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import orjson
import pytest

from app.audit.examination import examine_file
from app.audit.places import Places
from app.governance import bundle
from app.governance.comparison import compare
from app.governance.continuing import Departure, departure
from app.governance.errors import PolicyError, PolicyErrors, Undecided
from app.governance.model import Proposal, Role, Status, Wish
from app.governance.policy import PolicySet
from app.runtime import kernel
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict, ExaminationFailed, Forbidden, NotFound
from app.runtime.examining import Candidate, Examined
from app.runtime.invocation import Principal, ProposalRequest
from app.runtime.succession import AGAIN_S
from app.runtime.version import files_row
from tests.examining import examine_here
from tests.runtime.conftest import (
    AGENT,
    AT_BENCH,
    ENGINEER,
    OPERATOR,
    PATIENCE_S,
    HandCell,
    House,
    grasp,
    navigate,
    stating,
    until,
)

pytestmark = pytest.mark.anyio
FILES = bundle.read_files(Path(__file__).resolve().parents[2] / "policies")
ENGINEER_2 = Principal(name="emil", role=Role.ENGINEER)
SHARED, ORGANIZATION = "profiles/human-shared.yaml", "organization.yaml"
NO_MUG = """
  - id: no-mug
    applies_to: [grasp_object]
    when: params.object_id == "mug_1"
    then: deny
    because: The mug stays where it is.
"""


def edited(name: str, before: str, after: str, files: dict[str, str] | None = None) -> dict[str, str]:
    files = FILES if files is None else files
    assert before in files[name]
    return {**files, name: files[name].replace(before, after, 1)}


SLOWER = edited(SHARED, "base_speed_mps: {max: 0.3", "base_speed_mps: {max: 0.2")
FASTER = edited(SHARED, "base_speed_mps: {max: 0.3", "base_speed_mps: {max: 0.4")
BLUNTER = edited(SHARED, "sensitivity: 0.9", "sensitivity: 0.8")
WEAKER = edited(SHARED, "grip_force_n: {max: 60", "grip_force_n: {max: 30")
FORBIDDEN = edited(ORGANIZATION, "rules:\n", f"rules:{NO_MUG}")
ASKING = edited(
    ORGANIZATION,
    "rules:\n",
    "rules:\n  - {id: look, applies_to: [navigate_to], then: escalate, because: Somebody looks.}\n",
)
RETREAT = "  - {id: no-retreat, applies_to: [release_and_retract], "
NO_RETREAT = edited(ORGANIZATION, "rules:\n", f"rules:\n{RETREAT}then: deny, because: It falls.}}\n")
ASKING_NEAR = edited(
    ORGANIZATION,
    "rules:\n",
    f'rules:\n{RETREAT}when: "world.people_count > 0", then: escalate, because: Somebody is there.}}\n',
)
DROPPED = {
    name: text
    for name, text in FILES.items()
    if name != "capabilities/inspect_area.yaml" and not name.startswith("tests/")
}


async def brought(runtime: Runtime, files: dict[str, str], by: Principal = ENGINEER) -> str:
    document, _ = await runtime.versions.propose(files, by, "because")
    return document["digest"]


async def verdicts(runtime: Runtime) -> list[dict[str, Any]]:
    """Return what the record says that proofs said."""
    return [said for said in await bodies(runtime, "policy_version") if said["op"] != "proposed"]


async def put_in_force(runtime: Runtime, files: dict[str, str]) -> str:
    """Have two engineers put a version in force."""
    digest = await brought(runtime, files)
    _, entered = await runtime.versions.activate(digest, ENGINEER_2, "both of us want it")
    assert entered
    return digest


async def running(runtime: Runtime, cell: HandCell) -> dict[str, Any]:
    """Have a session run, and its cell's state be fresh."""
    await cell.state()
    made, _ = await runtime.governor.propose(AGENT, navigate())
    assert made["status"] == "running", made["admission"]
    await cell.launched(made["id"])
    return made


async def bodies(runtime: Runtime, kind: str, **filters: Any) -> list[dict[str, Any]]:
    return [event.payload() for event in await runtime.store.events(kind=kind, limit=1000, **filters)]


# -- bringing ----------------------------------------------------------------------------------------------------------


async def test_a_candidate_is_kept_by_its_digest_and_changes_nothing(runtime: Runtime) -> None:
    before = runtime.kernel.policy.digest
    document, new = await runtime.versions.propose(SLOWER, ENGINEER, "people work closer")
    assert new
    assert (document["status"], document["by"], document["against"]) == ("candidate", "erin", before)
    assert document["digest"] == bundle.digest(SLOWER)
    assert runtime.kernel.policy.digest == before
    again, new = await runtime.versions.propose(SLOWER, ENGINEER_2, "me too")
    assert not new
    assert again["by"] == "erin"
    (said,) = await bodies(runtime, "policy_version")
    assert said["comparison"]["direction"] == "tightens"
    assert said["comparison"]["differences"][0]["part"] == "profiles/human-shared/limits/base_speed_mps/maximum"


async def test_a_candidate_with_a_fault_is_not_kept_so_nobody_can_activate_it(runtime: Runtime) -> None:
    broken = edited(ORGANIZATION, "when: target.hazardous", "when: target.hazardus")
    with pytest.raises(PolicyErrors) as found:
        await runtime.versions.propose(broken, ENGINEER, "a slip")
    assert found.value.file == ORGANIZATION
    assert found.value.line > 0
    with pytest.raises(NotFound):
        await runtime.versions.activate(bundle.digest(broken), ENGINEER_2, "all the same")


async def test_a_candidate_that_fails_a_case_of_its_own_is_not_kept(runtime: Runtime) -> None:
    case = "cases:\n  - name: it is denied\n    profile: human-shared\n    capability: navigate_to\n"
    case += "    params: {target: dock}\n    expect: {status: denied}\n"
    with pytest.raises(PolicyErrors, match="it is denied"):
        await runtime.versions.propose({**SLOWER, "tests/mine.yaml": case}, ENGINEER, "with a case")
    assert (await runtime.versions.list())[0][0]["digest"] == runtime.kernel.policy.digest


async def test_what_a_start_offered_is_proved_before_it_comes_into_force(house: House) -> None:
    broken = PolicyErrors([PolicyError(file=SHARED, line=3, key="property", message="refuted: it does not hold")])
    proving: list[bool] = []

    async def examine(candidate: Candidate, against: Candidate | None) -> Examined:
        proving.append(candidate.prove)
        if candidate.prove and bundle.digest(candidate.files) == bundle.digest(FASTER):
            raise broken
        return await examine_here(candidate, against)

    async with house.open() as runtime:
        chosen = await put_in_force(runtime, SLOWER)
    house.policy, house.examine = bundle.load_files(FASTER), examine
    async with house.open() as runtime:
        assert runtime.kernel.policy.digest == chosen
        offered = (await runtime.versions.load(bundle.digest(FASTER))).public()
        assert (offered["status"], offered["proved"]) == ("candidate", "")
        for engineer in (ENGINEER, ENGINEER_2):
            with pytest.raises(PolicyErrors, match="it does not hold"):
                await runtime.versions.activate(bundle.digest(FASTER), engineer, "all the same")
        assert runtime.kernel.policy.digest == chosen
        assert proving.count(True) == 2
        first = next(
            one for one in (await runtime.versions.list())[0] if one["digest"] not in (chosen, offered["digest"])
        )
        await runtime.versions.activate(first["digest"], ENGINEER, "back")
        await runtime.versions.activate(first["digest"], ENGINEER_2, "back")
        assert runtime.kernel.policy.digest == first["digest"]
        assert (await runtime.versions.load(first["digest"])).proved


async def test_what_a_start_brought_is_proved_when_it_is_brought_again(house: House) -> None:
    async with house.open() as runtime:
        digest, promises = runtime.kernel.policy.digest, runtime.versions._promises
        assert (await runtime.versions.load(digest)).proved == ""
        mine = dict(runtime.kernel.policy.files)
        other = {**mine, bundle.PROPERTIES: "properties: []\n"}
        assert other[bundle.PROPERTIES] != promises
        assert (await runtime.versions.propose(other, ENGINEER, "with other promises"))[0]["proved"] == ""
        same = mine if promises is None else {**mine, bundle.PROPERTIES: promises}
        found, new = await runtime.versions.propose(same, ENGINEER, "to have it proved")
        assert (found["status"], found["proved"], new) == ("active", "that its cases hold", False)
        assert (await runtime.versions.load(digest)).proved == "that its cases hold"
        again = await runtime.versions.propose(same, ENGINEER_2, "once more")
        assert again == (found, False)


async def test_what_is_in_force_is_proved_behind_a_start_and_once(house: House) -> None:
    asked: list[Candidate] = []

    async def examine(candidate: Candidate, against: Candidate | None) -> Examined:
        asked.append(candidate)
        return await examine_here(candidate, against)

    house.examine = examine
    async with house.open() as runtime:
        digest = runtime.kernel.policy.digest
        assert (await runtime.versions.load(digest)).verdict == "unknown"
        found = await runtime.versions.proving.in_force()
        assert (found.version.verdict, found.version.proved, found.problems) == ("proved", "that its cases hold", ())
        assert [(one.prove, one.promises) for one in asked] == [(True, found.version.promises)]
        (said,) = await verdicts(runtime)
        assert (said["op"], said["policy_version"], said["proved"]) == ("proved", digest, "that its cases hold")
    async with house.open() as runtime:
        assert (await runtime.versions.proving.in_force()).version.verdict == "proved"
        assert len(asked) == 1
        assert len(await verdicts(runtime)) == 1


@pytest.mark.parametrize(("kind", "verdict"), [(PolicyErrors, "refuted"), (Undecided, "undecided")])
async def test_what_does_not_pass_its_proofs_goes_on_deciding_and_says_so(
    house: House, kind: type[PolicyErrors], verdict: str
) -> None:
    fault = PolicyError(file=SHARED, line=3, key="property", message=f"{verdict}: it does not hold")

    async def examine(candidate: Candidate, against: Candidate | None) -> Examined:
        raise kind([fault])

    house.examine = examine
    async with house.open() as runtime:
        digest = runtime.kernel.policy.digest
        found = await runtime.versions.proving.in_force()
        assert (found.version.verdict, found.version.proved, found.problems) == (verdict, "", (fault,))
        assert (runtime.versions.proving.trouble() is not None) == (verdict == "refuted")
        (said,) = await verdicts(runtime)
        assert (said["op"], said["problems"], said["of"]) == (verdict, [str(fault)], 1)
        assert runtime.kernel.policy.digest == digest
    house.examine = examine_here
    async with house.open() as runtime:  # what was found out holds until it is found out otherwise
        assert (await runtime.versions.load(digest)).verdict == verdict
        assert (runtime.versions.proving.trouble() is not None) == (verdict == "refuted")
        assert (await runtime.versions.proving.in_force()).version.verdict == "proved"
        assert runtime.versions.proving.trouble() is None
        assert (await runtime.versions.load(digest)).public()["verdict"] == "proved"


async def test_what_is_refuted_is_no_trouble_once_another_version_is_in_force(house: House) -> None:
    async def examine(candidate: Candidate, against: Candidate | None) -> Examined:
        if candidate.prove and bundle.digest(candidate.files) == bundle.digest(FILES):
            raise PolicyErrors([PolicyError(file=SHARED, line=3, key="property", message="it does not hold")])
        return await examine_here(candidate, against)

    house.examine = examine
    async with house.open() as runtime:
        await runtime.versions.proving.in_force()
        assert "`reins policy check`" in (runtime.versions.proving.trouble() or "")
        await put_in_force(runtime, SLOWER)
        assert runtime.versions.proving.trouble() is None


async def test_a_proof_that_was_begun_is_not_told_of_a_version_with_other_promises(house: House) -> None:
    async with house.open() as runtime:
        digest, promises = runtime.kernel.policy.digest, runtime.versions._promises
        told = await runtime.versions.proving.proved(digest, f"{promises}\n", "something else", actor="server")
        assert (told.verdict, await verdicts(runtime)) == ("unknown", [])


async def test_what_cannot_be_examined_behind_a_start_leaves_the_verdict_open(house: House) -> None:
    async def examine(candidate: Candidate, against: Candidate | None) -> Examined:
        raise ExaminationFailed("it ended with `-9`")

    house.examine = examine
    async with house.open() as runtime:
        with pytest.raises(ExaminationFailed):
            await runtime.versions.proving.in_force()
        assert (await runtime.versions.load(runtime.kernel.policy.digest)).verdict == "unknown"
        assert await verdicts(runtime) == []


async def test_what_cannot_be_examined_is_not_kept(house: House) -> None:
    async def examine(candidate: Candidate, against: Candidate | None) -> Examined:
        if candidate.prove:
            raise ExaminationFailed("it ended with `-9`")
        return await examine_here(candidate, against)

    house.examine = examine
    async with house.open() as runtime:
        with pytest.raises(ExaminationFailed):
            await runtime.versions.propose(SLOWER, ENGINEER, "a try")
        assert [one["digest"] for one in (await runtime.versions.list())[0]] == [runtime.kernel.policy.digest]


async def test_promises_are_kept_with_a_version_and_with_the_directory(house: House) -> None:
    house.promises = "order: []\n"
    against: list[str | None] = []

    async def examine(candidate: Candidate, other: Candidate | None) -> Examined:
        against.append(None if other is None else other.promises)
        return await examine_here(candidate, other)

    house.examine = examine
    async with house.open() as runtime:
        digest = await brought(runtime, {**SLOWER, bundle.PROPERTIES: "properties: []\n"})
        assert digest == bundle.digest(SLOWER)
        assert (await runtime.versions.load(digest)).promises == "properties: []\n"
        assert against == ["order: []\n"]
        _, new = await runtime.versions.propose({**SLOWER, bundle.PROPERTIES: "order: []\n"}, ENGINEER, "again")
        assert not new
        assert (await runtime.versions.load(digest)).promises == "properties: []\n"
    house.promises = "order: [human-shared]\n"
    async with house.open() as runtime:
        assert (await runtime.versions.load(runtime.kernel.policy.digest)).promises == "order: [human-shared]\n"


# -- who may -----------------------------------------------------------------------------------------------------------


async def test_one_engineer_tightens_alone(runtime: Runtime) -> None:
    before = runtime.kernel.policy.digest
    digest = await brought(runtime, SLOWER)
    document, entered = await runtime.versions.activate(digest, ENGINEER, "a visitor")
    assert entered
    assert document["status"] == "active"
    assert runtime.kernel.policy.digest == digest
    said = (await bodies(runtime, "policy_activated"))[-1]
    assert (said["policy_version"], said["former"], said["by"], said["why"]) == (
        digest, before, ["erin"], "a visitor",
    )  # fmt: skip
    assert said["comparison"]["direction"] == "tightens"
    with pytest.raises(Conflict, match="in force already"):
        await runtime.versions.activate(digest, ENGINEER, "again")


async def test_a_loosening_takes_another_engineer_than_the_one_who_brought_it(runtime: Runtime) -> None:
    digest, before = await brought(runtime, FASTER), runtime.kernel.policy.digest
    document, entered = await runtime.versions.activate(digest, ENGINEER, "faster")
    assert not entered
    assert document["status"] == "awaiting_second"
    assert runtime.kernel.policy.digest == before
    with pytest.raises(Conflict) as refused:
        await runtime.versions.activate(digest, ENGINEER, "really")
    assert refused.value.code == "second_engineer_needed"
    document, entered = await runtime.versions.activate(digest, ENGINEER_2, "I looked at it")
    assert entered
    assert document["activations"][-1]["by"] == ["emil", "erin"]
    assert document["awaiting"] is None


async def test_going_back_to_a_wider_version_takes_two_who_want_it_now(runtime: Runtime) -> None:
    wide = runtime.kernel.policy.digest
    former = runtime.kernel.policy.digest
    await runtime.versions.activate(await brought(runtime, SLOWER), ENGINEER, "a visitor", former)
    with pytest.raises(Conflict, match=f"is in force, not `{former}` any more") as late:
        await runtime.versions.activate(wide, ENGINEER_2, "compared with what was in force before", former)
    assert late.value.code == "policy_changed"
    _, entered = await runtime.versions.activate(wide, ENGINEER_2, "the visitor left")
    assert not entered
    _, entered = await runtime.versions.activate(wide, ENGINEER, "yes, gone")
    assert entered
    assert runtime.kernel.policy.digest == wide


async def test_a_word_about_another_change_counts_for_nothing(runtime: Runtime) -> None:
    digest = await brought(runtime, FASTER)
    await runtime.versions.activate(digest, ENGINEER, "faster")
    await runtime.versions.activate(await brought(runtime, SLOWER), ENGINEER, "a visitor")
    _, entered = await runtime.versions.activate(digest, ENGINEER_2, "faster than slow is another matter")
    assert not entered


async def test_bringing_is_no_word_any_more_where_another_change_came_and_went(runtime: Runtime) -> None:
    wide, digest = runtime.kernel.policy.digest, await brought(runtime, FASTER)
    await runtime.versions.activate(await brought(runtime, SLOWER), ENGINEER, "a visitor")
    for engineer in (ENGINEER, ENGINEER_2):
        await runtime.versions.activate(wide, engineer, "the visitor left")
    document, entered = await runtime.versions.activate(digest, ENGINEER_2, "faster")
    assert (entered, document["status"]) == (False, "awaiting_second")


async def test_a_word_from_before_another_change_counts_for_nothing_where_that_is_undone(runtime: Runtime) -> None:
    """Whoever tightened since, because of what they saw, has not said that they want the loosening all the same."""
    wide, digest = runtime.kernel.policy.digest, await brought(runtime, FASTER)
    for engineer in (ENGINEER, ENGINEER_2):
        await runtime.versions.activate(digest, engineer, "faster")
    await runtime.versions.activate(wide, ENGINEER, "too fast")
    await runtime.versions.activate(digest, ENGINEER, "faster")
    await runtime.versions.activate(await brought(runtime, SLOWER), ENGINEER, "a visitor")
    for engineer in (ENGINEER, ENGINEER_2):
        await runtime.versions.activate(wide, engineer, "the visitor left")
    document, entered = await runtime.versions.activate(digest, ENGINEER_2, "faster")
    assert not entered
    assert (document["status"], document["awaiting"]["by"]) == ("awaiting_second", ENGINEER_2.name)
    _, entered = await runtime.versions.activate(digest, ENGINEER, "yes, still")
    assert entered


@pytest.mark.parametrize("field", ["awaiting", "by"])
async def test_nobodys_word_comes_from_a_row(house: House, field: str) -> None:
    async with house.open() as runtime:
        digest, present = await brought(runtime, FASTER), runtime.kernel.policy.digest
        before = await runtime.versions.load(digest)
    words = {"awaiting": {"by": "emil", "at": before.created_at, "why": "never", "against": present}, "by": "emil"}
    forged = replace(before, **{field: words[field]})
    with sqlite3.connect(Places(house.folder).database) as database:
        database.execute("UPDATE policies SET document = ? WHERE id = ?", (forged.row().values["document"], digest))
    database.close()
    async with house.open() as runtime:
        _, entered = await runtime.versions.activate(digest, ENGINEER, "I want it alone")
        assert not entered
        assert runtime.kernel.policy.digest == present


async def test_who_is_no_engineer_any_more_once_their_turn_comes_puts_nothing_in_force(house: House) -> None:
    """Another change may be proved for minutes, and theirs waits behind it."""
    async with house.open() as runtime:
        digest, before = await brought(runtime, FASTER), runtime.kernel.policy.digest
        async with runtime.versions._changing:
            word = asyncio.ensure_future(runtime.versions.activate(digest, ENGINEER_2, "faster"))
            await asyncio.sleep(0.05)
            house.withdrawn.add(ENGINEER_2.name)
        with pytest.raises(Forbidden) as refused:
            await word
        assert (refused.value.code, runtime.kernel.policy.digest) == ("role_forbidden", before)


async def forge(house: House, digest: str, **said: Any) -> None:
    """Have a row say something else, as whoever can write the file could."""
    with sqlite3.connect(Places(house.folder).database) as database:
        ((document,),) = database.execute("SELECT document FROM policies WHERE id = ?", (digest,))
        forged = orjson.dumps({**orjson.loads(document), **said})
        database.execute("UPDATE policies SET document = ? WHERE id = ?", (forged, digest))
    database.close()


async def test_no_event_repeats_what_only_a_row_says(house: House) -> None:
    async with house.open() as runtime:
        digest = await brought(runtime, SLOWER)
    await forge(house, digest, by="emil", awaiting={"by": "emil", "at": "", "why": "mine", "against": ""})
    async with house.open() as runtime:
        await runtime.versions.activate(digest, ENGINEER_2, "a visitor")
        said = (await bodies(runtime, "policy_activated"))[-1]
        assert (said["by"], said["proposed_by"], said["awaiting"]) == (["emil"], "erin", None)


@pytest.mark.parametrize("forged", [{"proved": "everything"}, {"proved": "everything", "promises": None}])
async def test_no_row_stands_in_for_proofs(house: House, forged: dict[str, Any]) -> None:
    """What a start offered and proofs refuse stays out, whatever its row says of them."""
    asked: list[Candidate] = []

    async def examine(candidate: Candidate, against: Candidate | None) -> Examined:
        asked.append(candidate)
        if candidate.prove and candidate.promises == "order: []\n":
            raise PolicyErrors([PolicyError(file=SHARED, line=3, key="property", message="it does not hold")])
        return await examine_here(candidate, against)

    async with house.open() as runtime:
        chosen = await put_in_force(runtime, SLOWER)
    house.policy, house.examine, house.promises = bundle.load_files(FASTER), examine, "order: []\n"
    async with house.open():
        pass
    await forge(house, digest := bundle.digest(FASTER), **forged)
    house.sound = False
    async with house.open() as runtime:
        assert digest in runtime.register.unfounded
        for engineer in (ENGINEER, ENGINEER_2):
            with pytest.raises(PolicyErrors, match="it does not hold"):
                await runtime.versions.activate(digest, engineer, "all the same")
        assert runtime.kernel.policy.digest == chosen


async def test_nothing_comes_of_a_version_that_the_log_does_not_know(house: House) -> None:
    async with house.open() as runtime:
        known = await runtime.versions.load(runtime.kernel.policy.digest)
        digest = bundle.digest(FASTER)
        made = replace(known, digest=digest, status="candidate", by="erin", proved="everything")
        await runtime.store.append([], [made.row(), files_row(digest, FASTER, known.created_at)])
        for engineer in (ENGINEER, ENGINEER_2):
            with pytest.raises(NotFound):
                await runtime.versions.activate(digest, engineer, "somebody brought it")
        assert runtime.kernel.policy.digest == known.digest
        house.sound = False


async def test_who_gives_up_a_promise_needs_another_whatever_the_row_says_was_promised(house: House) -> None:
    async with house.open() as runtime:
        digest = await brought(runtime, {**SLOWER, bundle.PROPERTIES: "order: []\n"})
        await runtime.versions.activate(digest, ENGINEER, "a visitor")
    await forge(house, digest, promises=None)
    against: list[str | None] = []

    async def examine(candidate: Candidate, other: Candidate | None) -> Examined:
        against.append(None if other is None else other.promises)
        return await examine_here(candidate, other)

    house.sound, house.examine = False, examine
    async with house.open() as runtime:
        await runtime.versions.propose(FASTER, ENGINEER, "nothing promised")
        assert against[-1] == "order: []\n"


async def test_a_refuted_version_is_known_as_that_whatever_its_row_says(house: House) -> None:
    async def examine(candidate: Candidate, against: Candidate | None) -> Examined:
        raise PolicyErrors([PolicyError(file=SHARED, line=3, key="property", message="it does not hold")])

    house.examine = examine
    async with house.open() as runtime:
        digest = runtime.kernel.policy.digest
        await runtime.versions.proving.in_force()
    await forge(house, digest, doubt="", proved="everything")
    async with house.open() as runtime:
        assert runtime.versions.proving.trouble() is not None
        assert (await runtime.versions.proving.in_force()).version.verdict == "refuted"


@pytest.mark.parametrize(
    "forged",
    [
        {"by": "emil"},
        {"awaiting": {"by": "emil", "at": "", "why": "mine", "against": ""}},
        {"proved": "nothing at all"},
        {"promises": "order: []\n"},
        {"activations": []},
        {"activations": [{"at": "", "by": ["emil"], "why": "mine", "former": None, "direction": None}]},
    ],
)
async def test_an_auditor_sees_a_version_whose_row_the_log_does_not_bear_out(
    house: House, forged: dict[str, Any]
) -> None:
    async with house.open() as runtime:
        digest = await put_in_force(runtime, SLOWER)
    await forge(house, digest, **forged)
    found = examine_file(house.folder)
    assert not found.ok
    assert digest in (found.problem or "")
    house.sound = False


async def test_promises_that_come_with_another_start_are_in_the_log(house: House) -> None:
    for promises in (None, "order: []\n", "order: [human-shared]\n", None):
        house.promises = promises
        async with house.open() as runtime:
            found = await runtime.versions.proving.in_force()
            assert (found.version.promises, found.version.verdict) == (promises, "proved")
        assert examine_file(house.folder).ok


@pytest.mark.parametrize("brings", [True, False])
async def test_the_word_of_who_is_no_engineer_any_more_counts_for_nothing(house: House, brings: bool) -> None:
    async with house.open() as runtime:
        before = runtime.kernel.policy.digest
        digest = await brought(runtime, FASTER, by=ENGINEER if brings else ENGINEER_2)
        if not brings:
            house.withdrawn.add(ENGINEER_2.name)
            _, entered = await runtime.versions.activate(digest, ENGINEER, "faster")
            assert not entered
        house.withdrawn.add(ENGINEER.name)
        third = replace(ENGINEER, name="eva")
        _, entered = await runtime.versions.activate(digest, third, "they are gone, and I want it")
        assert not entered
        assert runtime.kernel.policy.digest == before
        _, entered = await runtime.versions.activate(digest, replace(ENGINEER, name="elias"), "so do I")
        assert entered


async def test_a_word_from_before_another_change_counts_for_nothing_whatever_the_clock_said(house: House) -> None:
    async with house.open() as runtime:
        wide, slow = runtime.kernel.policy.digest, await brought(runtime, SLOWER)
        house.wall_s.offset_s += 3600.0
        digest = await brought(runtime, FASTER)
        house.wall_s.offset_s -= 3600.0
        await runtime.versions.activate(slow, ENGINEER, "a visitor")
        for engineer in (ENGINEER, ENGINEER_2):
            await runtime.versions.activate(wide, engineer, "the visitor left")
        _, entered = await runtime.versions.activate(digest, ENGINEER_2, "faster")
        assert not entered


# -- what lives of a capability that is gone ---------------------------------------------------------------------------


async def test_a_session_of_a_capability_that_policy_dropped_still_asks_and_is_taken_over(
    runtime: Runtime, cell: HandCell
) -> None:
    await cell.state()
    look = ProposalRequest(capability="inspect_area", params={"area": "bench_a_top"})
    made, _ = await runtime.governor.propose(AGENT, look)
    assert made["status"] == "running", made["admission"]
    await cell.launched(made["id"])
    await put_in_force(runtime, DROPPED)
    await cell.report("status", made["id"], status="escalated", reason="policy_changed")
    await cell.report("escalation", made["id"], reason="policy_changed")
    document = await runtime.governor.invocation(made["id"], AGENT)
    question = await runtime.desk.get(document["escalation"]["id"])
    assert (question["status"], question["risk"]) == ("pending", "critical")
    await runtime.governor.take_over(made["id"], OPERATOR)
    await cell.expect("launch", 2)


async def test_a_session_is_taken_over_also_where_policy_dropped_what_its_cell_is_under_by_now(
    runtime: Runtime, cell: HandCell
) -> None:
    """And its capability: nothing but the profile that it was launched under says then how firmly something is held."""
    gone = "profiles/test-audit.yaml"
    fewer = {name: re.sub("test-audit: [a-z-]+, ", "", text) for name, text in DROPPED.items() if name != gone}
    await cell.state()
    look = ProposalRequest(capability="inspect_area", params={"area": "bench_a_top"})
    made, _ = await runtime.governor.propose(AGENT, look)
    await cell.launched(made["id"])
    await runtime.governor.set_profile(cell.id, "test-audit", ENGINEER)
    await put_in_force(runtime, fewer)
    await cell.report("status", made["id"], status="escalated", reason="policy_changed")
    cell.facts = {**AT_BENCH, "gripper_empty": False, "holding": "mug_1"}
    await cell.state(status="escalated")
    await runtime.governor.take_over(made["id"], OPERATOR)
    driving = json.loads(base64.b64decode((await cell.expect("launch", 2)).body))
    assert (driving["profile"], driving["params"]["grip_force_n"]) == ("human-shared", 60.0)


async def test_who_takes_over_where_policy_cannot_say_the_limits_of_a_session_is_refused_as_by_policy(
    runtime: Runtime, cell: HandCell
) -> None:
    manifest = "capabilities/takeover.yaml"
    renamed = edited(manifest, "    tcp_speed_mps: {", "    hand_mps: {")
    renamed = edited(manifest, "version: 1.0.0", "version: 2.0.0", renamed)
    await put_in_force(runtime, {name: text for name, text in renamed.items() if not name.startswith("tests/")})
    made = await running(runtime, cell)
    with pytest.raises(Conflict, match="policy does not let anybody drive now") as refused:
        await runtime.governor.take_over(made["id"], OPERATOR)
    assert (refused.value.code, [why["code"] for why in refused.value.reasons]) == (
        "takeover_refused",
        ["params_invalid"],
    )
    assert runtime.governor.cells()[0]["control"] is None


async def test_a_cell_under_a_profile_that_policy_dropped_is_named_until_it_is_put_under_another(
    runtime: Runtime, cell: HandCell
) -> None:
    files = {name: text for name, text in FILES.items() if name != SHARED and not name.startswith("tests/")}
    fewer = {name: re.sub(", human-shared: [a-z-]+", "", text) for name, text in files.items()}
    await put_in_force(runtime, fewer)
    await cell.state()
    assert "no profile `human-shared`" in runtime.governor.ready()[f"cell/{cell.id}"]
    await runtime.governor.set_profile(cell.id, "real-restricted", ENGINEER)
    assert runtime.governor.ready() == {}


# -- what comes back after a restart -----------------------------------------------------------------------------------


async def test_what_an_engineer_put_in_force_survives_a_restart_and_says_so(house: House) -> None:
    async with house.open() as runtime:
        digest = await put_in_force(runtime, FASTER)
    async with house.open() as runtime:
        assert runtime.kernel.policy.digest == digest
        assert "both of us want it" in runtime.versions.reason
        said = (await bodies(runtime, "policy_activated"))[-1]
        assert (said["policy_version"], said["directory"], said["source"]) == (digest, house.policy.digest, "request")


async def test_another_directory_takes_the_place_of_what_a_directory_held(house: House) -> None:
    async with house.open():
        pass
    house.policy = bundle.load_files(SLOWER)
    async with house.open() as runtime:
        assert runtime.kernel.policy.digest == house.policy.digest
        assert "another version" in runtime.versions.reason
        assert [item["status"] for item in (await runtime.versions.list())[0]] == ["active", "former"]


async def test_what_was_put_in_force_and_a_newer_release_refuses_is_named_at_the_start(house: House) -> None:
    files = edited(ORGANIZATION, "rules:\n", f"rules:{NO_MUG.replace('mug_1', 'mug_9')}")

    async def earlier(candidate: Candidate, _: Candidate | None) -> Examined:
        policy = bundle.load_kept(candidate.files)
        return Examined(policy=policy, cases=0, proved="it", comparison=compare(bundle.load_files(FILES), policy))

    async with replace(house, examine=earlier).open() as runtime:
        await put_in_force(runtime, files)
    with pytest.raises(PolicyErrors, match=r"`mug_9` is compared .*; valid: `mug_1`") as found:
        async with house.open():
            pass
    assert (found.value.file, found.value.line) == (ORGANIZATION, 13)


async def test_another_directory_only_becomes_a_candidate_beside_what_an_engineer_chose(house: House) -> None:
    async with house.open() as runtime:
        digest = await put_in_force(runtime, FASTER)
    house.policy = bundle.load_files(SLOWER)
    async with house.open() as runtime:
        assert runtime.kernel.policy.digest == digest
        offered = await runtime.versions.load(house.policy.digest)
        assert (offered.status, offered.source) == ("candidate", "directory")


# -- what follows ------------------------------------------------------------------------------------------------------


async def test_cells_get_the_new_version_at_once_and_launches_come_behind_it(runtime: Runtime, cell: HandCell) -> None:
    await cell.expect("policy")
    digest = await put_in_force(runtime, FASTER)
    await cell.expect("policy", 2)
    assert cell.all("policy")[-1].digest == digest
    await cell.state()
    made, _ = await runtime.governor.propose(AGENT, navigate())
    assert made["policy_version"] == digest
    await cell.expect("launch")
    kinds = [message.type for message in cell.heard]
    assert kinds.index("launch") > len(kinds) - 1 - kinds[::-1].index("policy")


async def test_a_session_that_departs_is_told_to_hold_and_a_human_is_asked_with_the_reasons(
    runtime: Runtime, cell: HandCell
) -> None:
    made = await running(runtime, cell)
    await runtime.versions.activate(await brought(runtime, SLOWER), ENGINEER, "a visitor")
    await until(lambda: "escalate" in cell.ops())
    (said,) = await bodies(runtime, "intervention")
    assert (said["code"], said["former"]) == ("policy_changed", made["policy_version"])
    await cell.report("escalation", made["id"], reason="policy_changed")
    question = runtime.desk.pending_for(made["id"])
    assert question is not None
    assert "human-shared/base_speed_mps" in {item["rule"] for item in question.reasons}
    with pytest.raises(Conflict) as refused:
        await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    assert refused.value.code == "resume_refused"
    closed = await runtime.desk.resolve(question.id, OPERATOR, "deny", question.digest)
    assert closed["status"] == "denied"


@pytest.mark.parametrize("restarted", [False, True])
async def test_a_session_is_held_for_what_may_recover_it_also_with_somebody_near_by_now(
    house: House, restarted: bool
) -> None:
    house.policy = bundle.load_files(ASKING_NEAR)
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        made = await running(runtime, cell)
        if restarted:
            await cell.hang_up()
        else:
            await held_for_its_recovery(runtime, cell)
    if restarted:
        async with house.open() as runtime:
            back = replace(cell, runtime=runtime, heard=[], closed=None, invocation=made["id"], status="running")
            await held_for_its_recovery(runtime, await back.dial())


async def held_for_its_recovery(runtime: Runtime, cell: HandCell) -> None:
    cell.facts["people_count"] = 1
    await cell.state()
    await runtime.versions.activate(await brought(runtime, NO_RETREAT), ENGINEER, "it falls")
    await until(lambda: "escalate" in cell.ops())
    (said,) = await bodies(runtime, "intervention")
    assert said["code"] == "policy_changed"
    assert "organization/no-retreat" in {item["rule"] for item in said["reasons"]}


async def test_where_only_a_humans_word_is_missing_one_lets_the_session_go_on(runtime: Runtime, cell: HandCell) -> None:
    made = await running(runtime, cell)
    await runtime.versions.activate(await brought(runtime, ASKING), ENGINEER, "look first")
    await until(lambda: "escalate" in cell.ops())
    await cell.report("escalation", made["id"], reason="policy_changed")
    question = runtime.desk.pending_for(made["id"])
    assert question is not None
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    await until(lambda: "resolve_continue" in cell.ops())


async def test_a_session_that_somebody_let_go_on_at_once_is_not_held_for_the_same_again(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    hold_again = runtime.succession.hold_again
    monkeypatch.setattr(runtime.succession, "hold_again", lambda: None)  # nobody looks while it waits
    made = await running(runtime, cell)
    await runtime.versions.activate(await brought(runtime, ASKING), ENGINEER, "look first")
    await cell.report("status", made["id"], status="escalated", reason="policy_changed")
    await cell.report("escalation", made["id"], reason="policy_changed")
    question = runtime.desk.pending_for(made["id"])
    assert question is not None
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    await cell.report("human", made["id"], op="resolve_continue")
    await cell.report("status", made["id"], status="running", reason="operator")
    await asyncio.sleep(AGAIN_S)
    hold_again()
    heard = len(cell.heard)
    await until(lambda: len(cell.heard) > heard)  # a beat, at least
    assert cell.ops() == ["escalate", "resolve_continue"]


@pytest.mark.parametrize("phase", [None, "drive"])
async def test_a_question_that_stands_says_what_another_policy_has_against_it_and_then_no_more(
    runtime: Runtime, cell: HandCell, phase: str | None
) -> None:
    made = await running(runtime, cell)
    await cell.report("status", made["id"], status="escalated", reason="separation")
    await cell.report("escalation", made["id"], reason="separation" if phase is None else f"confirm:{phase}")
    desk = runtime.desk
    asked = desk.pending_for(made["id"])
    assert asked is not None

    async def answer(digest: str) -> Any:
        return await desk.resolve(asked.id, OPERATOR, "approve", digest)

    before = runtime.kernel.policy.digest
    await runtime.versions.activate(await brought(runtime, ASKING), ENGINEER, "look first")
    with pytest.raises(Conflict) as refused:
        await answer(asked.digest)
    assert refused.value.code == "policy_changed"
    await until(lambda: desk.outdated(desk.pending_for(made["id"]) or asked) is None)
    anew = desk.pending_for(made["id"])
    assert anew is not None
    assert (anew.id, anew.phase, anew.expires_at) == (asked.id, phase, asked.expires_at)
    assert [*anew.reasons][: len(asked.reasons)] == [*asked.reasons]
    assert {why["code"] for why in anew.reasons} - {why["code"] for why in asked.reasons}
    assert anew.policy_version == runtime.kernel.policy.digest
    with pytest.raises(Conflict) as refused:
        await answer(asked.digest)
    assert refused.value.code == "policy_changed"

    for engineer in (ENGINEER, ENGINEER_2):
        await runtime.versions.activate(before, engineer, "no need")
    await until(lambda: (desk.pending_for(made["id"]) or anew).digest != anew.digest)
    again = desk.pending_for(made["id"])
    assert again is not None
    assert [*again.reasons] == [*asked.reasons]
    await answer(again.digest)
    await until(lambda: {"resolve_continue", "confirm"} & set(cell.ops()))


async def test_what_had_failed_is_asked_beside_what_another_policy_has_against_it(
    runtime: Runtime, cell: HandCell
) -> None:
    made = await running(runtime, cell)
    before = runtime.kernel.policy.digest
    await cell.report("status", made["id"], status="recovering", reason="RETRY")
    await runtime.versions.activate(await brought(runtime, ASKING), ENGINEER, "look first")
    await cell.report("status", made["id"], status="escalated", reason="policy_changed")
    await cell.report("escalation", made["id"], reason="policy_changed", failure="blocked")
    asked = runtime.desk.pending_for(made["id"])
    assert asked is not None
    assert [why["code"] for why in asked.reasons] == ["look", "policy_changed"]
    assert asked.reasons[1]["message"].startswith("something stands in the way (`blocked`)")
    assert asked.reasons[1]["remedy"] == "let it go on with a new attempt, or end it"
    for engineer in (ENGINEER, ENGINEER_2):
        await runtime.versions.activate(before, engineer, "no need")
    again = runtime.desk.pending_for(made["id"])
    assert again is not None
    assert [*again.reasons] == [asked.reasons[1]]


async def test_what_a_former_policy_alone_held_is_not_asked_without_a_reason(runtime: Runtime, cell: HandCell) -> None:
    made = await running(runtime, cell)
    before = runtime.kernel.policy.digest
    await runtime.versions.activate(await brought(runtime, ASKING), ENGINEER, "look first")
    await cell.report("status", made["id"], status="escalated", reason="policy_changed")
    await cell.report("escalation", made["id"], reason="policy_changed")
    asked = runtime.desk.pending_for(made["id"])
    assert asked is not None
    for engineer in (ENGINEER, ENGINEER_2):
        await runtime.versions.activate(before, engineer, "no need")
    again = runtime.desk.pending_for(made["id"])
    assert again is not None
    assert again.reasons != asked.reasons
    assert [why["code"] for why in again.reasons] == ["policy_changed"]


async def test_what_a_former_policy_held_is_not_asked_after_a_start_with_another(house: House) -> None:
    before = house.policy
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        made = await running(runtime, cell)
        await cell.report("escalation", made["id"], reason="separation")
    house.policy = bundle.load_files(ASKING)
    async with house.open() as runtime:
        asked = runtime.desk.pending_for(made["id"])
        assert asked is not None
        assert [why["code"] for why in asked.reasons] == ["separation", "look"]
    async with house.open() as runtime:
        asked = runtime.desk.pending_for(made["id"])
        assert asked is not None
        assert [why["code"] for why in asked.reasons] == ["separation", "look"], "the same is in force"
    house.policy = before
    async with house.open() as runtime:
        asked = runtime.desk.pending_for(made["id"])
        assert asked is not None
        assert [why["code"] for why in asked.reasons] == ["separation"]
        assert runtime.desk.outdated(asked) is None


async def test_who_let_a_session_go_on_is_not_asked_the_same_with_the_next_question(
    runtime: Runtime, cell: HandCell
) -> None:
    made = await running(runtime, cell)
    await cell.report("escalation", made["id"], reason="separation")
    await runtime.versions.activate(await brought(runtime, ASKING), ENGINEER, "look first")
    await until(lambda: any(len(asked.reasons) == 2 for asked in runtime.desk.pending()))
    question = runtime.desk.pending_for(made["id"])
    assert question is not None
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    await cell.report("status", made["id"], status="running", reason="operator")
    await cell.report("status", made["id"], status="escalated", reason="separation")
    question = runtime.desk.pending_for(made["id"])
    assert question is not None
    assert len(question.reasons) == 1
    assert runtime.desk.outdated(question) is None


def first(
    runtime: Runtime,
    digest: str,
    monkeypatch: pytest.MonkeyPatch,
    meanwhile: Callable[[], Awaitable[None]] | None = None,
) -> None:
    """Have a version come into force before whatever is recorded next, which was decided before that."""
    append = runtime.store.append

    async def behind(*given: Any) -> Any:
        monkeypatch.setattr(runtime.store, "append", append)
        changing = asyncio.create_task(runtime.versions.activate(digest, ENGINEER_2, "at once"))
        await until(lambda: runtime.kernel.policy.digest == digest)
        changing.add_done_callback(lambda done: done.result())
        if meanwhile is not None:
            await meanwhile()
        return await append(*given)

    monkeypatch.setattr(runtime.store, "append", behind)


async def test_what_a_policy_says_that_came_while_an_answer_was_recorded_is_asked(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = await running(runtime, cell)
    await runtime.versions.activate(await brought(runtime, ASKING), ENGINEER, "look first")
    await cell.report("escalation", made["id"], reason="policy_changed")
    question = runtime.desk.pending_for(made["id"])
    assert question is not None
    twice = await brought(runtime, edited(ORGANIZATION, "{id: look,", "{id: look-again,", ASKING))
    first(runtime, twice, monkeypatch)
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    assert runtime.kernel.policy.digest == twice
    await until(lambda: cell.ops()[-2:] == ["resolve_continue", "escalate"])
    await cell.report("status", made["id"], status="running", reason="operator")
    await cell.report("status", made["id"], status="escalated", reason="policy_changed")
    again = runtime.desk.pending_for(made["id"])
    assert again is not None
    assert [why["rule"] for why in again.reasons] == ["organization/look-again"]


async def test_nobody_takes_the_controls_once_a_policy_is_in_force_that_lets_nobody(
    runtime: Runtime, cell: HandCell
) -> None:
    made = await running(runtime, cell)
    digest = await brought(runtime, edited(SHARED, "interrupt-enabled, takeover-enabled]", "interrupt-enabled]"))
    entry = runtime.register.entry(made["id"])
    assert entry is not None
    async with entry.lock:  # somebody else is being heard about the session
        taking = asyncio.create_task(runtime.governor.take_over(made["id"], OPERATOR))
        await until(lambda: runtime.fleet.cell(cell.id).control is not None)
        await runtime.versions.activate(digest, ENGINEER, "nobody drives here")
        assert runtime.kernel.policy.digest == digest
    with pytest.raises(Conflict) as refused:
        await taking
    assert refused.value.code == "takeover_not_enabled"
    assert runtime.fleet.cell(cell.id).control is None
    assert len(cell.all("launch")) == 1


async def test_whoever_drives_has_the_controls_no_longer_once_a_policy_is_in_force_that_lets_nobody(
    runtime: Runtime, cell: HandCell
) -> None:
    made = await running(runtime, cell)
    lease = (await runtime.governor.take_over(made["id"], OPERATOR))["lease"]
    digest = await brought(runtime, edited(SHARED, "interrupt-enabled, takeover-enabled]", "interrupt-enabled]"))
    await runtime.versions.activate(digest, ENGINEER, "nobody drives here")
    await until(lambda: cell.ops()[-1:] == ["let_go"])
    assert runtime.fleet.cell(cell.id).control is None
    assert runtime.governor.jog(OPERATOR, cell.id, lease, 1, Wish(base=(0.1, 0.0, 0.0))) == "not_holder"
    async with asyncio.timeout(PATIENCE_S):  # it is taken away first, and recorded then
        while not (said := [body for body in await bodies(runtime, "human") if body["op"] == "control_withdrawn"]):
            await asyncio.sleep(0.002)
    assert [(body["holder"], body["lease"]) for body in said] == [(OPERATOR.name, lease)]
    assert [why["code"] for why in said[0]["reasons"]] == ["takeover_not_enabled"]


NO_HAND = "  - {id: no-hand, applies_to: [takeover], then: deny, because: Nobody drives here.}\n"
SLOW_HAND = (
    "  - {id: slow-hand, applies_to: [takeover], then: modify, set: {tcp_speed_mps: {max: 0.05}}, because: Slow.}\n"
)


@pytest.mark.parametrize(
    ("rule", "said"), [(NO_HAND, "organization/no-hand"), (SLOW_HAND, "organization/slow-hand"), ("", None)]
)
async def test_whoever_drives_a_session_is_held_to_what_another_policy_says_of_driving_as_on_an_idle_cell(
    runtime: Runtime, cell: HandCell, rule: str, said: str | None
) -> None:
    made = await running(runtime, cell)
    lease = (await runtime.governor.take_over(made["id"], OPERATOR))["lease"]
    await cell.report("launch", made["id"], capability="takeover")
    await put_in_force(runtime, edited(ORGANIZATION, "rules:\n", f"rules:\n{rule}") if rule else BLUNTER)
    for _ in range(2):  # one look is enough, and a second one finds nothing else
        runtime.governor.loosen_hands()
    driven = runtime.fleet.cell(cell.id).control
    assert (None if driven is None else driven.lease) == (lease if said is None else None)
    if said is not None:
        await until(lambda: cell.ops()[:1] == ["let_go"])


async def test_whoever_took_a_session_that_had_departed_drives_on_under_the_next_policy(
    runtime: Runtime, cell: HandCell
) -> None:
    made = await running(runtime, cell)
    await put_in_force(runtime, SLOWER)
    await cell.report("status", made["id"], status="escalated", reason="policy_changed")
    lease = (await runtime.governor.take_over(made["id"], OPERATOR))["lease"]
    await cell.report("launch", made["id"], capability="takeover")
    await cell.report("status", made["id"], status="running", reason="taken_over")
    await put_in_force(runtime, edited(SHARED, "base_speed_mps: {max: 0.3", "base_speed_mps: {max: 0.25"))
    runtime.governor.loosen_hands()
    await asyncio.sleep(3 * AGAIN_S)
    driven = runtime.fleet.cell(cell.id).control
    assert driven is not None
    assert (driven.lease, cell.told()) == (lease, ["escalate"])
    said = [body["intervention"] for body in await bodies(runtime, "intervention")]
    assert said == ["ESCALATE", "CONTINUE"], "whoever drives was told nothing"
    await put_in_force(runtime, edited(ORGANIZATION, "rules:\n", f"rules:\n{NO_HAND}", SLOWER))
    runtime.governor.loosen_hands()
    await until(lambda: cell.told()[:2] == ["escalate", "let_go"])  # and maybe told to hold, before anybody looks
    await cell.report("status", made["id"], status="escalated", reason="control_lapsed")
    asked = runtime.desk.pending_for(made["id"])
    assert asked is not None
    assert runtime.desk.outdated(asked) is not None, "it is asked anew, with what policy has against it"


async def test_what_is_bound_anew_under_a_policy_that_gives_way_meanwhile_is_not_sent(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = await running(runtime, cell)
    before = runtime.kernel.policy.digest
    await put_in_force(runtime, BLUNTER)
    await cell.report("launch", made["id"], capability="takeover")
    await cell.report("escalation", made["id"], reason="control_lapsed", failure="taken_over")
    question, launched = runtime.desk.pending_for(made["id"]), len(cell.all("launch"))
    assert question is not None
    await cell.state()
    first(runtime, before, monkeypatch)
    with pytest.raises(Conflict, match="it was not sent") as refused:
        await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    assert runtime.kernel.policy.digest == before
    assert [why["code"] for why in refused.value.reasons] == ["policy_changed", "watched_tighter"]
    assert {why["remedy"] for why in refused.value.reasons} == {"answer again, once it is asked about"}
    version = runtime.register.newest(made["id"])
    assert version is not None
    assert version.policy_version == before, "it is bound by what it was bound by"
    assert (cell.ops(), len(cell.all("launch"))) == ([], launched)
    assert await bodies(runtime, "intervention") == []
    async with stating(cell, status="escalated"):
        await until(lambda: runtime.desk.pending_for(made["id"]) is not None)


async def test_what_somebody_drove_and_left_goes_on_as_the_policy_in_force_binds_it_whatever_bound_it_before(
    runtime: Runtime, cell: HandCell
) -> None:
    before = runtime.kernel.policy.digest
    await put_in_force(runtime, BLUNTER)
    made = await running(runtime, cell)
    await cell.report("launch", made["id"], capability="takeover")
    await cell.report("escalation", made["id"], reason="control_lapsed", failure="taken_over")
    launched = len(cell.all("launch"))
    await runtime.versions.activate(before, ENGINEER, "as it was")
    await until(lambda: [runtime.desk.outdated(asked) for asked in runtime.desk.pending()] == [None])
    question = runtime.desk.pending_for(made["id"])
    assert question is not None
    assert "watched_tighter" in [why["code"] for why in question.reasons]
    await cell.state()
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    await cell.expect("launch", launched + 1)
    version = runtime.register.newest(made["id"])
    assert version is not None
    assert version.policy_version == before


async def test_what_stands_against_a_session_stands_still_where_what_binds_it_anew_is_not_sent(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = runtime.kernel.policy.digest
    blunter = await put_in_force(runtime, BLUNTER)
    made = await running(runtime, cell)
    await cell.report("launch", made["id"], capability="takeover")
    await cell.report("escalation", made["id"], reason="control_lapsed", failure="taken_over")
    await runtime.versions.activate(before, ENGINEER, "as it was")
    await until(lambda: [runtime.desk.outdated(asked) for asked in runtime.desk.pending()] == [None])
    question, departures = runtime.desk.pending_for(made["id"]), runtime.desk.departures
    assert question is not None
    await cell.state()
    first(runtime, await brought(runtime, FORBIDDEN), monkeypatch, meanwhile=cell.hang_up)
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    version = runtime.register.newest(made["id"])
    assert version is not None
    assert version.policy_version == blunter, "it is bound by what it was bound by"
    assert "watched_tighter" in [why["code"] for why in departures.standing(made["id"]) or ()]


async def test_what_stands_against_a_session_stands_still_where_its_cell_never_heard_that_it_may_go_on(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = runtime.kernel.policy.digest
    await put_in_force(runtime, BLUNTER)
    made = await running(runtime, cell)
    await cell.report("launch", made["id"], capability="takeover")
    await cell.report("escalation", made["id"], reason="control_lapsed", failure="taken_over")
    await runtime.versions.activate(before, ENGINEER, "as it was")
    await until(lambda: [runtime.desk.outdated(asked) for asked in runtime.desk.pending()] == [None])
    question, append = runtime.desk.pending_for(made["id"]), runtime.store.append
    assert question is not None
    await cell.state()

    async def behind(*given: Any) -> Any:
        monkeypatch.setattr(runtime.store, "append", append)
        await cell.hang_up()
        return await append(*given)

    monkeypatch.setattr(runtime.store, "append", behind)
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    standing = runtime.desk.departures.standing(made["id"])
    assert "watched_tighter" in [why["code"] for why in standing or ()]


async def test_what_cannot_be_compared_is_held_and_all_others_are_compared(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever a policy holds that nobody thought of: it comes into force, and nothing goes on that nobody compared."""
    made = await running(runtime, cell)
    other = await HandCell(runtime, id="workcell-2").dial()
    await other.state()
    elsewhere = ProposalRequest(capability="navigate_to", params={"target": "bench_a_stand"}, cell="workcell-2")
    second, _ = await runtime.governor.propose(AGENT, elsewhere)
    await other.launched(second["id"])

    def broken(old: PolicySet, new: PolicySet, proposal: Proposal, *rest: Any, **named: Any) -> Departure:
        if proposal.params["target"] == "dock":
            raise KeyError("device")
        return departure(old, new, proposal, *rest, **named)

    monkeypatch.setattr(kernel, "departure", broken)
    await put_in_force(runtime, SLOWER)
    assert (cell.told(), other.told()) == (["escalate"], ["escalate"])
    for each, name in ((cell, made["id"]), (other, second["id"])):
        await each.report("status", name, status="escalated", reason="policy_changed")
        await each.report("escalation", name, reason="policy_changed")
    asked, its = runtime.desk.pending_for(made["id"]), runtime.desk.pending_for(second["id"])
    assert asked is not None
    assert its is not None
    assert [why["code"] for why in asked.reasons] == ["not_comparable"]
    assert "KeyError: 'device'" in asked.reasons[0]["message"]
    assert "not_comparable" not in {why["code"] for why in its.reasons}
    with pytest.raises(Conflict) as refused:
        await runtime.desk.resolve(asked.id, OPERATOR, "approve", asked.digest)
    assert refused.value.code == "resume_refused"


async def test_a_loosening_leaves_what_runs_alone(runtime: Runtime, cell: HandCell) -> None:
    made = await running(runtime, cell)
    await put_in_force(runtime, FASTER)
    await cell.expect("policy", 2)
    assert cell.ops() == []
    assert (await runtime.governor.invocation(made["id"], AGENT))["status"] == "running"


async def test_a_launch_on_its_way_is_held_as_soon_as_the_cell_has_it(runtime: Runtime, cell: HandCell) -> None:
    made, _ = await runtime.governor.propose(AGENT, navigate())
    await runtime.versions.activate(await brought(runtime, SLOWER), ENGINEER, "a visitor")
    await until(lambda: cell.ops().count("escalate") == 1)  # it knows of no session yet, and cannot hold it
    await cell.launched(made["id"])
    await until(lambda: cell.ops().count("escalate") >= 2)


async def test_a_launch_on_its_way_is_held_for_no_policy_that_gave_way_before_its_cell_had_it(
    runtime: Runtime, cell: HandCell
) -> None:
    before = runtime.kernel.policy.digest
    made, _ = await runtime.governor.propose(AGENT, navigate())
    await runtime.versions.activate(await brought(runtime, SLOWER), ENGINEER, "a visitor")
    await until(lambda: cell.ops() == ["escalate"])
    for engineer in (ENGINEER, ENGINEER_2):
        await runtime.versions.activate(before, engineer, "gone")
    await cell.launched(made["id"])
    assert runtime.desk.departures.telling() == ()


async def test_nobody_is_given_the_controls_of_an_idle_cell_by_a_policy_that_gave_way_meanwhile(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    await cell.state()
    first(runtime, await brought(runtime, edited(ORGANIZATION, "rules:\n", f"rules:\n{NO_HAND}")), monkeypatch)
    with pytest.raises(Conflict) as refused:
        await runtime.governor.take_cell(cell.id, OPERATOR)
    assert refused.value.code == "takeover_refused"
    await until(lambda: runtime.fleet.busy(runtime.fleet.cell(cell.id)) is None)
    assert (runtime.governor.cells()[0]["control"], cell.all("launch")) == (None, [])


async def test_what_recovers_is_not_told_to_hold_five_times_a_second(runtime: Runtime, cell: HandCell) -> None:
    made = await running(runtime, cell)
    await cell.report("status", made["id"], status="recovering", reason="RETRY")
    await runtime.versions.activate(await brought(runtime, SLOWER), ENGINEER, "a visitor")
    await until(lambda: cell.ops() == ["escalate"])
    await asyncio.sleep(3 * AGAIN_S)
    assert cell.ops() == ["escalate"]
    await cell.report("status", made["id"], status="running", reason="recovered")
    await until(lambda: cell.ops().count("escalate") == 2)


async def test_what_departs_between_its_decision_and_its_record_is_never_sent(runtime: Runtime, cell: HandCell) -> None:
    digest = await brought(runtime, SLOWER)
    slower = await runtime.versions.compiled(digest)
    append = runtime.store.append

    async def meanwhile(*given: Any) -> Any:
        done = await append(*given)
        runtime.kernel.enforce(slower)
        return done

    await cell.state()
    runtime.store.append = meanwhile  # type: ignore[method-assign]
    made, _ = await runtime.governor.propose(AGENT, navigate())
    runtime.store.append = append  # type: ignore[method-assign]
    assert made["policy_version"] != digest
    await until(lambda: runtime.register.newest(made["id"]) is None)
    ended = await runtime.governor.invocation(made["id"], AGENT)
    assert (ended["status"], ended["outcome"]) == ("failed", "fault")
    assert ended["failure"]["reasons"][0]["code"] == "policy_changed"
    assert not cell.all("launch")
    assert runtime.fleet.busy(runtime.fleet.cell(cell.id)) is None


# -- what waits for approval -------------------------------------------------------------------------------------------


async def waiting(runtime: Runtime) -> tuple[dict[str, Any], Any]:
    made, _ = await runtime.governor.propose(AGENT, grasp())
    question = runtime.desk.pending_for(made["id"])
    assert question is not None
    return made, question


async def test_what_waits_is_asked_anew_and_an_old_answer_has_a_code_of_its_own(
    runtime: Runtime, cell: HandCell
) -> None:
    made, question = await waiting(runtime)
    digest = await brought(runtime, WEAKER)
    await runtime.versions.activate(digest, ENGINEER, "softer")
    anew = runtime.desk.pending_for(made["id"])
    assert anew is not None
    assert anew.id == question.id
    assert (anew.effective["force_n"], anew.policy_version) == (30.0, digest)
    with pytest.raises(Conflict) as refused:
        await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    assert refused.value.code == "policy_changed"
    await cell.state()
    await runtime.desk.resolve(anew.id, OPERATOR, "approve", anew.digest)
    launched = await runtime.governor.invocation(made["id"], AGENT)
    assert (launched["status"], launched["policy_version"], launched["effective"]["force_n"]) == ("running", digest, 30)


@pytest.mark.parametrize("decision", ["approve", "deny"])
async def test_what_waits_is_answered_where_the_former_version_is_in_force_again(
    runtime: Runtime, cell: HandCell, decision: str
) -> None:
    made, question = await waiting(runtime)
    before = runtime.kernel.policy.digest
    await runtime.versions.activate(await brought(runtime, WEAKER), ENGINEER, "softer")
    anew = runtime.desk.pending_for(made["id"])
    assert anew is not None
    for engineer in (ENGINEER, ENGINEER_2):
        await runtime.versions.activate(before, engineer, "no need")
    again = runtime.desk.pending_for(made["id"])
    assert again is not None
    assert (again.policy_version, [*again.former_digests]) == (before, [anew.digest])
    with pytest.raises(Conflict) as refused:
        await runtime.desk.resolve(question.id, OPERATOR, decision, anew.digest)
    assert refused.value.code == "policy_changed"
    await cell.state()
    await runtime.desk.resolve(again.id, OPERATOR, decision, again.digest)
    answered = await runtime.governor.invocation(made["id"], AGENT)
    assert answered["status"] == {"approve": "running", "deny": "denied"}[decision]


async def test_what_waits_and_is_denied_now_ends_denied(runtime: Runtime, cell: HandCell) -> None:
    made, question = await waiting(runtime)
    await runtime.versions.activate(await brought(runtime, FORBIDDEN), ENGINEER, "no mugs")
    ended = await runtime.governor.invocation(made["id"], AGENT)
    assert (ended["status"], ended["escalation"]["status"]) == ("denied", "withdrawn")
    assert "organization/no-mug" in {item["rule"] for item in ended["policy"]["reasons"]}
    with pytest.raises(Conflict) as refused:
        await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    assert refused.value.code == "already_resolved"


async def fewer_questions(runtime: Runtime) -> str:
    """Bring a version that asks nobody before grasping."""
    wider = edited(SHARED, "approval: {risk: [medium, high, critical]", "approval: {risk: [high, critical]")
    grasping = "capabilities/grasp_object.yaml"
    return await brought(runtime, edited(grasping, "human-shared: approval-required", "human-shared: guarded", wider))


async def test_what_waits_and_needs_nobody_any_more_launches(runtime: Runtime, cell: HandCell) -> None:
    made, _ = await waiting(runtime)
    digest = await fewer_questions(runtime)
    await cell.state()
    await runtime.versions.activate(digest, ENGINEER_2, "fewer questions")
    launched = await runtime.governor.invocation(made["id"], AGENT)
    assert (launched["status"], launched["escalation"]["status"]) == ("running", "withdrawn")
    await cell.expect("launch")


async def test_what_needs_nobody_any_more_is_not_decided_on_what_the_last_session_changed(
    runtime: Runtime, cell: HandCell
) -> None:
    (made, _), digest = await waiting(runtime), await fewer_questions(runtime)
    before = await running(runtime, cell)
    await cell.report("outcome", before["id"], outcome="succeeded", code="done")
    activating = asyncio.create_task(runtime.versions.activate(digest, ENGINEER_2, "fewer questions"))
    await until(lambda: runtime.kernel.policy.digest == digest)
    cell.invocation = cell.status = None
    await cell.state(facts={**AT_BENCH, "gripper_empty": False, "holding": "glass_1"})
    await activating
    ended = await runtime.governor.invocation(made["id"], AGENT)
    assert (ended["status"], ended["escalation"]["status"]) == ("deferred", "withdrawn")
    assert len(cell.all("launch")) == 1


async def test_what_waited_over_a_restart_under_another_directory_is_decided_again(house: House) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        made, question = await waiting(runtime)
        await cell.hang_up()
    house.policy = bundle.load_files(WEAKER)
    async with house.open() as runtime:
        anew = runtime.desk.pending_for(made["id"])
        assert anew is not None
        assert anew.digest != question.digest
        assert anew.effective["force_n"] == 30.0


# -- while much goes on ------------------------------------------------------------------------------------------------


async def test_every_decision_while_versions_change_is_made_under_one_of_them(runtime: Runtime, cell: HandCell) -> None:
    digests = [runtime.kernel.policy.digest, await brought(runtime, SLOWER)]
    most = dict(zip(digests, (0.3, 0.2), strict=True))
    made: list[dict[str, Any]] = []

    async def propose() -> None:
        for _ in range(60):
            document, _ = await runtime.governor.propose(AGENT, navigate_fast())
            made.append(document)
            await asyncio.sleep(0)

    proposing = asyncio.gather(*(propose() for _ in range(4)))
    for turn in range(6):
        await asyncio.sleep(0.02)
        for engineer in (ENGINEER, ENGINEER_2):
            _, entered = await runtime.versions.activate(digests[(turn + 1) % 2], engineer, "there and back")
            if entered:
                break
    await proposing
    assert {document["policy_version"] for document in made} == set(digests)
    for document in made:
        assert document["status"] in set(Status)
        checked = document["policy"]
        if checked is not None and checked["outcome"] == "modify":
            assert document["effective"]["speed_mps"] == most[document["policy_version"]]


def navigate_fast() -> Any:
    request = navigate()
    return type(request)(capability=request.capability, params={**request.params, "speed_mps": 1.0})
