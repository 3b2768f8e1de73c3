"""What the robot knows of its own body.

Forward and inverse kinematics (mink), Jacobian, expected torques and the residual.

The model is the robot's nominal one; the base is at the origin, so everything comes out relative to the base.
"""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING, NamedTuple

import mink
import mujoco
import numpy as np

from app.governance.model import CONTROL_PERIOD_S
from app.sim import robot

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_RESIDUAL_GAIN_HZ = 12.0
_IK_STEPS, _IK_POSITION_M, _IK_ANGLE_RAD = 12, 4e-4, 4e-3


class ToolPose(NamedTuple):
    """A pose of the tool relative to the base: the tool points down, the fingers open along y turned by `yaw_rad`."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float


class SelfModel:
    """The robot's model of itself, for what it measures every tick."""

    def __init__(self) -> None:
        """Compile the nominal robot."""
        self._model = robot.robot_model(mobile=True)
        self._data = mujoco.MjData(self._model)
        self._tcp = int(self._model.site(robot.TCP_SITE).id)
        self._jacp = np.zeros((3, self._model.nv))

    def update(
        self, joint_rad: Floats, speed: Floats, acceleration: Floats, base_velocity: Floats, base_acceleration: Floats
    ) -> Floats:
        """Take the measured motion and return the joint torques it needs (one inverse dynamics call)."""
        data = self._data
        data.qpos[3:9] = joint_rad
        data.qvel[0:3], data.qvel[3:9] = base_velocity, speed
        data.qacc[0:3], data.qacc[3:9] = base_acceleration, acceleration
        mujoco.mj_inverse(self._model, data)
        return data.qfrc_inverse[3:9]

    def tcp(self) -> tuple[Floats, Floats]:
        """Return the tool centre point (3) and its Jacobian (3 × 6) at the last update, relative to the base."""
        mujoco.mj_jacSite(self._model, self._data, self._jacp, None, self._tcp)
        return self._data.site_xpos[self._tcp], self._jacp[:, 3:9]

    def tcp_speed(self, joint_rad: Floats, speed: Floats) -> float:
        """Return the speed of the tool relative to the base for exact joint angles and speeds (evaluation)."""
        self.update(joint_rad, speed, np.zeros(6), np.zeros(3), np.zeros(3))
        return float(np.linalg.norm(self.tcp()[1] @ speed))


class Residual:
    """Momentum residual: the torque that the nominal model does not explain.

    First-order filtered (De Luca's observer, discrete).
    """

    def __init__(self) -> None:
        """Start from zero."""
        self.value = np.zeros(6)
        self._zero = np.zeros(6)
        self._speed: Floats | None = None
        self._base = np.zeros(3)

    def accelerations(self, speed: Floats, base_velocity: Floats) -> tuple[Floats, Floats]:
        """Return joint and base accelerations from one tick to the next."""
        before = speed if self._speed is None else self._speed
        joint, base = (speed - before) / CONTROL_PERIOD_S, (base_velocity - self._base) / CONTROL_PERIOD_S
        self._speed, self._base = speed.copy(), base_velocity.copy()
        return joint, base

    def update(self, expected: Floats, measured: Floats) -> Floats:
        """Return the residual after one more tick."""
        self.value += _RESIDUAL_GAIN_HZ * CONTROL_PERIOD_S * (expected - measured - self.value)
        return self.value - self._zero

    def zero(self) -> None:
        """Take what is unexplained now as the load (after lifting, after letting go)."""
        self._zero = self.value.copy()


class ArmSolver:
    """Differential inverse kinematics over the arm alone (mink with daqp), from a seed, step by step."""

    def __init__(self) -> None:
        """Compile the arm and prepare the task and its limits."""
        self._model = robot.robot_model(mobile=False)
        self._configuration = mink.Configuration(self._model)
        self._task = mink.FrameTask(robot.TCP_SITE, "site", position_cost=1.0, orientation_cost=0.3)
        self._limits = [mink.ConfigurationLimit(self._model)]
        self._tcp = int(self._model.site(robot.TCP_SITE).id)

    def forward(self, joint_rad: Floats) -> ToolPose:
        """Return where the tool is for these joint angles."""
        self._configuration.update(np.asarray(joint_rad, dtype=np.float64))
        at, matrix = self._configuration.data.site_xpos[self._tcp], self._configuration.data.site_xmat[self._tcp]
        return ToolPose(float(at[0]), float(at[1]), float(at[2]), float(np.arctan2(-matrix[1], matrix[4])))

    def solve(self, seed_rad: Floats, pose: ToolPose) -> Floats | None:
        """Return joint angles that reach the pose from the seed, or None where the arm does not get there."""
        configuration, task = self._configuration, self._task
        configuration.update(np.asarray(seed_rad, dtype=np.float64))
        task.set_target(_target(pose))
        for _ in range(_IK_STEPS):
            error = task.compute_error(configuration)
            if np.abs(error[:3]).max() < _IK_POSITION_M and np.abs(error[3:]).max() < _IK_ANGLE_RAD:
                return configuration.q.copy()
            velocity = mink.solve_ik(configuration, [task], 1.0, "daqp", damping=1e-4, limits=self._limits)
            configuration.integrate_inplace(np.clip(velocity, -0.4, 0.4), 1.0)
        return None


def _target(pose: ToolPose) -> mink.SE3:
    c, s = cos(pose.yaw_rad), sin(pose.yaw_rad)
    rotation = mink.SO3.from_matrix(np.array(((-c, -s, 0.0), (-s, c, 0.0), (0.0, 0.0, -1.0))))
    return mink.SE3.from_rotation_and_translation(rotation, np.array((pose.x_m, pose.y_m, pose.z_m)))
