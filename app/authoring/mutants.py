"""Every bound, operator, outcome and reference of a policy, changed in turn.

A mutant is a policy file with one value in it exchanged. What is changed and to what goes by where it stands: the table
`_BY_KEY` for what has a name, `app.authoring.numbers` for bounds, `app.authoring.conditions` for conditions. Texts for
people (`because`, `summary`, `source`) and names that things go by (`id`, `name`) are left alone: they decide nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, cast, get_args

from app.authoring.conditions import changes
from app.authoring.numbers import beside
from app.governance import bundle_shapes as shapes
from app.governance.bundle_yaml import dotted
from app.governance.conditions import TESTS
from app.governance.errors import ExpressionError
from app.governance.expression_tree import BOOL, STRING
from app.governance.policy_model import FAILURES, LIMIT_UNITS, REFERENCES, SIGNAL_UNITS

if TYPE_CHECKING:
    from app.governance.bundle_checks import Known
    from app.governance.bundle_yaml import Document, Path
    from app.governance.model import Json

MUTATED: Final = ("organization.yaml", "authority.yaml", "profiles/", "capabilities/")
_TEXTS: Final = frozenset({
    "because", "remedy", "summary", "source", "says", "id", "name", "version", "profile", "organization", "authority",
    "title", "description",
})  # fmt: skip
_UNTOUCHED: Final = frozenset({"phases", "codes", "type", "unit"})
"""Declarations: what they declare shows where it is used, and `type` and `unit` are checked on load against it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mutant:
    """One change of a policy: at a path of a file there stands another value.

    Attributes:
        file: Path of the file, relative to the policy directory.
        line: Line of what is changed, from 1.
        key: What is changed, as messages write it: `rules[2].when`.
        what: How, in a few words.
        path: Path of the value that is exchanged.
        value: What stands there instead.
    """

    file: str
    line: int
    key: str
    what: str
    path: Path
    value: Json

    def __str__(self) -> str:
        """Say where it is and what it is, on one line."""
        return f"{self.file}:{self.line}: {self.key}: {self.what}"

    def applied(self, content: Json) -> Json:
        """Return the file's content with the change in it."""
        return _put(content, self.path, self.value)


def _put(content: Json, path: Path, value: Json) -> Json:
    if not path:
        return value
    copied = cast(
        "dict[str | int, Json]", list(content) if isinstance(content, list) else {**cast("dict[str, Json]", content)}
    )
    copied[path[0]] = _put(copied[path[0]], path[1:], value)
    return cast("Json", copied)


def mutants(documents: Mapping[str, Document], known: Known) -> list[Mutant]:
    """List every mutant of a policy, in order of file and place.

    Args:
        documents: The policy files, by path.
        known: What they declare; references are exchanged for others of these.
    """
    found: list[Mutant] = []
    for file in sorted(documents):
        if file.startswith(MUTATED):
            walk = _Walk(documents[file], known)
            found += walk.value(documents[file].value, ())
    return found


class _Walk:
    """Goes through one file, with what its place says about every value."""

    def __init__(self, document: Document, known: Known) -> None:
        self.document, self.known = document, known

    def mutant(self, path: Path, what: str, at: Path, value: Json) -> Mutant:
        """Return a mutant about what stands at `path`, made by exchanging what stands at `at`."""
        document = self.document
        return Mutant(file=document.file, line=document.line(path), key=dotted(path), what=what, path=at, value=value)

    def value(self, value: Json, path: Path) -> Iterator[Mutant]:
        key = path[-1] if path else ""
        if path == ("organization",) or (key in _TEXTS and isinstance(value, str)) or key in _UNTOUCHED:
            return
        match value:
            case dict():
                yield from self.mapping(value, path)
            case list():
                yield from self.listing(cast("list[Json]", value), path)
            case bool():
                yield self.mutant(path, f"`{_shown(not value)}` instead of `{_shown(value)}`", path, not value)
            case int() | float():
                for other in beside(value, whole=_counted(path)):
                    yield self.mutant(path, f"`{other:g}` instead of `{value:g}`", path, other)
            case str():
                yield from self.text(value, path)
            case _:
                return

    def mapping(self, value: dict[str, Json], path: Path) -> Iterator[Mutant]:  # noqa: C901  # one branch per key
        for one, other in (("above", "below"), ("below", "above")):
            if one in value:
                turned = {(other if key == one else key): held for key, held in value.items()}
                yield self.mutant((*path, one), f"`{other}` instead of `{one}`", path, turned)
        if path and path[-1] in _DROPPING:
            for key in value:
                left = {other: held for other, held in value.items() if other != key}
                yield self.mutant((*path, key), f"without `{key}`", path, left)
        for key, held in value.items():
            if key == "then" and "set" in value:  # what sets nothing is another outcome
                rest = {other: kept for other, kept in value.items() if other != "set"}
                for effect in ("deny", "escalate"):
                    yield self.mutant((*path, key), f"`{effect}` instead of `modify`", path, {**rest, key: effect})
            elif key in ("applies_to", "profiles") and isinstance(held, list):
                rest = {other: kept for other, kept in value.items() if other != key}
                yield self.mutant((*path, key), "applies everywhere", path, rest)
                yield from self.value(held, (*path, key))
            elif key == "when":
                yield from self.condition(value, path)
            else:
                yield from self.value(held, (*path, key))

    def listing(self, value: list[Json], path: Path) -> Iterator[Mutant]:
        for index, item in enumerate(value):
            left = [*value[:index], *value[index + 1 :]]
            yield self.mutant((*path, index), f"without {_named(item)}", path, left)
        if path[-1] == "do":
            for index in range(len(value) - 1):
                turned = [*value[:index], value[index + 1], value[index], *value[index + 2 :]]
                what = f"`{value[index + 1]}` before `{value[index]}`"
                yield self.mutant((*path, index), what, path, cast("Json", turned))
        for name in self.addable(path):
            if name not in value:
                yield self.mutant(path, f"with `{name}` as well", path, [*value, name])
        for index, item in enumerate(value):
            if not isinstance(item, str):
                yield from self.value(item, (*path, index))

    def addable(self, path: Path) -> Sequence[str]:
        """Return what a list of names could hold as well."""
        key, above = path[-1], path[-2] if len(path) > 1 else ""
        if key == "modes":
            return get_args(shapes.AuthorityName if above == "authority" else shapes.ModeName)
        if key in ("risk", "risks"):
            return get_args(shapes.RiskName)
        if key == "outcomes":
            return get_args(shapes.SessionOutcome)
        if key == "permissions" and len(path) > 1:
            return sorted(self.known.permissions)
        return sorted(TESTS)[:NAMES] if key in ("preconditions", "postconditions") else ()

    def text(self, value: str, path: Path) -> Iterator[Mutant]:
        if path[-1] == "to":
            yield from self.setting(value, path)
            return
        key = str(path[-1])
        if "env_profile" in path:
            key = "env_profile"
        choose = _BY_KEY.get(key)
        for other in choose(value, path, self.known) if choose is not None else ():
            yield self.mutant(path, f"`{_shown(other)}` instead of `{value}`", path, other)

    def condition(self, rule: dict[str, Json], path: Path) -> Iterator[Mutant]:
        scope = rule.get("applies_to") or sorted(self.known.capabilities)
        for name in cast("list[str]", scope):
            try:
                typed = self.known.vocabulary.typed(str(rule["when"]), name, BOOL)
            except ExpressionError:
                continue
            for what, text in changes(typed):
                rest = {key: held for key, held in rule.items() if key != "when"}
                yield self.mutant((*path, "when"), what, path, {**rest, "when": text} if text else cast("Json", rest))
            return

    def setting(self, source: str, path: Path) -> Iterator[Mutant]:
        for name in sorted(self.known.capabilities):
            try:
                typed = self.known.vocabulary.typed(source, name, STRING)
            except ExpressionError:
                continue
            for what, text in changes(typed):
                yield self.mutant(path, what, path, text)
            return


_DROPPING: Final = frozenset({"set", "budget", "dependentRequired", "confirm_before"})
NAMES: Final = 2
"""By how many others a name is exchanged where there are many."""


def _counted(path: Path) -> bool:
    """Say whether a number counts something: milliseconds and characters are whole, metres and newtons are not."""
    names = [str(step) for step in path if isinstance(step, str)]
    return names[-1].endswith("_ms") or not _COUNTED.isdisjoint(names)


_COUNTED: Final = frozenset({"stale_after_ms", "budget", "retry_budget", "approvers", "minLength", "maxLength"})


def _shown(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) or value is None else str(value)


def _named(item: Json) -> str:
    """Return what an item of a list is called."""
    if isinstance(item, dict):
        name = item.get("id") or item.get("on") or item.get("capability")
        return f"`{name}`" if name else "an entry"
    return f"`{item}`"


# References and outcomes ---------------------------------------------------------------------------------------------

_Choose = Callable[[str, "Path", "Known"], Sequence["str | None"]]


def _other(names: Sequence[str], value: str, most: int = NAMES) -> list[str]:
    """Return the names after this one in the order they are declared in, beginning again at the first."""
    if value not in names:
        return [name for name in names if name != value][:most]
    start = names.index(value) + 1
    return [*names[start:], *names[: start - 1]][:most]


def _one_of(alias: object, most: int = NAMES) -> _Choose:
    return lambda value, _path, _known: _other(get_args(alias), value, most)


def _from(names: Sequence[str]) -> _Choose:
    return lambda value, _path, _known: _other(names, value)


def _of_unit(units: Mapping[str, str]) -> _Choose:
    return lambda value, _path, _known: _other([name for name in units if units[name] == units.get(value)], value)


def _then(value: str, path: Path, _known: Known) -> Sequence[str | None]:
    return _other(("resume", "stay") if "response" in path else ("escalate", "deny"), value)


def _rollback(value: str, path: Path, known: Known) -> Sequence[str | None]:
    if value in ("optional", "always", "required") and "inputs" not in path:
        return _other(("optional", "always", "required"), value)
    return (*_other(sorted(known.recoveries), value, 1), None)


def _capability(value: str, _path: Path, known: Known) -> Sequence[str | None]:
    return _other(sorted(known.recoveries if value in known.recoveries else known.capabilities), value, 1)


def _ending(value: str, _path: Path, _known: Known) -> Sequence[str | None]:
    return _other(get_args(shapes.Ending), value)


def _default(value: str, path: Path, _known: Known) -> Sequence[str | None]:
    return ("other",) if path[0] == "denials" else ()


_BY_KEY: Final[Mapping[str, _Choose]] = {
    "then": _then,
    "enter": _one_of(shapes.InterventionName),
    "else": _one_of(shapes.InterventionName),
    "emits": _from(("WARNING", "VIOLATION", "TIMEOUT", "INSTABILITY")),
    "method": _from(("threshold", "cusum")),
    "signal": _of_unit(SIGNAL_UNITS),
    "limit": _of_unit(LIMIT_UNITS),
    "x-limit": _of_unit(LIMIT_UNITS),
    "x-ref": _from(REFERENCES),
    "failure": _from(sorted(FAILURES)),
    "on": _from(sorted(FAILURES)),
    "capability": _capability,
    "rollback": _rollback,
    "risk": _one_of(shapes.RiskName),
    "env_profile": _one_of(shapes.Enabling, 3),
    "on_deny": _ending,
    "on_timeout": _ending,
    "default": _default,
}
