"""The conversation with the server, without I/O: generators that yield what to send and receive what came back.

Every proposal bears an idempotency key, so a lost answer is asked for again without a second proposal; a `Defer` is
proposed again after the time the server names, with growing patience, and after a minute at the latest.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field, replace
from inspect import iscoroutinefunction
from typing import Any, TypeAlias, TypeVar, cast

from app.agent.answers import (
    Document,
    ExecutionFailed,
    Problem,
    Refused,
    Result,
    Unreachable,
    Unsendable,
    document,
    documents,
)
from app.agent.sendable import check_sendable, header_text, path_of, shown

OnUpdate: TypeAlias = Callable[[Document], None]

WAIT_S = 20
MAX_TOKEN = 1024
_MAX_NAME = 255
_BEFORE_LAUNCH = frozenset({"rejected", "denied", "deferred"})
_TERMINAL = _BEFORE_LAUNCH | {"completed", "failed"}
_STATUSES = _TERMINAL | {"awaiting_approval", "running", "paused", "escalated", "recovering"}
_DONE = frozenset({"succeeded", "recovered"})
_SEND_ATTEMPTS = 8
_BACKOFF_S = 0.2
_BACKOFF_MAX_S = 5.0
_LONGEST_WAIT_S = 60.0  # whoever is told to stay away for a day had better be told so themselves
_TRANSIENT = frozenset({0, 408, 429, 502, 503, 504})
_SERVERS_FAULT = 500
_ATTEMPTS = uuid.UUID("6f1c5a52-3f0e-4d0b-9a53-0d7a0b1f7c11")  # sets our keys apart from whatever else is named so


@dataclass(frozen=True, slots=True, kw_only=True)
class Call:
    """A request to send; what comes back is a `Reply`."""

    method: str
    path: str
    json: Document | None = None
    query: Mapping[str, str] = field(default_factory=dict[str, str])
    headers: Mapping[str, str] = field(default_factory=dict[str, str])


@dataclass(frozen=True, slots=True, kw_only=True)
class Sleep:
    """A wait before going on."""

    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """What came back; `status` 0 means that nothing did, and `json` says from where, and why.

    Not `sent` is what never left, and never will: there is no use in asking again. `replayed` is an answer that was
    given to an earlier call under the same key.
    """

    status: int
    json: Any
    retry_after_s: float | None = None
    sent: bool = True
    replayed: bool = False


T = TypeVar("T")
Talk: TypeAlias = Generator[Call | Sleep, Reply, T]


def _backoff_s(attempt: int) -> float:
    return min(_BACKOFF_S * 2**attempt, _BACKOFF_MAX_S)


def send(call: Call, *, begun: bool = False) -> Talk[Any]:
    """Send until there is an answer; raise `Problem` for one that refuses. Only safe for calls that may be repeated.

    What cannot be sent is `Unsendable`, unless something was before, by an earlier attempt, or by what has `begun`.
    What a server or a proxy cannot answer now is sent again when it says so, and after a minute at the latest; a
    `Problem` in the end says if it asked for longer.
    """
    return _read((yield from _ask(call, begun=begun)))


def _ask(call: Call, *, begun: bool = False) -> Talk[Reply]:
    check_sendable(call.method, call.path, call.json, call.query)
    last: Reply | None = None
    for attempt in range(_SEND_ATTEMPTS):
        last = yield call
        if last.status in range(200, 300):
            return replace(last, replayed=last.replayed and not attempt)  # else it may answer what was just asked
        if not last.sent and not (begun or attempt):
            raise Unsendable(f"`{call.method} {call.path}`: {last.json}; nothing was sent")
        if not last.sent:
            raise Unreachable(f"no answer to `{call.method} {call.path}`: {last.json}")
        code = document(last.json).get("code")
        transient = last.status in _TRANSIENT or (last.status == 409 and code == "in_flight")
        if not transient:
            raise _problem(last)
        if attempt + 1 < _SEND_ATTEMPTS:
            yield Sleep(seconds=min(last.retry_after_s or _backoff_s(attempt), _LONGEST_WAIT_S))
    if last is None or last.status == 0:
        why = "" if last is None else f"; {last.json}"
        raise Unreachable(f"no answer to `{call.method} {call.path}` after {_SEND_ATTEMPTS} attempts{why}")
    raise _problem(last)


def _read(reply: Reply) -> Any:  # noqa: ANN401 - whatever the route answers with
    if not isinstance(reply.json, dict):
        said = str(reply.json)[:80]
        raise Problem(reply.status, "unreadable_answer", f"`{said}` is no JSON document; valid is the URL of a server")
    return cast("Any", reply.json)


def _problem(reply: Reply) -> Problem:
    body = document(reply.json)
    if reply.status in range(300, 400):
        leads = "the answer leads to another address; valid is the URL of the server itself"
        return Problem(reply.status, "redirected", leads)
    detail = str(body.get("detail") or body.get("title") or reply.json)
    if reply.retry_after_s is not None and reply.retry_after_s > _LONGEST_WAIT_S:
        detail += (
            f"; to be asked again after `{reply.retry_after_s:g}` s, of which at most {_LONGEST_WAIT_S:g} are waited"
        )
    return Problem(reply.status, str(body.get("code", "unknown")), detail)


def invoke(body: Document, key: str | None, defers: int, on_update: OnUpdate | None) -> Talk[Result]:
    """Propose, propose again while deferred, follow to the end.

    Every attempt has a key of its own that follows from the first one, so that whoever calls again under a key, say
    after a restart, finds what the last attempt under it came to, and launches nothing a second time. What breaks the
    conversation off says that key, and the invocation as last heard of: see `_leave_key`.
    """
    _check_callable(on_update)
    first_key = uuid.uuid4().hex if key is None else header_text("idempotency_key", key, _MAX_NAME)
    for attempt in range(defers + 1):
        heard: list[Document] = []

        def hear(document: Document, heard: list[Document] = heard) -> None:
            heard[:] = [document]
            if on_update is not None:
                on_update(document)

        headers = {"Idempotency-Key": _nth_key(first_key, attempt)}
        try:
            reply = yield from _ask(Call(method="POST", path="/v1/invocations", json=body, headers=headers))
            posted = _read(reply)
            if reply.replayed and posted.get("status") == "deferred" and attempt < defers:
                continue  # an earlier call was told so, and has waited: what came next is under the next key
            invocation = yield from follow(posted, hear)
            again = invocation["status"] == "deferred" and attempt < defers
            if again:
                yield Sleep(seconds=max(_patience_s(invocation), _backoff_s(attempt)))
        except BaseException as error:
            _leave_key(error, first_key, next(iter(heard), None))
            raise
        if not again:
            return conclude(invocation)
    raise AssertionError("unreachable: the last attempt always concludes")


def _check_callable(on_update: object) -> None:
    """Refuse what could not be told anything: a coroutine function would only make coroutines that nobody awaits."""
    if on_update is None:
        return
    if not callable(on_update):
        raise Unsendable(f"on_update is `{shown(on_update)}`; valid is a function of one document; nothing was sent")
    if iscoroutinefunction(on_update) or iscoroutinefunction(type(on_update).__call__):
        raise Unsendable("on_update is an `async def`; valid is a plain function of one document; nothing was sent")


def _leave_key(error: BaseException, key: str, heard: Document | None) -> None:
    """Leave with whatever breaks `invoke` off the key under which the robot may be moving.

    Exceptions of this client have a place for it; any other, `on_update`'s own or one that ends the program, keeps its
    type. Either gets a note, so that the key is not lost with a program that lets it through.
    """
    if isinstance(error, Unsendable) and heard is None:  # nothing was sent
        return
    if isinstance(error, Problem | Unreachable) and error.idempotency_key is None:
        error.idempotency_key, error.invocation = key, heard
        refused = isinstance(error, Problem) and error.status < _SERVERS_FAULT  # then nothing is under way
        noted = heard is not None or not refused
    else:  # also one that an `invoke` within `on_update` has left its own key with
        noted = True
    if noted:
        name = "" if heard is None else f", invocation `{heard.get('id')}`"
        error.add_note(f"proposed under the idempotency key `{key}`{name}: invoking again under it takes it up")


def _patience_s(deferred: Document) -> float:
    """Return after how long to propose again: a second, where an answer names no time, and a minute at most."""
    said = document(deferred.get("admission")).get("retry_after_s")
    return float(min(said, _LONGEST_WAIT_S)) if isinstance(said, int | float) and said > 0 else 1.0


def _nth_key(first: str, attempt: int) -> str:
    return first if attempt == 0 else uuid.uuid5(_ATTEMPTS, f"{first} {attempt}").hex


def follow(invocation: Document, on_update: OnUpdate | None) -> Talk[Document]:
    """Long-poll until the invocation has ended, telling every change.

    Each poll names the version known already, so that a change since then is answered at once. Raises `Problem` for an
    answer that is no invocation, or another one.
    """
    told: tuple[Any, ...] = ()
    name = invocation.get("id")
    while True:
        _check_invocation(invocation, name)
        seen = (invocation["status"], invocation.get("updated_at"))
        if on_update is not None and seen != told:
            on_update(invocation)
        if seen == told:  # it may not have waited at all
            yield Sleep(seconds=_BACKOFF_S)
        told = seen
        if invocation["status"] in _TERMINAL:
            return invocation
        query = {"wait": str(WAIT_S)}
        version = invocation.get("updated_at")
        if isinstance(version, str) and 0 < len(version) <= _MAX_NAME and version.isprintable():  # else it names none
            query["seen"] = version
        invocation = yield from send(Call(method="GET", path=path_of(invocation["id"]), query=query), begun=True)


def take_up(name: str, on_update: OnUpdate | None) -> Talk[Document]:
    """Follow an invocation proposed earlier, by its name. Raises as `follow`."""
    _check_callable(on_update)
    found = yield from send(Call(method="GET", path=path_of(name)))
    _check_invocation(found, name)
    return (yield from follow(found, on_update))


def listed(call: Call) -> Talk[list[Document]]:
    """Return the items of a list. Raises `Problem` for an answer that is none."""
    answer = yield from send(call)
    items = answer.get("items")
    if not isinstance(items, list) or documents(cast("object", items)) != items:
        raise _unreadable(answer, "is no list of documents; valid is the URL of a server")
    return documents(cast("object", items))


def _check_invocation(invocation: Document, asked: object) -> None:
    """Raise `Problem` for an answer that is not the invocation asked for: what came of that, it does not say."""
    name, status = invocation.get("id"), invocation.get("status")
    named = isinstance(name, str) and 0 < len(name) <= _MAX_NAME and name.isascii()  # so that it can be asked after
    if not (named and isinstance(status, str)):
        raise _unreadable(invocation, "is no invocation; valid is the URL of a server")
    if name != asked:
        raise _unreadable(invocation, f"is not the invocation `{asked}`; valid is the one that was asked for")
    if status not in _STATUSES:
        raise _unreadable(invocation, f"has the status {ascii(status)[:40]}; valid: {', '.join(sorted(_STATUSES))}")
    if status == "completed" and str(invocation.get("outcome")) not in _DONE:
        raise _unreadable(invocation, f"is completed otherwise than by success; valid: {', '.join(sorted(_DONE))}")


def _unreadable(answer: Document, wrong: str) -> Problem:
    return Problem(200, "unreadable_answer", f"`{ascii(answer)[:80]}` {wrong}")


def conclude(invocation: Document) -> Result:
    """Return the result of a completed invocation. Raises `Refused` or `ExecutionFailed` for any other end."""
    if invocation["status"] == "completed":
        return Result(invocation=invocation)
    raise (Refused if invocation["status"] in _BEFORE_LAUNCH else ExecutionFailed)(invocation)


def proposal(capability: str, inputs: object, params: Mapping[str, Any], options: Mapping[str, Any]) -> Document:
    """Return the body of a proposal; options that are None are left out.

    Raises `Unsendable` where `inputs` is neither a mapping nor None, or a parameter stands in both it and `params`.
    """
    if not isinstance(inputs, Mapping | None):
        raise Unsendable(f"inputs is `{shown(inputs)}`; valid is a mapping of names and values; nothing was sent")
    given = dict(cast("Mapping[str, Any]", inputs or {}))
    if twice := sorted(given.keys() & params.keys()):
        raise Unsendable(f"`{twice[0]}` is given twice; valid is once, in the mapping or by keyword; nothing was sent")
    body: Document = {"capability": capability, "params": {**given, **params}}
    body.update({name: value for name, value in options.items() if value is not None})
    return body
