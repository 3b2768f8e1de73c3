"""The words of the runtime governance layer as types: what is proposed, decided, authorized, observed and recorded.

Everything here is a value: frozen, comparable, free of behaviour beyond what follows from its own fields. Paper
symbols stand in the docstrings. SI units; the name of a quantity ends in its unit. Types of the control loop
(`Observation`, `Command`) are named tuples, because one of each is built 100 times a second; everything else is a
keyword-only dataclass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"
Params: TypeAlias = Mapping[str, Json]
Vec3: TypeAlias = tuple[float, float, float]
Vec6: TypeAlias = tuple[float, float, float, float, float, float]
Point: TypeAlias = tuple[float, float]

LONGEST_GRANT_S = 900.0  # what a human allowed in advance is asked about again after at most a quarter of an hour
CONTROL_PERIOD_S = 0.01  # 100 Hz control over 500 Hz physics (design, section 4)
EMPTY: Mapping[str, Json] = MappingProxyType({})
NO_CHANGES: Mapping[str, str] = MappingProxyType({})


# -- names -----------------------------------------------------------------------------------------


class Risk(StrEnum):
    """Operational risk level of a capability (paper, Capability Package)."""

    LOW = "low"
    MEDIUM = "medium"
    HIGH = "high"
    CRITICAL = "critical"


class Mode(StrEnum):
    """How carefully a skill runs; SAFER_MODE recovers in `careful`."""

    NORMAL = "normal"
    CAREFUL = "careful"


class AuthorityMode(StrEnum):
    """The paper's five authority modes H."""

    APPROVAL_REQUIRED = "approval-required"
    APPROVAL_ON_ESCALATION = "approval-on-escalation"
    INTERRUPT_ENABLED = "interrupt-enabled"
    TAKEOVER_ENABLED = "takeover-enabled"
    REVIEW_ONLY = "review-only"


class GrantScope(StrEnum):
    """What a standing grant is for: one object, one task, or whatever comes within its time."""

    OBJECT = "object"
    TASK = "task"
    TIME = "time"


class Role(StrEnum):
    """Who speaks over HTTP."""

    AGENT = "agent"
    OPERATOR = "operator"
    ENGINEER = "engineer"
    AUDITOR = "auditor"
    CELL = "cell"


class AdmissionOutcome(StrEnum):
    """Outcome of `admit` (paper, Capability Admission)."""

    ACCEPT = "accept"
    REJECT = "reject"
    DEFER = "defer"
    ESCALATE = "escalate"


class PolicyOutcome(StrEnum):
    """Outcome of `check` (paper, Policy Guard)."""

    ALLOW = "allow"
    MODIFY = "modify"
    DENY = "deny"
    ESCALATE = "escalate"


class Signal(StrEnum):
    """What the watcher says w_t (paper, Stage 5)."""

    NORMAL = "NORMAL"
    WARNING = "WARNING"
    VIOLATION = "VIOLATION"
    TIMEOUT = "TIMEOUT"
    INSTABILITY = "INSTABILITY"
    COMPLETION = "COMPLETION"


class Intervention(StrEnum):
    """i_t = Intervene(w_t, …) (paper, Stage 6)."""

    CONTINUE = "CONTINUE"
    PAUSE = "PAUSE"
    STOP = "STOP"
    ROLLBACK = "ROLLBACK"
    ESCALATE = "ESCALATE"


class Strategy(StrEnum):
    """r_t = Recover(…): the recovery strategies."""

    RETRY = "RETRY"
    RECOVERY_CAPABILITY = "RECOVERY_CAPABILITY"
    ROLLBACK = "ROLLBACK"
    SAFER_MODE = "SAFER_MODE"
    TERMINATE = "TERMINATE"
    ASK_HUMAN = "ASK_HUMAN"


class Status(StrEnum):
    """Status of an invocation: four before launch, six of the session (design, section 3)."""

    REJECTED = "rejected"
    DEFERRED = "deferred"
    DENIED = "denied"
    AWAITING_APPROVAL = "awaiting_approval"
    RUNNING = "running"
    PAUSED = "paused"
    ESCALATED = "escalated"
    RECOVERING = "recovering"
    COMPLETED = "completed"
    FAILED = "failed"


TERMINAL = frozenset({Status.REJECTED, Status.DEFERRED, Status.DENIED, Status.COMPLETED, Status.FAILED})
SESSION = frozenset({Status.RUNNING, Status.PAUSED, Status.ESCALATED, Status.RECOVERING})


class Outcome(StrEnum):
    """o_t: the final label of an invocation."""

    SUCCEEDED = "succeeded"
    RECOVERED = "recovered"
    ROLLED_BACK = "rolled_back"
    TERMINATED = "terminated"
    STOPPED = "stopped"
    CANCELLED = "cancelled"
    TAKEN_OVER = "taken_over"
    REJECTED = "rejected"
    DENIED = "denied"
    DEFERRED = "deferred"
    EXPIRED = "expired"
    FAULT = "fault"


class EventKind(StrEnum):
    """Kinds of recorded events (design, section 9)."""

    PROPOSAL = "proposal"
    ADMISSION = "admission"
    POLICY = "policy"
    ESCALATION = "escalation"
    APPROVAL = "approval"
    AUTHORIZATION = "authorization"
    LAUNCH = "launch"
    ALERT = "alert"
    INTERVENTION = "intervention"
    RECOVERY = "recovery"
    HUMAN = "human"
    GRANT = "grant"
    REVIEW = "review"
    TELEMETRY = "telemetry"
    OUTCOME = "outcome"
    STATUS = "status"
    POLICY_VERSION = "policy_version"
    POLICY_ACTIVATED = "policy_activated"
    SHADOW = "shadow"
    PROFILE_CHANGED = "profile_changed"
    PRINCIPAL = "principal"
    CELL = "cell"
    BOOT = "boot"


# -- proposing and deciding ------------------------------------------------------------------------


class Reason(NamedTuple):
    """Why a decision fell as it did, in terms an agent can replan on.

    `rule` names the determining rule (`human-shared/tcp_speed_mps`), `code` is stable and machine-readable, `remedy`
    says what would be accepted.
    """

    rule: str
    code: str
    message: str
    remedy: str = ""


class Change(NamedTuple):
    """One parameter that policy constrained, and the rule that did it."""

    param: str
    requested: Json
    effective: Json
    rule: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """q_t = (ĉ, x, z): capability, parameters (validated, defaults filled in) and contextual metadata.

    `version` is what of the capability the agent was made for (`semver`); None takes whatever is in force.
    """

    capability: str
    params: Params
    metadata: Params = field(default_factory=lambda: EMPTY)
    mode: Mode = Mode.NORMAL
    preconditions: tuple[str, ...] = ()
    recovery_preference: Strategy | None = None
    version: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentFacts:
    """Who proposes, and what policy permits that identity (never what it claims itself)."""

    name: str
    permissions: frozenset[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectFact:
    """One object as last perceived: position in the world frame, and whether the arm can get at it from here.

    Whether it stands `upright` was not recorded from the start: what does not say so was told of what stood.
    """

    visible: bool
    reachable: bool
    x_m: float
    y_m: float
    z_m: float
    stamp_s: float
    upright: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldFacts:
    """What a cell's sensors say about its world: the part of Γ_t that pre- and postconditions speak of.

    `arm_ready` says that a launch would find the arm at rest and in its place. Power is no part of it: what a stop took
    comes back with the next launch, which a latched stop refuses. `base` is the estimated pose (x_m, y_m, yaw_rad),
    `tools` maps a tool to its state (`raised`, `pressed`, …), `inspected` maps an area to the cell time at which all of
    it had been seen, `holding` names the object in the gripper.
    """

    stamp_s: float
    arm_ready: bool
    arm_retracted: bool
    gripper_empty: bool
    holding: str | None
    base: Vec3
    objects: Mapping[str, ObjectFact] = field(default_factory=dict[str, ObjectFact])
    tools: Mapping[str, str] = field(default_factory=dict[str, str])
    inspected: Mapping[str, float] = field(default_factory=dict[str, float])
    people_count: int = 0
    people_nearest_m: float = 99.0
    sensors_fresh: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class CellFacts:
    """The cell a proposal is aimed at, as the server knows it when it decides.

    `online` is false without a fresh report inside the link's lease; `facts` is None until the first one. `busy`
    names the invocation that has the cell. `recording` is false while the cell cannot write its journal: it
    lets nothing move then.
    """

    id: str
    online: bool
    latched: bool = False
    busy: str | None = None
    holding_link: bool = False
    recording: bool = True
    facts: WorldFacts | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Grant:
    """A human's approval in advance, against approval fatigue: bound on every side, and short.

    It answers for one agent and one capability on one cell, under one profile and one policy, and within that for one
    object, for one task (the proposal's `metadata.task`), or for time alone. Times are seconds since the epoch; no
    grant lives longer than `LONGEST_GRANT_S`.
    """

    id: str
    capability: str
    agent: str
    cell: str
    profile: str
    policy_digest: str
    scope: GrantScope
    issued_by: str
    issued_at_s: float
    expires_at_s: float
    object: str | None = None
    task: str | None = None

    def __post_init__(self) -> None:
        """Refuse a grant without an end, and one whose scope names nothing or something else."""
        if not 0.0 < self.expires_at_s - self.issued_at_s <= LONGEST_GRANT_S:
            raise ValueError(f"a grant lives for more than 0 s and at most {LONGEST_GRANT_S:g} s")
        if (self.object is not None) != (self.scope is GrantScope.OBJECT):
            raise ValueError("a grant names an object where its scope is `object`, and nowhere else")
        if (self.task is not None) != (self.scope is GrantScope.TASK):
            raise ValueError("a grant names a task where its scope is `task`, and nowhere else")


@dataclass(frozen=True, slots=True, kw_only=True)
class Context:
    """Γ_t: everything besides the proposal and the policy that a decision may depend on."""

    time_s: float
    profile: str
    agent: AgentFacts
    cell: CellFacts
    operator_on_duty: bool = False
    grants: tuple[Grant, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Admission:
    """Result of `admit`; never without a reason unless it accepts."""

    outcome: AdmissionOutcome
    reasons: tuple[Reason, ...] = ()
    retry_after_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Result of `check`: outcome, every determining rule, and the constrained proposal.

    `effective` equals the requested parameters unless modifications applied; a MODIFY cannot exist without at least
    one change.
    """

    outcome: PolicyOutcome
    effective: Params
    reasons: tuple[Reason, ...] = ()
    changes: tuple[Change, ...] = ()

    def __post_init__(self) -> None:
        """Refuse a modify that modifies nothing: it could not be told from an allow."""
        if self.outcome is PolicyOutcome.MODIFY and not self.changes:
            raise ValueError("a `modify` verdict needs at least one change")


@dataclass(frozen=True, slots=True, kw_only=True)
class ApprovalNeed:
    """What authority H asks for before launch: how many different people, by when, and what silence means."""

    approvers: int
    within_s: float
    on_timeout: str  # `deny` is the shipped action
    reasons: tuple[Reason, ...]


# -- capabilities and site -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Capability:
    """C_i: a capability package as its manifest declares it.

    `inputs` is a JSON Schema 2020-12 object schema whose numeric properties carry `unit`; `env_profile` maps a
    profile to `allowed`, `guarded`, `approval-required` or `forbidden`; `rollback` names a recovery capability or is
    None; `recovery` marks those that only governance may start. `phases` are what its skill says it is in, in the order
    in which it first is: a phase that is not listed cannot wait for a human. `changes` says in words what came with
    which version.
    """

    name: str
    version: str
    summary: str
    inputs: Params
    preconditions: tuple[str, ...]
    postconditions: tuple[str, ...]
    permissions: frozenset[str]
    risk: Risk
    rollback: str | None
    env_profile: Mapping[str, str]
    timeout_s: float
    recovery: bool = False
    phases: tuple[str, ...] = ()
    changes: Mapping[str, str] = field(default_factory=lambda: NO_CHANGES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Zone:
    """A named polygon on the floor, world frame, counter-clockwise. Kind: `forbidden`, `restricted` or `shared`."""

    name: str
    kind: str
    polygon: tuple[Point, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A named place to stand: pose of the base, world frame. `corridor` names the aisle that leads there, if any."""

    name: str
    x_m: float
    y_m: float
    yaw_rad: float
    corridor: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Surface:
    """A named horizontal surface: centre, half sizes, height of its top, yaw, and the target to stand at."""

    name: str
    x_m: float
    y_m: float
    z_m: float
    half_x_m: float
    half_y_m: float
    yaw_rad: float
    target: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Area:
    """A named area to inspect: polygon, and the target from which it is seen."""

    name: str
    polygon: tuple[Point, ...]
    target: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Corridor:
    """A named corridor: centre line and half width. Motion that has to keep it stays within."""

    name: str
    line: tuple[Point, ...]
    half_width_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteObject:
    """A known object: what policy may ask about it, and where it stands at the start."""

    name: str
    kind: str
    shape: str  # cylinder | box
    size_m: Vec3  # cylinder: radius, radius, half height; box: half sizes
    mass_kg: float
    fragile: bool
    hazardous: bool
    surface: str
    x_m: float
    y_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Tool:
    """A fixed tool at the tool station: its actions, each with the state it ends in."""

    name: str
    kind: str  # lever | button
    x_m: float
    y_m: float
    z_m: float
    target: str
    actions: Mapping[str, str]
    press: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """The workshop: bounds (x0, y0, x1, y1) and everything in it that has a name."""

    bounds_m: tuple[float, float, float, float]
    zones: Mapping[str, Zone]
    targets: Mapping[str, Target]
    surfaces: Mapping[str, Surface]
    areas: Mapping[str, Area]
    corridors: Mapping[str, Corridor]
    objects: Mapping[str, SiteObject]
    tools: Mapping[str, Tool]
    start: str


# -- watching --------------------------------------------------------------------------------------


class Fix(NamedTuple):
    """An absolute position fix: when it was taken (cell time) and the base pose it says, world frame."""

    stamp_s: float
    x_m: float
    y_m: float
    yaw_rad: float


class PersonTrack(NamedTuple):
    """One person as the tracker saw them: identity within the tracker, when, where (world frame)."""

    person: int
    stamp_s: float
    x_m: float
    y_m: float


class SensorStamps(NamedTuple):
    """Cell time of the newest sample of each sensor; what staleness is judged by."""

    arm: float
    wrist: float
    gripper: float
    odometry: float
    fix: float
    people: float
    objects: float


class Frames(NamedTuple):
    """What the newest raw sample of each sensor that looks around adds up to: noise makes it another number each time.

    A picture that comes again under a new stamp shows no more what is there, and neither does one that shows nobody.
    """

    fix: float
    people: float
    objects: float


class Sighting(NamedTuple):
    """A loose object as one raw picture shows it: its name in the site, and where (world frame)."""

    name: str
    x_m: float
    y_m: float


class Observation(NamedTuple):
    """Ω: what the sensors say in one control tick, never the simulator's truth.

    Frames: `tcp_m` and `jacobian` (3 × 6, row-major, d tcp / d joint) are relative to the base; `odometry` (x_m, y_m,
    yaw_rad) is dead reckoning in the world frame and drifts; `base_velocity` (vx, vy m/s in the base frame, wz rad/s)
    comes from the drives. `joint_torque_nm` is averaged over the substeps; `residual_nm` is the momentum residual,
    what pushes on the joints from outside, positive where it turns them forward.
    `contact_force_n` is the magnitude at the wrist, compensated for gripper and load, averaged over the tick;
    `peak_force_n` its highest substep. `slip_m` is in-hand slip since the grip closed. `frames` is None where samples
    carry no noise, or give nothing to tell one from the next by: then what is frozen while it stands goes unnoticed.
    `sightings` are of the newest picture, before anything is averaged; empty where the cell has no cameras.
    """

    tick: int
    time_s: float
    joint_rad: Vec6
    joint_speed_radps: Vec6
    joint_torque_nm: Vec6
    residual_nm: Vec6
    tcp_m: Vec3
    tcp_speed_mps: float
    jacobian: tuple[float, ...]
    contact_force_n: float
    peak_force_n: float
    grip_width_m: float
    grip_force_n: float
    slip_m: float
    pads_loaded: bool
    odometry: Vec3
    base_velocity: Vec3
    fix: Fix | None
    people: tuple[PersonTrack, ...]
    stamps_s: SensorStamps
    frames: Frames | None = None
    sightings: tuple[Sighting, ...] = ()


class Command(NamedTuple):
    """What a skill asks of the actuators for one tick: joint targets and speeds, base velocity (base frame), grip.

    `grip_force_n` > 0 closes with that force, < 0 opens, 0 lets the fingers rest.
    """

    joint_rad: Vec6
    joint_speed_radps: Vec6
    base_velocity: Vec3
    grip_force_n: float


class SkillState(StrEnum):
    """What a skill says of itself; governance verifies it with signals the skill does not own."""

    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"


class SkillReport(NamedTuple):
    """A skill's own word: phase (policy can `confirm_before` it), progress 0…1, state, and the failure's name."""

    phase: str
    progress: float
    state: SkillState = SkillState.RUNNING
    failure: str = ""


class Wish(NamedTuple):
    """What a human at the controls asks for, for as long as they hold the key.

    `base` is (vx, vy, wz) in the base frame, m/s and rad/s; `tool` (vx, vy, vz) in the base frame, m/s; `grip` is
    `open`, `close`, or None to leave the fingers as they are.
    """

    base: Vec3 = (0.0, 0.0, 0.0)
    tool: Vec3 = (0.0, 0.0, 0.0)
    grip: str | None = None


class Bounds(NamedTuple):
    """What the clamp holds commands to: the effective limits of one session."""

    tcp_speed_mps: float
    base_speed_mps: float
    grip_force_n: float
    contact_force_n: float
    joint_speed_radps: float = 3.14159


@dataclass(frozen=True, slots=True, kw_only=True)
class Response:
    """What a watch rule does while its condition holds, when it has cleared, and when it does not clear.

    `enter` and `otherwise` are interventions; `then` is what follows clearance: `resume` or `stay`. It is clear once
    its signal has been within the threshold for `clear_after_ms`, and by `clear_beyond`, in the signal's unit. With
    `persist_ms` None it never gives up waiting.
    """

    enter: Intervention
    clear_after_ms: int = 0
    clear_beyond: float = 0.0
    then: str = "stay"
    persist_ms: int | None = None
    otherwise: Intervention = Intervention.ESCALATE


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchRule:
    """One detector as policy configures it.

    `signal` is one of the watcher's signal names (`separation_m`, `contact_force_n`, …); the condition holds when the
    signal is `above` / `below` the threshold for `for_ms`. `threshold` is a number, or None where the detector
    computes it each tick (`protective_separation_m`). `emits` is what the watcher says, `failure` the name recovery
    looks up when the response ends the attempt.
    """

    id: str
    signal: str
    emits: Signal
    response: Response
    above: bool
    threshold: float | None
    for_ms: int = 0
    method: str = "threshold"  # threshold | cusum
    failure: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Separation:
    """Constants of the protective separation distance, ISO/TS 15066 5.5.4 form; every one declared by the profile."""

    human_speed_mps: float
    reaction_s: float
    stopping_s: float
    intrusion_m: float
    position_uncertainty_m: float
    robot_uncertainty_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchPlan:
    """What the watcher holds a session to: compiled from policy for one (capability, profile, effective parameters).

    `unwatched` names signals left out on purpose (`watcher.without`); policy has no way to say so. `keep_every_tick`
    says whether telemetry keeps every control tick, or a thinner series away from alerts.
    """

    capability: str
    profile: str
    sensitivity: float
    bounds: Bounds
    rules: tuple[WatchRule, ...]
    zones: tuple[Zone, ...]
    separation: Separation | None
    stale_after_ms: Mapping[str, int]
    timeout_s: float
    postconditions: tuple[str, ...]
    params: Params
    payload_kg: float = 0.0
    base_deceleration_mps2: float = 1.0
    base_radius_m: float = 0.45
    unwatched: frozenset[str] = frozenset()
    keep_every_tick: bool = True


class Alert(NamedTuple):
    """One thing the watcher said: signal, the rule behind it, the measured value against its threshold.

    `lingers` says that the rule is not violated any more, but not clear by as much as it has to be.
    """

    signal: Signal
    rule: str
    value: float
    threshold: float
    failure: str = ""
    lingers: bool = False

    @property
    def excess(self) -> float:
        """Return how far the rule is violated."""
        return 0.0 if self.lingers else abs(self.value - self.threshold)


# -- recovering ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoveryRule:
    """One row of a profile's recovery table: on this failure try these steps in order, each within its budget."""

    on: str  # failure name, or `any`
    do: tuple[Strategy, ...]
    capability: str | None = None
    risks: frozenset[Risk] = frozenset(Risk)
    budget: Mapping[Strategy, int] = field(default_factory=dict[Strategy, int])


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoveryPlan:
    """What recovery may do in one session: the profile's table as it applies, budgets counted over the session.

    Compiled from what the authorization names (policy, profile, capability), so that the cell needs nobody to know it.

    Attributes:
        risk: Of the authorized capability; only rows for it hold.
        can_ask: Whether the profile's authority leaves a human to ask in the middle of an execution.
        rules: The table.
        retry_budget: New attempts over the whole session.
        rollback: required, optional or always.
        rollback_capability: What undoes the authorized capability, if anything does.
        careful_admitted: Whether the profile lists the careful mode.
    """

    risk: Risk
    can_ask: bool
    rules: tuple[RecoveryRule, ...]
    retry_budget: int
    rollback: str  # required | optional | always
    rollback_capability: str | None
    careful_admitted: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class CoveredRecovery:
    """A recovery an authorization covers: decided and constrained, so that the cell can recover without the server."""

    strategy: Strategy
    capability: str
    params: Params
    mode: Mode = Mode.NORMAL


@dataclass(frozen=True, slots=True, kw_only=True)
class Authorization:
    """e_t: permission to move one cell, once, for one invocation, with exactly these parameters, under this policy.

    Times are seconds since the epoch. `confirm_before` names phases that wait for a human. `capability` may be
    `takeover`.
    """

    id: str
    invocation: str
    cell: str
    capability: str
    version: str
    params: Params
    mode: Mode
    profile: str
    policy_digest: str
    issued_at_s: float
    expires_at_s: float
    recoveries: tuple[CoveredRecovery, ...] = ()
    approvals: tuple[str, ...] = ()
    confirm_before: tuple[str, ...] = ()
