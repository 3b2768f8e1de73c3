"""The rows of telemetry, by the names of their channels."""

from __future__ import annotations

from math import inf

import pytest

from app.cell import telling
from app.governance.model import Wish
from app.governance.signals import SHOWN, Signals
from app.protocol import CHANNELS, HAND, ROW, SENSED, SENSED_PART
from tests.governance.test_watcher import seen


def test_a_row_holds_every_channel_in_its_place() -> None:
    signals = Signals(*(1.0 + place for place in range(len(Signals._fields))))
    one = seen(
        7,
        tcp_m=(0.1, 0.2, 0.3),
        tcp_speed_mps=0.4,
        joint_rad=(1.1, 1.2, 1.3, 1.4, 1.5, 1.6),
        peak_force_n=50.0,
        grip_width_m=0.05,
        grip_force_n=60.0,
    )
    row = dict(zip(SENSED, SENSED_PART.unpack(telling.row(one, tuple(signals), 0.25, 0.75, 0.45)), strict=True))
    said = {
        **{name: value for name, value in one._asdict().items() if name in SENSED},
        **dict(zip(("tcp_x_m", "tcp_y_m", "tcp_z_m"), one.tcp_m, strict=True)),
        **{f"q{joint}_rad": angle for joint, angle in enumerate(one.joint_rad, 1)},
        **{name: value for name, value in signals._asdict().items() if name in SHOWN and name in SENSED},
        "tcp_speed_mps": one.tcp_speed_mps,
        "progress": 0.25,
        "rate": 0.75,
        "base_radius_m": 0.45,
    }
    assert row == pytest.approx(said)


def test_a_row_ends_with_what_a_hand_asks_for_whatever_anybody_sends() -> None:
    asked = Wish(base=(0.1, -0.2, 1e300), tool=(0.03, 0.02, 0.01), grip="close")
    row = telling.row(seen(7), tuple(Signals()), 0.0, 1.0, 0.45) + telling.hand(asked, counts=True)
    said = dict(zip(CHANNELS, ROW.unpack(row), strict=True))
    assert [said[name] for name in HAND] == pytest.approx([0.1, -0.2, inf, 0.03, 0.02, 0.01, -1.0, 1.0])
    assert telling.hand(Wish(), counts=False) == telling.NO_HAND
