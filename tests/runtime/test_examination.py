"""Examining a data directory that a real runtime wrote, after somebody has changed what lies beside the log.

Every other test of the runtime ends with an examination that finds nothing (`House.open`).
"""

from __future__ import annotations

import asyncio
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import orjson
import pytest

from app.audit.examination import Examination, examine, examine_file
from app.audit.places import Places, load_verifier
from tests.runtime.conftest import AGENT, CELL, OPERATOR, OPERATOR_2, HandCell, House, navigate

pytestmark = pytest.mark.anyio


async def drive(house: House) -> str:
    """Record a drive that was stopped; returns its name."""
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        name = (await runtime.governor.propose(AGENT, navigate()))[0]["id"]
        await cell.launched(name)
        await runtime.governor.stop(name, OPERATOR)
        await cell.ended(name, "stopped")
    return name


def change(folder: Path, statement: str, *values: object) -> Examination:
    with closing(sqlite3.connect(Places(folder).database)) as database, database:
        assert database.execute(statement, values).rowcount == 1
    return examine_file(folder)


def rewritten(folder: Path, name: str, **changes: Any) -> bytes:
    with closing(sqlite3.connect(Places(folder).database)) as database:
        (document,) = database.execute("SELECT document FROM invocations WHERE id = ?", (name,)).fetchone()
    return orjson.dumps({**orjson.loads(document), **changes})


@pytest.mark.parametrize("by", ["agent", "hand"])
async def test_a_stop_that_is_written_down_before_what_it_met_changes_nothing_of_it(
    house: House, monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        begun, go, append = asyncio.Event(), asyncio.Event(), runtime.register.append

        async def late(*arguments: Any, **named: Any) -> Any:
            monkeypatch.setattr(runtime.register, "append", append)
            begun.set()
            await go.wait()
            return await append(*arguments, **named)

        monkeypatch.setattr(runtime.register, "append", late)
        if by == "agent":
            beginning = asyncio.create_task(runtime.governor.propose(AGENT, navigate()))
        else:
            beginning = asyncio.create_task(runtime.governor.take_cell(CELL, OPERATOR_2))
        await begun.wait()
        name = runtime.fleet.cell(CELL).claim
        assert name is not None
        await runtime.governor.estop(CELL, OPERATOR)
        go.set()
        await asyncio.gather(beginning, return_exceptions=True)  # whose controls the stop has taken away
        told = [event["body"].get("op", event["kind"]) for event in await runtime.governor.trace(name, OPERATOR)]
        assert told[:2] == ["estop", "proposal" if by == "agent" else "takeover"]
    assert examine_file(house.folder).ok


@pytest.mark.parametrize(
    ("column", "value"), [("status", "completed"), ("agent", "stranger"), ("created_seq", 999), ("created_at", "1999")]
)
async def test_names_a_row_whose_column_was_changed(house: House, column: str, value: object) -> None:
    name = await drive(house)
    found = change(house.folder, f"UPDATE invocations SET {column} = ? WHERE id = ?", value, name)  # noqa: S608
    assert not found.ok
    assert found.log.ok, "the log itself is good"
    (problem,) = found.state
    assert f"`{name}`: column `{column}` is `{value}`" in problem
    assert found.problem == problem


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("status", "completed"),
        ("outcome", "succeeded"),
        ("requested", {"target": "bench_a"}),
        ("effective", {"target": "dock", "speed_mps": 2.0}),
        ("policy_version", "sha256:other"),
        ("admission", {"outcome": "accept", "reasons": [{"rule": "x", "code": "forged"}]}),
        ("policy", {"outcome": "allow", "reasons": [], "changes": []}),
        ("escalation", {"id": "esc_forged", "status": "approved", "expires_at": None}),
        ("created_at", "1999-01-01T00:00:00.000Z"),
    ],
)
async def test_names_a_row_whose_document_was_changed(house: House, field: str, value: object) -> None:
    name = await drive(house)
    document = rewritten(house.folder, name, **{field: value})
    found = change(house.folder, "UPDATE invocations SET document = ? WHERE id = ?", document, name)
    (problem,) = found.state
    assert f"`{field}` is `" in problem


async def test_names_an_invocation_that_was_taken_out_of_the_table(house: House) -> None:
    name = await drive(house)
    found = change(house.folder, "DELETE FROM invocations WHERE id = ?", name)
    assert found.state == (f"`{name}`: the log knows it, the table `invocations` does not",)


async def test_names_an_invocation_that_was_never_recorded(house: House) -> None:
    name = await drive(house)
    columns = "created_seq, status, capability, agent, cell, profile, document, created_at, updated_at"
    found = change(
        house.folder,
        f"INSERT INTO invocations (id, {columns}) SELECT 'inv_never', {columns} FROM invocations WHERE id = ?",  # noqa: S608
        name,
    )
    assert found.state == ("`inv_never`: the log knows nothing of it",)


async def test_a_document_that_is_no_json_is_a_finding(house: House) -> None:
    name = await drive(house)
    found = change(house.folder, "UPDATE invocations SET document = ? WHERE id = ?", b"{", name)
    assert found.state == (f"`{name}`: its document is no JSON",)


async def test_says_that_there_was_not_the_time_to_read_the_database(house: House) -> None:
    await drive(house)
    places = Places(house.folder)
    with closing(sqlite3.connect(places.database)) as database, database:
        ballast = ((f"ballast/{number}",) for number in range(20_000))
        database.executemany("INSERT INTO settings VALUES (?, x'', '')", ballast)
    found = examine(places, load_verifier(places), within_s=0.0)
    assert (found.database, found.ok) == (None, True)
    assert examine_file(house.folder).database == ()
