"""Which ticks of a session telemetry keeps."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.cell.series import Series
from app.protocol import ROW
from tests.cell.rig import PLAN, Rig, replace

PERIOD_S = 0.01
AROUND = 100


def kept(ticks: int, alerts: set[int], *, keep_every_tick: bool) -> list[int]:
    series = Series(PERIOD_S, keep_every_tick=keep_every_tick)
    for tick in range(ticks):
        series.add(struct.pack("<I", tick), alerted=tick in alerts)
    series.close()
    return [number for (number,) in struct.iter_unpack("<I", series.ready)]


@given(st.integers(0, 900), st.sets(st.integers(0, 899), max_size=4))
def test_keeps_each_fifth_tick_the_last_and_all_within_a_second_of_an_alert(ticks: int, alerts: set[int]) -> None:
    wanted = [
        tick
        for tick in range(ticks)
        if tick % 5 == 0 or tick == ticks - 1 or any(abs(tick - at) <= AROUND for at in alerts if at < ticks)
    ]
    assert kept(ticks, alerts, keep_every_tick=False) == wanted


@given(st.integers(0, 400), st.sets(st.integers(0, 399), max_size=3))
def test_keeps_every_tick_where_the_profile_says_so(ticks: int, alerts: set[int]) -> None:
    assert kept(ticks, alerts, keep_every_tick=True) == list(range(ticks))


def test_no_row_waits_longer_than_a_second() -> None:
    series = Series(PERIOD_S, keep_every_tick=False)
    for tick in range(1000):
        series.add(b"x", alerted=False)
        assert len(series.ready) >= (tick - AROUND) / 5


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path, plan=replace(PLAN, keep_every_tick=False))
    yield made
    made.journal.close()


def test_a_session_without_alerts_is_told_by_a_fifth_of_its_ticks(rig: Rig) -> None:
    rig.launch()
    ticks = rig.finish()["ticks"]
    assert isinstance(ticks, int)
    last_is_extra = (ticks - 1) % 5 != 0
    assert len(rig.telemetry) / ROW.size == len(range(0, ticks, 5)) + last_is_extra


def test_every_tick_around_an_alert_is_told(rig: Rig) -> None:
    rig.cell.script.ticks = 200.0
    rig.cell.lie = lambda seen: seen._replace(tcp_speed_mps=0.6) if seen.tick == 110 else seen
    rig.launch()
    rig.finish()
    assert next(body["rule"] for body in rig.of("alert")) == "tcp_speed_mps"
    ticks = [round(row[0] / PERIOD_S) for row in ROW.iter_unpack(bytes(rig.telemetry))]
    assert set(range(10, 211)) <= set(ticks)
    assert [tick for tick in ticks if tick < 10] == [1, 6]
    assert {later - earlier for earlier, later in pairwise(ticks) if earlier >= 212} >= {5}
    assert ticks == sorted(set(ticks))
