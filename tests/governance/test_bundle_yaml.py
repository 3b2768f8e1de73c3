from __future__ import annotations

import pytest

from app.governance.bundle_yaml import parse


def value(text: str) -> object:
    document, problems = parse("x.yaml", text)
    assert problems == []
    return document.value


@pytest.mark.parametrize(
    ("text", "means"),
    [
        ("on", "on"), ("yes", "yes"), ("No", "No"), ("1:30", "1:30"), ("0x1F", "0x1F"), ("1_000", "1_000"),
        ("2024-01-01", "2024-01-01"), ("<<", "<<"), ("=", "="), ("nan", "nan"), ("inf", "inf"),
        ("~", None), ("null", None), ("Null", None), ('""', ""),
        ("true", True), ("TRUE", True), ("False", False), ("'true'", "true"),
        ("7", 7), ("-7", -7), ("+7", 7), ("017", 17), ("1" * 18, int("1" * 18)),
        ("7.0", 7.0), (".5", 0.5), ("-5.", -5.0), ("1e3", 1000.0), ("1E-3", 0.001),
    ],
)  # fmt: skip
def test_plain_words_mean_what_the_core_schema_says(text, means):
    found = value(f"key: {text}")
    assert found == {"key": means}
    assert type(found["key"]) is type(means)


@pytest.mark.parametrize(
    ("text", "key", "line", "said"),
    [
        ("a: &x [1]\nb: *x", "b", 2, "aliases are not allowed"),
        ("a: &x\n  b: *x", "a.b", 2, "aliases are not allowed"),
        ("a: " + "[" * 60 + "]" * 60, "", 1, "nested deeper than 40 levels"),
        ("a: 1\nb: !!python/object:os.system x", "b", 2, "is not allowed: plain values"),
        ("a: !!binary aGk=", "a", 1, "is not allowed: plain values"),
        ("a: !!set {x: }", "a", 1, "is not allowed: plain values"),
        ("a: 1\n[b, c]: 2", "", 2, "a key is a plain word"),
        ("a: 1\n? {b: c}\n: 2", "", 2, "a key is a plain word"),
        ("a: 1\na: 2", "a", 2, "stands twice, first on line 1"),
        ("a: 1\nb: .nan", "b", 2, "is not a finite number"),
        ("a: -.INF", "a", 1, "is not a finite number"),
        ("a: 1e999", "a", 1, "is not a finite number"),
        ("a: -" + "9" * 19, "a", 1, "number out of range"),
        ("a: 1\nb: [", "", 3, "not readable as YAML"),
        ("a: 1\n---\nb: 2", "", 2, "not readable as YAML"),
        ("a: \x00", "", 1, "not readable as YAML"),
    ],
)
def test_what_could_surprise_is_a_problem_with_its_place(text, key, line, said):
    _, problems = parse("x.yaml", text)
    assert len(problems) == 1
    assert (problems[0].file, problems[0].key, problems[0].line) == ("x.yaml", key, line)
    assert said in problems[0].message


@pytest.mark.parametrize("text", ["[" * 100_000, "{a: " * 100_000, "- " * 100_000, "? " * 100_000])
def test_a_file_of_any_depth_is_a_problem_and_no_crash(text):
    _, problems = parse("x.yaml", f"# a remark\n{text}")
    assert [(problem.line, problem.message) for problem in problems] == [(2, "nested deeper than 40 levels")]


def test_forty_levels_are_not_too_deep():
    assert value("[" * 40 + "]" * 40 + "\n") is not None


def test_an_empty_file_is_empty():
    assert value("") is None
    assert value("# only a remark\n") is None


def test_every_value_knows_its_line_and_what_is_missing_the_line_around_it():
    document, _ = parse("x.yaml", "a: 1\nb:\n  - c: 2\n    d: 3\n")
    assert [document.line(path) for path in (("a",), ("b", 0, "d"), ("b", 0, "e"), ("z",), ())] == [1, 4, 3, 1, 1]


@pytest.mark.parametrize("text", ["a: [1, {b: c}]", f"a: [1, {{b: c}}] # {'.' * 40_000}"], ids=["short", "long"])
def test_what_is_read_again_is_the_same_and_the_readers_own(text):
    first, _ = parse("x.yaml", text)
    first.value["a"][1]["b"] = "changed"
    again, problems = parse("x.yaml", text)
    assert (again.value, problems) == ({"a": [1, {"b": "c"}]}, [])
    assert again.lines == first.lines
    assert parse("y.yaml", text)[0].file == "y.yaml"


def test_what_is_wrong_is_said_each_time():
    _, problems = parse("x.yaml", "a: 1\na: 2")
    problems.clear()
    assert [problem.line for problem in parse("x.yaml", "a: 1\na: 2")[1]] == [2]
