"""Times as texts."""

from __future__ import annotations

import re
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.clock import monotonic_s, parse_rfc3339, rfc3339, wall_s

milliseconds = st.integers(0, 4_102_444_800_000)  # 1970 to 2100, where floats hold a millisecond well


@given(milliseconds)
def test_what_was_written_reads_back_to_the_millisecond(ms: int) -> None:
    text = rfc3339(ms / 1000)
    assert len(text) == 24
    assert parse_rfc3339(text) == pytest.approx(ms / 1000, abs=0.001)
    assert rfc3339(parse_rfc3339(text)) == text


@given(milliseconds, milliseconds)
def test_texts_sort_like_times(first: int, second: int) -> None:
    if first < second:
        assert rfc3339(first / 1000) <= rfc3339(second / 1000)


@given(st.floats(min_value=-6e10, max_value=2.5e11))
def test_a_written_time_is_what_the_calendar_says_cut_to_the_millisecond(seconds: float) -> None:
    calendar = datetime.fromtimestamp(seconds, tz=UTC).isoformat(timespec="milliseconds")
    assert rfc3339(seconds) == calendar.replace("+00:00", "Z")


def test_reads_any_offset() -> None:
    assert parse_rfc3339("2026-03-01T10:30:00+01:00") == parse_rfc3339("2026-03-01T09:30:00.000Z")
    assert parse_rfc3339("2026-03-01t09:30:00.250z") == parse_rfc3339("2026-03-01T09:30:00.250Z")  # RFC 3339, 5.6
    assert rfc3339(0) == "1970-01-01T00:00:00.000Z"


def test_reads_the_last_moment_of_the_calendar_cut_to_the_millisecond() -> None:
    last = rfc3339(parse_rfc3339("9999-12-31T23:59:59.999999Z"))
    assert last.startswith("9999-12-31T23:59:59.99"), "so far from 1970 a float holds no whole millisecond"


@pytest.mark.parametrize("text", ["9999-12-31T23:59:59-00:01", "0001-01-01T00:00:00+00:01"])
def test_refuses_in_words_a_time_that_its_offset_puts_outside_the_calendar(text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"`{text}` lies outside the years 1 to 9999 in UTC")):
        parse_rfc3339(text)


@pytest.mark.parametrize(
    "text",
    ["2026-W48-4T00:00:00Z", "2026-330T00:00:00Z", "20261126T000000Z", "2026-11-26T00Z", "2026-11-26T00:00:00+0100"],
)
def test_refuses_what_iso_8601_has_besides(text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"`{text}` is no RFC 3339 time")):
        parse_rfc3339(text)


@pytest.mark.parametrize("text", ["", "yesterday", "2026-03-01T09:30:00", "2026-13-01T00:00:00Z"])
def test_refuses_what_is_no_time_anywhere(text: str) -> None:
    with pytest.raises(ValueError, match="valid is"):
        parse_rfc3339(text)


@pytest.mark.parametrize("seconds", [float("nan"), float("inf"), 1e300, -1e12])
def test_refuses_a_time_outside_the_calendar(seconds: float) -> None:
    with pytest.raises(ValueError, match="valid are"):
        rfc3339(seconds)


def test_clocks_move_forward() -> None:
    assert wall_s() > parse_rfc3339("2025-01-01T00:00:00Z")
    assert monotonic_s() <= monotonic_s()
