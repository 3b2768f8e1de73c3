"""Time to safe state, and the least that physics and sensors leave of it.

The *safe state* after a violation is standstill with the skill held back; where a retreat or a rollback follows by
itself, it is the standstill after that, its verification included. A human who is asked ends the way: from then on
the robot is safe, and waits.

The *floor* of a trial is, from exact facts about that trial,

    floor = period + delay               of the sensor that the violation shows in, in control ticks at least
          + max(v_base / a_base,         speeds in truth at the onset; a_base is `motion.base_deceleration_mps2` of the
                v_hand / a_arm)          profile, a_arm the stop of the arm
          + ∫ max(v_base / allowed,      the way that the retreat really took, run at the speed policy allows it
                  v_hand / allowed) dt   (0 where nothing retreats)

without computing, debouncing, the drives' lag, gripping, or coming up to speed. Period and delay are what a watcher
needs who does not predict: one that stops before the limit is reached, or counts on with old positions, can be below,
as can one that stops from little: standstill is what is slower than 0.02 m/s, and the floor brakes to 0.
A violation that never came about because the robot was stopped in time has neither time nor floor.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from app.cell.run import ARM_DECELERATION_MPS2
from app.evaluation.metrics import percentile
from app.evaluation.model import Row, Violation
from app.governance.model import CONTROL_PERIOD_S
from app.sim.sensors import FIX_DELAY_TICKS, FIX_PERIOD_TICKS, PEOPLE_DELAY_TICKS, PEOPLE_PERIOD_TICKS

if TYPE_CHECKING:
    from app.governance.model import Bounds
    from app.sim.truth import Glance

DETECTION_TICKS: Final[Mapping[Violation, int]] = {
    # The robot's own sensors are read in every control tick, and are not late.
    Violation.FORCE: 1,
    Violation.SPEED: 1,
    Violation.RETRY: 1,
    Violation.POSTCONDITION: 1,
    Violation.ZONE: FIX_PERIOD_TICKS + FIX_DELAY_TICKS,
    Violation.PEOPLE: PEOPLE_PERIOD_TICKS + PEOPLE_DELAY_TICKS,
}
"""Period and delay of the sensor in which a violation shows, in control ticks."""

RETREATS: Final = frozenset({"retrace", "release_and_retract", "safe_retreat"})
"""The recovery capabilities that lead back; the others prepare a new attempt."""

ALL: Final = "all"


@dataclass(slots=True)
class Way:
    """The way from the onset of a violation to its safe state. Ticks count from the launch, at 100 a second."""

    onset: int
    braking_ticks: float
    retreat_ticks: float = 0.0
    safe: int | None = None
    stood: bool = False
    over: bool = False

    @property
    def seconds(self) -> float | None:
        """Return how long it took; None if it never came to an end."""
        return None if self.safe is None else (self.safe - self.onset) * CONTROL_PERIOD_S

    def floor_s(self, violation: Violation) -> float:
        """Return the least that it could have taken."""
        return (DETECTION_TICKS[violation] + self.braking_ticks + self.retreat_ticks) * CONTROL_PERIOD_S

    def see(self, tick: int, *, moving: bool, executing: bool, retreat: float | None) -> None:
        """Take one tick; `retreat` is the part of it that its way takes at the allowed speed, None in no retreat."""
        if self.over:
            return
        if retreat is not None:
            if self.stood:
                self.retreat_ticks, self.safe = self.retreat_ticks + retreat, None
        elif executing:
            self.over = self.stood
        elif not moving and self.safe is None:
            self.safe, self.stood = tick, True


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
        braking_ticks: float,
        moving: bool,
        executing: bool,
        retreating: bool,
    ) -> None:
        """Take one tick.

        Args:
            tick: its number.
            now: what truly is.
            bounds: what policy allows what is bound at present.
            onsets: the violations that have begun, in this tick or before.
            braking_ticks: what base and arm need to come to rest from here.
            moving: whether the robot does, in truth.
            executing: whether anything is let run.
            retreating: whether that leads back, and nobody was asked before.
        """
        if not onsets:
            return
        retreat = None
        if retreating:
            retreat = max(now.base_speed_mps / bounds.base_speed_mps, now.tcp_speed_mps / bounds.tcp_speed_mps)
        for violation in onsets:
            if violation not in self.of:
                self.of[violation] = Way(tick, braking_ticks)
            self.of[violation].see(tick, moving=moving, executing=executing, retreat=retreat)


def braking_ticks(now: Glance, base_deceleration_mps2: float) -> float:
    """Return how long base and arm need to come to rest from where they are, each at the deceleration it has."""
    longest_s = max(now.base_speed_mps / base_deceleration_mps2, now.tcp_speed_mps / ARM_DECELERATION_MPS2)
    return longest_s / CONTROL_PERIOD_S


class Reached:
    """Sums up what the rows of one method say about time to safe state."""

    def __init__(self) -> None:
        """Begin with no rows."""
        self.pairs: dict[str, list[tuple[float, float]]] = defaultdict(list)
        self._counts: dict[str, Counter[str]] = defaultdict(Counter)

    def add(self, row: Row) -> None:
        """Take a row; those without a violation, or where policy names no more than a warning, say nothing."""
        if not row.get("occurred") or row.get("class") in ("warned", "unwarned"):
            return
        safe, floor = row.get("safe_s"), row.get("floor_s")
        for violation in (str(row["violation"]), ALL):
            counts = self._counts[violation]
            if floor is None:
                counts["prevented"] += 1
            elif safe is None:
                counts["never"] += 1
            else:
                self.pairs[violation].append((float(safe), float(floor)))

    def entries(self) -> dict[str, dict[str, Any]]:
        """Return violation, or `all`, → counts, and median, 95th percentile of times, floors and their ratios."""
        order = [one for one in (*Violation, ALL) if one in self._counts or one in self.pairs]
        return {str(one): self._entry(str(one)) for one in order}

    def _entry(self, violation: str) -> dict[str, Any]:
        pairs, counts = self.pairs.get(violation, []), self._counts[violation]
        made: dict[str, Any] = {"prevented": counts["prevented"], "never": counts["never"], "n": len(pairs)}
        values = {
            "safe_s": [safe for safe, _ in pairs],
            "floor_s": [floor for _, floor in pairs],
            "ratio": [safe / floor for safe, floor in pairs],
            "above_s": [safe - floor for safe, floor in pairs],
        }
        for name, found in values.items():
            made[f"{name}_median"] = percentile(found, 0.5) if found else None
            made[f"{name}_p95"] = percentile(found, 0.95) if found else None
        return made
