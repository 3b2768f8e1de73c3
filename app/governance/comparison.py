"""What changes between two policies, and which way: does it tighten, loosen, both, or nothing at all?

The comparison is of structure: what a part means is not proved, so a change that is not plainly stricter counts as a
loosening. That is the safe side: a loosening needs a second engineer. `app.proofs.difference` proves more, and calls
less a loosening; nothing may call a loosening anything else.

| part | stricter |
|---|---|
| rule | more of them; a stronger effect; for more capabilities and profiles; tighter bounds; no condition |
| limit, retry budget, deadline | lower |
| permission of an agent, capability, profile, mode, name in the site | fewer |
| required permission, condition, watch rule, approval, confirmation, forbidden zone | more |
| text that only people read | neither |
"""

from __future__ import annotations

import re
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

from app.governance.changes import LOOSENS, SAME, TIGHTENS, summed
from app.governance.model import AuthorityMode, Risk
from app.governance.policy_model import Effect

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from app.governance.changes import Comparison, Direction, Found
    from app.governance.model import Capability, Site
    from app.governance.policy import PolicySet
    from app.governance.policy_model import Agent, Approval, Authority, Profile, Rule, Setting, WatchRow

Compare: TypeAlias = "Callable[[PolicySet, PolicySet], Comparison]"

_RISKS: Final = (Risk.LOW, Risk.MEDIUM, Risk.HIGH, Risk.CRITICAL)
_EFFECTS: Final = (Effect.MODIFY, Effect.ESCALATE, Effect.DENY)
_ENABLED: Final = ("allowed", "guarded", "approval-required", "forbidden")  # from the widest to the strictest


def compare(old: PolicySet, new: PolicySet) -> Comparison:
    """Compare two policies part by part. Pure.

    Args:
        old: the one in force.
        new: the one that may come into force.
    """
    conditions = " ; ".join(rule.when for policy in (old, new) for rule in policy.rules.values() if rule.when)
    return summed(
        (part, before, after, LOOSENS if _read(part, before, after, conditions) else direction)
        for part, before, after, direction in parts(old, new)
    )


def parts(old: PolicySet, new: PolicySet) -> Found:
    """Yield every part that is another, what it was and is, and which way that goes taken by itself.

    What conditions make of it is not looked at.
    """
    yield from _capabilities(old, new)
    yield from _profiles(old, new)
    yield from _rules(old, new)
    yield from _agents(old, new)
    yield from _authority(old.authority, new.authority)
    yield from _site(old.site, new.site)
    if old.permissions != new.permissions:
        yield "permissions", old.permissions, new.permissions, _words(old, new)  # nobody holds one by its being there


_NAMED_IN_CONDITIONS: Final[Mapping[str, str]] = {"sensitivity": "profile.sensitivity", "risk": "capability.risk"}
_HELD = re.compile(r"""["'](\w+)["'] in agent\.permissions""")


def _read(part: str, before: object, after: object, conditions: str) -> bool:
    """Say whether a condition reads what changed: then stricter there may be wider in what follows from it."""
    match part.split("/"):
        case ["profiles", _, "limits", name, *_]:
            return re.search(rf"\blimits\.{name}\b", conditions) is not None
        case ["agents", _, "permissions"]:
            lost = set(cast("frozenset[str]", before)) - set(cast("frozenset[str]", after))
            asked = _HELD.findall(conditions)
            return not lost.isdisjoint(asked) or len(asked) != conditions.count("agent.permissions")
        case [_, _, name] if name in _NAMED_IN_CONDITIONS:
            return _NAMED_IN_CONDITIONS[name] in conditions
        case _:
            return False


# Ways of going -------------------------------------------------------------------------------------------------------


def _less(before: float, after: float) -> Direction:
    """Less is stricter."""
    return TIGHTENS if after < before else LOOSENS


def _more(before: float, after: float) -> Direction:
    """More is stricter."""
    return TIGHTENS if after > before else LOOSENS


def _fewer(before: Any, after: Any) -> Direction:  # noqa: ANN401  # collections of one kind
    """A part of what was before is stricter; the order is none of it."""
    return SAME if set(after) == set(before) else TIGHTENS if set(after) < set(before) else LOOSENS


def _further(before: Any, after: Any) -> Direction:  # noqa: ANN401  # collections of one kind
    """All that was before and more is stricter; the order is none of it."""
    return SAME if set(after) == set(before) else TIGHTENS if set(after) > set(before) else LOOSENS


def _unknown(before: object, after: object) -> Direction:
    """Nothing can be said, so it counts as a loosening."""
    return LOOSENS


def _words(before: object, after: object) -> Direction:
    """Only people read it."""
    return SAME


def _along(scale: tuple[Any, ...]) -> Callable[[Any, Any], Direction]:
    """Return the way along a scale from wide to strict."""
    return lambda before, after: _more(scale.index(before), scale.index(after))


Way: TypeAlias = "Callable[[Any, Any], Direction]"
_INSIDE: Final = None  # in the place of a way: compared by itself, further in


def _fields(part: str, old: Any, new: Any, ways: Mapping[str, Way | None]) -> Found:  # noqa: ANN401  # one dataclass
    """Compare two values of one dataclass field by field; a field that `ways` does not name is unknown."""
    for field in fields(old):
        before, after = getattr(old, field.name), getattr(new, field.name)
        if before != after and (way := ways.get(field.name, _unknown)) is not None:
            yield f"{part}/{field.name}", before, after, way(before, after)


def _named(
    part: str, old: Mapping[str, Any], new: Mapping[str, Any], *, more: Direction, within: Callable[..., Found]
) -> Found:
    """Compare what has names: one more goes the way `more`, one less the other, one in both is looked into."""
    less = LOOSENS if more is TIGHTENS else TIGHTENS
    for name in sorted({*old, *new}):
        place = f"{part}/{name}"
        if name not in new:
            yield place, old[name], None, less
        elif name not in old:
            yield place, None, new[name], more
        elif old[name] != new[name]:
            yield from within(place, old[name], new[name])


def _any(part: str, before: object, after: object) -> Found:
    yield part, before, after, LOOSENS


def _approvers(before: Mapping[Risk, int], after: Mapping[Risk, int]) -> Direction:
    """More people for every risk that is named before, and none left out, is stricter."""
    return TIGHTENS if all(after.get(risk, 0) >= count for risk, count in before.items()) else LOOSENS


def _modes(before: frozenset[AuthorityMode], after: frozenset[AuthorityMode]) -> Direction:
    """More asking and reviewing is stricter; what lets people move the robot, or takes a pause from them, is not."""
    more = {AuthorityMode.APPROVAL_REQUIRED, AuthorityMode.INTERRUPT_ENABLED, AuthorityMode.REVIEW_ONLY}
    # A mode that asks lets somebody allow what would be denied where nobody can be asked.
    if before.isdisjoint({AuthorityMode.APPROVAL_REQUIRED, AuthorityMode.APPROVAL_ON_ESCALATION}):
        more -= {AuthorityMode.APPROVAL_REQUIRED}
    gained, lost = after - before, before - after
    return TIGHTENS if gained <= more and lost <= {AuthorityMode.TAKEOVER_ENABLED} else LOOSENS


def _wider(before: frozenset[str] | None, after: frozenset[str] | None) -> Direction:
    """For more is stricter, of a rule; None is for all."""
    return TIGHTENS if after is None or (before is not None and after > before) else LOOSENS


# Parts ---------------------------------------------------------------------------------------------------------------

_OF_A_CAPABILITY: Final[Mapping[str, Way | None]] = {
    "version": _words, "summary": _words, "changes": _words, "preconditions": _further, "postconditions": _further,
    "permissions": _further, "risk": _along(_RISKS), "timeout_s": _less, "env_profile": _INSIDE,
}  # fmt: skip
_OF_A_PROFILE: Final[Mapping[str, Way | None]] = {
    "sensitivity": _more, "admits": _fewer, "keep_every_tick": _more, "retry_budget": _less,
    "rollback": lambda before, after: _more(before != "optional", after != "optional"),
    "authority": _modes, "limits": _INSIDE, "stale_after_ms": _INSIDE,
    "watch": _INSIDE, "approval": _INSIDE,
}  # fmt: skip
_OF_A_LIMIT: Final[Mapping[str, Way | None]] = {"maximum": _less, "source": _words}
_OF_AN_APPROVAL: Final[Mapping[str, Way | None]] = {
    "risks": _further, "within_s": _less, "default_approvers": _more,
    "approvers": _approvers,
}  # fmt: skip
_OF_A_RULE: Final[Mapping[str, Way | None]] = {
    "applies_to": _wider, "profiles": _wider,
    "when": lambda before, after: TIGHTENS if after is None else LOOSENS, "then": _along(_EFFECTS),
    "settings": _INSIDE, "approvers": _more, "because": _words, "remedy": _words,
}  # fmt: skip
_OF_AUTHORITY: Final[Mapping[str, Way | None]] = {
    "within_s": _less, "confirm_before": _further, "denials": _words, "grants": _INSIDE,
}  # fmt: skip


def _capabilities(old: PolicySet, new: PolicySet) -> Found:
    return _named("capabilities", old.capabilities, new.capabilities, more=LOOSENS, within=_capability)


def _capability(part: str, old: Capability, new: Capability) -> Found:
    yield from _fields(part, old, new, _OF_A_CAPABILITY)
    for profile in sorted({*old.env_profile, *new.env_profile}):
        # A profile that a manifest does not name enables nothing there.
        before, after = (found.env_profile.get(profile, "forbidden") for found in (old, new))
        if before != after:
            yield f"{part}/env_profile/{profile}", before, after, _along(_ENABLED)(before, after)


def _profiles(old: PolicySet, new: PolicySet) -> Found:
    return _named("profiles", old.profiles, new.profiles, more=LOOSENS, within=_profile)


def _profile(part: str, old: Profile, new: Profile) -> Found:
    yield from _fields(part, old, new, _OF_A_PROFILE)
    yield from _named(f"{part}/limits", old.limits, new.limits, more=TIGHTENS, within=_limit)
    ages = (old.stale_after_ms, new.stale_after_ms)
    yield from _named(f"{part}/stale_after_ms", *ages, more=TIGHTENS, within=_number)
    rows = ({row.id: row for row in found.watch} for found in (old, new))
    yield from _named(f"{part}/watch", *rows, more=TIGHTENS, within=_watch_row)
    yield from _approval(f"{part}/approval", old.approval, new.approval)


def _limit(part: str, old: object, new: object) -> Found:
    return _fields(part, old, new, _OF_A_LIMIT)


def _number(part: str, before: float, after: float) -> Found:
    yield part, before, after, _less(before, after)


def _watch_row(part: str, old: WatchRow, new: WatchRow) -> Found:
    number = _less if old.above else _more  # an alarm that comes sooner
    ways = {"number": _numbers(number), "times": number, "for_ms": _less, "applies_to": _wider}
    return _fields(part, old, new, ways)


def _numbers(way: Way) -> Way:
    return lambda before, after: LOOSENS if before is None or after is None else way(before, after)


def _approval(part: str, old: Approval | None, new: Approval | None) -> Found:
    if old is None or new is None:
        if old is not new:
            yield part, old, new, TIGHTENS if old is None else LOOSENS
        return
    yield from _fields(part, old, new, _OF_AN_APPROVAL)


def _rules(old: PolicySet, new: PolicySet) -> Found:
    return _named("rules", old.rules, new.rules, more=TIGHTENS, within=_rule)


def _rule(part: str, old: Rule, new: Rule) -> Found:
    yield from _fields(part, old, new, _OF_A_RULE)
    if old.then is not new.then:
        return  # a stronger effect needs no bounds
    settings = ({setting.param: setting for setting in found.settings} for found in (old, new))
    yield from _named(f"{part}/set", *settings, more=TIGHTENS, within=_setting)


def _setting(part: str, old: Setting, new: Setting) -> Found:
    def bound(way: Way) -> Way:
        return lambda before, after: TIGHTENS if before is None else LOOSENS if after is None else way(before, after)

    return _fields(part, old, new, {"maximum": bound(_less), "minimum": bound(_more)})


def _agents(old: PolicySet, new: PolicySet) -> Found:
    return _named("agents", old.agents, new.agents, more=LOOSENS, within=_agent)


def _agent(part: str, old: Agent, new: Agent) -> Found:
    if old.permissions != new.permissions:
        way = _fewer(old.permissions, new.permissions)
        yield f"{part}/permissions", old.permissions, new.permissions, way
    known, asked = old.permissions | old.supervised, new.permissions | new.supervised
    if old.supervised != new.supervised:
        yield f"{part}/supervised", old.supervised, new.supervised, TIGHTENS if asked <= known else LOOSENS


def _authority(old: Authority, new: Authority) -> Found:
    yield from _fields("authority", old, new, _OF_AUTHORITY)
    if old.grants is None or new.grants is None:
        if old.grants is not new.grants:
            yield "authority/grants", old.grants, new.grants, TIGHTENS if new.grants is None else LOOSENS
        return
    yield from _fields("authority/grants", old.grants, new.grants, {"up_to_s": _less, "risks": _fewer})


def _site(old: Site, new: Site) -> Found:
    forbidden = ({name: zone for name, zone in found.zones.items() if zone.kind == "forbidden"} for found in (old, new))
    yield from _named("site/zones", *forbidden, more=TIGHTENS, within=_any)
    other = ({name: zone for name, zone in found.zones.items() if zone.kind != "forbidden"} for found in (old, new))
    yield from _named("site/zones", *other, more=LOOSENS, within=_any)
    for name in _NAMED_PARTS[1:]:
        yield from _named(f"site/{name}", getattr(old, name), getattr(new, name), more=LOOSENS, within=_any)
    yield from _fields("site", replace(old, **_NOTHING), replace(new, **_NOTHING), {})


_NAMED_PARTS: Final = ("zones", "targets", "surfaces", "areas", "corridors", "objects", "tools")
_NOTHING: Final[Mapping[str, Any]] = {name: {} for name in _NAMED_PARTS}
