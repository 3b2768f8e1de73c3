"""Conditions by themselves: compiled into a function that holds every value to its declaration before it is read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Final, cast

from app.governance.errors import DeclarationError, EvaluationError
from app.governance.expression_code import INTRINSICS, finite, int64, to_python
from app.governance.expression_tree import (
    BOOL,
    DOUBLE,
    INT,
    STRING,
    Field,
    ListType,
    MapType,
    RecordType,
    Scalar,
    SetType,
    Type,
    Typed,
    Variable,
    children,
    show,
)


def compile_condition(typed: Typed) -> Callable[[Mapping[str, object]], bool]:
    """Compile a condition into a function of its variables' values, which it checks itself.

    The function raises `EvaluationError` where a variable is missing, a value is not of its declared type, or the
    evaluation fails; variables the condition does not read are not looked at.

    Raises:
        DeclarationError: The expression is not a bool.
    """
    if typed.type is not BOOL:
        raise DeclarationError(name=show(typed.type), message="is not the type of a condition; valid: `bool`")
    fields = {node.name: Field(node.type, within=node.reach) for node in _free_variables(typed)}
    text = f"lambda values: {to_python(typed, {name: f'values[{name!r}]' for name in fields})}"
    evaluate: Callable[[Mapping[str, object]], bool] = eval(text, {"__builtins__": {}, **INTRINSICS})  # noqa: S307  # emitted above, from a checked tree

    def condition(values: Mapping[str, object]) -> bool:
        for name in fields:
            if name not in values:
                raise EvaluationError("unknown_variable", f"`{name}` has no value")
        return evaluate({name: conform(values[name], declared, name) for name, declared in fields.items()})

    return condition


def _free_variables(typed: Typed) -> Iterator[Variable]:
    if isinstance(typed, Variable) and not typed.bound:
        yield typed
    for child in children(typed):
        yield from _free_variables(child)


def conform(value: object, declared: Field, path: str) -> object:
    """Bring a value into the form emitted text relies on: exact types, finite, in range, nothing undeclared, no `None`.

    Lists become tuples, sets frozen ones, an integer where a double is declared becomes one, records become fresh dicts
    (or namespaces).

    Args:
        value: Anything.
        declared: What it is declared to be.
        path: How errors call it.

    Raises:
        EvaluationError: It is not a value of the declared type.
    """
    match declared.type:
        case Scalar():
            return _conform_scalar(value, declared, path)
        case ListType(element) if isinstance(value, (list, tuple)):
            items = cast("Sequence[object]", value)
            return tuple(conform(item, replace(declared, type=element), f"{path}[{i}]") for i, item in enumerate(items))
        case SetType(element) if isinstance(value, (set, frozenset)):
            items = cast("frozenset[object]", value)
            return frozenset(conform(item, replace(declared, type=element), f"{path}[…]") for item in items)
        case MapType(held) if isinstance(value, Mapping):
            return _conform_map(cast("Mapping[object, object]", value), replace(declared, type=held), path)
        case RecordType() as record if record.attributes:
            return SimpleNamespace(**_conform_fields(lambda name: getattr(value, name, None), record, path))
        case RecordType() as record if isinstance(value, Mapping):
            return _conform_fields(cast("Mapping[str, object]", value).get, record, path)
        case other:
            raise _wrong_type(value, other, path)


_PYTHON_TYPES: Final[Mapping[Scalar, tuple[type, ...]]] = {
    BOOL: (bool,),
    INT: (int,),
    DOUBLE: (float, int),
    STRING: (str,),
}


def _conform_scalar(value: object, declared: Field, path: str) -> object:
    held = cast("Scalar", declared.type)
    if not isinstance(value, _PYTHON_TYPES[held]) or isinstance(value, bool) is not (held is BOOL):
        raise _wrong_type(value, held, path)
    if held not in (INT, DOUBLE):
        return value
    number = cast("float", value)
    checked = int64(cast("int", number)) if held is INT else float(finite(number))
    if declared.within is not None and abs(checked) > declared.within:
        raise EvaluationError("out_of_range", f"`{path}` is {checked}; at most {declared.within} in magnitude")
    return checked


def _conform_map(value: Mapping[object, object], declared: Field, path: str) -> dict[str, object]:
    for key in value:
        if not isinstance(key, str):
            raise _wrong_type(key, STRING, f"key of {path}")
    entries = cast("Mapping[str, object]", value).items()
    return {key: conform(item, declared, f"{path}[{key!r}]") for key, item in entries if item is not None}


def _conform_fields(read: Callable[[str], object], record: RecordType, path: str) -> dict[str, object]:
    found: dict[str, object] = {}
    for name, declared in record.fields.items():
        value = read(name)
        if value is not None:
            found[name] = conform(value, declared, f"{path}.{name}")
        elif declared.required:
            raise EvaluationError("absent", f"`{path}.{name}` is absent and required")
        elif record.attributes:
            found[name] = None
    return found


def _wrong_type(value: object, expected: Type, path: str) -> EvaluationError:
    return EvaluationError("wrong_type", f"`{path}` is a {type(value).__name__}, not a {show(expected)}")
