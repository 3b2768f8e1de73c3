"""What the robot knows of its own body.

Forward and inverse kinematics (mink), Jacobian, expected torques and the residual.

The model is the robot's nominal one; the base is at the origin, so everything comes out relative to the base.
"""

from __future__ import annotations

from math import atan2, cos, sin, sqrt
from operator import mul, sub
from typing import TYPE_CHECKING, NamedTuple

import mink
import mujoco
import numpy as np

from app.governance.model import CONTROL_PERIOD_S
from app.sim import robot

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_RESIDUAL_GAIN_HZ = 12.0
_IK_STEPS, _IK_POSITION_M, _IK_ANGLE_RAD, _IK_DAMPING = 12, 4e-4, 4e-3, 1e-4


class ToolPose(NamedTuple):
    """A pose of the tool relative to the base: the tool points down, the fingers open along y turned by `yaw_rad`."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float


class SelfModel:
    """The robot's model of itself, for what it measures every tick."""

    def __init__(self, mjcf: Path | None = None) -> None:
        """Compile the nominal robot: the project's own, or the one of an MJCF file."""
        self._model = robot.robot_model(mobile=True, mjcf=mjcf)
        self._data = mujoco.MjData(self._model)
        self._tcp = int(self._model.site(robot.TCP_SITE).id)
        self._jacp = np.zeros((3, self._model.nv))
        # Views once, not per tick: every access to a field of `MjData` makes a new array object.
        data = self._data
        self._joint, self._velocity, self._acceleration = data.qpos[3:9], data.qvel, data.qacc
        self._torque, self._tcp_at, self._jacobian = (
            data.qfrc_inverse[3:9],
            data.site_xpos[self._tcp],
            self._jacp[:, 3:9],
        )

    def update(
        self,
        joint_rad: Sequence[float],
        velocity: Sequence[float],
        acceleration: Sequence[float],
    ) -> list[float]:
        """Take the measured motion and return the joint torques it needs (one inverse dynamics call).

        Args:
            joint_rad: the six joint angles.
            velocity: of the base (vx, vy, wz), then of the six joints.
            acceleration: the same nine.
        """
        self._joint[:] = joint_rad
        self._velocity[:] = velocity
        self._acceleration[:] = acceleration
        mujoco.mj_inverse(self._model, self._data)
        return self._torque.tolist()

    def tcp(self) -> tuple[list[float], list[list[float]]]:
        """Return the tool centre point (3) and its Jacobian (3 × 6) at the last update, relative to the base."""
        mujoco.mj_jacSite(self._model, self._data, self._jacp, None, self._tcp)
        return self._tcp_at.tolist(), self._jacobian.tolist()

    def tcp_speed(self, joint_rad: Floats, speed: Floats) -> float:
        """Return the speed of the tool relative to the base for exact joint angles and speeds (evaluation)."""
        self._joint[:] = joint_rad
        mujoco.mj_kinematics(self._model, self._data)  # all that the Jacobian goes by
        mujoco.mj_comPos(self._model, self._data)
        return speed_of(self.tcp()[1], speed.tolist())


def speed_of(jacobian: Sequence[Sequence[float]], joint_speed: Sequence[float]) -> float:
    """Return the magnitude of what a 3 × 6 Jacobian makes of six joint speeds."""
    x, y, z = (sum(map(mul, row, joint_speed)) for row in jacobian)
    return sqrt(x * x + y * y + z * z)


class Residual:
    """Momentum residual: the torque that the nominal model does not explain.

    First-order filtered (De Luca's observer, discrete).
    """

    def __init__(self) -> None:
        """Start from zero."""
        self.value = self._zero = [0.0] * 6
        self._velocity: list[float] | None = None

    def accelerations(self, velocity: list[float]) -> list[float]:
        """Return the accelerations of base (3) and joints (6) from one tick to the next."""
        before = [0.0, 0.0, 0.0, *velocity[3:]] if self._velocity is None else self._velocity
        self._velocity = velocity
        return [(now - then) / CONTROL_PERIOD_S for now, then in zip(velocity, before, strict=True)]

    def update(self, expected: Sequence[float], measured: Sequence[float]) -> tuple[float, ...]:
        """Return the residual after one more tick."""
        gain = _RESIDUAL_GAIN_HZ * CONTROL_PERIOD_S
        self.value = [v + gain * (e - m - v) for v, e, m in zip(self.value, expected, measured, strict=True)]
        return tuple(map(sub, self.value, self._zero))

    def zero(self) -> None:
        """Take what is unexplained now as the load (after lifting, after letting go)."""
        self._zero = self.value


class ArmSolver:
    """Differential inverse kinematics over the arm alone (mink with daqp), from a seed, step by step.

    A step minimises mink's quadratic objective within the joint limits. Where the free minimum lies within them it is
    that step, and six linear equations give it; the quadratic program is solved only where a limit is in the way.
    """

    def __init__(self, mjcf: Path | None = None) -> None:
        """Compile the arm, the project's own or the one of an MJCF file; prepare the task and its limits."""
        self._model = robot.robot_model(mobile=False, mjcf=mjcf)
        self._configuration = mink.Configuration(self._model)
        self._task = mink.FrameTask(robot.TCP_SITE, "site", position_cost=1.0, orientation_cost=0.3)
        limit = mink.ConfigurationLimit(self._model)
        self._limits, self._lower, self._upper, self._limit_gain = [limit], limit.lower, limit.upper, limit.gain
        self._damping = _IK_DAMPING * np.eye(self._model.nv)
        self._weight = self._task.cost[:, None]
        data, tcp = self._configuration.data, int(self._model.site(robot.TCP_SITE).id)
        self._tcp_at, self._tcp_turn = data.site_xpos[tcp], data.site_xmat[tcp]

    def forward(self, joint_rad: Floats) -> ToolPose:
        """Return where the tool is for these joint angles."""
        self._configuration.update(np.asarray(joint_rad, dtype=np.float64))
        (x, y, z), matrix = self._tcp_at.tolist(), self._tcp_turn.tolist()
        return ToolPose(x, y, z, atan2(-matrix[1], matrix[4]))

    def solve(self, seed_rad: Floats, pose: ToolPose, within_m: float = _IK_POSITION_M) -> Floats | None:
        """Return joint angles that reach the pose from the seed, or None where the arm does not get there."""
        configuration, task = self._configuration, self._task
        configuration.update(np.asarray(seed_rad, dtype=np.float64))
        task.set_target(_target(pose))
        for _ in range(_IK_STEPS):
            error = task.compute_error(configuration)
            if np.abs(error[:3]).max() < within_m and np.abs(error[3:]).max() < _IK_ANGLE_RAD:
                return configuration.q.copy()
            configuration.integrate_inplace(np.clip(self._step(error), -0.4, 0.4), 1.0)
        return None

    def _step(self, error: Floats) -> NDArray[np.floating]:
        """Return the change of the joints that the objective and the limits ask for."""
        configuration, task = self._configuration, self._task
        weighted = self._weight * task.compute_jacobian(configuration)
        step = np.linalg.solve(weighted.T @ weighted + self._damping, -task.gain * (task.cost * error) @ weighted)
        here, share = configuration.data.qpos, self._limit_gain
        if np.all(step <= share * (self._upper - here)) and np.all(step >= share * (self._lower - here)):
            return step
        return mink.solve_ik(configuration, [task], 1.0, "daqp", damping=_IK_DAMPING, limits=self._limits)


def _target(pose: ToolPose) -> mink.SE3:
    c, s = cos(pose.yaw_rad), sin(pose.yaw_rad)
    rotation = mink.SO3.from_matrix(np.array(((-c, -s, 0.0), (-s, c, 0.0), (0.0, 0.0, -1.0))))
    return mink.SE3.from_rotation_and_translation(rotation, np.array((pose.x_m, pose.y_m, pose.z_m)))
