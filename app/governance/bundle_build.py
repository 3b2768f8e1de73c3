"""From shapes to the words of policy: no checks here, only the translation of what `bundle_checks` has found sound."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.governance.model import (
    Area,
    AuthorityMode,
    Capability,
    Corridor,
    Intervention,
    Mode,
    Outcome,
    RecoveryRule,
    Response,
    Risk,
    Separation,
    Signal,
    Site,
    SiteObject,
    Strategy,
    Surface,
    Target,
    Tool,
    Zone,
)
from app.governance.policy_model import (
    LIMIT_UNITS,
    UNSPECIFIED,
    Agent,
    Approval,
    Authority,
    Confirmation,
    Denial,
    Effect,
    GrantTerms,
    Limit,
    Profile,
    RecoveryRow,
    ReviewTerms,
    Rule,
    Setting,
    WatchRow,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from app.governance import bundle_shapes as shapes


def capability(shape: shapes.CapabilityShape) -> Capability:
    """Build a capability package from its manifest."""
    return Capability(
        name=shape.name,
        version=shape.version,
        summary=shape.summary,
        inputs=shape.inputs,  # pyright: ignore[reportArgumentType]  # pydantic's JsonValue is our Json
        preconditions=tuple(shape.preconditions),
        postconditions=tuple(shape.postconditions),
        permissions=frozenset(shape.permissions),
        risk=Risk(shape.risk),
        rollback=shape.rollback,
        env_profile=dict(shape.env_profile),
        timeout_s=shape.timeout_s,
        recovery=shape.recovery,
        phases=tuple(shape.phases),
        changes=dict(shape.changes),
    )


def rule(owner: str, shape: shapes.RuleShape, profiles: frozenset[str] | None) -> Rule:
    """Build a rule; `owner` is the profile, `organization` or `authority`."""
    return Rule(
        id=f"{owner}/{shape.id}",
        applies_to=_names(shape.applies_to),
        profiles=profiles,
        when=shape.when,
        then=Effect(shape.then),
        settings=tuple(
            Setting(param=param, minimum=setting.min, maximum=setting.max, to=setting.to)
            for param, setting in shape.set.items()
        ),
        approvers=shape.approvers or 0,
        because=shape.because,
        remedy=shape.remedy,
    )


def _names(names: Iterable[str] | None) -> frozenset[str] | None:
    return None if names is None else frozenset(names)


def profile(shape: shapes.ProfileShape) -> Profile:
    """Build an environment profile, without its rules."""
    separation = shape.separation
    return Profile(
        name=shape.profile,
        sensitivity=shape.sensitivity,
        admits=frozenset(Mode(mode) for mode in shape.modes),
        shared_floor=shape.shared_floor,
        keep_every_tick=shape.keep_every_tick,
        rollback=shape.rollback,
        retry_budget=shape.retry_budget,
        limits={name: _limit(name, getattr(shape.limits, name)) for name in LIMIT_UNITS},
        separation=None if separation is None else Separation(**separation.model_dump()),
        stale_after_ms=dict(shape.stale_after_ms),
        base_deceleration_mps2=shape.motion.base_deceleration_mps2,
        base_radius_m=shape.motion.base_radius_m,
        watch=tuple(_watch(row) for row in shape.watch),
        recovery=tuple(_recovery(row) for row in shape.recovery),
        authority=frozenset(AuthorityMode(mode) for mode in shape.authority.modes),
        approval=None if shape.authority.approval is None else _approval(shape.authority.approval),
        review=None if shape.authority.review is None else _review(shape.authority.review),
    )


def _limit(name: str, shape: shapes.LimitShape) -> Limit:
    return Limit(name=name, maximum=shape.max, unit=LIMIT_UNITS[name], source=shape.source)


def _watch(shape: shapes.WatchShape) -> WatchRow:
    threshold = shape.below if shape.above is None else shape.above
    scaled = None if isinstance(threshold, (str, float, int)) else threshold
    return WatchRow(
        id=shape.id,
        applies_to=_names(shape.applies_to),
        signal=shape.signal,
        above=shape.above is not None,
        number=float(threshold) if isinstance(threshold, (float, int)) else None,
        named=threshold if isinstance(threshold, str) else None,
        limit=None if scaled is None else scaled.limit,
        times=1.0 if scaled is None else scaled.times,
        for_ms=shape.for_ms,
        method=shape.method,
        emits=Signal(shape.emits or ("WARNING" if shape.response.enter == "continue" else "VIOLATION")),
        failure=shape.failure,
        response=_response(shape.response),
    )


def _response(shape: shapes.ResponseShape) -> Response:
    return Response(
        enter=Intervention(shape.enter.upper()),
        clear_after_ms=shape.clear_after_ms,
        clear_beyond=shape.clear_beyond,
        then=shape.then,
        persist_ms=shape.persist_ms,
        otherwise=Intervention((shape.otherwise or "escalate").upper()),
    )


def _recovery(shape: shapes.RecoveryShape) -> RecoveryRow:
    return RecoveryRow(
        applies_to=_names(shape.applies_to),
        rule=RecoveryRule(
            on=shape.on,
            do=tuple(Strategy(step.upper()) for step in shape.do),
            capability=shape.capability,
            risks=frozenset(Risk) if shape.risks is None else frozenset(Risk(risk) for risk in shape.risks),
            budget={Strategy(step.upper()): count for step, count in shape.budget.items()},
        ),
    )


def _approval(shape: shapes.ApprovalShape) -> Approval:
    counts = {risk: getattr(shape.approvers, risk.value) for risk in Risk}
    return Approval(
        risks=frozenset(Risk(risk) for risk in shape.risk),
        within_s=shape.within_s,
        on_timeout=shape.on_timeout,
        default_approvers=shape.approvers.default,
        approvers={risk: count for risk, count in counts.items() if count is not None},
    )


def _review(shape: shapes.ReviewShape) -> ReviewTerms:
    return ReviewTerms(
        risks=frozenset(Risk(risk) for risk in shape.risk),
        outcomes=frozenset(Outcome(outcome) for outcome in shape.outcomes),
    )


def agents(shape: shapes.OrganizationShape) -> dict[str, Agent]:
    """Build what the agents may do."""
    return {
        name: Agent(permissions=frozenset(agent.permissions), supervised=frozenset(agent.supervised))
        for name, agent in shape.agents.items()
    }


def authority(shape: shapes.AuthorityFileShape) -> Authority:
    """Build the part of H that every profile shares."""
    return Authority(
        within_s=shape.mid_execution.within_s,
        on_timeout=shape.mid_execution.on_timeout,
        confirm_before=tuple(
            Confirmation(
                capability=entry.capability,
                profile=entry.profile,
                phases=tuple(entry.phases),
                within_s=entry.within_s,
                on_deny=entry.on_deny,
                on_timeout=entry.on_timeout,
            )
            for entry in shape.confirm_before
        ),
        denials=(UNSPECIFIED,) if shape.denials is None else _denials(shape.denials),
        grants=None
        if shape.grants is None
        else GrantTerms(
            up_to_s=shape.grants.up_to_minutes * 60.0, risks=frozenset(Risk(risk) for risk in shape.grants.risk)
        ),
    )


def _denials(shape: shapes.DenialsShape) -> tuple[Denial, ...]:
    """Build the reasons for denials, the default one first."""
    codes = sorted(shape.codes, key=lambda code: code != shape.default)
    return tuple(Denial(code=code, says=shape.codes[code].says, remedy=shape.codes[code].remedy) for code in codes)


def _points(points: Sequence[Sequence[float]]) -> tuple[tuple[float, float], ...]:
    return tuple((x, y) for x, y in points)


def site(shape: shapes.SiteShape) -> Site:
    """Build the site."""
    x0, y0, x1, y1 = shape.bounds_m
    return Site(
        bounds_m=(x0, y0, x1, y1),
        zones={
            name: Zone(name=name, kind=zone.kind, polygon=_points(zone.polygon)) for name, zone in shape.zones.items()
        },
        targets={name: Target(name=name, **found.model_dump()) for name, found in shape.targets.items()},
        surfaces={name: Surface(name=name, **found.model_dump()) for name, found in shape.surfaces.items()},
        areas={
            name: Area(name=name, polygon=_points(found.polygon), target=found.target)
            for name, found in shape.areas.items()
        },
        corridors={
            name: Corridor(name=name, line=_points(found.line), half_width_m=found.half_width_m)
            for name, found in shape.corridors.items()
        },
        objects={name: _object(name, found) for name, found in shape.objects.items()},
        tools={name: Tool(name=name, **found.model_dump()) for name, found in shape.tools.items()},
        start=shape.start,
    )


def _object(name: str, shape: shapes.ObjectShape) -> SiteObject:
    a, b, c = shape.size_m
    return SiteObject(name=name, **shape.model_dump(exclude={"size_m"}), size_m=(a, b, c))
