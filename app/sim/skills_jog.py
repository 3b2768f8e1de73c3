"""Driving by hand: base and tool follow a human's wish, and stand within 50 ms when it ends.

The wish is a velocity. It is held to 0.95 of what was authorized, along its own direction, and followed with a bounded
acceleration; the way down takes `STOP_S`, whatever the speed. The tool keeps its attitude: every tick the point a step
ahead is solved for by differential inverse kinematics, and where the arm does not get there, or only by a swing of its
joints, it stays and says `unreachable` until the hand wants another way. A base that does not get on although it is
driven has met something no sensor told of: it stops pushing, says `blocked`, and is driven again once the hand has let
go of it. So it does where it has come as near as it may to what is known to stand there (`surroundings`). To what is
near the tool comes as slowly as in any skill, whether the arm takes it there or the base: stopped when it touches at
full speed, it has pressed several times as hard as it may by then.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import cos, dist, hypot, sin
from typing import TYPE_CHECKING

import numpy as np

from app.governance.model import CONTROL_PERIOD_S, Command, SkillReport, Wish
from app.sim.body import OPEN_N, OPEN_WIDTH_M, PAD_TOUCH_TICKS, SOFT_CLOSE_N, Body
from app.sim.localisation import to_world
from app.sim.motion import ARM_ACCELERATION, BASE_ACCELERATION, MARGIN
from app.sim.skills_arm import number, remember_grip
from app.sim.surroundings import PUSHING_MPS, TOUCHING_MPS, blocks, hand_share, held_off

if TYPE_CHECKING:
    from app.governance.model import Json, Observation, Point, Vec3
    from app.sim.body import Senses

CAPABILITY = "takeover"
STOP_S = 0.05
_JOINT_SPEED_RADPS = 1.2
_LARGEST_TURN_RADPS, _BASE_RADIUS_M = 0.8, 0.45
_WITHIN_M = 1e-5  # a tenth of what the slowest hand moves the tool in a tick
_SAME_WAY = 0.9  # cosine
_GRIP_RAMP_NPS = 100.0
_IN_HAND_M = 0.06
_EMPTY_TICKS = 30  # pads that felt something until just now may hold it still
_RESTING: Vec3 = (0.0, 0.0, 0.0)
_PUSHED_TICKS = 30  # a base that drives off is behind its command for a tenth of that
_PUSHED_SHARE = 0.3  # of the commanded speed
_KEPT_SHARE = 0.1  # of a wanted velocity: what is left of less leads nowhere
_PUSHED_MPS, _PUSHED_RADPS = 0.03, 0.1  # below that the noise of odometry would decide


class Jog:
    """A human's hand on the robot; implements `Skill` and `Steered`."""

    capability = CAPABILITY
    starts = 1
    way: tuple[Point, ...] = ()  # nobody has planned one

    def __init__(self, params: Mapping[str, Json], body: Body) -> None:
        """Prepare to be steered, at rest; `params` are the limits that were authorized."""
        self._body = body
        self._base_mps = MARGIN * number(params, "base_speed_mps", 0.1)
        self._tool_mps = MARGIN * number(params, "tcp_speed_mps", 0.05)
        self._grip_n = 0.98 * number(params, "grip_force_n", SOFT_CLOSE_N)
        self._wish = Wish()
        self._base, self._tool = _Followed(BASE_ACCELERATION), _Followed(ARM_ACCELERATION)
        self._sent: Vec3 = _RESTING
        self._pushing = 0
        self._near = False  # as the base may come to what is known to stand where it is wanted
        self._met: Vec3 | None = None  # which way something stood that the base has met
        self._beyond: Vec3 | None = None  # which way the tool was wanted where the arm did not get
        self._tick = -1
        self._touching = self._missing = 0  # for how many ticks the pads have felt something, and nothing
        self.refused = ""
        self.detail = ""
        body.enter("jog", 0.0)

    def steer(self, wish: Wish) -> None:
        """Take what the human wants from the next tick on."""
        self._wish = wish

    def report(self) -> SkillReport:
        """Say that it goes on for as long as the human likes."""
        return SkillReport("jog", 0.0)

    def act(self, observation: Observation, rate: float) -> Command:
        """Return the command for this tick."""
        body = self._body
        body.seen, body.rate = observation, rate
        body.begin_at(body.senses.hold().joint_rad)  # it may have given way meanwhile; a hand leads from where it is
        if observation.tick > self._tick + 1:  # it was held meanwhile, and everything stands
            self._base.rest()
            self._tool.rest()
        self._tick = observation.tick
        wish = self._wish
        blocked = self._blocked()
        far = self._out_of_reach()
        driven, led = self._slowed(
            _RESTING if blocked else self._driven(wish.base), _RESTING if far else _held(wish.tool, self._tool_mps)
        )
        vx, vy, wz = self._base.follow(driven)
        tool = self._tool.follow(led)
        self._grip(wish.grip)
        moved = self._moved(tool, rate)
        if blocked or self._near or far:
            self.refused = "unreachable" if far else "blocked"
        self._sent = (vx * rate, vy * rate, wz * rate)
        return moved._replace(base_velocity=self._sent)

    def _blocked(self) -> bool:
        """Say whether the base has met something, and the hand still pushes that way."""
        if self._met is not None and _along(self._wish.base, self._met) <= 0.0:
            self._met = None
        if self._met is None:
            self._pushing = self._pushing + 1 if _stands_against(self._sent, self._body.seen.base_velocity) else 0
            self._met = self._sent if self._pushing >= _PUSHED_TICKS else None
        return self._met is not None

    def _out_of_reach(self) -> bool:
        """Say whether the arm got no further, and the hand still wants it to: it would start and stop for ever."""
        wanted, beyond = self._wish.tool, self._beyond
        if beyond is not None and _along(wanted, beyond) <= _SAME_WAY * hypot(*wanted) * hypot(*beyond):
            self._beyond = None
        return self._beyond is not None

    def _driven(self, wanted: Vec3) -> Vec3:
        """Hold the base to its speed, and its turning to what moves no point of the robot faster than that."""
        vx, vy, wz = wanted
        x, y, _ = self._body.seen.tcp_m
        arm_m = max(_BASE_RADIUS_M, hypot(x, y))
        limit = min(_LARGEST_TURN_RADPS, self._base_mps / arm_m)
        share = min(1.0, self._base_mps / (hypot(vx, vy) + abs(wz) * arm_m or 1.0), limit / (abs(wz) or limit))
        return vx * share, vy * share, wz * share

    def _slowed(self, base: Vec3, tool: Vec3) -> tuple[Vec3, Vec3]:
        """Have base and tool near what is known to stand about no faster than they may touch it."""
        self._near = False
        if base == _RESTING and tool == _RESTING:
            return base, tool
        body = self._body
        senses, pose, here = body.senses, body.senses.believed_pose(), body.pose
        wanted_mps, base = hypot(*base[:2]), held_off(senses.site, senses.perception, pose, base)
        vx, vy, wz = base
        self._near = hypot(vx, vy) < _KEPT_SHARE * wanted_mps
        x, y = vx - wz * here.y_m + tool[0], vy + wz * here.x_m + tool[1]
        c, s = cos(pose[2]), sin(pose[2])
        hand = senses.hand if body.holding else None
        share = hand_share(
            (*to_world(pose, here.x_m, here.y_m), here.z_m),
            (c * x - s * y, s * x + c * y, tool[2]),
            0.0 if hand is None else hand.above_support_m,
            blocks(senses.site, senses.perception, None if hand is None else hand.name),
            TOUCHING_MPS if base == _RESTING else PUSHING_MPS,
        )
        return (vx * share, vy * share, wz * share), (tool[0] * share, tool[1] * share, tool[2] * share)

    def _moved(self, tool: Vec3, rate: float) -> Command:
        """Return the arm's part: a step of the tool along its velocity."""
        body = self._body
        if tool == _RESTING:
            self.refused = ""
            return body.hold()
        step = tuple(speed * rate * CONTROL_PERIOD_S for speed in tool)
        here, joints = body.pose, body.joints
        ahead = here._replace(x_m=here.x_m + step[0], y_m=here.y_m + step[1], z_m=here.z_m + step[2])
        solved = body.senses.solver.solve(joints, ahead, _WITHIN_M)
        if solved is None or float(np.abs(solved - joints).max()) > _JOINT_SPEED_RADPS * CONTROL_PERIOD_S:
            self.refused, self._beyond = "unreachable", self._wish.tool
            self._tool.rest()
            return body.hold()
        self.refused = ""
        speeds = (solved - joints) / CONTROL_PERIOD_S
        return body.placed(solved, speeds)

    def _grip(self, wanted: str | None) -> None:
        """Open or close for as long as it is wanted; what is held stays held."""
        body = self._body
        seen = body.seen
        self._touching, self._missing = (self._touching + 1, 0) if seen.pads_loaded else (0, self._missing + 1)
        if wanted == "open":
            body.grip_n = -OPEN_N if seen.grip_width_m < OPEN_WIDTH_M else 0.0
        elif wanted == "close" and self._touching < PAD_TOUCH_TICKS:
            body.grip_n = min(SOFT_CLOSE_N, self._grip_n)
        elif wanted == "close":
            body.grip_n = min(self._grip_n, max(body.grip_n, 0.0) + _GRIP_RAMP_NPS * CONTROL_PERIOD_S)
        elif self._missing >= _EMPTY_TICKS or body.grip_n < 0.0:
            body.grip_n = 0.0
        self._know_the_hand()

    def _know_the_hand(self) -> None:
        """Keep what the robot believes to hold in step with what its pads feel."""
        body = self._body
        senses = body.senses
        if senses.hand is not None and not body.holding and body.grip_n <= 0.0:
            senses.hand = None
            senses.tare()
            senses.zero_slip()
        elif senses.hand is None and self._touching == PAD_TOUCH_TICKS:
            senses.zero_slip()  # this grip is another one: what is put down later is put down as it hangs in it
            self._recognise()

    def _recognise(self) -> None:
        body = self._body
        here = body.pose
        for thing in body.senses.site.objects.values():
            seen = body.senses.glimpse(thing.name)
            if seen is not None and dist((seen.x_m, seen.y_m, seen.z_m), here[:3]) < _IN_HAND_M:
                remember_grip(body, thing, seen)
                return


def takeover(params: Mapping[str, Json], senses: Senses, observation: Observation, held: Command) -> Jog:
    """Prepare to be steered, from the command that is being held."""
    return Jog(params, Body(senses, observation, held, careful=False))


def _along(velocity: Vec3, way: Vec3) -> float:
    return velocity[0] * way[0] + velocity[1] * way[1] + velocity[2] * way[2]


def _stands_against(sent: Vec3, seen: Vec3) -> bool:
    """Say whether a base that is driven hardly moves that way, nor turns."""
    speed, turn = hypot(sent[0], sent[1]), abs(sent[2])
    if speed < _PUSHED_MPS and turn < _PUSHED_RADPS:
        return False
    along = _along((*sent[:2], 0.0), seen)
    goes = speed >= _PUSHED_MPS and along > _PUSHED_SHARE * speed * speed
    turns = turn >= _PUSHED_RADPS and sent[2] * seen[2] > _PUSHED_SHARE * turn * turn
    return not goes and not turns


def _held(wanted: Vec3, limit: float) -> Vec3:
    """Hold a velocity to a speed, along its direction."""
    x, y, z = wanted
    share = min(1.0, limit / (hypot(x, y, z) or 1.0))
    return x * share, y * share, z * share


class _Followed:
    """A velocity that follows a wish: up by an acceleration, down to standstill within `STOP_S`."""

    def __init__(self, acceleration: float) -> None:
        """Begin at rest."""
        self._acceleration = acceleration
        self._highest = 0.0
        self.now: Vec3 = _RESTING

    def rest(self) -> None:
        """Stand still."""
        self._highest, self.now = 0.0, _RESTING

    def follow(self, wanted: Vec3) -> Vec3:
        """Return the velocity a tick on."""
        now = self.now
        speed = hypot(*now)
        self._highest = max(self._highest, speed) if speed else 0.0
        change = (wanted[0] - now[0], wanted[1] - now[1], wanted[2] - now[2])
        rate = self._highest / STOP_S if hypot(*wanted) < speed else self._acceleration
        most, size = rate * CONTROL_PERIOD_S, hypot(*change)
        if size <= most * 1.000001:  # five steps of a fifth are the whole, whatever floating point makes of them
            self.now = wanted
        else:
            share = most / size
            self.now = (now[0] + change[0] * share, now[1] + change[1] * share, now[2] + change[2] * share)
        return self.now
