"""What a comparison of two policies says: other parts, decisions that come out otherwise, and which way that goes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum, StrEnum
from typing import Any, Final, NamedTuple, TypeAlias, cast

MAX_SHOWN: Final = 240
NO_ROW: Final = "no row"
_NOTHING: Final[tuple[object, ...]] = (None, (), frozenset[str](), dict[str, object]())


class Direction(StrEnum):
    """Which way a change goes; of a whole comparison `both` says that it goes either way, in different parts."""

    SAME = "same"
    TIGHTENS = "tightens"
    LOOSENS = "loosens"
    BOTH = "both"


class Difference(NamedTuple):
    """One part that is another: where it stands, what it was, what it is, and which way that goes."""

    part: str
    before: str
    after: str
    direction: Direction


class Transition(NamedTuple):
    """One way in which decisions come out otherwise, shown by an example.

    Attributes:
        capability: about what; empty where it is about the floor.
        profile: where; empty likewise.
        change: what becomes of what: `deny -> allow`, `looser speed_mps`, `fewer approvers` and so on.
        direction: which way that goes.
        decided: whether it was proved and is shown; what is not decided goes the way that needs more people.
        message: the same in words.
        example: a case that shows it, as YAML: what it expects is what the new policy does.
        body: its proposal as a body of `POST /v1/check`.
        before, after: what becomes of that proposal under either policy: `what` (allow, approve, deny), `approvers`,
            the effective `values`, and `rules`, by which; None where no decision shows it.
    """

    capability: str
    profile: str
    change: str
    direction: Direction
    decided: bool
    message: str
    example: str
    body: Mapping[str, Any]
    before: Mapping[str, Any] | None = None
    after: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """All differences, and what they come to; `decisions` only where it was proved what follows for them."""

    direction: Direction
    differences: tuple[Difference, ...] = ()
    decisions: tuple[Transition, ...] = ()
    proved: bool = False

    @property
    def loosens(self) -> bool:
        """Say whether anything of it may allow more than before."""
        return self.direction in (Direction.LOOSENS, Direction.BOTH)

    @property
    def tightens(self) -> bool:
        """Say whether anything of it may allow less than before, or is not known not to."""
        return self.direction is not Direction.SAME

    def document(self) -> dict[str, Any]:
        """Return the comparison as JSON."""
        return {
            "direction": self.direction,
            "proved": self.proved,
            "differences": [found._asdict() for found in self.differences],
            "decisions": [found._asdict() for found in self.decisions],
        }

    def brief(self) -> dict[str, Any]:
        """Return the comparison as JSON without its examples, for the record."""
        said = [found._replace(example="", body={}, before=None, after=None)._asdict() for found in self.decisions]
        return {**self.document(), "decisions": said}

    @staticmethod
    def read(document: Mapping[str, Any]) -> Comparison:
        """Return the comparison that a document says."""
        differences: list[dict[str, Any]] = document["differences"]
        decisions: list[dict[str, Any]] = document["decisions"]
        return Comparison(
            direction=Direction(document["direction"]),
            differences=tuple(Difference(**_with_direction(one)) for one in differences),
            decisions=tuple(Transition(**_with_direction(one)) for one in decisions),
            proved=document["proved"],
        )


def _with_direction(one: Mapping[str, Any]) -> dict[str, Any]:
    return {**one, "direction": Direction(one["direction"])}


Found: TypeAlias = "Iterator[tuple[str, object, object, Direction]]"
SAME, TIGHTENS, LOOSENS = Direction.SAME, Direction.TIGHTENS, Direction.LOOSENS


def summed(found: Found, decisions: tuple[Transition, ...] = (), *, proved: bool = False) -> Comparison:
    """Return what parts and decisions come to together: one that loosens is outweighed by nothing."""
    differences = tuple(_difference(*one) for one in found)
    return total(differences, decisions, proved=proved)


def total(differences: tuple[Difference, ...], decisions: tuple[Transition, ...], *, proved: bool) -> Comparison:
    """Return what these come to."""
    ways = {one.direction for one in (*differences, *decisions)} - {SAME}
    direction = Direction.BOTH if len(ways) > 1 else next(iter(ways), SAME)
    return Comparison(direction=direction, differences=differences, decisions=decisions, proved=proved)


# In words ------------------------------------------------------------------------------------------------------------


def _difference(part: str, was: object, now: object, way: Direction) -> Difference:
    before, after = _apart(was, now)
    return Difference(part, _cut(before), _cut(after), way)


def _apart(was: object, now: object) -> tuple[str, str]:
    """Say what two values are, of rows and of what has fields only what is another: that must not be cut away."""
    if is_dataclass(was) and type(was) is type(now):
        before, after = _fields(was), _fields(now)
        names = [name for name in {**before, **after} if before.get(name) != after.get(name)]
        sides = ({name: found[name] for name in names if name in found} for found in (before, after))
        one, other = map(_named, sides)
        return one, other
    if isinstance(was, tuple) and isinstance(now, tuple):
        return _rows(cast("tuple[object, ...]", was), cast("tuple[object, ...]", now))
    return _said(cast("object", was)), _said(now)


def _rows(was: tuple[object, ...], now: tuple[object, ...]) -> tuple[str, str]:
    """Say what stands between the rows that both begin with and those that both end with; of plain values, all."""
    if not any(is_dataclass(row) for row in (*was, *now)):
        return _said(was), _said(now)
    least = min(len(was), len(now))
    head = next((index for index in range(least) if was[index] != now[index]), least)
    tail = next((index for index in range(least - head) if was[-1 - index] != now[-1 - index]), least - head)
    one, other = ("; ".join(map(_said, rows[head : len(rows) - tail])) for rows in (was, now))
    return one or NO_ROW, other or NO_ROW


def _said(value: object) -> str:
    """Say a value as a policy file would: names without their types, sets in one order, nothing that is left out."""
    match value:
        case None:
            return ""
        case Enum():
            return str(value.value)
        case frozenset() | set():
            return ", ".join(sorted(map(_said, cast("frozenset[object]", value))))
        case tuple() | list():
            return ", ".join(map(_said, cast("tuple[object, ...]", value)))
        case Mapping():
            return _named({_said(name): _inner(held) for name, held in cast("Mapping[object, object]", value).items()})
        case _ if is_dataclass(value):
            return _named(_fields(value))
        case _:
            return str(value)


def _inner(value: object) -> str:
    """Say a value inside another one: what has several parts stands between brackets."""
    if isinstance(value, frozenset | set | tuple | list):
        return f"[{_said(cast('tuple[object, ...]', value))}]"
    several = isinstance(value, Mapping) or is_dataclass(value)
    text = _said(cast("object", value))
    return f"{{{text}}}" if several else text


def _fields(value: object) -> dict[str, str]:
    """Return what every field says that says something."""
    held = {field.name: getattr(value, field.name) for field in fields(cast("Any", value))}
    return {name: _inner(one) for name, one in held.items() if one not in _NOTHING}


def _named(found: Mapping[str, str]) -> str:
    return ", ".join(f"{name}: {text}" for name, text in found.items())


def _cut(text: str) -> str:
    return text if len(text) <= MAX_SHOWN else f"{text[: MAX_SHOWN - 1]}…"
