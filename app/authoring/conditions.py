"""Conditions written back as text, and changed in one place: another operator, another literal, another reference.

Whoever changes a condition changes its typed tree and writes it as text again, so that the change goes the same way as
any other: parsed and type-checked. What does not type-check then is no condition.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Final, NamedTuple, assert_never

from app.authoring.numbers import beside
from app.governance.expression_tree import (
    BOOL,
    OVERLOADS,
    Apply,
    Conditional,
    Constant,
    ListOf,
    Logic,
    Present,
    Quantifier,
    RecordType,
    Select,
    Typed,
    Variable,
)

_SYMBOLS: Final[Mapping[str, str]] = {row.name: symbol for symbol, rows in OVERLOADS.items() for row in rows}
_ESCAPED: Final = str.maketrans({"\\": "\\\\", '"': '\\"', "\n": "\\n", "\r": "\\r", "\t": "\\t"})
_INSTEAD: Final[Mapping[str, tuple[str, ...]]] = {
    "<": ("<=", ">"),
    "<=": ("<", ">="),
    ">": (">=", "<"),
    ">=": (">", "<="),
    "==": ("!=",),
    "!=": ("==",),
    "+": ("-",),
    "-": ("+",),
    "*": ("/",),
    "/": ("*",),
    "%": ("/",),
    ".startsWith": (".endsWith",),
    ".endsWith": (".startsWith",),
    ".contains": (".startsWith",),
}
"""What an operator is exchanged for: the one beside it, and the one that points the other way."""


class Change(NamedTuple):
    """A condition with one thing changed; `text` is empty where it always holds."""

    what: str
    text: str


# Writing -------------------------------------------------------------------------------------------------------------


def to_cel(typed: Typed) -> str:  # noqa: C901, PLR0911  # one branch per shape
    """Write a typed tree as the text of a condition; parsed and checked again, it is the same tree."""
    match typed:
        case Constant():
            return _literal(typed.value)
        case Variable():
            return typed.name
        case Select():
            return f"{_tight(typed.record)}.{typed.name}"
        case Present():
            return f"has({to_cel(typed.select)})"
        case Apply():
            return _application(_SYMBOLS[typed.overload], typed.args)
        case Logic():
            return (" && " if typed.conjunction else " || ").join(_tight(operand) for operand in typed.operands)
        case Conditional():
            return f"{_tight(typed.condition)} ? {_tight(typed.then)} : {_tight(typed.otherwise)}"
        case Quantifier():
            name = "all" if typed.universal else "exists"
            return f"{_tight(typed.domain)}.{name}({typed.variable}, {to_cel(typed.predicate)})"
        case ListOf():
            return f"[{', '.join(to_cel(element) for element in typed.elements)}]"
        case _:
            assert_never(typed)


def _literal(value: bool | int | float | str) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return f'"{value.translate(_ESCAPED)}"' if isinstance(value, str) else repr(value)


def _tight(typed: Typed) -> str:
    """Write an operand, in parentheses where it is more than one word."""
    text = to_cel(typed)
    infix = isinstance(typed, Apply) and _SYMBOLS[typed.overload] in _INFIX - {"!_"}
    negated = isinstance(typed, Constant) and text.startswith("-")
    return f"({text})" if infix or negated or isinstance(typed, (Logic, Conditional)) else text


_INFIX: Final = frozenset({"==", "!=", "<", "<=", ">", ">=", "+", "-", "*", "/", "%", "in", "!_", "-_"})


def _application(symbol: str, args: tuple[Typed, ...]) -> str:
    match symbol, args:
        case "[", (held, key):
            return f"{_tight(held)}[{to_cel(key)}]"
        case (("!_" | "-_"), (only,)):
            return f"{symbol[0]}{_tight(only)}"
        case _, (receiver, *rest) if symbol.startswith("."):
            return f"{_tight(receiver)}{symbol}({', '.join(map(to_cel, rest))})"
        case _, (left, right) if symbol in _INFIX:
            return f"{_tight(left)} {symbol} {_tight(right)}"
        case _:
            return f"{symbol}({', '.join(map(to_cel, args))})"


# Changing ----------------------------------------------------------------------------------------------------------


def changes(typed: Typed) -> Iterator[Change]:
    """Yield every condition that differs in one operator, literal or reference; then that it always holds."""
    told = {to_cel(typed)}
    for what, changed in _changed(typed):
        text = to_cel(changed)
        if text not in told:
            told.add(text)
            yield Change(what, text)
    if typed.type is BOOL:
        yield Change("it always holds", "")


def _changed(typed: Typed) -> Iterator[tuple[str, Typed]]:
    """Yield the trees with one change at this node, then those with one further down."""
    yield from _here(typed)
    for part, rebuild in _parts(typed):
        for what, changed in _changed(part):
            yield what, rebuild(changed)


def _parts(typed: Typed) -> Iterator[tuple[Typed, Callable[[Typed], Typed]]]:  # noqa: C901  # one branch per shape
    """Yield every part of a node, with the way to put another in its place."""
    match typed:
        case Apply(args=parts):
            for index, part in enumerate(parts):
                yield part, lambda new, i=index: replace(typed, args=(*parts[:i], new, *parts[i + 1 :]))
        case Logic(operands=parts):
            for index, part in enumerate(parts):
                yield part, lambda new, i=index: replace(typed, operands=(*parts[:i], new, *parts[i + 1 :]))
        case ListOf(elements=parts):
            for index, part in enumerate(parts):
                yield part, lambda new, i=index: replace(typed, elements=(*parts[:i], new, *parts[i + 1 :]))
        case Conditional():
            yield typed.condition, lambda new: replace(typed, condition=new)
            yield typed.then, lambda new: replace(typed, then=new)
            yield typed.otherwise, lambda new: replace(typed, otherwise=new)
        case Quantifier():
            yield typed.domain, lambda new: replace(typed, domain=new)
            yield typed.predicate, lambda new: replace(typed, predicate=new)
        case Present() | Select() | Constant() | Variable():
            return
        case _:
            assert_never(typed)


def _here(typed: Typed) -> Iterator[tuple[str, Typed]]:  # noqa: C901, PLR0912  # one branch per shape
    match typed:
        case Constant():
            yield from _constant(typed)
        case Select():
            yield from _reference(typed)
        case Present(select=select):
            yield f"not `{to_cel(typed)}`", _not(typed)
            for what, other in _reference(select):
                if isinstance(other, Select):
                    yield what, replace(typed, select=other)
        case Apply():
            yield from _operator(typed)
        case Logic():
            yield from _logic(typed)
        case Conditional():
            yield "branches exchanged", replace(typed, then=typed.otherwise, otherwise=typed.then)
        case Quantifier():
            yield "`all` and `exists` exchanged", replace(typed, universal=not typed.universal)
        case ListOf(elements=elements) if len(elements) > 1:
            for index, element in enumerate(elements):
                yield (
                    f"without `{to_cel(element)}`",
                    replace(typed, elements=(*elements[:index], *elements[index + 1 :])),
                )
        case ListOf() | Variable():
            if typed.type is BOOL:
                yield f"not `{to_cel(typed)}`", _not(typed)
        case _:
            assert_never(typed)


def _not(typed: Typed) -> Typed:
    return Apply(type=BOOL, overload="not", args=(typed,))


def _constant(typed: Constant) -> Iterator[tuple[str, Typed]]:
    value = typed.value
    if isinstance(value, bool):
        yield f"`{_literal(not value)}` instead of `{_literal(value)}`", replace(typed, value=not value)
    elif isinstance(value, (int, float)):
        for other in beside(value, whole=isinstance(value, int)):
            yield f"`{other!r}` instead of `{value!r}`", replace(typed, value=other)
    else:
        yield f'"" instead of `{value}`', replace(typed, value="")


def _reference(typed: Select) -> Iterator[tuple[str, Typed]]:
    """Another field of the same record that could stand there; a truth value may also be turned around."""
    if typed.type is BOOL:
        yield f"not `{to_cel(typed)}`", _not(typed)
    record = typed.record.type
    if not isinstance(record, RecordType):
        return
    mine = record.fields[typed.name]
    for name, other in record.fields.items():
        if name != typed.name and (other.type, other.unit) == (mine.type, mine.unit):
            swapped = replace(typed, name=name)
            yield f"`{to_cel(swapped)}` instead of `{to_cel(typed)}`", swapped


def _operator(typed: Apply) -> Iterator[tuple[str, Typed]]:
    symbol, args = _SYMBOLS[typed.overload], typed.args
    if symbol == "!_":
        yield f"`{to_cel(args[0])}` instead of `{to_cel(typed)}`", args[0]
    elif typed.type is BOOL and symbol not in _INSTEAD:
        yield f"not `{to_cel(typed)}`", _not(typed)
    yield from _other_names(typed)
    for other in _INSTEAD.get(symbol, ()):
        rows = [row for row in OVERLOADS[other] if row.params == tuple(arg.type for arg in args)]
        names = [row.name for row in rows] or [row.name for row in OVERLOADS[other] if len(row.params) == len(args)][:1]
        yield f"`{other.strip('.')}` instead of `{symbol.strip('.')}`", replace(typed, overload=names[0])


def _other_names(typed: Apply) -> Iterator[tuple[str, Typed]]:
    """Where a text is one of a few, exchange the literal beside it for another of them."""
    known = [_among(arg) for arg in typed.args]
    for index, arg in enumerate(typed.args):
        if isinstance(arg, Constant) and isinstance(arg.value, str):
            others = sorted(frozenset[str]().union(*known) - {arg.value, ""})  # the empty one comes with the literal
            for name in others[:NAMES]:
                changed = (*typed.args[:index], replace(arg, value=name), *typed.args[index + 1 :])
                yield f'"{name}" instead of `{to_cel(arg)}`', replace(typed, args=changed)


def _among(typed: Typed) -> frozenset[str]:
    record = typed.record.type if isinstance(typed, Select) else None
    found = record.fields[typed.name].among if isinstance(record, RecordType) and isinstance(typed, Select) else None
    return found or frozenset()


NAMES: Final = 2
"""By how many others a name is exchanged."""


def _logic(typed: Logic) -> Iterator[tuple[str, Typed]]:
    one, other = ("&&", "||") if typed.conjunction else ("||", "&&")
    yield f"`{other}` instead of `{one}`", replace(typed, conjunction=not typed.conjunction)
    for index, operand in enumerate(typed.operands):
        rest = (*typed.operands[:index], *typed.operands[index + 1 :])
        left = rest[0] if len(rest) == 1 else replace(typed, operands=rest)
        yield f"without `{to_cel(operand)}`", left
