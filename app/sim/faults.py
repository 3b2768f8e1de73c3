"""Faults from outside a skill, declared as data.

They never tell the watcher; what they do shows in physics and sensors alone.

| kind | sizes | effect |
|---|---|---|
| `grip_gain` | gain | the gripper's motor gives this share of the commanded force |
| `speed_scaling` | gain | the low-level drives run this much faster than commanded, past the clamp |
| `slippery` | object, friction | the object slides in the pads |
| `missing` | object | the object is gone |
| `blocked` | x_m, y_m, z_m | a crate stands in the way, or hangs in it with its middle at `z_m` |
| `odometry_bias` | x_mps, y_mps | dead reckoning drifts |
| `payload_shift` | object, factor, offset_m | an object's mass changes, and how far beside its middle it pulls |
| `sensor` | sensor, fault, size | a sensor is stuck, stale, noisy, offset or delayed |
| `fade` | strength | the arm's servos keep this share of their strength |
| `misplaced` | object, x_m, y_m | somebody moves the object by so much |
| `habit` | habit | the skill starts over instead of failing (`obstinate`), claims success instead (`overconfident`), |
| | | does nothing (`hung`), or drives by dead reckoning alone (`dead_reckoning`) |

Habits are those of tasks: a recovery is another skill and has none of them. A person who walks in is a `Walk`.
`for_s` ends a fault by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import inf
from typing import TYPE_CHECKING

from app.governance.model import EMPTY
from app.sim.occasions import Trigger, mapping, name, number
from app.sim.people import Walk
from app.sim.robot import PAD_FRICTION
from app.sim.sensors import SENSORS, SensorFault
from app.sim.world import CRATE_HALF_M, UNDER_FLOOR_M

if TYPE_CHECKING:
    from app.governance.model import Json
    from app.sim.occasions import Occasions
    from app.sim.perception import Perception
    from app.sim.plant import Plant
    from app.sim.sensors import Sensors

HABITS = ("obstinate", "overconfident", "hung", "dead_reckoning")
SENSOR_FAULTS = ("stuck", "stale", "noisy", "offset", "delayed")
_NAMES = frozenset({"object", "sensor", "fault", "habit"})
_LEAST = {"gain": 0.0, "friction": 0.0, "strength": 0.0, "factor": 0.001}


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault: what, when, how big, and for how long (None: for good)."""

    kind: str
    at: Trigger
    sizes: Mapping[str, Json] = field(default_factory=lambda: EMPTY)
    for_s: float | None = None

    def __post_init__(self) -> None:
        """Refuse a kind or a size that means nothing."""
        if self.kind not in _KINDS:
            raise ValueError(f"fault `{self.kind}`: valid are {', '.join(sorted(_KINDS))}")
        wanted = _KINDS[self.kind][1]
        for unknown in sorted(map(str, set(self.sizes) - set(wanted))):
            raise ValueError(f"fault `{self.kind}` has no size `{unknown}`: valid are {', '.join(wanted)}")
        if "object" in wanted and "object" not in self.sizes:
            raise ValueError(f"fault `{self.kind}` needs `object`: valid is the name of an object of the site")
        self._check_values()
        if self.kind == "sensor" and (
            self.sizes.get("sensor") not in SENSORS or self.sizes.get("fault") not in SENSOR_FAULTS
        ):
            raise ValueError(
                f"sensor fault needs `sensor` ({', '.join(SENSORS)}) and `fault` ({', '.join(SENSOR_FAULTS)})"
            )

        if self.kind == "habit" and self.sizes.get("habit") not in HABITS:
            raise ValueError(f"habit `{self.sizes.get('habit')}`: valid are {', '.join(HABITS)}")

    def _check_values(self) -> None:
        for size, value in self.sizes.items():
            if size in _NAMES:
                name(value, f"fault `{self.kind}`: `{size}`")
            else:
                number(value, f"fault `{self.kind}`: `{size}`", _LEAST.get(size, -inf))
        if self.for_s is not None:
            number(self.for_s, f"fault `{self.kind}`: `for_s`", 0.0)

    @classmethod
    def read(cls, data: Json) -> Fault:
        """Read a fault from plain data: kind, at, for_s and its sizes side by side.

        Raises:
            ValueError: an unknown kind, key or trigger, or a size that is none.
        """
        fields = dict(mapping(data, "fault"))
        kind, at, for_s = str(fields.pop("kind", "")), Trigger.read(fields.pop("at", 0.0)), fields.pop("for_s", None)
        lasts_s = None if for_s is None else number(for_s, f"fault `{kind}`: `for_s`", 0.0)
        return cls(kind=kind, at=at, sizes=fields, for_s=lasts_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """Everything that a run adds to the plain workcell: faults and people."""

    faults: tuple[Fault, ...] = ()
    people: tuple[Walk, ...] = ()
    summary: str = ""

    @classmethod
    def read(cls, data: Json) -> Scenario:
        """Read a scenario from plain data: summary, faults, people.

        Raises:
            ValueError: something in it means nothing; the message names it.
        """
        fields = mapping(data, "scenario")
        unknown = set(fields) - {"summary", "faults", "people"}
        if unknown:
            raise ValueError(f"scenario key `{min(map(str, unknown))}`: valid are summary, faults, people")
        faults, people = fields.get("faults") or [], fields.get("people") or []
        if not isinstance(faults, list) or not isinstance(people, list):
            raise ValueError("a scenario's `faults` and `people` are lists")
        return cls(
            faults=tuple(Fault.read(entry) for entry in faults),
            people=tuple(Walk.read(entry) for entry in people),
            summary=str(fields.get("summary", "")),
        )


@dataclass(frozen=True, slots=True)
class Victim:
    """The parts of a workcell that faults get at."""

    plant: Plant
    sensors: Sensors
    perception: Perception
    habits: set[str]


class FaultClock:
    """Begins and ends faults at their moments; plain data, so that a snapshot can carry it."""

    def __init__(self, faults: tuple[Fault, ...]) -> None:
        """Start with nothing broken."""
        self._waiting = list(faults)
        self._active: list[tuple[float, Fault]] = []

    def advance(self, time_s: float, occasions: Occasions, victim: Victim) -> None:
        """Begin and end what is due."""
        if not self._waiting and not self._active:
            return
        for fault in list(self._waiting):
            due = occasions.due(fault.at)
            if due is not None and time_s >= due:
                self._waiting.remove(fault)
                _KINDS[fault.kind][0](victim, fault.sizes, True)
                if fault.for_s is not None:
                    self._active.append((time_s + fault.for_s, fault))
        for end, fault in list(self._active):
            if time_s >= end:
                self._active.remove((end, fault))
                _KINDS[fault.kind][0](victim, fault.sizes, False)


def _number(sizes: Mapping[str, Json], size: str, default: float) -> float:
    return number(sizes.get(size, default), f"fault size `{size}`")


def _grip_gain(victim: Victim, sizes: Mapping[str, Json], begin: bool) -> None:
    victim.plant.drives.grip_gain = _number(sizes, "gain", 0.1) if begin else 1.0


def _speed_scaling(victim: Victim, sizes: Mapping[str, Json], begin: bool) -> None:
    victim.plant.drives.speed_gain = _number(sizes, "gain", 1.5) if begin else 1.0


def _slippery(victim: Victim, sizes: Mapping[str, Json], begin: bool) -> None:
    victim.plant.make_slippery(str(sizes["object"]), _number(sizes, "friction", 0.05) if begin else PAD_FRICTION[0])


def _missing(victim: Victim, sizes: Mapping[str, Json], begin: bool) -> None:
    if begin:
        victim.plant.place_object(str(sizes["object"]), -1.0, -1.0, UNDER_FLOOR_M)


def _blocked(victim: Victim, sizes: Mapping[str, Json], begin: bool) -> None:
    if begin:
        x, y, z = _number(sizes, "x_m", 3.4), _number(sizes, "y_m", 3.6), _number(sizes, "z_m", CRATE_HALF_M[2])
        victim.plant.place_crate("crate_1", x, y, z)
    else:
        victim.plant.remove_crate("crate_1")
        victim.perception.crates.clear()


def _odometry_bias(victim: Victim, sizes: Mapping[str, Json], begin: bool) -> None:
    victim.sensors.odometry_bias = (_number(sizes, "x_mps", 0.0), _number(sizes, "y_mps", 0.0)) if begin else (0.0, 0.0)


def _payload_shift(victim: Victim, sizes: Mapping[str, Json], begin: bool) -> None:
    thing, factor, offset = str(sizes["object"]), _number(sizes, "factor", 2.0), _number(sizes, "offset_m", 0.0)
    victim.plant.scale_mass(thing, factor if begin else 1.0 / factor)
    if offset != 0.0:
        victim.plant.shift_mass(thing, offset if begin else 0.0)


def _sensor(victim: Victim, sizes: Mapping[str, Json], begin: bool) -> None:
    sensor, fault, size = str(sizes["sensor"]), str(sizes["fault"]), _number(sizes, "size", 0.0)
    if sensor == "objects":
        victim.perception.fault = (fault, size) if begin else None
    elif begin:
        victim.sensors.faults[sensor] = SensorFault(fault, size)
    else:
        victim.sensors.faults.pop(sensor, None)


def _fade(victim: Victim, sizes: Mapping[str, Json], begin: bool) -> None:
    victim.plant.weaken(_number(sizes, "strength", 0.3) if begin else 1.0)


def _misplaced(victim: Victim, sizes: Mapping[str, Json], begin: bool) -> None:
    if begin:
        thing = str(sizes["object"])
        at, yaw, _ = victim.plant.true_object(thing)
        x, y = at[0] + _number(sizes, "x_m", 0.0), at[1] + _number(sizes, "y_m", 0.0)
        victim.plant.place_object(thing, x, y, at[2], yaw)


def _habit(victim: Victim, sizes: Mapping[str, Json], begin: bool) -> None:
    (victim.habits.add if begin else victim.habits.discard)(str(sizes["habit"]))


_KINDS: dict[str, tuple[Callable[[Victim, Mapping[str, Json], bool], None], tuple[str, ...]]] = {
    "grip_gain": (_grip_gain, ("gain",)),
    "speed_scaling": (_speed_scaling, ("gain",)),
    "slippery": (_slippery, ("object", "friction")),
    "missing": (_missing, ("object",)),
    "blocked": (_blocked, ("x_m", "y_m", "z_m")),
    "odometry_bias": (_odometry_bias, ("x_mps", "y_mps")),
    "payload_shift": (_payload_shift, ("object", "factor", "offset_m")),
    "sensor": (_sensor, ("sensor", "fault", "size")),
    "fade": (_fade, ("strength",)),
    "misplaced": (_misplaced, ("object", "x_m", "y_m")),
    "habit": (_habit, ("habit",)),
}
