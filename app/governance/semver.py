"""Versions of capabilities, and what an agent may ask of one: `1.2.3` this, `~1.2.3` or later of 1.2, `^1.2.3` of 1.

Semantic Versioning 2.0.0, three numbers and no more. Before 1.0.0 a minor version may change anything, so `^0.2.1` is
`~0.2.1`, and `^0.0.3` is `0.0.3`.
"""

from __future__ import annotations

import re
from typing import Final, NamedTuple

VERSION: Final = r"(0|[1-9]\d{0,8})\.(0|[1-9]\d{0,8})\.(0|[1-9]\d{0,8})"
PIN: Final = rf"^[\^~]?{VERSION}$"
_PIN: Final = re.compile(rf"([\^~]?){VERSION}")


class Version(NamedTuple):
    """MAJOR.MINOR.PATCH; compares in order."""

    major: int
    minor: int
    patch: int

    def __str__(self) -> str:
        """Write it as manifests do."""
        return f"{self.major}.{self.minor}.{self.patch}"


def parse(text: str) -> Version:
    """Read a version, or the one a pin begins with. Raises `ValueError`."""
    return _read(text)[1]


def _read(text: str) -> tuple[str, Version]:
    found = _PIN.fullmatch(text)
    if found is None:
        raise ValueError(f"`{text}` is no version; valid: 1.2.3, ~1.2.3, ^1.2.3")
    return found[1], Version(int(found[2]), int(found[3]), int(found[4]))


def meets(version: str, pin: str) -> bool:
    """Say whether a version is one that a pin asks for.

    Raises:
        ValueError: one of them is none.
    """
    kind, least = _read(pin)
    found = parse(version)
    if kind == "" or (kind == "^" and least.major == least.minor == 0):
        return found == least
    same = 2 if kind == "~" or least.major == 0 else 1
    return found[:same] == least[:same] and found >= least
