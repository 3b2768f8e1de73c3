"""From a typed tree to the text of one Python expression, and the functions that text calls.

Nothing of a condition's source gets into the text but constants by `repr`, identifiers of declared fields, and the rows
of `OVERLOADS`. What `expression.check` proved is emitted bare; the rest calls `INTRINSICS`, which raise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Final, assert_never

from app.governance.errors import DeclarationError, EvaluationError
from app.governance.expression_reach import DOUBLE_MAX, INT_MAX, INT_MIN
from app.governance.expression_tree import (
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
    children,
    dotted,
)


def to_python(typed: Typed, names: Mapping[str, str]) -> str:
    """Emit the expression as the text of one Python expression.

    It needs `INTRINSICS` in its globals and no builtins. Nothing of the source gets into it but constants by `repr`,
    identifiers of declared fields, and the rows of `OVERLOADS`.

    Args:
        typed: What `check` yielded.
        names: Python text that reads a variable (`target`), or a field of one by its dotted path (`target.fragile`),
            for instance a local that was read before. Text for an optional field yields `None` where it is absent.
            It is trusted, goes in as it is, and must not use a name of `INTRINSICS` for anything else.

    Raises:
        DeclarationError: A variable has no text in `names`.
    """
    match typed:
        case Constant():
            return repr(typed.value)
        case Variable():
            return _accessor(typed.name, names)
        case ListOf():
            return f"({', '.join(to_python(element, names) for element in typed.elements)},)"
        case Apply():
            row = _TEXT[typed.overload]
            return (row.checked if typed.checked else row.bare).format(*(to_python(arg, names) for arg in typed.args))
        case Select():
            return _emit_select(typed, names)
        case _:
            return _emit_control(typed, names)


_TEXT: Final = {overload.name: overload for overloads in OVERLOADS.values() for overload in overloads}


def _accessor(name: str, names: Mapping[str, str]) -> str:
    if name not in names:
        raise DeclarationError(name=name, message="has no Python text to read it by")
    return names[name]


def _emit_select(typed: Select, names: Mapping[str, str]) -> str:
    if typed.checked:
        return f"_cel_present({_emit_maybe(typed, names)}, {(dotted(typed) or typed.name)!r})"
    path = dotted(typed)
    if path is not None and path in names:
        return names[path]
    record = to_python(typed.record, names)
    return f"{record}.{typed.name}" if _has_attributes(typed) else f"{record}[{typed.name!r}]"


def _emit_maybe(typed: Select, names: Mapping[str, str]) -> str:
    """The field's value, `None` where it is absent."""
    path = dotted(typed)
    if path is not None and path in names:
        return names[path]
    record = to_python(typed.record, names)
    return f"{record}.{typed.name}" if _has_attributes(typed) else f"{record}.get({typed.name!r})"


def _has_attributes(typed: Select) -> bool:
    return isinstance(typed.record.type, RecordType) and typed.record.type.attributes


def _emit_control(typed: Present | Logic | Conditional | Quantifier, names: Mapping[str, str]) -> str:
    match typed:
        case Present():
            return f"({_emit_maybe(typed.select, names)} is not None)"
        case Logic():
            return _emit_logic(typed, names)
        case Conditional():
            condition, then, otherwise = (to_python(part, names) for part in children(typed))
            return f"({then} if {condition} else {otherwise})"
        case Quantifier():
            return _emit_quantifier(typed, names)
        case _:
            assert_never(typed)


def _emit_logic(typed: Logic, names: Mapping[str, str]) -> str:
    """Plain `and`/`or` up to the first operand that may fail; from there on an error must not hide what decides."""
    texts = [to_python(operand, names) for operand in typed.operands]
    failing = [index for index, operand in enumerate(typed.operands) if operand.can_fail]
    if failing and failing[0] < len(texts) - 1:
        rest = ", ".join(f"lambda: {text}" for text in texts[failing[0] :])
        texts[failing[0] :] = [f"_cel_decide({not typed.conjunction}, ({rest}))"]
    return f"({(' and ' if typed.conjunction else ' or ').join(texts)})"


def _emit_quantifier(typed: Quantifier, names: Mapping[str, str]) -> str:
    variable = f"_cel_{typed.variable}_"  # the trailing underscore keeps it apart from every intrinsic
    domain = to_python(typed.domain, names)
    predicate = to_python(typed.predicate, {**names, typed.variable: variable})
    if typed.predicate.can_fail:
        return f"_cel_search({not typed.universal}, lambda {variable}: {predicate}, {domain})"
    return f"{'all' if typed.universal else 'any'}({predicate} for {variable} in {domain})"


# What the text calls -------------------------------------------------------------------------------------------------


def int64(value: int) -> int:
    """Return an integer that has 64 bits.

    Raises:
        EvaluationError: It has more.
    """
    if INT_MIN <= value <= INT_MAX:
        return value
    raise EvaluationError("overflow", f"`{value}` does not fit 64 bits")


def finite(value: float) -> float:
    """Return a double that is finite.

    Raises:
        EvaluationError: It is not.
    """
    if -DOUBLE_MAX <= value <= DOUBLE_MAX:  # false for nan
        return value
    raise EvaluationError("not_finite", f"`{value}` is not a finite number")


def _divide(dividend: float, divisor: float) -> float:
    if divisor:
        return finite(dividend / divisor)
    raise EvaluationError("division_by_zero", f"`{dividend}` divided by zero")


def _quotient(dividend: int, divisor: int) -> int:
    if not divisor:
        raise EvaluationError("division_by_zero", f"`{dividend}` divided by zero")
    magnitude = abs(dividend) // abs(divisor)
    return int64(magnitude if (dividend < 0) == (divisor < 0) else -magnitude)


def _remainder(dividend: int, divisor: int) -> int:
    return dividend - divisor * _quotient(dividend, divisor)


def _truncate(value: float) -> int:
    return int64(int(value))


def _element(held: Sequence[object], index: int) -> object:
    if 0 <= index < len(held):
        return held[index]
    raise EvaluationError("index_out_of_range", f"`{index}` in a list of {len(held)}")


def _entry(held: Mapping[str, object], key: str) -> object:
    return _present(held.get(key), key)


def _present(value: object, path: str) -> object:
    if value is None:
        raise EvaluationError("absent", f"`{path}` is absent")
    return value


def _decide(decisive: bool, operands: Iterable[Callable[[], bool]]) -> bool:
    """CEL's commutative logic: `decisive` if any operand is, else the first error, else the opposite."""
    error: EvaluationError | None = None
    for operand in operands:
        try:
            if operand() is decisive:
                return decisive
        except EvaluationError as raised:
            error = error or raised
    if error:
        raise error
    return not decisive


def _search(decisive: bool, predicate: Callable[[object], bool], domain: Iterable[object]) -> bool:
    return _decide(decisive, (partial(predicate, item) for item in domain))


INTRINSICS: Final[Mapping[str, object]] = {
    "_cel_int": int64,
    "_cel_finite": finite,
    "_cel_divide": _divide,
    "_cel_quotient": _quotient,
    "_cel_remainder": _remainder,
    "_cel_truncate": _truncate,
    "_cel_element": _element,
    "_cel_entry": _entry,
    "_cel_present": _present,
    "_cel_decide": _decide,
    "_cel_search": _search,
    **{builtin.__name__: builtin for builtin in (all, any, float, int, len, tuple)},
}
