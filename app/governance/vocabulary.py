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
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from app.governance.expression import Env, check, declare
from app.governance.expression_syntax import parse
from app.governance.expression_tree import BOOL, DOUBLE, INT, STRING, Field, RecordType, SetType
from app.governance.model import Mode, Risk
from app.governance.policy_model import LIMIT_UNITS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.expression_syntax import Tree
    from app.governance.expression_tree import Type, Typed
    from app.governance.model import Capability, Json

_TARGET: Final = RecordType(
    name="target",
    fields={
        "name": Field(STRING),
        "kind": Field(STRING),
        "mass_kg": Field(DOUBLE, unit="kg", within=1e6),
        "fragile": Field(BOOL),
        "hazardous": Field(BOOL),
    },
    attributes=True,
)
_PLACE: Final = RecordType(
    name="place",
    fields={
        "name": Field(STRING),
        "kind": Field(STRING),
        "forbidden": Field(BOOL),
        "outside": Field(BOOL),
        "corridor": Field(STRING, required=False),
    },
    attributes=True,
)
_TOOL: Final = RecordType(
    name="tool", fields={"name": Field(STRING), "kind": Field(STRING), "press": Field(BOOL)}, attributes=True
)
_METADATA: Final = RecordType(
    name="metadata",
    fields={
        "confidence": Field(DOUBLE, required=False, within=1.0),
        "intent": Field(STRING, required=False),
        "priority": Field(INT, required=False),
    },
)
_CAPABILITY: Final = RecordType(
    name="capability",
    fields={"name": Field(STRING), "risk": Field(STRING, among=frozenset(risk.value for risk in Risk))},
    attributes=True,
)
_PROFILE: Final = RecordType(
    name="profile",
    fields={
        "name": Field(STRING),
        "sensitivity": Field(DOUBLE, within=1.0),
        "shared_floor": Field(BOOL),
    },
    attributes=True,
)
_LIMITS: Final = RecordType(
    name="limits", fields={name: Field(DOUBLE, unit=unit, within=1e9) for name, unit in LIMIT_UNITS.items()}
)
_WORLD: Final = RecordType(
    name="world",
    fields={
        "people_count": Field(INT),
        "people_nearest_m": Field(DOUBLE, unit="m", within=1e9),
        "gripper_empty": Field(BOOL),
        "arm_ready": Field(BOOL),
        "arm_retracted": Field(BOOL),
        "sensors_fresh": Field(BOOL),
        "holding": Field(STRING, required=False),
    },
    attributes=True,
)

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


def _params(capability: Capability) -> RecordType:
    there = always_there(capability)
    fields = {
        name: Field(
            _SCALARS[str(spec["type"])],
            required=name in there,
            unit=str(spec["unit"]) if "unit" in spec else None,
            within=_within(spec),
            among=_choices(spec),
        )
        for name, spec in properties(capability).items()
        if str(spec.get("type")) in _SCALARS
    }
    return RecordType(name="params", fields=fields)


def _choices(spec: Mapping[str, Json]) -> frozenset[str] | None:
    listed = spec.get("enum")
    return frozenset(value for value in listed if isinstance(value, str)) if isinstance(listed, list) else None


def _within(spec: Mapping[str, Json]) -> float | None:
    low, high = spec.get("minimum"), spec.get("maximum")
    if isinstance(low, (int, float)) and isinstance(high, (int, float)):
        return max(abs(low), abs(high))
    return None


def _agent(permissions: frozenset[str] | None) -> RecordType:
    held = Field(SetType(STRING), among=permissions)
    return RecordType(name="agent", fields={"name": Field(STRING), "permissions": held}, attributes=True)


def declarations(capability: Capability, permissions: frozenset[str] | None = None) -> Env:
    """Declare the variables that conditions about a capability may use; permissions are those there are, if known."""
    variables: dict[str, Type | Field] = {
        "params": _params(capability),
        "target": _TARGET,
        "place": _PLACE,
        "agent": _agent(permissions),
        "metadata": _METADATA,
        "capability": _CAPABILITY,
        "profile": _PROFILE,
        "limits": _LIMITS,
        "mode": Field(STRING, among=frozenset(mode.value for mode in Mode)),
        "world": _WORLD,
        "operator_on_duty": BOOL,
    }
    if "tool" in referring(capability):
        variables["tool"] = _TOOL
    return declare(variables)


class Vocabulary:
    """Types conditions, each (source, capability) once."""

    def __init__(self, capabilities: Mapping[str, Capability], permissions: frozenset[str] | None = None) -> None:
        """Declare the variables of every capability; no condition names a permission that is not among those given."""
        self._envs = {name: declarations(capability, permissions) for name, capability in capabilities.items()}
        self._typed: dict[tuple[str, str, Type], Typed] = {}
        self._trees: dict[str, Tree] = {}  # a condition of all capabilities is parsed once
        self._permissions = permissions

    def replacing(self, capability: Capability) -> Vocabulary:
        """Return the same vocabulary but for one capability, with everything typed so far about the others."""
        other = Vocabulary({capability.name: capability}, self._permissions)
        other._envs = {**self._envs, **other._envs}
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
