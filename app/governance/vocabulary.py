"""The variables that conditions may use, typed per capability, and the Python names they have in a generated decision.

| variable | is |
|---|---|
| `params` | the proposal's parameters, as the capability's input schema types them |
| `target` | the object a proposal handles: the one it names, else the one in the gripper, else a weightless nothing |
| `place` | where it leads: `forbidden`, `outside`, `corridor` |
| `tool` | the tool it works |
| `agent` | `name`, `permissions` (a set) |
| `metadata` | what the agent says about its proposal: `confidence` in 0…1, `intent`, `priority` |
| `capability`, `profile`, `limits`, `mode` | what was proposed, under which profile |
| `world` | what the cell's sensors say: people, gripper, arm |
| `operator_on_duty` | whether a human is there |

A text that is always one of the names a policy has (`target.name`, `capability.name`, `params.surface`) is compared
with those only, so that no condition waits for what does not exist. An agent's name is open: an agent that policy does
not declare may ask, and has no permission.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from app.governance.expression import Env, check, declare
from app.governance.expression_syntax import parse
from app.governance.expression_tree import BOOL, DOUBLE, INT, STRING, Field, RecordType, SetType
from app.governance.model import Mode, Risk
from app.governance.places import LEADING, NOTHING, NOWHERE, kinds, names
from app.governance.policy_model import GOVERNANCE, LIMIT_UNITS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.expression_syntax import Tree
    from app.governance.expression_tree import Type, Typed
    from app.governance.model import Capability, Json, Site


@dataclass(frozen=True, slots=True, kw_only=True)
class Names:
    """The names that a policy has, so that no condition names another; of what is None, any may be named.

    Attributes:
        capabilities: The capabilities.
        profiles: The profiles.
        permissions: The permissions that agents may hold.
        site: Where objects, places and tools have theirs.
    """

    capabilities: frozenset[str] | None = None
    profiles: frozenset[str] | None = None
    permissions: frozenset[str] | None = None
    site: Site | None = None


ANY: Final = Names()

_METADATA: Final = RecordType(
    name="metadata",
    fields={
        "confidence": Field(DOUBLE, required=False, within=1.0),
        "intent": Field(STRING, required=False),
        "priority": Field(INT, required=False),
    },
)
_LIMITS: Final = RecordType(
    name="limits", fields={name: Field(DOUBLE, unit=unit, within=1e9) for name, unit in LIMIT_UNITS.items()}
)
_RISKS: Final = frozenset(risk.value for risk in Risk)
_WORLD: Final[Mapping[str, Field]] = {
    "people_count": Field(INT),
    "people_nearest_m": Field(DOUBLE, unit="m", within=1e9),
    "gripper_empty": Field(BOOL),
    "arm_ready": Field(BOOL),
    "arm_retracted": Field(BOOL),
    "sensors_fresh": Field(BOOL),
}

# What the generated function calls each variable; `world` and `operator_on_duty` are read where they are used.
NAMES: Final[Mapping[str, str]] = {
    "params": "params",
    "target": "target",
    "place": "place",
    "tool": "tool",
    "agent": "agent",
    "metadata": "metadata",
    "capability": "CAPABILITY",
    "profile": "PROFILE",
    "limits": "LIMITS",
    "mode": "mode",
    "world": "facts",
    "operator_on_duty": "on_duty",
}

_SCALARS: Final[Mapping[str, Type]] = {"number": DOUBLE, "integer": INT, "string": STRING, "boolean": BOOL}


def properties(capability: Capability) -> Mapping[str, Mapping[str, Json]]:
    """Return the declared parameters of a capability, name → its schema."""
    found = capability.inputs.get("properties")
    return {name: spec for name, spec in found.items() if isinstance(spec, dict)} if isinstance(found, dict) else {}


def referring(capability: Capability) -> Mapping[str, str]:
    """Return which parameter refers to which kind of name: kind → parameter."""
    return {str(spec["x-ref"]): name for name, spec in properties(capability).items() if "x-ref" in spec}


def always_there(capability: Capability) -> frozenset[str]:
    """Return the parameters that every validated proposal has: required ones, and those with a default."""
    required = capability.inputs.get("required")
    named = frozenset(str(name) for name in required) if isinstance(required, list) else frozenset[str]()
    return named | {name for name, spec in properties(capability).items() if "default" in spec}


def _params(capability: Capability, named: Mapping[str, frozenset[str]]) -> RecordType:
    there = always_there(capability)
    fields = {
        name: Field(
            _SCALARS[str(spec["type"])],
            required=name in there,
            unit=str(spec["unit"]) if "unit" in spec else None,
            within=_within(spec),
            among=_choices(spec, named),
        )
        for name, spec in properties(capability).items()
        if str(spec.get("type")) in _SCALARS
    }
    return RecordType(name="params", fields=fields)


def _choices(spec: Mapping[str, Json], named: Mapping[str, frozenset[str]]) -> frozenset[str] | None:
    """Return what a text can be: one of its list, else a name of the site; admission rejects any other."""
    listed = spec.get("enum")
    if isinstance(listed, list):
        return frozenset(value for value in listed if isinstance(value, str))
    return named.get(str(spec.get("x-ref")))


def _within(spec: Mapping[str, Json]) -> float | None:
    low, high = spec.get("minimum"), spec.get("maximum")
    if isinstance(low, (int, float)) and isinstance(high, (int, float)):
        return max(abs(low), abs(high))
    return None


def _common(known: Names, named: Mapping[str, frozenset[str]]) -> dict[str, Type | Field]:
    """Declare what is the same for every capability, given the names of the site by kind of reference."""
    permissions = None if known.permissions is None else known.permissions | {GOVERNANCE}
    among = _of_site(known.site, named)
    records: Mapping[str, Mapping[str, Field]] = {
        "target": {
            "name": Field(STRING, among=among.get("target.name")),
            "kind": Field(STRING, among=among.get("target.kind")),
            "mass_kg": Field(DOUBLE, unit="kg", within=1e6),
            "fragile": Field(BOOL),
            "hazardous": Field(BOOL),
        },
        "place": {
            "name": Field(STRING, among=among.get("place.name")),
            "kind": Field(STRING, among=among.get("place.kind")),
            "forbidden": Field(BOOL),
            "outside": Field(BOOL),
            "corridor": Field(STRING, required=False, among=named.get("corridor")),
        },
        "tool": {
            "name": Field(STRING, among=named.get("tool")),
            "kind": Field(STRING, among=among.get("tool.kind")),
            "press": Field(BOOL),
        },
        "agent": {"name": Field(STRING), "permissions": Field(SetType(STRING), among=permissions)},
        "capability": {"name": Field(STRING, among=known.capabilities), "risk": Field(STRING, among=_RISKS)},
        "profile": {
            "name": Field(STRING, among=known.profiles),
            "sensitivity": Field(DOUBLE, within=1.0),
            "shared_floor": Field(BOOL),
        },
        "world": {**_WORLD, "holding": Field(STRING, required=False, among=named.get("object"))},
    }
    return {
        "metadata": _METADATA,
        "limits": _LIMITS,
        "mode": Field(STRING, among=frozenset(mode.value for mode in Mode)),
        "operator_on_duty": BOOL,
        **{name: RecordType(name=name, fields=fields, attributes=True) for name, fields in records.items()},
    }


def _of_site(site: Site | None, named: Mapping[str, frozenset[str]]) -> Mapping[str, frozenset[str]]:
    """Return what texts can be that say an object or a place, or that there is none; nothing without a site."""
    if site is None:
        return {}
    there = kinds(site)
    return {
        "target.name": named["object"] | {NOTHING.name},
        "target.kind": there["object"] | {NOTHING.kind},
        "place.name": frozenset({NOWHERE.name}).union(*(named[kind] for kind in LEADING)),
        "place.kind": LEADING | {"point", NOWHERE.kind},
        "tool.kind": there["tool"],
    }


class Vocabulary:
    """Types conditions, each (source, capability) once."""

    def __init__(self, capabilities: Mapping[str, Capability], known: Names = ANY) -> None:
        """Declare the variables of every capability; no condition names what is not among the names that are known."""
        self._known = known
        self._named: Mapping[str, frozenset[str]] = {} if known.site is None else names(known.site)
        self._common = _common(known, self._named)
        self._envs = {name: self._declared(capability) for name, capability in capabilities.items()}
        self._typed: dict[tuple[str, str, Type], Typed] = {}
        self._trees: dict[str, Tree] = {}  # a condition of all capabilities is parsed once

    def _declared(self, capability: Capability) -> Env:
        variables = {"params": _params(capability, self._named), **self._common}
        if "tool" not in referring(capability):
            del variables["tool"]
        return declare(variables)

    def replacing(self, capability: Capability) -> Vocabulary:
        """Return the same vocabulary but for one capability, with everything typed so far about the others."""
        other = Vocabulary({}, self._known)
        other._envs = {**self._envs, capability.name: other._declared(capability)}
        other._trees = self._trees
        other._typed = {key: typed for key, typed in self._typed.items() if key[1] != capability.name}
        return other

    def typed(self, source: str, capability: str, expect: Type = BOOL) -> Typed:
        """Return the typed tree of a condition about a capability.

        Raises:
            ExpressionError: It does not parse, or does not type-check.
        """
        key = (source, capability, expect)
        if key not in self._typed:
            if source not in self._trees:
                self._trees[source] = parse(source)
            self._typed[key] = check(self._trees[source], self._envs[capability], expect)
        return self._typed[key]
