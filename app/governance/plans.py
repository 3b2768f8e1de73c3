"""What policy asks of one session: a watch plan, a recovery plan, and the phases that wait for a human.

Each is a `PolicySet` bound to a capability and a profile, and a watch plan to parameters, too: what the watcher and
recovery work by is numbers, and no longer policy.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, cast

from app.governance.control import TAKEOVER
from app.governance.model import Bounds, Mode, RecoveryPlan, WatchPlan, WatchRule
from app.governance.policy_code import limit_for
from app.governance.vocabulary import properties

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from app.governance.model import Authorization, Capability, Json, Params
    from app.governance.policy import PolicySet
    from app.governance.policy_model import Limit, Profile, WatchRow


CAREFUL_SPEED: Final = 0.5
"""What `careful` leaves of a speed; skills drive at 0.95 of it, as they do with every limit."""
SPEEDS: Final = frozenset({"tcp_speed_mps", "base_speed_mps"})
NOISE: Final = {"tcp_speed_mps": 0.01, "base_speed_mps": 0.01, "grip_force_n": 0.5}
"""At least five σ of what is measured: of a speed made from the drives' velocities, and of the mean of two pads."""

MANIPULATION: Final = "manipulation"
OF_A_PLAN: Final = frozenset({"stall_s", "elapsed_s", "retries"})
"""What says how a plan gets on; a human who drives has none, and may look before they move."""


def watch_plan(
    policy: PolicySet,
    capability: str,
    profile: str,
    params: Params,
    mode: Mode = Mode.NORMAL,
    *,
    held_n: float = math.inf,
) -> WatchPlan:
    """Bind a profile's watch rules to one session; its bounds are the smallest of limit, parameter and what is held.

    Args:
        policy: The policy set.
        capability: What is run.
        profile: Under which profile.
        params: Effective parameters.
        mode: How carefully; `careful` halves the speeds that the parameters ask for.
        held_n: How firmly what is in the hand already may be held, N.

    Raises:
        KeyError: Capability or profile is unknown.
    """
    package, environment = policy.capabilities[capability], policy.profiles[profile]
    bounds = _bounds(package, environment, params, mode)
    bounds = bounds._replace(grip_force_n=min(bounds.grip_force_n, held_n))
    held = params.get("object_id")
    known = policy.site.objects.get(held) if isinstance(held, str) else None
    return WatchPlan(
        capability=capability,
        profile=profile,
        sensitivity=environment.sensitivity,
        bounds=bounds,
        rules=tuple(
            _watch_rule(row, package, environment, bounds)
            for row in environment.watch
            if (row.applies_to is None or capability in row.applies_to)
            and not (capability == TAKEOVER and row.signal in OF_A_PLAN)
        ),
        zones=tuple(zone for zone in policy.site.zones.values() if zone.kind == "forbidden"),
        separation=environment.separation,
        stale_after_ms=environment.stale_after_ms,
        timeout_s=package.timeout_s,
        postconditions=package.postconditions,
        params=params,
        payload_kg=0.0 if known is None else known.mass_kg,
        base_deceleration_mps2=environment.base_deceleration_mps2,
        base_radius_m=environment.base_radius_m,
        keep_every_tick=environment.keep_every_tick or capability == TAKEOVER,
    )


def watch_plan_for(policy: PolicySet, authorization: Authorization) -> WatchPlan:
    """Return the watch plan of a session that an authorization starts.

    Raises:
        KeyError: Capability or profile is unknown.
    """
    return watch_plan(policy, authorization.capability, authorization.profile, authorization.params, authorization.mode)


def closes(policy: PolicySet, capability: str, profile: str) -> bool:
    """Say whether a capability takes hold of something as firmly as its own parameters say.

    Raises:
        KeyError: Capability or profile is unknown.
    """
    package, limits = policy.capabilities[capability], policy.profiles[profile].limits
    return any("grip_force_n" in _held_to(spec, limits) for spec in properties(package).values())


def _bounds(capability: Capability, profile: Profile, params: Params, mode: Mode) -> Bounds:
    bounds = {name: limit.maximum for name, limit in profile.limits.items()}
    for name, spec in properties(capability).items():
        value = params.get(name)
        if isinstance(value, (int, float)):
            for held in _held_to(spec, profile.limits):
                bounds[held] = min(bounds[held], float(value))
    share = CAREFUL_SPEED if mode is Mode.CAREFUL else 1.0
    return Bounds(
        tcp_speed_mps=bounds["tcp_speed_mps"] * share,
        base_speed_mps=bounds["base_speed_mps"] * share,
        grip_force_n=bounds["grip_force_n"],
        contact_force_n=bounds["contact_force_n"],
    )


def _held_to(spec: Mapping[str, Json], limits: Mapping[str, Limit]) -> Iterable[str]:
    """Return the bounds that a parameter's value lowers: of a speed that names no limit, arm and base alike."""
    limit = limit_for(spec, limits)
    if limit is None:
        return ()
    return SPEEDS if limit.name in SPEEDS and "x-limit" not in spec else (limit.name,)


_NAMED: Mapping[str, Callable[[Capability, Profile], float | None]] = {
    "protective_separation_m": lambda capability, profile: None,
    "stale_after_ms": lambda capability, profile: None,
    "timeout_s": lambda capability, profile: capability.timeout_s,
    "retry_budget": lambda capability, profile: float(profile.retry_budget),
}


def _watch_rule(row: WatchRow, capability: Capability, profile: Profile, bounds: Bounds) -> WatchRule:
    if row.named is not None:
        threshold = _NAMED[row.named](capability, profile)
    elif row.limit == "contact_force_n":
        # What a parameter asks for is pressed with; contact itself is the profile's matter.
        threshold = profile.limits[row.limit].maximum * row.times
    elif row.limit is not None:
        threshold = _headroom(cast("float", getattr(bounds, row.limit)), row, profile)
    else:
        threshold = row.number
    return WatchRule(
        id=row.id,
        signal=row.signal,
        emits=row.emits,
        response=row.response,
        above=row.above,
        threshold=threshold,
        for_ms=row.for_ms,
        method=row.method,
        failure=row.failure,
    )


def _headroom(bound: float, row: WatchRow, profile: Profile) -> float:
    """Return the threshold over a bound; for a slow session, or a weak grip, at least what the noise of it needs.

    Five percent of a low bound drown in that noise. It is never more than the profile's limit allows. What speaks up
    before the bound gets none: it would say no more than what speaks of the violation.
    """
    threshold = bound * row.times
    if row.signal not in NOISE or row.limit is None or row.times < 1.0:
        return threshold
    return max(threshold, min(bound + NOISE[row.signal], profile.limits[row.limit].maximum * row.times))


def recovery_plan(policy: PolicySet, capability: str, profile: str) -> RecoveryPlan:
    """Return what recovery may do in a session of this capability under this profile.

    A profile that requires rollback requires it of manipulation; elsewhere it is optional.

    Raises:
        KeyError: Capability or profile is unknown.
    """
    package, environment = policy.capabilities[capability], policy.profiles[profile]
    spared = environment.rollback == "required" and MANIPULATION not in package.permissions
    return RecoveryPlan(
        risk=package.risk,
        can_ask=environment.asks,
        rules=tuple(row.rule for row in environment.recovery if row.applies_to is None or capability in row.applies_to),
        retry_budget=environment.retry_budget,
        rollback="optional" if spared else environment.rollback,
        rollback_capability=package.rollback,
        careful_admitted=Mode.CAREFUL in environment.admits,
    )


def confirm_before(policy: PolicySet, capability: str, profile: str) -> tuple[str, ...]:
    """Return the phases of a capability that wait for a human under this profile, in the order policy lists them."""
    return tuple(
        phase
        for entry in policy.authority.confirm_before
        if (entry.capability, entry.profile) == (capability, profile)
        for phase in entry.phases
    )
