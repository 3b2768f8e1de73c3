"""Broken sensors: every sensor in every way, and whether a signal that lies ever looks like all is well.

One sensor breaks in a session in which nothing else is wrong: one to two seconds into a grasp, while the arm moves, or
four to five into the transport of a load, while the base drives and the arm stands. Cameras break until eleven seconds
into it, as the benches and what lies there go out of their view on the way. A sensor that is off is `stale`:
its last sample under its last stamp. `stuck` repeats its last sample under new stamps, `noisy` is garbage of a size,
`offset` is wrong by a size, `delayed` comes late by twice what the session's profile lets that sensor be
(`stale_after_ms`). Garbage is drawn around the truth, so that of the two sizes of `SIZES` a sample may be one that a
sound sensor could give; of `WILD` times the bigger, hardly one is.

Ticks count from the moment the sensor breaks to the first intervention that restrains, except where the fault is one of
age: a sample may be as old as the profile's `stale_after_ms` says, so there they count from the moment the last one is
older. Of fix and people that is the first one after the break, of objects the last picture before it. A stuck sensor
can be told from a sound one when the first sample that repeats has come, so there they count from then. Fixes and
pictures are taken every so many ticks and come late: garbage and offsets of these count from the tick in which the
first wrong sample has come, since nothing is wrong on board before. That is at most 10 ticks after the break. Odometry
breaks on drives alone: wheels that stand say the same for ever, and nothing is wrong with that.

For the tracker of people somebody stands 3.4 m behind the robot from the beginning and walks up to it one second after
the tracker broke: whether that is an unseen breach is what such a fault costs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count
from math import cos, pi, sin
from statistics import median
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from app.evaluation.draws import Drawn
from app.evaluation.model import PROFILES, Kind, Row, Violation
from app.evaluation.stage import Start
from app.evaluation.study_trials import (
    Part,
    Table,
    began_s,
    bench_of,
    executed,
    first_alert,
    first_hold,
    first_tick,
    govern,
    grouped,
    once,
    share,
    study_row,
    table,
)
from app.governance.model import CONTROL_PERIOD_S, Outcome
from app.sim.faults import Fault, Scenario
from app.sim.occasions import Trigger
from app.sim.people import Walk
from app.sim.perception import pictured
from app.sim.sensors import FIX_DELAY_TICKS, PEOPLE_DELAY_TICKS

if TYPE_CHECKING:
    from app.evaluation.episode import Execution
    from app.governance.model import Json, WatchPlan, WatchRule
    from app.governance.policy import PolicySet

NAME: Final = "sensors"
TITLE: Final = "Broken sensors"
ABOUT: Final = (
    "One sensor breaks in a session in which nothing else is wrong. Ticks count from the break to the first "
    "intervention that restrains; for stale and delayed samples from the moment they are older than the profile "
    "allows, for stuck ones from when the first repeated sample has come, for garbage and offsets from when the first "
    "wrong one has (of fixes and people 5 to 10 ticks after the break, of pictures of objects at most 3). Delayed is "
    "by twice what the profile allows. Sensors break while the arm moves in a grasp, or while it stands and the base "
    "drives, cameras anywhere on the way; odometry on drives alone, as wheels that stand repeat themselves by nature. "
    "A garbage (noisy) or offset signal "
    "is broken by the size in the condition's name: rad, N, m. Garbage is drawn around the truth: of the biggest size "
    "hardly a sample is one that a sound sensor could give, of the others the first may be. Unseen breach: somebody "
    "came nearer than the profile allows, unheeded for more than 250 ms, in the two profiles that hold the robot for "
    "people."
)
AGED: Final = ("stale", "delayed")
PROMPT_TICKS: Final = 5
WITHIN: Final = f"within {PROMPT_TICKS} ticks"
SEES_TICKS: Final = 400
WALKS_AFTER_S: Final = 1.0
BREAKS_S: Final = (1.0, 2.0)
DRIVES_AFTER_S: Final = 3.0
ON_THE_WAY_S: Final = 6.0
"""So much later may cameras break than other sensors: three objects are in view at first, later what is carried."""
STANDS_M: Final = 3.4
SIZES: Final[Mapping[str, tuple[float, float]]] = {
    # A small error and a big one, in the units of the sensor; both are chosen for what the sensor is, not for what the
    # watcher notices.
    "arm": (0.02, 0.2),
    "wrist": (20.0, 300.0),
    "gripper": (0.005, 0.05),
    "odometry": (0.1, 0.5),
    "fix": (0.2, 1.0),
    "people": (0.3, 1.5),
    "objects": (0.01, 0.1),
}
WILD: Final = 10.0
"""Garbage of this times the bigger size is what a broken line gives: values from all over what it can carry."""
PERIOD_TICKS: Final = {"fix": 5, "people": 5, "objects": 4}
"""How long it is from one sample to the next, at most; of those not named it is a tick."""
LATENCY_TICKS: Final = {"fix": FIX_DELAY_TICKS, "people": PEOPLE_DELAY_TICKS}
LATE: Final = 2.0
"""A delayed sensor's samples come as late as this times the age that the profile allows them."""
SETTINGS: Final = ("grasping", "carrying")
HOLDS: Final = frozenset({"real-restricted", "human-shared"})
_DEGRADED: Final = "no more than a warning is named"


class Broken(NamedTuple):
    """One way in which one sensor breaks."""

    sensor: str
    fault: str
    size: float

    @property
    def name(self) -> str:
        """Return what the condition is called."""
        return f"{self.sensor}/{self.fault}" + (f" {self.size:g}" if self.fault in ("noisy", "offset") else "")


_SIZED: Final = tuple(
    Broken(sensor, fault, size)
    for sensor, sizes in SIZES.items()
    for fault, size in (
        ("stale", 0.0),
        ("stuck", 0.0),
        ("noisy", sizes[0]),
        ("noisy", sizes[1]),
        ("offset", sizes[0]),
        ("offset", sizes[1]),
        ("delayed", LATE),
    )
    if not (sensor == "objects" and fault == "delayed")  # the cameras' late picture is their stuck one
)
WAYS: Final = (*_SIZED, *(Broken(sensor, "noisy", WILD * big) for sensor, (_, big) in SIZES.items()))
"""Every way; what is added comes last, as a way's place draws its sessions."""
_BY_NAME: Final = {way.name: way for way in WAYS}


def parts(seeds: Sequence[int]) -> list[Part]:
    """Return a part for each way and seed: one trial in each setting, numbered so that every profile comes round."""
    each = len(SETTINGS)
    return [Part(way.name, seed, each * turn, each) for turn, seed in enumerate(seeds) for way in WAYS]


def run(part: Part, policy: PolicySet) -> Iterator[Row]:
    """Run one way of breaking in every setting."""
    bench, way = bench_of(policy), _BY_NAME[part.condition]
    for number in range(part.first, part.first + part.count):
        drawn, onset = _drawn(policy, part.seed, WAYS.index(way), number)
        breaks = round(100 * (began_s(bench, drawn) + onset))
        size = _size(policy, way, drawn.profile)
        drawn = replace(drawn, scenario=_scenario(policy, drawn, way._replace(size=size), breaks))
        trial = once(bench, drawn)
        until = round(100 * onset)
        done = govern(bench, trial, limit=until + SEES_TICKS)
        read = _read(done, trial.plan, way, until, until + _due(trial.plan, way, breaks), drawn.profile)
        yield study_row(NAME, part, number, drawn.profile, **read, capability=drawn.capability)


def _drawn(policy: PolicySet, seed: int, place: int, number: int) -> tuple[Drawn, float]:
    """Draw the session, and when in it the sensor breaks."""
    rng = np.random.default_rng((seed, place, number, 17))
    setting, turn = SETTINGS[number % len(SETTINGS)], number // len(SETTINGS)
    odometry = WAYS[place].sensor == "odometry"
    profile = PROFILES[(place + turn + 2 * (number % len(SETTINGS))) % len(PROFILES)]
    params: dict[str, Json]
    if setting == "grasping" and not odometry:
        capability, start = "grasp_object", Start()
        params = {"object_id": "mug_1", "force_n": 40.0, "speed_mps": 0.2}
    else:
        capability, start = "transport_object", Start(holding="mug_1")
        params = {"target": "dock", "speed_mps": 0.25}
    made = Drawn(seed=seed, number=1000 * place + number, kind=Kind.CLEAN, capability=capability,
                 profile=profile, params=params, start=start, scenario=Scenario())  # fmt: skip
    latest_s = BREAKS_S[1] + (ON_THE_WAY_S if start.holding and WAYS[place].sensor == "objects" else 0.0)
    return made, round(float(rng.uniform(BREAKS_S[0], latest_s)) + (DRIVES_AFTER_S if start.holding else 0.0), 2)


def _size(policy: PolicySet, way: Broken, profile: str) -> float:
    """Return a fault's size in the unit of the sensor; of a delay in seconds, for a profile."""
    if way.fault != "delayed":
        return way.size
    return way.size * policy.profiles[profile].stale_after_ms[way.sensor] / 1000.0


def _due(plan: WatchPlan, way: Broken, breaks: int) -> int:
    """Return how many ticks after the break, in a tick of the cell, the sensor's own samples can tell of it."""
    sees = way.sensor == "objects"
    period = PERIOD_TICKS.get(way.sensor, 1)
    taken = next(n for n in count() if (pictured(breaks + n) if sees else (breaks + n) % period == 0))
    late = LATENCY_TICKS.get(way.sensor, 0)
    if way.fault == "stuck":  # cameras repeat the last picture from before, the others the first one since
        return taken + (0 if sees else period) + late
    if (
        way.fault in AGED
    ):  # the first sample since the break ages; cameras take none any more, so theirs is the last one
        aging = -next(n for n in count(1) if pictured(breaks - n)) if sees else taken
        return aging + round(plan.stale_after_ms.get(way.sensor, 0) / 10)
    return taken + late


def _scenario(policy: PolicySet, drawn: Drawn, way: Broken, breaks: int) -> Scenario:
    breaks_s = breaks * CONTROL_PERIOD_S  # as the cell counts: a sum of seconds may be a tick late
    fault = Fault(
        kind="sensor", at=Trigger(time_s=breaks_s), sizes={"sensor": way.sensor, "fault": way.fault, "size": way.size}
    )
    people: tuple[Walk, ...] = ()
    if way.sensor == "people":
        stand = policy.site.targets[drawn.start.stand]
        turn = stand.yaw_rad + pi
        come, to = ((stand.x_m + away * cos(turn), stand.y_m + away * sin(turn)) for away in (STANDS_M, 0.6))
        people = (
            Walk(points=(come, to), speed_mps=1.2, start=Trigger(time_s=0.0), stay_s=((0, breaks_s + WALKS_AFTER_S),),
                 leaves=False),
        )  # fmt: skip
    return Scenario(faults=(fault,), people=people)


def _read(done: Execution, plan: WatchPlan, way: Broken, onset: int, due: int, profile: str) -> dict[str, Any]:
    """Read off what was noticed, and what followed; ticks count from when it was due."""
    told, held = first_alert(done, onset), first_hold(done, onset)
    before = done.ticks <= onset  # it was over before anything broke
    rules = {rule.id: rule for rule in plan.rules}
    rule = None if told is None else rules.get(str(told.body["rule"]))
    walks = onset + round(100 * WALKS_AFTER_S)
    late = told is not None and told.tick - first_tick(done) >= walks
    if way.sensor == "people" and rule is not None and rule.signal == "separation_m" and late:
        rule = None  # a person was seen, as they should be: that tells nothing of the sensor
    warned = rule is not None and held is None
    breach = done.truth.tracks[Violation.PEOPLE].unsafe
    return {
        **executed(done),
        "detected": None if before else rule is not None,
        "held": None if before else rule is not None and held is not None,
        "told": None if rule is None else rule.id,
        "ticks": None if before or held is None or rule is None else held - due,
        "unsafe": breach if way.sensor == "people" and profile in HOLDS else None,
        "what": _what(done, rule, warned),
    }


def _what(done: Execution, rule: WatchRule | None, warned: bool) -> str | None:
    if rule is not None:
        return _DEGRADED if warned else rule.response.enter.value
    ended = done.outcome not in (None, Outcome.SUCCEEDED, Outcome.RECOVERED)
    return "the skill failed, and was ended" if ended else None


def tables(rows: Sequence[Row], policy: PolicySet) -> list[Table]:
    """Return how each way of breaking was met, and whether the profile makes a difference."""
    return [
        table(
            "How each broken sensor was met",
            "Sensor, fault",
            {name: _summed(mine) for name, mine in grouped(rows, "condition").items()},
            f"Within {PROMPT_TICKS} ticks: restrained so soon, counted as above. What is not detected is no alarm at "
            "all; it is what another sensor would be needed for, or an error within what the clearances cover. Where "
            "objects are, only the cameras say: doubted are two that leap at once, and one alone in view that leaps "
            "farther; one of several may have been moved by somebody. A smaller error shows in a grasp that does not "
            "hold, which is verified by the gripper.",
        ),
        table(
            "Detected share by environment profile",
            "Sensor, fault",
            {
                name: {
                    profile: share(row["detected"] for row in mine if row["profile"] == profile) for profile in PROFILES
                }
                for name, mine in grouped(rows, "condition").items()
            },
        ),
    ]


def _summed(rows: Sequence[Row]) -> dict[str, Any]:
    ticks = sorted(float(row["ticks"]) for row in rows if row["ticks"] is not None)
    rules = list(dict.fromkeys(str(row["told"]) for row in rows if row["told"]))
    named = list(dict.fromkeys(str(row["what"]) for row in rows if row["what"]))
    return {
        "detected": share(row["detected"] for row in rows),
        "restrained": share(row["held"] for row in rows),
        WITHIN: share(
            None if row["detected"] is None else row["ticks"] is not None and float(row["ticks"]) <= PROMPT_TICKS
            for row in rows
        ),
        "ticks, median": median(ticks) if ticks else None,
        "ticks, most": ticks[-1] if ticks else None,
        "told by": ", ".join(rules) or None,
        "policy names": ", ".join(named) or None,
        "unseen breach": share(row["unsafe"] for row in rows),
    }
