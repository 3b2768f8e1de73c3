"""One session as the runner carries it from tick to tick: what is bound, how fast it runs, and what it waits for.

Plain state without decisions: those are governance's (`watcher`, `intervention`, `recovery`, `session`) and the
runner's, who applies them. Two things are worked out here because they follow from the state alone: how the rate
ramps, and when everything stands still.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from operator import add, mul, sub
from typing import TYPE_CHECKING, Final, TypeAlias

from app.governance.clamp import hold
from app.governance.intervention import NOTHING, InterventionState, Responses, released
from app.governance.model import Outcome, SkillReport, SkillState, Status
from app.governance.recovery import Budgets, RecoveryDecision
from app.governance.signals import WatchState
from app.governance.watcher import Watcher, compile_watch

if TYPE_CHECKING:
    from app.cell.series import Series
    from app.cell.substrate import Skill
    from app.governance.model import (
        Bounds,
        Command,
        CoveredRecovery,
        Observation,
        RecoveryPlan,
        Vec6,
        WatchPlan,
        WorldFacts,
    )
    from app.governance.permit import Grant

ARM_DECELERATION_MPS2: Final = 2.5
SHORTEST_RAMP_S: Final = 0.05
RAMP_UP_S: Final = 0.3
STILL_BASE_MPS: Final = 0.02
STILL_JOINT_RADPS: Final = 0.05
LONGEST_WAIT_TICKS: Final = 150
MOVING: Final = (Status.RUNNING, Status.RECOVERING)
EASED: Final = 0.9
GIVES_RAD: Final = 0.15  # a push of 600 N bends the arm by less
GIVES_TICKS: Final = 60
PUSHED_NM: Final = 5.0  # as much is left unexplained by a sound run; less says nothing of who pushes whom
RETURNS_RADPS: Final = 0.1  # 6 cm/s for a hand at 0.6 m: what it gave way to may be there still
STRAYS_RAD: Final = 0.2  # more than a stop or `GIVES_RAD` moves a joint that is held
GAINS_MPS: Final = 0.3  # twice what a hand gains that is braked, by servos that run ahead or by what it springs off
SETTLES: Final = 0.98  # of its speed by then, in a tick, once it is told to stand: it swings back for 0.2 s at most
LINK: Final = "link"  # why a cell holds whose link's lease has lapsed
_AT_REST: Final = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NOT_SAID: Final = SkillReport("", 0.0)
EASE_TICKS: Final = 20  # the gripper needs 0.2 s to follow; judged earlier, it would be told too little


class Doing(StrEnum):
    """What is bound: the authorized capability, a recovery capability, the rollback, or a human's driving."""

    ATTEMPT = "attempt"
    RECOVERY = "recovery"
    ROLLBACK = "rollback"
    TAKEOVER = "takeover"


@dataclass(frozen=True, slots=True)
class Bind:
    """Once still: bind this and go on."""

    doing: Doing
    careful: bool
    cover: CoveredRecovery | None = None


@dataclass(frozen=True, slots=True)
class End:
    """Once still: end the session. `category` is the stop category to end with, None to only lock the actuators."""

    outcome: Outcome
    code: str
    category: int | None = None

    def yields_to(self, other: End) -> bool:
        """Say whether another end takes the place of this one before it is reached: a stop does, of any but its like.

        A fault ends by category 1 as well, and what it says of the cell is not to be lost.
        """
        return other.outcome is Outcome.STOPPED and self.outcome not in (Outcome.STOPPED, Outcome.FAULT)


@dataclass(frozen=True, slots=True)
class Unprepared:
    """A skill that could not be prepared at launch: it has failed before it moved, and recovery takes it from there."""

    failure: str
    held: Command

    def act(self, observation: Observation, rate: float) -> Command:  # what every skill is asked
        """Return the command that keeps everything where it is."""
        return self.held

    def report(self) -> SkillReport:
        """Say that it has failed, and of what."""
        return SkillReport("unprepared", 0.0, SkillState.FAILED, self.failure)


Next: TypeAlias = Bind | End


@dataclass(slots=True, kw_only=True)
class Run:
    """The session under way.

    `bounds` is what the clamp holds commands to: those of the plan, and less grip (`eased`) where the gripper gives too
    much. A stop keeps the grip, and letting go may drop what is held: a gripper that gives more than it is told has to
    be told less, at once and until the session ends.

    `grips` says whether the hand has something to keep: it was closed when the session began, or its pads have felt
    something since it was told to close. Fingers that have not are on their way, and a hold stops them.

    `given` is where the arm gave way to what it met, from where it was `told` to be, until something moves it again: an
    arm that keeps where it was told to be presses on, however still it stands. `apart` is how far it is from where its
    skill has it since, until it was led back.
    """

    grant: Grant
    plan: WatchPlan
    recovery: RecoveryPlan
    skill: Skill
    watcher: Watcher
    responses: Responses
    watching: WatchState
    previous: Command
    series: Series
    began: WorldFacts
    first_tick: int
    status: Status = Status.RUNNING
    doing: Doing = Doing.ATTEMPT
    rate: float = 0.0
    ramp_s: float = SHORTEST_RAMP_S
    responding: InterventionState = NOTHING
    used: Budgets = field(default_factory=Budgets)
    recoveries: int = 0
    next: Next | None = None
    deciding: RecoveryDecision | None = None
    paused_by: set[str] = field(default_factory=set[str])
    escalated_by: str = ""
    failed: str = ""
    asked: str = ""  # the failure that a human let it go on after, until a new attempt has begun
    confirmed: set[str] = field(default_factory=set[str])
    settling_ticks: int = 0
    unmet: tuple[str, ...] = ()
    still_ticks: int = 0
    speaking: dict[str, int] = field(default_factory=dict[str, int])
    answered: frozenset[str] = frozenset()  # the rules that spoke when it was decided what is bound next
    decided_tick: int = 0  # and when that was
    hold_after_recovery: str = ""  # why, where a session waits for a human once its recovery has ended
    bounds: Bounds = field(init=False)
    confirms: bool = field(init=False)  # whether a phase may wait for a human at all
    report: SkillReport = NOT_SAID  # the skill's last
    grips: bool = field(init=False)
    eased: Bounds | None = None
    ease_again: int = 0
    told: Vec6 = _AT_REST
    given: Vec6 | None = None
    apart: Vec6 | None = None
    giving_ticks: int = 0
    stood: Vec6 | None = None  # where the arm was once it was held
    braked_mps: float | None = None  # how fast the hand was when that began, or may be still

    def __post_init__(self) -> None:
        """Begin with the bounds of the plan."""
        self.bounds = self.plan.bounds
        self.grips = self.previous.grip_force_n > 0.0
        self.confirms = bool(self.grant.authorization.confirm_before)

    @property
    def id(self) -> str:
        """Return the invocation."""
        return self.grant.authorization.invocation

    @property
    def recovering(self) -> bool:
        """Say whether a recovery is bound, or about to be, rather than the capability itself."""
        if isinstance(self.next, Bind):
            return self.next.doing is not Doing.TAKEOVER
        return self.doing in (Doing.RECOVERY, Doing.ROLLBACK)

    @property
    def undoing(self) -> bool:
        """Say whether a rollback is under way, held or not, or about to be."""
        if self.next is None:
            return self.doing is Doing.ROLLBACK and not self.failed
        return isinstance(self.next, Bind) and self.next.doing is Doing.ROLLBACK

    @property
    def spared(self) -> tuple[str, ...]:
        """Return the rules that what is bound next has grace for: those it was decided for and that speak still."""
        return tuple(rule for rule in self.speaking if rule in self.answered)

    def waits_for_confirmation(self, phase: str) -> bool:
        """Say whether a phase may not begin before a human has confirmed it."""
        phases = self.grant.authorization.confirm_before
        return phase in phases and phase not in self.confirmed and self.doing is Doing.ATTEMPT

    def escalated(self, reason: str) -> None:
        """Note why a human is asked. A lost link answers nothing: a phase that waited to be confirmed waits on."""
        if reason != LINK or not self.unconfirmed:
            self.escalated_by = reason
        self.hold_after_recovery = ""  # whoever is asked now need not be asked once more

    @property
    def unconfirmed(self) -> bool:
        """Say whether a phase waits for a human to confirm it."""
        return self.status is Status.ESCALATED and self.escalated_by.startswith("confirm:")

    def confirm(self) -> None:
        """Note that a human let the phase begin that was asked about, if that was the question."""
        if self.escalated_by.startswith("confirm:"):
            self.confirmed.add(self.escalated_by.removeprefix("confirm:"))
        self.escalated_by = ""

    def begin_anew(self) -> None:
        """Forget what humans confirmed: that was about another moment, perhaps under another authorization."""
        self.confirmed.clear()
        self.confirms = bool(self.grant.authorization.confirm_before)

    def ease_grip(self, measured_n: float, tick: int) -> None:
        """Lower the bound of the grip so far that what the gripper makes of it is within what policy allows."""
        allowed_n = self.plan.bounds.grip_force_n
        told_n = min(self.previous.grip_force_n, self.bounds.grip_force_n)
        if tick < self.ease_again or not measured_n > 0.0 or told_n <= 0.0:  # of a hand that opens it tells nothing
            return
        self.bounds = self.eased = self.bounds._replace(grip_force_n=told_n * EASED * allowed_n / measured_n)
        self.ease_again = tick + EASE_TICKS

    def held(self) -> Command:
        """Return the command that keeps everything where it is: fingers as well, which else open or close on."""
        command = hold(self.previous)
        return command if self.grips else command._replace(grip_force_n=0.0)

    def sent(self, command: Command, seen: Observation) -> None:
        """Note what was sent, and whether there is something between the fingers that it closes."""
        self.previous = command
        self.grips = command.grip_force_n > 0.0 and (self.grips or seen.pads_loaded)
        if self.rate > 0.0:
            self.stood = None
        if self.moves():
            self.braked_mps = None

    def give_way(self) -> None:
        """Have the arm keep where it is instead of where it was told to be, so that its servos stop pressing.

        For a while it follows what it pressed against (the reaction of De Luca et al. 2006: no stiffness after a
        collision), by no more than `GIVES_RAD`; then it keeps where that has led. Only where it is pushed: drives that
        run ahead of what they are told move it as well, and to follow these leads it on into what it met.
        """
        self.giving_ticks = GIVES_TICKS
        if self.given is None:
            self.told = self.given = self.previous.joint_rad

    def yielding(self, command: Command, seen: Observation) -> Command:
        """Return a command with the arm kept where it gives way; once the skill is let go on that is over."""
        if self.given is None or self.moves():
            self.given, self.giving_ticks = None, 0  # left over, they had no later hold be watched (`strays`)
            return command
        if self.giving_ticks > 0:
            self.giving_ticks -= 1
            # A reading that is no number is greater than nothing, and moves nothing.
            self.given = tuple(  # type: ignore[assignment]  # six of them
                max(told - GIVES_RAD, min(told + GIVES_RAD, q)) if abs(nm) > PUSHED_NM and (q - at) * nm > 0.0 else at
                for told, at, q, nm in zip(self.told, self.given, seen.joint_rad, seen.residual_nm, strict=True)
            )
        return command._replace(joint_rad=self.given, joint_speed_radps=_AT_REST)

    def led_back(self, command: Command, period_s: float) -> Command:
        """Return what a skill says to an arm that gave way: from there it is led back slowly to where the skill has it.

        At once it would jump onto what it pressed on, as fast as the bounds let it.
        """
        if self.given is not None:
            if not self.moves():
                return command
            self.apart = tuple(map(sub, self.previous.joint_rad, command.joint_rad))  # type: ignore[assignment]  # six of them
        most = RETURNS_RADPS * period_s
        if self.apart is None or self._near(self.apart, command, most, period_s):
            self.apart = None
            return command
        left = most * self.rate
        self.apart = tuple(d - max(-left, min(left, d)) for d in self.apart)  # type: ignore[assignment]
        return command._replace(joint_rad=tuple(map(add, command.joint_rad, self.apart)))  # type: ignore[arg-type]

    @staticmethod
    def _near(apart: Vec6, command: Command, most: float, period_s: float) -> bool:
        """Say whether an arm is as near to where its skill has it as one tick takes it."""
        return all(abs(d) <= most + period_s * abs(v) for d, v in zip(apart, command.joint_speed_radps, strict=True))

    def bound(self, doing: Doing, held: Command) -> None:
        """Note that something else is bound, which begins from where everything is held."""
        self.doing, self.previous, self.apart = doing, held, None

    def strays(self, seen: Observation) -> bool:
        """Say whether an arm that is braked or held moves away all the same: its drives do not hold it, or do so again.

        One that falls gains speed from the first tick on, long before it is far from where it stood (as the monitored
        ramp of IEC 61800-5-2: what does not slow down as told loses its power).
        """
        if self.giving_ticks > 0:  # in touch with something: brakes that fall in now clamp it, by 650 N for good
            self.stood, self.braked_mps = seen.joint_rad, None
            return False
        if self.braked_mps is None or not math.isfinite(self.braked_mps):
            self.braked_mps = seen.tcp_speed_mps
        if seen.tcp_speed_mps > self.braked_mps + GAINS_MPS:
            return True
        if self.rate > 0.0:
            return False
        self.braked_mps *= SETTLES
        self.stood = self.stood or seen.joint_rad
        return any(abs(q - stood) > STRAYS_RAD for q, stood in zip(seen.joint_rad, self.stood, strict=True))

    def watch_with(self, plan: WatchPlan, period_s: float) -> None:
        """Go on under another plan, with timers of its own; estimates live on."""
        if self.eased is not None:
            self.eased = plan.bounds._replace(grip_force_n=min(self.eased.grip_force_n, plan.bounds.grip_force_n))
        self.plan, self.bounds = plan, self.eased or plan.bounds
        self.watcher = compile_watch(plan, period_s)
        self.responses = Responses(self.watcher.rules, period_s)
        self.watching = self.watcher.begin(self.watching)

    def let_go(self) -> None:
        """Note that a human lets go on: what spoke has been answered, and only what is violated now speaks again."""
        self.watching = self.watcher.let_go(self.watching)
        self.responding = self.responses.let_go(self.responding)

    def release(self) -> None:
        """Note that a human has it undone: that answers what spoke, and only what is violated now speaks again."""
        self.watching = self.watcher.let_go(self.watching)
        self.responding = released(self.responding)

    def moves(self) -> bool:
        """Say whether the skill is to be let run."""
        return self.next is None and self.status in MOVING

    def ramp(self, period_s: float) -> float:
        """Advance the rate by one tick and return it: towards 1 where the skill may move, else to 0 as declared."""
        if self.next is None and self.status in MOVING:  # `moves`, without the call
            if self.rate < 1.0:
                self.rate = min(1.0, self.rate + period_s / RAMP_UP_S)
        elif self.rate > 0.0:
            self.rate = max(0.0, self.rate - period_s / self.ramp_s)
        return self.rate

    def brake(self, seen: Observation) -> None:
        """Choose the ramp down: the base at its declared deceleration, the arm at its own, the slower of the two.

        What moves faster than it was told brakes for longer, up to twice: a reading that is wrong is not to hold up a
        stop, least of all of what was told to stand.
        """
        vx, vy, _ = seen.base_velocity
        told_x, told_y, _ = self.previous.base_velocity
        # What was told goes first in min() and max(): there it wins against a reading that is no number.
        base_mps = min(2.0 * math.hypot(told_x, told_y), math.hypot(vx, vy))
        arm_mps = min(2.0 * self._told_tcp_mps(seen.jacobian), seen.tcp_speed_mps)
        stopping_s = max(SHORTEST_RAMP_S, base_mps / self.plan.base_deceleration_mps2, arm_mps / ARM_DECELERATION_MPS2)
        self.ramp_s = stopping_s / max(self.rate, 0.1)
        self.still_ticks = 0

    def _told_tcp_mps(self, jacobian: tuple[float, ...]) -> float:
        """Return how fast the tool was told to be, and no more than the bound where the joints' readings say so."""
        speeds = self.previous.joint_speed_radps
        told_mps = math.hypot(*(sum(map(mul, jacobian[row : row + 6], speeds)) for row in (0, 6, 12)))
        return min(self.bounds.tcp_speed_mps, told_mps)

    def still(self, seen: Observation) -> bool:
        """Say whether everything has come to rest (or has had long enough to)."""
        if self.rate > 0.0:
            return False
        self.still_ticks += 1
        vx, vy, _ = seen.base_velocity
        resting = math.hypot(vx, vy) < STILL_BASE_MPS and max(map(abs, seen.joint_speed_radps)) < STILL_JOINT_RADPS
        return self.still_ticks >= LONGEST_WAIT_TICKS or (resting and self.still_ticks >= 3)
