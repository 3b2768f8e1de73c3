from __future__ import annotations

import json

import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.api.problems import Problem
from app.api.wire import (
    MAX_DEPTH,
    MAX_TEXT,
    MAX_VALUES,
    EmptyBody,
    ProposalBody,
    ResolveBody,
    StrategyName,
    check_media_type,
    parse,
    to_model,
)
from app.governance.model import Strategy

PROPOSAL = {"capability": "grasp_object", "params": {"object_id": "mug_1", "force_n": 80}}

MALFORMED = {
    "nothing": b"",
    "cut off": b'{"capability": "grasp_object"',
    "trailing comma": b'{"capability": "x",}',
    "single quotes": b"{'capability': 'x'}",
    "comment": b'{"capability": "x" /* no */}',
    "NaN": b'{"capability": "x", "params": {"force_n": NaN}}',
    "Infinity": b'{"capability": "x", "params": {"force_n": Infinity}}',
    "minus Infinity": b'{"capability": "x", "params": {"force_n": -Infinity}}',
    "beyond double": b'{"capability": "x", "params": {"force_n": 1e999}}',
    "integer that no double holds": b'{"capability": "x", "params": {"force_n": 9007199254740993}}',
    "integer below zero that no double holds": b'{"capability": "x", "params": {"force_n": -9007199254740993}}',
    "integer beyond 64 bits": b'{"capability": "x", "params": {"force_n": 18446744073709551616}}',
    "integer in a list": b'{"capability": "x", "params": {"a": ["\\"", 9007199254740993]}}',
    "endless integer in a text's shadow": b'{"capability": "1e5", "n": 1' + b"0" * 5000 + b"}",
    "lone surrogate": b'{"capability": "x", "params": {"object_id": "\\ud800"}}',
    "no UTF-8": b'{"capability": "\xff"}',
    "byte order mark": b'\xef\xbb\xbf{"capability": "x"}',
    "control character": b'{"capability": "a\x00b"}',
    "two values": b'{"capability": "x"} {"capability": "y"}',
    "duplicate key": b'{"capability": "x", "capability": "y"}',
    "duplicate key, spelled differently": b'{"capability": "x", "capabilit\\u0079": "y"}',
    "duplicate key inside": b'{"capability": "x", "params": {"force_n": 1, "force_n": 2}}',
    "duplicate key in a list": b'{"capability": "x", "params": {"a": [{"b": 1, "b": 1}]}}',
    "duplicate key beside colons in texts": b'{"capability": "a:b:c", "params": {"d:": 1, "d:": 2}}',
    "deep lists": b'{"capability": "x", "params": {"a": ' + b"[" * 40 + b"]" * 40 + b"}}",
    "many lists": b'{"capability": "x", "metadata": {"a": [' + b"[],{}," * 5_000 + b"[]]}}",
    "many numbers": b'{"capability": "x", "metadata": {"a": [' + b"0," * 10_000 + b"0]}}",
    "many members": orjson.dumps({"capability": "x", "metadata": {f"m{number}": number for number in range(10_000)}}),
    "very deep lists": b"[" * 100_000 + b"]" * 100_000,
    "deep objects": b'{"a":' * 500 + b"1" + b"}" * 500,
    "deep lists behind a duplicate key": b'{"a": ' + b"[" * 1000 + b"]" * 1000 + b', "a": 1}',
    "deep objects behind a duplicate key": b'{"a": ' + b'{"a":' * 1000 + b"1" + b"}" * 1000 + b', "a": 1}',
}


@pytest.mark.parametrize(("values", "read"), [(MAX_VALUES, True), (MAX_VALUES + 1, False)])
def test_reads_so_many_values_and_no_more(values: int, read: bool) -> None:
    body = orjson.dumps([0] * (values - 1))  # and the list itself
    if read:
        assert parse(body) == [0] * (values - 1)
        return
    with pytest.raises(Problem, match=f"more than `{MAX_VALUES}` values"):
        parse(body)


@pytest.mark.parametrize("raw", MALFORMED.values(), ids=MALFORMED.keys())
def test_refuses_what_is_not_strict_json(raw: bytes) -> None:
    with pytest.raises(Problem) as refused:
        parse(raw)
    assert (refused.value.code, refused.value.status) == ("malformed_json", 422)


def test_names_the_place_of_a_syntax_error() -> None:
    with pytest.raises(Problem, match=r"line 2, column 14, character 15"):
        parse(b'{\n"capability" "x"}')


@pytest.mark.parametrize(
    ("raw", "where"),
    [
        (b'{"a": 9007199254740993}', "line 1, column 7, character 6"),
        (b'{"\xc3\xa4": "9007199254740993",\n "b": [-9007199254740993]}', "line 2, column 8, character 33"),
    ],
)
def test_names_the_place_of_an_integer_that_no_double_holds(raw: bytes, where: str) -> None:
    with pytest.raises(Problem, match=rf"9007199254740993` is an integer beyond double precision: .* \({where}\)"):
        parse(raw)
    assert where == _where(b"!", raw)


def _where(mark: bytes, raw: bytes) -> str:
    """Return where the parser itself would say that something stands."""
    begin = raw.rindex(b"-" if b"-" in raw else b"9007199254740993")
    with pytest.raises(Problem) as refused:
        parse(raw[:begin] + mark + raw[begin:])
    return refused.value.detail.rpartition("(")[2].rstrip(")")


@given(st.integers(-(2**80), 2**80))
def test_an_integer_is_read_as_itself_or_not_at_all(number: int) -> None:
    try:
        assert parse(b'{"n": %d}' % number) == {"n": number}
        assert float(number) == number
    except Problem:
        assert float(number) != number or not -(2**63) <= number < 2**63


def test_names_a_key_that_is_given_twice() -> None:
    with pytest.raises(Problem, match="`force_n` is given twice"):
        parse(MALFORMED["duplicate key inside"])


@pytest.mark.parametrize(
    "raw",
    [
        b'{"a": "x:y", "b": {"c": [":", {"a": 1}]}, "c": 1}',
        b'{"a": 1e308, "b": -0.0, "c": 9007199254740992, "d": -9223372036854775808, "e": 9007199254740994}',
        b'{"a": 0.30000000000000004, "b": 123456789012345678901234567890e0, "c": 12345678901234567890.5}',
        b'{"a": "9007199254740993", "b": "\\"9007199254740993", "9007199254740993": "\\\\"}',
        b'{"a": "\\ud83d\\ude00", "b": "\\u0000"}',
        b"[" * MAX_DEPTH + b"]" * MAX_DEPTH,
    ],
)
def test_reads_what_is_strict_json(raw: bytes) -> None:
    assert parse(raw) == orjson.loads(raw)


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=12,
)


@given(JSON)
def test_reads_back_whatever_json_can_say(value: object) -> None:
    try:
        raw = json.dumps(value).encode()
        expected = orjson.loads(raw)
    except orjson.JSONDecodeError:  # half a surrogate pair, which nothing here takes
        return
    assert parse(raw) == expected


@given(st.dictionaries(st.sampled_from(["a", "b", ":", '"']), JSON, min_size=1), st.data())
def test_refuses_every_object_with_a_key_given_twice(value: dict[str, object], data: st.DataObject) -> None:
    again = data.draw(st.sampled_from(sorted(value)))
    members = [f"{json.dumps(key)}: {json.dumps(item)}" for key, item in [*value.items(), (again, None)]]
    with pytest.raises(Problem):
        parse(("{" + ", ".join(members) + "}").encode())


@pytest.mark.parametrize(
    ("change", "field", "valid"),
    [
        ({"capability": None}, "capability", "valid is a text"),
        ({"capability": ""}, "capability", "at least 1 characters"),
        ({"capability": "x" * 129}, "capability", "at most 128 characters"),
        ({"params": [1]}, "params", "valid is an object"),
        ({"params": "x"}, "params", "valid is an object"),
        ({"mode": "reckless"}, "mode", "'normal' or 'careful'"),
        ({"preconditions": "arm_ready"}, "preconditions", "valid is a list"),
        ({"preconditions": ["x"] * 65}, "preconditions", "at most 64 items"),
        ({"recovery_preference": "hope"}, "recovery_preference", "'RETRY'"),
        ({"recovery_preference": "hope"}, "recovery_preference", "is `hope`: "),
        ({"recovery_preference": ["retry"]}, "recovery_preference", "'RETRY'"),
        ({"metadata": 7}, "metadata", "is `7`: valid is an object"),
        ({"capability": True}, "capability", "is `true`: valid is a text"),
        ({"profile": "sim-relaxed"}, "profile", "is unknown: valid are capability, params"),
        ({"params": {"note": "x" * (MAX_TEXT + 1)}}, "params.note", f"at most {MAX_TEXT} characters"),
        ({"params": {"a": [{"b": "x" * (MAX_TEXT + 1)}]}}, "params.a.0.b", f"at most {MAX_TEXT} characters"),
        ({"params": {"k" * 129: 1}}, "params", "valid are at most 128"),
    ],
)
def test_names_the_field_that_is_wrong_and_what_would_be_valid(
    change: dict[str, object], field: str, valid: str
) -> None:
    with pytest.raises(Problem) as refused:
        to_model({**PROPOSAL, **change}, ProposalBody)
    assert refused.value.code == "request_invalid"
    assert refused.value.errors[0]["field"] == field
    assert valid in refused.value.errors[0]["message"]


def test_says_that_a_field_is_missing() -> None:
    with pytest.raises(Problem) as refused:
        to_model({"decision": "approve"}, ResolveBody)
    assert refused.value.errors == ({"field": "digest", "message": "is missing"},)


@pytest.mark.parametrize("value", [[], "x", 7, 7.5, True, None])
def test_refuses_a_body_that_is_no_object(value: object) -> None:
    with pytest.raises(Problem, match="valid is an object"):
        to_model(value, EmptyBody)


def test_fills_in_what_may_be_left_out() -> None:
    body = to_model({"capability": "x"}, ProposalBody)
    assert (body.params, body.cell, body.mode, body.preconditions, body.metadata) == ({}, None, None, [], {})


@pytest.mark.parametrize("written", ["retry", "RETRY"])
def test_reads_a_strategy_in_the_spelling_of_policy_files_too(written: str) -> None:
    assert to_model({"capability": "x", "recovery_preference": written}, ProposalBody).recovery_preference == "RETRY"


def test_knows_every_strategy() -> None:
    assert set(StrategyName.__args__) == {strategy.value for strategy in Strategy}


@pytest.mark.parametrize("said", [None, "application/json", "Application/JSON ; charset=UTF-8", "application/json;"])
def test_reads_json_by_its_media_type(said: str | None) -> None:
    check_media_type(said)


@pytest.mark.parametrize(
    "said",
    ["text/plain", "application/x-www-form-urlencoded", "application/json; charset=utf-16", "", "application/jsonp"],
)
def test_refuses_another_media_type(said: str) -> None:
    with pytest.raises(Problem) as refused:
        check_media_type(said)
    assert refused.value.status == 415
