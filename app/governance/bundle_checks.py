"""What a policy directory has to mean before it is used: names exist, bounds hold something, nothing is uncovered.

Each check yields problems; none stops at the first, so that one run of `reins policy check` shows everything.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, cast

import jsonschema_rs

from app.governance.bundle_checks_values import listed, unproposable
from app.governance.bundle_references import references
from app.governance.bundle_yaml import Path, Reader
from app.governance.conditions import TESTS
from app.governance.errors import DeclarationError, ExpressionError, PolicyError
from app.governance.expression_tree import BOOL, STRING, Conditional, Constant
from app.governance.fitting import validator
from app.governance.policy_model import (
    LIMIT_UNITS,
    REFERENCES,
)
from app.governance.vocabulary import Vocabulary, always_there, properties, referring

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from app.governance import bundle_shapes as shapes
    from app.governance.expression_tree import Typed
    from app.governance.model import Capability, Json

UNITS: Final[Mapping[str, str]] = {
    "_m": "m", "_mps": "m/s", "_n": "N", "_s": "s", "_ms": "ms", "_rad": "rad", "_kg": "kg", "_nm": "N.m",
}  # fmt: skip
ASKING: Final = frozenset({"approval-required", "approval-on-escalation"})
HUMANS: Final = ASKING | {"takeover-enabled"}
MANIPULATION: Final = "manipulation"
MAY_BE_LEFT_OUT: Final = frozenset({"target", "corridor"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """Every name there is, so that references can be checked.

    `unread` are capabilities whose manifests could not be read: they may be named, and nothing else is known of them.
    `takeover` is none of `recoveries`: it does nothing unless a human drives, so nothing is undone or mended by it.
    """

    capabilities: Mapping[str, Capability]
    recoveries: frozenset[str]
    profiles: frozenset[str]
    permissions: frozenset[str]
    vocabulary: Vocabulary
    names: Mapping[str, frozenset[str]]  # those of the site, by kind of reference
    modes: Mapping[str, frozenset[str]]  # modes of authority, by profile
    unread: frozenset[str] = frozenset()

    @property
    def named(self) -> frozenset[str]:
        """Return what may be named as a capability."""
        return self.unread.union(self.capabilities)


# Capabilities --------------------------------------------------------------------------------------------------------


def capability(reader: Reader, shape: shapes.CapabilityShape, known: Known) -> Iterator[PolicyError]:
    """Check a manifest: conditions, permissions, rollback, coverage of profiles."""
    if f"{shape.name}.yaml" != reader.document.file.rpartition("/")[2]:
        yield reader.problem(("name",), f"`{shape.name}` stands in `{reader.document.file}`", [f"{shape.name}.yaml"])
    for key, names in (("preconditions", shape.preconditions), ("postconditions", shape.postconditions)):
        for index, name in enumerate(names):
            yield from reader.unknown((key, index), "condition", name, TESTS)
    for index, name in enumerate(shape.permissions):
        yield from reader.unknown(("permissions", index), "permission", name, known.permissions)
    if not shape.permissions and not shape.recovery:
        message = "a capability that agents propose needs a permission"
        yield reader.problem(("permissions",), message, sorted(known.permissions))
    if shape.rollback is not None and shape.rollback not in known.recoveries:
        message = f"there is no recovery capability `{shape.rollback}`"
        yield reader.problem(("rollback",), message, [*sorted(known.recoveries), "null: it has none"])
    for name, spec in properties(known.capabilities[shape.name]).items():
        yield from listed(reader, ("inputs", "properties", name), spec)
    yield from _named_always(reader, known.capabilities[shape.name])
    yield from _named(reader, known.capabilities[shape.name], known)
    yield from _coverage(reader, shape, known)


def _named_always(reader: Reader, found: Capability) -> Iterator[PolicyError]:
    """What a proposal handles, works or looks at is always named; a target may be a point, a corridor none."""
    for kind, param in referring(found).items():
        if kind not in MAY_BE_LEFT_OUT and param not in always_there(found):
            message = f"`{param}` names the {kind}, and may be left out: nothing could be decided about it then"
            yield reader.problem(("inputs", "properties", param), message, [f"required: [{param}]"])


def _named(reader: Reader, found: Capability, known: Known) -> Iterator[PolicyError]:
    """Whatever a schema itself gives a parameter that names something is there: admission would reject it."""
    for kind, param in referring(found).items():
        spec = properties(found)[param]
        listed = spec.get("enum")
        given: list[tuple[Path, Json]] = [((key,), spec[key]) for key in ("const", "default") if key in spec]
        given += [(("enum", index), value) for index, value in enumerate(listed if isinstance(listed, list) else ())]
        texts = [(step, value) for step, value in given if isinstance(value, str)]
        for step, value in texts if kind in known.names else ():
            yield from reader.unknown(("inputs", "properties", param, *step), kind, value, known.names[kind])


def _coverage(reader: Reader, shape: shapes.CapabilityShape, known: Known) -> Iterator[PolicyError]:
    for name in shape.env_profile:
        yield from reader.unknown(("env_profile", name), "profile", name, known.profiles)
    for name in sorted(known.profiles - shape.env_profile.keys()):
        message = f"profile `{name}` is not covered: say whether `{shape.name}` is enabled there"
        yield reader.problem(("env_profile",), message, ["allowed", "guarded", "approval-required", "forbidden"])


def inputs(reader: Reader, shape: shapes.CapabilityShape) -> Iterator[PolicyError]:
    """Check an input schema: valid, closed, every parameter of a known kind, numbers with unit and bounds."""
    schema = shape.inputs
    if lost := [*references(reader, schema)]:
        yield from lost
        return
    try:
        whole = validator(schema)
        jsonschema_rs.meta.validate(schema)
    except (ValueError, jsonschema_rs.ValidationError) as error:
        yield _no_schema(reader, error)
        return
    if schema.get("type") != "object" or schema.get("additionalProperties") is not False:
        message = "inputs are a closed object"
        yield reader.problem(("inputs",), message, ["type: object", "additionalProperties: false"])
    if "patternProperties" in schema:
        message = "parameters have names: what only fits a pattern, no rule and no limit would hold"
        yield reader.problem(("inputs", "patternProperties"), message, ["properties"])
    declared = schema.get("properties")
    for name, spec in (declared if isinstance(declared, dict) else {}).items():
        path = ("inputs", "properties", name)
        if not isinstance(spec, dict) or str(spec.get("type")) not in _PARAM_CHECKS:
            yield reader.problem(path, f"`{name}` needs a type", list(_PARAM_CHECKS))
            continue
        yield from _PARAM_CHECKS[str(spec["type"])](reader, path, name, cast("Mapping[str, Json]", spec))
        yield from _default(reader, path, cast("Mapping[str, Json]", spec), whole)
    yield from _references(reader, cast("Mapping[str, object]", declared if isinstance(declared, dict) else {}))


def _no_schema(reader: Reader, error: Exception) -> PolicyError:
    """Say where a schema is none; of a ValueError (a schema too strange to look at) only that it is not."""
    inside = cast("Path", tuple(getattr(error, "instance_path", ())))
    detail, valid = str(getattr(error, "message", error)).splitlines()[0], list[str]()
    if inside[-1:] == ("type",):
        detail, valid = f"`{getattr(error, 'instance', '')}` is no type", list(_PARAM_CHECKS)
    return reader.problem(("inputs", *inside), f"not a valid JSON Schema: {detail}", valid)


def _references(reader: Reader, declared: Mapping[str, object]) -> Iterator[PolicyError]:
    """A kind is referred to once, or all but one of its names would go unheeded; an action is one of its tool's."""
    kinds: dict[object, str] = {}
    for name, spec in declared.items():
        kind = cast("Mapping[str, object]", spec).get("x-ref") if isinstance(spec, dict) else None
        path = ("inputs", "properties", name, "x-ref")
        if isinstance(kind, str) and kind in kinds:
            message = f"`{name}` and `{kinds[kind]}` both refer to a kind of name, `{kind}`: one may"
            yield reader.problem(path, message, [other for other in REFERENCES if other not in kinds])
        if isinstance(kind, str):
            kinds[kind] = name
    if "action" in kinds and "tool" not in kinds:
        path = ("inputs", "properties", kinds["action"], "x-ref")
        yield reader.problem(path, f"`{kinds['action']}` is an action, but no parameter is its tool", ["x-ref: tool"])


def _number(reader: Reader, path: Path, name: str, spec: Mapping[str, Json]) -> Iterator[PolicyError]:
    end = next((end for end in UNITS if name.endswith(end)), "")
    suffix = UNITS.get(end)
    unit = spec.get("unit")
    if unit not in UNITS.values():
        yield reader.problem((*path, "unit"), f"`{name}` needs a unit, `{unit}` is none", sorted(set(UNITS.values())))
    elif suffix != unit:
        called = f"{name.removesuffix(end)}{next(other for other, has in UNITS.items() if has == unit)}"
        said = f"is named in `{suffix}`" if suffix else "is named in no unit"
        valid = [*([f"unit: {suffix}"] if suffix else []), f"the name {called}"]
        yield reader.problem((*path, "unit"), f"unit mismatch: `{name}` {said}, declared in `{unit}`", valid)
    low, high = spec.get("minimum"), spec.get("maximum")
    if not isinstance(low, (int, float)) or not isinstance(high, (int, float)):
        yield reader.problem(path, f"`{name}` needs a finite range", ["minimum and maximum"])
    elif low >= high:
        message = f"empty range: minimum `{low}` is not below maximum `{high}`"
        yield reader.problem((*path, "minimum"), message, [f"a minimum below {high}", f"a maximum above {low}"])
    limit = spec.get("x-limit")
    if isinstance(low, (int, float)) and low < 0 and unit in LIMIT_UNITS.values():
        message = f"`{name}` goes down to `{low}`: a limit in `{unit}` holds it from above only"
        yield reader.problem((*path, "minimum"), message, ["a minimum of 0 or more"])
    if limit is not None and LIMIT_UNITS.get(str(limit)) != unit:
        fitting = [other for other, has in LIMIT_UNITS.items() if has == unit]
        yield reader.problem((*path, "x-limit"), f"unit mismatch: `{limit}` is no limit in `{unit}`", fitting)


def _string(reader: Reader, path: Path, name: str, spec: Mapping[str, Json]) -> Iterator[PolicyError]:
    reference = spec.get("x-ref")
    yield from _plain(reader, path, name, spec)
    if reference is None and "enum" not in spec:
        yield reader.problem(path, f"`{name}` is neither a name of the site nor one of a list", ["x-ref", "enum"])
    elif reference is not None:
        yield from reader.unknown((*path, "x-ref"), "kind of reference", reference, REFERENCES)


def _plain(reader: Reader, path: Path, name: str, spec: Mapping[str, Json]) -> Iterator[PolicyError]:
    for key in ("unit", "x-limit"):
        if key in spec:
            yield reader.problem(
                (*path, key), f"`{key}` belongs to a number, `{name}` is a {spec['type']}", ["type: number"]
            )


_PARAM_CHECKS: Final = {"number": _number, "integer": _plain, "string": _string, "boolean": _plain}
PARAM_TYPES: Final = tuple(_PARAM_CHECKS)


def _default(
    reader: Reader, path: Path, spec: Mapping[str, Json], whole: jsonschema_rs.Draft202012Validator
) -> Iterator[PolicyError]:
    """Hold a default against its own parameter; what it refers to stands in the whole schema."""
    own = [*path[1:]]
    found = whole.iter_errors({path[-1]: spec["default"]}) if "default" in spec else ()
    if any(error.evaluation_path[: len(own)] == own for error in found):
        message = f"default `{spec['default']}` is not valid for the parameter itself"
        yield reader.problem((*path, "default"), message, _taken(spec))


def _taken(spec: Mapping[str, Json]) -> list[str]:
    """Say what a parameter takes: one of its list, what lies in its range, else what is of its type."""
    listed, low, high = spec.get("enum"), spec.get("minimum"), spec.get("maximum")
    if isinstance(listed, list):
        return [str(value) for value in listed]
    if isinstance(low, (int, float)) and isinstance(high, (int, float)) and low <= high:
        return [f"{low:g} to {high:g}"]
    return [f"a {spec['type']}"]


def vocabulary(reader: Reader, found: Capability) -> Iterator[PolicyError]:
    """Check that a capability's parameters can be spoken of in conditions."""
    try:
        Vocabulary({found.name: found})
    except DeclarationError as error:
        yield reader.problem(("inputs", "properties", error.name), error.message)


# Rules ---------------------------------------------------------------------------------------------------------------


def rules(reader: Reader, shapes_: Sequence[shapes.RuleShape], known: Known) -> Iterator[PolicyError]:
    """Check a list of rules: unique ids, known names, conditions that type-check, bounds that hold something."""
    yield from repeated(reader, "rules", "rule", [shape.id for shape in shapes_])
    for index, shape in enumerate(shapes_):
        path: Path = ("rules", index)
        yield from _rule_names(reader, path, shape, known)
        yield from _rule_effect(reader, path, shape)
        scope = [name for name in shape.applies_to or known.capabilities if name in known.capabilities]
        yield from _condition(reader, (*path, "when"), shape.when, scope, known)
        yield from _settings(reader, path, shape, scope, known)


def repeated(reader: Reader, key: str, what: str, ids: Sequence[str]) -> Iterator[PolicyError]:
    """Yield a problem for every id that another of the same list has before."""
    first: dict[str, int] = {}
    for index, name in enumerate(ids):
        if name in first:
            line = reader.document.line((key, first[name], "id"))
            message = f"{what} `{name}` stands twice, first on line {line}"
            yield reader.problem((key, index, "id"), message, [f"an id that no other {what} of this file has"])
        first.setdefault(name, index)


def _rule_names(reader: Reader, path: Path, shape: shapes.RuleShape, known: Known) -> Iterator[PolicyError]:
    for index, name in enumerate(shape.applies_to or ()):
        yield from reader.unknown((*path, "applies_to", index), "capability", name, known.named)
    for index, name in enumerate(shape.profiles or ()):
        yield from reader.unknown((*path, "profiles", index), "profile", name, known.profiles)


def _rule_effect(reader: Reader, path: Path, shape: shapes.RuleShape) -> Iterator[PolicyError]:
    if shape.then == "modify" and not shape.set:
        yield reader.problem(path, "a `modify` rule needs `set`: it could not modify anything", ["set"])
    if shape.then != "modify" and shape.set:
        message = f"`set` belongs to a `modify` rule, this one says `{shape.then}`"
        yield reader.problem((*path, "set"), message, ["then: modify"])
    if shape.then != "escalate" and shape.approvers is not None:
        yield reader.problem((*path, "approvers"), "`approvers` belongs to an `escalate` rule", ["then: escalate"])


def _condition(
    reader: Reader, path: Path, source: str | None, scope: Iterable[str], known: Known, expect: object = BOOL
) -> Iterator[PolicyError]:
    told: set[str] = set()
    for name in scope if source is not None else ():
        try:
            known.vocabulary.typed(cast("str", source), name, expect)  # pyright: ignore[reportArgumentType]
        except ExpressionError as error:
            message = f"column {error.column}: {error.message}"
            if message not in told:
                told.add(message)
                yield reader.problem(path, f"{message} (for `{name}`)", error.valid)


def _settings(
    reader: Reader, path: Path, shape: shapes.RuleShape, scope: Sequence[str], known: Known
) -> Iterator[PolicyError]:
    for param, setting in shape.set.items():
        here = (*path, "set", param)
        holders = [name for name in scope if param in properties(known.capabilities[name])]
        if (
            scope
            and not holders
            and known.unread.isdisjoint(known.unread if shape.applies_to is None else shape.applies_to)
        ):
            names = {other for name in scope for other in properties(known.capabilities[name])}
            yield from reader.unknown(here, "parameter", param, names)
        if setting.to is None:
            yield from _numeric_setting(reader, here, param, setting, [known.capabilities[name] for name in holders])
        elif setting.min is not None or setting.max is not None:
            yield reader.problem(here, "`to` says the value, it goes without `min` and `max`", ["to", "min and max"])
        else:
            yield from _named_setting(reader, here, param, [known.capabilities[name] for name in holders])
            mistyped = list(_condition(reader, (*here, "to"), setting.to, holders, known, STRING))
            yield from mistyped or _constants(reader, (*here, "to"), param, setting.to, holders, known)


def _numeric_setting(
    reader: Reader, path: Path, param: str, setting: shapes.SettingShape, holders: Sequence[Capability]
) -> Iterator[PolicyError]:
    if setting.min is None and setting.max is None:
        yield reader.problem(path, "an empty bound", ["min", "max", "to"])
    elif setting.min is not None and setting.max is not None and setting.min > setting.max:
        message = f"inverted bound: min `{setting.min}` is above max `{setting.max}`"
        yield reader.problem(path, message, [f"a min up to {setting.max:g}", f"a max from {setting.min:g}"])
    for holder in holders:
        spec = properties(holder)[param]
        if spec.get("type") != "number":
            yield reader.problem(
                path, f"`{param}` of `{holder.name}` is a {spec.get('type')}, it has no bounds", ["to"]
            )
        elif param not in always_there(holder):
            message = f"`{param}` of `{holder.name}` may be left out: give it a default to bound it"
            yield reader.problem(path, message, needed(param))
        else:
            yield from _beyond_schema(reader, path, f"`{param}` of `{holder.name}`", setting, spec)
            yield from unproposable(
                reader, path, f"`{param}` of `{holder.name}`", {"min": setting.min, "max": setting.max}, spec
            )


def needed(param: str) -> list[str]:
    """Say by what a manifest has a parameter always there."""
    return [f"in its manifest a default for {param}", f"required: [{param}]"]


def _beyond_schema(
    reader: Reader, path: Path, what: str, setting: shapes.SettingShape, spec: Mapping[str, Json]
) -> Iterator[PolicyError]:
    """A bound that no value of the input schema keeps denies every proposal it holds for."""
    lowest, highest = cast("float", spec["minimum"]), cast("float", spec["maximum"])
    valid = [f"{lowest:g} to {highest:g}"]
    if setting.min is not None and setting.min > highest:
        yield reader.problem(
            (*path, "min"), f"min `{setting.min:g}` is above the maximum `{highest:g}` of {what}", valid
        )
    if setting.max is not None and setting.max < lowest:
        yield reader.problem(
            (*path, "max"), f"max `{setting.max:g}` is below the minimum `{lowest:g}` of {what}", valid
        )


def _constants(
    reader: Reader, path: Path, param: str, source: str, holders: Sequence[str], known: Known
) -> Iterator[PolicyError]:
    """A constant that the parameter can never be denies every proposal its rule holds for."""
    told: set[str] = set()
    for holder in holders:
        spec = properties(known.capabilities[holder])[param]
        what, allowed = _nameable(param, spec, known)
        for value in _outcomes(known.vocabulary.typed(source, holder, STRING)) if allowed is not None else ():
            if value not in told:
                told.add(value)
                yield from reader.unknown(path, what, value, cast("Collection[str]", allowed))


def _nameable(param: str, spec: Mapping[str, Json], known: Known) -> tuple[str, Collection[str] | None]:
    """Return what a parameter names, and the names it may be: those of its list, else the site's."""
    listed = spec.get("enum")
    if isinstance(listed, list):
        return f"value of `{param}` called", [str(value) for value in listed]
    return str(spec.get("x-ref")), known.names.get(str(spec.get("x-ref")))


def _outcomes(node: Typed) -> Iterator[str]:
    """Yield the constants an expression may come to; what it reads is held against the names when it is decided."""
    match node:
        case Constant(value=value):
            yield str(value)
        case Conditional(then=then, otherwise=otherwise):
            yield from _outcomes(then)
            yield from _outcomes(otherwise)
        case _:
            return


def _named_setting(reader: Reader, path: Path, param: str, holders: Sequence[Capability]) -> Iterator[PolicyError]:
    for holder in holders:
        spec = properties(holder)[param]
        if spec.get("type") != "string":
            yield reader.problem(path, f"`{param}` of `{holder.name}` is a {spec.get('type')}", ["min", "max"])
