"""What the robot's model of itself says of its tool."""

from __future__ import annotations

import numpy as np
import pytest

from app.sim.kinematics import SelfModel, speed_of
from app.sim.robot import HOME_RAD


def test_the_exact_speed_of_the_tool_is_that_of_the_posture_asked_about_whatever_was_before() -> None:
    speed = np.array([0.3, -0.2, 0.1, 0.4, -0.5, 0.6])
    asked, elsewhere = np.array(HOME_RAD) + 0.2, np.array(HOME_RAD) - 0.3
    whole, quick = SelfModel(), SelfModel()
    whole.update(asked.tolist(), [0.0] * 9, [0.0] * 9)
    quick.update(elsewhere.tolist(), [0.0] * 9, [0.0] * 9)
    wanted = speed_of(whole.tcp()[1], speed.tolist())
    assert wanted > 0.1
    assert quick.tcp_speed(asked, speed) == pytest.approx(wanted, abs=1e-12)
