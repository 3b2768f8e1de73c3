"""What the log says of stops and of reports, and whether the rows beside it say the same."""

from __future__ import annotations

import tracemalloc
from contextlib import closing
from pathlib import Path
from typing import Any

import orjson
import pytest

from app.audit.cells import PAGE, Latch, cell_problems, latches, reported
from app.audit.event import EventDraft, RowWrite
from app.audit.reader import Reader
from app.audit.store import AuditStore
from tests.audit.conftest import TIME, draft

pytestmark = pytest.mark.anyio

CELL = "workcell-1"


def word(op: str, **more: Any) -> EventDraft:
    return draft("human", None, "olivia", **{"op": op, "cell": CELL, "role": "operator", **more})


def told(what: str, *, cell: str = CELL, invocation: str | None = None, kind: str = "cell", **more: Any) -> EventDraft:
    return draft(kind, invocation, cell, **{"what": what, "cell_seq": 1, **more})


def missed(cell: str = CELL) -> EventDraft:
    return draft("cell", None, "server", what="not_confirmed", op="reset", cell=cell)


def confirmed() -> EventDraft:
    return draft("cell", None, "server", what="confirmed", op="reset", cell=CELL)


KEPT = draft("cell", None, "server", what="latched", cell=CELL)
STORIES: dict[str, tuple[list[EventDraft], bool, bool]] = {
    "a stop": ([word("estop")], True, True),
    "its reset": ([word("estop"), word("reset")], False, False),
    "another stop": ([word("estop"), word("reset"), word("estop")], True, True),
    "a stop that its row was written for later": ([KEPT], True, True),
    "its own stop": ([told("estop")], False, True),
    "its own reset": ([told("estop"), told("reset")], False, False),
    "a reset it says nothing of": ([told("estop"), word("estop"), word("reset")], False, True),
    "a reset it reports": ([told("estop"), word("estop"), word("reset"), told("reset")], False, False),
    "a reset that was missed": ([word("estop"), word("reset"), missed()], False, True),
    "one reported before that": ([word("estop"), word("reset"), told("reset"), missed()], False, False),
    "one reported after that": ([word("estop"), word("reset"), missed(), told("reset")], False, False),
    "one that its cell needs no more": ([word("estop"), word("reset"), missed(), confirmed()], False, False),
    "one told of after that": ([word("estop"), word("reset"), confirmed(), missed()], False, False),
    "one of a cell with a stop of its own": ([told("estop"), word("reset"), missed(), confirmed()], False, True),
    "a reset that was missed, and another": ([word("reset"), missed(), word("reset")], False, False),
    "a stop said before its reset": ([word("reset"), word("estop", said_at=TIME)], False, False),
    "a stop said after its reset": ([word("reset"), word("estop", said_at="2999-01-01T00:00:00.000Z")], True, True),
    "a reset that only a cell tells of": ([word("estop"), told("", kind="human", op="reset")], True, True),
    "a reset of an invocation": ([told("estop"), told("reset", invocation="inv_1")], False, True),
    "a reset of what it never had": ([told("estop"), told("reset", stray="cell", session="inv_1")], False, True),
    "what only looks like it": ([told("x", detail={"what": "estop"}), word("x", of={"op": "estop"})], False, False),
}  # fmt: skip


@pytest.mark.parametrize("story", STORIES)
async def test_a_stop_stands_until_it_is_left(store: AuditStore, story: str) -> None:
    drafts, worded, latched = STORIES[story]
    for one in drafts:
        await store.append([one])
    found = (await store.ask(latches)).get(CELL, Latch())
    assert (found.worded, found.latched) == (worded, latched)


async def test_every_cell_has_a_stop_of_its_own_however_long_the_log(store: AuditStore) -> None:
    await store.append([word("estop"), draft("human", None, "olivia", op="estop")])
    for _ in range(3):
        await store.append([draft(n=n) for n in range(400)])
        await store.append([told("estop", cell=f"cell-{n % 7}") for n in range(400)])
    await store.append([told("reset", cell="cell-3")])
    found = await store.ask(latches)
    assert {cell for cell, latch in found.items() if latch.latched} == {
        CELL,
        *(f"cell-{n}" for n in (0, 1, 2, 4, 5, 6)),
    }


async def test_however_much_cells_say_of_stops_no_more_is_held_than_is_read_at_a_time(store: AuditStore) -> None:
    held: list[int] = []
    for count in (PAGE, 4 * PAGE):
        for _ in range(count):
            await store.append([told("estop", detail="x" * 50_000)])
        with closing(Reader(store.places.database)) as reader:
            latches(reader)
            tracemalloc.start()
            assert latches(reader)[CELL].latched
            held.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
    assert held[1] < 2 * held[0]


# -- reports -----------------------------------------------------------------------------------------------------------


def attached(journal: str | None, cell: str = CELL) -> EventDraft:
    return draft("cell", None, cell, **({} if journal is None else {"journal": journal}), link="attached")


def numbered(*numbers: int) -> list[EventDraft]:
    return [told("news", cell_seq=number) for number in numbers]


async def test_reports_count_in_the_journal_of_the_link_they_came_on(store: AuditStore) -> None:
    asked = ("a", "b", "c")
    assert await store.ask(lambda reader: reported(reader, CELL, asked)) == {"a": 0, "b": 0, "c": 0}
    await store.append([*numbered(1), attached("a"), *numbered(2, 3), attached("a"), *numbered(4)])
    await store.append(
        [attached("b"), *numbered(1, 2), attached("x", "other"), told("news", cell="other", cell_seq=90)]
    )
    await store.append([attached("a"), told("said", cell_seq=5, link="attached", journal="c"), attached("b")])
    await store.append([draft("proposal", actor=CELL, params={"cell_seq": 77})])
    assert await store.ask(lambda reader: reported(reader, CELL, asked)) == {"a": 5, "b": 2, "c": 0}


async def test_reports_without_any_link_are_of_whatever_journal_is_asked_for(store: AuditStore) -> None:
    await store.append(numbered(1, 2))
    assert await store.ask(lambda reader: reported(reader, CELL, ("a",))) == {"a": 2}


async def test_numbers_from_before_journals_had_names_go_on_in_the_first_named(store: AuditStore) -> None:
    await store.append([attached(None), *numbered(1, 2), attached("a"), attached("b"), *numbered(1)])
    found = await store.ask(lambda reader: reported(reader, CELL, ("", "a", "b")))
    assert found == {"": 1, "a": 2, "b": 1}


async def test_many_events_that_bear_a_number_elsewhere_hide_no_report(store: AuditStore) -> None:
    await store.append([attached("a"), *numbered(9)])
    await store.append([draft(actor=CELL, params={"cell_seq": n}) for n in range(1200)])
    assert await store.ask(lambda reader: reported(reader, CELL, ("a",))) == {"a": 9}


# -- rows --------------------------------------------------------------------------------------------------------------


def setting(name: str, value: object) -> RowWrite:
    content = value if isinstance(value, bytes) else orjson.dumps(value)
    return RowWrite(table="settings", values={"name": name, "value": content, "updated_at": TIME})


def progress(up_seq: int, journal: str = "a") -> RowWrite:
    values = {"cell": CELL, "up_seq": up_seq, "journal": journal, "updated_at": TIME}
    return RowWrite(table="cell_progress", values=values)


ESTOP = f"estop/{CELL}"
FORMER = f"journals/{CELL}"
ROWS: dict[str, tuple[list[RowWrite], str | None]] = {
    "as it is": ([setting(ESTOP, True), progress(2), setting(FORMER, {"b": 1})], None),
    "less than the log holds": ([setting(ESTOP, True), progress(1), setting(FORMER, {})], None),
    "not stopped": ([setting(ESTOP, False)], f"`{ESTOP}` in the table `settings`: its row says `false`"),
    "gone": ([], f"`{ESTOP}` in the table `settings`: its row is gone, by the log a stop is latched"),
    "not readable": ([setting(ESTOP, b"\xff")], "its row says `\ufffd`, by the log a stop is latched"),
    "another is stopped": ([setting(ESTOP, True), setting("estop/other", True)], "says `true`, by the log no stop"),
    "more reports": ([setting(ESTOP, True), progress(3)], "`3` are in the log, which holds them up to `2`"),
    "another journal": ([setting(ESTOP, True), progress(1, "z")], "`1` are in the log, which holds them up to `0`"),
    "more of a former one": ([setting(ESTOP, True), setting(FORMER, {"b": 2, "c": "x"})], "which holds them up to `1`"),
    "no former ones": ([setting(ESTOP, True), setting(FORMER, []), setting("shadow", {"b": 2})], None),
}  # fmt: skip


@pytest.mark.parametrize("stored", ROWS)
async def test_rows_about_cells_are_compared_with_the_log(store: AuditStore, data: Path, stored: str) -> None:
    rows, problem = ROWS[stored]
    reports = [attached("b"), *numbered(1), attached("a"), *numbered(1, 2)]
    await store.append([word("estop"), *reports], rows)
    found = await store.ask(lambda reader: cell_problems(reader, limit=10))
    assert len(found) == (problem is not None), found
    assert problem is None or problem in found[0]
    whole = (await store.examine()).state
    assert list(whole) == found


async def test_names_no_more_than_was_asked_for(store: AuditStore) -> None:
    await store.append([], [setting(f"estop/cell-{n}", True) for n in range(5)])
    assert len(await store.ask(lambda reader: cell_problems(reader, limit=3))) == 3


@pytest.mark.parametrize("before", [[setting(ESTOP, False)], []], ids=["another", "the first"])
async def test_a_row_that_changes_meanwhile_is_left_for_the_next_time(
    store: AuditStore, before: list[RowWrite]
) -> None:
    """A stop and its row are written together, between two looks of whoever compares."""
    later = {**setting(ESTOP, True).values, "updated_at": "2026-03-01T09:30:01.000Z"}

    class Overtaken(Reader):
        looks = 0

        def rows(self, table: str, filters: Any = None) -> list[Any]:
            found = super().rows(table, filters)
            if table == "settings":
                self.looks += 1
            return [later] if table == "settings" and self.looks == 2 else found

    await store.append([word("estop")], before)
    reader = Overtaken(store.places.database)
    try:
        assert cell_problems(reader, limit=10) == []
    finally:
        reader.close()
