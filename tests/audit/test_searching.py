"""Which events hold a word, and how far one look at the log goes."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.audit import searching
from app.audit.errors import EventUnreadable, RecordDamaged
from app.audit.event import Event, EventDraft, prepare
from app.audit.searching import Found, Words, search, texts_of
from app.audit.store import AuditStore
from tests.audit.conftest import TIME, draft

BODY: dict[str, Any] = {
    "reasons": [{"rule": "human-shared/tcp_speed_mps", "code": "limit", "message": "at most 0.25 m/s here"}],
    "params": {"object_id": "Mug_1", "speed_mps": 0.25, "careful": True, "near": None},
    "note": 'Straße "Süd", back\\slash',
}


def recorded(body: dict[str, Any], seq: int = 7) -> Event:
    return prepare(EventDraft(kind="policy", actor="planner", invocation="inv_01AB", body=body), TIME).seal(seq)


@pytest.mark.parametrize(
    "text",
    [
        "human-shared/tcp", "MUG_1", "limit  mug_1", "object_id", "0.25", "true", "planner", "policy", "inv_01ab",
        "STRASSE", "süd", '"SÜD"', "back\\slash", "most 0.25 here",
    ],
)  # fmt: skip
def test_an_event_holds_words_of_its_texts_in_whatever_case(text: str) -> None:
    assert Words(text).held_by(recorded(BODY))


@pytest.mark.parametrize(
    "text",
    [
        "mug_2", "limit mug_2", "null", "body", "seq", "2026-03-01", '"limit"', '":', "{", "\udcff", "u0022",
    ],
)  # fmt: skip
def test_an_event_does_not_hold_what_only_stands_between_its_texts(text: str) -> None:
    assert not Words(text).held_by(recorded(BODY))


DOCUMENTS = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False, width=32) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@given(body=st.dictionaries(st.text(), DOCUMENTS, max_size=3), data=st.data())
def test_whatever_part_of_a_text_is_looked_for_is_found(body: dict[str, Any], data: st.DataObject) -> None:
    event = recorded(body)
    texts = [text for text in texts_of(event.payload()) if text.split()]
    if texts:
        text = data.draw(st.sampled_from(texts))
        start = data.draw(st.integers(0, len(text) - 1))
        part = text[start : data.draw(st.integers(start + 1, len(text)))]
        assert Words(part.upper() if part.upper().casefold() == part.casefold() else part).held_by(event)


@pytest.mark.parametrize("body", [b'{"body":', b'{"body":[]}', b'{"body":{"x":"\xff"}}', '{"body":{}}'])
def test_what_cannot_be_read_is_not_passed_over(body: Any) -> None:
    with pytest.raises(EventUnreadable, match="`7`"):
        Words("x").held_by(recorded({})._replace(body=body))


class Log:
    """A log of numbered events, of which it says when it was read."""

    def __init__(self, size: int, marked: set[int]) -> None:
        self.events = [recorded({"n": n, "mark": "here" if n in marked else ""}, n) for n in range(1, size + 1)]
        self.asked: list[int] = []

    def read(self, *, after: int, before: int | None, newest: bool, limit: int) -> list[Event]:
        self.asked.append(limit)
        found = [event for event in self.events if after < event.seq < (before or len(self.events) + 1)]
        return (found[::-1] if newest else found)[:limit]


def told(found: Found) -> tuple[list[int], int, int | None, bool]:
    return [event.seq for event in found.events], found.looked, found.last and found.last.seq, found.more


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(searching, "SLICE", 3)
    monkeypatch.setattr(searching, "MOST", 10)


HERE = Words("HERE")


@pytest.mark.usefixtures("small")
def test_one_look_ends_where_enough_is_found_or_looked_at_and_says_whether_there_is_more() -> None:
    log = Log(20, {2, 4, 5, 20})
    assert told(search(log.read, HERE, limit=2)) == ([2, 4], 4, 4, True)
    assert told(search(log.read, HERE, after=4)) == ([5], 10, 14, True)
    assert told(search(log.read, HERE, after=14)) == ([20], 6, 20, False)
    assert told(search(log.read, HERE, newest=True)) == ([20], 10, 11, True)
    assert told(search(log.read, HERE, newest=True, before=11, limit=3)) == ([5, 4, 2], 9, 2, True)
    assert told(search(log.read, HERE, newest=True, before=2)) == ([], 1, 1, False)
    assert told(search(log.read, HERE, after=19, limit=1)) == ([20], 1, 20, False)
    assert told(search(log.read, HERE, after=20)) == ([], 0, None, False)
    assert max(log.asked) == 3


@pytest.mark.usefixtures("small")
def test_one_look_ends_where_what_was_found_fills_a_page(monkeypatch: pytest.MonkeyPatch) -> None:
    log = Log(20, {2, 4, 5, 20})
    monkeypatch.setattr(searching, "MAX_PAGE_BYTES", len(log.events[1].body) + 1)
    assert told(search(log.read, HERE)) == ([2, 4], 4, 4, True)
    assert told(search(log.read, HERE, after=4)) == ([5], 10, 14, True)
    assert told(search(log.read, HERE, after=14)) == ([20], 6, 20, False)


@pytest.mark.usefixtures("small")
def test_one_look_ends_when_its_time_is_over_and_not_before_it_has_looked_at_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(searching, "WITHIN_S", 0.0)
    assert told(search(Log(20, set()).read, HERE)) == ([], 3, 3, True)


@pytest.mark.anyio
async def test_a_search_keeps_no_other_reader_waiting(store: AuditStore, monkeypatch: pytest.MonkeyPatch) -> None:
    await store.append([draft(mark="here"), draft()])
    looks, goes_on = threading.Event(), threading.Event()

    def look(*given: Any, **named: Any) -> Found:
        looks.set()
        assert goes_on.wait(10)
        return search(*given, **named)

    monkeypatch.setattr("app.audit.store.search", look)
    searched = asyncio.ensure_future(store.search(HERE, kind="proposal", newest=True))
    assert await asyncio.to_thread(looks.wait, 10)
    assert [event.seq for event in await store.events()] == [1, 2]
    goes_on.set()
    assert told(await searched) == ([1], 2, 1, False)


@pytest.mark.anyio
async def test_a_search_that_meets_a_damaged_event_says_so(store: AuditStore, monkeypatch: pytest.MonkeyPatch) -> None:
    def unreadable(event: Event) -> None:
        raise EventUnreadable(event.seq)

    await store.append([draft()])
    monkeypatch.setattr(Event, "payload", unreadable)
    with pytest.raises(RecordDamaged, match="`1`"):
        await store.search(HERE)
    assert store.damage is not None
