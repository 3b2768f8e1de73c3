"""The application: every route, guarded and described, around the parts it is given.

Nothing is wired here: `create_app` takes the live parts of the server and serves them. `app.main` makes them.
"""

from __future__ import annotations

import asyncio
import gc
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import orjson
from fastapi import FastAPI
from fastapi.middleware.asyncexitstack import AsyncExitStackMiddleware
from starlette.exceptions import HTTPException
from starlette.middleware.exceptions import ExceptionMiddleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.websockets import WebSocket

from app import __version__
from app.api import agents, audits, console, documents, grants, links, operators, pages, policies, problems, schemas
from app.api.access import GuardedRoute, direct_routes, verify_routes
from app.api.frame import Frame
from app.api.openapi import Answers, answer, declare, describe
from app.api.parts import Parts, parts_of
from app.api.roll import Roll

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Mapping

    from starlette.types import ASGIApp, Receive, Scope, Send

    from app.api.auth import Principals
    from app.audit.store import AuditStore
    from app.governance.policy import PolicySet
    from app.runtime.broadcast import Broadcast
    from app.runtime.desk import Desk
    from app.runtime.feed import Feed
    from app.runtime.fleet import Fleet
    from app.runtime.governor import Governor
    from app.runtime.shadow import Shadow
    from app.runtime.versions import Versions

DESCRIPTION = """\
An agent proposes, Reins decides, a cell acts under watch, and a record stands.

Bearer tokens carry a role; every operation names the roles that may use it. A refusal of a *proposal* is an ordinary
answer with reasons; a refusal of a *request* is a problem (RFC 9457) with a stable `code`. Bodies are strict JSON of at
most 256 kB (4 MB for a candidate policy) and 10,000 values: unknown fields, keys given twice, NaN and numbers beyond
double precision are refused. Lists are `{items, next}`; give `next` back as `cursor` (or `after`, in the log). HEAD
answers as GET does, without the body.

What lets something move counts while whoever said it waits: with their connection over, or later than `Reins-Patience`
says (`<beat> <ms>`: so long after that beat of the console's socket), it is refused with 409 `given_up`.

What no operation describes: a path there is not is answered with 404 `not_found`; a method that a path does not know
with 405 `method_not_allowed`, and `Allow` names those it does; what should open a websocket and cannot, with 400
`handshake_invalid`.
"""


COLLECT_AFTER_OBJECTS = 20_000


class Application(FastAPI):
    """FastAPI without the layers that this application does for itself."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a connection as Starlette does; asking whether it is traced would cost every request its share."""
        scope["app"] = self
        if self.middleware_stack is None:
            self.middleware_stack = self.build_middleware_stack()
        await self.middleware_stack(scope, receive, send)

    def build_middleware_stack(self) -> ASGIApp:
        """Return the routes inside three layers: the frame, the exceptions that have problems, FastAPI's exit stack.

        Starlette's error page is the frame's work here, body limits are `wire`'s, and nothing is traced.
        """
        handlers = dict(self.exception_handlers)
        inner = AsyncExitStackMiddleware(self.router)
        return Frame(ExceptionMiddleware(inner, handlers=handlers), direct_routes(self.routes))


def create_app(  # noqa: PLR0913  # every part of a server, by name
    *,
    governor: Governor,
    desk: Desk,
    fleet: Fleet,
    feed: Feed,
    broadcast: Broadcast,
    store: AuditStore,
    policy: Callable[[], PolicySet],
    versions: Versions,
    shadow: Shadow,
    principals: Principals,
    checks: Mapping[str, Callable[[], str | None]] | None = None,
) -> FastAPI:
    """Return the application over live parts.

    Args:
        governor: takes proposals and interventions.
        desk: owns escalations.
        fleet: owns cells and their links.
        feed: fans events out.
        broadcast: what consoles are shown.
        store: the record.
        policy: returns the policy set in force.
        versions: every version of policy.
        shadow: what a candidate would decide on live traffic.
        principals: who may come in.
        checks: further questions of readiness about cells, by name; each returns what is broken, or None.

    Raises:
        RouteUnguarded: a route and the table of roles do not match.
    """
    app = Application(
        title="Reins", version=__version__, openapi_url=None, docs_url=None, redoc_url=None, lifespan=_lifespan
    )
    app.router.route_class = GuardedRoute
    app.router.redirect_slashes = False
    app.state.parts = Parts(
        governor=governor,
        desk=desk,
        fleet=fleet,
        feed=feed,
        broadcast=broadcast,
        store=store,
        policy=policy,
        versions=versions,
        shadow=shadow,
        principals=principals,
        roll=Roll(principals, store),
        checks=dict(checks or {}),
    )
    app.state.pages = pages.read_pages(pages.FOLDER)
    problems.install(app)
    app.router.default = _nowhere
    for room in (agents, operators, grants, policies, schemas, audits, links, console, pages):
        room.register(app.router)
    declare(app.router, "GET /healthz", healthz, Answers(model=documents.Health))
    declare(app.router, "GET /readyz", readyz, Answers(model=documents.Readiness, also={503: documents.Readiness}))
    declare(app.router, "GET /openapi.json", openapi, Answers(model=documents.Anything))
    verify_routes(app.routes)
    app.state.openapi = None
    return app


async def _nowhere(scope: Scope, receive: Receive, send: Send) -> None:
    """Say that there is nothing here, to a websocket too."""
    if scope["type"] != "websocket":
        raise HTTPException(404)
    answer = problems.as_problem(HTTPException(404)).response(scope["path"])
    await WebSocket(scope, receive, send).send_denial_response(answer)


async def healthz(request: Request) -> Response:
    """Say that the process answers, whether it and its cells can keep their records, and whether policy is refuted.

    Without a record only what restrains is obeyed: everywhere, or on the cells that `broken` names. What the last
    verification found wrong stands there, and lets nothing launch. A policy in force
    that does not pass its proofs goes on deciding; each decision fails closed by itself. Grants that only the database
    knows, and not the log, hold for nothing. While the file of principals cannot be read, those read last hold.
    """
    parts = parts_of(request)
    await parts.store.look()
    broken = {} if parts.store.healthy else {"store": parts.store.reason}
    if parts.store.damage is not None:
        broken["record"] = parts.store.damage
    broken |= parts.fleet.faults()
    if parts.governor.broken:
        broken["background"] = parts.governor.broken
    register = parts.desk.register
    if said := "; ".join(filter(None, (register.trouble(), register.stored.trouble()))):
        broken["rows"] = said
    if (unfounded := parts.desk.grants.trouble()) is not None:
        broken["grants"] = unfounded
    if (unreadable := parts.principals.trouble()) is not None:
        broken["principals"] = unreadable
    if (refuted := parts.versions.proving.trouble()) is not None:
        broken["policy"] = refuted
    return answer({"status": "degraded" if broken else "ok", "version": __version__, "broken": broken})


async def readyz(request: Request) -> Response:
    """Say whether a proposal could launch; 503 while not.

    `broken` says what is in the way: the store, the policy, and each cell where none can take a proposal. Where one
    can, what ails the others is `impaired`, absent where nothing does.
    """
    parts = parts_of(request)
    await parts.store.look()
    broken = parts.governor.ready()
    ailing = parts.fleet.unusable()
    for name, question in parts.checks.items():
        if (trouble := question()) is not None:
            ailing[name] = trouble
    if parts.fleet.problems():
        broken |= ailing
    document = {"ready": not broken, "broken": broken}
    if impaired := {name: why for name, why in ailing.items() if name not in broken}:
        document["impaired"] = impaired
    return answer(document, 503 if broken else 200)


async def openapi(request: Request) -> Response:
    """Return this description."""
    return Response(await described(request.app), media_type="application/json")


async def described(app: FastAPI) -> bytes:
    """Return the OpenAPI document; the first who asks has it written, which takes as long as a tenth of a start."""
    if app.state.openapi is None:
        app.state.openapi = asyncio.create_task(asyncio.to_thread(lambda: orjson.dumps(describe(app, DESCRIPTION))))
    return await asyncio.shield(app.state.openapi)


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncGenerator[None]:
    # What was built at the start stays for good: the collector need not walk it again while requests wait. What a
    # request builds is gone with it, so looking for cycles after every 700 objects finds little at a high price.
    gc.collect()
    gc.freeze()
    gc.set_threshold(COLLECT_AFTER_OBJECTS, 10, 10)
    parts: Parts = app.state.parts
    await parts.roll.open()
    keeping = asyncio.create_task(parts.roll.keep(), name="roll")
    try:
        yield
    finally:
        keeping.cancel()
        await asyncio.wait({keeping})
