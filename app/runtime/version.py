"""One version of policy as the server keeps it: whose it is, what became of it, and who stood behind that.

| status | means |
|---|---|
| `candidate` | it was checked, and was never in force |
| `awaiting_second` | one engineer wants it in force, and what it loosens takes another |
| `active` | it decides |
| `former` | it was in force before |
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import orjson

from app.audit.errors import RowUnreadable
from app.audit.event import EventDraft, RowWrite
from app.audit.versions import KEPT_ACTIVATIONS
from app.governance.errors import PolicyErrors
from app.governance.model import EventKind
from app.runtime.errors import ExaminationFailed, NotFound

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.audit.versions import Told

CANDIDATE: Final = "candidate"
AWAITING: Final = "awaiting_second"
ACTIVE: Final = "active"
FORMER: Final = "former"
REQUEST: Final = "request"
DIRECTORY: Final = "directory"
SETTING: Final = "policy_active"
PROVED: Final = "proved"
REFUTED: Final = "refuted"
UNDECIDED: Final = "undecided"
UNKNOWN: Final = "unknown"
UNREADABLE: Final = (NotFound, RowUnreadable, PolicyErrors, ExaminationFailed)
"""Why a kept version cannot be had: what only looks at it, or compares with it, does without."""


class InForce(NamedTuple):
    """What is in force, and why: `source` is `directory` or `request`."""

    digest: str
    source: str
    why: str

    def row(self, at: str) -> RowWrite:
        """Return the row that says so to the next start."""
        values = {"name": SETTING, "value": orjson.dumps(self._asdict()), "updated_at": at}
        return RowWrite(table="settings", values=values)


@dataclass(frozen=True, slots=True, kw_only=True)
class Version:
    """The newest state of one version; `evolve` makes the next.

    Attributes:
        digest: `sha256:…` over its files.
        status: as in the table above.
        source: `request`, or the `directory` that a server was started with.
        by: who brought it.
        why: why they did.
        against: what was in force then; None for the first.
        rules: how many rules it has.
        cases: how many cases it passed.
        proved: what was proved of it, in a sentence; empty where nothing was yet.
        doubt: why it is not proved, where that was tried: `refuted` or `undecided`; empty otherwise.
        promises: text of its `properties.yaml`; None where it promises nothing.
        awaiting: the first of two engineers' word: `{by, at, why, against}`; None where nobody waits. It is shown; what
            counts is what `vouching` says.
        activations: every time it came into force: `{at, by, why, former, direction}`, the newest last.
    """

    digest: str
    status: str
    source: str
    by: str
    why: str
    against: str | None
    rules: int
    cases: int
    created_at: str
    updated_at: str
    proved: str = ""
    doubt: str = ""
    promises: str | None = None
    awaiting: Mapping[str, Any] | None = None
    activations: tuple[Mapping[str, Any], ...] = ()

    @property
    def verdict(self) -> str:
        """Return what is known of its proofs: `proved`, `refuted`, `undecided`, or `unknown`."""
        return PROVED if self.proved else self.doubt or UNKNOWN

    def evolve(self, at: str, **changes: Any) -> Version:  # noqa: ANN401  # fields of this class
        """Return the next state."""
        return replace(self, updated_at=at, **changes)

    def entered(self, at: str, activation: Mapping[str, Any]) -> Version:
        """Return it in force."""
        kept = (*self.activations, {"at": at, **activation})[-KEPT_ACTIVATIONS:]
        return self.evolve(at, status=ACTIVE, awaiting=None, activations=kept)

    def as_told(self, told: Told) -> Version:
        """Return it with what the log says in the place of what its row does, wherever something follows from that."""
        return replace(
            self,
            by=told.by,
            proved=told.proved,
            doubt=told.doubt,
            awaiting=told.awaiting,
            promises=told.promises if told.promised else self.promises,
            activations=self.activations if told.in_force else (),
        )

    def public(self) -> dict[str, Any]:
        """Return the version as JSON."""
        return {
            "digest": self.digest,
            "status": self.status,
            "source": self.source,
            "by": self.by,
            "why": self.why,
            "against": self.against,
            "rules": self.rules,
            "cases": self.cases,
            "proved": self.proved,
            "verdict": self.verdict,
            "awaiting": None if self.awaiting is None else dict(self.awaiting),
            "activations": [dict(one) for one in self.activations],
            "created_at": self.created_at,
            "updated_at": self.updated_at,
        }

    def row(self) -> RowWrite:
        """Return the row that holds this state."""
        return RowWrite(
            table="policies",
            values={
                "id": self.digest,
                "status": self.status,
                "document": orjson.dumps({**self.public(), "promises": self.promises, "doubt": self.doubt}),
                "created_at": self.created_at,
                "updated_at": self.updated_at,
            },
        )

    def event(self, op: str, actor: str, **more: Any) -> EventDraft:  # noqa: ANN401  # what else is to be recorded
        """Return the event of something that was said of it: `proposed`, `awaiting_second`, `offered`, a verdict."""
        body = {"op": op, "policy_version": self.digest, "status": self.status, "why": self.why, **more}
        return EventDraft(kind=EventKind.POLICY_VERSION, actor=actor, body=body)


def read_version(document: bytes) -> Version:
    """Read a stored document back."""
    fields: dict[str, Any] = orjson.loads(document)
    activations = tuple(fields.pop("activations"))
    fields.pop("verdict", None)  # it follows from the others
    return Version(**fields, activations=activations)


def files_row(digest: str, files: Mapping[str, str], at: str) -> RowWrite:
    """Return the row that keeps a version's files."""
    values = {"digest": digest, "files": orjson.dumps(dict(files)), "created_at": at}
    return RowWrite(table="policy_files", values=values)
