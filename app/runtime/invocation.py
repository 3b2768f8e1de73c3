"""One invocation as the server knows it: a value, its document (design, section 8), its row, and who may see what.

The stored document is the public one; while an invocation is not final it carries, under `_`, what the runtime needs
to go on with it after a restart.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, cast

import orjson

from app.audit.event import RowWrite
from app.clock import parse_rfc3339, rfc3339
from app.governance.model import TERMINAL, Mode, Outcome, Proposal, Role, Status, Strategy

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from app.governance.model import CoveredRecovery, Params, Reason

PRIVATE: Final = "_"
SEES_ALL: Final = frozenset({Role.OPERATOR, Role.ENGINEER, Role.AUDITOR})
FREE_TEXT: Final = frozenset({"comment", "note"})  # an operator's words; the agent gets codes


@dataclass(frozen=True, slots=True, kw_only=True)
class Principal:
    """Who speaks: a name that policy knows permissions for, and the role its token carries."""

    name: str
    role: Role
    station: str | None = None  # the cell this person stands at
    waits: Callable[[], bool] = field(default=lambda: True, compare=False, repr=False)  # for the answer, still


@dataclass(frozen=True, slots=True, kw_only=True)
class ProposalRequest:
    """What came through the door, already in types; `params` is as the agent sent it."""

    capability: str
    params: Params
    cell: str | None = None
    mode: Mode = Mode.NORMAL
    preconditions: tuple[str, ...] = ()
    recovery_preference: Strategy | None = None
    metadata: Params = field(default_factory=dict[str, Any])
    version: str | None = None

    def document(self) -> dict[str, Any]:
        """Return the request as JSON, for the record and for telling one request from another.

        A version that nobody asked for is left out, so that a request is the same as in a release that knew none.
        """
        return {
            "capability": self.capability,
            "params": dict(self.params),
            "cell": self.cell,
            "mode": self.mode,
            "preconditions": list(self.preconditions),
            "recovery_preference": self.recovery_preference,
            "metadata": dict(self.metadata),
            **({} if self.version is None else {"capability_version": self.version}),
        }

    def proposal(self, params: Params) -> Proposal:
        """Return the proposal q_t with parameters that were validated and filled in."""
        return Proposal(
            capability=self.capability,
            params=params,
            metadata=self.metadata,
            mode=self.mode,
            preconditions=self.preconditions,
            recovery_preference=self.recovery_preference,
            version=self.version,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Terms:
    """What of a proposal its document does not show, kept until it is final."""

    mode: Mode = Mode.NORMAL
    preconditions: tuple[str, ...] = ()
    recovery_preference: Strategy | None = None
    metadata: Params = field(default_factory=dict[str, Any])
    authorization: str | None = None  # the newest that was sent, whoever's hands it is for
    launched_at_s: float | None = None
    confirmed: bool = False  # the cell said that it has the session
    version: str | None = None  # of the capability, as the agent asked for it
    undone_by: str | None = None  # who ordered that the session be undone: only people may call that off
    taking: bool = False  # a human takes the controls, and the cell has not said yet that it has heard of it
    displaced: bool = False  # a human has driven it: it goes on only under a new authorization
    asked_tick: int | None = None  # when the cell last had a human asked
    recoveries: tuple[CoveredRecovery, ...] | None = None  # that its own newest authorization covers, as the log has it

    def document(self) -> dict[str, Any]:
        """Return the terms as JSON."""
        return {
            "mode": self.mode,
            "preconditions": list(self.preconditions),
            "recovery_preference": self.recovery_preference,
            "metadata": dict(self.metadata),
            "authorization": self.authorization,
            "launched_at_s": self.launched_at_s,
            "confirmed": self.confirmed,
            "version": self.version,
            "undone_by": self.undone_by,
            "taking": self.taking,
            "displaced": self.displaced,
            "asked_tick": self.asked_tick,
        }

    @classmethod
    def read(cls, document: Mapping[str, Any]) -> Terms:
        """Read back what `document` wrote; earlier releases did not say who ordered a rollback, or drives."""
        preference = document["recovery_preference"]
        return cls(
            mode=Mode(document["mode"]),
            preconditions=tuple(document["preconditions"]),
            recovery_preference=None if preference is None else Strategy(preference),
            metadata=document["metadata"],
            authorization=document["authorization"],
            launched_at_s=document["launched_at_s"],
            confirmed=document["confirmed"],
            version=document.get("version"),
            undone_by=document.get("undone_by"),
            taking=document.get("taking", False),
            displaced=document.get("displaced", False),
            asked_tick=document.get("asked_tick"),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Invocation:
    """The newest version of one invocation; `evolve` makes the next."""

    id: str
    status: Status
    capability: str
    agent: str
    cell: str | None
    profile: str
    policy_version: str
    requested: Mapping[str, Any]
    effective: Mapping[str, Any] | None
    admission: Mapping[str, Any]
    policy: Mapping[str, Any] | None
    escalation: Mapping[str, Any] | None
    outcome: Outcome | None
    created_at: str
    updated_at: str
    terms: Terms
    failure: Mapping[str, Any] | None = None
    grant: str | None = None
    takeover: Mapping[str, Any] | None = None

    @property
    def final(self) -> bool:
        """Say whether nothing can change any more."""
        return self.status in TERMINAL

    def evolve(self, at: str, **changes: Any) -> Invocation:  # noqa: ANN401  # fields of this class
        """Return the next version; its `updated_at` is later than the present one's even within a millisecond."""
        if at <= self.updated_at:
            at = rfc3339(parse_rfc3339(self.updated_at) + 0.0015)  # a millisecond on, and clear of the cutting off
        return replace(self, updated_at=at, **changes)

    def public(self) -> dict[str, Any]:
        """Return the document of design section 8.

        `grant` stands in it where a standing grant spared a human the question, `failure` where a session did not do
        its task, `takeover` where a human took the controls.
        """
        return {
            "id": self.id,
            "status": self.status,
            "capability": self.capability,
            "agent": self.agent,
            "cell": self.cell,
            "profile": self.profile,
            "policy_version": self.policy_version,
            "requested": self.requested,
            "effective": self.effective,
            "admission": self.admission,
            "policy": self.policy,
            "escalation": self.escalation,
            **({} if self.grant is None else {"grant": self.grant}),
            "outcome": self.outcome,
            **({} if self.failure is None else {"failure": self.failure}),
            **({} if self.takeover is None else {"takeover": self.takeover}),
            "created_at": self.created_at,
            "updated_at": self.updated_at,
        }

    @property
    def task(self) -> str | None:
        """Return what the agent calls its task; None where it names none."""
        return self._stated("task")

    @property
    def goal(self) -> str | None:
        """Return what the agent says it is after: its `goal`, or else the `intent` that rules can read; or None."""
        return self._stated("goal") or self._stated("intent")

    def _stated(self, name: str) -> str | None:
        said = self.terms.metadata.get(name)
        return said if isinstance(said, str) else None

    def row(self) -> RowWrite:
        """Return the row that holds this version."""
        document = self.public()
        if not self.final:
            document[PRIVATE] = self.terms.document()
        return RowWrite(
            table="invocations",
            values={
                "id": self.id,
                "status": self.status.value,
                "capability": self.capability,
                "agent": self.agent,
                "cell": self.cell,
                "profile": self.profile,
                "document": orjson.dumps(document),
                "created_at": self.created_at,
                "updated_at": self.updated_at,
            },
        )

    def proposal(self, params: Mapping[str, Any]) -> Proposal:
        """Return this invocation's proposal with other parameters (an approver's, or the constrained ones)."""
        return Proposal(
            capability=self.capability,
            params=params,
            metadata=self.terms.metadata,
            mode=self.terms.mode,
            preconditions=self.terms.preconditions,
            recovery_preference=self.terms.recovery_preference,
            version=self.terms.version,
        )


def read_invocation(document: bytes) -> Invocation:
    """Read a stored document back."""
    fields: dict[str, Any] = orjson.loads(document)
    terms = fields.pop(PRIVATE, None)
    status = Status(fields.pop("status"))
    outcome = fields.pop("outcome")
    return Invocation(
        **fields,
        status=status,
        outcome=None if outcome is None else Outcome(outcome),
        terms=Terms() if terms is None else Terms.read(terms),
    )


def public_document(document: bytes) -> dict[str, Any]:
    """Return the public part of a stored document."""
    fields: dict[str, Any] = orjson.loads(document)
    fields.pop(PRIVATE, None)
    return fields


def may_see(principal: Principal, agent: str) -> bool:
    """Say whether a principal may see what an agent proposed: an agent sees its own alone."""
    return principal.role in SEES_ALL or (principal.role is Role.AGENT and principal.name == agent)


def reasons_document(reasons: tuple[Reason, ...]) -> list[dict[str, str]]:
    """Return reasons as JSON objects."""
    return [
        {"rule": rule, "code": code, "message": message, "remedy": remedy} for rule, code, message, remedy in reasons
    ]


def without_free_text(value: Any) -> Any:  # noqa: ANN401  # JSON
    """Return JSON without what an operator wrote in words, at any depth."""
    match value:
        case dict():
            fields = cast("dict[str, Any]", value)
            return {key: without_free_text(item) for key, item in fields.items() if key not in FREE_TEXT}
        case list():
            return [without_free_text(item) for item in cast("list[Any]", value)]
        case _:
            return value
