"""What the parts of two policies that differ go to by themselves, where their effect on decisions is proved elsewhere.

`governance.comparison` looks at parts, and has to take what it cannot judge for a loosening. Beside a proof of what
becomes of every decision (`difference`), less is left to it:

| part | here |
|---|---|
| rules | nothing: they decide, and do nothing else |
| a mark in a manifest, other than `forbidden` | nothing: it asks for approval, which is part of the decision |
| forbidden zones | nothing: compared as the ground they cover |
| what only conditions read of an object or a tool | nothing |
| inputs | parameter by parameter: narrower is stricter, another default is unknown |
| risk | stricter where neither grants, reviews nor recovery make less of the higher one |
| bounds of the site | inside the former ones is stricter |
| any other zone | nothing reads it but people: unknown |

What it does not name stays as the comparison of parts has it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, cast

from app.governance.changes import LOOSENS, SAME, TIGHTENS
from app.governance.comparison import parts
from app.governance.model import Risk

if TYPE_CHECKING:
    from app.governance.changes import Direction, Found
    from app.governance.model import SiteObject, Tool, Zone
    from app.governance.policy import PolicySet

Part = tuple[str, object, object, "Direction"]
FORBIDDEN: Final = "forbidden"


def standing(old: PolicySet, new: PolicySet) -> Found:
    """Yield every part that is another, and which way it goes but for the decisions."""
    for found in parts(old, new):
        part, before, after, _ = found
        if part.startswith("capabilities/") and part.endswith("/inputs"):
            yield from _inputs(part, cast("Mapping[str, Any]", before), cast("Mapping[str, Any]", after))
        else:
            yield part, before, after, _way(old, new, found)


def _way(old: PolicySet, new: PolicySet, found: Part) -> Direction:
    part, before, after, direction = found
    match part.split("/"):
        case ["rules", *_]:
            return SAME
        case ["capabilities", name, "risk"]:
            return _risk(old, new, name)
        case ["capabilities", _, "env_profile", _]:
            return direction if FORBIDDEN in (before, after) else SAME
        case ["site", "bounds_m"]:
            return _bounds(cast("tuple[float, ...]", before), cast("tuple[float, ...]", after))
        case ["site", kind, name]:
            return _on_site(old, new, kind, name, direction)
        case ["agents", _]:
            return LOOSENS if _open(new) else direction
        case _:
            return direction


def _open(policy: PolicySet) -> bool:
    """Say whether anybody may propose something: then who is known at all may matter to conditions."""
    return any(not found.permissions and not found.recovery for found in policy.capabilities.values())


# The site ------------------------------------------------------------------------------------------------------------


def _on_site(old: PolicySet, new: PolicySet, kind: str, name: str, direction: Direction) -> Direction:
    before, after = getattr(old.site, kind).get(name), getattr(new.site, kind).get(name)
    if kind == "zones":
        return SAME if any(zone is not None and zone.kind == FORBIDDEN for zone in (before, after)) else LOOSENS
    if before is None or after is None:
        return direction
    known = _ONLY_READ.get(kind)
    return SAME if known is not None and known(before) == known(after) else LOOSENS


def _thing(thing: SiteObject) -> SiteObject:
    return replace(thing, fragile=False, hazardous=False)


def _tool(tool: Tool) -> Tool:
    return replace(tool, press=False)


_ONLY_READ: Final[Mapping[str, Callable[[Any], object]]] = {"objects": _thing, "tools": _tool}


def forbidden(policy: PolicySet) -> list[Zone]:
    """Return the zones that nothing may enter."""
    return [zone for zone in policy.site.zones.values() if zone.kind == FORBIDDEN]


def _bounds(before: tuple[float, ...], after: tuple[float, ...]) -> Direction:
    inside = after[0] >= before[0] and after[1] >= before[1] and after[2] <= before[2] and after[3] <= before[3]
    return TIGHTENS if inside else LOOSENS


# Risk ----------------------------------------------------------------------------------------------------------------

_RISKS: Final = (Risk.LOW, Risk.MEDIUM, Risk.HIGH, Risk.CRITICAL)


def _risk(old: PolicySet, new: PolicySet, name: str) -> Direction:
    """Higher is stricter where nothing that goes by risk makes less of it: grants, reviews, recovery."""
    before, after = old.capabilities[name].risk, new.capabilities[name].risk
    granted = new.authority.grants is not None and after in new.authority.grants.risks
    granted_before = old.authority.grants is not None and before in old.authority.grants.risks
    reviewed = all(
        found.review is None or before not in found.review.risks or after in found.review.risks
        for found in new.profiles.values()
    )
    recovered = all(
        (before in row.rule.risks) == (after in row.rule.risks)
        for found in new.profiles.values()
        for row in found.recovery
    )
    higher = _RISKS.index(after) > _RISKS.index(before)
    return TIGHTENS if higher and granted <= granted_before and reviewed and recovered else LOOSENS


# Inputs --------------------------------------------------------------------------------------------------------------

_WORDS: Final = frozenset({"title", "description", "$comment", "examples"})


def _inputs(part: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[Part]:
    """Compare two input schemas parameter by parameter."""
    for key in sorted({*old, *new} - {"properties"}):
        before, after = old.get(key), new.get(key)
        if before != after:
            yield f"{part}/{key}", before, after, _key(key, before, after)
    mine, theirs = old.get("properties", {}), new.get("properties", {})
    for name in sorted({*mine, *theirs}):
        place = f"{part}/{name}"
        if name not in mine or name not in theirs:
            yield place, mine.get(name), theirs.get(name), LOOSENS
            continue
        for key in sorted({*mine[name], *theirs[name]}):
            before, after = mine[name].get(key), theirs[name].get(key)
            if before != after:
                yield f"{place}/{key}", before, after, _key(key, before, after)


def _key(key: str, before: object, after: object) -> Direction:
    """Say which way another value of a keyword goes: what takes fewer proposals is stricter."""
    if key in _WORDS:
        return SAME
    narrower = _NARROWER.get(key)
    if narrower is None or after is None:
        return LOOSENS
    return TIGHTENS if before is None or narrower(before, after) else _again(key, before, after)


def _again(key: str, before: object, after: object) -> Direction:
    listed = key in ("enum", "required")
    return SAME if listed and set(cast("list[str]", before)) == set(cast("list[str]", after)) else LOOSENS


_NARROWER: Final[Mapping[str, Callable[[Any, Any], bool]]] = {
    "minimum": lambda before, after: after > before,
    "exclusiveMinimum": lambda before, after: after > before,
    "maximum": lambda before, after: after < before,
    "exclusiveMaximum": lambda before, after: after < before,
    "enum": lambda before, after: set(after) < set(before),
    "required": lambda before, after: set(after) > set(before),
}

__all__ = ["forbidden", "standing"]
