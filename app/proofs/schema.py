"""What a capability's input schema says about its parameters together: which may stand beside which, and be what.

Every single parameter's own range or choice is part of its variable (`space`); here are the keywords of the object
around them. A keyword that is not known here leaves proposals in that the schema refuses: what is proved holds all the
same, and a counterexample is held against the real schema before anybody sees it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, cast

import z3

from app.governance.model import Json
from app.proofs.formulas import Formula, both, choose, every, implies, no, some
from app.proofs.values import Theory, Value, constant

OWN: Final = frozenset({"type", "properties", "additionalProperties", "title", "description", "$comment", "$schema"})


class UnknownKeywordError(Exception):
    """A keyword that is not known here."""


@dataclass(frozen=True, slots=True)
class Given:
    """What a proposal gives: where each parameter is given, before defaults, and its value."""

    given: Mapping[str, Formula]
    values: Mapping[str, Value]
    theory: Theory


def mentioned(schema: Mapping[str, Json]) -> bool:
    """Say whether a schema speaks of its parameters together."""
    return not schema.keys() <= OWN | {"required"}


def admitted(schema: Mapping[str, Json], given: Given) -> tuple[Formula, bool]:
    """Return where the object's own keywords are kept, and whether all of them are known."""
    parts: list[Formula] = []
    known = True
    for keyword in schema.keys() - OWN:
        try:
            parts.append(_keyword(keyword, schema, given))
        except UnknownKeywordError:
            known = False
    return every(parts), known


def _within(schema: Json, given: Given) -> Formula:
    """Return where a subschema of the whole object is kept."""
    if isinstance(schema, bool):
        return schema
    if not isinstance(schema, dict):
        raise UnknownKeywordError(str(schema))
    return every(_keyword(keyword, schema, given) for keyword in schema if keyword not in _SILENT)


def _keyword(keyword: str, schema: Mapping[str, Json], given: Given) -> Formula:
    found = _KEYWORDS.get(keyword)
    if found is None:
        raise UnknownKeywordError(keyword)
    return found(schema, given)


def _there(name: Json, given: Given) -> Formula:
    return given.given.get(str(name), False)


def _required(schema: Mapping[str, Json], given: Given) -> Formula:
    return every(_there(name, given) for name in cast("list[Json]", schema["required"]))


def _dependent(schema: Mapping[str, Json], given: Given) -> Formula:
    entries = cast("Mapping[str, list[Json]]", schema["dependentRequired"])
    return every(
        implies(_there(name, given), every(_there(other, given) for other in others))
        for name, others in entries.items()
    )


def _dependent_schemas(schema: Mapping[str, Json], given: Given) -> Formula:
    entries = cast("Mapping[str, Json]", schema["dependentSchemas"])
    return every(implies(_there(name, given), _within(inner, given)) for name, inner in entries.items())


def _branches(schema: Mapping[str, Json], keyword: str, given: Given) -> Sequence[Formula]:
    return [_within(inner, given) for inner in cast("list[Json]", schema[keyword])]


def _one_of(schema: Mapping[str, Json], given: Given) -> Formula:
    branches = _branches(schema, "oneOf", given)
    return some(
        both(branch, *(no(other) for place, other in enumerate(branches) if place != index))
        for index, branch in enumerate(branches)
    )


def _conditional(schema: Mapping[str, Json], given: Given) -> Formula:
    then, otherwise = (_within(schema.get(key, True), given) for key in ("then", "else"))
    return choose(_within(schema["if"], given), then, otherwise)


def _count(schema: Mapping[str, Json], keyword: str, given: Given) -> Formula:
    wanted = cast("int", schema[keyword])
    sure = sum(part is True for part in given.given.values())
    maybe = [part for part in given.given.values() if not isinstance(part, bool)]
    if keyword == "minProperties":
        return True if sure >= wanted else z3.AtLeast(*maybe, wanted - sure) if len(maybe) >= wanted - sure else False
    return False if sure > wanted else z3.AtMost(*maybe, wanted - sure) if maybe else True


def _properties(schema: Mapping[str, Json], given: Given) -> Formula:
    entries = cast("Mapping[str, Json]", schema["properties"])
    return every(implies(_there(name, given), _value(name, inner, given)) for name, inner in entries.items())


def _value(name: str, schema: Json, given: Given) -> Formula:
    """Return where one parameter keeps a subschema of its own."""
    if isinstance(schema, bool):
        return schema
    if not isinstance(schema, dict) or name not in given.values:
        raise UnknownKeywordError(str(schema))
    parts: list[Formula] = []
    for keyword, wanted in schema.items():
        if keyword in ("const", "enum"):
            options = cast("list[Json]", wanted if keyword == "enum" else [wanted])
            parts.append(some(_compared("equal", name, option, given) for option in options))
        elif keyword in _BOUNDS:
            parts.append(_compared(_BOUNDS[keyword], name, wanted, given))
        elif keyword not in _SILENT:
            raise UnknownKeywordError(keyword)
    return every(parts)


def _compared(overload: str, name: str, wanted: Json, given: Given) -> Formula:
    value = given.values[name]
    shown = value.cases[0][1]
    if isinstance(wanted, bool) != (isinstance(shown, bool) or z3.is_bool(shown)):
        return False
    if isinstance(wanted, bool):
        return value.truth if wanted else no(value.truth)
    texts = isinstance(shown, str)
    if isinstance(wanted, str) != texts or not isinstance(wanted, (str, int, float)):
        return False
    if isinstance(shown, float) or (isinstance(shown, z3.ArithRef) and shown.is_real()):
        wanted = float(wanted)
    return given.theory.apply(overload, (value, constant(wanted)), checked=False, wide=False).truth


_BOUNDS: Final[Mapping[str, str]] = {
    "minimum": "at_least",
    "maximum": "at_most",
    "exclusiveMinimum": "greater",
    "exclusiveMaximum": "less",
}
_SILENT: Final = frozenset({"type", "title", "description", "$comment", "default", "unit", "then", "else"})
_KEYWORDS: Final[Mapping[str, Callable[[Mapping[str, Json], Given], Formula]]] = {
    "required": _required,
    "properties": _properties,
    "dependentRequired": _dependent,
    "dependentSchemas": _dependent_schemas,
    "oneOf": _one_of,
    "anyOf": lambda schema, given: some(_branches(schema, "anyOf", given)),
    "allOf": lambda schema, given: every(_branches(schema, "allOf", given)),
    "not": lambda schema, given: no(_within(schema["not"], given)),
    "if": _conditional,
    "then": lambda _schema, _given: True,
    "else": lambda _schema, _given: True,
    "minProperties": lambda schema, given: _count(schema, "minProperties", given),
    "maxProperties": lambda schema, given: _count(schema, "maxProperties", given),
}
