"""Conditions against CEL's own evaluator, and against themselves with every check left in."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

import celpy
import pytest
from celpy.evaluation import CELEvalError
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from app.governance.errors import EvaluationError, ExpressionError
from app.governance.expression import MAX_QUANTIFIERS, check, declare
from app.governance.expression_code import INTRINSICS, to_python
from app.governance.expression_syntax import parse
from app.governance.expression_tree import (
    BOOL,
    DOUBLE,
    INT,
    OVERLOADS,
    STRING,
    Apply,
    Constant,
    Field,
    ListType,
    MapType,
    RecordType,
    Select,
    children,
    references,
)
from app.governance.expression_value import compile_condition

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from app.governance.expression_syntax import Syntax
    from app.governance.expression_tree import Type, Typed

INTS, DOUBLES, STRINGS = ListType(INT), ListType(DOUBLE), ListType(STRING)
AREA = RecordType(
    name="area",
    fields={"shared": Field(BOOL), "limit": Field(DOUBLE, required=False), "floor": Field(INT, required=False)},
)
TARGET = RecordType(
    name="target",
    fields={
        "fragile": Field(BOOL),
        "count": Field(INT),
        "mass": Field(DOUBLE, required=False),
        "label": Field(STRING, required=False),
        "area": Field(AREA, required=False),
        "tags": Field(STRINGS, required=False),
    },
)
VARIABLES: dict[str, Field] = {
    "b": Field(BOOL),
    "i": Field(INT),
    "small": Field(INT, within=1000),
    "d": Field(DOUBLE),
    "force": Field(DOUBLE, within=140),
    "s": Field(STRING),
    "li": Field(INTS),
    "ld": Field(DOUBLES),
    "ls": Field(STRINGS),
    "m": Field(MapType(DOUBLE)),
    "target": Field(TARGET),
    "areas": Field(ListType(AREA)),
}
ENV = declare(VARIABLES)
WORDS = ("", "a", "ab", "b", "it's", 'a"b', "é\n", "\\")


# -- random well-typed sources -----------------------------------------------------------------------------------------


def _quote(word: str) -> str:
    return "'" + word.replace("\\", "\\\\").replace("'", "\\'").replace("\n", "\\n") + "'"


SCALAR_LITERALS = {
    BOOL: st.sampled_from(["true", "false"]),
    INT: st.one_of(st.integers(-4, 4), st.sampled_from([2**63 - 1, -(2**63), 1000])).map(str),
    DOUBLE: st.sampled_from(["0.0", "0.5", "1.0", "-2.5", "1e3", "1e3", "2.0", "0.1", "1e308"]),
    STRING: st.sampled_from(WORDS).map(_quote),
}
READS = {
    BOOL: ["b", "target.fragile", "target.area.shared", "has(target.mass)", "has(target.area)", "has(m.a)",
           "has(target.area.limit)", "has(target.tags)"],
    INT: ["i", "small", "target.count", "target.area.floor", "size(li)", "s.size()", "size(m)"],
    DOUBLE: ["d", "force", "target.mass", "target.area.limit", "m.a", "m['ab']"],
    STRING: ["s", "target.label"],
    INTS: ["li"],
    DOUBLES: ["ld"],
    STRINGS: ["ls", "target.tags"],
}  # fmt: skip
GUARDED = (
    "has(target.mass) && target.mass > {d}",
    "!has(target.mass) || target.mass <= {d}",
    "(has(target.mass) ? target.mass : {d}) < {d}",
    "has(target.area) && has(target.area.limit) && target.area.limit < {d}",
    "has(target.area.limit) && target.area.limit < {d}",
    "!(!has(target.mass) || {b}) && target.mass > {d}",
    "!has(target.tags) || target.tags.exists(tag, tag == {s})",
    "{s} in m && m[{s}] > {d}",
    "has(m.a) && {b} && m.a + {d} > {d}",
    "areas.exists(spot, has(spot.limit) && spot.limit < {d})",
    "areas.all(spot, spot.limit > {d} || spot.shared)",
    "force * 2 > 100",
    "({d} < 3 || d in [1, 2.5])",
    "m.exists(key, m[key] > {d})",
    "m.all(key, key in m && m[key] > {d})",
)


class Sources:
    """Draws sources that type-check, by construction."""

    def __init__(self, draw: Callable[[st.SearchStrategy[object]], object]) -> None:
        self.draw = draw

    def pick(self, options: list[str] | tuple[str, ...]) -> str:
        return str(self.draw(st.sampled_from(options)))

    def of(self, kind: Type, depth: int, bound: Mapping[str, Type]) -> str:
        if depth <= 0 or self.draw(st.integers(0, 5)) == 0:
            return self.leaf(kind, bound)
        if isinstance(kind, ListType):
            return self.list_of(kind, depth, bound)
        if self.draw(st.integers(0, 9)) == 0:
            parts = (self.of(BOOL, depth - 1, bound), self.of(kind, depth - 1, bound), self.of(kind, depth - 1, bound))
            return "({} ? {} : {})".format(*parts)
        return {BOOL: self.bool, INT: self.int, DOUBLE: self.double, STRING: self.string}[kind](depth - 1, bound)

    def leaf(self, kind: Type, bound: Mapping[str, Type]) -> str:
        reads = [*READS[kind], *(name for name, held in bound.items() if held == kind)]
        if isinstance(kind, ListType) or self.draw(st.booleans()):
            return self.pick(reads)
        return str(self.draw(SCALAR_LITERALS[kind]))

    def list_of(self, kind: ListType, depth: int, bound: Mapping[str, Type]) -> str:
        size = self.draw(st.integers(1, 3))
        return "[" + ", ".join(self.of(kind.element, depth - 1, bound) for _ in range(size)) + "]"

    def bool(self, depth: int, bound: Mapping[str, Type]) -> str:
        plain = ("logic", "logic", "compare", "compare", "compare", "not", "in", "text", "lists")
        form = self.pick(plain if len(bound) == MAX_QUANTIFIERS else (*plain, "quantifier", "guarded", "guarded"))
        of = functools.partial(self.of, depth=depth, bound=bound)
        kind = self.draw(st.sampled_from([INT, DOUBLE, STRING]))
        held = {INT: INTS, DOUBLE: DOUBLES, STRING: STRINGS}[kind]
        match form:
            case "logic":
                word = self.pick(("&&", "||"))
                return "(" + f" {word} ".join(of(BOOL) for _ in range(self.draw(st.integers(2, 4)))) + ")"
            case "compare":
                return f"({of(kind)} {self.pick(('<', '<=', '>', '>=', '==', '!='))} {of(kind)})"
            case "not":
                return f"!({of(BOOL)})"
            case "in":
                return f"({of(kind)} in {of(held)})"
            case "text":
                return f"({of(STRING)}).{self.pick(('startsWith', 'endsWith', 'contains'))}({of(STRING)})"
            case "lists":
                return f"({of(held)} {self.pick(('==', '!='))} {of(held)})"
            case "guarded":
                holes = {"b": BOOL, "d": DOUBLE, "s": STRING}
                return f"({self.pick(GUARDED).format(**{h: self.leaf(k, bound) for h, k in holes.items()})})"
            case _:
                name = f"each{len(bound)}"
                predicate = self.of(BOOL, depth, {**bound, name: kind})
                return f"({of(held)}).{self.pick(('exists', 'all'))}({name}, {predicate})"

    def int(self, depth: int, bound: Mapping[str, Type]) -> str:
        of = functools.partial(self.of, depth=depth, bound=bound)
        match self.pick(("+", "-", "*", "/", "%", "minus", "size", "int", "index")):
            case "minus":
                return f"-({of(INT)})"
            case "size":
                return f"size({of(self.draw(st.sampled_from([INTS, STRINGS, STRING])))})"
            case "int":
                return f"int({of(self.draw(st.sampled_from([INT, DOUBLE])))})"
            case "index":
                return f"({of(INTS)})[{self.index(depth, bound)}]"
            case operator:
                return f"({of(INT)} {operator} {of(INT)})"

    def double(self, depth: int, bound: Mapping[str, Type]) -> str:
        of = functools.partial(self.of, depth=depth, bound=bound)
        match self.pick(("+", "-", "*", "/", "minus", "double", "index")):
            case "minus":
                return f"-({of(DOUBLE)})"
            case "double":
                return f"double({of(INT)})"
            case "index":
                return f"({of(DOUBLES)})[{self.index(depth, bound)}]"
            case operator:
                return f"({of(DOUBLE)} {operator} {of(DOUBLE)})"

    def string(self, depth: int, bound: Mapping[str, Type]) -> str:
        of = functools.partial(self.of, depth=depth, bound=bound)
        return f"({of(STRINGS)})[{self.index(depth, bound)}]"

    def index(self, depth: int, bound: Mapping[str, Type]) -> str:
        return self.pick(("0", "0", "0", "1", "1", "2", self.of(INT, depth, bound)))


# -- random bindings ---------------------------------------------------------------------------------------------------

WORD = st.sampled_from(WORDS)
SMALL, WIDE = st.integers(-3, 3), st.integers(-(2**63), 2**63 - 1)
INTEGER = st.one_of(SMALL, SMALL, SMALL, WIDE, st.sampled_from([2**63 - 1, -(2**63)]))
ROUND = st.sampled_from([0.0, -0.0, 0.5, 1.0, -2.5, 3.0, 1e3])
FLOAT = st.one_of(
    ROUND, ROUND, st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(allow_nan=False, allow_infinity=False)
)
AREAS = st.fixed_dictionaries({"shared": st.booleans()}, optional={"limit": FLOAT, "floor": INTEGER})
BINDINGS: dict[str, st.SearchStrategy[object]] = {
    "b": st.booleans(),
    "i": INTEGER,
    "small": st.integers(-1000, 1000),
    "d": FLOAT,
    "force": st.floats(-140, 140),
    "s": WORD,
    "li": st.lists(INTEGER, max_size=3),
    "ld": st.lists(FLOAT, max_size=3),
    "ls": st.lists(WORD, max_size=3),
    "m": st.dictionaries(st.sampled_from(["a", "ab", "b"]), FLOAT),
    "target": st.fixed_dictionaries(
        {"fragile": st.booleans(), "count": INTEGER},
        optional={"mass": FLOAT, "label": WORD, "area": AREAS, "tags": st.lists(WORD, max_size=3)},
    ),
    "areas": st.lists(AREAS, max_size=3),
}


class Case(NamedTuple):
    """A condition and eight sets of values for the variables it reads."""

    source: str
    typed: Typed
    rows: list[dict[str, object]]


def variables(typed: Typed) -> list[str]:
    return sorted({path.split(".")[0] for path in references(typed)})


@st.composite
def cases(draw: Callable[[st.SearchStrategy[object]], object]) -> Case:
    source = Sources(draw).bool(draw(st.integers(1, 3)), {})
    typed = check(parse(source), ENV)
    bindings = st.fixed_dictionaries({name: BINDINGS[name] for name in variables(typed)})
    return Case(source, typed, [draw(bindings) for _ in range(8)])


Outcome = bool | str
"""The truth value, or "error"."""


def outcome(evaluate: Callable[[], object]) -> Outcome:
    try:
        result = evaluate()
    except EvaluationError:
        return "error"
    assert isinstance(result, bool)
    return result


# -- against CEL's own evaluator ---------------------------------------------------------------------------------------

CEL = celpy.Environment()
NOTED: list[str] = []
"""What went wrong anywhere in the evaluation under way, also where a deciding operand made up for it."""


def _noting(intrinsic: Callable[..., object]) -> Callable[..., object]:
    def noted(*args: object) -> object:
        try:
            return intrinsic(*args)
        except EvaluationError as error:
            NOTED.append(f"{intrinsic.__name__} {error.code} {error.detail}")
            raise

    return noted


NOTING = {name: _noting(f) if name.startswith("_cel_") else f for name, f in INTRINSICS.items()}


def unproved(typed: Typed) -> Typed:
    """The same tree as if nothing had been proved: every check that exists is made."""
    changes: dict[str, object] = {"can_fail": True}
    for field in dataclasses.fields(typed):
        part = getattr(typed, field.name)
        if isinstance(part, tuple):
            changes[field.name] = tuple(unproved(each) for each in part)
        elif dataclasses.is_dataclass(part) and hasattr(part, "can_fail"):
            changes[field.name] = unproved(part)
    if isinstance(typed, Select):
        changes["checked"] = not typed.record.type.fields[typed.name].required
    elif isinstance(typed, Apply):
        changes["checked"] = bool(
            next(r for rows in OVERLOADS.values() for r in rows if r.name == typed.overload).checked
        )
    return dataclasses.replace(typed, **changes)


def compiled(typed: Typed, intrinsics: Mapping[str, object] = INTRINSICS) -> Callable[..., object]:
    names = variables(typed)
    text = f"lambda {', '.join(names)}: {to_python(typed, {name: name for name in names})}"
    return eval(text, {"__builtins__": {}, **intrinsics})  # noqa: S307


def promotes(source: str, typed: Typed) -> bool:
    """Whether an int literal was made a double; CEL itself would not compare the two."""

    def ints(part: Syntax) -> int:
        return (type(part.value) is int) + sum(map(ints, part.parts))

    def int_constants(node: Typed) -> int:
        own = isinstance(node, Constant) and node.type is INT
        return own + sum(map(int_constants, children(node)))

    return ints(parse(source).root) != int_constants(typed)


# Where cel-python is not followed, by name: what has to be in the source, and what has to have gone wrong anywhere in
# the evaluation. An evaluation that touches one is not compared. docs/design/expressions.md says for each who is right.
EXCLUDED = {
    "double divided by zero": ("/", re.compile(r"_divide division_by_zero")),
    "double out of range": ("", re.compile(r"(_divide|finite) not_finite")),
    "least int % -1": ("%", re.compile(r"_remainder overflow")),
    "negative index": ("[", re.compile(r"_element index_out_of_range `-")),
    "has() inside an absent record": ("has(target.area.limit)", re.compile(r"_present absent `target.area`")),
}


def exclusion(source: str) -> str | None:
    noted = "\n".join(NOTED)
    return next((name for name, (text, error) in EXCLUDED.items() if text in source and error.search(noted)), None)


def cel_outcome(program: celpy.Runner, row: Mapping[str, object]) -> Outcome:
    try:
        return bool(program.evaluate({name: celpy.json_to_cel(value) for name, value in row.items()}))
    except CELEvalError:
        return "error"


def settled(examples: int) -> settings:
    """The same examples in every run; nothing is shrunk, what failed is reported as it was drawn."""
    return settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )


def test_agrees_with_cel_python_on_five_thousand_evaluations() -> None:
    tally: Counter[str] = Counter()

    @settled(850)
    @given(cases())
    def compare(case: Case) -> None:
        if promotes(case.source, case.typed):
            tally["excluded: int literal beside a double"] += len(case.rows)
            return
        # with nothing proved and every operand evaluated, NOTED holds every fault cel-python could have met
        evaluate = compiled(unproved(case.typed), NOTING)
        program = CEL.program(CEL.compile(case.source))
        for row in case.rows:
            NOTED.clear()
            ours = outcome(lambda row=row: evaluate(**row))
            excluded = exclusion(case.source)
            if excluded:
                tally[f"excluded: {excluded}"] += 1
                continue
            assert cel_outcome(program, row) == ours, (case.source, row)
            tally["compared"] += 1
            tally[f"compared: {ours}"] += 1

    compare()
    print(dict(tally))
    assert tally["compared"] >= 5000
    assert min(tally[f"compared: {each}"] for each in (True, False, "error")) >= 300


# -- against itself ----------------------------------------------------------------------------------------------------


def test_what_is_proved_changes_no_outcome_and_what_cannot_fail_never_raises() -> None:
    """With values `conform` accepts, only `EvaluationError` is raised, and only where `can_fail` says so."""
    tally: Counter[str] = Counter()

    @settled(500)
    @given(cases())
    def compare(case: Case) -> None:
        alone, inlined, cautious = compile_condition(case.typed), compiled(case.typed), compiled(unproved(case.typed))
        for row in case.rows:
            ours = outcome(lambda row=row: inlined(**row))
            assert ours == outcome(lambda row=row: cautious(**row)) == outcome(lambda row=row: alone(row))
            assert case.typed.can_fail or ours != "error"
            tally[f"can fail {case.typed.can_fail}, {ours}"] += 1

    compare()
    assert len(tally) == 5
    assert min(tally.values()) >= 100


@pytest.mark.parametrize("spoiled", [math.nan, math.inf, -math.inf, 10**400, "2", None, True, [1.0], {}])
def test_a_value_that_is_no_finite_double_is_an_error_and_never_a_truth_value(spoiled: object) -> None:
    @settled(60)
    @given(st.sampled_from(["d > 5.0", "!(d > 5.0)", "d == d", "d != d", "d in [1.0]", "d > 5.0 ? true : false"]))
    def evaluate(source: str) -> None:
        condition = compile_condition(check(parse(source), ENV))
        with pytest.raises(EvaluationError):
            condition({"d": spoiled})

    evaluate()


# -- garbage -----------------------------------------------------------------------------------------------------------

# fmt: off
TOKENS = (
    "target", ".", "fragile", "d", "i", "li", "(", ")", "[", "]", "&&", "||", "!", "-", "+", "/", "==", "<", "in", "?",
    ":", ",", "has", "size", "exists", "all", "1", "2.5", "'a'", "true", "null", "__class__", "lambda", "\\", '"', " ",
    "0x1", "1u", "//", "{", "}", "@", "é", "\ud800", "1e999", "99999999999999999999",
)
# fmt: on


@settled(400)
@given(st.one_of(st.text(max_size=60), st.lists(st.sampled_from(TOKENS), max_size=25).map(" ".join)))
def test_garbage_is_an_expression_error_and_nothing_else(source: str) -> None:
    try:
        typed = check(parse(source), ENV)
    except ExpressionError as error:
        where = (error.source, 1 <= error.column <= len(source) + 1)
        assert where == (source, True)  # most garbage is refused, some is not
    else:
        assert typed.type is BOOL


@settled(300)
@given(st.text(max_size=30))
def test_text_in_a_condition_stays_text(word: str) -> None:
    quoted = "".join(f"\\u{ord(c):04x}" if ord(c) < 0xD800 else "?" for c in word)
    typed = check(parse(f"s == '{quoted}'"), ENV)
    plain = "".join(c if ord(c) < 0xD800 else "?" for c in word)
    assert compiled(typed)(s=plain) is True
    assert compiled(typed)(s=plain + "x") is False
