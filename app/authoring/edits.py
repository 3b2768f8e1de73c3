"""What approvers change before they approve: one number always down or always up, one name always to the same other.

An approval that was edited both ways, or to several names, shows no habit: nothing is made of it. A name is judged by
the approvals that were shown with that very name (or without any), a number by all of its capability and profile.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import orjson

from app.authoring.habits import Tally

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from app.authoring.habits import Habits, Question

LOWERED: Final = "lowered"
RAISED: Final = "raised"
RENAMED: Final = "renamed"
MOSTLY: Final = 0.5  # of what was granted, from here on it is a habit to change it


class Habit(NamedTuple):
    """What people keep changing about what they approve.

    Attributes:
        how: `LOWERED`, `RAISED` or `RENAMED`.
        capability: of what.
        profile: under which.
        param: which parameter.
        of: how many approvals it is judged by.
        seen: those that changed it, each the same way.
        value: the most of what a number was lowered to, the least of what it was raised to; else the name.
        shown: the name that was shown; None where there was none, and for numbers.
    """

    how: str
    capability: str
    profile: str
    param: str
    of: int
    seen: Tally
    value: float | str
    shown: str | None

    def rule(self) -> dict[str, Any]:
        """Return a rule that does the same beforehand, as a policy file says it."""
        name = f"{self.capability}-{self.param}".replace("_", "-")
        rule: dict[str, Any] = {"id": f"{name}-as-approved", "applies_to": [self.capability], "then": "modify"}
        if self.how != RENAMED:
            bound, words = ("max", "at most") if self.how == LOWERED else ("min", "at least")
            rule["set"] = {self.param: {bound: self.value}}
            rule["because"] = f"People who approved it {self.how} `{self.param}` to {words} {self.value:g}."
            return rule
        there = f"has(params.{self.param})"
        told = "not given" if self.shown is None else f"`{self.shown}`"
        if self.shown is not None:
            rule["id"] = f"{name}-{self.shown}-as-approved".replace("_", "-")
        rule["when"] = f"!{there}" if self.shown is None else f"{there} && params.{self.param} == {_text(self.shown)}"
        rule["set"] = {self.param: {"to": _text(str(self.value))}}
        rule["because"] = f"People who approved it made `{self.param}` `{self.value}` where it was {told}."
        return rule


def _text(name: str) -> str:
    return orjson.dumps(name).decode()


class _Change(NamedTuple):
    """One parameter that an approver changed: `how`, and for a name the one that was shown."""

    how: str
    param: str
    shown: str | None
    value: float | str


def edited(habits: Habits, least: int) -> Iterator[Habit]:
    """Yield what was changed the same way in most approvals, and so often at least."""
    approvals = [one for one in habits.questions.values() if one.document["status"] == "approved"]
    found: dict[tuple[str, str, str, str | None], list[tuple[Question, _Change]]] = {}
    for one in approvals:
        said = one.document
        for change in _changes(said) if said["edits"] else ():
            key = (str(said["capability"]), str(said["profile"]), change.param, change.shown)
            found.setdefault(key, []).append((one, change))
    for (capability, profile, param, shown), listed in sorted(found.items(), key=lambda item: tuple(map(str, item[0]))):
        how, values = listed[0][1].how, [change.value for _, change in listed]
        of = _of(approvals, (capability, profile), param, named=how == RENAMED, shown=shown)
        if len(listed) >= max(least, MOSTLY * of) and _alike(change for _, change in listed):
            seen = Tally()
            for question, _ in listed:
                seen.note(question.seq, question.at)
            value = min(values) if how == RAISED else max(values)  # pyright: ignore[reportArgumentType]  # of one kind
            yield Habit(how, capability, profile, param, of, seen, value, shown)


def _changes(said: Mapping[str, Any]) -> Iterator[_Change]:
    for param, after in said["effective"].items():
        before = said["constrained"].get(param)
        if _is_number(before) and _is_number(after) and before != after:
            yield _Change(LOWERED if after < before else RAISED, param, None, float(after))
        elif isinstance(after, str) and before != after:
            yield _Change(RENAMED, param, before, after)


def _of(approvals: list[Question], pair: tuple[str, str], param: str, *, named: bool, shown: str | None) -> int:
    """Return how many approvals show the habit or its absence: of a name, those that were shown with it."""
    return sum(
        (one.document["capability"], one.document["profile"]) == pair
        and (not named or one.document["constrained"].get(param) == shown)
        for one in approvals
    )


def _alike(changes: Iterable[_Change]) -> bool:
    """Say whether all go one way: one direction for numbers, one name for names."""
    return len({(change.how, change.value if change.how == RENAMED else None) for change in changes}) == 1


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


__all__ = ["LOWERED", "RAISED", "RENAMED", "Habit", "edited"]
