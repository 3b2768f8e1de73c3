"""Conditions: a CEL subset, type-checked on load, turned into Python text that a decision function inlines.

    env = declare({"target": RecordType(name="target", fields={"fragile": Field(BOOL)}), "force_n": DOUBLE})
    typed = check(parse("target.fragile && force_n > 20"), env)
    to_python(typed, {"target": "target", "force_n": "force_n"})     # "(target['fragile'] and (force_n > 20.0))"

1. **Types first.** `check` accepts only what cannot go wrong by type. `int` and `double` do not mix; a literal becomes
   a double beside one. Quantities with different units are neither compared nor added.
2. **Errors are never truth values.** Overflow of 64-bit integers, a double that is not finite, division by zero, an
   index outside the list, a field that is absent: `EvaluationError`. As CEL has it, `false && error` and
   `error && false` are `false`, `true || error` and `error || true` are `true`, every other mixture is the error.
3. **What cannot fail costs nothing.** `check` proves, where it can, that arithmetic stays within range (`Node.reach`)
   and that an optional field is there (`has(a.b) && a.b > 1`). What is proved is emitted bare; `typed.can_fail` says
   whether anything is left that may raise.

What the user of `to_python` guarantees, once per decision, because the emitted text does not check it again: every
variable holds a value of its declared type (an int may stand for a double), doubles are finite, integers have 64 bits,
numbers keep their declared `within`, required fields are there, maps hold no `None`. `conform` establishes exactly
that; `compile_condition` calls it by itself.

Docs: docs/design/expressions.md. Source: CEL language definition, restricted; design, section 5.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Final, cast

from app.governance.errors import DeclarationError, ExpressionError
from app.governance.expression_reach import DOUBLE_MAX, INT_MAX, INT_MIN, REACH
from app.governance.expression_syntax import Syntax, Tree
from app.governance.expression_tree import (
    ANY,
    BOOL,
    DOUBLE,
    INT,
    OVERLOADS,
    STRING,
    Apply,
    Conditional,
    Constant,
    Field,
    ListOf,
    ListType,
    Logic,
    MapType,
    Overload,
    Present,
    Quantifier,
    RecordType,
    Scalar,
    Select,
    SetType,
    Type,
    Typed,
    Variable,
    children,
    dotted,
    require_identifier,
    show,
)

MAX_QUANTIFIERS: Final = 2
_SAME_UNIT: Final = frozenset({"==", "!=", "<", "<=", ">", ">=", "+", "-", "%", "in"})
_SUMS: Final = frozenset({"+", "-", "%"})
_ADDING: Final = frozenset({"+", "-"})
_MATCHING: Final = frozenset({"==", "!=", "in"})
_SCALING: Final = frozenset({"*", "/"})
_OF_A_SET: Final = ("x in set", "set.exists(x, condition on x)", "set.all(x, condition on x)", "size(set)")
_PARTS: Final[Mapping[str, Callable[[str, str], bool]]] = {
    ".startsWith": str.startswith,
    ".endsWith": str.endswith,
    ".contains": str.__contains__,
}
_COUNTS: Final = frozenset({"size", ".size", "!_", *_PARTS})


# Variables -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Env:
    """The variables conditions may use."""

    variables: Mapping[str, Field]


def declare(variables: Mapping[str, Type | Field]) -> Env:
    """Declare the variables conditions may use, each by its type, or by a `Field` that adds a unit and a range.

    Raises:
        DeclarationError: A name is not usable in the language, or a variable is declared optional.
    """
    fields: dict[str, Field] = {}
    for name, declared in variables.items():
        require_identifier(name)
        fields[name] = declared if isinstance(declared, Field) else Field(declared)
        if not fields[name].required:
            raise DeclarationError(name=name, message="is a variable and must be there; only fields may be optional")
    return Env(fields)


# Type check ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Scope:
    """What holds at one place: the names, how many quantifiers enclose it, and what is proved to be present there."""

    source: str
    variables: Mapping[str, Field]
    bound: Mapping[str, Field]
    present: frozenset[Typed]

    def error(self, syntax: Syntax, message: str, valid: Sequence[str] = ()) -> ExpressionError:
        return ExpressionError(source=self.source, column=syntax.column, message=message, valid=valid)

    def assuming(self, facts: frozenset[Typed]) -> _Scope:
        return replace(self, present=self.present | facts) if facts else self


def check(tree: Tree, env: Env, expect: Type = BOOL) -> Typed:
    """Give every node its type, or say what is wrong.

    Args:
        tree: What `parse` yielded.
        env: The variables.
        expect: The type the whole must have; conditions are bool.

    Raises:
        ExpressionError: Unknown name, type or unit that does not fit, literal out of range, too many quantifiers.
    """
    scope = _Scope(tree.source, env.variables, {}, frozenset())
    typed = _check(tree.root, scope)
    if typed.type != expect and expect is DOUBLE:
        typed = _promote(typed)
    if typed.type != expect:
        raise scope.error(tree.root, f"expected a {show(expect)}, this is a {show(typed.type)}")
    return typed


def _check(syntax: Syntax, scope: _Scope) -> Typed:
    return _RULES[syntax.kind](syntax, scope)


def _nearest(name: str, known: Sequence[str]) -> list[str]:
    near = get_close_matches(name, known, n=3, cutoff=0.5)
    return [*near, *(other for other in sorted(known) if other not in near)]


def _literal(syntax: Syntax, scope: _Scope) -> Typed:
    match syntax.value:
        case bool() as value:
            return Constant(type=BOOL, value=value, column=syntax.column)
        case str() as value:
            return Constant(type=STRING, value=value, column=syntax.column)
        case int() as value if INT_MIN <= value <= INT_MAX:
            return Constant(type=INT, value=value, reach=abs(value), column=syntax.column)
        case float() as value if math.isfinite(value):
            return Constant(type=DOUBLE, value=value, reach=abs(value), column=syntax.column)
        case _:
            raise scope.error(syntax, "number out of range; an int has 64 bits, a double is finite")


def _name(syntax: Syntax, scope: _Scope) -> Typed:
    name = str(syntax.value)
    declared = scope.bound.get(name) or scope.variables.get(name)
    if declared is None:
        known = [*scope.bound, *scope.variables]
        raise scope.error(syntax, f"unknown variable `{name}`", _nearest(name, known))
    reach = _reach_of(declared)
    return Variable(
        type=declared.type, unit=declared.unit, reach=reach, column=syntax.column, name=name, bound=name in scope.bound
    )


def _reach_of(declared: Field) -> float:
    """Largest magnitude of a number of this type, or of the numbers in this list, set or map."""
    held = declared.type
    while isinstance(held, (ListType, SetType, MapType)):
        held = held.value if isinstance(held, MapType) else held.element
    within = math.inf if declared.within is None else declared.within
    if held is INT:
        return math.floor(min(within, -INT_MIN))
    return float(min(DOUBLE_MAX, within)) if held is DOUBLE else 0


def _select(syntax: Syntax, scope: _Scope) -> Typed:
    record, name = _check(syntax.parts[0], scope), str(syntax.value)
    match record.type:
        case RecordType(fields=fields) if name in fields:
            declared = fields[name]
        case RecordType(name=owner, fields=fields):
            raise scope.error(syntax, f"`{owner}` has no field `{name}`", _nearest(name, list(fields)))
        case MapType():
            key = Constant(type=STRING, value=name, column=syntax.column)
            return _apply("[", (record, key), syntax, scope)
        case other:
            raise scope.error(syntax, f"a {show(other)} has no field `{name}`")
    found = Select(
        type=declared.type,
        unit=declared.unit,
        reach=_reach_of(declared),
        column=syntax.column,
        record=record,
        name=name,
    )
    checked = not declared.required and found not in scope.present
    return replace(found, checked=checked, can_fail=checked or record.can_fail)


def _has(syntax: Syntax, scope: _Scope) -> Typed:
    if len(syntax.parts) != 1 or syntax.parts[0].kind != "select":
        raise scope.error(syntax, "`has` takes one field", ("has(record.field)",))
    inner = syntax.parts[0]
    selected = _select(inner, scope)
    if not isinstance(selected, Select):  # a map: `has(m.k)` is `"k" in m`
        return _apply("in", children(selected)[::-1], syntax, scope)
    return Present(type=BOOL, can_fail=selected.record.can_fail, column=syntax.column, select=selected)


def _call(syntax: Syntax, scope: _Scope) -> Typed:
    symbol, parts = str(syntax.value), syntax.parts
    if symbol == "has":
        return _has(syntax, scope)
    if symbol not in OVERLOADS:
        functions = [name for name in OVERLOADS if name.isalpha() and name != "in"]
        raise scope.error(syntax, f"unknown function `{symbol}`", _nearest(symbol, [*functions, "has"]))
    literal = parts[0].value if parts and parts[0].kind == "literal" else None
    if symbol == "-_" and isinstance(literal, (int, float)) and not isinstance(literal, bool):
        return _literal(replace(syntax, value=-literal), scope)
    return _apply(symbol, tuple(_check(part, scope) for part in parts), syntax, scope)


def _method(syntax: Syntax, scope: _Scope) -> Typed:
    symbol = f".{syntax.value}"
    if syntax.value in ("exists", "all"):
        return _quantifier(syntax, scope)
    if symbol not in OVERLOADS:
        methods = ["exists", "all", *(name[1:] for name in OVERLOADS if name.startswith("."))]
        raise scope.error(syntax, f"unknown method `{syntax.value}`", _nearest(str(syntax.value), methods))
    return _apply(symbol, tuple(_check(part, scope) for part in syntax.parts), syntax, scope)


def _apply(symbol: str, args: tuple[Typed, ...], syntax: Syntax, scope: _Scope) -> Typed:
    for attempt in (args, tuple(_promote(arg) for arg in args)):
        for overload in OVERLOADS[symbol]:
            found: dict[str, Type] = {}
            if len(attempt) == len(overload.params) and all(
                _fits(param, arg.type, found) for param, arg in zip(overload.params, attempt, strict=True)
            ):
                result = found["any"] if overload.result is ANY else overload.result
                return _applied(symbol, overload, result, attempt, syntax, scope)
    given = " and ".join(show(arg.type) for arg in args) or "nothing"
    if any(isinstance(arg.type, SetType) for arg in args) and symbol not in _COUNTS | {"in"}:
        message = f"`{symbol.strip('_.')}` does not take {given}: a set has no order, and is compared with nothing"
        raise scope.error(syntax, message, _OF_A_SET)
    takes = [" and ".join(show(param) for param in overload.params) for overload in OVERLOADS[symbol]]
    mixed = "; `double(…)` converts an int" if {INT, DOUBLE} <= {arg.type for arg in args} else ""
    raise scope.error(syntax, f"`{symbol.strip('_.')}` does not take {given}{mixed}", takes)


def _fits(param: Type, given: Type, found: dict[str, Type]) -> bool:
    if param is ANY:
        return found.setdefault("any", given) == given
    match param, given:
        case (ListType(inner), ListType(other)) | (SetType(inner), SetType(other)) | (MapType(inner), MapType(other)):
            return _fits(inner, other, found)
        case _:
            return param == given


def _promote(node: Typed) -> Typed:
    """An int literal, or a list of them, as doubles, where nothing is lost by it."""
    match node:
        case Constant(type=Scalar.INT, value=int() as value) if float(value) == value:
            return replace(node, type=DOUBLE, value=float(value), reach=abs(float(value)))
        case ListOf(elements=elements):
            promoted = tuple(_promote(element) for element in elements)
            fits = all(element.type is DOUBLE for element in promoted)
            return replace(node, type=ListType(DOUBLE), elements=promoted) if fits else node
        case _:
            return node


def _applied(
    symbol: str, overload: Overload, result: Type, args: tuple[Typed, ...], syntax: Syntax, scope: _Scope
) -> Typed:
    reach = REACH[overload.name](args) if overload.name in REACH else 0
    node = Apply(
        type=result,
        unit=_unit(symbol, args, syntax, scope),
        reach=min(reach, -INT_MIN) if result is INT else min(reach, DOUBLE_MAX),
        column=syntax.column,
        overload=overload.name,
        args=args,
    )
    proved = node in scope.present if overload.result is ANY else reach <= (INT_MAX if result is INT else DOUBLE_MAX)
    checked = bool(overload.checked) and not proved
    return replace(node, checked=checked, can_fail=checked or any(arg.can_fail for arg in args))


def _unit(symbol: str, args: tuple[Typed, ...], syntax: Syntax, scope: _Scope) -> str | None:
    """Unit of a result. Units are names, not algebra: a product of two quantities has no known one."""
    if symbol in _SAME_UNIT:
        unit = _common_unit(args, syntax, scope)
        if symbol in _ADDING:
            _refuse_pure(args, syntax, scope)
        if symbol in _MATCHING:
            _refuse_strangers(args, syntax, scope)
        return unit if symbol in _SUMS else None
    if symbol in _PARTS:
        _refuse_no_part(symbol, args, syntax, scope)
    if symbol == "*" and isinstance(args[0], Constant):
        return args[1].unit
    if symbol in _SCALING and not isinstance(args[1], Constant):
        return None
    return None if symbol in _COUNTS else args[0].unit


def _refuse_pure(args: Sequence[Typed], syntax: Syntax, scope: _Scope) -> None:
    """Refuse to add a pure number to a quantity: `0.8 + limits.payload_kg` is no mass, `0.8 * …` was meant."""
    units = [arg.unit for arg in args if arg.unit is not None]
    if units and any(arg.unit is None and _pure(arg) for arg in args):
        message = f"unit mismatch: a pure number and a quantity in `{units[0]}` do not add up: a factor goes by `*`"
        raise scope.error(syntax, message)


def _pure(node: Typed) -> bool:
    """Say whether a number without unit has none; of products and quotients of quantities it is not known."""
    if isinstance(node, Apply):
        return all(_pure(arg) for arg in node.args)
    return node.unit is None and isinstance(node, (Constant, Select, Variable))


def _refuse_strangers(args: Sequence[Typed], syntax: Syntax, scope: _Scope) -> None:
    """Refuse to compare a text that is one of a few with one that it can never be."""
    among = next((known for known in (_among(arg, scope) for arg in args) if known is not None), None)
    if among is None:
        return
    for arg in args:
        for literal in _literals(arg):
            if literal.value not in among:
                message = f"`{literal.value}` is compared with what is never that"
                empty = ['""'] if "" in among else []  # a name that nothing has; it is nobody's misspelling
                raise scope.error(syntax, message, [*_nearest(str(literal.value), sorted(among - {""})), *empty])


def _refuse_no_part(symbol: str, args: Sequence[Typed], syntax: Syntax, scope: _Scope) -> None:
    """Refuse to look in a text that is one of a few for what none of them has: `target.name.startsWith('mgu')`."""
    among = _among(args[0], scope)
    if among is None:
        return
    for part in map(str, (literal.value for literal in _literals(args[1]))):
        if not any(_PARTS[symbol](name, part) for name in among):
            message = f"nothing that it can be has `{part}` there"
            raise scope.error(syntax, message, _nearest(part, sorted(among - {""})))


def _literals(node: Typed) -> Iterator[Constant]:
    """Yield the literals that a value, or what a list holds, may come to."""
    match node:
        case Constant():
            yield node
        case ListOf(elements=parts):
            yield from (literal for part in parts for literal in _literals(part))
        case Conditional(then=then, otherwise=otherwise):
            yield from (*_literals(then), *_literals(otherwise))
        case _:
            return


def _among(node: Typed, scope: _Scope) -> frozenset[str] | None:
    match node:
        case Select(record=record, name=name):
            return cast("RecordType", record.type).fields[name].among
        case Variable(name=name, bound=bound):
            return (scope.bound if bound else scope.variables)[name].among
        case _:
            return None


def _common_unit(nodes: Sequence[Typed], syntax: Syntax, scope: _Scope) -> str | None:
    units = dict.fromkeys(node.unit for node in nodes if node.unit is not None)
    if len(units) > 1:
        message = "units differ: " + " and ".join(f"`{unit}`" for unit in units)
        raise scope.error(syntax, message, _in_unit(next(iter(units)), nodes, scope))
    return next(iter(units), None)


def _in_unit(unit: str, nodes: Sequence[Typed], scope: _Scope) -> list[str]:
    """Return what else could stand beside a quantity in this unit: what is declared in it, or a number."""
    paths: dict[str, Field] = {}
    for name, declared in {**scope.variables, **scope.bound}.items():
        inner: Mapping[str, Field] = declared.type.fields if isinstance(declared.type, RecordType) else {}
        paths |= {name: declared, **{f"{name}.{key}": field for key, field in inner.items()}}
    told = {dotted(node) for node in nodes}
    fitting = (path for path, field in paths.items() if field.unit == unit and field.type in (INT, DOUBLE))
    return [*(path for path in fitting if path not in told), f"a number in {unit}"]


def _common_type(nodes: tuple[Typed, ...], syntax: Syntax, scope: _Scope) -> tuple[Typed, ...]:
    """The same nodes, literals promoted where that makes their types one."""
    for attempt in (nodes, tuple(_promote(node) for node in nodes)):
        if all(node.type == attempt[0].type for node in attempt):
            return attempt
    types = dict.fromkeys(show(node.type) for node in nodes)
    raise scope.error(syntax, "types differ: " + " and ".join(types), [f"{type_} everywhere" for type_ in types])


def _list(syntax: Syntax, scope: _Scope) -> Typed:
    if not syntax.parts:
        raise scope.error(syntax, "an empty list literal has no element type", ("size(list) == 0",))
    elements = _common_type(tuple(_check(part, scope) for part in syntax.parts), syntax, scope)
    return ListOf(
        type=ListType(elements[0].type),
        unit=_common_unit(elements, syntax, scope),
        reach=max(element.reach for element in elements),
        can_fail=any(element.can_fail for element in elements),
        column=syntax.column,
        elements=elements,
    )


def _logic(syntax: Syntax, scope: _Scope) -> Typed:
    conjunction = syntax.value == "&&"
    operands: list[Typed] = []
    for part in syntax.parts:
        operand = _bool(part, scope)
        operands.append(operand)
        scope = scope.assuming(_facts(operand, conjunction))
    return Logic(
        type=BOOL,
        can_fail=any(operand.can_fail for operand in operands),
        column=syntax.column,
        conjunction=conjunction,
        operands=tuple(operands),
    )


def _bool(syntax: Syntax, scope: _Scope) -> Typed:
    typed = _check(syntax, scope)
    if typed.type is not BOOL:
        raise scope.error(syntax, f"expected a bool, this is a {show(typed.type)}")
    return typed


def _facts(node: Typed, truth: bool) -> frozenset[Typed]:
    """Which accesses cannot fail once `node` has turned out as `truth`, or as an error.

    An operand that errors does not end a conjunction, so that only tests that cannot fail themselves prove anything.
    """
    match node:
        case Present(select=select, can_fail=False) if truth:
            return frozenset({select})
        case Apply(overload="in_map", args=(key, held), can_fail=False) if truth and isinstance(held.type, MapType):
            return frozenset({Apply(type=held.type.value, unit=held.unit, overload="entry", args=(held, key))})
        case Apply(overload="not", args=(inner,)):
            return _facts(inner, not truth)
        case Logic(conjunction=conjunction, operands=operands) if conjunction == truth:
            return frozenset[Typed]().union(*(_facts(operand, truth) for operand in operands))
        case _:
            return frozenset()


def _conditional(syntax: Syntax, scope: _Scope) -> Typed:
    condition = _bool(syntax.parts[0], scope)
    branches = tuple(
        _check(part, scope.assuming(_facts(condition, truth)))
        for part, truth in zip(syntax.parts[1:], (True, False), strict=True)
    )
    then, otherwise = _common_type(branches, syntax, scope)
    return Conditional(
        type=then.type,
        unit=_common_unit(branches, syntax, scope),
        reach=max(then.reach, otherwise.reach),
        can_fail=condition.can_fail or then.can_fail or otherwise.can_fail,
        column=syntax.column,
        condition=condition,
        then=then,
        otherwise=otherwise,
    )


def _quantifier(syntax: Syntax, scope: _Scope) -> Typed:
    if len(syntax.parts) != 3 or syntax.parts[1].kind != "name":  # receiver, variable, predicate
        usage = f"list.{syntax.value}(x, condition on x)"
        raise scope.error(syntax, f"`{syntax.value}` takes a variable and a condition", (usage,))
    domain, variable = _check(syntax.parts[0], scope), str(syntax.parts[1].value)
    if variable in scope.bound or variable in scope.variables:
        raise scope.error(syntax.parts[1], f"`{variable}` is already a variable; choose another name")
    if len(scope.bound) == MAX_QUANTIFIERS:
        raise scope.error(syntax, f"more than {MAX_QUANTIFIERS} quantifiers inside one another")
    match domain.type:
        case ListType(element) | SetType(element):
            held = Field(element, unit=domain.unit, within=domain.reach, among=_among(domain, scope))
        case MapType():
            held = Field(STRING)
        case other:
            raise scope.error(syntax, f"`{syntax.value}` needs a list, a set or a map, this is a {show(other)}")
    predicate = _bool(syntax.parts[2], replace(scope, bound={**scope.bound, variable: held}))
    return Quantifier(
        type=BOOL,
        can_fail=domain.can_fail or predicate.can_fail,
        column=syntax.column,
        universal=syntax.value == "all",
        variable=variable,
        domain=domain,
        predicate=predicate,
    )


_RULES: Final[Mapping[str, Callable[[Syntax, _Scope], Typed]]] = {
    "literal": _literal,
    "name": _name,
    "select": _select,
    "call": _call,
    "method": _method,
    "logic": _logic,
    "conditional": _conditional,
    "list": _list,
}
