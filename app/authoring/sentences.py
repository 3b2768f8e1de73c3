"""Conditions in plain English, from the typed tree: what a safety engineer would say instead of writing them.

Every operator has its own words here, and what is read of the world has too; a parameter goes by its name. Numbers
carry the unit of what they are compared with, and what follows from a profile's limits is worked out beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final, assert_never

from app.authoring.conditions import to_cel
from app.authoring.equivalence import fold
from app.governance.expression_tree import (
    Apply,
    Conditional,
    Constant,
    ListOf,
    Logic,
    Present,
    Quantifier,
    Select,
    Typed,
    Variable,
    dotted,
    references,
)

if TYPE_CHECKING:
    from app.authoring.equivalence import Values

_TRUTHS: Final[Mapping[str, tuple[str, str]]] = {
    "target.fragile": ("the object is fragile", "the object is not fragile"),
    "target.hazardous": ("the object is hazardous", "the object is not hazardous"),
    "place.forbidden": ("it leads into a forbidden zone", "it leads into no forbidden zone"),
    "place.outside": ("it leads outside the site or off the surface it names", "it leads inside the site"),
    "tool.press": ("the tool is a press", "the tool is no press"),
    "profile.shared_floor": ("people share the floor", "people do not share the floor"),
    "world.gripper_empty": ("the gripper is empty", "the gripper holds something"),
    "world.arm_ready": ("the arm is ready", "the arm is not ready"),
    "world.arm_retracted": ("the arm is retracted", "the arm is not retracted"),
    "world.sensors_fresh": ("the sensors are fresh", "the sensors are stale"),
    "operator_on_duty": ("an operator is on duty", "no operator is on duty"),
}
_GIVEN: Final[Mapping[str, tuple[str, str]]] = {
    "metadata.confidence": ("a confidence is stated", "no confidence is stated"),
    "metadata.intent": ("an intent is stated", "no intent is stated"),
    "metadata.priority": ("a priority is stated", "no priority is stated"),
    "place.corridor": ("a corridor leads there", "no corridor leads there"),
    "world.holding": ("the gripper is known to hold something", "the gripper is not known to hold anything"),
}
_VALUES: Final[Mapping[str, str]] = {
    "target.name": "the object",
    "target.kind": "the kind of object",
    "target.mass_kg": "the object's mass",
    "place.name": "the place it leads to",
    "place.kind": "the kind of place it leads to",
    "place.corridor": "the corridor that leads there",
    "tool.name": "the tool",
    "tool.kind": "the kind of tool",
    "metadata.confidence": "the stated confidence",
    "metadata.intent": "the stated intent",
    "metadata.priority": "the stated priority",
    "agent.name": "the agent",
    "agent.permissions": "the agent's permissions",
    "capability.name": "the capability",
    "capability.risk": "the risk",
    "profile.name": "the profile",
    "profile.sensitivity": "the sensitivity",
    "limits.tcp_speed_mps": "the arm's speed limit",
    "limits.base_speed_mps": "the base's speed limit",
    "limits.grip_force_n": "the grip force limit",
    "limits.contact_force_n": "the contact force limit",
    "limits.payload_kg": "the payload limit",
    "mode": "the mode",
    "world.people_count": "the number of people about",
    "world.people_nearest_m": "the distance to the nearest person",
    "world.holding": "what the gripper holds",
}
_COMPARED: Final[Mapping[str, tuple[str, str]]] = {
    "less": ("less than", "at least"),
    "at_most": ("at most", "more than"),
    "greater": ("more than", "at most"),
    "at_least": ("at least", "less than"),
    "equal": ("", "not"),
    "unequal": ("not", ""),
    "equal_lists": ("exactly", "not exactly"),
    "unequal_lists": ("not exactly", "exactly"),
}
_TEXTS: Final[Mapping[str, tuple[str, str]]] = {
    "starts_with": ("begins with", "does not begin with"),
    "ends_with": ("ends with", "does not end with"),
    "contains": ("contains", "does not contain"),
}
_JOINED: Final[Mapping[str, str]] = {"add": "plus", "subtract": "minus", "multiply": "times", "divide": "divided by"}


def sentence(typed: Typed, values: Values) -> str:
    """Say a condition in words.

    Args:
        typed: A condition.
        values: What is known of the profile's limits, by dotted path; worked out beside what they are part of.
    """
    return _Speaker(values).truth(typed, holds=True)


def value_of(typed: Typed, values: Values) -> str:
    """Say a value in words; `values` as for `sentence`."""
    return _Speaker(values).value(typed)


class _Speaker:
    def __init__(self, values: Values) -> None:
        self.values = values

    # -- truth values -------------------------------------------------------------------------------------------------

    def truth(self, typed: Typed, *, holds: bool) -> str:  # noqa: C901  # one per shape
        """Say that something holds, or that it does not."""
        side = 0 if holds else 1
        match typed:
            case Constant():
                return "always" if bool(typed.value) is holds else "never"
            case Present(select=select):
                return self._given(select, side)
            case Variable() | Select():
                path = dotted(typed) or to_cel(typed)
                generic = f"{self.value(typed)} is true", f"{self.value(typed)} is false"
                return _TRUTHS.get(path, generic)[side]
            case Logic():
                parts = [self._part(operand, holds=holds) for operand in typed.operands]
                return joined(parts, "and" if typed.conjunction is holds else "or")
            case Conditional():
                then, otherwise = (self.truth(part, holds=holds) for part in (typed.then, typed.otherwise))
                return f"{then} where {self.truth(typed.condition, holds=True)}, and {otherwise} elsewhere"
            case Quantifier():
                return self._quantified(typed, holds=holds)
            case Apply():
                return self._applied(typed, holds=holds)
            case ListOf():
                return self.value(typed)
            case _:
                assert_never(typed)

    def _part(self, typed: Typed, *, holds: bool) -> str:
        text = self.truth(typed, holds=holds)
        while isinstance(typed, Apply) and typed.overload == "not":  # what it turns round is said in its place
            (typed,) = typed.args
        return f"({text})" if isinstance(typed, (Logic, Conditional, Quantifier)) else text

    def _given(self, select: Select, side: int) -> str:
        name = self.value(select)
        return _GIVEN.get(dotted(select) or "", (f"{name} is given", f"{name} is not given"))[side]

    def _quantified(self, typed: Quantifier, *, holds: bool) -> str:
        every = typed.universal is holds
        word = "every" if every else "some"
        return f"{word} `{typed.variable}` of {self.value(typed.domain)}: {self.truth(typed.predicate, holds=holds)}"

    def _applied(self, typed: Apply, *, holds: bool) -> str:
        side = 0 if holds else 1
        match typed.overload, typed.args:
            case "not", (only,):
                return self.truth(only, holds=not holds)
            case (("in_list" | "in_map"), (item, held)):
                return self._among(item, held, holds=holds)
            case name, (left, right) if name in _COMPARED:
                unit = left.unit or right.unit
                words = f"is {_COMPARED[name][side]}".rstrip()
                return f"{self.value(left, unit)} {words} {self.value(right, unit)}"
            case name, (left, right) if name in _TEXTS:
                return f"{self.value(left)} {_TEXTS[name][side]} {self.value(right)}"
            case _:
                return f"`{to_cel(typed)}` is {'true' if holds else 'false'}"

    def _among(self, item: Typed, held: Typed, *, holds: bool) -> str:
        if dotted(held) == "agent.permissions":
            return f"the agent {'holds' if holds else 'does not hold'} {self.value(item)}"
        words = "is" if holds else "is not"
        if isinstance(held, ListOf):
            return f"{self.value(item)} {words} {joined([self.value(element) for element in held.elements], 'or')}"
        return f"{self.value(item)} {words} in {self.value(held)}"

    # -- values -------------------------------------------------------------------------------------------------------

    def value(self, typed: Typed, unit: str | None = None) -> str:
        """Say a value; a bare number takes the unit of what it stands beside."""
        match typed:
            case Constant():
                return quantity(typed.value, unit)
            case ListOf():
                return joined([self.value(element, unit) for element in typed.elements], "and")
            case Conditional():
                then, otherwise = self.value(typed.then, unit), self.value(typed.otherwise, unit)
                return f"{then} where {self.truth(typed.condition, holds=True)}, else {otherwise}"
            case Select() | Variable():
                return self._worked_out(typed, self._name(typed))
            case Apply():
                return self._worked_out(typed, self._computed(typed))
            case _:
                return f"`{to_cel(typed)}`"

    def _name(self, typed: Select | Variable) -> str:
        path = dotted(typed) or to_cel(typed)
        return _VALUES.get(path, f"`{path.removeprefix('params.')}`")

    def _computed(self, typed: Apply) -> str:
        kind = typed.overload.rpartition("_")[0]
        match typed.args:
            case (Constant(value=float() as share), other) if kind == "multiply" and 0.0 < share < 1.0:
                return f"{100 * share:g} % of {self._inner(other)}"
            case (left, right) if kind in _JOINED:
                return f"{self._inner(left)} {_JOINED[kind]} {self._inner(right)}"
            case (only,) if typed.overload == "size":
                return f"the number of {self._inner(only)}"
            case (only,) if kind in ("double", "int"):
                return self._inner(only)
            case _:
                return f"`{to_cel(typed)}`"

    def _inner(self, typed: Typed) -> str:
        match typed:
            case Select() | Variable():
                return self._name(typed)
            case Apply():
                text = self._computed(typed)
                return f"({text})" if typed.overload.rpartition("_")[0] in _JOINED else text
            case _:
                return self.value(typed)

    def _worked_out(self, typed: Typed, words: str) -> str:
        """Put beside a value what it comes to, where the profile fixes it."""
        read = references(typed)
        if not read or any(path not in self.values for path in read):
            return words
        found = fold(typed, self.values)
        return f"{words} ({quantity(found.value, typed.unit)})" if isinstance(found, Constant) else words


def quantity(value: object, unit: str | None) -> str:
    """Write a number with its unit as people do, `0.25 m/s`, and a name as code."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return f"{value:g}" if unit in (None, "1") else f"{value:g} {unit}"
    return f"`{value}`"


def joined(parts: Sequence[str], word: str) -> str:
    """Join parts as a sentence does: `a, b and c`."""
    return f" {word} ".join(part for part in (", ".join(parts[:-1]), parts[-1]) if part) if parts else ""
