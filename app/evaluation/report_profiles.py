"""The report's part on environment profiles: what policy made of the same proposals, as a picture and as a table."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from app.evaluation.plots import Mark, marks
from app.evaluation.report_tables import Grid, Results, plain_text

if TYPE_CHECKING:
    from app.evaluation.plots import Plot

AS_PROPOSED: Final = Mark("=", "as proposed")
CHANGED: Final = Mark("≠", "changed")
ASKED: Final = Mark("?", "asked")
ALARMED: Final = Mark("!", "alarmed")
REFUSED: Final = Mark("✗", "refused")
MARKS: Final = (AS_PROPOSED, CHANGED, ASKED, ALARMED, REFUSED)
"""From the mildest to the most severe, which gives a cell its colour."""

_REFUSED: Final = re.compile(r"(?:reject|defer|deny|escalate) \(.+\)")
_RAN: Final = re.compile(
    r"(?P<decided>.+?): \w+ \d+/\d+(?:, \w+ \d+/\d+)*, [\d.]+ s(?P<alarms>(?:; \S+ alarmed \d+/\d+)*)"
)
_DECIDED: Final = re.compile(
    r"(?P<proposed>as proposed)|(?P<asked>asks \d+)?(?:; )?(?P<changed>\w+ \S+ to \S+(?:, \w+ \S+ to \S+)*)?"
)
_ABOUT: Final = (
    "The same proposals in four environment profiles. Every sign that applies is shown: = as proposed, ≠ changed by "
    "policy, ? a human asked (who says yes), ! a watcher alarmed under way, ✗ refused, also where a human would have "
    "to be asked and the profile asks nobody. The colour is that of the most severe. The table says what was changed "
    "and how the sessions ended."
)


class UnknownVerdict(ValueError):
    """A cell of the matrix that says none of what can become of a proposal."""

    def __init__(self, text: str) -> None:
        """Name the cell, and what would be valid."""
        super().__init__(
            f"cross_profile says `{text}`: valid is `<reject, defer, deny or escalate> (rules)`, or `as proposed`, "
            "`asks N` or changes, then `: <ends>, <time> s` and alarms"
        )


def classify(text: str) -> tuple[Mark, ...]:
    """Return what became of a proposal in a profile, the mildest first.

    Raises:
        UnknownVerdict: it is none of what the study of profiles writes.
    """
    if _REFUSED.fullmatch(text):
        return (REFUSED,)
    ran = _RAN.fullmatch(text)
    decided = None if ran is None else _DECIDED.fullmatch(ran["decided"])
    if ran is None or decided is None:
        raise UnknownVerdict(text)
    found = {
        AS_PROPOSED: decided["proposed"],
        CHANGED: decided["changed"],
        ASKED: decided["asked"],
        ALARMED: ran["alarms"],
    }
    return tuple(mark for mark in MARKS if found.get(mark))


def profile_grids(results: Results) -> tuple[Grid, ...]:
    """Return the matrix as a table, for whoever cannot see the picture or wants to know more."""
    found: Mapping[str, Mapping[str, Any]] = results.get("cross_profile", {})
    profiles = tuple(dict.fromkeys(profile for row in found.values() for profile in row))
    rows = tuple((name, tuple(plain_text(row.get(profile)) for profile in profiles)) for name, row in found.items())
    return (Grid("matrix", "The same proposals, in words", "Proposal", (), profiles, rows),) if rows else ()


def profile_plots(results: Results) -> tuple[Plot, ...]:
    """Draw the matrix.

    Raises:
        UnknownVerdict: a cell says nothing that is known.
    """
    found: Mapping[str, Mapping[str, str]] = results.get("cross_profile", {})
    cells = {
        name: {profile: classify(text) for profile, text in row.items()} for name, row in found.items() if any(row)
    }
    return (marks(cells, MARKS, _ABOUT),) if cells else ()
