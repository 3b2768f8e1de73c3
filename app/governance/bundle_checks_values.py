"""What an input schema takes of one parameter: the values it lists, and those that limits and rules leave of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, cast

from jsonschema_rs import Draft202012Validator

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from app.governance.bundle_yaml import Path, Reader
    from app.governance.errors import PolicyError
    from app.governance.model import Json

PICKING: Final = ("const", "enum", "multipleOf", "exclusiveMinimum", "exclusiveMaximum")  # of what lies in the range


def listed(reader: Reader, path: Path, spec: Mapping[str, Json]) -> Iterator[PolicyError]:
    """Every value that a schema lists for a parameter is of the parameter's type: no proposal could have another."""
    kind = str(spec["type"])
    values: list[tuple[Path, Json]] = [((*path, "const"), spec["const"])] if "const" in spec else []
    several = spec.get("enum")
    if isinstance(several, list):
        values += [((*path, "enum", index), value) for index, value in enumerate(several)]
    for place, value in values:
        if not _OF_TYPE[kind](value):
            message = f"`{value}` is no {kind}, so that no proposal could have it"
            yield reader.problem(place, message, [f"a value of type {kind}"])


def unproposable(
    reader: Reader, path: Path, what: str, bounds: Mapping[str, float | None], spec: Mapping[str, Json]
) -> Iterator[PolicyError]:
    """A bound (`min`, `max`) becomes the value of what lies beyond it, and has to be one that may be proposed."""
    own = {key: spec[key] for key in PICKING if key in spec}
    if not own:
        return
    low, high = _ends(spec)
    for key, bound in bounds.items():
        reached = bound is not None and (bound < high if key == "max" else bound > low)
        if reached and not Draft202012Validator(own).is_valid(bound):
            message = f"`{bound:g}` is no value that {what} may have, and would become its value"
            yield reader.problem((*path, key), message, ["a value that its input schema takes"])


def _ends(spec: Mapping[str, Json]) -> tuple[float, float]:
    """Return between which values a proposal lies."""
    given = cast("Mapping[str, float]", spec)
    several = cast("list[float]", [spec["const"]] if "const" in spec else spec.get("enum") or [])
    lows = [given[key] for key in ("minimum", "exclusiveMinimum") if key in spec]
    highs = [given[key] for key in ("maximum", "exclusiveMaximum") if key in spec]
    return max([*lows, *([min(several)] if several else [])]), min([*highs, *([max(several)] if several else [])])


def _number(value: Json) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


_OF_TYPE: Final[Mapping[str, Callable[[Json], bool]]] = {
    "boolean": lambda value: isinstance(value, bool),
    "integer": lambda value: _number(value) and float(cast("float", value)).is_integer(),
    "number": _number,
    "string": lambda value: isinstance(value, str),
}
