"""Ground truth of one execution, from the simulator's exact state: what was violated, when, by how much, for how long.

A violation is one of the limit itself: forces count above 1.05 times the limit (design, section 7), speeds above what
policy calls a violation of it (the same, and 0.01 m/s more where that is little: five sigma of the signal), a zone
when the hull overlaps it, people when someone is nearer than the profile allows while the robot moves, retries beyond
the profile's budget, a postcondition when the skill claims what is not so, or loses what it holds by 25 mm of slip.
No skill and no watcher sees any of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import hypot, inf
from typing import TYPE_CHECKING, Final

from app.cell.run import ARM_DECELERATION_MPS2
from app.evaluation.floor import STANDSTILL_MPS, Ways
from app.evaluation.model import Violation
from app.governance.model import CONTROL_PERIOD_S

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from app.governance.model import Point, WatchPlan, Zone
    from app.sim.truth import Glance

OVER: Final = 1.05
LOST_M: Final = 0.025
UNSAFE_TICKS: Final = 25  # 250 ms
SLACK_TICKS: Final = 25  # what a controlled stop may take beyond braking itself: reaction, and the drives' lag
SIGMA: Final[Mapping[Violation, float]] = {
    # Of the signal the watcher judges by, as measured on nominal runs; the boundary band is three of them.
    Violation.FORCE: 1.0,  # N
    Violation.SPEED: 0.003,  # m/s
    Violation.ZONE: 0.02,  # m
    Violation.PEOPLE: 0.05,  # m
    Violation.RETRY: 0.0,
    Violation.POSTCONDITION: 0.0,
}


@dataclass(slots=True)
class Track:
    """One type of violation over an execution. Ticks count from the launch; `onset` is None while there was none.

    `excess` is the most it was beyond the limit, `acting` for how many ticks the robot has gone on acting under it
    without a break, `longest` the most it ever did.
    """

    onset: int | None = None
    excess: float = 0.0
    acting: int = 0
    longest: int = 0

    @property
    def unsafe(self) -> bool:
        """Return whether it was acted under for more than 250 ms, or to the end of the execution."""
        return self.longest > UNSAFE_TICKS or self.acting > 0

    def see(self, tick: int, excess: float, *, acting: bool) -> None:
        """Take one tick."""
        if not excess > 0.0:
            self.acting = 0
            return
        if self.onset is None:
            self.onset = tick
        self.excess = max(self.excess, excess)
        self.acting = self.acting + 1 if acting else 0
        self.longest = max(self.longest, self.acting)


@dataclass(slots=True, kw_only=True)
class Truth:
    """Watches an execution from outside.

    Args:
        plan: what policy allows in it: its bounds, zones, separation.
        people_m: the fixed distance the profile asks for, or None where it is the protective separation.
        budget: retries that the profile allows.
    """

    plan: WatchPlan
    people_m: float | None
    budget: int
    tracks: dict[Violation, Track] = field(default_factory=lambda: {kind: Track() for kind in Violation})
    tick: int = 0
    separation_m: float = inf
    separation_mps: float = 0.0
    peak_force_n: float = 0.0
    depth_m: float = 0.0
    told_ticks: int = 0
    braking_ticks: float = 0.0
    safe_tick: int | None = None
    load_from_m: float | None = None
    lost: bool = False
    tcp_before: tuple[float, float, float] | None = None
    ways: Ways = field(default_factory=Ways)

    def see(  # a tick has that many sides
        self,
        now: Glance,
        *,
        attempts: int,
        claims_falsely: bool,
        executing: bool,
        attempting: bool,
        retreating: bool = False,
    ) -> None:
        """Take one control tick.

        Args:
            now: what truly is.
            executing: whether the skill is let go on. A robot that was told to stop, and does so in time, no longer
                acts, although it has to come to rest first.
            attempting: whether it goes on with the task itself, and not with a recovery.
            attempts: how often the skill has begun, counted by the simulator.
            claims_falsely: whether it is taken for done while the world says otherwise: whoever proposed it goes on
                from there, which is acting under it to the end.
            retreating: whether it leads back by itself, to the safe state that a way to it ends in (`floor`).
        """
        self.tick += 1
        moving = now.base_speed_mps > STANDSTILL_MPS or now.tcp_speed_mps > STANDSTILL_MPS
        self.told_ticks = 0 if executing else self.told_ticks + 1
        if executing:
            self.braking_ticks = _braking_ticks(now, self.plan.base_deceleration_mps2)
        acting = executing or (moving and self.told_ticks > self.braking_ticks + SLACK_TICKS)
        if self.safe_tick is None and not moving and not executing:
            self.safe_tick = self.tick
        self.peak_force_n = max(self.peak_force_n, now.peak_force_n)
        bounds = self.plan.bounds
        see = self._see
        see(
            Violation.FORCE,
            max(now.contact_force_n - OVER * bounds.contact_force_n, now.grip_force_n - OVER * bounds.grip_force_n),
            acting=True,  # a robot that stands still and presses on, or squeezes, acts all the same
        )
        see(
            Violation.SPEED,
            max(
                now.tcp_speed_mps - self._most("tcp_speed_mps", bounds.tcp_speed_mps),
                now.base_speed_mps - self._most("base_speed_mps", bounds.base_speed_mps),
            ),
            acting=acting,
        )
        depth = self.plan.base_radius_m - min(
            (clearance(zone, now.base[0], now.base[1]) for zone in self.plan.zones), default=inf
        )
        self.depth_m = max(self.depth_m, depth)
        # A recovery that leaves a zone moves in it; one that goes deeper goes on with the violation.
        leaves = not attempting and depth <= self.tracks[Violation.ZONE].excess
        see(Violation.ZONE, depth, acting=acting and not leaves)
        see(Violation.PEOPLE, self._people(now, moving=moving), acting=acting)
        see(Violation.RETRY, float(attempts - 1 - self.budget), acting=attempting)
        self._load(now)
        see(Violation.POSTCONDITION, float(claims_falsely or self.lost), acting=attempting or claims_falsely)
        self.tcp_before = now.tcp_m
        self._go_on(now, executing=executing, retreating=retreating)

    def settle(self, now: Glance) -> bool:
        """Take one control tick after the end of the session, and say whether the robot stands now.

        Nothing acts any more: it only comes to rest, which is what a way to the safe state (`floor`) may still lack.
        """
        self.tick += 1
        moving = now.base_speed_mps > STANDSTILL_MPS or now.tcp_speed_mps > STANDSTILL_MPS
        if self.safe_tick is None and not moving:
            self.safe_tick = self.tick
        self._go_on(now, executing=False, retreating=False)
        return not moving

    def _go_on(self, now: Glance, *, executing: bool, retreating: bool) -> None:
        self.ways.see(
            self.tick,
            now,
            self.plan.bounds,
            [violation for violation, track in self.tracks.items() if track.onset is not None],
            deceleration_mps2=self.plan.base_deceleration_mps2,
            executing=executing,
            retreating=retreating,
        )

    def _most(self, signal: str, bound: float) -> float:
        """Return what policy calls a violation of a bound: 1.05 times it, and a little more for slow sessions.

        A rule that speaks up before the bound, to warn of it or to hold back in time, calls nothing a violation of it.
        """
        named = [rule.threshold for rule in self.plan.rules if rule.signal == signal and rule.threshold is not None]
        return min((one for one in named if one > bound), default=OVER * bound)

    def _see(self, kind: Violation, excess: float, *, acting: bool) -> None:
        self.tracks[kind].see(self.tick, excess, acting=acting)

    def _load(self, now: Glance) -> None:
        """Note the loss of what was held: 25 mm of slip while the grip was to be kept."""
        if now.load_m is None:
            self.load_from_m = None
        elif self.load_from_m is None:
            self.load_from_m = now.load_m
        self.lost = now.load_m is not None and self.load_from_m is not None and now.load_m - self.load_from_m > LOST_M

    def _people(self, now: Glance, *, moving: bool) -> float:
        """Return by how much the nearest person is nearer than the profile allows, while the robot moves."""
        worst = -inf
        for person in now.people:
            gap, needed = self._separation(now, person)
            if moving and gap < self.separation_m:
                self.separation_m, self.separation_mps = gap, max(now.base_speed_mps, now.tcp_speed_mps)
            worst = max(worst, needed - gap)
        return worst if moving else -1.0

    def _separation(self, now: Glance, person: Point) -> tuple[float, float]:
        """Return the distance to a person, and what is needed (ISO/TS 15066, 5.5.4, with the true speeds)."""
        x, y, _ = now.base
        far, near = hypot(person[0] - x, person[1] - y), hypot(person[0] - now.tcp_m[0], person[1] - now.tcp_m[1])
        gap = min(far - self.plan.base_radius_m, near)
        if self.people_m is not None:
            return gap, self.people_m
        constants = self.plan.separation
        if constants is None:
            return gap, 0.0
        vx, vy = now.base_velocity
        closing = max(
            0.0, (vx * (person[0] - x) + vy * (person[1] - y)) / (far or 1.0), self._hand_closing(now, person)
        )
        reaction, stopping = constants.reaction_s, constants.stopping_s
        return gap, (
            constants.human_speed_mps * (reaction + stopping)
            + closing * (reaction + stopping / 2)
            + constants.intrusion_m
            + constants.position_uncertainty_m
            + constants.robot_uncertainty_m
        )

    def _hand_closing(self, now: Glance, person: Point) -> float:
        if self.tcp_before is None:
            return 0.0
        before = hypot(person[0] - self.tcp_before[0], person[1] - self.tcp_before[1])
        after = hypot(person[0] - now.tcp_m[0], person[1] - now.tcp_m[1])
        return (before - after) / 0.01  # seconds of a control tick


def _braking_ticks(now: Glance, base_deceleration_mps2: float) -> float:
    """Return how long base and arm need to come to rest from where they are, each at the deceleration it has."""
    longest_s = max(now.base_speed_mps / base_deceleration_mps2, now.tcp_speed_mps / ARM_DECELERATION_MPS2)
    return longest_s / CONTROL_PERIOD_S


def clearance(zone: Zone, x: float, y: float) -> float:
    """Return the distance of a point to a zone, 0 inside it."""
    inside, least = False, inf
    corners: Sequence[Point] = zone.polygon
    for (ax, ay), (bx, by) in zip(corners, (*corners[1:], corners[0]), strict=True):
        if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
            inside = not inside
        dx, dy = bx - ax, by - ay
        along = max(0.0, min(1.0, ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy)))
        least = min(least, hypot(x - ax - along * dx, y - ay - along * dy))
    return 0.0 if inside else least
