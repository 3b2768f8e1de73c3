"""What the server's answer comes to for whoever proposed: a result, or an exception that says why there is none.

ReinsError
 ├─ Unsendable           what cannot be sent: no JSON, no path, no header, or by a closed client; nothing was sent
 ├─ Unreachable          no answer from the server, however often asked
 ├─ Problem              the server refused the request itself (application/problem+json)
 └─ NotCompleted         the proposal was decided, but the task is not done; carries the invocation
     ├─ Refused          rejected, denied, expired, or deferred for too long: never launched
     └─ ExecutionFailed  launched and ended otherwise than by success

An `Unreachable` or a `Problem` may come after the robot has begun. One that `invoke` raises says under which key it
proposed (`idempotency_key`), and what was last heard of the invocation (`invocation`, None if nothing): whoever invokes
again under that key finds the same invocation, and launches nothing a second time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias, cast

if TYPE_CHECKING:
    from collections.abc import Sequence

Document: TypeAlias = dict[str, Any]


class ReinsError(Exception):
    """Anything this client raises on purpose."""


class Unsendable(ReinsError):
    """A value given to the client cannot be sent, or the client was closed; nothing was sent."""


class _Interrupted(ReinsError):
    """The conversation broke off; what was proposed may be under way all the same.

    Attributes:
        idempotency_key: under which `invoke` proposed, and finds the same invocation again; None for other calls.
        invocation: the document last heard of it; None where the proposal itself was not answered.
    """

    idempotency_key: str | None = None
    invocation: Document | None = None


class Unreachable(_Interrupted):
    """The server did not answer, however often it was asked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reason:
    """Why a decision fell as it did: the rule, a stable code, plain words, and what would be accepted."""

    rule: str
    code: str
    message: str
    remedy: str


class Problem(_Interrupted):
    """The server refused the request itself: malformed, unauthenticated, not allowed, conflicting (RFC 9457)."""

    def __init__(self, status: int, code: str, detail: str) -> None:
        """Keep the facts; the message is made of them."""
        self.status = status
        self.code = code
        self.detail = detail
        super().__init__(f"{status} {code}: {detail}")


class NotCompleted(ReinsError):
    """A proposal that did not end in success: `invocation` is the whole document, `reasons` what to replan on.

    Those by which policy merely constrained a parameter come last: they are not what it failed by. What a denied one
    was deferred for stands behind what policy says of it: to mend that would not help.
    """

    PARTS: ClassVar[tuple[str, ...]] = ("admission", "policy", "failure")  # of the document, that say why

    def __init__(self, invocation: Document) -> None:
        """Collect the reasons."""
        self.invocation = invocation
        constrained = {change.get("rule") for change in documents(document(invocation.get("policy")).get("changes"))}
        denied = invocation.get("status") == "denied"
        reasons = reasons_of(invocation, sorted(self.PARTS, key=lambda part: denied and part == "admission"))
        self.reasons = tuple(sorted(reasons, key=lambda reason: reason.rule in constrained))
        said = "; ".join(reason.message or reason.code for reason in self.reasons) or "no reason given"
        super().__init__(f"`{invocation.get('capability')}` {invocation.get('status')}: {said}{_again(invocation)}")

    @property
    def codes(self) -> frozenset[str]:
        """The codes of all reasons."""
        return frozenset(reason.code for reason in self.reasons)


class Refused(NotCompleted):
    """Never launched: rejected, denied, expired without an answer, or deferred for too long."""


class ExecutionFailed(NotCompleted):
    """Launched, and ended otherwise than by success; `outcome` says how (`terminated`, `stopped`, `fault`, …).

    `reasons` are those of its end alone: what policy said to let it launch is in `invocation`.
    """

    PARTS = ("failure",)

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
        return str(self.invocation.get("id"))

    @property
    def outcome(self) -> str:
        """The outcome label o_t."""
        return str(self.invocation.get("outcome"))

    @property
    def effective(self) -> Document:
        """The parameters that were really in force."""
        return dict(document(self.invocation.get("effective")))

    @property
    def changes(self) -> list[Document]:
        """What policy constrained: param, requested, effective, rule."""
        return documents(document(self.invocation.get("policy")).get("changes"))


def reasons_of(invocation: Document, parts: Sequence[str]) -> tuple[Reason, ...]:
    """Return the reasons that parts of an invocation document hold, in that order.

    A part holds a list of `reasons`, or is itself the only one. What is no reason says nothing.
    """
    found: list[Document] = []
    for part in parts:
        said = document(invocation.get(part))
        found += documents(said.get("reasons")) or ([said] if "code" in said else [])
    return tuple(reason for item in found if (reason := _reason(item)) is not None)


def _again(invocation: Document) -> str:
    after_s = document(invocation.get("admission")).get("retry_after_s")
    named = invocation.get("status") == "deferred" and isinstance(after_s, int | float)
    return f"; to be proposed again after `{after_s}` s" if named else ""


def _reason(item: Document) -> Reason | None:
    words = {name: said for name in ("rule", "code", "message", "remedy") if isinstance(said := item.get(name), str)}
    return Reason(**{"rule": "", "code": "", "message": "", "remedy": "", **words}) if words else None


def document(value: object) -> Document:
    """Return a JSON object as it is, and anything else (an absent part) as an empty one."""
    return cast("Document", value) if isinstance(value, dict) else {}


def documents(value: object) -> list[Document]:
    """Return the JSON objects of a list; anything else holds none."""
    items = cast("list[object]", value) if isinstance(value, list) else []
    return [cast("Document", item) for item in items if isinstance(item, dict)]
