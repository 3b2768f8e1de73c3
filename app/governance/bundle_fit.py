"""Fits a document into its shape, or says of every misfit where it stands and what would be valid."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast, get_args, get_origin

from pydantic import BaseModel, ValidationError

from app.governance.bundle_shapes import AGENT, NAME, SLUG
from app.governance.bundle_yaml import dotted
from app.governance.errors import PolicyError
from app.governance.semver import PIN, VERSION

if TYPE_CHECKING:
    from app.governance.bundle_yaml import Document

Misfit: TypeAlias = Mapping[str, Any]  # as pydantic tells it

_QUOTED: Final = re.compile(r"'([^']*)'")
_KINDS: Final = {  # what pydantic calls a misfit of type, and what is expected there
    "string_type": "text", "float_type": "a number", "int_type": "a whole number", "int_from_float": "a whole number",
    "bool_type": "`true` or `false`", "model_type": "a mapping", "dict_type": "a mapping", "list_type": "a list",
}  # fmt: skip
_PATTERNS: Final = {  # what texts are made of, in words
    NAME: "small letters, digits and `_`, a letter first",
    SLUG: "small letters and digits, `-` between them, a letter first",
    AGENT: "small letters, digits, `_` and `-`, a letter first",
    f"^{VERSION}$": "three numbers, as in `1.0.0`",
    PIN: "three numbers, as in `1.0.0`, `~1.0.0` or `^1.0.0`",
}
_SCALARS: Final = {"float": "float_type", "str": "string_type"}  # a union's members, and how each says what misfits
_UNIONS: Final = frozenset({"float", "str", "int", "bool", "constrained-str", "ScaledLimit"})


def fit(shape: type[Any], document: Document) -> tuple[Any | None, list[PolicyError]]:
    """Fit a document into its shape, or say for every misfit where it stands and what would be valid."""
    try:
        return shape.model_validate(document.value), []
    except ValidationError as error:
        return None, [_problem(shape, document, found) for found in _told(cast("list[Misfit]", error.errors()))]


def _told(misfits: Sequence[Misfit]) -> list[Misfit]:
    """Tell once what does not fit a union, which pydantic tells once for every member.

    What is wrong inside a mapping is told if the value is one; of anything else, that it is none of the members.
    """
    unions = {found["loc"][:-1]: found["input"] for found in misfits if _of_member(found, "float")}
    told: list[Misfit] = []
    for found in misfits:
        place = next((loc for loc in unions if found["loc"][: len(loc)] == loc), None)
        if place is None or (isinstance(unions[place], dict) and not any(_of_member(found, name) for name in _SCALARS)):
            told.append(found)
        elif not isinstance(unions[place], dict) and _of_member(found, "float"):
            told.append({**found, "type": "union"})
    return told


def _of_member(found: Misfit, name: str) -> bool:
    return found["loc"][-1:] == (name,) and found["type"] == _SCALARS[name]


def _problem(shape: type[BaseModel], document: Document, found: Misfit) -> PolicyError:
    path = _known_path(tuple(found["loc"]))
    kind, context = str(found["type"]), cast("Mapping[str, Any]", found.get("ctx", {}))
    key, valid = dotted(path), ()
    message = str(found["msg"])[:1].lower() + str(found["msg"])[1:]
    if kind == "extra_forbidden":
        message, valid = f"unknown key `{path[-1]}`", tuple(_keys_at(shape, path[:-1]))
    elif kind == "missing":
        message = f"key `{found['loc'][-1]}` is missing"
    elif kind == "literal_error":
        message, valid = f"`{found['input']}` is not valid", tuple(_QUOTED.findall(str(context["expected"])))
    elif kind == "union":
        keys = ", ".join(f"`{name}`" for name in _keys_at(shape, path))
        message = f"expected a number, a name, or a mapping of {keys}; found `{_short(found['input'])}`"
    elif kind == "string_pattern_mismatch":
        message = f"`{_short(found['input'])}` is not made of {_PATTERNS[str(context['pattern'])]}"
    elif kind in _KINDS:
        message = f"expected {_KINDS[kind]}, found {_shown(found['input'])}"
        valid = ("1.0.0",) if path[-1:] == ("version",) else ()
    else:
        message = f"`{_short(found['input'])}`: {message}"
    return PolicyError(file=document.file, line=document.line(path), key=key, message=message, valid=valid)


def _shown(value: object) -> str:
    """Write a value as it may stand in the file."""
    match value:
        case None:
            return "nothing"
        case bool():
            return "`true`" if value else "`false`"
        case _:
            return f"`{_short(value)}`"


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "…"


def _known_path(loc: tuple[str | int, ...]) -> tuple[str | int, ...]:
    """Drop the names of union members that pydantic weaves into a location."""
    return tuple(step for step in loc if step not in _UNIONS)


def _keys_at(shape: object, path: tuple[str | int, ...]) -> list[str]:
    """Names of the keys that the mapping at this path may have."""
    for step in path:
        shape = _inside(shape, step)
    model = _model(shape)
    return [] if model is None else list(_fields(model))


def _inside(shape: object, step: str | int) -> object:
    """Return the shape of what stands one step inside a mapping, a list, or the member of a union that holds any."""
    if isinstance(shape, type) and issubclass(shape, BaseModel):
        return _fields(shape)[str(step)]
    options = get_args(shape)
    if get_origin(shape) in (dict, list):
        return options[-1]
    return _inside(next(option for option in options if _model(option) is not None), step)


def _fields(model: type[BaseModel]) -> dict[str, object]:
    return {info.alias or name: info.annotation for name, info in model.model_fields.items()}


def _model(annotation: object) -> type[BaseModel] | None:
    """Return the model inside an annotation: a list's item, a mapping's value, a union's member; None without one."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    models = [_model(option) for option in get_args(annotation)]
    return next((model for model in models if model is not None), None)
