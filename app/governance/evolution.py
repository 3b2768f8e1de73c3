"""How a capability may change: every change of a manifest is classified, and its version has to grow accordingly.

Seen from the agent that proposes it, with what it may rely on kept or not:

| what changed | major | minor | patch |
|---|---|---|---|
| a parameter | gone, or new and to be given | new, with a default or not to be given | |
| its type, unit, kind of name, default | another | a default where none was | |
| its bounds and choices | narrower | wider | |
| other keywords of the schema | any change | | words |
| preconditions, permissions | one more | one less | |
| postconditions, phases | one less | one more | |
| risk | higher: more is asked about | lower | |
| rollback | another, or none any more | one where there was none | |
| time limit | shorter | longer | |
| summary | | | any change |

`env_profile` is policy, not the capability: it demands nothing. Before 1.0.0 what would be major grows the minor
version. Whether a change loosens what policy allows is `comparison`'s to say, and takes a second engineer either way.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from app.governance.bundle_yaml import parse as parse_yaml
from app.governance.errors import PolicyError
from app.governance.model import Risk
from app.governance.semver import Version, parse
from app.governance.vocabulary import always_there, properties

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from app.governance.model import Capability, Json
    from app.governance.policy import PolicySet


class Class(IntEnum):
    """Which part of a version a change demands to grow, from the least."""

    NONE = 0
    PATCH = 1
    MINOR = 2
    MAJOR = 3


class Change(NamedTuple):
    """One change of a manifest: what it is, in words, and what it demands."""

    what: str
    demands: Class


@dataclass(frozen=True, slots=True, kw_only=True)
class Evolution:
    """How a capability changed.

    Attributes:
        changes: every change, in order of the manifest.
        before: its version before.
        after: its version now.
    """

    changes: tuple[Change, ...]
    before: Version
    after: Version

    @property
    def demands(self) -> Class:
        """Return the strongest demand."""
        return max((change.demands for change in self.changes), default=Class.NONE)

    @property
    def least(self) -> Version:
        """Return the least version that would do."""
        return _grown(self.before, self.demands)

    @property
    def enough(self) -> bool:
        """Say whether the version grew as the changes demand; one that goes back is never enough."""
        return self.after >= self.least


def _grown(version: Version, demanded: Class) -> Version:
    if version.major == 0 and demanded is Class.MAJOR:
        demanded = Class.MINOR
    match demanded:
        case Class.MAJOR:
            return Version(version.major + 1, 0, 0)
        case Class.MINOR:
            return Version(version.major, version.minor + 1, 0)
        case Class.PATCH:
            return version._replace(patch=version.patch + 1)
        case _:
            return version


def evolve(old: Capability, new: Capability) -> Evolution:
    """Say how a capability changed, and what that demands of its version. Pure."""
    changes = (
        *sorted(_parameters(old, new)),
        *_schema(old, new),
        *_members("precondition", old.preconditions, new.preconditions, more=Class.MAJOR),
        *_members("postcondition", old.postconditions, new.postconditions, more=Class.MINOR),
        *_members("phase", old.phases, new.phases, more=Class.MINOR),
        *_members("permission", sorted(old.permissions), sorted(new.permissions), more=Class.MAJOR),
        *_scalars(old, new),
    )
    return Evolution(changes=tuple(changes), before=parse(old.version), after=parse(new.version))


# Parameters ----------------------------------------------------------------------------------------------------------

_APART: Final = frozenset(
    {"minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum", "minLength", "maxLength", "enum"}
)
_WORDS: Final = frozenset({"title", "description", "examples", "$comment"})
_LOW: Final = ("minimum", "exclusiveMinimum", "minLength")
_GIVEN: Final = (Class.MINOR, Class.MAJOR)  # an agent may leave it out; it may not


def _parameters(old: Capability, new: Capability) -> Iterator[Change]:
    before, after = properties(old), properties(new)
    asked, asks = _required(old), _required(new)
    for name in before.keys() - after.keys():
        yield Change(f"input `{name}` is gone", Class.MAJOR)
    for name in after.keys() - before.keys():
        given = name in asks
        yield Change(f"input `{name}` is new" + (" and has to be given" if given else ""), _GIVEN[given])
    for name in before.keys() & after.keys():
        yield from _parameter(name, before[name], after[name])
        if (name in asked) is not (name in asks):
            given = name in asks
            yield Change(f"input `{name}` {'has to be given' if given else 'may be left out'} now", _GIVEN[given])


def _required(capability: Capability) -> frozenset[str]:
    """Return the parameters an agent has to give: those with a default are there all the same."""
    return always_there(capability) - {name for name, spec in properties(capability).items() if "default" in spec}


def _parameter(name: str, before: Mapping[str, Json], after: Mapping[str, Json]) -> Iterator[Change]:
    for key in sorted({*before, *after}):
        was, now = before.get(key), after.get(key)
        if was == now and (key in before) == (key in after):
            continue
        if key in _WORDS:
            yield Change(f"input `{name}`: its {key} reads otherwise", Class.PATCH)
        elif key == "x-limit":
            yield Change(f"input `{name}` is held by `{now}` instead of `{was}`", Class.MINOR)
        elif key == "default" and key not in before:
            yield Change(f"input `{name}` has a default now", Class.MINOR)
        elif key in _APART:
            yield _bound(name, key, was, now)
        else:
            yield Change(f"input `{name}`: {key} is `{now}` instead of `{was}`", Class.MAJOR)


def _bound(name: str, key: str, was: Json, now: Json) -> Change:
    what = f"input `{name}`: {key} is `{now}` instead of `{was}`"
    if now is None:
        return Change(f"input `{name}`: {key} is gone", Class.MINOR)
    if was is None:
        return Change(f"input `{name}`: {key} is `{now}` now", Class.MAJOR)
    if key == "enum":
        kept = all(value in cast("list[Json]", now) for value in cast("list[Json]", was))
        return Change(what, Class.MINOR if kept else Class.MAJOR)
    less = cast("float", now) < cast("float", was)
    return Change(what, Class.MINOR if less is (key in _LOW) else Class.MAJOR)


def _schema(old: Capability, new: Capability) -> Iterator[Change]:
    """Compare the keywords around the parameters; what they come to together nobody can tell from their text."""
    for key in sorted({*old.inputs, *new.inputs} - {"properties", "required"}):
        if old.inputs.get(key) != new.inputs.get(key):
            yield Change(f"inputs: `{key}` is another", Class.PATCH if key in _WORDS else Class.MAJOR)


# The rest of a manifest ----------------------------------------------------------------------------------------------


def _members(what: str, old: Any, new: Any, *, more: Class) -> Iterator[Change]:  # noqa: ANN401  # lists of names
    fewer = Class.MINOR if more is Class.MAJOR else Class.MAJOR
    yield from (Change(f"{what} `{name}` is new", more) for name in new if name not in old)
    yield from (Change(f"{what} `{name}` is gone", fewer) for name in old if name not in new)
    if list(old) != list(new) and sorted(old) == sorted(new):
        yield Change(f"{what}s stand in another order", Class.PATCH)


def _scalars(old: Capability, new: Capability) -> Iterator[Change]:
    if old.risk is not new.risk:
        risks = list(Risk)
        higher = risks.index(new.risk) > risks.index(old.risk)
        yield Change(f"risk is {new.risk} instead of {old.risk}", Class.MAJOR if higher else Class.MINOR)
    if old.rollback != new.rollback:
        kept = Class.MINOR if old.rollback is None else Class.MAJOR
        yield Change(f"rollback is `{new.rollback}` instead of `{old.rollback}`", kept)
    if old.timeout_s != new.timeout_s:
        longer = Class.MINOR if new.timeout_s > old.timeout_s else Class.MAJOR
        yield Change(f"time limit is {new.timeout_s:g} s instead of {old.timeout_s:g} s", longer)
    if old.recovery is not new.recovery:
        yield Change("who may propose it is another", Class.MAJOR)
    if old.summary != new.summary:
        yield Change("the summary reads otherwise", Class.PATCH)


# A candidate against what is in force --------------------------------------------------------------------------------


def outgrown(live: PolicySet, candidate: PolicySet) -> list[PolicyError]:
    """Return every capability of a candidate whose version does not say what changed since the live policy.

    Args:
        live: what agents know.
        candidate: what may come into force.
    """
    problems: list[PolicyError] = []
    for name, new in sorted(candidate.capabilities.items()):
        old = live.capabilities.get(name)
        found = None if old is None else evolve(old, new)
        if found is not None and not found.enough:
            problems.append(_problem(candidate, name, found))
    return problems


def _problem(candidate: PolicySet, name: str, found: Evolution) -> PolicyError:
    file = f"capabilities/{name}.yaml"
    line = parse_yaml(file, candidate.files[file])[0].line(("version",))
    strongest = [change.what for change in found.changes if change.demands is found.demands]
    if found.after < found.before:
        message = f"the version goes back from {found.before} to {found.after}"
    else:
        part = found.demands.name.lower()
        message = f"{found.before} in force became {found.after}, and what changed demands a {part} step"
    told = f": {'; '.join(strongest)}" if strongest else ""
    return PolicyError(
        file=file, line=line, key="version", message=f"{message}{told}", valid=(f"{found.least} or later",)
    )
