"""Conditions: what they mean, what is refused on load, what is an error, what is emitted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest

from app.governance.errors import DeclarationError, EvaluationError, ExpressionError
from app.governance.expression import check, declare
from app.governance.expression_code import to_python
from app.governance.expression_syntax import MAX_DEPTH, MAX_SOURCE, parse
from app.governance.expression_tree import (
    BOOL,
    DOUBLE,
    INT,
    STRING,
    Apply,
    Constant,
    Field,
    ListType,
    Logic,
    MapType,
    RecordType,
    Select,
    SetType,
    Typed,
    children,
    references,
)
from app.governance.expression_value import compile_condition, conform

BIG = 2**63 - 1

HOLDER = RecordType(name="holder", fields={"grip": Field(DOUBLE, required=False)})
TARGET = RecordType(
    name="target",
    fields={
        "fragile": Field(BOOL),
        "weight_kg": Field(DOUBLE, required=False, unit="kg"),
        "holder": Field(HOLDER, required=False),
    },
)
PERSON = RecordType(
    name="person", fields={"distance_m": Field(DOUBLE, unit="m"), "name": Field(STRING, required=False)}
)
SENSED = RecordType(
    name="sensed", fields={"force_n": Field(DOUBLE), "slip": Field(BOOL, required=False)}, attributes=True
)
ENV = declare(
    {
        "target": TARGET,
        "people": ListType(PERSON),
        "sensed": SENSED,
        "force_n": Field(DOUBLE, unit="N", within=140),
        "speed_mps": Field(DOUBLE, unit="m/s"),
        "d": DOUBLE,
        "i": INT,
        "small": Field(INT, within=100),
        "b": BOOL,
        "s": STRING,
        "li": ListType(INT),
        "ld": ListType(DOUBLE),
        "ls": ListType(STRING),
        "limits": Field(MapType(DOUBLE), unit="N", within=500),
        "colour": Field(STRING, among=frozenset({"red", "green"})),
        "held": Field(SetType(STRING), among=frozenset({"red", "green"})),
        "colours": Field(ListType(STRING), among=frozenset({"red", "green"})),
    }
)
VALUES: dict[str, object] = {
    "target": {"fragile": True},
    "people": [{"distance_m": 0.5, "name": "a"}, {"distance_m": 2.0}],
    "sensed": SimpleNamespace(force_n=3.0, slip=None),
    "force_n": 40.0,
    "speed_mps": 0.3,
    "d": 2.5,
    "i": 7,
    "small": 5,
    "b": True,
    "s": "grasp_object",
    "li": [1, 2, 3],
    "ld": [0.5, 1.5],
    "ls": ["a", "b"],
    "limits": {"grip": 60.0, "touch": 100.0},
    "colour": "red",
    "held": {"red"},
    "colours": ["red"],
}


def checked(source: str) -> Typed:
    return check(parse(source), ENV)


def evaluate(source: str, **values: object) -> bool:
    return compile_condition(checked(source))({**VALUES, **values})


def text(source: str) -> str:
    return to_python(checked(source), {name: name for name in ENV.variables})


# -- meaning ---------------------------------------------------------------------------------------------------------

TRUE = """
true
!false
colour == "red" && colour != "green" && "red" in colours && colour in ["red", "green"]
force_n / force_n + 1.0 > 1.0 && force_n + force_n * 0.5 == 60.0 && force_n * d - force_n * 2.0 > 0.0
force_n - (b ? force_n : force_n * 2.0) == 0.0 && force_n + (b ? d : 1.0) > 1.0
b && i > 6 && d < 3
false || b
b ? true : false
(b ? 1 : 2) == 1
(b ? 1 : d) == 1.0
i + 1 == 8 && i - 9 == -2 && i * 2 == 14
-7 / 2 == -3 && 7 / -2 == -3 && -7 / -2 == 3
-7 % 3 == -1 && 7 % -3 == 1
d / 2 == 1.25
-d == -2.5
-(-5) == 5
1 + 2 * 3 == 7
(1 + 2) * 3 == 9
2 - 1 - 1 == 0
d > 2 && 2 < d
1e3 > .5 && 1.5E-3 < 1.0
i in li == false
2 in [1, 2, 3]
d in [2, 2.5]
s in ['grasp_object', "place_object"]
"grip" in limits && !("x" in limits)
has(limits.grip) && !has(limits.x)
limits.grip < limits["touch"]
li[0] == 1 && li[2] == 3
[1, 2][1] == 2
"red" in held && size(held) == 1 && held.exists(h, h == "red") && !held.all(h, h == "green")
size(li) == 3 && li.size() == 3 && size(limits) == 2 && size("äb") == 2
li == [1, 2, 3] && li != [1, 2]
ld == [0.5, 1.5]
li.exists(e, e == 2) && !li.exists(e, e == 4)
li.all(e, e > 0) && !li.all(e, e > 1)
[1].all(e, e == 1)
limits.exists(k, k == "grip") && limits.all(k, k in limits && limits[k] > 50)
li.exists(e, ld.exists(f, double(e) > f))
people.exists(p, p.distance_m < 1 && has(p.name) && p.name == "a")
!has(target.weight_kg)
has(target.fragile) && target.fragile
!has(sensed.slip) && sensed.force_n == 3
double(i) == 7.0 && double(d) == 2.5 && double(3) == 3.0
int(d) == 2 && int(-d) == -2 && int(i) == 7
s.startsWith("grasp") && s.endsWith("object") && s.contains("_")
"a" < "b" && "b" >= "b" && s != "x"
"a\\"\\'\\\\\\n\\r\\t\\u0041" == 'a"\\'\\\\\\n\\r\\tA'
target
  .fragile
  && b
"""
LINES = TRUE.strip().split("\n")
SOURCES = [*LINES[:-3], "\n".join(LINES[-3:])]


@pytest.mark.parametrize("source", SOURCES)
def test_is_true(source: str) -> None:
    assert evaluate(source) is True
    assert evaluate(f"!({source})") is False


ERRORS = {
    f"i + {BIG} > 0": "overflow",
    f"i * {BIG} > 0": "overflow",
    f"i - {-BIG} > 0": "overflow",
    "-i == 0": "overflow",
    "i / -1 == 0": "overflow",
    "i % -1 == 0": "overflow",
    "i / (small - 5) == 0": "division_by_zero",
    "i % (small - 5) == 0": "division_by_zero",
    "i / 0 == 0": "division_by_zero",
    "d / 0 > 1": "division_by_zero",
    "d / (d - d) > 1": "division_by_zero",
    "d / 1e-300 > 1": "not_finite",
    "d * 1e300 > 1": "not_finite",
    "d + d > 1": "not_finite",
    "-d - d < 1": "not_finite",
    "int(d) > 1": "overflow",
    "li[3] == 1": "index_out_of_range",
    "li[-1] == 3": "index_out_of_range",
    "limits.x > 1": "absent",
    "limits['x'] > 1": "absent",
    "target.weight_kg > 1": "absent",
    "target.holder.grip > 1": "absent",
    "has(target.holder.grip)": "absent",
    "sensed.slip": "absent",
    "people.all(p, p.name == 'a')": "absent",
}


@pytest.mark.parametrize(("source", "code"), ERRORS.items())
def test_is_an_error(source: str, code: str) -> None:
    extreme = {"i": -(2**63) if "-" in source[:2] or "-1" in source else BIG, "d": 1.7e308}
    assert checked(source).can_fail
    with pytest.raises(EvaluationError) as raised:
        evaluate(source, **extreme)
    assert raised.value.code == code
    assert raised.value.detail
    with pytest.raises(EvaluationError):
        evaluate(f"!({source})", **extreme)


# CEL language definition, logical operators: t(rue), f(alse), e(rror)
LOGIC = """
t&&t=t t&&f=f t&&e=e f&&t=f f&&f=f f&&e=f e&&t=e e&&f=f e&&e=e
t||t=t t||f=t t||e=t f||t=t f||f=f f||e=e e||t=t e||f=e e||e=e
t&&e&&f=f e&&t&&f=f e||f||t=t f||e||f=e e&&(e||t)=e (e||t)&&t=t
"""


@pytest.mark.parametrize("row", LOGIC.split())
def test_an_error_yields_to_the_operand_that_decides(row: str) -> None:
    formula, _, expected = row.partition("=")
    source = "".join({"t": "b", "f": "!b", "e": "1 / (i - 7) > 0"}.get(c, c) for c in formula)
    if expected == "e":
        with pytest.raises(EvaluationError, match="division_by_zero"):
            evaluate(source)
    else:
        assert evaluate(source) is (expected == "t")


@pytest.mark.parametrize(
    ("source", "expected"), [("li.exists(e, 1 / (e - 2) == 1)", True), ("li.all(e, 1 / (e - 2) > 5)", False)]
)
def test_an_error_at_one_element_yields_to_another_that_decides(source: str, expected: bool) -> None:
    assert evaluate(source) is expected


@pytest.mark.parametrize("source", ["li.exists(e, 1 / (e - 2) > 5)", "li.all(e, 1 / (e - 2) < 5)"])
def test_an_error_at_one_element_stands_where_no_other_decides(source: str) -> None:
    with pytest.raises(EvaluationError, match="division_by_zero"):
        evaluate(source)


@pytest.mark.parametrize("word", ["&&", "||"])
def test_five_hundred_operands_are_one_level(word: str) -> None:
    assert isinstance(checked(f" {word} ".join(["b"] * 500)), Logic)
    assert evaluate(f" {word} ".join(["(b)"] * 500)) is True
    assert evaluate(f" {word} ".join(["i / i == 1"] * 250)) is True
    assert checked(f"b {word} (b {word} b)") == checked(f"(b {word} b) {word} b") == checked(f"b {word} b {word} b")


# -- refused on load -------------------------------------------------------------------------------------------------

PURE = "unit mismatch: a pure number and a quantity in `N` do not add up: a factor goes by `*`"
NO_ORDER = " a set has no order, and is compared with nothing"
REFUSED = [
    ("", 1, "unexpected end", ()),
    ("b &&", 5, "unexpected end", ()),
    ("b & b", 3, "unexpected `&`", ("&&",)),
    ("b and b", 3, "unexpected `and`", ("&&",)),
    ("b | b", 3, "unexpected `|`", ("||",)),
    ("b or b", 3, "unexpected `or`", ("||",)),
    ("i = 1", 3, "unexpected `=`", ("==",)),
    ("b b", 3, "unexpected `b`", ()),
    ("(b", 3, "unexpected end", ()),
    ("null == s", 1, "unexpected `null`", ()),
    ("1u > 0", 1, "unexpected `1u`", ()),
    ("0x1F > 0", 1, "unexpected `0x1F`", ()),
    ("in(1, li)", 1, "unexpected `in`", ()),
    ("s == 'ab", 6, "unexpected `'`", ()),
    ("s == '\\q'", 7, "unknown escape `\\q`", ("\\\\",)),
    ("s == '\\ud800'", 7, "unknown escape `\\ud800`", ("\\\\",)),
    ("s == '\ud800'", 7, "half of a surrogate pair is not a character", ()),
    ("b // why", 4, "unexpected `/`", ()),
    ("{'a': 1}", 1, "unexpected `{`", ()),
    ("٣ > 1", 1, "unexpected `٣`", ()),
    ("_x > 1", 1, "unexpected `_x`", ()),
    ("targt.fragile", 1, "unknown variable `targt`", ("target",)),
    ("b && target.fragil", 13, "`target` has no field `fragil`", ("fragile",)),
    ("i.x == 1", 3, "a int has no field `x`", ()),
    ("sizes(li) == 1", 1, "unknown function `sizes`", ("size",)),
    ("li.map(e, e) == li", 4, "unknown method `map`", ("all",)),
    ("eval('1')", 1, "unknown function `eval`", ("double",)),
    ("size(li, li) == 1", 1, "`size` does not take list<int> and list<int>", ("string",)),
    ("size() == 1", 1, "`size` does not take nothing", ("string",)),
    ("i > d", 3, "`>` does not take int and double; `double(…)` converts an int", ("int and int",)),
    ("i > 1.5", 3, "`>` does not take int and double; `double(…)` converts an int", ("int and int",)),
    ("1 + 2 > d", 7, "`>` does not take int and double; `double(…)` converts an int", ("int and int",)),
    ("9007199254740993 > d", 18, "`>` does not take int and double; `double(…)` converts an int", ("int and int",)),
    ("d in [9007199254740993]", 3, "`in` does not take double and list<int>", ("bool and list<bool>",)),
    ("b == 1", 3, "`==` does not take bool and int", ("bool and bool",)),
    ("b < b", 3, "`<` does not take bool and bool", ("int and int",)),
    ("target == target", 8, "`==` does not take target and target", ("bool and bool",)),
    ("limits == limits", 8, "`==` does not take map<string, double> and map<string, double>", ("bool and bool",)),
    ("'a' + 'b' == s", 5, "`+` does not take string and string", ("int and int",)),
    ("!i", 1, "`!` does not take int", ("bool",)),
    ("-s == s", 1, "`-` does not take string", ("int",)),
    ("li['a'] == 1", 3, "`[` does not take list<int> and string", ("list<any> and int",)),
    ("d % 2 == 0", 3, "`%` does not take double and int; `double(…)` converts an int", ("int and int",)),
    ("b && 1", 6, "expected a bool, this is a int", ()),
    ("i ? b : b", 1, "expected a bool, this is a int", ()),
    ("li.exists(e, e)", 14, "expected a bool, this is a int", ()),
    ("i", 1, "expected a bool, this is a int", ()),
    ("(b ? i : d) > 1", 4, "types differ: int and double", ("int everywhere", "double everywhere")),
    ("[i, d] == ld", 1, "types differ: int and double", ()),
    ("[1, i, 2.5] == ld", 1, "types differ: int and double", ()),
    ("li == []", 7, "an empty list literal has no element type", ("size(list) == 0",)),
    ("9223372036854775808 > i", 1, "number out of range; an int has 64 bits, a double is finite", ()),
    ("1e999 > d", 1, "number out of range; an int has 64 bits, a double is finite", ()),
    ("force_n > speed_mps", 9, "units differ: `N` and `m/s`", ("a number in N",)),
    ("force_n * 2 + -speed_mps > 1", 13, "units differ: `N` and `m/s`", ()),
    ("force_n / 2 == speed_mps", 13, "units differ: `N` and `m/s`", ()),
    ("2 * force_n == double(speed_mps)", 13, "units differ: `N` and `m/s`", ()),
    ("speed_mps < limits.grip", 11, "units differ: `m/s` and `N`", ()),
    ("speed_mps in [force_n]", 11, "units differ: `m/s` and `N`", ()),
    ("[speed_mps, force_n] == ld", 1, "units differ: `m/s` and `N`", ()),
    ("(b ? speed_mps : force_n) > 1", 4, "units differ: `m/s` and `N`", ()),
    ("people.exists(p, p.distance_m > speed_mps)", 31, "units differ: `m` and `m/s`", ()),
    ("[force_n].exists(f, f > speed_mps)", 23, "units differ: `N` and `m/s`", ()),
    ("force_n + 1 > 5", 9, PURE, ()),
    ("0.8 - force_n < 5", 5, PURE, ()),
    ("force_n - d * 2 > 1", 9, PURE, ()),
    ("colour == 'grün'", 8, "`grün` is compared with what is never that", ("green", "red")),
    ("held[0] == 'red'", 5, f"`[` does not take set<string> and int:{NO_ORDER}", ("x in set",)),
    ("held == ['red']", 6, f"`==` does not take set<string> and list<string>:{NO_ORDER}", ("x in set",)),
    ("colours != held", 9, f"`!=` does not take list<string> and set<string>:{NO_ORDER}", ("x in set",)),
    ("held == held", 6, f"`==` does not take set<string> and set<string>:{NO_ORDER}", ("x in set",)),
    ("'red' in (b ? held : colours)", 13, "types differ: set<string> and list<string>", ()),
    ("1 in held", 3, "`in` does not take int and set<string>", ("bool and list<bool>",)),
    ("held.exists(h, h == 'gren')", 18, "`gren` is compared with what is never that", ("green", "red")),
    ("'gren' in held", 8, "`gren` is compared with what is never that", ("green", "red")),
    ("'gren' in colours", 8, "`gren` is compared with what is never that", ("green", "red")),
    ("colour == (b ? 'red' : 'blue')", 8, "`blue` is compared with what is never that", ("green", "red")),
    ("colour in (b ? ['red', s] : ['blue'])", 8, "`blue` is compared with what is never that", ("green", "red")),
    ("colour in ['red', 'blue']", 8, "`blue` is compared with what is never that", ("green", "red")),
    ("colour.startsWith('gern')", 8, "nothing that it can be has `gern` there", ("green", "red")),
    ("colour.endsWith('dee')", 8, "nothing that it can be has `dee` there", ("green", "red")),
    ("held.all(h, h.contains(b ? 'r' : 'x'))", 15, "nothing that it can be has `x` there", ("green", "red")),
    ("has(b)", 1, "`has` takes one field", ("has(record.field)",)),
    ("has()", 1, "`has` takes one field", ("has(record.field)",)),
    ("has(target.x)", 12, "`target` has no field `x`", ("fragile",)),
    ("li.exists(e)", 4, "`exists` takes a variable and a condition", ("list.exists(x, condition on x)",)),
    ("li.all(1, b)", 4, "`all` takes a variable and a condition", ("list.all(x, condition on x)",)),
    ("li.all(d, b)", 8, "`d` is already a variable; choose another name", ()),
    ("li.all(e, li.all(e, b))", 18, "`e` is already a variable; choose another name", ()),
    ("i.all(e, b)", 3, "`all` needs a list, a set or a map, this is a int", ()),
    ("li.all(e, li.all(f, li.all(g, b)))", 24, "more than 2 quantifiers inside one another", ()),
    ("li.all(e, b) && e > 1", 17, "unknown variable `e`", ("b",)),
]  # fmt: skip


@pytest.mark.parametrize(("source", "column", "message", "valid"), REFUSED, ids=[repr(row[0])[1:-1] for row in REFUSED])
def test_refuses_on_load_and_says_where_and_what_would_be_valid(
    source: str, column: int, message: str, valid: tuple[str, ...]
) -> None:
    with pytest.raises(ExpressionError) as raised:
        checked(source)
    error = raised.value
    assert (error.column, error.message) == (column, message)
    assert error.valid[: len(valid)] == valid
    assert error.source == source
    assert str(error).startswith(f"column {column}: {message}")


def test_refuses_a_source_that_is_too_long() -> None:
    room = MAX_SOURCE - len("b")
    assert evaluate(" " * room + "b")
    with pytest.raises(ExpressionError, match="`4097` characters are too many; at most 4096"):
        checked(" " * (room + 1) + "b")


@pytest.mark.parametrize(
    ("nest", "levels"),
    [
        ("!{}", 1),
        ("[{}][0]", 2),
        ("({} ? b : b)", 1),
        ("(b && !{})", 2),
        ("(i / i > 0 && (i / i > 9 || {} || b))", 2),
    ],
)
def test_refuses_a_source_that_is_nested_too_deep(nest: str, levels: int) -> None:
    deep = "b"
    for _ in range((MAX_DEPTH - 3) // levels):
        deep = nest.format(deep)
    assert evaluate(deep) in (True, False)
    with pytest.raises(ExpressionError, match="nested deeper than 32 levels"):
        checked("!!!" + nest.format(deep))


def test_parentheses_are_no_nesting() -> None:
    assert evaluate("(" * 2000 + "b" + ")" * 2000)


def test_a_limit_may_be_an_expression_of_another_type() -> None:
    assert check(parse("force_n * 0.5"), ENV, DOUBLE).unit == "N"
    assert check(parse("20"), ENV, DOUBLE) == Constant(type=DOUBLE, value=20.0)
    with pytest.raises(ExpressionError, match="expected a double, this is a int"):
        check(parse("i"), ENV, DOUBLE)


@pytest.mark.parametrize("name", ["in", "null", "_x", "a-b", "", "é", "a b", "__class__", "x;import os"])
def test_refuses_to_declare_what_no_source_can_spell(name: str) -> None:
    with pytest.raises(DeclarationError, match="is not a usable name") as raised:
        declare({name: BOOL})
    assert raised.value.name == name
    with pytest.raises(DeclarationError):
        RecordType(name="r", fields={name: Field(BOOL)})


def test_refuses_an_optional_variable() -> None:
    with pytest.raises(DeclarationError, match="only fields may be optional"):
        declare({"a": Field(BOOL, required=False)})


# -- what cannot fail ------------------------------------------------------------------------------------------------

WEIGHED, HEAVY = "(target.get('weight_kg') is not None)", "(target['weight_kg'] > 1.0)"
HELD = "(target.get('holder') is not None)"
BARE = {
    "target.fragile": "target['fragile']",
    "force_n > 20": "(force_n > 20.0)",
    "force_n * force_n - 5 > 100": "(((force_n * force_n) - 5.0) > 100.0)",
    "d * 0.8 > 1": "((d * 0.8) > 1.0)",
    "d / 2 > 1": "((d / 2.0) > 1.0)",
    "d + 1 > 1": "((d + 1.0) > 1.0)",
    "-d > 1": "((-d) > 1.0)",
    "i / 2 > 1": "(_cel_quotient(i, 2) > 1)",
    "i % 2 == 1": "(_cel_remainder(i, 2) == 1)",
    "small % -1 == 0": "(_cel_remainder(small, -1) == 0)",
    "small * small + 1 > 1": "(((small * small) + 1) > 1)",
    "-small / -1 > 1": "(_cel_quotient((-small), -1) > 1)",
    "int(force_n) > 1": "(int(force_n) > 1)",
    "double(small) * 2 > 1": "((float(small) * 2.0) > 1.0)",
    "int(small) + 1 > 1": "((small + 1) > 1)",
    "double(force_n) * 2 > 1": "((force_n * 2.0) > 1.0)",
    "size(li) > 1": "(len(li) > 1)",
    "has(target.weight_kg) && target.weight_kg > 1": f"({WEIGHED} and {HEAVY})",
    "!has(target.weight_kg) || target.weight_kg > 1": f"((not {WEIGHED}) or {HEAVY})",
    "has(target.weight_kg) ? target.weight_kg > 1 : b": f"({HEAVY} if {WEIGHED} else b)",
    "(b && has(target.weight_kg)) ? target.weight_kg > 1 : b": f"({HEAVY} if (b and {WEIGHED}) else b)",
    "!(b || !has(target.weight_kg)) && target.weight_kg > 1": f"((not (b or (not {WEIGHED}))) and {HEAVY})",
    "has(sensed.slip) && sensed.slip": "((sensed.slip is not None) and sensed.slip)",
    "has(target.holder) && has(target.holder.grip) && target.holder.grip > 1":
        f"({HELD} and (target['holder'].get('grip') is not None) and (target['holder']['grip'] > 1.0))",
    "'x' in limits && limits.x > 1": "(('x' in limits) and (limits['x'] > 1.0))",
    "li.all(e, e > 1)": "all((_cel_e_ > 1) for _cel_e_ in li)",
    "ls.exists(e, e in limits && limits[e] > 1)":
        "any(((_cel_e_ in limits) and (limits[_cel_e_] > 1.0)) for _cel_e_ in ls)",
    "s == 'a' || s.contains(\"'\")": "((s == 'a') or (\"'\" in s))",
    "s in ['a']": "(s in ('a',))",
}  # fmt: skip


@pytest.mark.parametrize(("source", "emitted"), BARE.items())
def test_emits_bare_what_cannot_fail(source: str, emitted: str) -> None:
    assert not checked(source).can_fail
    assert text(source) == emitted


CHECKED = {
    "d * 1.5 > 1": "(_cel_finite((d * 1.5)) > 1.0)",
    "d / 0.5 > 1": "(_cel_divide(d, 0.5) > 1.0)",
    "d / force_n > 1": "(_cel_divide(d, force_n) > 1.0)",
    "small + i > 1": "(_cel_int((small + i)) > 1)",
    "-(small + i) > 1": "(_cel_int(-_cel_int((small + i))) > 1)",
    "-li[0] > 1": "(_cel_int(-_cel_element(li, 0)) > 1)",
    "b && i / i > 1": "(b and (_cel_quotient(i, i) > 1))",
    "i / i > 1 && b": "(_cel_decide(False, (lambda: (_cel_quotient(i, i) > 1), lambda: b)))",
    "b || i / i > 1 || b": "(b or _cel_decide(True, (lambda: (_cel_quotient(i, i) > 1), lambda: b)))",
    "li.exists(e, i / e > 1)": "_cel_search(True, lambda _cel_e_: (_cel_quotient(i, _cel_e_) > 1), li)",
    "li.all(e, i / e > 1)": "_cel_search(False, lambda _cel_e_: (_cel_quotient(i, _cel_e_) > 1), li)",
    "sensed.slip": "_cel_present(sensed.slip, 'sensed.slip')",
    "target.weight_kg > 1": "(_cel_present(target.get('weight_kg'), 'target.weight_kg') > 1.0)",
    "people[0].distance_m > 1": "(_cel_element(people, 0)['distance_m'] > 1.0)",
    "people[0].name == s": "(_cel_present(_cel_element(people, 0).get('name'), 'name') == s)",
}


@pytest.mark.parametrize(("source", "emitted"), CHECKED.items())
def test_emits_a_check_where_it_may_fail(source: str, emitted: str) -> None:
    assert checked(source).can_fail
    assert text(source) == emitted


@pytest.mark.parametrize(
    "source",
    [
        "target.weight_kg > 1 && has(target.weight_kg)",  # the test comes too late
        "has(target.weight_kg) || target.weight_kg > 1",
        "!has(target.weight_kg) && target.weight_kg > 1",
        "has(target.weight_kg) ? b : target.weight_kg > 1",
        "(b && has(target.weight_kg)) ? b : target.weight_kg > 1",
        "!(b && has(target.weight_kg)) && target.weight_kg > 1",
        "(has(target.weight_kg) || b) && target.weight_kg > 1",
        "has(target.holder.grip) && target.holder.grip > 1",  # the test itself may fail, and proves nothing then
        "ls[0] in limits && limits[ls[0]] > 1",
        "'x' in limits && limits.y > 1",
        "people.exists(p, has(p.name)) && people.exists(p, p.name == s)",
    ],
)
def test_proves_nothing_from_a_test_that_does_not_decide(source: str) -> None:
    assert checked(source).can_fail


def test_reads_through_the_names_it_is_given() -> None:
    names = {"target.fragile": "t_fragile", "target.weight_kg": "t_weight", "target": "t"}
    emit = lambda source: to_python(checked(source), names)  # noqa: E731
    assert emit("target.fragile") == "t_fragile"
    assert emit("has(target.weight_kg) && target.weight_kg > 1") == "((t_weight is not None) and (t_weight > 1.0))"
    assert emit("target.weight_kg > 1") == "(_cel_present(t_weight, 'target.weight_kg') > 1.0)"
    assert emit("has(target.holder)") == "(t.get('holder') is not None)"
    with pytest.raises(DeclarationError, match="`i` has no Python text to read it by"):
        emit("i > 1")


def test_lists_what_a_condition_reads() -> None:
    source = (
        "target.fragile && has(target.holder.grip) && people.all(p, p.distance_m > d) && [i][0] == 1 && limits.x > 1"
    )
    found = references(checked(f"{source} && (b ? b : b) && people[0].distance_m > 1"))
    assert set(found) == {"target.fragile", "target.holder.grip", "people", "d", "i", "limits", "b"}
    assert isinstance(found["target.fragile"], Select)


def test_nodes_are_equal_when_they_mean_the_same() -> None:
    first = checked("  d  >  1")
    assert first == checked("d > 1.0")
    assert first.column != checked("d > 1.0").column
    assert isinstance(first, Apply)
    assert {first, checked("d>1")} == {first}
    assert checked("1 == 1") != checked("1.0 == 1.0")


def test_refuses_a_node_of_no_known_shape() -> None:
    stranger = cast("Typed", object())
    with pytest.raises(AssertionError):
        children(stranger)
    with pytest.raises(AssertionError):
        to_python(stranger, {})


# -- values ----------------------------------------------------------------------------------------------------------


def test_a_variable_without_a_value_is_an_error() -> None:
    with pytest.raises(EvaluationError, match="unknown_variable: `d` has no value"):
        compile_condition(checked("b || d > 1"))({"b": True})


def test_a_variable_that_is_not_read_is_not_looked_at() -> None:
    assert compile_condition(checked("b"))({"b": True, "d": float("nan"), "other": object()}) is True


def test_only_a_bool_is_a_condition() -> None:
    with pytest.raises(DeclarationError, match="`int` is not the type of a condition"):
        compile_condition(check(parse("i"), ENV, INT))


FITTING: list[tuple[Field, object, object]] = [
    (Field(DOUBLE), 3, 3.0),
    (Field(DOUBLE, within=3), -3, -3.0),
    (Field(ListType(DOUBLE), within=3), [1, 2.5], (1.0, 2.5)),
    (Field(ListType(INT)), (1, 2), (1, 2)),
    (Field(SetType(INT)), {2}, frozenset({2})),
    (Field(SetType(DOUBLE), within=3), frozenset({2}), frozenset({2.0})),
    (Field(MapType(INT)), {"a": 1, "b": None}, {"a": 1}),
    (Field(TARGET), {"fragile": False, "weight_kg": None, "more": 1}, {"fragile": False}),
    (Field(TARGET), {"fragile": False, "weight_kg": 2}, {"fragile": False, "weight_kg": 2.0}),
    (Field(SENSED), SimpleNamespace(force_n=1), SimpleNamespace(force_n=1.0, slip=None)),
]


@pytest.mark.parametrize(("declared", "value", "conformed"), FITTING)
def test_brings_a_value_into_form(declared: Field, value: object, conformed: object) -> None:
    found = conform(value, declared, "v")
    assert found == conformed
    assert repr(found) == repr(conformed)


UNFIT: list[tuple[Field, object, str]] = [
    (Field(BOOL), 1, "wrong_type: `v` is a int, not a bool"),
    (Field(INT), True, "wrong_type: `v` is a bool, not a int"),
    (Field(INT), 1.0, "wrong_type: `v` is a float, not a int"),
    (Field(INT), 2**63, "overflow: `9223372036854775808` does not fit 64 bits"),
    (Field(INT, within=5), 6, "out_of_range: `v` is 6; at most 5 in magnitude"),
    (Field(DOUBLE), False, "wrong_type: `v` is a bool, not a double"),
    (Field(DOUBLE), float("nan"), "not_finite: `nan` is not a finite number"),
    (Field(DOUBLE, within=5), -5.1, "out_of_range: `v` is -5.1; at most 5 in magnitude"),
    (Field(ListType(DOUBLE), within=3), [1.0, 4], "out_of_range: `v[1]` is 4.0; at most 3 in magnitude"),
    (Field(STRING), None, "wrong_type: `v` is a NoneType, not a string"),
    (Field(ListType(INT)), "ab", "wrong_type: `v` is a str, not a list<int>"),
    (Field(ListType(INT)), [1, None], "wrong_type: `v[1]` is a NoneType, not a int"),
    (Field(SetType(INT)), [1], "wrong_type: `v` is a list, not a set<int>"),
    (Field(SetType(DOUBLE), within=3), {4.0}, "out_of_range: `v[…]` is 4.0; at most 3 in magnitude"),
    (Field(MapType(INT)), [1], "wrong_type: `v` is a list, not a map<string, int>"),
    (Field(MapType(INT)), {1: 1}, "wrong_type: `key of v` is a int, not a string"),
    (Field(MapType(INT)), {"a": "b"}, "wrong_type: `v['a']` is a str, not a int"),
    (Field(TARGET), {}, "absent: `v.fragile` is absent and required"),
    (Field(TARGET), 5, "wrong_type: `v` is a int, not a target"),
    (Field(SENSED), 5, "absent: `v.force_n` is absent and required"),
    (Field(TARGET), {"fragile": True, "holder": {"grip": float("inf")}}, "not_finite: `inf` is not a finite number"),
]


@pytest.mark.parametrize(("declared", "value", "message"), UNFIT)
def test_refuses_a_value_that_is_not_what_was_declared(declared: Field, value: object, message: str) -> None:
    with pytest.raises(EvaluationError) as raised:
        conform(value, declared, "v")
    assert str(raised.value) == message
