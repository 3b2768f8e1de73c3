"""YAML as policy files use it: YAML 1.2 core schema, every value with its line, and nothing that could surprise.

`on`, `yes` and `1:30` are plain text (YAML 1.1 made them true, true and 90); duplicate keys, aliases, tags, NaN and
infinity are errors.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import lru_cache
from typing import TYPE_CHECKING, Final, TypeAlias, cast

import yaml

from app.governance.errors import PolicyError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from app.governance.model import Json

Path: TypeAlias = tuple[str | int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Document:
    """One file's content, and the line on which each key or list item stands."""

    file: str
    value: Json
    lines: Mapping[Path, int]

    def line(self, path: Path) -> int:
        """Return the line of a path, or of the nearest thing around it; 1 for the whole file."""
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """Writes problems about one document."""

    document: Document

    def problem(self, path: Path, message: str, valid: Iterable[str] = ()) -> PolicyError:
        """Return a problem at a path."""
        document = self.document
        return PolicyError(
            file=document.file, line=document.line(path), key=dotted(path), message=message, valid=tuple(valid)
        )

    def unknown(self, path: Path, what: str, name: object, known: Collection[str]) -> Iterator[PolicyError]:
        """Yield a problem unless the name is known; the nearest names come first."""
        if name not in known:
            names = sorted(known)
            near = get_close_matches(str(name), names, n=3, cutoff=0.5)
            yield self.problem(path, f"there is no {what} `{name}`", [*near, *(n for n in names if n not in near)])


class _Loader(yaml.CSafeLoader):
    """The YAML 1.2 core schema: only these plain scalars are anything else than text."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012  # yaml's own way


for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", "~nN"),
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", r"[-+]?[0-9]+", "-+0123456789"),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", "-+.0123456789"),
    ("float", r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", "-+."),
):  # fmt: skip
    _Loader.add_implicit_resolver(  # pyright: ignore[reportUnknownMemberType]
        f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})$"), [*_first, ""] if _tag == "null" else list(_first)
    )

_SCALARS: Final = {f"tag:yaml.org,2002:{name}": name for name in ("null", "bool", "int", "float", "str")}
_MAX_DEPTH: Final = 40
_KEPT_FILES: Final = 64
_KEPT_CHARACTERS: Final = 32_768  # of one file: what is kept stays small, whatever anybody offers
_MAX_DIGITS: Final = 400  # of an integer with leading zeros; longer ones are not even read


# Embeddings, overrides, isolates (Unicode TR 9), also as YAML writes them in double quotes: what is shown holds them.
_TURNING: Final = re.compile(r"[\u202a-\u202e\u2066-\u2069]|\\(?:u|U0000)(?:202[a-eA-E]|206[6-9])")


def turned(file: str, text: str) -> list[PolicyError]:
    """Return a problem for every mark that turns round how a line is read, comments included.

    People sign what they read, and the server takes what stands there (Unicode TR 36, 2.10).
    """
    found = ((at, mark) for at, line in enumerate(text.splitlines(), 1) for mark in _TURNING.findall(line))
    said = "`U+{:04X}` turns round how the line is read"
    return [
        PolicyError(file=file, line=at, key="", message=said.format(_point(mark)), valid=["text without it"])
        for at, mark in found
    ]


def _point(mark: str) -> int:
    return ord(mark) if len(mark) == 1 else int(mark[-4:], 16)


class _Walk:
    """Turns yaml's node tree into plain values, gathering lines and problems on the way."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.lines: dict[Path, int] = {}
        self.problems: list[PolicyError] = []
        self.seen: set[int] = set()

    def fault(self, node: yaml.Node, path: Path, message: str) -> None:
        self.problems.append(PolicyError(file=self.file, line=_line(node), key=dotted(path), message=message))

    def value(self, node: yaml.Node, path: Path) -> Json:
        self.lines.setdefault(path, _line(node))
        if id(node) in self.seen:
            message = "aliases are not allowed: write the value out"
            self.problems.append(PolicyError(file=self.file, line=self.lines[path], key=dotted(path), message=message))
            return None
        self.seen.add(id(node))
        match node:
            case yaml.MappingNode(tag="tag:yaml.org,2002:map"):
                return self.mapping(node, path)
            case yaml.SequenceNode(tag="tag:yaml.org,2002:seq"):
                items = cast("list[yaml.Node]", node.value)
                return [self.value(item, (*path, index)) for index, item in enumerate(items)]
            case yaml.ScalarNode() if node.tag in _SCALARS:
                return self.scalar(node, path)
            case _:
                self.fault(node, path, f"tag `{node.tag}` is not allowed: plain values, lists and mappings are")
                return None

    def mapping(self, node: yaml.MappingNode, path: Path) -> Json:
        result: dict[str, Json] = {}
        for key_node, value_node in cast("list[tuple[yaml.Node, yaml.Node]]", node.value):
            key = key_node.value if isinstance(key_node, yaml.ScalarNode) else None
            if not isinstance(key, str):
                self.fault(key_node, path, "a key is a plain word")
                continue
            here = (*path, key)
            if key in result:
                self.fault(key_node, here, f"key `{key}` stands twice, first on line {self.lines[here]}")
                continue
            self.lines[here] = _line(key_node)
            result[key] = self.value(value_node, here)
        return result

    def scalar(self, node: yaml.ScalarNode, path: Path) -> Json:
        text = str(node.value)
        match _SCALARS[node.tag]:
            case "null":
                return None
            case "bool":
                return text.lower() == "true"
            case "int" if len(text.lstrip("+-")) > _MAX_DIGITS or not -(2**63) <= int(text) < 2**63:
                self.fault(node, path, f"number out of range: `{text[:24]}…`")
                return 0
            case "int":
                return int(text)
            case "float":
                number = float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
                if not math.isfinite(number):
                    self.fault(node, path, f"`{text}` is not a finite number")
                return number
            case _:
                return text


def _line(node: yaml.Node) -> int:
    return int(node.start_mark.line) + 1


def dotted(path: Path) -> str:
    """Write a path as messages do: `rules[2].when`."""
    text = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path)
    return text.removeprefix(".")


def _too_deep(text: str) -> int | None:
    """Return the line on which the nesting goes too deep, or None.

    The events come one after the other; composing nodes from them recurses in C, where there is no limit but the stack.
    """
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > _MAX_DEPTH:
                return int(cast("yaml.Mark", event.start_mark).line) + 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
    return None


def parse(file: str, text: str) -> tuple[Document, list[PolicyError]]:
    """Read one file; what is wrong with it comes back as problems beside whatever could be read.

    Reading YAML is most of loading a policy, and a candidate differs from what is in force in a file or two: what was
    read lately is not read again. The values are the caller's own.
    """
    if len(text) > _KEPT_CHARACTERS:
        return _read(file, text)
    document, problems = _kept(file, text)
    return replace(document, value=_copied(document.value)), [*problems]


@lru_cache(maxsize=_KEPT_FILES)
def _kept(file: str, text: str) -> tuple[Document, list[PolicyError]]:
    return _read(file, text)


def _copied(value: Json) -> Json:
    match value:
        case dict():
            return {key: _copied(item) for key, item in value.items()}
        case list():
            return [_copied(item) for item in value]
        case _:
            return value


def _read(file: str, text: str) -> tuple[Document, list[PolicyError]]:
    try:
        deep = _too_deep(text)
        node = None if deep is not None else yaml.compose(text, Loader=_Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = int(mark.line) + 1 if mark is not None else 1
        detail = str(getattr(error, "problem", None) or error).splitlines()[0]
        problem = PolicyError(file=file, line=line, key="", message=f"not readable as YAML: {detail}")
        return Document(file=file, value=None, lines={}), [problem]
    if deep is not None:
        message = f"nested deeper than {_MAX_DEPTH} levels"
        return Document(file=file, value=None, lines={}), [PolicyError(file=file, line=deep, key="", message=message)]
    if node is None:
        return Document(file=file, value=None, lines={}), []
    walk = _Walk(file)
    value = walk.value(node, ())
    return Document(file=file, value=value, lines=walk.lines), walk.problems
