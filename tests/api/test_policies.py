"""Versions of policy over HTTP: bringing, comparing, putting in force."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from app import clock
from app.api.auth import issue_token
from app.governance import bundle
from app.governance.model import Role
from tests.api.conftest import POLICIES, House, eventually, open_house

pytestmark = pytest.mark.anyio
FILES = bundle.read_files(POLICIES)
SHARED = "profiles/human-shared.yaml"
SLOWER = {**FILES, SHARED: FILES[SHARED].replace("base_speed_mps: {max: 0.3", "base_speed_mps: {max: 0.2")}
FASTER = {**FILES, SHARED: FILES[SHARED].replace("base_speed_mps: {max: 0.3", "base_speed_mps: {max: 0.4")}


@pytest.fixture
async def changing(tmp_path: Path) -> AsyncIterator[House]:
    """A server of its own: what is in force changes here."""
    async with open_house(tmp_path, "human-shared") as house:
        token = issue_token(tmp_path, name="engineer_2", role=Role.ENGINEER)
        house.tokens["engineer_2"] = token
        await eventually(lambda: house.knows("engineer_2"))
        yield house


async def bring(house: House, files: dict[str, str]) -> httpx.Response:
    async with house.client("engineer") as client:
        return await client.post("/v1/policies", json={"files": files, "why": "because"})


async def activate(house: House, digest: str, key: str = "engineer") -> httpx.Response:
    async with house.client(key) as client:
        return await client.post(f"/v1/policies/{digest}/activate", json={"why": "it is time"})


async def get(house: House, path: str) -> Any:
    async with house.client("auditor") as client:
        return (await client.get(path)).json()


async def test_a_tightening_comes_into_force_by_one_engineers_word(changing: House) -> None:
    brought = await bring(changing, SLOWER)
    assert brought.status_code == 201
    digest = brought.json()["digest"]
    assert (await get(changing, brought.headers["location"]))["digest"] == digest
    assert (await bring(changing, SLOWER)).status_code == 200
    found = await get(changing, f"/v1/policies/{digest}/diff")
    assert found["direction"] == "tightens"
    assert (await get(changing, f"/v1/policies/{digest}/files"))["files"] == SLOWER
    assert (await activate(changing, digest)).status_code == 200
    assert (await get(changing, "/v1/policies/active"))["version"] == digest
    listed = await get(changing, "/v1/policies")
    assert listed["active"] == digest
    assert [item["status"] for item in listed["items"]] == ["active", "former"]
    refused = await activate(changing, digest)
    assert (refused.status_code, refused.json()["code"]) == (409, "policy_active")


async def test_a_loosening_waits_for_a_second_engineer(changing: House) -> None:
    digest = (await bring(changing, FASTER)).json()["digest"]
    first = await activate(changing, digest)
    assert (first.status_code, first.json()["status"]) == (202, "awaiting_second")
    again = await activate(changing, digest)
    assert (again.status_code, again.json()["code"]) == (409, "second_engineer_needed")
    assert (await activate(changing, digest, "engineer_2")).status_code == 200
    assert (await get(changing, f"/v1/policies/{digest}"))["status"] == "active"


async def test_faults_are_named_with_file_and_line_and_nothing_is_kept(changing: House) -> None:
    organization = FILES["organization.yaml"].replace("when: target.hazardous", "when: target.hazardus")
    refused = await bring(changing, {**FILES, "organization.yaml": organization})
    assert (refused.status_code, refused.json()["code"]) == (422, "policy_invalid")
    fault = refused.json()["errors"][0]
    assert fault["file"] == "organization.yaml"
    assert "hazardus" in organization.splitlines()[fault["line"] - 1]
    assert len((await get(changing, "/v1/policies"))["items"]) == 1
    unknown = await activate(changing, bundle.digest({**FILES, "organization.yaml": organization}))
    assert (unknown.status_code, unknown.json()["code"]) == (404, "policy_unknown")


async def test_a_large_policy_is_taken_and_an_endless_one_is_not(changing: House) -> None:
    remarks = "# a remark\n" * 40_000
    assert (await bring(changing, {**FILES, SHARED: remarks + FILES[SHARED]})).status_code == 201
    refused = await bring(changing, {**FILES, SHARED: remarks * 12 + FILES[SHARED]})
    assert (refused.status_code, refused.json()["code"]) == (413, "body_too_large")


async def test_no_request_fails_while_versions_come_into_force(changing: House) -> None:
    digests = [changing.runtime.kernel.policy.digest, (await bring(changing, SLOWER)).json()["digest"]]
    seen: list[tuple[int, str]] = []
    async with changing.cell(), changing.client("agent") as client:
        until_s = clock.monotonic_s() + 1.0
        turn = 0
        while clock.monotonic_s() < until_s or turn < 4:
            for key in ("engineer", "engineer_2"):
                answer = await client.post(
                    "/v1/invocations", json={"capability": "navigate_to", "params": {"target": "dock"}}
                )
                seen.append((answer.status_code, answer.json()["policy_version"]))
                if (await activate(changing, digests[(turn + 1) % 2], key)).status_code == 200:
                    turn += 1
                    break
    assert {status for status, _ in seen} == {201}
    assert {version for _, version in seen} == set(digests)


INSPECT = "capabilities/inspect_area.yaml"


def inspecting(version: str, dwell: str) -> dict[str, str]:
    """The shipped policy with another longest dwell, and what its manifest says of it."""
    manifest = FILES[INSPECT].replace(
        "version: 1.0.0\n", f"version: {version}\nchanges: {{{version}: Dwells otherwise.}}\n"
    )
    return {**FILES, INSPECT: manifest.replace("maximum: 10.0", dwell)}


async def test_a_changed_capability_needs_the_version_its_change_demands(changing: House) -> None:
    assert "maximum: 10.0" in FILES[INSPECT]
    refused = await bring(changing, inspecting("1.1.0", "maximum: 5"))
    assert (refused.status_code, refused.json()["code"]) == (422, "policy_invalid")
    (fault,) = refused.json()["errors"]
    assert (fault["file"], fault["line"], fault["field"]) == (INSPECT, 3, "version")
    assert (
        "demands a major step: input `dwell_s`: maximum is `5` instead of `10.0`; valid: `2.0.0 or later`"
        in fault["message"]
    )
    assert (await bring(changing, inspecting("2.0.0", "maximum: 5"))).status_code == 201


async def test_an_agent_made_for_an_older_capability_is_told_which_is_in_force_until_it_comes_back(
    changing: House,
) -> None:
    async def propose(params: dict[str, Any], version: str) -> dict[str, Any]:
        async with changing.client("agent") as client:
            body = {"capability": "inspect_area", "params": params, "capability_version": version}
            return (await client.post("/v1/invocations", json=body)).json()

    former = changing.runtime.kernel.policy.digest
    digest = (await bring(changing, inspecting("2.0.0", "maximum: 5"))).json()["digest"]
    for key in ("engineer", "engineer_2"):
        await activate(changing, digest, key)
    async with changing.cell():
        told = await propose({"area": "bench_a_top", "dwell_s": 9}, "^1.0.0")  # another schema's parameters
        assert (told["status"], told["admission"]["reasons"][0]["code"]) == ("rejected", "capability_version")
        assert "2.0.0: Dwells otherwise." in told["admission"]["reasons"][0]["message"]
        taken = await propose({"area": "bench_a_top", "dwell_s": 4}, "^2.0.0")
        assert [one["code"] for one in taken["admission"]["reasons"]] == ["precondition_unmet"]
        malformed = await propose({"area": "bench_a_top"}, "newest")
        assert malformed["code"] == "request_invalid"
        for key in ("engineer", "engineer_2"):  # what was in force before may come back, its versions with it
            await activate(changing, former, key)
        assert changing.runtime.kernel.policy.digest == former
