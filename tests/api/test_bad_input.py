from __future__ import annotations

import asyncio
import gzip
import json
from collections.abc import AsyncIterator, Mapping
from urllib.parse import urlsplit

import pytest

from app.api.access import ACCESS, PUBLIC, RESTRAINING
from app.api.console import PATH
from tests.api.conftest import House
from tests.api.test_wire import MALFORMED

pytestmark = pytest.mark.anyio

ROUTES = {
    "/v1/invocations": "agent",
    "/v1/check": "agent",
    "/v1/escalations/esc_1/resolve": "operator",
}
REFUSED = {"rejected", "denied", "deferred"}
JSON = {"content-type": "application/json"}


def proposal(**params: object) -> bytes:
    return json.dumps({"capability": "grasp_object", "params": {"object_id": "mug_1", **params}}).encode()


STRANGE = {
    **MALFORMED,
    "wrong type": proposal(force_n="much"),
    "unknown field": b'{"capability": "grasp_object", "params": {"object_id": "mug_1"}, "profile": "sim-relaxed"}',
    "unknown parameter": proposal(colour="red"),
    "no object": b'["grasp_object"]',
    "1e308": proposal(force_n=1e308),
    "minus 1e308": proposal(speed_mps=-1e308),
    "huge integer": b'{"capability": "grasp_object", "params": {"object_id": "mug_1", "force_n": 1'
    + b"0" * 300
    + b"}}",
    "endless integer": b'{"capability": "x", "params": {"force_n": 1' + b"0" * 5000 + b"}}",
    "empty name": b'{"capability": ""}',
    "empty object": proposal(object_id=""),
    "NUL": proposal(object_id="a\x00b"),
    "long text": proposal(object_id="x" * 5000),
    "1 MB text": proposal(object_id="x" * 1_000_000),
    "over 256 kB": proposal(note="x" * 300_000),
    "unknown capability": b'{"capability": "fly_to"}',
    "unknown object": proposal(object_id="unicorn"),
    "unknown zone": b'{"capability": "inspect_area", "params": {"area": "attic"}}',
    "unknown cell": b'{"capability": "navigate_to", "params": {"target": "dock"}, "cell": "nowhere"}',
    "metadata nobody can store": b'{"capability": "x", "metadata": {"n": 99999999999999999999}}',
}

UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}


def raw(start: str, fields: Mapping[str, str | None], body: bytes = b"") -> bytes:
    """Return a request as it goes over the wire; a field that is None is left out."""
    lines = [start, *(f"{name}: {value}" for name, value in {"Host": "here", **fields}.items() if value is not None)]
    return "\r\n".join([*lines, "", ""]).encode("latin-1") + body


NO_REQUEST = {
    "no HTTP": b"\x16\x03\x01\x02\x00\x01\r\n\r\n",
    "HTTP/2": b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    "no path": raw("GET /v1/\xe9 HTTP/1.1", {}),
    "no length": raw("POST /v1/check HTTP/1.1", {"Content-Length": "much"}),
    "no chunk": raw("POST /v1/check HTTP/1.1", {"Transfer-Encoding": "chunked"}, b"zz\r\n"),
    "tunnel": raw("CONNECT elsewhere:443 HTTP/1.1", {}),
}
CONSOLE = f"GET {PATH} HTTP/1.1"
NO_HANDSHAKE = {
    "no key": raw(CONSOLE, {**UPGRADE, "Sec-WebSocket-Key": None}),
    "a version nobody knows": raw(CONSOLE, {**UPGRADE, "Sec-WebSocket-Version": "9"}),
    "many fields": raw(CONSOLE, UPGRADE | {f"X-{number}": "y" for number in range(200)}),
    "a long field": raw(CONSOLE, UPGRADE | {"X": "y" * 10_000}),
    "a long path": raw(f"GET {PATH}?{'y' * 10_000} HTTP/1.1", UPGRADE),
}
# Just over what is read, so that nothing is left unread when the connection ends.
TOO_LARGE = {
    "a long path": raw(f"GET /healthz?{'y' * 65_536} HTTP/1.1", {}),
    "many fields": raw("GET /healthz HTTP/1.1", {f"X-{number}": "y" * 40 for number in range(1_450)}),
}
# What wishes for a websocket in passing is a request like any other.
NO_WEBSOCKET = {
    "with a body": (raw("POST /v1/check HTTP/1.1", UPGRADE | {"Content-Length": "2"}, b"{}"), "token_missing"),
    "in chunks": (
        raw("POST /v1/check HTTP/1.1", UPGRADE | {"Transfer-Encoding": "chunked"}, b"2\r\n{}\r\n0\r\n\r\n"),
        "token_missing",
    ),
    "without a body": (raw("POST /v1/check HTTP/1.1", UPGRADE), "token_missing"),
    "a reader with a body": (raw(CONSOLE, UPGRADE | {"Content-Length": "2"}, b"{}"), "not_found"),
    "HTTP/1.0": (raw(f"GET {PATH} HTTP/1.0", UPGRADE), "not_found"),
    "where no websocket is": (raw("GET /v1/nowhere HTTP/1.1", UPGRADE), "not_found"),
}
BENEATH = {
    **{name: (sent, "http_malformed") for name, sent in NO_REQUEST.items()},
    **{name: (sent, "handshake_invalid") for name, sent in NO_HANDSHAKE.items()},
    **{f"{name}, too large": (sent, "head_too_large") for name, sent in TOO_LARGE.items()},
    **NO_WEBSOCKET,
}


@pytest.fixture
async def watched(house: House) -> AsyncIterator[House]:
    """Let a cell stand ready, so that a launch would be seen."""
    async with house.cell() as cell:
        yield house
        assert not cell.launches


@pytest.mark.parametrize("raw", STRANGE.values(), ids=STRANGE.keys())
async def test_strange_input_is_refused_and_launches_nothing(watched: House, raw: bytes) -> None:
    for path, key in ROUTES.items():
        async with watched.client(key) as client:
            answer = await client.post(path, content=raw, headers=JSON)
        if answer.is_success:
            assert answer.json()["status"] in REFUSED, f"{path}: {answer.text}"
        else:
            assert 400 <= answer.status_code < 500, f"{path}: {answer.text}"


async def test_a_body_without_declared_length_is_cut_off_too(house: House) -> None:
    async def endless() -> AsyncIterator[bytes]:
        for _ in range(20):
            yield b" " * 32_768

    async with house.client() as agent:
        answer = await agent.post("/v1/invocations", content=endless(), headers=JSON)
    assert (answer.status_code, answer.json()["code"]) == (413, "body_too_large")


async def test_two_tokens_are_nobodys(house: House) -> None:
    bearers = [("Authorization", f"Bearer {house.tokens[key]}") for key in ("agent", "operator")]
    async with house.client(None) as client:
        for method, path in (("GET", "/v1/cells"), ("POST", "/v1/invocations"), ("POST", "/v1/cells/x/estop")):
            answer = await client.request(method, path, headers=bearers)
            assert (answer.status_code, answer.json()["code"]) == (400, "given_twice")
            assert "`Authorization`" in answer.json()["detail"]


@pytest.mark.parametrize("path", ["/v1/invocations", "/v1/escalations", "/v1/audit/events", "/v1/cells"])
async def test_a_parameter_that_is_given_twice_is_refused(house: House, path: str) -> None:
    async with house.client("operator") as operator:
        answer = await operator.get(f"{path}?limit=1&status=&li%6dit=2")
    assert (answer.status_code, answer.json()["code"]) == (400, "given_twice")
    assert "`limit`" in answer.json()["detail"]


async def test_nothing_in_a_query_stands_in_a_stops_way(house: House) -> None:
    async with house.cell(), house.client("agent") as agent:
        assert (await agent.post("/v1/cells/workcell-1/estop?a=1&a=2")).status_code == 200


@pytest.mark.parametrize("path", sorted(RESTRAINING))
async def test_nothing_in_a_query_is_what_a_restraint_is_refused_for(house: House, path: str) -> None:
    async with house.client("operator") as operator:
        answer = await operator.post(path.replace("{id}", "x") + "?a=1&a=2", json={"then": "end"})
    assert "query" not in answer.text
    assert answer.json()["code"] != "given_twice"


@pytest.mark.parametrize("path", ROUTES)
async def test_a_compressed_body_is_refused(house: House, path: str) -> None:
    async with house.client(ROUTES[path]) as client:
        for encoding in ("gzip", "identity, br"):
            headers = {**JSON, "Content-Encoding": encoding}
            answer = await client.post(path, content=gzip.compress(b"{}"), headers=headers)
            assert (answer.status_code, answer.json()["code"]) == (415, "encoding_unsupported")
            assert f"`{encoding}`" in answer.json()["detail"]
        plain = await client.post(path, content=proposal(), headers={**JSON, "Content-Encoding": "identity"})
        assert plain.status_code in {200, 201, 422}
        both = [("content-type", "application/json"), ("content-type", "text/plain")]
        assert (await client.post(path, content=b"{}", headers=both)).json()["code"] == "given_twice"


@pytest.mark.parametrize(
    ("path", "value", "valid"),
    [
        ("/v1/audit/events?kind=zzz", "`zzz`", "admission"),
        ("/v1/invocations?status=zzz", "`zzz`", "running"),
        ("/v1/invocations?cursor=zzz", "`zzz`", "`next`"),
        ("/v1/audit/events?after=zzz", "`zzz`", "whole number"),
        ("/v1/audit/events?since=zzz", "`zzz`", "2026"),
        ("/v1/policies?cursor=zzz", "`zzz`", "`next`"),
    ],
)
async def test_a_parameter_out_of_place_is_named_with_what_is_valid(
    house: House, path: str, value: str, valid: str
) -> None:
    async with house.client("auditor") as auditor:
        answer = await auditor.get(path)
    problem = answer.json()
    assert (answer.status_code, problem["code"]) == (422, "request_invalid")
    assert value in problem["detail"]
    assert valid in problem["errors"][0]["message"]


READS = [
    path
    for (method, path), roles in ACCESS.items()
    if method == "GET" and path.startswith("/v1/") and roles is not PUBLIC
]


@pytest.mark.parametrize("path", READS)
async def test_no_route_passes_over_a_parameter_that_it_does_not_know(house: House, path: str) -> None:
    async with house.client("auditor") as auditor:
        answer = await auditor.get(path.replace("{", "").replace("}", ""), params={"colour": "red"})
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
    assert "`query.colour` is unknown" in answer.json()["detail"]
    assert answer.json()["errors"][0]["field"] == "query.colour"


async def test_an_unknown_parameter_is_told_which_there_are(house: House) -> None:
    async with house.client("operator") as operator:
        lists = await operator.get("/v1/grants", params={"state": "active"})
        takes_none = await operator.get("/v1/cells", params={"limit": 1})
    assert lists.json()["errors"][0]["message"] == "is unknown: valid are limit, cursor, status"
    assert takes_none.json()["errors"][0]["message"] == "is unknown: this route takes no parameters"


MAY_MOVE = [key for key in ACCESS if key[0] in {"POST", "PUT"} and key[1] not in RESTRAINING]


@pytest.mark.parametrize(("method", "path"), MAY_MOVE)
async def test_nothing_that_may_let_something_move_passes_over_a_query(house: House, method: str, path: str) -> None:
    role = min(ACCESS[method, path] or ())
    async with house.client(role) as client:
        for query in ("cell=workcell-2", "after=0"):
            answer = await client.request(method, f"{path.replace('{', '').replace('}', '')}?{query}", json={})
            assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
            assert f"`query.{query.partition('=')[0]}` is unknown" in answer.json()["detail"]


async def test_the_server_is_well_and_the_log_holds_afterwards(house: House) -> None:
    async with house.client("auditor") as auditor:
        assert (await auditor.get("/healthz")).status_code == 200
        verdict = (await auditor.get("/v1/audit/verify")).json()
    assert (verdict["ok"], verdict["first_bad"]) == (True, None)


async def test_every_answer_bears_the_security_headers(house: House) -> None:
    async with house.client() as agent:
        for path in ("/healthz", "/v1/capabilities", "/nowhere", "/v1/check"):
            headers = (await agent.get(path)).headers
            assert (headers["x-content-type-options"], headers["cache-control"]) == ("nosniff", "no-store")


async def test_a_failure_of_the_server_says_nothing_of_its_inside(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    def break_down() -> None:
        raise RuntimeError("secret detail")

    monkeypatch.setattr(house.runtime.governor, "cells", break_down)
    async with house.client() as agent:
        answer = await agent.get("/v1/cells")
    assert (answer.status_code, answer.json()["code"]) == (500, "internal")
    assert "secret" not in answer.text


@pytest.mark.parametrize(("path", "method"), [("/v1/cells", "cells"), ("/v1/invocations/inv_1", "invocation")])
async def test_what_a_server_that_stops_leaves_unanswered_is_a_problem_too(
    house: House, monkeypatch: pytest.MonkeyPatch, path: str, method: str
) -> None:
    def cut(*_: object) -> None:
        raise asyncio.CancelledError

    monkeypatch.setattr(house.runtime.governor, method, cut)
    async with house.client() as agent:
        answer = await agent.get(path)
    assert (answer.status_code, answer.json()["code"]) == (503, "record_unavailable")
    assert (answer.headers["retry-after"], answer.headers["x-content-type-options"]) == ("5", "nosniff")


@pytest.mark.parametrize(("sent", "code"), BENEATH.values(), ids=BENEATH)
async def test_what_no_route_is_asked_for_is_refused_as_a_problem_too(house: House, sent: bytes, code: str) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", urlsplit(house.url).port)
    async with asyncio.timeout(10):
        writer.write(sent)
        head, _, body = (await reader.read()).partition(b"\r\n\r\n")  # to the end: the connection is closed
    writer.close()
    problem = json.loads(body)
    assert problem["code"] == code
    assert head.startswith(b"HTTP/1.1 %d " % problem["status"])
    assert b"application/problem+json" in head
    assert b"\r\nconnection: close" in head.lower()
