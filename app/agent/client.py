"""The client SDK: propose a capability invocation, wait for its end, get a result or a refusal with reasons.

    from app.agent.client import ReinsClient

    with ReinsClient("http://127.0.0.1:8000", token) as client:
        client.invoke("navigate_to", target="bench_a_stand")
        client.invoke("grasp_object", object_id="mug_1", force_n=40)

The conversation with the server is written once (`conversation`); the sync and the async client only differ in how they
carry it out. What they return and raise stands in `answers`.
"""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from http.cookiejar import CookieJar, DefaultCookiePolicy
from typing import Any, Self

import httpx

from app.agent.address import address, blaming_environment
from app.agent.answers import (
    Document,
    ExecutionFailed,
    NotCompleted,
    Problem,
    Reason,
    Refused,
    ReinsError,
    Result,
    Unreachable,
    Unsendable,
    document,
)
from app.agent.conversation import (
    MAX_TOKEN,
    WAIT_S,
    Call,
    OnUpdate,
    Reply,
    Sleep,
    T,
    Talk,
    conclude,
    invoke,
    listed,
    proposal,
    send,
    take_up,
)
from app.agent.sendable import header_text, path_of, shown

__all__ = [
    "AsyncReinsClient", "Document", "ExecutionFailed", "NotCompleted", "OnUpdate", "Problem", "Reason", "Refused",
    "ReinsClient", "ReinsError", "Result", "Unreachable", "Unsendable", "document",
]  # fmt: skip


def _reply(response: httpx.Response) -> Reply:
    kind = response.headers.get("content-type", "")
    content: object = response.content.decode(errors="replace")  # only to be shown; a charset may name any codec
    with suppress(ValueError, RecursionError):  # says that it is JSON, and is not, or bottomless: `_read` shows it
        content = response.json() if "json" in kind else content
    replayed = response.headers.get("idempotency-replayed") == "true"
    return Reply(status=response.status_code, json=content, retry_after_s=_patience_s(response), replayed=replayed)


def _patience_s(response: httpx.Response) -> float | None:
    """Return how long a server asks to be left alone; what is no such number says nothing."""
    after = response.headers.get("retry-after", "")
    return float(after) if _SECONDS.fullmatch(after) else None


def _authorization(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {header_text('token', token, MAX_TOKEN)}"}


def _no_cookies() -> CookieJar:
    """Return a jar that takes nothing: the token says who asks, and some a server may set cannot be sent back."""
    return CookieJar(DefaultCookiePolicy(allowed_domains=()))


def _number(defers: object) -> int:
    """Return how often to propose again. Raises `ValueError` for what is no number of times."""
    if not isinstance(defers, int) or isinstance(defers, bool) or defers < 0:
        raise ValueError(f"defers `{shown(defers, str)}`: valid is a whole number from 0 on, for instance `20`")
    return defers


def _nothing(http: httpx.Client | httpx.AsyncClient, error: Exception) -> Reply:
    """Return what stands for no answer, and which server gave none, and why; or for what httpx would not send."""
    refused = isinstance(error, httpx.InvalidURL | httpx.LocalProtocolError | httpx.UnsupportedProtocol)
    why = f"`{http.base_url}`: {str(error) or type(error).__name__}"
    return Reply(status=0, json=why, sent=not refused or http.is_closed)  # closed under way: it may have been sent


def _opened(make: Callable[..., T], url: str, token: str) -> T:
    """Return what speaks HTTP to a server; of what the environment breaks in it, the environment is blamed."""
    server, headers = address(url), _authorization(token)
    with blaming_environment():
        return make(base_url=server, headers=headers, cookies=_no_cookies(), timeout=_TIMEOUT)


_SECONDS = re.compile(r"[0-9]{1,6}")
_SLEPT = Reply(status=0, json=None)
_CLOSED = Reply(status=0, json="the client was closed; valid is a new one", sent=False)
_TIMEOUT = httpx.Timeout(10.0, read=WAIT_S + 15.0)


class ReinsClient:
    """Synchronous client; a context manager."""

    def __init__(self, url: str, token: str, *, defers: int = 20) -> None:
        """Speak to `url` as the owner of `token`; propose a deferred invocation again up to `defers` times.

        Raises `ValueError` if `url` names no server, or a user as well, if `defers` is no number of times, or if the
        environment names a proxy or certificates that are none; `Unsendable` if `token` fits no header.
        """
        self._defers = _number(defers)
        self._http = _opened(httpx.Client, url, token)

    def __enter__(self) -> Self:
        """Return the client."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connection."""
        self.close()

    def close(self) -> None:
        """Close the connection; whatever is asked from then on is `Unsendable`."""
        self._http.close()

    def invoke(  # noqa: PLR0913 - a proposal has that many fields
        self,
        capability: str,
        inputs: Mapping[str, Any] | None = None,
        /,
        *,
        mode: str | None = None,
        cell: str | None = None,
        metadata: Document | None = None,
        preconditions: Sequence[str] | None = None,
        recovery_preference: str | None = None,
        capability_version: str | None = None,
        idempotency_key: str | None = None,
        on_update: OnUpdate | None = None,
        **params: Any,  # noqa: ANN401 - whatever the capability's own schema declares
    ) -> Result:
        """Propose a capability and wait for its end.

        The named options are the proposal's own, as `POST /v1/invocations` has them: `mode`, `cell`, `metadata` (say
        `{"confidence": 0.9}`), `preconditions` (conditions checked beside the capability's own),
        `recovery_preference` and `capability_version`. Every other keyword is an input of the capability; what is
        called like an option, or is no Python name, stands in `inputs`: `invoke("mix", {"mode": "fast"}, speed_mps=1)`.

        What is deferred is proposed again, and what the server cannot answer now (408, 429, 502, 503, 504) sent again,
        after the time that it names, but a minute at most. A longer one stands in the deferral that `on_update` gets
        (`admission.retry_after_s`), and in the words of the `Refused` or `Problem` that comes when patience ends.

        Returns the result of a completed invocation. Raises `Refused` if it was not launched, `ExecutionFailed` if it
        ended without success, `Problem` if the request was malformed or not allowed, `Unsendable` if it could
        not even be sent, `Unreachable` if there was no answer; the robot may be moving all the same, and invoking
        again under the error's `idempotency_key` takes it up.

        `on_update` is called with the invocation at every change; not with deferrals that an earlier call under the
        same `idempotency_key` was told of, nor are those waited out again. What it raises ends the waiting, not the
        robot, and comes through as it is, with a note (`__notes__`) of the key and the invocation's `id`; so does
        Ctrl-C. A program that means to go on then names an `idempotency_key` of its own.
        """
        options = {
            "mode": mode,
            "cell": cell,
            "metadata": metadata,
            "preconditions": preconditions,
            "recovery_preference": recovery_preference,
            "capability_version": capability_version,
        }
        return self._run(
            invoke(proposal(capability, inputs, params, options), idempotency_key, self._defers, on_update)
        )

    def follow(self, invocation: str, *, on_update: OnUpdate | None = None) -> Result:
        """Wait for the end of an invocation proposed earlier, say before a restart. Raises as `invoke` does.

        What `on_update` raises comes through as it is.
        """
        return conclude(self._run(take_up(invocation, on_update)))

    def check(
        self,
        capability: str,
        inputs: Mapping[str, Any] | None = None,
        /,
        *,
        mode: str | None = None,
        cell: str | None = None,
        metadata: Document | None = None,
        preconditions: Sequence[str] | None = None,
        recovery_preference: str | None = None,
        capability_version: str | None = None,
        **params: Any,  # noqa: ANN401
    ) -> Document:
        """Return what would be decided, without proposing; options and inputs are those of `invoke`.

        Raises `Problem` if the request was malformed or not allowed, `Unsendable`, `Unreachable`.
        """
        options = {
            "mode": mode,
            "cell": cell,
            "metadata": metadata,
            "preconditions": preconditions,
            "recovery_preference": recovery_preference,
            "capability_version": capability_version,
        }
        return self.call("POST", "/v1/check", json=proposal(capability, inputs, params, options))

    def trace(self, invocation: str) -> list[Document]:
        """Return τ_t: all events of an invocation in order."""
        return self._run(listed(Call(method="GET", path=f"{path_of(invocation)}/trace")))

    def capabilities(self) -> list[Document]:
        """Return the registered capabilities as their manifests declare them."""
        return self._run(listed(Call(method="GET", path="/v1/capabilities")))

    def call(
        self, method: str, path: str, *, json: Document | None = None, query: Mapping[str, str] | None = None
    ) -> Any:  # noqa: ANN401
        """Call any route that may be repeated; return its JSON. Raises `Problem`, `Unsendable` or `Unreachable`."""
        return self._run(send(Call(method=method, path=path, json=json, query={} if query is None else query)))

    def _run(self, talk: Talk[T]) -> T:
        try:
            step = next(talk)
            while True:
                step = talk.send(self._do(step))
        except StopIteration as end:
            return end.value
        except BaseException as error:  # Ctrl-C, say: the conversation leaves the key with it
            talk.throw(error)
            raise

    def _do(self, step: Call | Sleep) -> Reply:
        if isinstance(step, Sleep):
            time.sleep(step.seconds)
            return _SLEPT
        if self._http.is_closed:
            return _CLOSED
        try:
            return _reply(
                self._http.request(
                    step.method, step.path, json=step.json, params=step.query, headers=dict(step.headers)
                )
            )
        except (httpx.RequestError, httpx.InvalidURL) as error:  # one that cannot be decoded is no answer either
            return _nothing(self._http, error)


class AsyncReinsClient:
    """Asynchronous client; an async context manager. Methods and exceptions are those of `ReinsClient`."""

    def __init__(self, url: str, token: str, *, defers: int = 20) -> None:
        """Speak to `url` as the owner of `token`; errors as of `ReinsClient`."""
        self._defers = _number(defers)
        self._http = _opened(httpx.AsyncClient, url, token)

    async def __aenter__(self) -> Self:
        """Return the client."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the connection."""
        await self.close()

    async def close(self) -> None:
        """Close the connection; whatever is asked from then on is `Unsendable`."""
        await self._http.aclose()

    def invoke(  # noqa: PLR0913 - a proposal has that many fields
        self,
        capability: str,
        inputs: Mapping[str, Any] | None = None,
        /,
        *,
        mode: str | None = None,
        cell: str | None = None,
        metadata: Document | None = None,
        preconditions: Sequence[str] | None = None,
        recovery_preference: str | None = None,
        capability_version: str | None = None,
        idempotency_key: str | None = None,
        on_update: OnUpdate | None = None,
        **params: Any,  # noqa: ANN401 - whatever the capability's own schema declares
    ) -> Awaitable[Result]:
        """Propose a capability and wait for its end; see `ReinsClient.invoke`."""
        options = {
            "mode": mode,
            "cell": cell,
            "metadata": metadata,
            "preconditions": preconditions,
            "recovery_preference": recovery_preference,
            "capability_version": capability_version,
        }
        return self._run(
            invoke(proposal(capability, inputs, params, options), idempotency_key, self._defers, on_update)
        )

    async def follow(self, invocation: str, *, on_update: OnUpdate | None = None) -> Result:
        """Wait for the end of an invocation proposed earlier; see `ReinsClient.follow`."""
        return conclude(await self._run(take_up(invocation, on_update)))

    def check(
        self,
        capability: str,
        inputs: Mapping[str, Any] | None = None,
        /,
        *,
        mode: str | None = None,
        cell: str | None = None,
        metadata: Document | None = None,
        preconditions: Sequence[str] | None = None,
        recovery_preference: str | None = None,
        capability_version: str | None = None,
        **params: Any,  # noqa: ANN401
    ) -> Awaitable[Document]:
        """Return what would be decided, without proposing; see `ReinsClient.check`."""
        options = {
            "mode": mode,
            "cell": cell,
            "metadata": metadata,
            "preconditions": preconditions,
            "recovery_preference": recovery_preference,
            "capability_version": capability_version,
        }
        return self.call("POST", "/v1/check", json=proposal(capability, inputs, params, options))

    async def trace(self, invocation: str) -> list[Document]:
        """Return τ_t: all events of an invocation in order."""
        return await self._run(listed(Call(method="GET", path=f"{path_of(invocation)}/trace")))

    async def capabilities(self) -> list[Document]:
        """Return the registered capabilities as their manifests declare them."""
        return await self._run(listed(Call(method="GET", path="/v1/capabilities")))

    def call(
        self, method: str, path: str, *, json: Document | None = None, query: Mapping[str, str] | None = None
    ) -> Awaitable[Any]:
        """Call any route that may be repeated; return its JSON. Raises `Problem`, `Unsendable` or `Unreachable`."""
        return self._run(send(Call(method=method, path=path, json=json, query={} if query is None else query)))

    async def _run(self, talk: Talk[T]) -> T:
        try:
            step = next(talk)
            while True:
                step = talk.send(await self._do(step))
        except StopIteration as end:
            return end.value
        except BaseException as error:  # Ctrl-C, say: the conversation leaves the key with it
            talk.throw(error)
            raise

    async def _do(self, step: Call | Sleep) -> Reply:
        if isinstance(step, Sleep):
            await asyncio.sleep(step.seconds)
            return _SLEPT
        if self._http.is_closed:
            return _CLOSED
        try:
            return _reply(
                await self._http.request(
                    step.method, step.path, json=step.json, params=step.query, headers=dict(step.headers)
                )
            )
        except (httpx.RequestError, httpx.InvalidURL) as error:  # one that cannot be decoded is no answer either
            return _nothing(self._http, error)
