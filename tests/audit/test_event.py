"""Canonical bytes of events."""

from __future__ import annotations

import json
from types import MappingProxyType
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.audit.errors import EventMalformed, EventUnreadable
from app.audit.event import MAX_BODY_BYTES, Event, EventDraft, prepare, prepare_all, read_columns
from app.audit.tables import events
from app.governance.model import Reason, Status
from tests.audit.conftest import TIME, draft

texts = st.text(st.characters(codec="utf-8"), max_size=10)
values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | texts,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=12,
)
mappings = st.dictionaries(texts, values, max_size=5)


@given(mappings)
def test_body_holds_everything_and_decodes_to_what_was_given(body: dict[str, Any]) -> None:
    event = prepare(draft(**{"nested": body}), TIME).seal(7)
    assert read_columns(event.body) == event
    assert event.payload() == {"nested": body}
    assert json.loads(event.body).keys() == {"actor", "at", "body", "invocation", "kind", "seq"}


@given(mappings)
def test_bytes_do_not_depend_on_the_order_of_keys(body: dict[str, Any]) -> None:
    backwards = dict(reversed(body.items()))
    assert prepare(draft(nested=body), TIME).seal(1).body == prepare(draft(nested=backwards), TIME).seal(1).body


def test_keys_are_sorted_at_every_level() -> None:
    body = prepare(draft(kind="alert", b=1, a={"d": 1, "c": 2}), TIME).seal(3).body
    assert body == (
        b'{"actor":"planner","at":"2026-03-01T09:30:00.000Z","body":{"a":{"c":2,"d":1},"b":1},'
        b'"invocation":"inv_1","kind":"alert","seq":3}'
    )


def test_says_governance_s_types_as_json_does() -> None:
    event = prepare(
        draft(
            reason=Reason("rule", "limit", "message"),
            status=Status.RUNNING,
            params=MappingProxyType({"b": 1, Status.PAUSED: 2}),
            counts={Status.RUNNING: 3, "b": 1},
            ids=frozenset({"b", "a"}),
            gap=float("nan"),
        ),
        TIME,
    ).seal(1)
    assert event.payload() == {
        "reason": {"rule": "rule", "code": "limit", "message": "message", "remedy": ""},
        "status": "running",
        "params": {"b": 1, "paused": 2},
        "counts": {"b": 1, "running": 3},
        "ids": ["a", "b"],
        "gap": None,
    }


@pytest.mark.parametrize("body", [b'{"cut":', b"\xff\x00", b"[]", b"{}", b"null", b'{"body":5}'])
def test_a_damaged_event_is_named_and_what_it_holds_kept_back(body: bytes) -> None:
    with pytest.raises(EventUnreadable, match=r"^event `7` cannot be read: its bytes are no event$"):
        Event(7, TIME, "launch", None, "kernel", body).payload()


def test_a_draft_changed_after_it_was_handed_over_is_recorded_as_it_was() -> None:
    body = {"force_n": 60}
    prepared = prepare(EventDraft(kind="policy", actor="kernel", body=body), TIME)
    body["force_n"] = 600
    assert prepared.seal(1).payload() == {"force_n": 60}


@pytest.mark.parametrize("value", [2**64, "\ud800", {(1,): 2}, object(), b"raw", "x" * (MAX_BODY_BYTES + 1)])
def test_refuses_what_json_cannot_say(value: object) -> None:
    with pytest.raises(EventMalformed, match="`proposal`"):
        prepare(draft(value=value), TIME)


def test_refuses_columns_that_are_no_text() -> None:
    with pytest.raises(EventMalformed):
        prepare_all([draft(), draft(actor="\udc00")], TIME)


def test_refuses_a_body_that_is_no_mapping() -> None:
    with pytest.raises(EventMalformed, match="no mapping"):
        prepare(EventDraft(kind="alert", actor="cell", body=["a"]), TIME)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("body", [b"[]", b"{}", b'{"seq":"1"}', b"\xff", b""])
def test_bytes_that_are_no_event_are_not_read_as_one(body: bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011  # what JSON and we say differs, the class does not
        read_columns(body)


def test_an_event_is_its_columns() -> None:
    event = prepare(draft(invocation=None), TIME).seal(2)
    assert event == Event(2, TIME, "proposal", None, "planner", event.body)


def test_an_events_fields_stand_in_the_order_of_its_columns() -> None:
    assert Event._fields == tuple(events.c.keys())
