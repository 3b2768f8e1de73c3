"""Fits a document into its shape, or says of every misfit where it stands and what would be valid."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, cast, get_args, get_origin

from pydantic import BaseModel, ValidationError

from app.governance.bundle_yaml import dotted
from app.governance.errors import PolicyError

if TYPE_CHECKING:
    from app.governance.bundle_yaml import Document

_QUOTED: Final = re.compile(r"'([^']*)'")
_UNIONS: Final = frozenset({"float", "str", "int", "bool", "constrained-str", "ScaledLimit"})


def fit(shape: type[Any], document: Document) -> tuple[Any | None, list[PolicyError]]:
    """Fit a document into its shape, or say for every misfit where it stands and what would be valid."""
    try:
        return shape.model_validate(document.value), []
    except ValidationError as error:
        return None, [_problem(shape, document, cast("Mapping[str, Any]", found)) for found in error.errors()]


def _problem(shape: type[BaseModel], document: Document, found: Mapping[str, Any]) -> PolicyError:
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
    elif kind in ("model_type", "dict_type", "list_type"):
        message = f"expected a {'list' if kind == 'list_type' else 'mapping'}, found `{_short(found['input'])}`"
    else:
        message = f"`{_short(found['input'])}`: {message}"
    return PolicyError(file=document.file, line=document.line(path), key=key, message=message, valid=valid)


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
