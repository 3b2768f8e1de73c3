"""Time to safe state, and the least that physics leaves of it, for every trial from exact facts about that trial.

The *safe state* after a violation is standstill with the skill held back; where a retreat or a rollback follows by
itself, it is the standstill after that, its verification included. A human who is asked ends the way: from then on
the robot is safe, and waits. A new attempt leaves the safe state where it was reached.

The time has three parts, and each has its own least:

| part | from, to | least |
|---|---|---|
| told | onset in truth, to the skill being held back | one control tick; none where it was held back by then |
| stop | from there to standstill (0.02 m/s) | the speeds at its beginning, braked as hard as the drives can |
| back | from there to the end of the way back | the way that was really gone, at the speed policy allows there |

**Stop.** The drives' best is their force limit over the mass of the base, both axes pulling (6.1 m/s²), and the
shoulder's torque limit on hand and wrist at full reach (47 m/s²). An arm that met something stiff needs no braking.
`declared_stop_s` is the same at the decelerations that are declared, the profile's `motion.base_deceleration_mps2` and
the arm's: how a controlled stop is to brake. It is no floor; a skill that fails lets go of its speed at once.

**Back.** For every tick, the share of it that its way takes at the allowed speed: the base's or the hand's, whichever
is more, and no more than the tick itself. Their sum τ is the way at full speed. Coming up to speed v and down again
takes v/a more (a trapezoid; 2·√(τ·v/a) where it is too short to get there), with a as declared. Left out is what a
way back needs besides its way: planning, gripping and putting down, standing at its corners, verification.

The stop is rounded up to whole control ticks: nothing shows in less.

A violation that never came about because the robot was stopped in time has neither time nor floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import ceil, hypot, sqrt
from typing import TYPE_CHECKING, Final

from app.cell.run import ARM_DECELERATION_MPS2
from app.evaluation.model import Violation
from app.governance.model import CONTROL_PERIOD_S
from app.sim import robot

if TYPE_CHECKING:
    from app.governance.model import Bounds
    from app.sim.truth import Glance

STANDSTILL_MPS: Final = 0.02
BASE_BEST_MPS2: Final = hypot(*robot.BASE_FORCE[:2]) / robot.BASE_MASS_KG
ARM_BEST_MPS2: Final = robot.TORQUE_LIMIT_NM[1] / (
    (sum(robot.LINK_MASS_KG[3:]) + robot.GRIPPER_MASS_KG) * sum(map(abs, robot.DH_A_M))
)
RETREATS: Final = frozenset({"retrace", "release_and_retract", "safe_retreat"})
"""The recovery capabilities that lead back; the others prepare a new attempt."""


@dataclass(slots=True)
class Back:
    """The way back so far: its ticks at the allowed speed, and how long base and hand take to come up to that."""

    ticks: float = 0.0
    base_ramp_s: float = 0.0
    hand_ramp_s: float = 0.0

    @property
    def seconds(self) -> float:
        """Return the least that it takes, with one ramp up and one down, of whichever of both comes up to speed first.

        Source: rest-to-rest travel under limits of speed and acceleration.
        """
        way_s = self.ticks * CONTROL_PERIOD_S
        ramp_s = min((one for one in (self.base_ramp_s, self.hand_ramp_s) if one), default=0.0)
        return way_s + ramp_s if way_s >= ramp_s else 2.0 * sqrt(way_s * ramp_s)

    def see(self, now: Glance, bounds: Bounds, base_deceleration_mps2: float) -> None:
        """Take one tick of it."""
        base, hand = now.base_speed_mps / bounds.base_speed_mps, now.tcp_speed_mps / bounds.tcp_speed_mps
        self.ticks += min(1.0, max(base, hand))
        if now.base_speed_mps > STANDSTILL_MPS:
            self.base_ramp_s = bounds.base_speed_mps / base_deceleration_mps2
        if now.tcp_speed_mps > STANDSTILL_MPS:
            self.hand_ramp_s = bounds.tcp_speed_mps / ARM_DECELERATION_MPS2


@dataclass(slots=True)
class Way:
    """The way from the onset of a violation to its safe state. Ticks count from the launch, at 100 a second.

    Attributes:
        onset: When it came about.
        told: When the skill was held back: the onset itself where it was by then; None: never.
        stood: When the robot came to rest after that.
        safe: When the safe state was reached; None while it is not.
        stop_s: The least that coming to rest took, from the speeds at `told`.
        declared_stop_s: The same at the declared decelerations.
        back: The way back, if one was gone.
        over: Whether it goes on with something else.
    """

    onset: int
    told: int | None = None
    stood: int | None = None
    safe: int | None = None
    stop_s: float = 0.0
    declared_stop_s: float = 0.0
    back: Back = field(default_factory=Back)
    over: bool = False

    @property
    def seconds(self) -> float | None:
        """Return how long it took; None if it never came to an end."""
        return _seconds(self.onset, self.safe)

    @property
    def told_s(self) -> float | None:
        """Return how long it took until the skill was held back."""
        return _seconds(self.onset, self.told)

    @property
    def stopped_s(self) -> float | None:
        """Return how long it took from there to standstill."""
        return _seconds(self.told, self.stood)

    @property
    def back_s(self) -> float | None:
        """Return how long the way back took from there; 0 where none was gone."""
        return _seconds(self.stood, self.safe)

    @property
    def floor_s(self) -> float:
        """Return the least that the whole way could have taken."""
        told = min(1, (self.onset + 1 if self.told is None else self.told) - self.onset) * CONTROL_PERIOD_S
        return told + self.stop_s + self.back.seconds

    def see(self, tick: int, now: Glance, *, executing: bool, pressed: bool, deceleration_mps2: float) -> None:
        """Take one tick that is no part of a way back.

        Args:
            tick: its number.
            now: what truly is.
            executing: whether anything is let run.
            pressed: whether the arm is in something stiff, which stops it.
            deceleration_mps2: how the base is declared to brake.
        """
        if self.over:
            return
        if self.told is None and not executing:
            self.told = tick
            hand_mps = 0.0 if pressed else now.tcp_speed_mps
            best_s = braking_s(now.base_speed_mps, hand_mps, BASE_BEST_MPS2, ARM_BEST_MPS2)
            self.stop_s = ceil(best_s / CONTROL_PERIOD_S) * CONTROL_PERIOD_S
            self.declared_stop_s = braking_s(now.base_speed_mps, hand_mps, deceleration_mps2, ARM_DECELERATION_MPS2)
        if self.told is not None and self.safe is None and _stands(now) and (self.stood is None or not executing):
            self.safe = tick
            self.stood = tick if self.stood is None else self.stood
        if executing:  # what is let run again after standstill is no part of the way any more
            self.over = self.stood is not None

    def go_back(self, tick: int, now: Glance, bounds: Bounds, deceleration_mps2: float) -> None:
        """Take one tick of a way back, which puts the safe state off."""
        if self.over:
            return
        if self.told is None:  # it comes about on the way back from something else
            self.told = self.stood = tick
        elif self.stood is None and _stands(now):  # it comes to rest with the way back bound already
            self.stood = tick
        self.safe = None
        self.back.see(now, bounds, deceleration_mps2)


@dataclass(slots=True)
class Ways:
    """The ways of all violations of an execution, each from its onset on."""

    of: dict[Violation, Way] = field(default_factory=dict[Violation, Way])

    def see(  # a tick has that many sides
        self,
        tick: int,
        now: Glance,
        bounds: Bounds,
        onsets: Sequence[Violation],
        *,
        deceleration_mps2: float,
        executing: bool,
        retreating: bool,
    ) -> None:
        """Take one tick.

        Args:
            tick: its number.
            now: what truly is.
            bounds: what policy allows what is bound at present.
            onsets: the violations that have begun, in this tick or before.
            deceleration_mps2: how the base is declared to brake.
            executing: whether anything is let run.
            retreating: whether that leads back, and nobody was asked before.
        """
        for violation in onsets:
            way = self.of.get(violation) or self.of.setdefault(violation, Way(tick))
            if retreating:
                way.go_back(tick, now, bounds, deceleration_mps2)
            else:
                pressed = violation is Violation.FORCE
                way.see(tick, now, executing=executing, pressed=pressed, deceleration_mps2=deceleration_mps2)


def braking_s(base_mps: float, hand_mps: float, base_mps2: float, hand_mps2: float) -> float:
    """Return how long base and hand need from their speeds to standstill, each at its deceleration."""
    return max(0.0, (base_mps - STANDSTILL_MPS) / base_mps2, (hand_mps - STANDSTILL_MPS) / hand_mps2)


def _stands(now: Glance) -> bool:
    return now.base_speed_mps <= STANDSTILL_MPS and now.tcp_speed_mps <= STANDSTILL_MPS


def _seconds(since: int | None, until: int | None) -> float | None:
    return None if since is None or until is None else (until - since) * CONTROL_PERIOD_S
