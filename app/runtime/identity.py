"""Identifiers that sort by the time of their making, and digests of what people approve."""

from __future__ import annotations

import os
from hashlib import sha256
from typing import TYPE_CHECKING, Final

import orjson

if TYPE_CHECKING:
    from collections.abc import Callable

_ALPHABET: Final = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"  # Crockford's: no I, L, O, U
_PAIRS: Final = tuple(first + second for first in _ALPHABET for second in _ALPHABET)
_RANDOM_BITS: Final = 80
_BLOCK: Final = 256  # draws from the system at a time


class Identities:
    """Makes identifiers in the ULID form: 48 bits of milliseconds, 80 of randomness, 26 characters.

    Within one millisecond the random part counts up, so that the order of making is the order of the texts.
    """

    def __init__(self, wall_s: Callable[[], float]) -> None:
        """Take the clock."""
        self._wall_s = wall_s
        self._last = 0
        self._stem, self._text = -1, ""  # all but the last ten bits of the last one, and how they are written
        self._drawn: list[bytes] = []

    def make(self, prefix: str) -> str:
        """Return a new identifier, for instance `inv_01JCEX…`."""
        ms = int(self._wall_s() * 1000)
        value = self._last + 1
        if ms > value >> _RANDOM_BITS:  # else this millisecond goes on, or the wall clock stepped back
            value = ms << _RANDOM_BITS | self._random()
        self._last = value
        stem = value >> 10
        if stem != self._stem:
            self._stem, self._text = stem, "".join([_PAIRS[stem >> shift & 1023] for shift in range(110, -1, -10)])
        return f"{prefix}_{self._text}{_PAIRS[value & 1023]}"

    def _random(self) -> int:
        if not self._drawn:
            block = os.urandom(10 * _BLOCK)
            self._drawn = [block[at : at + 10] for at in range(0, len(block), 10)]
        return int.from_bytes(self._drawn.pop())


def digest(document: object) -> str:
    """Return `sha256:…` over the document's canonical JSON."""
    return "sha256:" + sha256(orjson.dumps(document, option=orjson.OPT_SORT_KEYS)).hexdigest()
