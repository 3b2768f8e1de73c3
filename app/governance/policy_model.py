"""What a policy set is made of once its files are read: rules, limits, profiles, authority.

Paper: Π(E, O, H). `Profile` is E with the part of H that belongs to it, organization rules are O, `Authority` the rest
of H.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from app.governance.model import AuthorityMode, Mode, Outcome, RecoveryRule, Response, Risk, Separation, Signal

if TYPE_CHECKING:
    from collections.abc import Mapping

LIMIT_UNITS: Final[Mapping[str, str]] = {
    "tcp_speed_mps": "m/s",
    "base_speed_mps": "m/s",
    "grip_force_n": "N",
    "contact_force_n": "N",
    "payload_kg": "kg",
}

# What the watcher can say a number about, each with its unit (design, section 7); flags are 0 or 1.
SIGNAL_UNITS: Final[Mapping[str, str]] = {
    "contact_force_n": "N",
    "residual_nm": "N.m",
    "tcp_speed_mps": "m/s",
    "base_speed_mps": "m/s",
    "zone_margin_m": "m",
    "separation_m": "m",
    "stall_s": "s",
    "elapsed_s": "s",
    "retries": "1",
    "slip_m": "m",
    "grip_lost": "1",
    "grip_force_n": "N",
    "tracking_error_rad": "rad",
    "base_tracking_error_mps": "m/s",
    "sensor_age_ms": "ms",
    "implausible": "1",
    "postcondition": "1",
}

# Thresholds that go by a name, with the one signal each belongs to.
NAMED_THRESHOLDS: Final[Mapping[str, str]] = {
    "protective_separation_m": "separation_m",
    "stale_after_ms": "sensor_age_ms",
    "timeout_s": "elapsed_s",
    "retry_budget": "retries",
}

FAILURES: Final = frozenset({
    "object_not_found", "grasp_failed", "object_lost", "no_path", "blocked", "unreachable", "placement_failed",
    "tool_failed", "perception_mismatch", "timeout", "postcondition_failed", "contact", "overspeed", "zone",
    "instability", "sensor_fault", "stall", "retries_exhausted", "overgrip",
})  # fmt: skip

REFERENCES: Final = ("object", "target", "surface", "area", "corridor", "tool", "action")
WALKING_MPS: Final = 1.6  # a person's, where no other speed was measured (ISO 13855; ISO/TS 15066, 5.5.4)
SENSORS: Final = ("arm", "wrist", "gripper", "odometry", "fix", "people", "objects")
ASKING: Final = frozenset({AuthorityMode.APPROVAL_REQUIRED, AuthorityMode.APPROVAL_ON_ESCALATION})

GOVERNANCE: Final = (
    "governance"  # the agent name and the permission under which recoveries are proposed; nobody else has it
)


class Effect(StrEnum):
    """What a rule does when its condition holds."""

    MODIFY = "modify"
    ESCALATE = "escalate"
    DENY = "deny"


@dataclass(frozen=True, slots=True, kw_only=True)
class Limit:
    """The most a profile lets a quantity be, and where the number comes from."""

    name: str
    maximum: float
    unit: str
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """What a modify rule does to one parameter: bounds on a number, or `to`, an expression for the value of a name."""

    param: str
    minimum: float | None = None
    maximum: float | None = None
    to: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """One rule with its full id (`organization/hazardous`); `applies_to` and `profiles` None mean all of them.

    `approvers` is how many people an escalation by this rule asks for; 0 leaves it to the profile.
    """

    id: str
    applies_to: frozenset[str] | None
    profiles: frozenset[str] | None
    when: str | None
    then: Effect
    settings: tuple[Setting, ...]
    approvers: int
    because: str
    remedy: str

    @property
    def code(self) -> str:
        """Return the stable reason code, made of the rule's own name."""
        return self.id.rpartition("/")[2].replace("-", "_")


@dataclass(frozen=True, slots=True, kw_only=True)
class Approval:
    """How a profile asks for approval: at which risk without further cause, how many people, and what silence means."""

    risks: frozenset[Risk]
    within_s: float
    on_timeout: str
    default_approvers: int
    approvers: Mapping[Risk, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class ReviewTerms:
    """Which finished sessions wait for a verdict: those of these risks, and those that ended in one of these ways."""

    risks: frozenset[Risk]
    outcomes: frozenset[Outcome]


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchRow:
    """A watch rule before it is bound to a session: the threshold is a number, a name, or a limit times a factor."""

    id: str
    applies_to: frozenset[str] | None
    signal: str
    above: bool
    number: float | None
    named: str | None
    limit: str | None
    times: float
    for_ms: int
    method: str
    emits: Signal
    failure: str
    response: Response


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoveryRow:
    """A recovery rule with the capabilities it is for; None means all."""

    applies_to: frozenset[str] | None
    rule: RecoveryRule


@dataclass(frozen=True, slots=True, kw_only=True)
class Profile:
    """E: an environment profile, with its modes of authority."""

    name: str
    sensitivity: float
    admits: frozenset[Mode]
    shared_floor: bool
    keep_every_tick: bool
    rollback: str  # optional | always | required
    retry_budget: int
    limits: Mapping[str, Limit]
    separation: Separation | None
    stale_after_ms: Mapping[str, int]
    base_deceleration_mps2: float
    base_radius_m: float
    watch: tuple[WatchRow, ...]
    recovery: tuple[RecoveryRow, ...]
    authority: frozenset[AuthorityMode]
    approval: Approval | None
    review: ReviewTerms | None = None

    @property
    def asks(self) -> bool:
        """Return whether anybody can answer: before something is launched, or in the middle of it."""
        return not ASKING.isdisjoint(self.authority)


@dataclass(frozen=True, slots=True, kw_only=True)
class Confirmation:
    """Phases of a capability that wait for a human in the middle of execution.

    `within_s` None is as long as any session may wait; `on_deny` and `on_timeout` are `terminate` or `rollback`.
    """

    capability: str
    profile: str
    phases: tuple[str, ...]
    within_s: float | None = None
    on_deny: str = "terminate"
    on_timeout: str = "terminate"


@dataclass(frozen=True, slots=True, kw_only=True)
class Denial:
    """Why a person denies: the code goes to the agent with these words, whatever the person adds does not."""

    code: str
    says: str
    remedy: str


UNSPECIFIED: Final = Denial(code="unspecified", says="a human denied this", remedy="propose something else")


@dataclass(frozen=True, slots=True, kw_only=True)
class GrantTerms:
    """For which risks a human may approve in advance, and for how long; never for critical risk."""

    up_to_s: float
    risks: frozenset[Risk]


@dataclass(frozen=True, slots=True, kw_only=True)
class Authority:
    """H as far as every profile shares it.

    Attributes:
        within_s: How long a session may wait for a human.
        on_timeout: What silence then means.
        confirm_before: Phases that wait for a confirmation.
        denials: Reason codes of denials; the first is what a denial without one means.
        grants: Terms of standing grants; None allows none.
    """

    within_s: float
    on_timeout: str
    confirm_before: tuple[Confirmation, ...] = ()
    denials: tuple[Denial, ...] = (UNSPECIFIED,)
    grants: GrantTerms | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Agent:
    """What an agent may do by itself, and what it may only propose for a human to approve."""

    permissions: frozenset[str] = field(default_factory=frozenset[str])
    supervised: frozenset[str] = field(default_factory=frozenset[str])
