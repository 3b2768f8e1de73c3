"""Symbolic values: what an expression comes to, as cases under conditions, and what operations make of them.

What can be one of a few (the mass of one of six objects) is a list of constants, each under the condition that it is
that one; operations on constants are those of Python, so that nothing is lost. Only what really has a range becomes a
term of Z3: an integer, a text, and a double as a *real number*.

Reals and doubles. Every double is a real, and comparisons of doubles are comparisons of reals. What rounds is
arithmetic: `x op y` is the exact result times (1 + δ) plus η, |δ| ≤ 2⁻⁵³, |η| ≤ 2⁻¹⁰⁷⁵. It becomes a fresh term
within these bounds, which also keeps its side of every double it is compared with (rounding is monotone). So there are
more solutions than doubles have: what has none is proved, what has one must be confirmed by the real code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from math import frexp, isfinite
from typing import Final, TypeAlias, cast

import z3

from app.governance.expression_reach import INT_MAX, INT_MIN
from app.proofs.formulas import LAST_CHARACTER, Formula, both, either, every, no, rational, some, term, text

MOST_CASES: Final = 64
EXACT_INT: Final = 2**53
HALF: Final = 0.5  # the mantissa of a power of two
ROUNDING: Final = Fraction(1, 2**53)
SMALLEST: Final = Fraction(1, 2**1075)
OVERFLOW: Final = 2**1024 - 2**970  # from here on a double rounds to infinity

Constant: TypeAlias = bool | int | float | str


class NotCoveredError(Exception):
    """Something conditions can say, and proofs cannot reason about; what depends on it is undecided."""


@dataclass(frozen=True, slots=True)
class Items:
    """A list, whose elements are all there, or a set: each element under the condition that it is in it."""

    elements: tuple[tuple[Formula, Value], ...]


Payload: TypeAlias = "Constant | z3.ExprRef | Items"


@dataclass(frozen=True, slots=True)
class Value:
    """Cases whose conditions exclude one another and leave nothing out but where `error` holds.

    A truth value has one case, always, whose payload is a formula.
    """

    cases: tuple[tuple[Formula, Payload], ...]
    error: Formula = False

    @property
    def truth(self) -> Formula:
        """Return a truth value's formula; where `error` holds it means nothing."""
        return cast("Formula", self.cases[0][1])

    @property
    def holds(self) -> Formula:
        """Return where a truth value is true, and no error."""
        return both(self.truth, no(self.error))


def constant(value: Payload) -> Value:
    """Return the value that is always this."""
    return Value(((True, value),))


def truth(formula: Formula, error: Formula = False) -> Value:
    """Return a truth value."""
    return Value(((True, formula),), error)


def choice(options: Iterable[tuple[Formula, Payload]], error: Formula = False) -> Value:
    """Return a value by cases; equal constants become one case."""
    merged: dict[object, list[Formula]] = {}
    payloads: dict[object, Payload] = {}
    for guard, payload in options:
        key = _key(payload)
        payloads[key] = payload
        merged.setdefault(key, []).append(guard)
    cases = ((some(guards), payloads[key]) for key, guards in merged.items())
    return Value(tuple((guard, payload) for guard, payload in cases if guard is not False), error)


def _key(payload: Payload) -> object:
    if isinstance(payload, z3.ExprRef):
        return ("term", payload.get_id())
    return ("list", id(payload)) if isinstance(payload, Items) else (type(payload), payload)


def pick(condition: Formula, then: Value, otherwise: Value, boolean: bool) -> Value:
    """Return one value where a condition holds, else the other."""
    error = either(both(condition, then.error), both(no(condition), otherwise.error))
    if boolean:
        return truth(either(both(condition, then.truth), both(no(condition), otherwise.truth)), error)
    options = [(both(condition, guard), payload) for guard, payload in then.cases]
    return choice([*options, *((both(no(condition), guard), payload) for guard, payload in otherwise.cases)], error)


def lift(payload: Payload, *, real: bool = False) -> z3.ExprRef:
    """Return a constant as a term; `real` makes a number one of the reals."""
    if isinstance(payload, z3.ExprRef):
        return payload
    if isinstance(payload, bool):
        return term(payload)
    if isinstance(payload, str):
        if max(map(ord, payload), default=0) > LAST_CHARACTER:
            raise NotCoveredError("a character beyond what the solver knows")
        return text(payload)
    if isinstance(payload, (int, float)):
        return rational(payload) if real or isinstance(payload, float) else z3.IntVal(payload)
    raise NotCoveredError("a list inside a list")


Outcome: TypeAlias = "tuple[Payload, Formula]"


class Theory:
    """What operations mean, and the facts about the terms they introduce; one for everything proved together."""

    def __init__(self) -> None:
        """Begin without facts."""
        self.facts: list[z3.BoolRef] = []
        self.approximate = False  # whether some term may be more than doubles are
        self.exactly: list[z3.BoolRef] = []  # where nothing was rounded
        self._rounded: dict[int, tuple[z3.ArithRef, z3.ArithRef]] = {}  # id of the exact term → itself, as rounded
        self._exact: dict[int, z3.ArithRef] = {}  # id of the rounded term → the exact one
        self._named: list[tuple[z3.ArithRef, z3.ArithRef]] = []
        self._sided: set[tuple[int, float]] = set()

    # Rounding --------------------------------------------------------------------------------------------------------

    def rounded(self, exact: z3.ArithRef) -> z3.ArithRef:
        """Return the double next to an exact result: always the same for the same result."""
        found = self._rounded.get(exact.get_id())
        if found is not None:
            return found[1]
        self.approximate = True
        named, near = z3.FreshReal("exact"), z3.FreshReal("rounded")
        slack = rational(ROUNDING) * z3.If(named >= 0, named, -named) + rational(SMALLEST)
        self.facts += [named == exact, near - named <= slack, named - near <= slack]
        self.exactly.append(near == named)
        self._rounded[exact.get_id()] = (exact, near)
        self._exact[near.get_id()] = named
        self._named.append((near, named))
        return near

    def rounding(self) -> Mapping[int, z3.ArithRef]:
        """Return for each exact result, by its term's id, the rounded one."""
        return {named.get_id(): near for near, named in self._named}

    def _side(self, left: z3.ExprRef, right: Payload) -> None:
        """Rounding is monotone and leaves doubles alone: what is rounded keeps its side of any double."""
        named = self._exact.get(left.get_id())
        if named is None or not isinstance(right, float) or (left.get_id(), right) in self._sided:
            return
        self._sided.add((left.get_id(), right))
        bound, near = rational(right), cast("z3.ArithRef", left)
        self.facts += [z3.Implies(named <= bound, near <= bound), z3.Implies(named >= bound, near >= bound)]

    # Operations ------------------------------------------------------------------------------------------------------

    def apply(self, overload: str, args: tuple[Value, ...], *, checked: bool, wide: bool) -> Value:
        """Return what an operation makes of its arguments' cases.

        Args:
            overload: Name of the row of `OVERLOADS`.
            args: The arguments.
            checked: Whether the operation itself may leave its type's range.
            wide: Whether an integer argument may be beyond 2⁵³.
        """
        error = some(arg.error for arg in args)
        size = 1
        for arg in args:
            size *= len(arg.cases)
        sets = [arg.cases if size <= MOST_CASES else self._joined(arg) for arg in args]
        results: list[tuple[Formula, Payload]] = []
        errors: list[Formula] = [error]
        for combination in product(*sets):
            guard = every(case[0] for case in combination)
            if guard is False:
                continue
            payload, fails = self._result(overload, [case[1] for case in combination], checked, wide)
            results.append((both(guard, no(fails)), payload))
            errors.append(both(guard, fails))
        if overload in _TRUTHS:
            return truth(some(both(guard, cast("Formula", payload)) for guard, payload in results), some(errors))
        return choice(results, some(errors))

    def _joined(self, value: Value) -> tuple[tuple[Formula, Payload], ...]:
        """Return a value of many cases as one term."""
        if len(value.cases) <= 1 or any(isinstance(payload, Items) for _, payload in value.cases):
            return value.cases
        real = any(isinstance(payload, float) or _is_real(payload) for _, payload in value.cases)
        joined = lift(value.cases[-1][1], real=real)
        for guard, payload in value.cases[:-1]:
            joined = z3.If(term(guard), lift(payload, real=real), joined)
        return ((True, joined),)

    def _result(self, overload: str, payloads: list[Payload], checked: bool, wide: bool) -> Outcome:
        if overload in _COMPARISONS:
            return self.compare(overload, payloads[0], payloads[1]), False
        if overload in _TEXTS:
            return _text(overload, payloads), False
        if overload.endswith("_lists"):
            equal = self._equal_lists(cast("Items", payloads[0]), cast("Items", payloads[1]))
            return (cast("Payload", equal if overload == "equal_lists" else no(equal))), False
        operation = _OPERATIONS.get(overload)
        if operation is None:
            raise NotCoveredError(f"`{overload}`")
        return operation(self, payloads, checked, wide)

    def compare(self, overload: str, left: Payload, right: Payload) -> Formula:
        """Return where a comparison of two scalars holds."""
        if not isinstance(left, z3.ExprRef) and not isinstance(right, z3.ExprRef):
            return _COMPARISONS[overload](left, right)
        if isinstance(left, bool) or isinstance(right, bool) or z3.is_bool(left):
            equal = term(cast("Formula", left)) == term(cast("Formula", right))
            return equal if overload == "equal" else z3.Not(equal)
        for one, other in ((left, right), (right, left)):
            if isinstance(one, z3.ExprRef):
                self._side(one, other)
        one, other = lift(left), lift(right)
        if z3.is_string(one) and overload in _REVERSED:  # the solver knows its way about `<` of texts alone
            return no(cast("Formula", _COMPARISONS[_REVERSED[overload]](one, other)))
        return _COMPARISONS[overload](one, other)

    def _equal_lists(self, left: Items, right: Items) -> Formula:
        if len(left.elements) != len(right.elements):
            return False
        pairs = zip(left.elements, right.elements, strict=True)
        return every(self._equal(one, other) for (_, one), (_, other) in pairs)

    def _equal(self, one: Value, other: Value) -> Formula:
        return self.apply("equal", (one, other), checked=False, wide=False).truth

    def contains(self, held: Items, value: Value) -> Formula:
        """Return where a value is in a list."""
        return some(both(guard, self._equal(value, element)) for guard, element in held.elements)

    # Arithmetic ------------------------------------------------------------------------------------------------------

    def _whole(self, made: int | z3.ExprRef, checked: bool) -> Outcome:
        if isinstance(made, int):
            return made, not INT_MIN <= made <= INT_MAX
        number = cast("z3.ArithRef", made)
        return number, either(number < INT_MIN, number > INT_MAX) if checked else False

    def _real(self, made: float | z3.ExprRef, checked: bool) -> Outcome:
        if isinstance(made, float):
            return made, not isfinite(made)
        exact = cast("z3.ArithRef", made)
        limit = rational(Fraction(OVERFLOW))
        return self.rounded(exact), either(exact >= limit, exact <= -limit) if checked else False


_Operation: TypeAlias = "Callable[[Theory, list[Payload], bool, bool], Outcome]"


def _is_real(payload: Payload) -> bool:
    return isinstance(payload, z3.ArithRef) and payload.is_real()


def _constants(payloads: list[Payload]) -> bool:
    return not any(isinstance(payload, z3.ExprRef) for payload in payloads)


def _arithmetic(operate: Callable[[object, object], object], whole: bool) -> _Operation:
    def made(theory: Theory, payloads: list[Payload], checked: bool, _wide: bool) -> Outcome:
        left, right = payloads if _constants(payloads) else [lift(payload) for payload in payloads]
        found = cast("int | float | z3.ExprRef", operate(left, right))
        return theory._whole(cast("int", found), checked) if whole else theory._real(cast("float", found), checked)  # pyright: ignore[reportPrivateUsage]

    return made


_rounding_product: Final = _arithmetic(lambda a, b: a * b, whole=False)  # type: ignore[operator]  # pyright: ignore[reportOperatorIssue]


def _multiply_double(theory: Theory, payloads: list[Payload], checked: bool, wide: bool) -> Outcome:
    """Multiply; by a power of two of one or more nothing is rounded, only the exponent grows."""
    powers = [payload for payload in payloads if isinstance(payload, float) and _doubling(payload)]
    if not powers or _constants(payloads):
        return _rounding_product(theory, payloads, checked, wide)
    left, right = (cast("z3.ArithRef", lift(payload)) for payload in payloads)
    limit = rational(Fraction(OVERFLOW))
    exact = left * right
    return exact, either(exact >= limit, exact <= -limit) if checked else False


def _doubling(factor: float) -> bool:
    return abs(factor) >= 1.0 and abs(frexp(factor)[0]) == HALF


def _divide_double(theory: Theory, payloads: list[Payload], checked: bool, _wide: bool) -> Outcome:
    left, right = payloads
    zero = cast("z3.ArithRef", right) == 0 if isinstance(right, z3.ExprRef) else right == 0
    if zero is True:
        return 0.0, True
    if _constants(payloads):
        return theory._real(cast("float", left) / cast("float", right), checked)  # pyright: ignore[reportPrivateUsage]
    exact = cast("z3.ArithRef", lift(left)) / cast("z3.ArithRef", lift(right))
    made, fails = theory._real(exact, checked)  # pyright: ignore[reportPrivateUsage]
    return made, either(zero, fails)


def _quotient(payloads: list[Payload]) -> tuple[int | z3.ExprRef, Formula]:
    """Divide integers towards zero, as CEL does; beside it, where the divisor is zero."""
    left, right = payloads
    if isinstance(left, int) and isinstance(right, int):
        if not right:
            return 0, True
        magnitude = abs(left) // abs(right)
        return (magnitude if (left < 0) == (right < 0) else -magnitude), False
    a, b = cast("z3.ArithRef", lift(left)), cast("z3.ArithRef", lift(right))
    magnitude = z3.If(a < 0, -a, a) / z3.If(b < 0, -b, b)
    zero = False if isinstance(right, int) and right else b == 0
    return z3.If((a < 0) == (b < 0), magnitude, -magnitude), zero


def _divide_int(theory: Theory, payloads: list[Payload], _checked: bool, _wide: bool) -> Outcome:
    quotient, zero = _quotient(payloads)
    made, fails = theory._whole(cast("int", quotient), checked=True)  # pyright: ignore[reportPrivateUsage]
    return made, either(zero, fails)


def _remainder(theory: Theory, payloads: list[Payload], checked: bool, wide: bool) -> Outcome:
    quotient, fails = _divide_int(theory, payloads, checked, wide)
    if _constants(payloads):
        left, right = cast("list[int]", payloads)
        return left - right * cast("int", quotient), fails
    left, right = (cast("z3.ArithRef", lift(payload)) for payload in payloads)
    return left - right * cast("z3.ArithRef", lift(quotient)), fails


def _negate(theory: Theory, payloads: list[Payload], checked: bool, _wide: bool) -> Outcome:
    (value,) = payloads
    if isinstance(value, float) or _is_real(value):
        return -cast("float", value), False
    return theory._whole(-cast("int", value), checked)  # pyright: ignore[reportPrivateUsage]


def _double_int(theory: Theory, payloads: list[Payload], _checked: bool, wide: bool) -> Outcome:
    (value,) = payloads
    if isinstance(value, int):
        return float(value), False
    exact = z3.ToReal(cast("z3.ArithRef", value))
    return (theory.rounded(exact) if wide else exact), False


def _int_double(theory: Theory, payloads: list[Payload], checked: bool, _wide: bool) -> Outcome:
    (value,) = payloads
    if isinstance(value, float):
        return theory._whole(int(value), checked)  # pyright: ignore[reportPrivateUsage]
    number = cast("z3.ArithRef", value)
    return theory._whole(z3.If(number >= 0, z3.ToInt(number), -z3.ToInt(-number)), checked)  # pyright: ignore[reportPrivateUsage]


def _same(_theory: Theory, payloads: list[Payload], _checked: bool, _wide: bool) -> Outcome:
    return payloads[0], False


def _size(_theory: Theory, payloads: list[Payload], _checked: bool, _wide: bool) -> Outcome:
    (value,) = payloads
    if isinstance(value, str):
        return len(value), False
    if not isinstance(value, Items):
        return z3.Length(cast("z3.SeqRef", value)), False
    certain = sum(guard is True for guard, _ in value.elements)
    maybe = [z3.If(term(guard), 1, 0) for guard, _ in value.elements if guard is not True]
    return (z3.Sum(*maybe) + certain if maybe else certain), False


def _text(overload: str, payloads: list[Payload]) -> Payload:
    left, right = payloads
    if isinstance(left, str) and isinstance(right, str):
        return {"starts_with": left.startswith, "ends_with": left.endswith, "contains": left.__contains__}[overload](
            right
        )
    return _TEXTS[overload](lift(left), lift(right))


_COMPARISONS: Final[Mapping[str, Callable[[object, object], bool]]] = {
    "equal": lambda a, b: a == b,
    "unequal": lambda a, b: a != b,
    "less": lambda a, b: a < b,  # type: ignore[operator]  # pyright: ignore[reportOperatorIssue]
    "at_most": lambda a, b: a <= b,  # type: ignore[operator]  # pyright: ignore[reportOperatorIssue]
    "greater": lambda a, b: b < a,  # type: ignore[operator]  # pyright: ignore[reportOperatorIssue]
    "at_least": lambda a, b: a >= b,  # type: ignore[operator]  # pyright: ignore[reportOperatorIssue]
}
_TEXTS: Final[Mapping[str, Callable[[z3.ExprRef, z3.ExprRef], z3.BoolRef]]] = {
    "starts_with": lambda text, start: z3.PrefixOf(start, text),
    "ends_with": lambda text, end: z3.SuffixOf(end, text),
    "contains": z3.Contains,
}
_REVERSED: Final[Mapping[str, str]] = {"at_most": "greater", "at_least": "less"}
_TRUTHS: Final = frozenset({*_COMPARISONS, *_TEXTS, "equal_lists", "unequal_lists"})
_OPERATIONS: Final[Mapping[str, _Operation]] = {
    "add_int": _arithmetic(lambda a, b: a + b, whole=True),  # type: ignore[operator]  # pyright: ignore[reportOperatorIssue]
    "subtract_int": _arithmetic(lambda a, b: a - b, whole=True),  # type: ignore[operator]  # pyright: ignore[reportOperatorIssue]
    "multiply_int": _arithmetic(lambda a, b: a * b, whole=True),  # type: ignore[operator]  # pyright: ignore[reportOperatorIssue]
    "add_double": _arithmetic(lambda a, b: a + b, whole=False),  # type: ignore[operator]  # pyright: ignore[reportOperatorIssue]
    "subtract_double": _arithmetic(lambda a, b: a - b, whole=False),  # type: ignore[operator]  # pyright: ignore[reportOperatorIssue]
    "multiply_double": _multiply_double,
    "divide_double": _divide_double,
    "divide_int": _divide_int,
    "remainder_int": _remainder,
    "negate_int": _negate,
    "negate_double": _negate,
    "double_int": _double_int,
    "double_double": _same,
    "int_double": _int_double,
    "int_int": _same,
    "size": _size,
}
