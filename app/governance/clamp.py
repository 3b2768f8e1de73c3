"""The last word before the actuators: a command, held to the bounds of the session (design, section 4, step 6).

The clamp is governance code and runs on every command, whatever skill made it. It slows down along the commanded
direction, so that what was asked for is kept in kind and only its speed is lost; it never stops a movement that is
within bounds and never makes one. A command that is not finite says nothing at all, and the answer to nothing is to
hold.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from app.governance.model import Command

if TYPE_CHECKING:
    from app.governance.model import Bounds, Vec6

RESTING = (0.0, 0.0, 0.0)
STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
LARGEST_TURN_RADPS = 1.5


def hold(previous: Command) -> Command:
    """Return the command that stays where the previous one was: same joints, no speed, same grip."""
    return Command(previous.joint_rad, STILL, RESTING, previous.grip_force_n)


def clamp(
    command: Command, previous: Command, bounds: Bounds, jacobian: tuple[float, ...], period_s: float
) -> tuple[Command, bool]:
    """Return the command held to the bounds, and whether it had to be changed.

    What counts as arm speed is the larger of what the command says (`joint_speed_radps`) and what it does (the step
    from the previous joint targets over one period): a wrong feed forward cannot hide a jump, nor a jump a wrong feed
    forward.

    Args:
        command: What the skill asks for.
        previous: What was sent in the tick before.
        bounds: The effective limits of the session.
        jacobian: 3 × 6, row-major, d tcp / d joint, in the base frame.
        period_s: The control period.
    """
    joints, speeds, base, grip = command
    last = previous.joint_rad
    vx, vy, wz = base
    stepped, arm, total = STILL, 0.0, vx + vy + wz + grip
    if speeds != STILL or joints != last:  # NaN equals nothing, and what was sent before is finite
        total += sum(joints) + sum(speeds)
        stepped = _stepped(joints, last, 1.0 / period_s)
        arm = max(_excess(stepped, jacobian, bounds), _excess(speeds, jacobian, bounds))
    # One sum finds any NaN or infinity: it is finite only if every term is.
    if total - total != 0.0:
        return hold(previous), True
    drive = math.sqrt(vx * vx + vy * vy) / bounds.base_speed_mps
    turn = abs(wz) / LARGEST_TURN_RADPS
    if arm <= 1.0 and drive <= 1.0 and turn <= 1.0 and grip <= bounds.grip_force_n:
        return command, False
    if not arm <= 1.0:
        slower = 1.0 / arm if arm < math.inf else 0.0
        (l1, l2, l3, l4, l5, l6), q = last, period_s * slower
        s1, s2, s3, s4, s5, s6 = stepped
        joints = (l1 + s1 * q, l2 + s2 * q, l3 + s3 * q, l4 + s4 * q, l5 + s5 * q, l6 + s6 * q)
        u, v, w, x, y, z = speeds
        speeds = (u * slower, v * slower, w * slower, x * slower, y * slower, z * slower)
    worst = max(drive, turn)
    if worst > 1.0:
        base = (vx / worst, vy / worst, wz / worst)
    return Command(joints, speeds, base, min(grip, bounds.grip_force_n)), True


def _stepped(joints: Vec6, last: Vec6, rate: float) -> Vec6:
    """Return the joint speeds that a step from the last targets amounts to."""
    a, b, c, d, e, f = joints
    g, h, i, j, k, m = last
    return (a - g) * rate, (b - h) * rate, (c - i) * rate, (d - j) * rate, (e - k) * rate, (f - m) * rate


def _excess(speeds: tuple[float, ...], jacobian: tuple[float, ...], bounds: Bounds) -> float:
    """Return by what factor joint speeds exceed the TCP or joint speed bound; infinite where that cannot be told."""
    u, v, w, x, y, z = speeds
    fastest = max(u, v, w, x, y, z, -u, -v, -w, -x, -y, -z)
    j0, j1, j2, j3, j4, j5, k0, k1, k2, k3, k4, k5, l0, l1, l2, l3, l4, l5 = jacobian
    tx = j0 * u + j1 * v + j2 * w + j3 * x + j4 * y + j5 * z
    ty = k0 * u + k1 * v + k2 * w + k3 * x + k4 * y + k5 * z
    tz = l0 * u + l1 * v + l2 * w + l3 * x + l4 * y + l5 * z
    tcp = math.sqrt(tx * tx + ty * ty + tz * tz) / bounds.tcp_speed_mps
    if tcp != tcp:
        return math.inf
    joint = fastest / bounds.joint_speed_radps
    return tcp if tcp > joint else joint
