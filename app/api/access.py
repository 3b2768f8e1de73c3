"""Who may use which route: one table, and the route class that holds every route to it.

A route that is not in `ACCESS` cannot be built, so a forgotten entry stops the server's start instead of opening a
door. What a role may see within a route (an agent only its own invocations) is decided where the route is written.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from inspect import signature
from typing import TYPE_CHECKING, Any, cast
from urllib.parse import parse_qsl

from fastapi.routing import APIRoute
from starlette.requests import HTTPConnection, Request

from app.api.parts import parts_of
from app.api.problems import Problem
from app.api.staying import GONE, STILL_KNOWN_S
from app.clock import monotonic_s
from app.governance.model import Role

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Sequence

    from pydantic import BaseModel
    from starlette.responses import Response
    from starlette.routing import BaseRoute
    from starlette.types import Receive, Scope, Send

    from app.api.auth import Principals
    from app.runtime.broadcast import Broadcast
    from app.runtime.invocation import Principal

AGENT, OPERATOR, ENGINEER, AUDITOR, CELL = Role.AGENT, Role.OPERATOR, Role.ENGINEER, Role.AUDITOR, Role.CELL
PEOPLE = frozenset({OPERATOR, ENGINEER, AUDITOR})
READERS = PEOPLE | {AGENT}
OPERATORS = frozenset({OPERATOR})
AGENTS = frozenset({AGENT})
ENGINEERS = frozenset({ENGINEER})
ANYONE = frozenset(Role)  # with a token
WEBSOCKET = "WS"

PUBLIC: frozenset[Role] | None = None  # no token asked for
PATIENCE = b"reins-patience"  # the newest beat that a console has heard, and how many ms from that on it waits
MOST = 20  # of a query's names that a refusal lists

ACCESS: Mapping[tuple[str, str], frozenset[Role] | None] = {
    ("POST", "/v1/invocations"): AGENTS,
    ("GET", "/v1/invocations"): READERS,
    ("GET", "/v1/invocations/{id}"): READERS,
    ("GET", "/v1/invocations/{id}/trace"): READERS,
    ("POST", "/v1/invocations/{id}/cancel"): frozenset({AGENT, OPERATOR}),
    ("POST", "/v1/check"): READERS,
    ("GET", "/v1/escalations"): PEOPLE,
    ("GET", "/v1/escalations/{id}"): PEOPLE,
    ("POST", "/v1/escalations/{id}/resolve"): OPERATORS,
    ("POST", "/v1/escalations/{id}/acknowledge"): OPERATORS,
    ("GET", "/v1/grants"): PEOPLE,
    ("POST", "/v1/grants"): OPERATORS,
    ("POST", "/v1/grants/{id}/revoke"): OPERATORS,
    ("GET", "/v1/reviews"): PEOPLE,
    ("POST", "/v1/reviews"): PEOPLE,
    ("POST", "/v1/reviews/{id}/resolve"): PEOPLE,
    ("POST", "/v1/invocations/{id}/pause"): OPERATORS,
    ("POST", "/v1/invocations/{id}/resume"): OPERATORS,
    ("POST", "/v1/invocations/{id}/stop"): OPERATORS,
    ("POST", "/v1/invocations/{id}/rollback"): OPERATORS,
    ("POST", "/v1/invocations/{id}/takeover"): OPERATORS,
    ("POST", "/v1/invocations/{id}/release"): OPERATORS,
    ("POST", "/v1/cells/{id}/takeover"): OPERATORS,
    ("POST", "/v1/cells/{id}/estop"): ANYONE,  # a stop outranks everyone (design, rule 6)
    ("POST", "/v1/cells/{id}/reset"): OPERATORS,
    ("PUT", "/v1/cells/{id}/profile"): frozenset({OPERATOR, ENGINEER}),
    ("GET", "/v1/cells"): READERS,
    ("GET", "/v1/capabilities"): READERS,
    ("GET", "/v1/policies/active"): READERS,
    ("GET", "/v1/policies/active/watch"): PEOPLE,
    ("GET", "/v1/policies"): PEOPLE,
    ("POST", "/v1/policies"): ENGINEERS,
    ("GET", "/v1/policies/{digest}"): PEOPLE,
    ("GET", "/v1/policies/{digest}/files"): PEOPLE,
    ("GET", "/v1/policies/{digest}/diff"): PEOPLE,
    ("POST", "/v1/policies/{digest}/activate"): ENGINEERS,
    ("GET", "/v1/policies/{digest}/shadow"): PEOPLE,
    ("POST", "/v1/policies/{digest}/shadow"): ENGINEERS,
    ("GET", "/v1/schemas"): READERS,
    ("GET", "/v1/schemas/{name}"): READERS,
    ("GET", "/v1/audit/events"): PEOPLE,
    ("GET", "/v1/audit/checkpoint"): PEOPLE,
    ("GET", "/v1/audit/verify"): PEOPLE,
    ("GET", "/v1/audit/telemetry/{id}"): PEOPLE,
    ("GET", "/v1/audit/telemetry/{id}/mcap"): PEOPLE,
    ("GET", "/v1/events"): PEOPLE,
    (WEBSOCKET, "/v1/cells/{id}/link"): frozenset({CELL}),
    (WEBSOCKET, "/v1/console"): PEOPLE,
    **{("GET", path): PUBLIC for path in ("/", "/live", "/audit", "/policy", "/fleet", "/icon.svg", "/assets/{file}")},
    ("GET", "/healthz"): PUBLIC,
    ("GET", "/readyz"): PUBLIC,
    ("GET", "/openapi.json"): PUBLIC,
}

# What restrains, or may: nothing in a query stands in its way.
RESTRAINING = frozenset(
    {
        "/v1/cells/{id}/estop",
        "/v1/escalations/{id}/acknowledge",
        "/v1/escalations/{id}/resolve",
        "/v1/grants/{id}/revoke",
        "/v1/invocations/{id}/cancel",
        "/v1/invocations/{id}/pause",
        "/v1/invocations/{id}/release",
        "/v1/invocations/{id}/stop",
    }
)

_CALLER = "reins.caller"


class RouteUnguarded(Exception):
    """A route stands in the application and not in `ACCESS`, or the other way round."""


def allowed_roles(method: str, path: str) -> frozenset[Role] | None:
    """Return the roles that may use a route, None for a public one. Raises `RouteUnguarded`."""
    try:
        return ACCESS[method, path]
    except KeyError:
        raise RouteUnguarded(f"`{method} {path}` has no entry in `ACCESS`: name the roles that may use it") from None


def authorize(connection: HTTPConnection, principals: Principals, allowed: frozenset[Role] | None) -> Principal | None:
    """Let the request through, or refuse it before anything else of it is read. Returns who asks; None on public ones.

    Raises:
        Problem: 401 without a valid token, 403 `role_forbidden` with the wrong role.
    """
    if allowed is None:
        return None
    principal = principals.authenticate(connection.headers)
    check_role(principal, allowed)
    connection.scope[_CALLER] = principal, allowed, monotonic_s()
    return principal


def check_role(principal: Principal, allowed: frozenset[Role]) -> None:
    """Refuse whoever has another role. Raises `Problem`: 403 `role_forbidden`."""
    if principal.role not in allowed:
        valid = ", ".join(sorted(role.value for role in allowed))
        raise Problem("role_forbidden", f"the role `{principal.role.value}` may not do this: valid are {valid}")


def caller(connection: HTTPConnection) -> Principal:
    """Return who was let through, as whoever asks for that has read what they say; on a public route that is a bug.

    A body may take its time, and a long poll does: who began it long ago is asked again who they are.

    Raises:
        Problem: as `authorize`, where they would not be let in by now.
    """
    _, allowed, since_s = connection.scope[_CALLER]
    if monotonic_s() - since_s >= STILL_KNOWN_S:
        authorize(connection, parts_of(connection).principals, allowed)
    return cast("Principal", connection.scope[_CALLER][0])


def speaker(request: Request) -> Principal:
    """Return who was let through to say what lets something move: their word counts while they wait for its answer.

    Raises:
        Problem: as `caller`.
    """
    gone, broadcast = request.scope.get(GONE), parts_of(request).broadcast
    until = [value for name, value in request.scope["headers"] if name == PATIENCE]

    def waits() -> bool:
        return not (gone is not None and gone()) and all(_goes_on(broadcast, patience) for patience in until)

    return replace(caller(request), waits=waits)


def _goes_on(broadcast: Broadcast, patience: bytes) -> bool:
    """Say whether somebody's patience, so many ms from a beat on, is not over; one that cannot be read is."""
    said = re.fullmatch(rb"(\d{1,15}) (\d{1,9})", patience)
    return said is not None and broadcast.since_beat_s(int(said[1])) <= int(said[2]) / 1000.0


class GuardedRoute(APIRoute):
    """A route that asks `ACCESS` who may come in, before anything else of the request is read.

    An endpoint that takes the request alone reads it by itself: it is called directly, because what FastAPI would do
    around it (parameters, dependencies, exit stacks) costs more than the decision it leads to.
    """

    def __init__(self, path: str, endpoint: Callable[..., Any], **options: Any) -> None:  # noqa: ANN401  # FastAPI's own
        """Build the route. Raises `RouteUnguarded`."""
        super().__init__(path, endpoint, **options)
        self.direct: Callable[[Request], Coroutine[Any, Any, Response]] | None = None
        if list(signature(endpoint).parameters) == ["request"]:
            guarded = self.direct = self._guard(endpoint)

            async def app(scope: Scope, receive: Receive, send: Send) -> None:
                response = await guarded(Request(scope, receive, send))
                await response(scope, receive, send)

            self.app = app

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return FastAPI's handler behind the guard. Raises `RouteUnguarded`."""
        return self._guard(super().get_route_handler())

    def _guard(
        self, handler: Callable[[Request], Coroutine[Any, Any, Response]]
    ) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        (method,) = cast("set[str]", self.methods)  # one method a route: the table names them one by one
        allowed = allowed_roles(method, self.path)
        reads_query = self.path not in RESTRAINING
        knows_query = reads_query and allowed is not PUBLIC
        models = [cast("type[BaseModel]", one.field_info.annotation) for one in self.dependant.query_params]
        taken = [name for model in models for name in model.model_fields]

        async def guarded(request: Request) -> Response:
            parts = parts_of(request)
            principal = authorize(request, parts.principals, allowed)
            if reads_query:
                _refuse_twice(request.scope["query_string"])
            if knows_query:
                _refuse_unknown(request.scope["query_string"], taken)
            if principal is not None:
                parts.governor.kernel.heard(principal)  # whoever speaks is on duty
            return await handler(request)

        return guarded


def _refuse_unknown(query: bytes, taken: Sequence[str]) -> None:
    """Refuse what a route does not know: whoever sent it believes that it counts.

    Raises:
        Problem: 422 `request_invalid`, naming what the route takes.
    """
    if query and (names := [name for name in _names(query) if name not in taken]):
        valid = f"valid are {', '.join(taken)}" if taken else "this route takes no parameters"
        errors = [{"field": f"query.{name[:100]}", "message": f"is unknown: {valid}"} for name in names]
        first = errors[0]
        raise Problem(
            "request_invalid", f"a parameter is not valid: `{first['field']}` {first['message']}", errors=errors[:MOST]
        )


def _names(query: bytes) -> list[str]:
    return [name for name, _ in parse_qsl(query.decode("latin-1"), keep_blank_values=True)]


def _refuse_twice(query: bytes) -> None:
    """Refuse a query that says a thing twice: of two values one would count, and nobody said which.

    Raises:
        Problem: 400 `given_twice`.
    """
    if b"&" not in query:
        return
    seen: set[str] = set()
    for name in _names(query):
        if name in seen:
            raise Problem("given_twice", f"the parameter `{name[:100]}` is given more than once: valid is once")
        seen.add(name)


def direct_routes(
    routes: Iterable[BaseRoute],
) -> dict[tuple[str, str], Callable[[Request], Coroutine[Any, Any, Response]]]:
    """Return the routes that can be found by method and path alone and read their requests by themselves."""
    return {
        (method, route.path): route.direct
        for route in routes
        if isinstance(route, GuardedRoute) and route.direct is not None and not route.param_convertors
        for method in cast("set[str]", route.methods)
    }


def verify_routes(routes: Iterable[BaseRoute]) -> None:
    """Check that application and table name the same routes, and that each is held to the table.

    Raises:
        RouteUnguarded: a route without an entry, an entry without a route, or a route of another class.
    """
    present: set[tuple[str, str]] = set()
    for route in routes:
        path = str(getattr(route, "path", route))
        methods: set[str] = getattr(route, "methods", None) or {WEBSOCKET}
        for method in methods:
            allowed_roles(method, path)
            present.add((method, path))
        if methods != {WEBSOCKET} and not isinstance(route, GuardedRoute):
            raise RouteUnguarded(f"`{path}` is no `GuardedRoute`: valid are routes that ask the table")
    if missing := ACCESS.keys() - present:
        raise RouteUnguarded(f"`ACCESS` names routes that do not exist: {sorted(missing)}")
