"""Questions that a template asks, and answers held to what they may be."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

Answer: TypeAlias = "str | float | bool | tuple[str, ...]"
Answers: TypeAlias = "Mapping[str, Answer]"

_SLUG: Final = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
_WORDS: Final[Mapping[str, bool]] = {"yes": True, "true": True, "no": False, "false": False}


class AnswerError(ValueError):
    """An answer that cannot be taken: which question, what was said, and what would be valid."""

    def __init__(self, key: str, said: str, valid: str) -> None:
        """Keep the parts."""
        self.key = key
        super().__init__(f"`{said}` is no answer to `{key}`; valid: {valid}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Question(ABC):
    """One thing a template needs to know; each kind says what may be answered, and reads it.

    Attributes:
        key: The name it is answered by.
        asks: The question, with its unit.
        why: What it is for, and where the number comes from.
        default: What holds if nobody answers, as it would be typed; None where somebody has to: the risk assessment.
        source: The clause behind the default or the bounds.
    """

    key: str
    asks: str
    why: str
    default: str | None = None
    source: str = ""

    @property
    @abstractmethod
    def valid(self) -> str:
        """Say what may be answered."""

    @abstractmethod
    def read(self, said: str) -> Answer:
        """Return the answer that was typed. Raises `AnswerError`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Number(Question):
    """A number above `above`, at least `least` and at most `most`."""

    above: float = 0.0
    least: float = -math.inf
    most: float = math.inf

    @property
    def valid(self) -> str:
        """Say what may be answered."""
        low = f"at least {self.least:g}" if self.least > self.above else f"above {self.above:g}"
        return f"a number {low}" + (f", at most {self.most:g}" if math.isfinite(self.most) else "")

    def read(self, said: str) -> float:
        """Return the number that was typed. Raises `AnswerError`."""
        try:
            number = float(said)
        except ValueError:
            number = math.nan
        if not (math.isfinite(number) and number > self.above and self.least <= number <= self.most):
            raise AnswerError(self.key, said, self.valid)
        return number


@dataclass(frozen=True, slots=True, kw_only=True)
class Words(Question):
    """A name (`slug`), or a line of text."""

    slug: bool = False

    @property
    def valid(self) -> str:
        """Say what may be answered."""
        return "small letters, digits and hyphens, like `hall-2`" if self.slug else "1 to 120 characters on one line"

    def read(self, said: str) -> str:
        """Return the text that was typed. Raises `AnswerError`."""
        text = said.strip()
        if not 1 <= len(text) <= (64 if self.slug else 120) or not text.isprintable():
            raise AnswerError(self.key, said, self.valid)
        if self.slug and _SLUG.fullmatch(text) is None:
            raise AnswerError(self.key, said, self.valid)
        return text


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice(Question):
    """One of a list, or with `several` any of it, separated by commas."""

    among: Sequence[str]
    several: bool = False

    @property
    def valid(self) -> str:
        """Say what may be answered."""
        return ("some of " if self.several else "one of ") + ", ".join(self.among)

    def read(self, said: str) -> str | tuple[str, ...]:
        """Return what was chosen. Raises `AnswerError`."""
        chosen = list(dict.fromkeys(word.strip() for word in said.split(",") if word.strip()))
        if not chosen or not {*chosen} <= {*self.among} or (len(chosen) > 1 and not self.several):
            raise AnswerError(self.key, said, self.valid)
        return tuple(chosen) if self.several else chosen[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class YesNo(Question):
    """Yes or no."""

    @property
    def valid(self) -> str:
        """Say what may be answered."""
        return "yes or no"

    def read(self, said: str) -> bool:
        """Return what was typed. Raises `AnswerError`."""
        if said.strip().lower() not in _WORDS:
            raise AnswerError(self.key, said, self.valid)
        return _WORDS[said.strip().lower()]
