"""What an input schema refers to: only itself. What the digest of a policy covers decides, and nothing else is read.

1. `references` says, with its line, what would lead out of the document; of what stays inside, what leads nowhere or
   never comes to an end. Parameters are flat, so a schema that refers to itself on its own way is a mistake.
2. The validators that decide (`fitting.validator`) cannot retrieve anything, whatever 1 overlooked.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final
from urllib.parse import unquote

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from app.governance.bundle_yaml import Path, Reader
    from app.governance.errors import PolicyError
    from app.governance.model import Json

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
REFERRING: Final = ("$ref", "$dynamicRef", "$recursiveRef")
INSIDE: Final = r"^#(/|$)"
MOST_PARTS: Final = 10_000  # with what is referred to written out: what doubles with each reference outgrows all time
MOST_LEVELS: Final = 100  # likewise
_MOST_SHOWN: Final = 80
_MOST_NAMED: Final = 12


def references(reader: Reader, schema: Mapping[str, Json]) -> Iterator[PolicyError]:
    """Check that a schema refers to what stands in it alone, and that following it comes to an end."""
    leading_out = [*_leading_out(reader, ("inputs",), dict(schema))]
    yield from leading_out
    if not leading_out:
        try:
            _Following(dict(schema)).measure(("inputs",), dict(schema), 1)
        except _EndlessError as found:
            yield reader.problem(found.path, found.message, found.valid)


def _leading_out(reader: Reader, path: Path, value: Json) -> Iterator[PolicyError]:
    """Whatever stands there: a reference may lead to what is no schema where it stands, and make it one."""
    for step, inner in _inside(value):
        here = (*path, step)
        if isinstance(inner, str):
            shown = inner if len(inner) <= _MOST_SHOWN else f"{inner[:_MOST_SHOWN]}…"
            if step in REFERRING and inner != "#" and not inner.startswith("#/"):
                yield reader.problem(here, f"`{step}` is `{shown}`: it leads within this document, or nowhere", ["#/…"])
            elif step == "$schema" and inner != DIALECT:
                yield reader.problem(here, f"`{shown}` is no dialect that is read here", [DIALECT])
            elif step == "$id":
                yield reader.problem(here, f"`$id` is `{shown}`: references would lead there", ["inputs without `$id`"])
        yield from _leading_out(reader, here, inner)


def _inside(value: Json) -> list[tuple[str | int, Json]]:
    match value:
        case dict():
            return [*value.items()]
        case list():
            return [*enumerate(value)]
        case _:
            return []


class _EndlessError(Exception):
    """A reference that cannot be followed to an end."""

    def __init__(self, path: Path, message: str, *valid: str) -> None:
        super().__init__(message)
        self.path, self.message, self.valid = path, message, valid


class _Following:
    """Measures a schema with everything that is referred to written out; what was measured once is not walked again."""

    def __init__(self, root: dict[str, Json]) -> None:
        self._root = root
        self._open: set[Path] = set()
        self._measured: dict[Path, tuple[int, int]] = {}

    def measure(self, path: Path, value: Json, level: int) -> tuple[int, int]:
        """Return how many mappings and lists there are at and below a path, and how many levels of them.

        Raises:
            _EndlessError: A reference leads nowhere or back to where it came from, or what comes of them is too much.
        """
        if path not in self._measured:
            self._open.add(path)
            beneath = self._beneath(path, value) if level <= MOST_LEVELS else ()
            parts = [self.measure(*inner, level + 1) for inner in beneath]
            self._open.remove(path)
            self._measured[path] = (1 + sum(size for size, _ in parts), 1 + max((deep for _, deep in parts), default=0))
        size, levels = self._measured[path]
        if size > MOST_PARTS:
            raise _EndlessError(path, f"with what it refers to it has more than {MOST_PARTS:,} parts")
        if level + levels - 1 > MOST_LEVELS:
            raise _EndlessError(path, f"with what it refers to it nests deeper than {MOST_LEVELS} levels")
        return size, levels

    def _beneath(self, path: Path, value: Json) -> Iterator[tuple[Path, Json]]:
        for step, inner in _inside(value):
            here = (*path, step)
            if step in REFERRING and isinstance(inner, str):
                yield self._pointed(here, inner)
            elif isinstance(inner, (dict, list)):
                yield here, inner

    def _pointed(self, path: Path, reference: str) -> tuple[Path, Json]:
        """Return what a reference leads to (a JSON Pointer, RFC 6901, as a fragment), and where it stands."""
        found: Path = ("inputs",)
        value: Json = self._root
        for part in unquote(reference).split("/")[1:]:
            name = part.replace("~1", "/").replace("~0", "~")
            match value:
                case dict() if name in value:
                    found, value = (*found, name), value[name]
                case list() if name.isdecimal() and int(name[:9]) < len(value):
                    found, value = (*found, int(name[:9])), value[int(name[:9])]
                case _:
                    shown = reference[:_MOST_SHOWN]
                    raise _EndlessError(path, f"`{shown}` leads nowhere: there is no `{name}`", *_names(value))
        if found in self._open:  # what is open is on the way here
            raise _EndlessError(path, f"`{reference[:_MOST_SHOWN]}` leads back to where it is: following it never ends")
        return found, value


def _names(value: Json) -> list[str]:
    return [str(step) for step, _ in _inside(value)][:_MOST_NAMED]
