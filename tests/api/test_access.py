from __future__ import annotations

import pytest
from fastapi import APIRouter, FastAPI
from starlette.responses import Response

from app.api import pages
from app.api.access import ACCESS, WEBSOCKET, GuardedRoute, RouteUnguarded, verify_routes
from tests.api.conftest import House, eventually

pytestmark = pytest.mark.anyio

# Who may do what, spelled out once more by hand: a = agent, o = operator, e = engineer, u = auditor, c = cell.
EXPECTED = {
    "POST /v1/invocations": "a",
    "GET /v1/invocations": "aoeu",
    "GET /v1/invocations/{id}": "aoeu",
    "GET /v1/invocations/{id}/trace": "aoeu",
    "POST /v1/invocations/{id}/cancel": "ao",
    "POST /v1/check": "aoeu",
    "GET /v1/escalations": "oeu",
    "GET /v1/escalations/{id}": "oeu",
    "POST /v1/escalations/{id}/resolve": "o",
    "POST /v1/escalations/{id}/acknowledge": "o",
    "GET /v1/grants": "oeu",
    "POST /v1/grants": "o",
    "POST /v1/grants/{id}/revoke": "o",
    "GET /v1/reviews": "oeu",
    "POST /v1/reviews": "oeu",
    "POST /v1/reviews/{id}/resolve": "oeu",
    "POST /v1/invocations/{id}/pause": "o",
    "POST /v1/invocations/{id}/resume": "o",
    "POST /v1/invocations/{id}/stop": "o",
    "POST /v1/invocations/{id}/rollback": "o",
    "POST /v1/invocations/{id}/takeover": "o",
    "POST /v1/invocations/{id}/release": "o",
    "POST /v1/cells/{id}/takeover": "o",
    "POST /v1/cells/{id}/estop": "aoeuc",
    "POST /v1/cells/{id}/reset": "o",
    "PUT /v1/cells/{id}/profile": "oe",
    "GET /v1/cells": "aoeu",
    "GET /v1/capabilities": "aoeu",
    "GET /v1/policies/active": "aoeu",
    "GET /v1/policies/active/watch": "oeu",
    "GET /v1/policies": "oeu",
    "POST /v1/policies": "e",
    "GET /v1/policies/{digest}": "oeu",
    "GET /v1/policies/{digest}/files": "oeu",
    "GET /v1/policies/{digest}/diff": "oeu",
    "POST /v1/policies/{digest}/activate": "e",
    "GET /v1/policies/{digest}/shadow": "oeu",
    "POST /v1/policies/{digest}/shadow": "e",
    "GET /v1/schemas": "aoeu",
    "GET /v1/schemas/{name}": "aoeu",
    "GET /v1/audit/events": "oeu",
    "GET /v1/audit/checkpoint": "oeu",
    "GET /v1/audit/verify": "oeu",
    "GET /v1/audit/telemetry/{id}": "oeu",
    "GET /v1/audit/telemetry/{id}/mcap": "oeu",
    "GET /v1/events": "oeu",
    "WS /v1/cells/{id}/link": "c",
    "WS /v1/console": "oeu",
    **{
        f"GET {path}": "public" for path in ("/", "/live", "/audit", "/policy", "/fleet", "/icon.svg", "/assets/{file}")
    },
    "GET /healthz": "public",
    "GET /readyz": "public",
    "GET /openapi.json": "public",
}
KEYS = {"agent": "a", "operator": "o", "operator_2": "o", "engineer": "e", "auditor": "u", "cell": "c"}


def routes_of(house: House) -> set[str]:
    found: set[str] = set()
    for route in house.app.routes:
        for method in getattr(route, "methods", None) or {WEBSOCKET}:
            found.add(f"{method} {route.path}")  # type: ignore[attr-defined]
    return found


async def test_every_route_stands_in_the_table_and_no_other(house: House) -> None:
    assert routes_of(house) == set(EXPECTED)


@pytest.mark.parametrize("key", [*KEYS, None])
async def test_every_route_lets_in_exactly_the_roles_it_should(house: House, key: str | None) -> None:
    async with house.client(key) as client:
        for route in sorted(routes_of(house)):
            method, path = route.split(" ")
            if method == WEBSOCKET:
                continue  # test_links walks the websocket
            path = path.replace("{id}", "nothing").replace("{file}", "nothing")
            async with client.stream(method, path, headers={"content-type": "application/json"}) as answer:
                code = "" if answer.is_success else await problem_code(answer)
            public = EXPECTED[route] == "public"
            if key is None and not public:
                assert (answer.status_code, code) == (401, "token_missing"), route
                assert answer.headers["www-authenticate"].startswith("Bearer")
            elif public or KEYS[key or "agent"] in EXPECTED[route]:
                assert answer.status_code not in {401, 403}, route
            else:
                assert (answer.status_code, code) == (403, "role_forbidden"), route


async def problem_code(answer: object) -> str:
    await answer.aread()  # type: ignore[attr-defined]
    if not answer.headers["content-type"].startswith("application/"):  # type: ignore[attr-defined]
        return ""  # the page that says how to build the console
    return answer.json().get("code", "")  # type: ignore[attr-defined]


async def nothing(request: object) -> Response:
    return Response()


def test_a_route_that_nobody_entered_cannot_be_built() -> None:
    router = APIRouter(route_class=GuardedRoute)
    with pytest.raises(RouteUnguarded, match="`GET /v1/backdoor` has no entry"):
        router.add_api_route("/v1/backdoor", nothing, methods=["GET"])


def test_a_route_that_does_not_ask_the_table_stops_the_start() -> None:
    app = FastAPI(openapi_url=None)
    app.router.add_api_route("/healthz", nothing, methods=["GET"])
    with pytest.raises(RouteUnguarded, match="no `GuardedRoute`"):
        verify_routes(app.routes)


def test_an_entry_without_a_route_stops_the_start() -> None:
    with pytest.raises(RouteUnguarded, match="routes that do not exist"):
        verify_routes([])


def test_only_what_holds_no_secret_is_public() -> None:
    public = {path for (_, path), roles in ACCESS.items() if roles is None}
    assert public == {"/healthz", "/readyz", "/openapi.json", *pages.VIEWS, pages.ICON, pages.ASSETS}


async def test_a_method_that_a_path_does_not_know_is_answered_with_all_that_it_knows(house: House) -> None:
    known: dict[str, set[str]] = {}
    for method, path in ACCESS:
        if method != WEBSOCKET:
            known.setdefault(path, set()).add(method)
    assert known["/v1/invocations"] == {"GET", "POST"}
    async with house.client(None) as anybody:
        for path, methods in known.items():
            here = path.replace("{id}", "x").replace("{digest}", "x").replace("{name}", "x").replace("{file}", "x")
            answer = await anybody.request("DELETE", here)
            assert (answer.status_code, answer.json()["code"]) == (405, "method_not_allowed"), path
            headless = {"HEAD"} if "GET" in methods else set()
            assert answer.headers["allow"] == ", ".join(sorted(methods | headless)), path
        assert (await anybody.request("GET", "/v1/check")).headers["allow"] == "POST"


@pytest.mark.parametrize("key", ["auditor", "agent", None])
async def test_the_head_alone_is_what_get_would_answer_with_to_the_same_people(house: House, key: str | None) -> None:
    apart = {"date", "content-length"}  # how much a page of the log is differs as the log grows
    async with house.client(key) as client:
        for method, path in ACCESS:
            if method == "GET":
                here = path.replace("{id}", "x").replace("{digest}", "x").replace("{name}", "x").replace("{file}", "x")
                async with client.stream("GET", here) as whole:
                    said = {name: value for name, value in whole.headers.items() if name not in apart}
                head = await client.head(here)
                assert (head.status_code, head.content) == (whole.status_code, b""), path
                told = {name: value for name, value in head.headers.items() if name not in apart}
                assert told == {name: value for name, value in said.items() if name != "transfer-encoding"}, path
        assert (await client.head("/v1/check")).status_code == 405


async def test_the_head_of_a_stream_ends_and_leaves_its_seat(house: House) -> None:
    async with house.client("auditor") as auditor:
        assert (await auditor.head("/v1/events")).status_code == 200
        await eventually(lambda: house.app.state.parts.streams.taken == 0)
