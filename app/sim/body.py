"""The movements skills are made of.

Generators that yield one command per tick and keep the robot on its path whatever the rate does.

A `Body` lives as long as one skill. It reads the observation it is given and what the robot perceives and believes,
and has no other way to the actuators than the commands it yields. Planning yields hold commands between its steps, so
that no tick waits for a long one.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from math import cos, hypot, sin
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np

from app.governance.model import CONTROL_PERIOD_S, Command, Observation
from app.sim import robot
from app.sim.hand import Hand, Mark, support
from app.sim.kinematics import ArmSolver, ToolPose
from app.sim.localisation import to_base, to_world, wrapped
from app.sim.motion import (
    ARM_ACCELERATION,
    ARM_JERK,
    BASE_ACCELERATION,
    BASE_JERK,
    MARGIN,
    Limits,
    Path,
    Travel,
    reversals,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from collections.abc import Set as AbstractSet

    from numpy.typing import NDArray

    from app.governance.model import Point, Site, Vec3, Vec6
    from app.sim.perception import Glimpse, Perception

    Floats = NDArray[np.float64]

Moves: TypeAlias = Iterator[Command]

CONTACT_SPEED_MPS = 0.05
CONTACT_NEAR_M = 0.06
GUARD_N = 25.0
SOFT_CLOSE_N, PAD_TOUCH_N, PAD_TOUCH_TICKS = 8.0, 2.0, 3
SOFTLY, FELT = 0.85, 0.7  # of a weak grip: pads that meet something bear a fifth more, and feel it at less
CLOSE_TIMEOUT_S, RAMP_S, OPEN_N = 2.5, 0.2, 12.0
OPEN_WIDTH_M = 2 * robot.FINGER_STROKE_M - 0.006
_LINE_STEP_M, _TURN_STEP_RAD, _TURN_M_PER_RAD = 0.01, 0.05, 0.12
JOINT_SPEED_RADPS = 1.6
_SOLVES_PER_TICK = 3
_DRIVE_GAIN, _TURN_GAIN = 1.5, 1.5
_ARRIVING_S, _LATE_S, _ARRIVED_MPS = 0.1, 1.5, 0.008  # twice the noise of that speed
_DOCKED_M, _DOCKED_RAD, _DOCKED_TICKS, _DOCKING_S = 0.006, 0.01, 20, 2.5
_BLOCKED_ERROR_M, _LOOKAHEAD_M = 0.20, 0.9
_CRATE_M = robot.BASE_RADIUS_M + 0.30  # from the middle of one to the middle of the base
_LOOKS, _NEARER_M = 6, 0.05  # how often the way back is looked at within that, and what docking may wander
_TURN_SPEED_RADPS = 0.8


class SkillFailed(Exception):  # a fact about the skill, not an error of the program
    """A skill gives up; `failure` is a failure name recovery knows."""

    def __init__(self, failure: str, detail: str) -> None:
        """Keep the facts."""
        self.failure, self.detail = failure, detail
        super().__init__(f"{failure}: {detail}")


class Senses(Protocol):
    """What a skill may ask of the robot besides the observation: its own beliefs, never the truth."""

    site: Site
    perception: Perception
    solver: ArmSolver
    hand: Hand | None
    trail: list[Mark]

    @property
    def habits(self) -> AbstractSet[str]:
        """Return the bad habits that faults have given the skill: `faults.HABITS`."""
        ...

    def hold(self) -> Command:
        """Return the command that keeps everything where it is told to be."""
        ...

    def believed_pose(self) -> Vec3:
        """Return where the robot believes its base is."""
        ...

    def glimpse(self, name: str) -> Glimpse | None:
        """Return an object as the cameras see it now, relative to the base."""
        ...

    def sweep(self, area: str, surface_z_m: float) -> float:
        """Look at an area and return the share of it seen so far."""
        ...

    def tool_state(self, name: str) -> str:
        """Return a tool's state as its own switch says."""
        ...

    def tare(self) -> None:
        """Take what the wrist carries now as the load."""
        ...

    def zero_slip(self) -> None:
        """Take the present grip as the one without slip."""
        ...


class Body:
    """The robot as one skill moves it."""

    def __init__(self, senses: Senses, observation: Observation, held: Command, *, careful: bool) -> None:
        """Start from the command that is being held."""
        self.senses = senses
        self.seen = observation
        self.rate = 1.0
        self.phase, self.progress = "start", 0.0
        self.careful = careful
        self.carrying = False
        self.way: tuple[Point, ...] = ()  # the base is planned to go
        self.stretch = (0.0, 1.0)
        self._joints: Vec6 = held.joint_rad
        self.grip_n = held.grip_force_n
        self._still: Vec6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    # -- small things ----------------------------------------------------------------------------------------

    def enter(self, phase: str, progress: float) -> None:
        """Say which phase begins and how far the skill is, or the part of it that `stretch` stands for."""
        first, last = self.stretch
        self.phase, self.progress = phase, first + (last - first) * progress

    def hold(self) -> Command:
        """Return the command that keeps arm, base and grip."""
        return Command(self._joints, self._still, (0.0, 0.0, 0.0), self.grip_n)

    def begin_at(self, joints: Vec6) -> None:
        """Go on with the arm from these joint angles, wherever the last command was to take it."""
        self._joints = joints

    def placed(self, joints: Floats, speeds: Floats) -> Command:
        """Return the command that takes the arm to these joint angles at these joint speeds, with the present grip."""
        self._joints = tuple(joints.tolist())  # type: ignore[assignment]  # six of them
        return Command(self._joints, tuple(speeds.tolist()), (0.0, 0.0, 0.0), self.grip_n)  # type: ignore[arg-type]

    def wait(self, seconds: float) -> Moves:
        """Stand still for some time."""
        passed = 0.0
        while passed < seconds:
            passed += self.rate * CONTROL_PERIOD_S
            yield self.hold()

    def arrived(self) -> Moves:
        """Wait until the tool stands: servos that run behind are on their way still when the last command is given."""
        passed = 0.0
        while passed < _ARRIVING_S or (passed < _LATE_S and self.seen.tcp_speed_mps > _ARRIVED_MPS):
            passed += self.rate * CONTROL_PERIOD_S
            yield self.hold()

    def speed(self, limit_mps: float) -> float:
        """Return the speed to drive at for a limit: 0.95 of it, half of that when careful."""
        return limit_mps * MARGIN * (0.5 if self.careful else 1.0)

    @property
    def joints(self) -> Floats:
        """The joint angles the arm is commanded to."""
        return np.array(self._joints)

    @property
    def pose(self) -> ToolPose:
        """Where the tool is commanded to be, relative to the base."""
        return self.senses.solver.forward(self.joints)

    @property
    def holding(self) -> bool:
        """Whether the pads hold something, by their own sensors."""
        return self.seen.pads_loaded

    # -- arm -------------------------------------------------------------------------------------------------

    def plan_line(self, target: ToolPose, out: list[Floats]) -> Moves:
        """Plan a straight line of the tool to `target` into `out`, a few solutions per tick."""
        start, seed = self.pose, self.joints
        turn = wrapped(target.yaw_rad - start.yaw_rad)
        length = hypot(target.x_m - start.x_m, target.y_m - start.y_m, target.z_m - start.z_m)
        steps = max(1, int(np.ceil(max(length / _LINE_STEP_M, abs(turn) / _TURN_STEP_RAD))))
        out.append(seed)
        for k in range(1, steps + 1):
            share = k / steps
            pose = ToolPose(
                *(a + share * (b - a) for a, b in zip(start[:3], target[:3], strict=True)),
                yaw_rad=start.yaw_rad + share * turn,
            )
            solved = self.senses.solver.solve(seed, pose)
            if solved is None or np.abs(solved - seed).max() > 0.5:
                raise SkillFailed(
                    "unreachable",
                    f"the arm does not reach ({pose.x_m:.2f}, {pose.y_m:.2f}, {pose.z_m:.2f}) from the base",
                )
            seed = solved
            out.append(seed)
            if k % _SOLVES_PER_TICK == 0:
                yield self.hold()

    def line(self, target: ToolPose, speed_mps: float, *, until: Callable[[], bool] | None = None) -> Moves:
        """Move the tool along a straight line; stop early when `until` says so."""
        points: list[Floats] = []
        yield from self.plan_line(target, points)
        yield from self.follow(points, speed_mps, until=until)

    def follow(
        self,
        points: Sequence[Floats],
        speed_mps: float,
        *,
        until: Callable[[], bool] | None = None,
        joint_radps: float = JOINT_SPEED_RADPS,
    ) -> Moves:
        """Travel along joint way points, the tool at most at `speed_mps` and no joint faster than `joint_radps`."""
        path = joint_path(self.senses.solver, points, speed_mps, joint_radps)
        travel = Travel(path, Limits(speed_mps, ARM_ACCELERATION, ARM_JERK))
        while not travel.done:
            point, velocity = travel.advance(self.rate)
            self._joints = tuple(point)  # type: ignore[assignment]  # six of them
            yield Command(self._joints, tuple(velocity), (0.0, 0.0, 0.0), self.grip_n)  # type: ignore[arg-type]
            if until is not None and until():
                return

    def approach(self, target: ToolPose, speed_mps: float) -> Moves:
        """Move to a pose over the work: up or down first where that keeps clear, then across."""
        here = self.pose
        high = max(here.z_m, target.z_m)
        if here.z_m < high - 0.02:
            yield from self.line(here._replace(z_m=high), speed_mps)
        yield from self.line(target._replace(z_m=high), speed_mps)
        if target.z_m < high - 0.002:
            yield from self.line(target, speed_mps)

    def joints_to(self, target: Sequence[float], speed_mps: float) -> Moves:
        """Move the arm straight in joint space."""
        goal = np.array(target)
        steps = max(2, int(np.abs(goal - self.joints).max() / 0.05) + 1)
        start = self.joints
        yield from self.follow([start + (goal - start) * k / steps for k in range(steps + 1)], speed_mps)

    def retract(self, speed_mps: float) -> Moves:
        """Draw the arm in for driving: up, then back over the base."""
        home = self.senses.solver.forward(np.array(robot.HOME_RAD))
        yield from self.approach(home._replace(z_m=max(home.z_m, self.pose.z_m)), speed_mps)
        if np.abs(self.joints - np.array(robot.HOME_RAD)).max() < 1.0:
            yield from self.joints_to(robot.HOME_RAD, speed_mps)

    # -- gripper ---------------------------------------------------------------------------------------------

    def open(self) -> Moves:
        """Open the fingers all the way."""
        self.grip_n, passed = -OPEN_N, 0.0
        while self.seen.grip_width_m < OPEN_WIDTH_M and passed < CLOSE_TIMEOUT_S:
            passed += CONTROL_PERIOD_S
            yield self.hold()
        self.senses.zero_slip()

    def close(self, force_n: float, *, taken: Callable[[], None] = lambda: None) -> Moves:
        """Close softly until both pads feel something for three ticks, then raise the grip to `force_n` within 0.2 s.

        Args:
            force_n: how firmly.
            taken: told as soon as something is between the pads: whatever interrupts the rest, the hand holds it.

        Raises:
            SkillFailed: `grasp_failed`, the pads met nothing.
        """
        soft = min(SOFT_CLOSE_N, SOFTLY * force_n)
        felt_n = min(PAD_TOUCH_N, FELT * soft)
        self.grip_n, passed, touching = soft, 0.0, 0
        while touching < PAD_TOUCH_TICKS:
            yield self.hold()
            passed += self.rate * CONTROL_PERIOD_S
            touching = touching + 1 if self.seen.grip_force_n > felt_n and self.holding else 0
            if passed > CLOSE_TIMEOUT_S or (self.seen.grip_width_m < 0.004 and passed > 0.3):
                raise SkillFailed("grasp_failed", "the fingers closed on nothing")
        taken()
        risen = 0.0
        while risen < 1.0:
            risen = min(1.0, risen + self.rate * CONTROL_PERIOD_S / RAMP_S)
            self.grip_n = soft + risen * (force_n - soft)
            yield self.hold()
        yield from self.wait(0.1)
        self.senses.zero_slip()

    def touched(self, force_n: float = GUARD_N) -> bool:
        """Tell whether the wrist feels a contact."""
        return self.seen.contact_force_n > force_n

    # -- base ------------------------------------------------------------------------------------------------

    def drive(self, way: Sequence[Point], yaw_rad: float, speed_mps: float) -> Moves:
        """Drive along straight legs through `way`, turning to `yaw_rad` on the middle legs, and settle at the end.

        Raises:
            SkillFailed: `blocked`, something stands in the way or the base does not follow; `object_lost` while
                carrying.
        """
        start_yaw = self.senses.believed_pose()[2]
        turn = wrapped(yaw_rad - start_yaw)
        lengths = [hypot(b[0] - a[0], b[1] - a[1]) for a, b in itertools.pairwise(way)]
        turning = set(range(1, len(lengths) - 1)) if len(lengths) > 2 else set(range(len(lengths)))
        turning = turning or {0}
        over = sum(lengths[k] for k in turning) or 1.0
        total, done, yaw = sum(lengths) or 1.0, 0.0, start_yaw
        first, last = self.progress, 0.95
        for k, (a, b) in enumerate(itertools.pairwise(way)):
            after = yaw + (turn * lengths[k] / over if k in turning else 0.0)
            yield from self._leg(
                (*a, yaw),
                (*b, after),
                speed_mps,
                first + (last - first) * done / total,
                (last - first) * lengths[k] / total,
            )
            yaw, done = after, done + lengths[k]
        yield from self._settle((*way[-1], yaw_rad), speed_mps)

    def _leg(self, start: Vec3, end: Vec3, speed_mps: float, before: float, share: float) -> Moves:
        length = hypot(end[0] - start[0], end[1] - start[1])
        metres = max(length, abs(end[2] - start[2]) * speed_mps / _TURN_SPEED_RADPS)
        if metres < 1e-6:
            return
        travel = Travel(Path([start, end], [metres]), Limits(speed_mps * 0.97, BASE_ACCELERATION, BASE_JERK))
        while not travel.done:
            point, velocity = travel.advance(self.rate)
            self._check_follows(point)
            self._check_way(end)
            yield self._drive_command(point, velocity, speed_mps)
            self.progress = before + share * travel.progress

    def _check_follows(self, point: Sequence[float]) -> None:
        if self.carrying and not self.holding:
            raise SkillFailed("object_lost", "the object was lost on the way")
        x, y, _ = self.senses.believed_pose()
        if hypot(point[0] - x, point[1] - y) > _BLOCKED_ERROR_M:
            raise SkillFailed("blocked", "the base does not follow: something holds it")

    def _check_way(self, end: Vec3) -> None:
        x, y, _ = self.senses.believed_pose()
        ahead = hypot(end[0] - x, end[1] - y)
        if ahead < 0.05:
            return
        reach = min(ahead, _LOOKAHEAD_M)
        tip = (x + (end[0] - x) / ahead * reach, y + (end[1] - y) / ahead * reach)
        for cx, cy in self.senses.perception.crates:
            if near_segment((cx, cy), (x, y), tip) < _CRATE_M:
                raise SkillFailed("blocked", f"a crate stands at ({cx:.1f}, {cy:.1f})")

    def _check_way_back(self, travel: Travel) -> None:
        """See that the recorded way leads up to no crate; away from one it may lead, however near it begins."""
        x, y, _ = self.senses.believed_pose()
        for cx, cy in self.senses.perception.crates:
            here = hypot(cx - x, cy - y) - _NEARER_M
            for part in range(1, _LOOKS + 1):
                (ax, ay, _), _ = travel.path.sample(travel.metres + _LOOKAHEAD_M * part / _LOOKS)
                if hypot(cx - ax, cy - ay) < min(here, _CRATE_M):
                    raise SkillFailed("blocked", f"a crate stands at ({cx:.1f}, {cy:.1f})")

    def _drive_command(self, point: Sequence[float], velocity: Sequence[float], speed_mps: float) -> Command:
        x, y, yaw = self.senses.believed_pose()
        vx = velocity[0] + _DRIVE_GAIN * self.rate * (point[0] - x)
        vy = velocity[1] + _DRIVE_GAIN * self.rate * (point[1] - y)
        wz = velocity[2] + _TURN_GAIN * self.rate * wrapped(point[2] - yaw)
        fast = hypot(vx, vy)
        if fast > speed_mps:
            vx, vy = vx * speed_mps / fast, vy * speed_mps / fast
        c, s = cos(yaw), sin(yaw)
        return Command(
            self._joints,
            self._still,
            (c * vx + s * vy, c * vy - s * vx, wz),
            self.grip_n,
        )

    def _settle(self, goal: Vec3, speed_mps: float) -> Moves:
        """Dock: correct what is left as the belief sharpens at rest, until it keeps calm or time is up."""
        calm, passed = 0, 0.0
        while calm < _DOCKED_TICKS and passed < _DOCKING_S:
            x, y, yaw = self.senses.believed_pose()
            near = hypot(goal[0] - x, goal[1] - y) < _DOCKED_M and abs(wrapped(goal[2] - yaw)) < _DOCKED_RAD
            calm = calm + 1 if near else 0
            passed += self.rate * CONTROL_PERIOD_S
            yield self._drive_command(goal, (0.0, 0.0, 0.0), min(speed_mps, 0.1))
        x, y, _ = self.senses.believed_pose()
        if hypot(goal[0] - x, goal[1] - y) > 0.10:
            raise SkillFailed("blocked", "the base does not reach its stand")
        yield self.hold()

    def drive_poses(self, poses: Sequence[Vec3], speed_mps: float) -> Moves:
        """Drive through poses (retracing); no corner is sharper than it was when recorded.

        Where the way turns back the base comes to a stand: whoever led it there by hand came to a stand as well. What
        was free when it was recorded need not be so any more: the way is looked at as any other is.
        """
        start = self.senses.believed_pose()
        points = [np.array((*p[:2], start[2] + wrapped(p[2] - start[2]))) for p in (start, *poses)]
        for first, last in itertools.pairwise((0, *reversals(points), len(points) - 1)):
            yield from self._journey(points[first : last + 1], speed_mps)
        yield from self._settle((*poses[-1][:2], poses[-1][2]), speed_mps)

    def _journey(self, points: Sequence[Floats], speed_mps: float) -> Moves:
        lengths = [float(np.hypot(*(b - a)[:2])) + abs(float(b[2] - a[2])) * 0.3 for a, b in itertools.pairwise(points)]
        travel = Travel(Path(points, lengths), Limits(speed_mps * 0.97, BASE_ACCELERATION, BASE_JERK))
        while not travel.done:
            point, velocity = travel.advance(self.rate)
            self._check_follows(point)
            self._check_way_back(travel)
            yield self._drive_command(point, velocity, speed_mps)

    def support_below(self) -> float | None:
        """Return the height of the surface under the tool, if one is there."""
        at = to_world(self.senses.believed_pose(), self.pose.x_m, self.pose.y_m)
        surface = support(self.senses.site, *at)
        return surface.z_m if surface else None

    def relative(self, x_m: float, y_m: float) -> Point:
        """Express a point of the world relative to the base, as believed."""
        return to_base(self.senses.believed_pose(), x_m, y_m)


def joint_path(
    solver: ArmSolver, points: Sequence[Floats], speed_mps: float, joint_radps: float = JOINT_SPEED_RADPS
) -> Path:
    """Measure joint way points by what bounds their speed.

    Metres of the tool, or joint travel where that takes longer.
    """
    poses = [solver.forward(point) for point in points]
    metres: list[float] = []
    for a, b, p, q in zip(poses, poses[1:], points, points[1:], strict=False):
        tool = hypot(b.x_m - a.x_m, b.y_m - a.y_m, b.z_m - a.z_m) * 1.002
        joint = float(np.abs(q - p).max()) * speed_mps / joint_radps
        metres.append(max(tool, joint, abs(wrapped(b.yaw_rad - a.yaw_rad)) * _TURN_M_PER_RAD))
    return Path(points, metres)


def near_segment(point: Point, start: Point, end: Point) -> float:
    """Return the distance of a point to a line from one point to another."""
    return hypot(*from_segment(point, start, end))


def from_segment(point: Point, start: Point, end: Point) -> Point:
    """Return the way to a point from the nearest one of a line between two others."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    share = min(max(((point[0] - start[0]) * dx + (point[1] - start[1]) * dy) / max(dx * dx + dy * dy, 1e-9), 0.0), 1.0)
    return point[0] - start[0] - share * dx, point[1] - start[1] - share * dy
