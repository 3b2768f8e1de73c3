"""Shows that two policies of one site decide alike, or leaves it open: what is not shown here is not claimed.

Shown is what follows from two readings:
1. Conditions are evaluated as far as policy and site go. What they read of `capability`, `profile` and `limits` is
   known of a pair; `target` is one of the site's objects or nothing, `tool` one of its tools. For each of those the
   condition is folded; where what is left is the same text for all, the two conditions hold for the same proposals.
2. Tables are read as they are used: a watch row by the capabilities it is for, a recovery row by the failures and the
   risk for which it is the first to match, risks that ask or are reviewed by the risks there are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from app.authoring.conditions import to_cel
from app.governance.authority import MARKED, grantable
from app.governance.expression_code import INTRINSICS, to_python
from app.governance.expression_tree import (
    BOOL,
    DOUBLE,
    STRING,
    Apply,
    Conditional,
    Constant,
    ListOf,
    Logic,
    Present,
    Typed,
    dotted,
)
from app.governance.model import AuthorityMode, Risk, Strategy
from app.governance.places import NOTHING
from app.governance.plans import recovery_plan
from app.governance.policy_code import limit_for
from app.governance.policy_model import FAILURES
from app.governance.recovery import DEFAULT_BUDGET
from app.governance.vocabulary import properties, referring

if TYPE_CHECKING:
    from app.governance.expression_tree import Type
    from app.governance.model import Capability
    from app.governance.policy import PolicySet
    from app.governance.policy_model import Profile, Rule
    from app.governance.vocabulary import Vocabulary

Values: TypeAlias = Mapping[str, "bool | int | float | str"]
Shows: TypeAlias = Callable[[str, str], bool]


def equivalent(one: PolicySet, other: PolicySet, vocabulary: Vocabulary, concerns: Shows = lambda _c, _p: True) -> bool:
    """Say whether two policies are shown to decide alike and to hold sessions alike.

    Args:
        one: A policy.
        other: The other, of the same site.
        vocabulary: Types the conditions of both.
        concerns: Which pairs (capability, profile) can differ at all; the others are not looked at.
    """
    if (one.agents, one.permissions, set(one.gates)) != (other.agents, other.permissions, set(other.gates)):
        return False
    if _packages(one) != _packages(other):
        return False
    authority = replace(other.authority, grants=one.authority.grants)  # grants are looked at by what they grant
    if one.authority != authority or _up_to(one) != _up_to(other):
        return False
    if any(_profile(one, name) != _profile(other, name) for name in one.profiles):
        return False
    pairs = [pair for pair in one.gates if concerns(*pair)]
    return all(_pair(one, vocabulary, *pair) == _pair(other, vocabulary, *pair) for pair in pairs)


def _packages(policy: PolicySet) -> list[Capability]:
    """Return the capabilities without what goes by the pair: whether one is enabled, and whether it is marked."""
    return [replace(package, env_profile={}, phases=(), summary="") for package in policy.capabilities.values()]


def _marked(package: Capability, profile: Profile) -> bool:
    """Say whether a manifest's mark asks for approval where the profile would not ask for the risk."""
    by_risk = AuthorityMode.APPROVAL_REQUIRED in profile.authority
    asked = by_risk and profile.approval is not None and package.risk in profile.approval.risks
    return package.env_profile[profile.name] == MARKED and not package.recovery and not asked


def _up_to(policy: PolicySet) -> float | None:
    return None if policy.authority.grants is None else policy.authority.grants.up_to_s


def _profile(policy: PolicySet, name: str) -> dict[str, Any]:
    """Return what a profile says to all its pairs; its rows and limits are looked at pair by pair."""
    profile = policy.profiles[name]
    found = {field.name: getattr(profile, field.name) for field in fields(profile)}
    for looked_at in ("watch", "recovery", "limits", "sensitivity", "shared_floor"):
        found.pop(looked_at)
    # What conditions read of these is folded into them; the rest is what sessions are held to.
    found["held"] = (
        profile.sensitivity,
        [profile.limits[limit].maximum for limit in sorted(profile.limits) if limit != "payload_kg"],
    )
    risks = {capability.risk for capability in policy.capabilities.values()}
    if profile.approval is not None:
        asking = risks if AuthorityMode.APPROVAL_REQUIRED in profile.authority else set[Risk]()
        counts = {risk: profile.approval.approvers.get(risk, profile.approval.default_approvers) for risk in risks}
        found["approval"] = profile.approval.risks & asking, counts, profile.approval.within_s
    if profile.review is not None:
        found["review"] = profile.review.risks & risks, profile.review.outcomes
    return found


def _pair(policy: PolicySet, vocabulary: Vocabulary, capability: str, profile: str) -> tuple[object, ...]:
    package, environment = policy.capabilities[capability], policy.profiles[profile]
    plan = recovery_plan(policy, capability, profile)
    rows = {failure: _steps(failure, plan.risk, plan.rules) for failure in FAILURES}
    watch = [row for row in environment.watch if row.applies_to is None or capability in row.applies_to]
    watched = [replace(row, applies_to=None) for row in watch]
    rules = list(_rules(policy, vocabulary, package, environment))
    limits = {name: limit_for(spec, environment.limits) for name, spec in properties(package).items()}
    grant = grantable(policy, capability, profile)
    return rules, limits, rows, watched, _marked(package, environment), None if grant is None else grant.code


def _steps(failure: str, risk: object, rows: tuple[Any, ...]) -> list[tuple[object, ...]]:
    row = next((row for row in rows if row.on in (failure, "any") and risk in row.risks), None)
    return [] if row is None else [
        (step, row.capability if step is Strategy.RECOVERY_CAPABILITY else None, row.budget.get(step, DEFAULT_BUDGET))
        for step in row.do
    ]  # fmt: skip


# Rules ---------------------------------------------------------------------------------------------------------------


def _rules(
    policy: PolicySet, vocabulary: Vocabulary, package: Capability, environment: Profile
) -> Iterator[tuple[object, ...]]:
    for rule in policy.rules.values():
        if not _applies(rule, package.name, environment.name):
            continue
        settings = [setting for setting in rule.settings if setting.param in properties(package)]
        if rule.settings and not settings:
            continue
        when = _folded(policy, vocabulary, package, environment, rule.when, BOOL)
        if set(when) == {"false"}:
            continue
        named = [_folded(policy, vocabulary, package, environment, setting.to, STRING) for setting in settings]
        bounds = [(setting.param, setting.minimum, setting.maximum) for setting in settings]
        yield rule.id, rule.then, rule.approvers, bounds, named, when


def _applies(rule: Rule, capability: str, profile: str) -> bool:
    return (rule.applies_to is None or capability in rule.applies_to) and (
        rule.profiles is None or profile in rule.profiles
    )


def _folded(
    policy: PolicySet,
    vocabulary: Vocabulary,
    package: Capability,
    environment: Profile,
    source: str | None,
    type_: Type,
) -> tuple[str, ...]:
    """Return what is left of a condition for every object and tool there is."""
    if source is None:
        return ("true",)
    typed = vocabulary.typed(source, package.name, type_)
    return tuple(to_cel(fold(typed, values)) for values in situations(policy, package, environment))


def situations(policy: PolicySet, package: Capability, environment: Profile) -> Iterator[Values]:
    """Yield everything a condition may read that policy and site fix, once for every object and tool there is."""
    fixed: dict[str, Any] = {
        "capability.name": package.name,
        "capability.risk": package.risk.value,
        "profile.name": environment.name,
        "profile.sensitivity": environment.sensitivity,
        "profile.shared_floor": environment.shared_floor,
        **{f"limits.{name}": limit.maximum for name, limit in environment.limits.items()},
    }
    tools = list(policy.site.tools.values()) if "tool" in referring(package) else [None]
    for thing in (NOTHING, *policy.site.objects.values()):
        about = {f"target.{name}": getattr(thing, name) for name in ("name", "kind", "mass_kg", "fragile", "hazardous")}
        for tool in tools:
            worked = {} if tool is None else {f"tool.{name}": getattr(tool, name) for name in ("name", "kind", "press")}
            yield {**fixed, **about, **worked}


def fold(typed: Typed, values: Values) -> Typed:
    """Evaluate a typed tree as far as what it reads is known; what may fail is left as it is."""
    path = dotted(typed)
    if path is not None and path in values:
        return Constant(type=typed.type, value=float(values[path]) if typed.type is DOUBLE else values[path])
    match typed:
        case Present(select=select) if dotted(select) in values:
            return TRUE
        case Apply():
            return _applied(replace(typed, args=tuple(fold(arg, values) for arg in typed.args)))
        case ListOf():
            return replace(typed, elements=tuple(fold(element, values) for element in typed.elements))
        case Logic():
            return _logic(replace(typed, operands=tuple(fold(operand, values) for operand in typed.operands)))
        case Conditional():
            parts = (fold(part, values) for part in (typed.condition, typed.then, typed.otherwise))
            condition, then, otherwise = parts
            if isinstance(condition, Constant):
                return then if condition.value else otherwise
            return replace(typed, condition=condition, then=then, otherwise=otherwise)
        case _:
            return typed


TRUE: Final = Constant(type=BOOL, value=True)
FALSE: Final = Constant(type=BOOL, value=False)


def _applied(typed: Apply) -> Typed:
    known = all(
        isinstance(arg, Constant) or (isinstance(arg, ListOf) and all(isinstance(e, Constant) for e in arg.elements))
        for arg in typed.args
    )
    if not known or typed.checked:
        return typed
    text = to_python(typed, {})
    value = eval(text, {**INTRINSICS, "__builtins__": {"len": len}})  # noqa: S307  # constants and operators of our own
    return Constant(type=typed.type, value=value)


def _logic(typed: Logic) -> Typed:
    """Fold a conjunction or disjunction: an operand that decides does so whatever the others are, errors included."""
    deciding = FALSE if typed.conjunction else TRUE
    if any(isinstance(operand, Constant) and operand.value is deciding.value for operand in typed.operands):
        return deciding
    left = tuple(operand for operand in typed.operands if not isinstance(operand, Constant))
    if not left:
        return TRUE if typed.conjunction else FALSE
    return left[0] if len(left) == 1 else replace(typed, operands=left)


__all__ = ["equivalent", "fold", "situations"]
