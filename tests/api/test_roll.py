"""Principals in the record."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import orjson
import pytest
from starlette.datastructures import Headers

from app import clock
from app.api.auth import FIRST_PRINCIPALS, PRINCIPALS_FILE, TOKENS_FILE, Principals, issue_token, open_principals
from app.api.problems import Problem
from app.api.roll import Roll
from app.audit import store as store_module
from app.audit.errors import RecordUnavailable
from app.audit.event import EventDraft
from app.audit.store import AuditStore
from app.governance.model import Role
from tests.api.conftest import House, eventually

pytestmark = pytest.mark.anyio


@pytest.fixture
async def store(tmp_path: Path) -> AsyncIterator[AuditStore]:
    store = AuditStore.open(tmp_path)
    yield store
    await store.close()


async def words(store: AuditStore) -> list[dict[str, Any]]:
    return [event.payload() for event in await store.events(kind="principal")]


def may_enter(principals: Principals, token: str) -> bool:
    try:
        principals.authenticate(Headers({"authorization": f"Bearer {token}"}))
    except Problem as problem:
        if problem.code != "token_invalid":
            raise
        return False
    return True


def withdraw(folder: Path, name: str) -> None:
    path = folder / PRINCIPALS_FILE
    rows = [row for row in orjson.loads(path.read_bytes())["principals"] if row["name"] != name]
    path.write_bytes(orjson.dumps({"principals": rows}))


async def test_the_first_start_records_everyone(tmp_path: Path, store: AuditStore) -> None:
    await Roll(open_principals(tmp_path), store).open()
    said = [(word["op"], word["principal"], word["role"]) for word in await words(store)]
    assert said == [*(("added", name, role.value) for _, name, role in FIRST_PRINCIPALS), ("added", "cell", "cell")]


async def test_a_second_start_records_only_what_changed_meanwhile(tmp_path: Path, store: AuditStore) -> None:
    await Roll(open_principals(tmp_path), store).open()
    before = store.size
    await Roll(open_principals(tmp_path), store).open()
    assert store.size == before
    issue_token(tmp_path, name="visitor", role=Role.AUDITOR, ttl_s=60.0)
    withdraw(tmp_path, "engineer")
    await Roll(open_principals(tmp_path), store).open()
    added, withdrawn = (await words(store))[-2:]
    assert (added["op"], added["principal"], added["role"]) == ("added", "visitor", "auditor")
    assert added["expires_at"] is not None
    assert (withdrawn["op"], withdrawn["principal"]) == ("withdrawn", "engineer")


async def test_no_token_stands_in_the_record(tmp_path: Path, store: AuditStore) -> None:
    await Roll(open_principals(tmp_path), store).open()
    said = orjson.dumps(await words(store)).decode()
    for token in orjson.loads((tmp_path / TOKENS_FILE).read_bytes()).values():
        assert token not in said


async def test_who_is_new_counts_only_once_recorded(
    tmp_path: Path, store: AuditStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    principals = open_principals(tmp_path)
    roll = Roll(principals, store)
    await roll.open()
    token = issue_token(tmp_path, name="second", role=Role.AGENT)
    principals.look()
    assert not may_enter(principals, token)

    async def fail(events: list[EventDraft]) -> list[int]:
        raise RecordUnavailable("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(store, "append", fail)
        with pytest.raises(RecordUnavailable):
            await roll.update()
    assert not may_enter(principals, token)
    await roll.update()
    assert may_enter(principals, token)
    assert (await words(store))[-1]["principal"] == "second"


async def test_who_is_gone_stops_counting_before_it_is_recorded(tmp_path: Path, store: AuditStore) -> None:
    principals = open_principals(tmp_path)
    roll = Roll(principals, store)
    token = issue_token(tmp_path, name="second", role=Role.AGENT)
    await roll.open()
    assert may_enter(principals, token)
    withdraw(tmp_path, "second")
    principals.look()
    assert not may_enter(principals, token)
    await roll.update()
    assert [word["op"] for word in await words(store) if word["principal"] == "second"] == ["added", "withdrawn"]


async def test_another_role_for_the_same_token_is_recorded(tmp_path: Path, store: AuditStore) -> None:
    principals = open_principals(tmp_path)
    roll = Roll(principals, store)
    await roll.open()
    path = tmp_path / PRINCIPALS_FILE
    path.write_bytes(path.read_bytes().replace(b'"engineer",\n      "sha256"', b'"auditor",\n      "sha256"'))
    await roll.update()
    last = (await words(store))[-1]
    assert (last["op"], last["principal"], last["role"]) == ("changed", "engineer", "auditor")


async def test_a_token_issued_while_the_server_runs_is_recorded_and_counts(house: House) -> None:
    token = issue_token(house.folder, name="visitor", role=Role.AUDITOR)

    async with house.client("auditor") as auditor, auditor.stream("GET", "/v1/events?after=0") as answer:
        async for line in answer.aiter_lines():
            if line.startswith("data: ") and orjson.loads(line[6:])["body"].get("principal") == "visitor":
                break
    principals: Principals = house.app.state.parts.principals
    await eventually(lambda: may_enter(principals, token))


async def test_a_name_stays_somebodys_after_its_token_is_withdrawn(tmp_path: Path, store: AuditStore) -> None:
    principals = open_principals(tmp_path)
    issue_token(tmp_path, name="Lena  M", role=Role.OPERATOR)
    issue_token(tmp_path, name="workcell-2", role=Role.CELL)
    roll = Roll(principals, store)
    await roll.open()
    assert (roll.alike("lena m"), roll.alike("workcell-2"), roll.alike("nobody")) == ("Lena  M", None, None)
    issue_token(tmp_path, name="Otto", role=Role.OPERATOR)
    assert roll.alike("otto") == "Otto", "who is new has the name before the record knows"
    withdraw(tmp_path, "Lena  M")
    await roll.update()
    again = Roll(open_principals(tmp_path), store)
    await again.open()
    assert (roll.alike("lena m"), again.alike("lena m")) == ("Lena  M", "Lena  M")


async def test_where_somebody_stands_is_recorded_before_it_counts(tmp_path: Path, store: AuditStore) -> None:
    principals = open_principals(tmp_path)
    roll = Roll(principals, store)
    await roll.open()
    token = issue_token(tmp_path, name="maria", role=Role.OPERATOR, station="workcell-1")
    await roll.update()
    assert (await words(store))[-1]["station"] == "workcell-1"
    assert all("station" not in word for word in (await words(store))[:-1])
    path = tmp_path / PRINCIPALS_FILE
    rows = orjson.loads(path.read_bytes())["principals"]
    path.write_bytes(orjson.dumps({"principals": [{**row, "station": "workcell-2"} for row in rows]}))
    await roll.update()
    changed = (await words(store))[-len(rows) :]
    assert {(word["op"], word["station"]) for word in changed} == {("changed", "workcell-2")}
    assert principals.recognize(token).station == "workcell-2"


async def test_a_token_that_has_expired_holds_no_more_at_a_start_with_the_clock_put_back(
    tmp_path: Path, store: AuditStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    await Roll(open_principals(tmp_path), store).open()
    over = issue_token(tmp_path, name="maria", role=Role.AUDITOR, ttl_s=60.0)
    await Roll(principals := open_principals(tmp_path), store).open()
    assert may_enter(principals, over)
    now_s = clock.wall_s()
    with monkeypatch.context() as later:
        later.setattr(store_module, "wall_s", lambda: now_s + 90.0)
        await store.append([EventDraft(kind="boot", actor="server", body={})])
    holds = issue_token(tmp_path, name="jo", role=Role.AUDITOR, ttl_s=60.0)
    await Roll(principals := open_principals(tmp_path), store).open()
    assert may_enter(principals, holds), "it was issued after the clock was put back"
    await Roll(principals := open_principals(tmp_path), store).open()
    assert may_enter(principals, holds)
    with pytest.raises(Problem, match="expired"):
        principals.authenticate(Headers({"authorization": f"Bearer {over}"}))
