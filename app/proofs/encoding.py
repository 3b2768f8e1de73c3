"""A condition's typed tree as a symbolic value, with errors as values: the third reading of the tree.

`expression_code` emits Python, `expression_value` evaluates; this module says for which inputs an expression is true,
and for which it raises. The rules are those of docs/design/expressions.md: strict functions raise where an argument
does, `&&` and `||` let an operand that decides win over an error on either side, quantifiers do as much for elements,
`?:` raises where its condition does, or the branch it takes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias, assert_never, cast

from app.governance.expression_tree import (
    BOOL,
    Apply,
    Conditional,
    Constant,
    ListOf,
    Logic,
    Present,
    Quantifier,
    Select,
    Typed,
    Variable,
)
from app.proofs.formulas import Formula, both, either, every, no, some
from app.proofs.values import EXACT_INT, Items, NotCoveredError, Theory, Value, choice, constant, pick, truth


@dataclass(frozen=True, slots=True)
class Slot:
    """A record's field: where it is there, and what it then is."""

    present: Formula
    value: Value


Record: TypeAlias = Mapping[str, Slot]
Scope: TypeAlias = "Mapping[str, Value | Record]"


def encode(typed: Typed, scope: Scope, theory: Theory) -> Value:
    """Return what an expression comes to.

    Args:
        typed: What `expression.check` yielded.
        scope: Every variable, records by field.
        theory: Where the facts about new terms go.

    Raises:
        NotCoveredError: It says something that proofs cannot reason about (maps, for instance).
    """
    match typed:
        case Constant(value=value):
            return constant(value)
        case Variable(name=name):
            found = scope[name]
            if not isinstance(found, Value):
                raise NotCoveredError(f"`{name}` as a whole")
            return found
        case Select():
            slot = _slot(typed, scope)
            return Value(slot.value.cases, either(no(slot.present), slot.value.error))
        case Present(select=select):
            return truth(_slot(select, scope).present)
        case ListOf(elements=elements):
            values = [encode(element, scope, theory) for element in elements]
            return Value(((True, Items(tuple((True, value) for value in values))),), some(v.error for v in values))
        case Apply():
            return _apply(typed, scope, theory)
        case _:
            return _control(typed, scope, theory)


def _slot(select: Select, scope: Scope) -> Slot:
    record = select.record
    found = scope.get(record.name) if isinstance(record, Variable) else None
    if found is None or isinstance(found, Value):
        raise NotCoveredError(f"`.{select.name}` of what is no variable")
    return found[select.name]


def _apply(typed: Apply, scope: Scope, theory: Theory) -> Value:
    args = tuple(encode(arg, scope, theory) for arg in typed.args)
    match typed.overload:
        case "not":
            return truth(no(args[0].truth), args[0].error)
        case "equal" | "unequal" if typed.args[0].type is BOOL:
            equal = either(both(args[0].truth, args[1].truth), both(no(args[0].truth), no(args[1].truth)))
            error = either(args[0].error, args[1].error)
            return truth(equal if typed.overload == "equal" else no(equal), error)
        case "in_list":
            held = some(both(guard, theory.contains(cast("Items", items), args[0])) for guard, items in args[1].cases)
            return truth(held, either(args[0].error, args[1].error))
        case "element":
            return _element(args[0], args[1], typed.type is BOOL, theory)
        case "in_map" | "entry":
            raise NotCoveredError("maps")
        case overload:
            wide = any(arg.reach > EXACT_INT for arg in typed.args)
            return theory.apply(overload, args, checked=typed.checked, wide=wide)


def _element(held: Value, index: Value, boolean: bool, theory: Theory) -> Value:
    """`list[i]`: an error outside the list."""
    result = Value((), True)
    for guard, payload in held.cases:
        items = cast("Items", payload)
        for place, (_, element) in enumerate(items.elements):
            here = both(guard, theory.apply("equal", (index, constant(place)), checked=False, wide=False).truth)
            result = pick(here, element, result if result.cases or not boolean else truth(False, True), boolean)
    if boolean and not result.cases:
        result = truth(False, True)
    return Value(result.cases, some((result.error, held.error, index.error)))


def _control(typed: Logic | Conditional | Quantifier, scope: Scope, theory: Theory) -> Value:
    match typed:
        case Logic(conjunction=conjunction, operands=operands):
            return _decided([encode(operand, scope, theory) for operand in operands], conjunction)
        case Conditional():
            condition = encode(typed.condition, scope, theory)
            then, otherwise = encode(typed.then, scope, theory), encode(typed.otherwise, scope, theory)
            found = pick(condition.truth, then, otherwise, typed.type is BOOL)
            return Value(found.cases, either(condition.error, found.error))
        case Quantifier():
            return _quantified(typed, scope, theory)
        case _:
            assert_never(typed)


def _decided(values: list[Value], conjunction: bool) -> Value:
    """An operand that decides wins; else an error is one; else nothing decided."""
    if conjunction:
        decided = some(both(no(value.truth), no(value.error)) for value in values)
        return truth(every(value.truth for value in values), both(some(v.error for v in values), no(decided)))
    decided = some(value.holds for value in values)
    return truth(decided, both(some(value.error for value in values), no(decided)))


def _quantified(typed: Quantifier, scope: Scope, theory: Theory) -> Value:
    domain = encode(typed.domain, scope, theory)
    found: list[Value] = []
    for guard, payload in domain.cases:
        for inside, element in cast("Items", payload).elements:
            here = both(guard, inside)
            value = encode(typed.predicate, {**scope, typed.variable: element}, theory)
            absent = no(here)  # what is not in the list decides nothing
            shown = either(absent, value.truth) if typed.universal else both(here, value.truth)
            found.append(truth(shown, both(here, value.error)))
    result = _decided(found, typed.universal)
    return truth(result.truth, either(domain.error, result.error))


__all__ = ["Record", "Scope", "Slot", "choice", "encode"]
