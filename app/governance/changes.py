"""What a comparison of two policies says: other parts, decisions that come out otherwise, and which way that goes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final, NamedTuple, TypeAlias

MAX_SHOWN: Final = 120


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
    """

    capability: str
    profile: str
    change: str
    direction: Direction
    decided: bool
    message: str
    example: str
    body: Mapping[str, Any]


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
        said = [found._replace(example="", body={})._asdict() for found in self.decisions]
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
    differences = tuple(Difference(part, _shown(was), _shown(now), way) for part, was, now, way in found)
    return total(differences, decisions, proved=proved)


def total(differences: tuple[Difference, ...], decisions: tuple[Transition, ...], *, proved: bool) -> Comparison:
    """Return what these come to."""
    ways = {one.direction for one in (*differences, *decisions)} - {SAME}
    direction = Direction.BOTH if len(ways) > 1 else next(iter(ways), SAME)
    return Comparison(direction=direction, differences=differences, decisions=decisions, proved=proved)


def _shown(value: object) -> str:
    match value:
        case None:
            return ""
        case frozenset() | set():
            text = ", ".join(sorted(map(str, value)))  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
        case tuple():
            text = ", ".join(map(str, value))  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
        case _:
            text = str(value)
    return text if len(text) <= MAX_SHOWN else f"{text[: MAX_SHOWN - 1]}…"
