"""A small honest robot for the runner's tests: it integrates what it is commanded, and its sensors can be made to lie.

Also the kernel's side of a launch (a throwaway key, authorizations, recoveries), plans without a policy, and the same
runner on the simulated workcell under the shipped policy.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.cell.journal import Entry, Journal
from app.cell.latch import Latch
from app.cell.runner import Runner
from app.cell.substrate import SubstrateError
from app.governance.model import (
    Authorization,
    Bounds,
    Command,
    CoveredRecovery,
    Fix,
    Intervention,
    Mode,
    Observation,
    Params,
    PersonTrack,
    RecoveryPlan,
    RecoveryRule,
    Response,
    Risk,
    SensorStamps,
    Separation,
    Signal,
    SkillReport,
    SkillState,
    Strategy,
    WatchPlan,
    WatchRule,
    WorldFacts,
)
from app.governance.permit import Grant, SignedAuthorization, mint

STILL = (0.0,) * 6
HOME = (0.0, -1.2, 1.4, -0.2, 1.0, 0.0)
REACH_M = 0.4  # the fake arm is one long first joint: its hand moves sideways on a circle of this radius
JACOBIAN = (0.0,) * 6 + (REACH_M, 0.0, 0.0, 0.0, 0.0, 0.0) + (0.0,) * 6
KEY = Ed25519PrivateKey.generate()
DIGEST = "sha256:policy"
NOW_S = 1_000_000.0


@dataclass
class FakeSkill:
    """Moves the base forward and the first joint round at given speeds until a distance is done."""

    cell: FakeCell
    capability: str
    params: Mapping[str, object]
    careful: bool
    progress: float = 0.0
    phase: str = "move"
    acted: int = 0

    def act(self, observation: Observation, rate: float) -> Command:
        self.acted += 1
        script = self.cell.script
        if script.raises is not None and self.acted > script.raises_after:
            raise script.raises
        speed = script.base_mps * (0.5 if self.careful else 1.0) * rate
        turn = script.joint_radps * rate
        held = self.cell.hold()
        joints = (held.joint_rad[0] + turn * self.cell.period_s, *held.joint_rad[1:])
        self.progress = min(1.0, self.progress + rate / script.ticks)
        self.phase = "release" if self.progress > 0.5 and script.releases else "move"
        if self.progress >= 1.0:
            return held._replace(grip_force_n=script.grip_n)
        return Command(joints, (turn, *STILL[1:]), (speed, 0.0, 0.0), script.grip_n)

    def report(self) -> SkillReport:
        script = self.cell.script
        failure = script.fails.get((self.capability, self.cell.runs[self.capability]), "")
        if failure and self.progress > 0.3:
            return SkillReport(self.phase, self.progress, SkillState.FAILED, failure)
        done = self.progress >= 1.0
        return SkillReport(self.phase, self.progress, SkillState.SUCCEEDED if done else SkillState.RUNNING)


@dataclass
class Script:
    """What the fake skills do."""

    base_mps: float = 0.2
    joint_radps: float = 0.2
    grip_n: float = 0.0
    ticks: float = 100.0
    releases: bool = False
    fails: dict[tuple[str, int], str] = field(default_factory=dict)
    raises: Exception | None = None
    raises_after: int = 20


class FakeCell:
    """A substrate without physics. `lie` may replace any observation before it is reported."""

    def __init__(self, *, seed: int = 0) -> None:
        self.id = "workcell-1"
        self.period_s = 0.01
        self.script = Script()
        self.lie: Callable[[Observation], Observation] = lambda seen: seen
        self.people: Callable[[float], tuple[tuple[float, float], ...]] = lambda _: ()
        self.unmet: tuple[str, ...] = ()
        self.refuses: dict[str, str] = {}
        self.runs: dict[str, int] = {}
        self.bound: list[tuple[str, dict[str, object], bool]] = []
        self.commands: list[Command] = []
        self.stops: list[int] = []
        self.powered = True
        self.x_m = 2.0
        self.y_m = 2.0
        self._noise = random.Random(seed)  # noqa: S311  # repeatable noise, no secret
        self._grant: Grant | None = None
        self._tick = 0
        self._joints: tuple[float, ...] = HOME
        self._applied = Command(HOME, STILL, (0.0, 0.0, 0.0), 0.0)
        self._seen = self._observe()

    def bind(self, grant: Grant, capability: str, params: Params, *, careful: bool = False) -> FakeSkill:
        if not grant.covers(capability, params):
            raise SubstrateError("not_covered", f"`{capability}`")
        if not self.powered:
            raise SubstrateError("power_off", "reset first")
        if self._grant is not None and self._grant.authorization.id != grant.authorization.id:
            raise SubstrateError("busy", "another grant is bound")
        if capability in self.refuses:
            raise SubstrateError(self.refuses[capability], capability)
        self._grant = grant
        self.runs[capability] = self.runs.get(capability, 0) + 1
        self.bound.append((capability, dict(params), careful))
        return FakeSkill(self, capability, params, careful)

    def unbind(self) -> None:
        self._grant = None

    def hold(self) -> Command:
        return Command(self._applied.joint_rad, STILL, (0.0, 0.0, 0.0), max(0.0, self._applied.grip_force_n))

    def step(self, command: Command) -> Observation:
        self._tick += 1
        self._applied = command if self._grant is not None and self.powered else self.hold()
        self.commands.append(self._applied)
        self.x_m += self._applied.base_velocity[0] * self.period_s
        self._joints = self._applied.joint_rad
        self._seen = self.lie(self._observe())
        return self._seen

    def observe(self) -> Observation:
        return self._seen

    def stop(self, category: int) -> None:
        self.stops.append(category)
        self.powered = False

    def reset(self) -> None:
        self.powered = True

    def facts(self) -> WorldFacts:
        return WorldFacts(
            stamp_s=self._seen.time_s,
            arm_ready=True,
            arm_retracted=True,
            gripper_empty=True,
            holding=None,
            base=(self.x_m, self.y_m, 0.0),
        )

    def scene(self) -> Mapping[str, object]:
        return {}

    def poses(self) -> Callable[[], bytes]:
        return lambda: b""

    def way(self) -> tuple[tuple[float, float], ...]:
        return ()

    def snapshot(self) -> object:
        return self._tick

    def restore(self, state: object) -> None:
        assert isinstance(state, int)
        self._tick = state

    def _observe(self) -> Observation:
        noise = self._noise.gauss
        now_s = self._tick * self.period_s
        sampled_s = math.floor(now_s / 0.05 + 1e-9) * 0.05
        command = self._applied
        vx = command.base_velocity[0] + noise(0.0, 1e-4)
        speeds = tuple(speed + noise(0.0, 1e-4) for speed in command.joint_speed_radps)
        return Observation(
            tick=self._tick,
            time_s=now_s,
            joint_rad=tuple(joint + noise(0.0, 1e-5) for joint in self._joints),
            joint_speed_radps=speeds,
            joint_torque_nm=tuple(20.0 + noise(0.0, 0.5) for _ in range(6)),
            residual_nm=tuple(noise(0.0, 0.5) for _ in range(6)),
            tcp_m=(REACH_M, 0.0, 0.9),
            tcp_speed_mps=abs(speeds[0]) * REACH_M,
            jacobian=JACOBIAN,
            contact_force_n=abs(2.0 + noise(0.0, 0.2)),
            peak_force_n=3.0,
            grip_width_m=0.05,
            grip_force_n=command.grip_force_n + abs(noise(0.0, 0.1)),
            slip_m=0.0,
            pads_loaded=command.grip_force_n > 0.0,
            odometry=(self.x_m + noise(0.0, 1e-4), self.y_m + noise(0.0, 1e-4), 0.0),
            base_velocity=(vx, noise(0.0, 1e-4), 0.0),
            fix=Fix(sampled_s, self.x_m - command.base_velocity[0] * (now_s - sampled_s), self.y_m, 0.0),
            people=tuple(PersonTrack(number, now_s, x, y) for number, (x, y) in enumerate(self.people(now_s))),
            stamps_s=SensorStamps(*(now_s,) * 7),
        )


# -- plans without a policy ------------------------------------------------------------------------------------------


def rule(
    signal: str,
    *,
    above: bool = True,
    threshold: float | None = None,
    response: Response | None = None,
    failure: str = "",
    for_ms: int = 0,
    method: str = "threshold",
    emits: Signal = Signal.VIOLATION,
    name: str = "",
) -> WatchRule:
    return WatchRule(
        id=name or signal,
        signal=signal,
        emits=emits,
        response=response or Response(enter=Intervention.STOP),
        above=above,
        threshold=threshold,
        for_ms=for_ms,
        method=method,
        failure=failure,
    )


KEEP_AWAY = Response(
    enter=Intervention.PAUSE, clear_after_ms=200, then="resume", persist_ms=2000, otherwise=Intervention.ESCALATE
)
GAP = Separation(
    human_speed_mps=1.6,
    reaction_s=0.1,
    stopping_s=0.3,
    intrusion_m=0.2,
    position_uncertainty_m=0.08,
    robot_uncertainty_m=0.05,
)
RULES = (
    rule("separation_m", above=False, response=KEEP_AWAY),
    rule("contact_force_n", threshold=100.0, failure="contact"),
    rule("tcp_speed_mps", threshold=0.26, failure="overspeed", method="cusum"),
    rule("base_speed_mps", threshold=0.32, failure="overspeed"),
    rule("zone_margin_m", above=False, threshold=0.0, failure="zone"),
    rule("slip_m", threshold=0.005, failure="object_lost"),
    rule("grip_lost", threshold=0.5, failure="object_lost"),
    rule("elapsed_s", failure="timeout", emits=Signal.TIMEOUT),
    rule("stall_s", threshold=3.0, failure="stall"),
    rule("sensor_age_ms", response=KEEP_AWAY, failure="sensor_fault"),
    rule("postcondition", threshold=0.5, failure="postcondition_failed"),
)
PLAN = WatchPlan(
    capability="grasp_object",
    profile="human-shared",
    sensitivity=0.9,
    bounds=Bounds(tcp_speed_mps=0.25, base_speed_mps=0.3, grip_force_n=60.0, contact_force_n=100.0),
    rules=RULES,
    zones=(),
    separation=GAP,
    stale_after_ms={"arm": 50, "wrist": 50, "gripper": 50, "odometry": 50, "fix": 300, "people": 300},
    timeout_s=20.0,
    postconditions=("object_secured",),
    params={"object_id": "mug_1"},
)
RECOVERY = RecoveryPlan(
    risk=Risk.MEDIUM,
    can_ask=True,
    rules=(
        RecoveryRule(
            on="object_lost",
            do=(Strategy.RECOVERY_CAPABILITY, Strategy.RETRY, Strategy.ASK_HUMAN),
            capability="release_and_retract",
        ),
        RecoveryRule(on="grasp_failed", do=(Strategy.RETRY, Strategy.ROLLBACK, Strategy.ASK_HUMAN)),
        RecoveryRule(on="postcondition_failed", do=(Strategy.RETRY, Strategy.ROLLBACK, Strategy.ASK_HUMAN)),
        RecoveryRule(on="overspeed", do=(Strategy.SAFER_MODE, Strategy.ASK_HUMAN)),
        RecoveryRule(on="timeout", do=(Strategy.TERMINATE,)),
        RecoveryRule(on="any", do=(Strategy.ASK_HUMAN,)),
    ),
    retry_budget=2,
    rollback="optional",
    rollback_capability="retrace",
    careful_admitted=True,
)
PARAMS: Params = {"object_id": "mug_1"}
COVERED = (
    CoveredRecovery(strategy=Strategy.RETRY, capability="grasp_object", params=PARAMS),
    CoveredRecovery(strategy=Strategy.SAFER_MODE, capability="grasp_object", params=PARAMS, mode=Mode.CAREFUL),
    CoveredRecovery(
        strategy=Strategy.RECOVERY_CAPABILITY, capability="release_and_retract", params={"speed_mps": 0.15}
    ),
    CoveredRecovery(strategy=Strategy.ROLLBACK, capability="retrace", params={"speed_mps": 0.15}),
)
PERMIT = Authorization(
    id="auth-1",
    invocation="inv-1",
    cell="workcell-1",
    capability="grasp_object",
    version="1.0.0",
    params=PARAMS,
    mode=Mode.NORMAL,
    profile="human-shared",
    policy_digest=DIGEST,
    issued_at_s=NOW_S,
    expires_at_s=NOW_S + 30.0,
    recoveries=COVERED,
)


def signed(permit: Authorization = PERMIT, **changes: object) -> SignedAuthorization:
    return mint(replace(permit, **changes), KEY)  # type: ignore[arg-type]


# -- a runner on the fake --------------------------------------------------------------------------------------------


class Rig:
    """A runner on a fake cell, with a real journal, and what a test wants to ask of the two."""

    def __init__(self, folder: Path, *, plan: WatchPlan = PLAN, recovery: RecoveryPlan = RECOVERY) -> None:
        self.cell = FakeCell()
        self.plan, self.recovery = plan, recovery
        self.journal = Journal(folder / "journal", boot="boot-1")
        self.entries: list[Entry] = []
        self.telemetry = bytearray()
        self.now_s = NOW_S + 1.0
        self.runner = self.start()

    def start(self, latch: Latch | None = None) -> Runner:
        runner = Runner(
            self.cell,  # type: ignore[arg-type]
            plan_of=self.plan_of,
            verify=lambda _names, _params, _facts: self.cell.unmet,
            journal=self.journal,
            wall=lambda: self.now_s,
            emit=self.entries.append,
            on_telemetry=lambda _, rows: self.telemetry.extend(rows),
            latch=latch,
        )
        runner.adopt(policy_digest=DIGEST, key=KEY.public_key())
        return runner

    def plan_of(self, grant: Grant, recovery: CoveredRecovery | None = None) -> tuple[WatchPlan, RecoveryPlan]:
        if recovery is None:
            return self.plan, self.recovery
        return replace(self.plan, capability=recovery.capability, params=recovery.params), self.recovery

    def launch(self, **changes: object) -> None:
        assert self.runner.launch(signed(**changes)) is None

    def ticks(self, count: int) -> None:
        for _ in range(count):
            self.runner.tick()

    def until(self, condition: Callable[[], object], within: int = 3000) -> None:
        for _ in range(within):
            if condition():
                return
            self.runner.tick()
        raise AssertionError(f"not within {within} ticks; told: {self.story()}")

    def until_status(self, status: str) -> None:
        self.until(lambda: self.runner.status is not None and self.runner.status.value == status)

    def finish(self) -> dict[str, object]:
        self.until(lambda: self.runner.invocation is None)
        return self.last("outcome")

    def of(self, kind: str) -> list[dict[str, object]]:
        return [entry.body for entry in self.entries if entry.kind == kind]

    def last(self, kind: str) -> dict[str, object]:
        return self.of(kind)[-1]

    def statuses(self) -> list[object]:
        return [body["status"] for body in self.of("status")]

    def story(self) -> list[str]:
        words = ("status", "rule", "strategy", "intervention", "op", "reason", "outcome", "refused", "what", "code")
        return [
            f"{entry.tick} {entry.kind}: "
            + ", ".join(f"{word}={entry.body[word]}" for word in words if entry.body.get(word) is not None)
            for entry in self.entries
        ]

    def runs(self, capability: str) -> int:
        return self.cell.runs.get(capability, 0)

    def moving(self) -> bool:
        return any(self.cell.commands[-1].joint_speed_radps) or any(self.cell.commands[-1].base_velocity)
