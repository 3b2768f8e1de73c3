"""The layer around all routes: security headers on every response, and an answer where a handler failed."""

from __future__ import annotations

import asyncio
import logging
import re
from typing import TYPE_CHECKING, Any

from starlette.requests import Request
from starlette.responses import Response

from app.api.problems import AGAIN, Problem, as_problem

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

log = logging.getLogger(__name__)

# Sent with every answer. Answers are of the moment and for one caller, so nothing may keep them.
SECURITY_HEADERS: tuple[tuple[bytes, bytes], ...] = (
    (b"x-content-type-options", b"nosniff"),
    (b"cache-control", b"no-store"),
    (b"referrer-policy", b"no-referrer"),
    (b"x-frame-options", b"DENY"),
    (b"content-security-policy", b"default-src 'none'; frame-ancestors 'none'"),
)
PREFERRED = ("br", "gzip")  # of the encodings there are, the best first
HEADERS = "reins.headers"  # where in the scope a page says which headers it is sent with instead


class Json(Response):
    """An answer whose bytes are JSON already, sent in one piece."""

    media_type = "application/json"

    def __init__(self, content: bytes, status_code: int = 200, headers: Mapping[str, str] | None = None) -> None:
        """Take the bytes; what Starlette would find out about them is known."""
        self.status_code, self.body, self.background = status_code, content, None
        self.raw_headers = [(b"content-length", b"%d" % len(content)), (b"content-type", b"application/json")]
        if headers is not None:
            for name, value in headers.items():
                self.raw_headers.append((name.lower().encode("latin-1"), value.encode("latin-1")))


def best_form(forms: Mapping[str, bytes], accept_encoding: str) -> tuple[bytes, dict[str, str]]:
    """Return a body in the best of its forms that is accepted, and the headers that say so.

    Args:
        forms: the bytes by encoding, `""` for those that are not encoded.
        accept_encoding: the header of the request; an encoding without weight is not accepted.
    """
    accepted: set[str] = set()
    for part in accept_encoding.lower().split(","):
        name, _, weight = part.strip().partition(";")
        if not re.fullmatch(r"\s*q=0(\.0*)?\s*", weight):
            accepted.add(name.strip())
    encoding = next((name for name in PREFERRED if name in accepted and name in forms), "")
    headers = {"Vary": "Accept-Encoding"}
    return forms[encoding], {**headers, "Content-Encoding": encoding} if encoding else headers


class Frame:
    """Sends every response, whoever made it.

    Routes in `direct`, by method and path, are called right here: finding them again behind further layers would cost
    more than what many of them do.
    """

    def __init__(
        self, app: ASGIApp, direct: Mapping[tuple[str, str], Callable[[Request], Coroutine[Any, Any, Response]]]
    ) -> None:
        """Wrap the application."""
        self._app = app
        self._direct = direct

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on; stamp what comes back."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        if scope["method"] == "HEAD":
            scope, send = {**scope, "method": "GET"}, _without_body(send)
        handler = self._direct.get((scope["method"], scope["path"]))
        if handler is None:
            await self._pass_on(self._app, scope, receive, send)
            return
        try:
            response = await handler(Request(scope, receive))
        except asyncio.CancelledError:
            response = _left().response(scope["path"])
        except Exception as error:
            response = _answer_to(error, scope)
        if type(response) is not Json:
            await self._pass_on(response, scope, receive, send)
            return
        headers = [*response.raw_headers, *SECURITY_HEADERS]
        await send({"type": "http.response.start", "status": response.status_code, "headers": headers})
        await send({"type": "http.response.body", "body": response.body})

    async def _pass_on(self, app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
        started = False

        async def stamped(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                message["headers"] = [*message["headers"], *scope.get(HEADERS, SECURITY_HEADERS)]
            await send(message)

        try:
            await app(scope, receive, stamped)
        except asyncio.CancelledError:
            if started:
                raise
            await _left().response(scope["path"])(scope, receive, stamped)
        except Exception as error:
            if started:  # half an answer is out; cutting the connection is the only honest end
                raise
            await _answer_to(error, scope)(scope, receive, stamped)


def _without_body(send: Send) -> Send:
    """Return what sends the head of an answer and ends it there (RFC 9110, 9.3.2), a stream before its first event."""

    async def head(message: Message) -> None:
        if message["type"] == "http.response.start":
            await send(message)
            await send({"type": "http.response.body", "body": b""})

    return head


def _left() -> Problem:
    """Return what is said to a request that the server ends before it is answered: only a server that stops does so.

    What was begun may come about all the same, so this says nothing of that.
    """
    detail = "the server stops before this is answered; valid is to look, or to ask again, once it is back"
    return Problem("record_unavailable", detail, headers=AGAIN)


def _answer_to(error: Exception, scope: Scope) -> Response:
    """Return the answer to a request whose handler failed; what nobody listed goes to the server's log."""
    problem = as_problem(error)
    if problem.code == "internal":
        log.error("`%s %s` failed", scope["method"], scope["path"], exc_info=error)
    return problem.response(scope["path"])
