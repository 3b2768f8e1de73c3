"""The client SDK: propose a capability invocation, wait for its end, get a result or a refusal with reasons.

    from app.agent.client import ReinsClient

    with ReinsClient("http://127.0.0.1:8000", token) as client:
        client.invoke("navigate_to", target="bench_a_stand")
        client.invoke("grasp_object", object_id="mug_1", force_n=40)

The conversation with the server is written once, as generators that yield what to send and receive what came back
(`_Talk`); the sync and the async client only differ in how they carry it out. Every proposal bears an idempotency
key, so a lost answer is asked for again without a second proposal; a `Defer` is proposed again after the time the
server names, with growing patience.

Exceptions:

    ReinsError
     ├─ Unsendable           a value that cannot be sent: not JSON, or not what a header takes; nothing was sent
     ├─ Unreachable          no answer from the server, however often asked
     ├─ Problem              the server refused the request itself (application/problem+json)
     └─ NotCompleted         the proposal was decided, but the task is not done; carries the invocation
         ├─ Refused          rejected, denied, expired, or deferred for too long: never launched
         └─ ExecutionFailed  launched and ended otherwise than by success
"""

from __future__ import annotations

import asyncio
import math
import time
import uuid
from collections.abc import Awaitable, Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Self, TypeAlias, TypeVar, cast

import httpx

Document: TypeAlias = dict[str, Any]
OnUpdate: TypeAlias = Callable[[Document], None]

_BEFORE_LAUNCH = frozenset({"rejected", "denied", "deferred"})
_TERMINAL = _BEFORE_LAUNCH | {"completed", "failed"}
_WAIT_S = 20
_SEND_ATTEMPTS = 8
_BACKOFF_S = 0.2
_BACKOFF_MAX_S = 5.0
_MAX_DEPTH = 32
_MAX_KEY = 255
_MAX_TOKEN = 1024


class ReinsError(Exception):
    """Anything this client raises on purpose."""


class Unsendable(ReinsError):
    """A value given to the client cannot be sent; nothing was."""


class Unreachable(ReinsError):
    """The server did not answer, however often it was asked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reason:
    """Why a decision fell as it did: the rule, a stable code, plain words, and what would be accepted."""

    rule: str
    code: str
    message: str
    remedy: str


class Problem(ReinsError):
    """The server refused the request itself: malformed, unauthenticated, not allowed, conflicting (RFC 9457)."""

    def __init__(self, status: int, code: str, detail: str) -> None:
        """Keep the facts; the message is made of them."""
        self.status = status
        self.code = code
        self.detail = detail
        super().__init__(f"{status} {code}: {detail}")


class NotCompleted(ReinsError):
    """A proposal that did not end in success: `invocation` is the whole document, `reasons` what to replan on."""

    def __init__(self, invocation: Document) -> None:
        """Collect the reasons of admission, policy and outcome."""
        self.invocation = invocation
        self.reasons = reasons_of(invocation)
        said = "; ".join(reason.message or reason.code for reason in self.reasons) or "no reason given"
        super().__init__(f"`{invocation['capability']}` {invocation['status']}: {said}")

    @property
    def codes(self) -> frozenset[str]:
        """The codes of all reasons."""
        return frozenset(reason.code for reason in self.reasons)


class Refused(NotCompleted):
    """Never launched: rejected, denied, expired without an answer, or deferred for too long."""


class ExecutionFailed(NotCompleted):
    """Launched, and ended otherwise than by success; `outcome` says how (`terminated`, `stopped`, `fault`, …)."""

    @property
    def outcome(self) -> str:
        """The outcome label o_t."""
        return str(self.invocation.get("outcome"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """A completed invocation: its outcome (`succeeded` or `recovered`) and what policy changed."""

    invocation: Document

    @property
    def id(self) -> str:
        """Identifier, for `trace`."""
        return str(self.invocation["id"])

    @property
    def outcome(self) -> str:
        """The outcome label o_t."""
        return str(self.invocation["outcome"])

    @property
    def effective(self) -> Document:
        """The parameters that were really in force."""
        return dict(self.invocation["effective"])

    @property
    def changes(self) -> list[Document]:
        """What policy constrained: param, requested, effective, rule."""
        return list(document(self.invocation.get("policy")).get("changes") or [])


def reasons_of(invocation: Document) -> tuple[Reason, ...]:
    """Return all reasons of an invocation document: admission first, then policy, then those of its end.

    A part holds a list of `reasons`, or is itself the only one.
    """
    found: list[Document] = []
    for part in ("admission", "policy", "failure"):
        said = document(invocation.get(part))
        found += cast("list[Document]", said.get("reasons") or ([said] if "code" in said else []))
    return tuple(
        Reason(
            rule=item.get("rule", ""),
            code=item.get("code", ""),
            message=item.get("message", ""),
            remedy=item.get("remedy", ""),
        )
        for item in found
    )


# -- the conversation, without I/O -----------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _Call:
    method: str
    path: str
    json: Document | None = None
    query: Mapping[str, str] = field(default_factory=dict[str, str])
    headers: Mapping[str, str] = field(default_factory=dict[str, str])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sleep:
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Reply:
    """What came back; `status` 0 means that nothing did."""

    status: int
    json: Any
    retry_after_s: float | None = None


_T = TypeVar("_T")
_Talk: TypeAlias = Generator[_Call | _Sleep, _Reply, _T]


def _backoff_s(attempt: int) -> float:
    return min(_BACKOFF_S * 2**attempt, _BACKOFF_MAX_S)


def _send(call: _Call) -> _Talk[Any]:
    """Send until there is an answer; raise `Problem` for one that refuses. Only safe for calls that may be repeated."""
    _check_sendable(call)
    last: _Reply | None = None
    for attempt in range(_SEND_ATTEMPTS):
        last = yield call
        if last.status in range(200, 300):
            return _read(last)
        code = document(last.json).get("code")
        transient = last.status in (0, 502, 503, 504) or (last.status == 409 and code == "in_flight")
        if not transient:
            raise _problem(last)
        yield _Sleep(seconds=last.retry_after_s or _backoff_s(attempt))
    if last is None or last.status == 0:
        raise Unreachable(f"no answer to `{call.method} {call.path}` after {_SEND_ATTEMPTS} attempts")
    raise _problem(last)


def _read(reply: _Reply) -> Any:  # noqa: ANN401 - whatever the route answers with
    if not isinstance(reply.json, dict | list):
        said = str(reply.json)[:80]
        raise Problem(reply.status, "unreadable_answer", f"`{said}` is no JSON document; valid is the URL of a server")
    return cast("Any", reply.json)


def _check_sendable(call: _Call) -> None:
    """Raise `Unsendable` for the first value that has no place in a request, before anything is sent."""
    for name, value in (("json", call.json), ("query", dict(call.query))):
        for wrong in _misfits(value, name):
            raise Unsendable(f"{wrong}; nothing was sent")
    if not call.path.isprintable():
        raise Unsendable(f"the path is {call.path!r}; valid are printable characters; nothing was sent")


def _misfits(value: object, name: str, depth: int = 0) -> Iterator[str]:
    """Say of every value in a document that is no JSON where it stands, what it is, and what would be valid."""
    if depth > _MAX_DEPTH:
        yield f"`{name}` is nested too deep; valid are at most {_MAX_DEPTH} levels"
    elif isinstance(value, dict):
        for key, item in cast("dict[object, object]", value).items():
            if not isinstance(key, str):
                yield f"`{name}` has the key `{key!r}`; valid keys are strings"
            yield from _misfits(key, f"{name}, key {key!r}", depth + 1)
            yield from _misfits(item, f"{name}.{key}".removeprefix("json."), depth + 1)
    elif isinstance(value, list | tuple):
        for place, item in enumerate(cast("list[object]", value)):
            yield from _misfits(item, f"{name}[{place}]", depth + 1)
    else:
        yield from _misfit(value, name)


def _misfit(value: object, name: str) -> Iterator[str]:
    if isinstance(value, float) and not math.isfinite(value):
        yield f"`{name}` is `{value}`; valid are finite numbers"
    elif isinstance(value, str) and any("\ud800" <= character <= "\udfff" for character in value):
        yield f"`{name}` is `{value!r}`; valid is text without lone surrogates"
    elif not isinstance(value, str | int | float | None):
        yield f"`{name}` is `{value!r}`, a {type(value).__name__}; valid are JSON's types: text, numbers, lists, …"


def _header_text(name: str, value: object, most: int) -> str:
    """Return a value that may stand in a header. Raises `Unsendable` naming it; a token is not repeated."""
    if not isinstance(value, str) or not (0 < len(value) <= most and value.isascii() and value.isprintable()):
        shown = "" if name == "token" else f" `{value!r}`"
        raise Unsendable(f"{name}{shown}: valid are 1 to {most} printable ASCII characters; nothing was sent")
    return value


def document(value: object) -> Document:
    """Return a JSON object as it is, and anything else (an absent part) as an empty one."""
    return cast("Document", value) if isinstance(value, dict) else {}


def _problem(reply: _Reply) -> Problem:
    body = document(reply.json)
    return Problem(
        reply.status, str(body.get("code", "unknown")), str(body.get("detail") or body.get("title") or reply.json)
    )


def _invoke(body: Document, key: str | None, defers: int, on_update: OnUpdate | None) -> _Talk[Result]:
    """Propose, propose again while deferred, follow to the end."""
    first_key = uuid.uuid4().hex if key is None else _header_text("idempotency_key", key, _MAX_KEY)
    for attempt in range(defers + 1):
        headers = {"Idempotency-Key": uuid.uuid4().hex if attempt else first_key}
        invocation: Document = yield from _send(
            _Call(method="POST", path="/v1/invocations", json=body, headers=headers)
        )
        invocation = yield from _follow(invocation, on_update)
        if invocation["status"] == "deferred" and attempt < defers:
            patience = document(invocation.get("admission")).get("retry_after_s") or 1.0
            yield _Sleep(seconds=max(float(patience), _backoff_s(attempt)))
            continue
        return _conclude(invocation)
    raise AssertionError("unreachable: the last attempt always concludes")


def _follow(invocation: Document, on_update: OnUpdate | None) -> _Talk[Document]:
    """Long-poll until the invocation has ended, telling every change.

    Each poll names the version known already, so that a change since then is answered at once.
    """
    told: tuple[Any, ...] = ()
    while True:
        seen = (invocation["status"], invocation.get("updated_at"))
        if on_update is not None and seen != told:
            on_update(invocation)
        told = seen
        if invocation["status"] in _TERMINAL:
            return invocation
        path = f"/v1/invocations/{invocation['id']}"
        query = {"wait": str(_WAIT_S)}
        if invocation.get("updated_at"):
            query["seen"] = str(invocation["updated_at"])
        invocation = yield from _send(_Call(method="GET", path=path, query=query))


def _conclude(invocation: Document) -> Result:
    if invocation["status"] == "completed":
        return Result(invocation=invocation)
    raise (Refused if invocation["status"] in _BEFORE_LAUNCH else ExecutionFailed)(invocation)


def _proposal(capability: str, params: Mapping[str, Any], options: Mapping[str, Any]) -> Document:
    body: Document = {"capability": capability, "params": dict(params)}
    body.update({name: value for name, value in options.items() if value is not None})
    return body


def _reply(response: httpx.Response) -> _Reply:
    after = response.headers.get("retry-after", "")
    kind = response.headers.get("content-type", "")
    try:
        content = response.json() if "json" in kind else response.text
    except ValueError:  # says that it is JSON, and is not: `_read` shows it
        content = response.text
    return _Reply(status=response.status_code, json=content, retry_after_s=float(after) if after.isdigit() else None)


def _authorization(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {_header_text('token', token, _MAX_TOKEN)}"}


_NOTHING = _Reply(status=0, json=None)
_TIMEOUT = httpx.Timeout(10.0, read=_WAIT_S + 15.0)


# -- the two clients -------------------------------------------------------------------------------


class ReinsClient:
    """Synchronous client; a context manager."""

    def __init__(self, url: str, token: str, *, defers: int = 20) -> None:
        """Speak to `url` as the owner of `token`; propose a deferred invocation again up to `defers` times."""
        self._defers = defers
        self._http = httpx.Client(base_url=url, headers=_authorization(token), timeout=_TIMEOUT)

    def __enter__(self) -> Self:
        """Return the client."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connection."""
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def invoke(
        self,
        capability: str,
        /,
        *,
        mode: str | None = None,
        cell: str | None = None,
        metadata: Document | None = None,
        recovery_preference: str | None = None,
        capability_version: str | None = None,
        idempotency_key: str | None = None,
        on_update: OnUpdate | None = None,
        **params: Any,  # noqa: ANN401 - whatever the capability's own schema declares
    ) -> Result:
        """Propose a capability and wait for its end.

        Returns the result of a completed invocation. Raises `Refused` if it was not launched, `ExecutionFailed` if it
        ended without success, `Problem` if the request was malformed or not allowed, `Unsendable` if it could
        not even be sent, `Unreachable` if there was no answer. `on_update` is called with the invocation at every
        change.
        """
        options = {
            "mode": mode,
            "cell": cell,
            "metadata": metadata,
            "recovery_preference": recovery_preference,
            "capability_version": capability_version,
        }
        return self._run(_invoke(_proposal(capability, params, options), idempotency_key, self._defers, on_update))

    def follow(self, invocation: str, *, on_update: OnUpdate | None = None) -> Result:
        """Wait for the end of an invocation proposed earlier, say before a restart. Raises as `invoke` does."""
        first = self.call("GET", f"/v1/invocations/{invocation}")
        return _conclude(self._run(_follow(first, on_update)))

    def check(self, capability: str, /, *, mode: str | None = None, cell: str | None = None, **params: Any) -> Document:  # noqa: ANN401
        """Return what would be decided, without proposing."""
        return self.call("POST", "/v1/check", json=_proposal(capability, params, {"mode": mode, "cell": cell}))

    def trace(self, invocation: str) -> list[Document]:
        """Return τ_t: all events of an invocation in order."""
        return list(self.call("GET", f"/v1/invocations/{invocation}/trace")["items"])

    def capabilities(self) -> list[Document]:
        """Return the registered capabilities as their manifests declare them."""
        return list(self.call("GET", "/v1/capabilities")["items"])

    def call(
        self, method: str, path: str, *, json: Document | None = None, query: Mapping[str, str] | None = None
    ) -> Any:  # noqa: ANN401
        """Call any route that may be repeated; return its JSON. Raises `Problem` or `Unreachable`."""
        return self._run(_send(_Call(method=method, path=path, json=json, query=query or {})))

    def _run(self, talk: _Talk[_T]) -> _T:
        try:
            step = next(talk)
            while True:
                step = talk.send(self._do(step))
        except StopIteration as end:
            return end.value

    def _do(self, step: _Call | _Sleep) -> _Reply:
        if isinstance(step, _Sleep):
            time.sleep(step.seconds)
            return _NOTHING
        try:
            return _reply(
                self._http.request(
                    step.method, step.path, json=step.json, params=step.query, headers=dict(step.headers)
                )
            )
        except httpx.TransportError:
            return _NOTHING


class AsyncReinsClient:
    """Asynchronous client; an async context manager. Methods and exceptions are those of `ReinsClient`."""

    def __init__(self, url: str, token: str, *, defers: int = 20) -> None:
        """Speak to `url` as the owner of `token`; propose a deferred invocation again up to `defers` times."""
        self._defers = defers
        self._http = httpx.AsyncClient(base_url=url, headers=_authorization(token), timeout=_TIMEOUT)

    async def __aenter__(self) -> Self:
        """Return the client."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the connection."""
        await self.close()

    async def close(self) -> None:
        """Close the connection."""
        await self._http.aclose()

    def invoke(
        self,
        capability: str,
        /,
        *,
        mode: str | None = None,
        cell: str | None = None,
        metadata: Document | None = None,
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
            "recovery_preference": recovery_preference,
            "capability_version": capability_version,
        }
        return self._run(_invoke(_proposal(capability, params, options), idempotency_key, self._defers, on_update))

    async def follow(self, invocation: str, *, on_update: OnUpdate | None = None) -> Result:
        """Wait for the end of an invocation proposed earlier; see `ReinsClient.follow`."""
        first = await self.call("GET", f"/v1/invocations/{invocation}")
        return _conclude(await self._run(_follow(first, on_update)))

    def check(
        self,
        capability: str,
        /,
        *,
        mode: str | None = None,
        cell: str | None = None,
        **params: Any,  # noqa: ANN401
    ) -> Awaitable[Document]:
        """Return what would be decided, without proposing."""
        return self.call("POST", "/v1/check", json=_proposal(capability, params, {"mode": mode, "cell": cell}))

    async def trace(self, invocation: str) -> list[Document]:
        """Return τ_t: all events of an invocation in order."""
        return list((await self.call("GET", f"/v1/invocations/{invocation}/trace"))["items"])

    async def capabilities(self) -> list[Document]:
        """Return the registered capabilities as their manifests declare them."""
        return list((await self.call("GET", "/v1/capabilities"))["items"])

    def call(
        self, method: str, path: str, *, json: Document | None = None, query: Mapping[str, str] | None = None
    ) -> Awaitable[Any]:
        """Call any route that may be repeated; return its JSON. Raises `Problem` or `Unreachable`."""
        return self._run(_send(_Call(method=method, path=path, json=json, query=query or {})))

    async def _run(self, talk: _Talk[_T]) -> _T:
        try:
            step = next(talk)
            while True:
                step = talk.send(await self._do(step))
        except StopIteration as end:
            return end.value

    async def _do(self, step: _Call | _Sleep) -> _Reply:
        if isinstance(step, _Sleep):
            await asyncio.sleep(step.seconds)
            return _NOTHING
        try:
            return _reply(
                await self._http.request(
                    step.method, step.path, json=step.json, params=step.query, headers=dict(step.headers)
                )
            )
        except httpx.TransportError:
            return _NOTHING
