from __future__ import annotations

import pytest

from app.authoring.conditions import changes, to_cel
from app.governance.expression import check, declare
from app.governance.expression_syntax import parse
from app.governance.expression_tree import BOOL, DOUBLE, INT, STRING, Field, ListType, MapType, RecordType

ENV = declare({
    "t": RecordType(name="t", fields={
        "a": Field(BOOL), "b": Field(BOOL), "m": Field(DOUBLE, unit="kg"), "w": Field(DOUBLE, unit="kg"),
        "s": Field(STRING), "o": Field(DOUBLE, required=False),
    }),
    "x": DOUBLE, "n": INT, "l": ListType(STRING), "k": MapType(DOUBLE), "f": BOOL,
    "risk": Field(STRING, among=frozenset({"low", "high"})),
    "r": RecordType(name="r", fields={
        "risk": Field(STRING, among=frozenset({"low", "high"})),
        "held": Field(STRING, among=frozenset({"", "a", "b", "c", "d"})),
    }),
})  # fmt: skip


def typed(source):
    return check(parse(source), ENV, BOOL)


CONDITIONS = [
    "t.a && !t.b || f", "t.m > 0.8 * t.w && t.m <= t.w", "has(t.o) && t.o < 0.5", "x + 1.5 - 2.5 * x / 3.5 >= -1.5",
    'r.risk in ["low", "high"]', '"hazmat" in l', 'l.exists(i, i == "a") && l.all(i, i != "b")', "(f ? x : 1.5) > 1.5",
    't.s.startsWith("a\\"b") || t.s.size() > 2', 'k["q"] < 2.5 && "q" in k', "n % 2 == 1 && double(n) > x",
    "!(t.a && t.b)", "-x < 1.5", "(x - 1.5) - 2.5 < x - (1.5 - 2.5)", "l[0] == t.s", "(f ? t.a : t.b) == f",
]  # fmt: skip


@pytest.mark.parametrize("source", CONDITIONS)
def test_a_tree_written_and_read_again_is_the_same_tree(source):
    assert typed(to_cel(typed(source))) == typed(source)


@pytest.mark.parametrize("source", CONDITIONS)
def test_every_change_is_another_condition_and_each_comes_once(source):
    texts = [change.text for change in changes(typed(source))]
    assert len(set(texts)) == len(texts)
    assert to_cel(typed(source)) not in texts
    assert texts[-1] == ""


def test_operators_literals_and_references_are_changed():
    texts = {change.text for change in changes(typed("t.m > 2.0 && t.a"))}
    assert {"(t.m >= 2.0) && t.a", "(t.m < 2.0) && t.a", "(t.m > 2.02) && t.a", "(t.m > 1.98) && t.a"} <= texts
    assert {"(t.w > 2.0) && t.a", "(t.m > 2.0) && t.b", "(t.m > 2.0) && !t.a", "(t.m > 2.0) || t.a"} <= texts
    assert {"t.a", "t.m > 2.0", ""} <= texts


def test_a_name_becomes_the_empty_one_and_two_others_that_something_has():
    texts = {change.text for change in changes(typed('r.held == "a"'))}
    assert {text for text in texts if text.startswith("r.held ==")} == {
        f'r.held == "{name}"' for name in ("", "b", "c")
    }


def test_a_name_that_is_one_of_a_few_becomes_another_of_them():
    assert 'r.risk == "high"' in {change.text for change in changes(typed('r.risk == "low"'))}
