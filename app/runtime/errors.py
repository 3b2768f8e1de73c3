"""What the runtime raises at its callers' misuse. Refusals of a proposal are values; these never stand for one.

RuntimeRefusal
├── InvalidParams   the request does not fit the capability's schema, or names a cell that does not exist
├── NotFound        there is no such thing, or it is not the caller's to see
├── Forbidden       the caller may see it but not do this with it
├── ExaminationFailed  a candidate could not be examined, so it is not kept and cannot come into force
└── Conflict        it cannot be done in the present state; `code` says why and is stable

`GaveWay` stays within: what a decision stood on gave way before what was decided was sent.
`RecordUnavailable` (from `app.audit`) passes through unchanged: the record cannot be written, so nothing was done.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Self

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from app.governance.model import Reason

CONFLICTS: Final[Mapping[str, int]] = {
    "idempotency_mismatch": 422,
    "in_flight": 409,
    "wrong_status": 409,
    "ending": 409,
    "overtaken": 409,
    "given_up": 409,
    "rollback_ordered": 409,
    "already_resolved": 409,
    "already_approved": 409,
    "escalation_expired": 409,
    "digest_mismatch": 409,
    "edit_refused": 409,
    "cell_offline": 409,
    "cell_busy": 409,
    "not_latched": 409,
    "grant_refused": 409,
    "grant_ended": 409,
    "already_reviewed": 409,
    "interrupt_not_enabled": 409,
    "takeover_not_enabled": 409,
    "takeover_refused": 409,
    "control_held": 409,
    "not_taken_over": 409,
    "nothing_to_resume": 409,
    "resume_refused": 409,
    "facts_stale": 409,
    "paused": 409,
    "estop_latched": 409,
    "not_armed": 409,
    "review_not_enabled": 409,
    "policy_active": 409,
    "policy_changed": 409,
    "profile_changed": 409,
    "second_engineer_needed": 409,
}
"""Every code a `Conflict` may bear, with the HTTP status that says the same."""


class GaveWay(Exception):
    """A policy, profile, grant or link that a decision stood on gave way before that was sent; see `reasons`."""

    def __init__(self, *reasons: Reason) -> None:
        """Say what gave way, and to what."""
        self.reasons = reasons
        super().__init__(reasons[0].message)


class RuntimeRefusal(Exception):
    """Anything the runtime raises at a caller."""


class InvalidParams(RuntimeRefusal):
    """A request that does not fit; `problems` are `{path, message}` with dotted paths into it."""

    def __init__(self, problems: Sequence[Mapping[str, str]]) -> None:
        """Keep the problems; the message is the first of them."""
        self.problems = tuple(problems)
        first = self.problems[0] if self.problems else {"path": "", "message": "does not fit"}
        super().__init__(f"`{first['path']}` {first['message']}")


class NotFound(RuntimeRefusal):
    """There is no such thing for this caller."""

    def __init__(self, what: str, name: str, valid: Iterable[str] = ()) -> None:
        """Name what was looked for, and what there is where that is a handful."""
        self.what = what
        self.name = name
        there_is = ", ".join(f"`{one}`" for one in valid)
        super().__init__(f"no {what} `{name}`" + (f"; valid: {there_is}" if there_is else ""))


class Forbidden(RuntimeRefusal):
    """The caller may not do this; `code` is stable."""

    def __init__(self, code: str, message: str) -> None:
        """Keep the code and the message."""
        self.code = code
        super().__init__(message)

    @classmethod
    def withdrawn(cls, name: str) -> Self:
        """Say of somebody that their token was withdrawn, or expired, before their word counted."""
        return cls("role_forbidden", f"`{name}` may not do this any more: the token was withdrawn, or has expired")


class ExaminationFailed(RuntimeRefusal):
    """A policy could not be examined; nothing is known of it, and nothing has changed."""

    def __init__(self, why: str) -> None:
        """Say why."""
        super().__init__(f"the policy could not be examined: {why}")


class Conflict(RuntimeRefusal):
    """Not in the present state; `code` is one of `CONFLICTS`, `status` the HTTP status that goes with it."""

    def __init__(
        self, code: str, message: str, *, reasons: Sequence[Mapping[str, str]] = (), digest: str | None = None
    ) -> None:
        """Keep the code, the reasons where policy had any, and the digest by which what it asks is approved."""
        self.code = code
        self.status = CONFLICTS[code]
        self.reasons = tuple(reasons)
        self.digest = digest
        super().__init__(message)

    @classmethod
    def of(cls, reason: Reason) -> Conflict:
        """Return the conflict that a refusal of governance's is, with its reason."""
        return cls(reason.code, f"{reason.message}; valid: {reason.remedy}", reasons=[reason._asdict()])
