"""What consoles are shown of what is too long for them."""

from __future__ import annotations

from typing import Any

import orjson
import pytest

from app.audit.event import EventDraft, prepare
from app.runtime.shortened import LONG_BYTES, MOST_NAMED, shortened, shown_event

AT = "2026-03-01T09:30:00.250Z"


def event(**body: Any) -> Any:
    return prepare(EventDraft(kind="proposal", actor="planner", invocation="inv-1", body=body), AT).seal(7)


def test_an_event_of_the_usual_length_is_shown_in_the_bytes_that_were_hashed() -> None:
    usual = event(capability="grasp_object", params={"object_id": "mug_1"})
    assert shown_event(usual) is usual


def test_of_a_long_event_the_longest_parts_are_empty_and_named() -> None:
    short = {"capability": "grasp_object", "seen": 4, "mode": None, "params": {"object_id": "x" * 100}}
    shown = shown_event(event(**short, metadata={"goal": "x" * 6_000}, preconditions=["y" * 5_000]))
    record = orjson.loads(shown.body)
    assert len(shown.body) <= LONG_BYTES
    assert record["body"] == {**short, "metadata": {}, "preconditions": ["y" * 5_000], "left_out": ["metadata"]}
    assert (record["seq"], record["actor"], shown.seq) == (7, "planner", 7)


@pytest.mark.parametrize("parts", [None, {"params"}])
def test_what_holds_many_long_parts_is_short_and_names_some_of_them(parts: set[str] | None) -> None:
    document = {"params": {"x": "x" * LONG_BYTES}, **{f"part_{number}": ["x" * 500] for number in range(100)}}
    shown = shortened(document, parts)
    assert shown["params"] == {}
    assert shown["left_out"][0] == "params"
    if parts is None:
        assert len(orjson.dumps(shown)) < 2 * LONG_BYTES
        assert len(shown["left_out"]) == MOST_NAMED
    else:
        assert shown == {**document, "params": {}, "left_out": ["params"]}
