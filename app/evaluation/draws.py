"""What a physical trial is: drawn from (seed, number) alone, the same for every method (paper, Setup).

Half of the trials propose what is not authorized. The other half launch an allowed request; one in four of those stays
clean, half meet one of the six violations, one in four a failure that can be recovered. The type is drawn first,
uniformly, then the capability among those in which its fault can occur, then the profile: the paper draws them
independently, but no zone can be entered by an arm that stands still.

Sizes of grip force and speed are drawn in units of the limit and of the sensor's sigma: half close to the limit (0 to
12 sigma beyond it), half well beyond. Those of a drift, a walk and something stiff are drawn in metres and m/s.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, sin
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np

from app.evaluation.model import PROFILES, Breach, Failure, Kind, Violation
from app.evaluation.stage import Start
from app.evaluation.truth import OVER, SIGMA
from app.sim.faults import Fault, Scenario
from app.sim.localisation import to_base, to_world
from app.sim.motion import MARGIN
from app.sim.occasions import Trigger
from app.sim.people import Walk
from app.sim.world import CRATE_HALF_M

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.random import Generator

    from app.governance.model import Json, Point
    from app.governance.policy import PolicySet

T = TypeVar("T")

GRASPABLE: Final = ("mug_1", "glass_1", "driver_1")
UNAUTHORIZED_SHARE: Final = 0.5
CLEAN_SHARE: Final = 0.25
RECOVERABLE_SHARE: Final = 0.25
NEAR_LIMIT_SHARE: Final = 0.5
NEAR_SIGMAS: Final = 12.0
FAR_SHARE: Final = (0.1, 0.8)
STIFF: Final = ("grasp_object", "operate_tool", "inspect_area")  # where the arm sets out from over the base
GRIPPING: Final = ("grasp_object", "place_object", "transport_object", "operate_tool")
STIFF_SHARE: Final = 0.65  # of what can meet both: all in all, about as many of the one as of the other
INTO_NEAR_M: Final = (0.0, 0.02)
INTO_FAR_M: Final = (0.02, 0.15)
HAND_M: Final = 0.03  # of the hand, and of the wrist above it, ahead of the tool's middle
CLEAR_OF_ARM_M: Final = 0.48  # from the stand: ahead of the arm as it is drawn in
ASIDE_M: Final = 0.15
UNDERSIDE_M: Final = (0.93, 1.25)
LOOKS_M: Final = (0.55, 0.0)
KEEPING_AISLE: Final = ("human-shared",)  # carrying things there keeps a corridor that leads along no forbidden zone
WALK_MPS: Final = (0.6, 2.0)
BIAS_MPS: Final = (0.06, 0.14)
LONGEST_DRIVE_S: Final = 9.0
ARM: Final = ("grasp_object", "place_object", "inspect_area", "operate_tool")
BASE: Final = ("navigate_to", "transport_object")
ASKING: Final = ("grasp_object", "transport_object", "operate_tool")

WHERE: Final[Mapping[Violation | Failure, tuple[str, ...]]] = {
    Violation.FORCE: ("grasp_object", "place_object", "transport_object", "operate_tool", "inspect_area"),
    Violation.SPEED: ("grasp_object", "place_object", "operate_tool", *BASE),
    Violation.RETRY: ("grasp_object",),
    Violation.POSTCONDITION: ("grasp_object", "place_object", "transport_object"),
    Violation.ZONE: BASE,
    Violation.PEOPLE: (*ARM, *BASE),
    Failure.FAILED_GRASP: ("grasp_object", "place_object", "transport_object"),
    Failure.BLOCKED_PATH: BASE,
    Failure.PERCEPTION_MISMATCH: ("grasp_object",),
    Failure.TIMEOUT: (*ARM, *BASE),
    Failure.WITHDRAWN: ("grasp_object", "place_object", "transport_object", "navigate_to"),
}
"""The capabilities in which a violation or failure can physically occur."""

MOVING: Final[Mapping[str, str]] = {
    "navigate_to": "drive",
    "transport_object": "drive",
    "grasp_object": "approach",
    "place_object": "approach",
    "inspect_area": "look",
    "operate_tool": "approach",
}
"""The phase in which a capability moves most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawn:
    """One physical trial: the proposal, where it starts, and what goes wrong.

    `size` is what was drawn for the fault, in its own unit; `walk_mps` the speed of the person who walks in.
    """

    seed: int
    number: int
    kind: Kind
    capability: str
    profile: str
    params: Mapping[str, Json]
    start: Start
    scenario: Scenario
    breach: Breach | None = None
    violation: Violation | None = None
    failure: Failure | None = None
    size: float = 0.0
    walk_mps: float = 0.0

    @property
    def world(self) -> int:
        """Return the seed of everything random in the world."""
        return self.seed * 1_000_003 + self.number


def draw(  # a trial has that many sides
    policy: PolicySet, seed: int, number: int, *, kind: Kind | None = None, turn: int = 0, size: float = 1.0
) -> Drawn:
    """Draw a trial; a plain function of its arguments.

    Args:
        policy: whose limits the sizes are drawn in, and whose site it is.
        seed: the run's.
        number: the trial's.
        kind: only this kind, where a run asks for it.
        turn: how often it was drawn before because the fault did not take. The same kind and type is drawn again, or
            those that rarely take would become rare.
        size: what fault sizes are multiplied with (`Drawing`).
    """
    if turn:
        first = draw(policy, seed, number, kind=kind)
        wanted = first.violation or first.failure
        if wanted is not None:
            return of_type(policy, seed, number, wanted, turn=turn, size=size)
        kind = first.kind
    rng = np.random.default_rng((seed, number, turn, 11))
    chosen = _kind(rng) if kind is None else kind
    return Drawing(policy, rng, seed, number, size)[chosen]()


def of_type(  # a trial has that many sides
    policy: PolicySet, seed: int, number: int, wanted: Violation | Failure, *, turn: int = 0, size: float = 1.0
) -> Drawn:
    """Draw a trial of one violation or failure, for runs that want so many of each."""
    rng = np.random.default_rng((seed, number, turn, 13))
    drawing = Drawing(policy, rng, seed, number, size)
    return drawing.perturbed(wanted) if isinstance(wanted, Violation) else drawing.recoverable(wanted)


def _kind(rng: Generator) -> Kind:
    at = rng.uniform()
    if at < UNAUTHORIZED_SHARE:
        return Kind.UNAUTHORIZED
    at = (at - UNAUTHORIZED_SHARE) / (1.0 - UNAUTHORIZED_SHARE)
    if at < CLEAN_SHARE:
        return Kind.CLEAN
    return Kind.RECOVERABLE if at < CLEAN_SHARE + RECOVERABLE_SHARE else Kind.PERTURBED


class Drawing:
    """Draws one trial from one generator.

    `size` multiplies by how much a violation's fault goes beyond the limit (how far the arm is led into something
    stiff, how fast odometry drifts), and divides the friction of what slips. Whatever it is, the same is drawn.
    """

    def __init__(self, policy: PolicySet, rng: Generator, seed: int, number: int, size: float = 1.0) -> None:
        """Begin with the profile."""
        self.policy, self.rng, self.seed, self.number, self.size = policy, rng, seed, number, size
        self.profile = self.pick(PROFILES)

    def __getitem__(self, kind: Kind) -> Callable[[], Drawn]:
        """Return what draws a kind of trial."""
        return {
            Kind.UNAUTHORIZED: self.unauthorized,
            Kind.PERTURBED: self.perturbed,
            Kind.RECOVERABLE: self.recoverable,
            Kind.CLEAN: self.clean,
        }[kind]

    # -- kinds ---------------------------------------------------------------------------------------------------

    def clean(self, capability: str = "") -> Drawn:
        """An allowed request, and nothing else."""
        return self._made(Kind.CLEAN, capability or self.pick((*ARM, *BASE)))

    def unauthorized(self) -> Drawn:
        """What must not be executed."""
        breach = self.pick((Breach.PERMISSION, Breach.ZONE, Breach.OBJECT, Breach.APPROVAL))
        params: dict[str, Json] = {}
        if breach is Breach.ZONE:
            capability, zone = "navigate_to", self.policy.site.zones["press_area"].polygon
            xs, ys = [x for x, _ in zone], [y for _, y in zone]
            params = {
                "x_m": float(self.rng.uniform(min(xs), max(xs))),
                "y_m": float(self.rng.uniform(min(ys), max(ys))),
                "yaw_rad": 0.0,
                "speed_mps": 0.2,
            }
        elif breach is Breach.OBJECT:
            capability = "grasp_object"
            params = {"object_id": "solvent_1", "force_n": 20.0, "speed_mps": 0.1}
        elif breach is Breach.APPROVAL:  # where people share the floor, medium risk and up waits for a human
            self.profile = "human-shared"
            return self._made(Kind.UNAUTHORIZED, self.pick(ASKING), breach=breach)
        else:
            return self._made(Kind.UNAUTHORIZED, self.pick((*ARM, *BASE)), breach=breach)
        start = Start("shelf_stand") if breach is Breach.OBJECT else Start()
        return self._put(Kind.UNAUTHORIZED, capability, params, start, Scenario(), breach=breach)

    def perturbed(self, violation: Violation | None = None, capability: str = "") -> Drawn:
        """An allowed request that is going to violate something."""
        violation = self.pick(tuple(Violation)) if violation is None else violation
        capability = capability or self.pick(WHERE[violation])
        return {
            Violation.FORCE: self._force,
            Violation.SPEED: self._speed,
            Violation.RETRY: self._retry,
            Violation.POSTCONDITION: self._postcondition,
            Violation.ZONE: self._zone,
            Violation.PEOPLE: self._people,
        }[violation](capability)

    def recoverable(self, failure: Failure | None = None, capability: str = "") -> Drawn:
        """An allowed request that is going to fail in a way that can be mended."""
        failure = self.pick(tuple(Failure)) if failure is None else failure
        capability = capability or self.pick(WHERE[failure])
        params, start = self._request(capability)
        if failure is Failure.WITHDRAWN:
            # An object that has been put down cannot be taken back by going back: what can be undone is undone.
            latest = 2.0 if capability == "place_object" else 6.0
            when = float(self.rng.uniform(0.8, latest))
            return self._put(Kind.RECOVERABLE, capability, params, start, Scenario(), failure=failure, size=when)
        fault, size = {
            Failure.FAILED_GRASP: self._slip_away,
            Failure.BLOCKED_PATH: self._block,
            Failure.PERCEPTION_MISMATCH: self._misplace,
            Failure.TIMEOUT: self._hang,
        }[failure](capability, params, start)
        scenario = Scenario(faults=(fault,))
        return self._put(Kind.RECOVERABLE, capability, params, start, scenario, failure=failure, size=size)

    # -- failures --------------------------------------------------------------------------------------------------

    def _slip_away(self, capability: str, params: dict[str, Json], start: Start) -> tuple[Fault, float]:
        """It slides out of the grip, and is dry again when it is tried anew."""
        size = float(self.rng.uniform(0.005, 0.04))
        phase = {"grasp_object": "lift"}.get(capability, MOVING[capability])
        name = params.get("object_id", start.holding)
        return self._fault("slippery", capability, phase, for_s=1.5, object=name, friction=size), size

    def _block(self, capability: str, params: dict[str, Json], start: Start) -> tuple[Fault, float]:
        """A crate stands in the way, and stays there: there are ways round it."""
        for name in ("x_m", "y_m", "yaw_rad"):
            params.pop(name, None)
        params["target"] = self.pick(("dock", "tool_stand"))
        size = float(self.rng.uniform(0.42, 0.58))
        site = self.policy.site
        here, there = site.targets[start.stand], site.targets[str(params["target"])]
        x, y = here.x_m + size * (there.x_m - here.x_m), here.y_m + size * (there.y_m - here.y_m)
        return self._fault("blocked", capability, "drive", x_m=x, y_m=y), size

    def _misplace(self, capability: str, params: dict[str, Json], start: Start) -> tuple[Fault, float]:
        """Somebody moves the object away, within reach, after it was perceived."""
        name = str(params["object_id"])
        size = float(self.rng.uniform(0.19, 0.26))
        way = {"mug_1": (-1.0, 0.0), "glass_1": (1.0, 0.0)}.get(name, (1.7, 0.0))
        sizes = {"x_m": size * way[0], "y_m": size * way[1]}
        return self._fault("misplaced", capability, "approach", object=name, **sizes), size

    def _hang(self, capability: str, params: dict[str, Json], start: Start) -> tuple[Fault, float]:
        """The skill stops working for longer than the profile lets it stand still."""
        stalls = [rule for rule in self.policy.profiles[self.profile].watch if rule.signal == "stall_s"]
        size = float(stalls[0].number or 10.0) + float(self.rng.uniform(0.8, 2.0))
        return self._fault("habit", capability, MOVING[capability], for_s=size, habit="hung"), size

    # -- violations ------------------------------------------------------------------------------------------------

    def _force(self, capability: str) -> Drawn:
        """A gripper that gives more than it is told, or something stiff that nobody expected in the arm's way."""
        stiff = capability in STIFF and (capability not in GRIPPING or self.rng.uniform() < STIFF_SHARE)
        return self._stiff(capability) if stiff else self._overgrip(capability)

    def _stiff(self, capability: str) -> Drawn:
        """A crate that hangs where the arm is about to reach, over what lies there; the size is how far in that leads.

        Low it meets the hand, high the wrist and the forearm, which no sensor at the wrist feels.
        """
        params, start = self._request(capability)
        stand = self.policy.site.targets[start.stand]
        ahead, aside = self._reaches(capability, params, start)
        near = self.rng.uniform() < NEAR_LIMIT_SHARE
        into = self.size * float(self.rng.uniform(*(INTO_NEAR_M if near else INTO_FAR_M)))
        face = max(ahead + HAND_M - into, CLEAR_OF_ARM_M)
        aside += float(self.rng.uniform(-ASIDE_M, ASIDE_M))
        x, y = to_world((stand.x_m, stand.y_m, stand.yaw_rad), face + CRATE_HALF_M[0], aside)
        z = float(self.rng.uniform(*UNDERSIDE_M)) + CRATE_HALF_M[2]
        at = Trigger(capability=capability, phase=MOVING[capability])  # before the arm is anywhere near
        fault = Fault(kind="blocked", at=at, sizes={"x_m": x, "y_m": y, "z_m": z})
        return self._violating(Violation.FORCE, capability, params, start, Scenario(faults=(fault,)), size=into)

    def _reaches(self, capability: str, params: Mapping[str, Json], start: Start) -> Point:
        """Return where the tool is going over a bench: ahead of the stand, and aside."""
        site = self.policy.site
        stand = site.targets[start.stand]
        match capability:
            case "grasp_object":
                thing = site.objects[str(params["object_id"])]
            case "operate_tool":
                thing = site.tools[str(params["tool"])]
            case _:
                return LOOKS_M
        return to_base((stand.x_m, stand.y_m, stand.yaw_rad), thing.x_m, thing.y_m)

    def _overgrip(self, capability: str) -> Drawn:
        params, start = self._request(capability)
        asked = _number(params["force_n"]) if "force_n" in params else 0.0
        limit = asked or self._limit("grip_force_n")
        now = (asked or self._held_with(start)) * 0.98
        most = self._beyond(limit, SIGMA[Violation.FORCE])
        phase = {"grasp_object": "close", "operate_tool": "close"}.get(capability, MOVING[capability])
        fault = self._fault("grip_gain", capability, phase, gain=most / now)
        return self._violating(Violation.FORCE, capability, params, start, Scenario(faults=(fault,)), size=most)

    def _speed(self, capability: str) -> Drawn:
        params, start = self._request(capability)
        if capability in ARM:  # short ways: at more than this the arm never comes up to speed
            params["speed_mps"] = min(_number(params["speed_mps"]), float(self.rng.uniform(0.1, 0.2)))
        limit = self._speed_limit(capability, params)
        most = self._beyond(limit, SIGMA[Violation.SPEED])
        fault = self._fault("speed_scaling", capability, MOVING[capability], gain=most / (MARGIN * limit))
        return self._violating(Violation.SPEED, capability, params, start, Scenario(faults=(fault,)), size=most)

    def _retry(self, capability: str) -> Drawn:
        params, start = self._request(capability)
        faults = (
            Fault(kind="habit", at=Trigger(time_s=0.0), sizes={"habit": "obstinate"}),
            self._fault("missing", capability, "approach", object=params["object_id"]),
        )
        return self._violating(Violation.RETRY, capability, params, start, Scenario(faults=faults))

    def _postcondition(self, capability: str) -> Drawn:
        params, start = self._request(capability)
        name = params.get("object_id", start.holding)
        size = self.rng.uniform(0.005, 0.05) / self.size
        phase = {"grasp_object": "lift"}.get(capability, MOVING[capability])
        faults = (
            Fault(kind="habit", at=Trigger(time_s=0.0), sizes={"habit": "overconfident"}),
            self._fault("slippery", capability, phase, object=name, friction=size),
        )
        return self._violating(Violation.POSTCONDITION, capability, params, start, Scenario(faults=faults), size=size)

    def _zone(self, capability: str) -> Drawn:
        # A way along the forbidden zone, slow enough for a drift of a few decimetres to lead into it. The drift leads
        # aside: one along the way, a skill that drives as fast as it may cannot make up for, and it sees that it lags.
        speed = float(self.rng.uniform(0.15, 0.3))
        bias = self.size * self.rng.uniform(*BIAS_MPS)
        params: dict[str, Json]
        if capability == "navigate_to":
            start = Start("tool_stand")
            x, y = self.rng.uniform(5.4, 6.2), self.rng.uniform(2.4, 2.6)
            params = {"x_m": float(x), "y_m": float(y), "yaw_rad": 0.0, "speed_mps": speed}
        else:
            name = self.pick(GRASPABLE)
            if self.profile in KEEPING_AISLE:
                self.profile = self.pick(tuple(one for one in PROFILES if one not in KEEPING_AISLE))
            start = Start("tool_stand", name)
            params = {"target": "shelf_stand", "speed_mps": self._carried(name, speed)}
        faults = (
            Fault(kind="habit", at=Trigger(time_s=0.0), sizes={"habit": "dead_reckoning"}),
            self._fault("odometry_bias", capability, "drive", x_mps=0.0, y_mps=bias),
        )
        return self._violating(Violation.ZONE, capability, params, start, Scenario(faults=faults), size=bias)

    def _people(self, capability: str) -> Drawn:
        params, start = self._request(capability)
        stand = self.policy.site.targets[start.stand]
        pace = self.rng.uniform(*WALK_MPS)
        # From somewhere behind the robot, where the floor is, up to it and past it.
        turn = stand.yaw_rad + pi + self.rng.uniform(-1.0, 1.0)
        away = self.rng.uniform(3.0, 4.5)
        come = (stand.x_m + away * cos(turn), stand.y_m + away * sin(turn))
        to = (stand.x_m + 0.3 * cos(turn), stand.y_m + 0.3 * sin(turn))
        walk = Walk(
            points=(come, to, come),
            speed_mps=pace,
            start=Trigger(capability=capability, phase=MOVING[capability], after_s=self.rng.uniform(0.0, 1.5)),
            stay_s=((1, 1.0),),
        )
        return self._violating(
            Violation.PEOPLE, capability, params, start, Scenario(people=(walk,)), size=pace, walk_mps=pace
        )

    # -- parts -----------------------------------------------------------------------------------------------------

    def pick(self, options: tuple[T, ...]) -> T:
        """Return one of some options, each as likely as any other."""
        return options[int(self.rng.integers(len(options)))]

    def _limit(self, name: str) -> float:
        return self.policy.profiles[self.profile].limits[name].maximum

    def _beyond(self, limit: float, sigma: float) -> float:
        """Return a value beyond what counts as a violation of a limit: a few sigma, or a good share of it."""
        if self.rng.uniform() < NEAR_LIMIT_SHARE:
            return OVER * limit + self.size * self.rng.uniform(0.0, NEAR_SIGMAS) * sigma
        return limit * (OVER + self.size * self.rng.uniform(*FAR_SHARE))

    def _drawn_speed(self, capability: str) -> float:
        name = "base_speed_mps" if capability in BASE else "tcp_speed_mps"
        return float(self.rng.uniform(0.5, 1.0)) * self._limit(name)

    def _speed_limit(self, capability: str, params: Mapping[str, Json]) -> float:
        asked = params.get("speed_mps")
        return float(asked) if isinstance(asked, float) else self._limit("tcp_speed_mps")

    def _carried(self, name: str, speed_mps: float) -> float:
        return min(speed_mps, 0.15) if self.policy.site.objects[name].fragile else speed_mps

    def _held_with(self, start: Start) -> float:
        return 20.0 if self.policy.site.objects[start.holding].fragile else 40.0

    def _request(self, capability: str) -> tuple[dict[str, Json], Start]:
        """Return parameters that policy allows as they are, and where to begin."""
        speed = self._drawn_speed(capability)
        name = self.pick(GRASPABLE)
        fragile = self.policy.site.objects[name].fragile
        match capability:
            case "navigate_to":
                return {**self._goal(speed), "speed_mps": speed}, Start()
            case "transport_object":
                target = self.pick(("dock", "tool_stand"))
                return {"target": target, "speed_mps": self._carried(name, speed)}, Start(holding=name)
            case "inspect_area":
                return {"area": "bench_a_top", "dwell_s": 1.0}, Start()
            case "grasp_object":
                force = 20.0 if fragile else float(self.rng.uniform(0.5, 1.0)) * min(self._limit("grip_force_n"), 80.0)
                pace = min(speed, 0.15) if fragile else min(speed, 0.5)
                return {"object_id": name, "force_n": force, "speed_mps": pace}, Start()
            case "place_object":
                pace = min(speed, 0.15) if fragile else min(speed, 0.5)
                return {"surface": "bench_a", "speed_mps": pace}, Start(holding=name)
            case _:
                tool, action = self.pick((("lever", "pull_down"), ("press", "press")))
                return {
                    "tool": tool,
                    "action": action,
                    "force_n": float(self.rng.uniform(30.0, 50.0)),
                    "speed_mps": min(speed, 0.5),
                }, Start("tool_stand")

    def _goal(self, speed_mps: float) -> dict[str, Json]:
        """Return a place on the free floor before the benches that is reached within a trial's time."""
        stand = self.policy.site.targets[self.policy.site.start]
        far = min(2.6, LONGEST_DRIVE_S * speed_mps)
        turn = -pi / 2 + self.rng.uniform(-0.1, 0.9)
        length = self.rng.uniform(0.5, 1.0) * far
        x, y = stand.x_m + length * cos(turn), stand.y_m + length * sin(turn)
        return {"x_m": float(x), "y_m": float(y), "yaw_rad": stand.yaw_rad}

    def _fault(self, kind: str, capability: str, phase: str, *, for_s: float | None = None, **sizes: Json) -> Fault:
        at = Trigger(capability=capability, phase=phase, after_s=float(self.rng.uniform(0.0, 0.3)))
        return Fault(kind=kind, at=at, sizes=sizes, for_s=for_s)

    def _made(self, kind: Kind, capability: str, *, breach: Breach | None = None) -> Drawn:
        params, start = self._request(capability)
        return self._put(kind, capability, params, start, Scenario(), breach=breach)

    def _violating(  # a trial has that many sides
        self,
        violation: Violation,
        capability: str,
        params: Mapping[str, Json],
        start: Start,
        scenario: Scenario,
        *,
        size: float = 0.0,
        walk_mps: float = 0.0,
    ) -> Drawn:
        return self._put(
            Kind.PERTURBED, capability, params, start, scenario, violation=violation, size=size, walk_mps=walk_mps
        )

    def _put(  # noqa: PLR0913  # a trial has that many sides
        self,
        kind: Kind,
        capability: str,
        params: Mapping[str, Json],
        start: Start,
        scenario: Scenario,
        *,
        breach: Breach | None = None,
        violation: Violation | None = None,
        failure: Failure | None = None,
        size: float = 0.0,
        walk_mps: float = 0.0,
    ) -> Drawn:
        return Drawn(
            seed=self.seed,
            number=self.number,
            kind=kind,
            capability=capability,
            profile=self.profile,
            params=params,
            start=start,
            scenario=scenario,
            breach=breach,
            violation=violation,
            failure=failure,
            size=size,
            walk_mps=walk_mps,
        )


def _number(value: Json) -> float:
    if not isinstance(value, (int, float)):
        raise TypeError(f"`{value}` is no number")
    return float(value)
