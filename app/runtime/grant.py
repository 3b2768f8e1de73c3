"""A standing grant as the runtime keeps it: what governance decides by, and what became of it.

It ends once, and for one of `ENDS`; from then on it answers for nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import orjson

from app.audit.event import RowWrite
from app.clock import parse_rfc3339, rfc3339
from app.governance.model import Grant, GrantScope, Reason
from app.runtime.errors import GaveWay, InvalidParams

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.runtime.invocation import Invocation

LEAST_MINUTES: Final = 0.01  # what is shorter is over before anybody could use it
ACTIVE: Final = "active"
ENDED: Final = "ended"
REVOKED: Final = Reason(
    "authority/grants", "grant_ended", "the standing grant it was allowed by ended before it was sent", "propose again"
)
ENDS: Final = ("revoked", "expired", "estop", "profile_changed", "policy_changed", "giver_withdrawn")


class GrantEnded(GaveWay):
    """A grant that a decision stood on has ended before the decision was recorded."""

    def __init__(self) -> None:
        """Say of what is not sent that its grant has ended."""
        super().__init__(REVOKED)


@dataclass(frozen=True, slots=True, kw_only=True)
class GrantRequest:
    """What a person grants: to whom, for what, and for how long."""

    capability: str
    agent: str
    cell: str
    scope: GrantScope
    minutes: float
    object: str | None = None
    task: str | None = None
    profile: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Offer:
    """What a person grants with an approval: more of what was shown."""

    scope: GrantScope
    minutes: float
    object: str | None = None
    task: str | None = None

    def request(self, invocation: Invocation, handled: str | None) -> GrantRequest:
        """Return the grant for more of an invocation: for the object it handles (`handled`), or for its task.

        Raises:
            InvalidParams: it names another object or task than was shown.
        """
        named = {"object": self.object, "task": self.task}
        for scope, shown in ((GrantScope.OBJECT, handled), (GrantScope.TASK, invocation.task)):
            if self.scope is scope:
                named[scope] = _same(scope, named[scope], shown)
        return GrantRequest(
            capability=invocation.capability,
            agent=invocation.agent,
            cell=invocation.cell or "",
            profile=invocation.profile,
            scope=self.scope,
            minutes=self.minutes,
            **named,
        )


def _same(scope: GrantScope, named: str | None, shown: str | None) -> str | None:
    if named not in (None, shown):
        valid = "another scope" if shown is None else f"`{shown}`"
        raise InvalidParams([{"path": f"grant.{scope}", "message": f"`{named}` is not what was shown; valid: {valid}"}])
    return shown


@dataclass(frozen=True, slots=True, kw_only=True)
class Standing:
    """The newest version of one standing grant; `evolve` makes the next."""

    grant: Grant
    status: str
    escalation: str | None
    invocation: str | None
    uses: int
    used_at: str | None
    ended: Mapping[str, str] | None
    created_at: str
    updated_at: str
    drops: int = 0  # how often the grants of its cell had been dropped when it was decided; not recorded

    @property
    def id(self) -> str:
        """Return the grant's name."""
        return self.grant.id

    def evolve(self, at: str, **changes: Any) -> Standing:  # noqa: ANN401  # fields of this class
        """Return the next version."""
        return replace(self, updated_at=at, **changes)

    def end(self, at: str, code: str, by: str) -> Standing:
        """Return the version that has ended, and why."""
        return self.evolve(at, status=ENDED, ended={"code": code, "by": by, "at": at})

    def public(self) -> dict[str, Any]:
        """Return the document."""
        grant = self.grant
        return {
            "id": grant.id,
            "status": self.status,
            "capability": grant.capability,
            "agent": grant.agent,
            "cell": grant.cell,
            "profile": grant.profile,
            "policy_version": grant.policy_digest,
            "scope": grant.scope.value,
            "object": grant.object,
            "task": grant.task,
            "issued_by": grant.issued_by,
            "issued_at": rfc3339(grant.issued_at_s),
            "expires_at": rfc3339(grant.expires_at_s),
            "escalation": self.escalation,
            "invocation": self.invocation,
            "uses": self.uses,
            "used_at": self.used_at,
            "ended": None if self.ended is None else dict(self.ended),
            "created_at": self.created_at,
            "updated_at": self.updated_at,
        }

    def row(self) -> RowWrite:
        """Return the row that holds this version."""
        return RowWrite(
            table="grants",
            values={
                "id": self.id,
                "cell": self.grant.cell,
                "status": self.status,
                "document": orjson.dumps(self.public()),
                "created_at": self.created_at,
                "updated_at": self.updated_at,
            },
        )


def read_standing(document: bytes) -> Standing:
    """Read a stored document back."""
    fields: dict[str, Any] = orjson.loads(document)
    kept = ("status", "escalation", "invocation", "uses", "used_at", "ended", "created_at", "updated_at")
    grant = Grant(
        id=fields["id"],
        capability=fields["capability"],
        agent=fields["agent"],
        cell=fields["cell"],
        profile=fields["profile"],
        policy_digest=fields["policy_version"],
        scope=GrantScope(fields["scope"]),
        issued_by=fields["issued_by"],
        issued_at_s=parse_rfc3339(fields["issued_at"]),
        expires_at_s=parse_rfc3339(fields["expires_at"]),
        object=fields["object"],
        task=fields["task"],
    )
    return Standing(grant=grant, **{name: fields[name] for name in kept})
