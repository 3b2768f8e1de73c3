"""JSON Schema of every kind of policy file, made of the shapes that loading holds the files to.

With it an editor completes keys and words and underlines what does not fit, while it is typed. A schema says what a
file may contain and which words there are; whether names lead somewhere and conditions type-check only loading knows.

1. pydantic writes the shape down; what its own description of a mapping leaves open (`additionalProperties` beside
   `patternProperties`) is closed, as the shape closes it.
2. `_WORDS` are the lists of words that `bundle_checks` holds a text to, and `_TOGETHER` what it asks of several keys of
   one mapping: both from the same constants, and tests hold the two against each other with every planted fault.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

from pydantic.json_schema import GenerateJsonSchema

from app.governance import bundle_promises as promises
from app.governance import bundle_shapes as shapes
from app.governance.bundle_checks import PARAM_TYPES, UNITS
from app.governance.bundle_checks_profile import ASKING, RESERVED
from app.governance.bundle_references import DIALECT, INSIDE, REFERRING
from app.governance.conditions import TESTS
from app.governance.policy_model import FAILURES, LIMIT_UNITS, NAMED_THRESHOLDS, REFERENCES, SENSORS, SIGNAL_UNITS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from pydantic_core import core_schema

Refine: TypeAlias = "Callable[[dict[str, Any]], dict[str, Any]]"

SUFFIX: Final = ".schema.json"
MODELINE: Final = "# yaml-language-server: $schema="


@dataclass(frozen=True, slots=True, kw_only=True)
class FileKind:
    """A kind of policy file: its name, where such files stand in a policy directory, and the shape they have."""

    name: str
    files: str
    shape: type[shapes.Shape]

    def modeline(self) -> str:
        """Return the comment by which editors find the schema, of a policy directory beside one called `schemas`."""
        return f"{MODELINE}{'../' * (self.files.count('/') + 1)}schemas/{self.name}{SUFFIX}"


KINDS: Final[Mapping[str, FileKind]] = {
    name: FileKind(name=name, files=files, shape=shape)
    for name, files, shape in (
        ("capability", "capabilities/*.yaml", shapes.CapabilityShape),
        ("profile", "profiles/*.yaml", shapes.ProfileShape),
        ("organization", "organization.yaml", shapes.OrganizationShape),
        ("authority", "authority.yaml", shapes.AuthorityFileShape),
        ("site", "site.yaml", shapes.SiteShape),
        ("properties", "properties.yaml", promises.PropertiesShape),
        ("cases", "tests/*.yaml", shapes.CasesShape),
    )
}


@cache
def schema(kind: str) -> Mapping[str, Any]:
    """Return the JSON Schema (2020-12) of a kind of policy file.

    Raises:
        KeyError: there is no such kind; `KINDS` lists them.
    """
    known = KINDS[kind]
    made = known.shape.model_json_schema(by_alias=True, schema_generator=_Generator)
    parts = cast("dict[str, dict[str, Any]]", made.pop("$defs", {}))
    for name, part in ({**parts, known.shape.__name__: made}).items():
        _complete(name, part)
    head = {"$schema": DIALECT, "$id": f"urn:reins:schema:{kind}", "title": f"Reins policy: {known.files}"}
    return {**head, **made, **({"$defs": parts} if parts else {})}


class _Generator(GenerateJsonSchema):
    """Without a title for every field, and with mappings that take only the keys their shape takes."""

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ANN401  # pydantic's own union of core schemas
        del schema
        return False

    def dict_schema(self, schema: core_schema.DictSchema) -> dict[str, Any]:
        made = super().dict_schema(schema)
        return {**made, "additionalProperties": False} if "patternProperties" in made else made


def _complete(shape: str, part: dict[str, Any]) -> None:
    """Add to the schema of a shape the words its texts may be, what its keys ask of each other, and what they mean."""
    part.pop("title", None)
    declared = cast("dict[str, Any]", part.get("properties", {}))
    for key, said in declared.items():
        if (words := _WORDS.get((shape, key))) is not None:
            declared[key] = words(said)
        if (meaning := _MEANINGS.get((shape, key)) or _MEANINGS.get((_ANY, key))) is not None:
            declared[key] = {"description": meaning, **declared[key]}
    if (together := _TOGETHER.get(shape)) is not None:
        part["allOf"] = list(together)


def _one_of(words: Iterable[str]) -> Refine:
    return lambda said: {**said, "enum": sorted(words)}


def _each_of(words: Iterable[str]) -> Refine:
    return lambda said: {**said, "items": {**said["items"], "enum": sorted(words)}}


def _keys_of(words: Iterable[str]) -> Refine:
    return lambda said: {**said, "propertyNames": {"enum": sorted(words)}}


def _given(key: str) -> dict[str, Any]:
    return {"required": [key], "properties": {key: {"not": {"type": "null"}}}}


def _without(key: str, nothing: Iterable[object] = (None,)) -> dict[str, Any]:
    return {"properties": {key: {"enum": [*nothing]}}}


def _when(condition: dict[str, Any], then: dict[str, Any], otherwise: dict[str, Any] | None = None) -> dict[str, Any]:
    return {"if": condition, "then": then, **({} if otherwise is None else {"else": otherwise})}


def _is(key: str, *values: str) -> dict[str, Any]:
    return {"required": [key], "properties": {key: {"enum": [*values]}}}


def _holds(key: str, *values: str) -> dict[str, Any]:
    return {"required": [key], "properties": {key: {"type": "array", "contains": {"enum": [*values]}}}}


def _threshold(signal: str) -> dict[str, Any]:
    """A threshold is a number, a limit in the signal's unit, or the name that belongs to the signal."""
    names = [name for name, of in NAMED_THRESHOLDS.items() if of == signal]
    limits = [name for name, unit in LIMIT_UNITS.items() if unit == SIGNAL_UNITS[signal]]
    return {
        "anyOf": [
            {"type": ["number", "null"]},
            *([{"enum": names}] if names else ()),
            *([{"type": "object", "properties": {"limit": {"enum": limits}}}] if limits else ()),
        ]
    }


_LAST_ROW: Final = {
    "required": ["on"],
    "properties": {"on": {"const": "any"}, "applies_to": {"type": "null"}, "risks": {"type": "null"}},
}


# Input schemas -------------------------------------------------------------------------------------------------------

_NUMBER: Final = {
    "required": ["unit", "minimum", "maximum"],
    "properties": {
        "unit": {"description": "As the name's ending says.", "enum": sorted(set(UNITS.values()))},
        "minimum": {"type": "number"},
        "maximum": {"type": "number"},
        "x-limit": {"description": "Which limit of the profile holds it.", "enum": sorted(LIMIT_UNITS)},
    },
}
_NAME: Final = {
    "anyOf": [{"required": ["x-ref"]}, {"required": ["enum"]}],
    "properties": {
        "x-ref": {"description": "Which names of the site it may be.", "enum": [*REFERENCES]},
        "enum": {"type": "array", "minItems": 1},
    },
}
_BARE: Final = {"properties": {"unit": False, "x-limit": False}}
_CLOSED: Final = {**{key: {"pattern": INSIDE} for key in REFERRING}, "$schema": {"const": DIALECT}, "$id": False}
_PARAMETER: Final = {
    "type": "object",
    "required": ["type"],
    "properties": {"type": {"enum": sorted(PARAM_TYPES)}, "default": {}, "description": {"type": "string"}, **_CLOSED},
    "allOf": [
        _when(_is("type", "number"), _NUMBER, _BARE),
        _when(_is("type", "string"), _NAME),
    ],
}


def _parameters() -> dict[str, Any]:
    """Numbers are named in their unit: `speed_mps` in m/s."""
    by_unit = {
        f"{suffix}$": {"allOf": [_PARAMETER, _when(_is("type", "number"), _in_unit(unit))]}
        for suffix, unit in UNITS.items()
    }
    other = {"allOf": [_PARAMETER, {"properties": {"type": {"enum": sorted({*PARAM_TYPES} - {"number"})}}}]}
    return {"type": "object", "patternProperties": by_unit, "additionalProperties": other}


def _in_unit(unit: str) -> dict[str, Any]:
    """A limit in the same unit may hold it, from above only: so it does not go below zero."""
    limits = sorted(name for name, has in LIMIT_UNITS.items() if has == unit)
    held = {"x-limit": {"enum": limits}, "minimum": {"minimum": 0}} if limits else {"x-limit": False}
    return {"properties": {"unit": {"const": unit}, **held}}


def _inputs(said: dict[str, Any]) -> dict[str, Any]:
    del said
    return {
        "type": "object",
        "required": ["type", "additionalProperties"],
        "properties": {
            "type": {"const": "object"},
            "additionalProperties": {"const": False},
            "patternProperties": False,
            **_CLOSED,
            "required": {"type": "array", "items": {"type": "string"}},
            "properties": _parameters(),
        },
    }


_WORDS: Final[Mapping[tuple[str, str], Refine]] = {
    ("CapabilityShape", "inputs"): _inputs,
    ("CapabilityShape", "preconditions"): _each_of(TESTS),
    ("CapabilityShape", "postconditions"): _each_of(TESTS),
    ("ProfileShape", "stale_after_ms"): _keys_of(SENSORS),
    ("WatchShape", "signal"): _one_of(SIGNAL_UNITS),
    ("WatchShape", "failure"): _one_of([*FAILURES, ""]),
    ("RecoveryShape", "on"): _one_of([*FAILURES, "any"]),
}

_TOGETHER: Final[Mapping[str, tuple[dict[str, Any], ...]]] = {
    "RuleShape": (
        _when(
            _is("then", "modify"),
            {"required": ["set"], "properties": {"set": {"minProperties": 1}}},
            {"properties": {"set": {"maxProperties": 0}}},
        ),
        _when(_is("then", "escalate"), {}, _without("approvers")),
    ),
    "SettingShape": (_when(_given("to"), {"allOf": [_without("min"), _without("max")]},
                           {"anyOf": [_given("min"), _given("max")]}),),
    "WatchShape": (
        {"oneOf": [_given("above"), _given("below")]},
        *(
            _when(_is("signal", signal), {"properties": {side: _threshold(signal) for side in ("above", "below")}})
            for signal in SIGNAL_UNITS
        ),
    ),
    "ProfileShape": (
        {"properties": {"profile": {"not": {"enum": sorted(RESERVED)}}, "recovery": {"contains": _LAST_ROW}}},
    ),
    "CapabilityShape": (
        _when({"required": ["recovery"], "properties": {"recovery": {"const": True}}}, {},
              {"properties": {"permissions": {"minItems": 1}}}),
    ),
    "ResponseShape": (
        _when(_is("then", "resume"), _is("enter", "pause")),
        _when(_given("else"), _given("persist_ms")),
    ),
    "RecoveryShape": (_when(_holds("do", "recovery_capability"), _given("capability")),),
    "AuthorityShape": (
        _when(_holds("modes", *sorted(ASKING)), _given("approval"), _without("approval")),
        _when(_given("review"), _holds("modes", "review-only")),
    ),
    "ReviewShape": (
        {"anyOf": [{"required": [key], "properties": {key: {"minItems": 1}}} for key in ("risk", "outcomes")]},
    ),
    "PropertyShape": (
        {"anyOf": [{"required": ["never"], "properties": {"never": {"minItems": 1}}},
                   _given("always"), _given("approvers")]},
    ),
}  # fmt: skip

_ANY: Final = ""
_MEANINGS: Final[Mapping[tuple[str, str], str]] = {
    (_ANY, "applies_to"): "The capabilities it is for; left out: all of them.",
    (_ANY, "profiles"): "The profiles it is for; left out: all of them.",
    ("RuleShape", "when"): "A condition in CEL over params, target, place, tool, agent, metadata, capability, profile, "
    "limits, mode, world and operator_on_duty; left out: always.",
    ("RuleShape", "then"): "modify bounds parameters, escalate asks people, deny refuses; the strictest rule wins.",
    ("RuleShape", "set"): "Of a `modify` rule: bounds by parameter, or `to`, a CEL expression for a name.",
    ("RuleShape", "approvers"): "Of an `escalate` rule: how many different people approve.",
    ("RuleShape", "because"): "The reason, as agents and people read it.",
    ("RuleShape", "remedy"): "What an agent may do instead.",
    ("CapabilityShape", "version"): "Semantic: MAJOR.MINOR.PATCH; what changed demands which part grows.",
    ("CapabilityShape", "changes"): "By version, what came with it; agents that ask for an older one are told.",
    ("CapabilityShape", "recovery"): "Whether governance alone proposes it, to recover.",
    ("CapabilityShape", "inputs"): "A closed JSON Schema of the parameters; numbers with unit, minimum and maximum.",
    ("CapabilityShape", "permissions"): "What an agent has to hold to propose it.",
    ("CapabilityShape", "rollback"): "The recovery capability that undoes it, or null.",
    ("CapabilityShape", "env_profile"): "Every profile, and whether it is enabled there.",
    ("ProfileShape", "sensitivity"): "0 to 1: how soon a change of a signal is taken for one.",
    ("ProfileShape", "shared_floor"): "Whether people work on the same floor while the robot moves.",
    ("ProfileShape", "stale_after_ms"): "After how long without a reading a sensor counts as silent.",
    ("ProfileShape", "recovery"): "The first row that matches holds; the last one is `on: any`.",
    ("LimitShape", "source"): "Where the number comes from: a clause of a standard, or your risk assessment.",
    ("SeparationShape", "human_speed_mps"): "How fast a person walks towards the robot (ISO/TS 15066:2016, 5.5.4).",
    ("SeparationShape", "reaction_s"): "From a person's move to the robot's first reaction.",
    ("SeparationShape", "stopping_s"): "From the first reaction to standstill.",
    ("SeparationShape", "intrusion_m"): "How far a hand reaches before it is noticed: C.",
    (
        "ResponseShape",
        "clear_beyond",
    ): "By how much the signal has to be within its threshold to be clear, in its unit.",
    ("ResponseShape", "else"): "What follows when the condition has not cleared after persist_ms.",
    ("ApprovalShape", "risk"): "The risks that ask without further cause.",
    ("CaseShape", "expect"): "What must come of it; what is not named is not compared.",
}


__all__ = ["KINDS", "MODELINE", "FileKind", "schema"]
