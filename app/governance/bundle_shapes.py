"""The shape of every policy file, as strict pydantic models: unknown keys, wrong types, non-finite numbers are errors.

Shapes say what a file may contain, and `bundle_fit` fits it in; `bundle_checks` says what it may mean; `bundle` builds
the policy set from both.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, JsonValue

from app.governance.semver import PIN, VERSION

NAME: Final = r"^[a-z][a-z0-9_]*$"
SLUG: Final = r"^[a-z][a-z0-9]*(-[a-z0-9]+)*$"
AGENT: Final = r"^[a-z][a-z0-9_-]*$"

Name: TypeAlias = Annotated[str, Field(pattern=NAME, max_length=64)]
Slug: TypeAlias = Annotated[str, Field(pattern=SLUG, max_length=64)]
Version: TypeAlias = Annotated[str, Field(pattern=rf"^{VERSION}$")]
Text: TypeAlias = Annotated[str, Field(min_length=1, max_length=400)]
Length: TypeAlias = Annotated[float, Field(gt=0, le=1000)]  # what a cell holds, or anything in it does, is within that
Count: TypeAlias = Annotated[int, Field(ge=0, le=100)]
Millis: TypeAlias = Annotated[int, Field(ge=0, le=3_600_000)]
XY: TypeAlias = Annotated[list[float], Field(min_length=2, max_length=2)]
Polygon: TypeAlias = Annotated[list[XY], Field(min_length=3)]
RiskName: TypeAlias = Literal["low", "medium", "high", "critical"]
ModeName: TypeAlias = Literal["normal", "careful"]
Enabling: TypeAlias = Literal["allowed", "guarded", "approval-required", "forbidden"]
AuthorityName: TypeAlias = Literal[
    "approval-required", "approval-on-escalation", "interrupt-enabled", "takeover-enabled", "review-only"
]
SessionOutcome: TypeAlias = Literal[
    "succeeded", "recovered", "rolled_back", "terminated", "stopped", "cancelled", "taken_over", "fault"
]
Ending: TypeAlias = Literal["terminate", "rollback"]
InterventionName: TypeAlias = Literal["continue", "pause", "stop", "rollback", "escalate"]
StrategyName: TypeAlias = Literal["retry", "recovery_capability", "rollback", "safer_mode", "terminate", "ask_human"]


class Shape(BaseModel):
    """A mapping with exactly the keys declared here."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


# Rules ---------------------------------------------------------------------------------------------------------------


class SettingShape(Shape):
    """What a modify rule does to one parameter."""

    min: float | None = None
    max: float | None = None
    to: str | None = None


class RuleShape(Shape):
    """One rule of a profile, the organization or authority."""

    id: Slug
    applies_to: Annotated[list[Name], Field(min_length=1)] | None = None
    profiles: Annotated[list[Slug], Field(min_length=1)] | None = None
    when: str | None = None
    then: Literal["modify", "escalate", "deny"]
    set: dict[Name, SettingShape] = {}
    approvers: Annotated[int, Field(ge=1, le=9)] | None = None
    because: Text
    remedy: str = ""


# Capabilities --------------------------------------------------------------------------------------------------------


class CapabilityShape(Shape):
    """A capability manifest."""

    name: Name
    version: Version
    changes: dict[Version, Text] = {}
    summary: Text
    recovery: bool = False
    inputs: dict[str, JsonValue]
    phases: list[Name] = []
    preconditions: list[Name]
    postconditions: list[Name]
    permissions: list[Name]
    risk: RiskName
    rollback: Name | None
    env_profile: dict[Slug, Enabling]
    timeout_s: Annotated[float, Field(gt=0, le=86_400)]


# Profiles ------------------------------------------------------------------------------------------------------------


class LimitShape(Shape):
    """The most a quantity may be."""

    max: Annotated[float, Field(gt=0)]
    source: Text


class LimitsShape(Shape):
    """The limits every profile declares."""

    tcp_speed_mps: LimitShape
    base_speed_mps: LimitShape
    grip_force_n: LimitShape
    contact_force_n: LimitShape
    payload_kg: LimitShape


class SeparationShape(Shape):
    """Constants of the protective separation distance."""

    human_speed_mps: Length
    reaction_s: Length
    stopping_s: Length
    intrusion_m: Annotated[float, Field(ge=0)]
    position_uncertainty_m: Annotated[float, Field(ge=0)]
    robot_uncertainty_m: Annotated[float, Field(ge=0)]


class MotionShape(Shape):
    """What prediction needs to know of the base."""

    base_deceleration_mps2: Length = 1.0
    base_radius_m: Length = 0.45


class ScaledLimit(Shape):
    """A threshold that follows a limit."""

    limit: Literal["tcp_speed_mps", "base_speed_mps", "grip_force_n", "contact_force_n"]
    times: Length = 1.0


class ResponseShape(Shape):
    """What a watch rule does; `else` is what follows when the condition does not clear."""

    enter: InterventionName
    clear_after_ms: Millis = 0
    clear_beyond: Annotated[float, Field(ge=0)] = 0.0
    then: Literal["resume", "stay"] = "stay"
    persist_ms: Annotated[int, Field(gt=0, le=3_600_000)] | None = None
    otherwise: InterventionName | None = Field(default=None, alias="else")


class WatchShape(Shape):
    """One watch rule."""

    id: Slug
    applies_to: Annotated[list[Name], Field(min_length=1)] | None = None
    signal: Name
    above: float | str | ScaledLimit | None = None
    below: float | str | ScaledLimit | None = None
    for_ms: Millis = 0
    method: Literal["threshold", "cusum"] = "threshold"
    emits: Literal["WARNING", "VIOLATION", "TIMEOUT", "INSTABILITY"] | None = None
    failure: str = ""
    response: ResponseShape


class RecoveryShape(Shape):
    """One row of the recovery table."""

    on: str
    applies_to: Annotated[list[Name], Field(min_length=1)] | None = None
    do: Annotated[list[StrategyName], Field(min_length=1)]
    capability: Name | None = None
    risks: Annotated[list[RiskName], Field(min_length=1)] | None = None
    budget: dict[StrategyName, Count] = {}


class ApproversShape(Shape):
    """How many different people approve, by risk."""

    default: Annotated[int, Field(ge=1, le=9)] = 1
    low: Annotated[int, Field(ge=1, le=9)] | None = None
    medium: Annotated[int, Field(ge=1, le=9)] | None = None
    high: Annotated[int, Field(ge=1, le=9)] | None = None
    critical: Annotated[int, Field(ge=1, le=9)] | None = None


class ApprovalShape(Shape):
    """When a profile asks, for how long, and what silence means."""

    risk: list[RiskName]
    within_s: Annotated[float, Field(gt=0, le=86_400)]
    on_timeout: Literal["deny"]
    approvers: ApproversShape = ApproversShape()


class ReviewShape(Shape):
    """Which finished sessions wait for a verdict."""

    risk: list[RiskName] = []
    outcomes: list[SessionOutcome] = []


class AuthorityShape(Shape):
    """The authority block of a profile."""

    modes: Annotated[list[AuthorityName], Field(min_length=1)]
    approval: ApprovalShape | None = None
    review: ReviewShape | None = None


class ProfileShape(Shape):
    """An environment profile."""

    profile: Slug
    sensitivity: Annotated[float, Field(ge=0, le=1)]
    modes: Annotated[list[ModeName], Field(min_length=1)]
    shared_floor: bool = False
    keep_every_tick: bool = False
    rollback: Literal["optional", "always", "required"]
    retry_budget: Count
    limits: LimitsShape
    rules: list[RuleShape] = []
    separation: SeparationShape | None = None
    stale_after_ms: dict[Name, Annotated[int, Field(gt=0, le=60_000)]]
    motion: MotionShape = MotionShape()
    watch: Annotated[list[WatchShape], Field(min_length=1)]
    recovery: Annotated[list[RecoveryShape], Field(min_length=1)]
    authority: AuthorityShape


# Organization and authority ------------------------------------------------------------------------------------------


class AgentShape(Shape):
    """What one agent may do, by itself or with a human's approval."""

    permissions: list[Name] = []
    supervised: list[Name] = []


class OrganizationShape(Shape):
    """O: rules of every profile, and who may propose what."""

    organization: Slug
    agents: dict[Annotated[str, Field(pattern=AGENT, max_length=64)], AgentShape]
    permissions: list[Name]
    rules: list[RuleShape]


class WaitShape(Shape):
    """A session that waits for a human."""

    within_s: Annotated[float, Field(gt=0, le=86_400)]
    on_timeout: Literal["terminate"]


class ConfirmShape(Shape):
    """Phases that wait for a confirmation."""

    capability: Name
    profile: Slug
    phases: Annotated[list[Name], Field(min_length=1)]
    within_s: Annotated[float, Field(gt=0, le=86_400)] | None = None
    on_deny: Ending = "terminate"
    on_timeout: Ending = "terminate"


class DenialShape(Shape):
    """One reason for a denial, in the words that the agent gets with its code."""

    says: Text
    remedy: Text


class DenialsShape(Shape):
    """Why a person denies, by code."""

    default: Name
    codes: Annotated[dict[Name, DenialShape], Field(min_length=1)]


class GrantsShape(Shape):
    """Standing grants: for which risks, and for how long."""

    up_to_minutes: Annotated[float, Field(gt=0, le=15)]
    risk: Annotated[list[Literal["low", "medium", "high"]], Field(min_length=1)]


class AuthorityFileShape(Shape):
    """H, as far as every profile shares it."""

    authority: Slug
    mid_execution: WaitShape
    confirm_before: list[ConfirmShape] = []
    grants: GrantsShape | None = None
    denials: DenialsShape | None = None
    rules: list[RuleShape] = []


# Site ----------------------------------------------------------------------------------------------------------------


class TargetShape(Shape):
    """A place to stand."""

    x_m: float
    y_m: float
    yaw_rad: float
    corridor: Name | None = None


class SurfaceShape(Shape):
    """A horizontal surface."""

    x_m: float
    y_m: float
    z_m: float
    half_x_m: Length
    half_y_m: Length
    yaw_rad: float
    target: Name


class AreaShape(Shape):
    """An area to inspect."""

    polygon: Polygon
    target: Name


class CorridorShape(Shape):
    """A corridor."""

    line: Annotated[list[XY], Field(min_length=2)]
    half_width_m: Length


class ZoneShape(Shape):
    """A zone."""

    kind: Literal["forbidden", "restricted", "shared"]
    polygon: Polygon


class ObjectShape(Shape):
    """A known object."""

    kind: Name
    shape: Literal["cylinder", "box"]
    size_m: Annotated[list[Length], Field(min_length=3, max_length=3)]
    mass_kg: Length
    fragile: bool
    hazardous: bool
    surface: Name
    x_m: float
    y_m: float


class ToolShape(Shape):
    """A fixed tool."""

    kind: Literal["lever", "button"]
    x_m: float
    y_m: float
    z_m: float
    target: Name
    actions: Annotated[dict[Name, Name], Field(min_length=1)]
    press: bool = False


class SiteShape(Shape):
    """The site."""

    site: Slug
    bounds_m: Annotated[list[float], Field(min_length=4, max_length=4)]
    start: Name
    targets: Annotated[dict[Name, TargetShape], Field(min_length=1)]
    surfaces: dict[Name, SurfaceShape]
    areas: dict[Name, AreaShape]
    corridors: dict[Name, CorridorShape]
    zones: dict[Name, ZoneShape]
    objects: dict[Name, ObjectShape]
    tools: dict[Name, ToolShape]


# Cases ---------------------------------------------------------------------------------------------------------------


class CaseShape(Shape):
    """One case: a proposal in a context, and what must come of it. What `expect` does not name is not compared."""

    name: Text
    profile: Slug | None = None
    capability: str
    params: dict[str, JsonValue] = {}
    mode: ModeName = "normal"
    metadata: dict[str, JsonValue] = {}
    preconditions: list[str] = []
    capability_version: Annotated[str, Field(pattern=PIN)] | None = None
    context: ContextShape | None = None
    expect: ExpectShape


class ContextShape(Shape):
    """What differs from the ordinary: an idle cell whose sensors say that everything the capability needs is so."""

    agent: str = "planner"
    permissions: list[Name] | None = None  # in the place of those that policy gives this agent
    online: bool = True
    latched: bool = False
    busy: str | None = None
    holding: str | None = None
    stand: str | None = None
    unseen: list[str] = []
    unreachable: list[str] = []
    at: dict[Name, XY] = {}  # where objects are perceived, if not where the site says
    arm_ready: bool = True
    arm_retracted: bool = True
    gripper_empty: bool | None = None  # if it is not what `holding` says
    sensors_fresh: bool = True
    people_count: Annotated[int, Field(ge=0)] = 0
    people_nearest_m: Annotated[float, Field(ge=0)] = 99.0
    operator_on_duty: bool = True


class ExpectShape(Shape):
    """What must come of a case."""

    status: Literal["allowed", "rejected", "deferred", "denied", "awaiting_approval", "invalid"]
    admission: Literal["accept", "reject", "defer", "escalate"] | None = None
    policy: Literal["allow", "modify", "deny", "escalate"] | None = None
    codes: list[str] | None = None
    rules: list[str] | None = None  # among those that determined it
    determined_by: list[str] | None = None  # these and no others did
    changes: dict[str, JsonValue] | None = None
    approvers: int | None = None
    session: dict[str, JsonValue] | None = None  # what a session of it would be held to, as far as it is named


class CasesShape(Shape):
    """A file of cases."""

    cases: Annotated[list[CaseShape], Field(min_length=1)]
    profile: Slug | None = None


CaseShape.model_rebuild()
