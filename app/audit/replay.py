"""Recorded decisions, made again under a policy, from the log with the recorded context.

What is compared is all that a decision says: status, admission with its reasons, verdict with its reasons, effective
parameters and changes. Under the policy that was in force then nothing may differ; under a candidate every difference
is a decision that would have come out otherwise. What a change of decisions would have led to next (other facts, other
proposals) nobody knows, so each decision stands by itself.

A decision that was recorded without its context (by a release before contexts were kept) is counted and not made again.
A long log is replayed by several processes, each on its own stretch.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast
from urllib.parse import quote

import orjson

from app.audit.errors import RecordDamaged
from app.audit.places import Places
from app.audit.reader import failure, open_read_only
from app.clock import rfc3339
from app.governance import recorded
from app.governance.bundle import digest as digest_of
from app.governance.bundle import load_kept
from app.governance.decision import decide
from app.governance.model import Proposal, Status

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Mapping
    from pathlib import Path

    from app.governance.decision import Decision
    from app.governance.model import Params, Reason
    from app.governance.policy import PolicySet

PAGE: Final = 2000
PARAMS: Final = "policy/inputs"
# By place alone: the index by kind would have every page sort all that is left.
_QUERY: Final = (
    "SELECT seq, invocation, kind, body FROM events NOT INDEXED "
    "WHERE seq > ? AND seq <= ? AND kind IN ('admission', 'policy') ORDER BY seq"
)

Body = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Changed:
    """One decision that comes out otherwise: where it stands in the log, and what it was and is."""

    seq: int
    invocation: str
    capability: str
    profile: str
    before: str
    after: str
    what: str

    @property
    def group(self) -> tuple[str, str, str, str, str]:
        """Return what it has in common with others."""
        return self.capability, self.profile, self.before, self.after, self.what


@dataclass(slots=True, kw_only=True)
class Replay:
    """What came of it: how many decisions were made again, which changed, how many could not be."""

    decisions: int = 0
    without_context: int = 0
    without_policy: int = 0
    changed: list[Changed] = field(default_factory=list[Changed])

    def add(self, other: Replay) -> None:
        """Take another stretch's result behind this one's."""
        self.decisions += other.decisions
        self.without_context += other.without_context
        self.without_policy += other.without_policy
        self.changed += other.changed

    def groups(self) -> list[tuple[tuple[str, str, str, str, str], list[Changed]]]:
        """Return the changed decisions by what they have in common, the largest group first."""
        found: dict[tuple[str, str, str, str, str], list[Changed]] = {}
        for one in self.changed:
            found.setdefault(one.group, []).append(one)
        return sorted(found.items(), key=lambda item: (-len(item[1]), item[0]))

    def document(self) -> Body:
        """Return the result as JSON, with every changed decision by its place and invocation."""
        names = ("capability", "profile", "before", "after", "what")
        groups = [
            {**dict(zip(names, group, strict=True)), "count": len(members),
             "decisions": [{"seq": one.seq, "invocation": one.invocation} for one in members]}
            for group, members in self.groups()
        ]  # fmt: skip
        return {
            "decisions": self.decisions,
            "without_context": self.without_context,
            "without_policy": self.without_policy,
            "changed": len(self.changed),
            "groups": groups,
        }


Policies: TypeAlias = "Callable[[str], PolicySet | None]"


def replay(data_dir: Path, policies: Policies, *, after: int = 0, until: int | None = None) -> Replay:
    """Make the decisions of a stretch of a log again; reads only, beside a running server or without one.

    Args:
        data_dir: the directory of a server.
        policies: what decides now, by the digest of what decided then; None where nothing can.
        after: the last place before the stretch.
        until: its last place; None is the end of the log.

    Raises:
        RecordDamaged: there is no log, it cannot be read, or an event is not what a server writes.
    """
    result, deciders = Replay(), dict[str, _Again | None]()
    for seq, invocation, admission, verdict in _decisions(data_dir, after, until):
        kept = admission.get(recorded.KEY)
        if kept is None:
            result.without_context += 1
            continue
        try:
            version = kept["policy_version"]
            if version not in deciders:
                policy = policies(version)
                deciders[version] = None if policy is None else _Again(policy)
            again = deciders[version]
            if again is None:
                result.without_policy += 1
                continue
            changed = again.compare(seq, invocation, admission, _own(admission, verdict), kept)
        except (KeyError, TypeError, ValueError) as error:
            database = Places(data_dir).database
            raise RecordDamaged(database, f"event `{seq}` is no record of a decision: {error!r}") from error
        result.decisions += 1
        if changed is not None:
            result.changed.append(changed)
    return result


def then_in_force(data_dir: Path) -> Policies:
    """Return what finds the version that decided then, among those that the server kept.

    It decides as it did then, also where a newer release would not put it in force any more.
    """

    def find(digest: str) -> PolicySet | None:
        with _opened(data_dir) as connection:
            row = connection.execute("SELECT files FROM policy_files WHERE digest = ?", (digest,)).fetchone()
        files = None if row is None else orjson.loads(row[0])
        return None if files is None or digest_of(files) != digest else load_kept(files)

    return find


def stretches(data_dir: Path, *, since: float | None, count: int) -> list[tuple[int, int]]:
    """Cut a log from a time on into stretches of about one length: the last place before each, and its own last.

    Args:
        data_dir: the directory of a server.
        since: wall time in seconds; None is the beginning.
        count: how many at most.

    Raises:
        RecordDamaged: there is no log, or it cannot be read.
    """
    at = "" if since is None else rfc3339(since)
    with _opened(data_dir) as connection:
        bounds = "SELECT coalesce(min(seq), 1), coalesce(max(seq), 0) FROM events WHERE at >= ?"
        first, last = connection.execute(bounds, (at,)).fetchone()
    length = max(PAGE, -(-(last - first + 1) // count))
    return [(start - 1, min(start - 1 + length, last)) for start in range(first, last + 1, length)]


@contextmanager
def _opened(data_dir: Path) -> Generator[sqlite3.Connection]:
    """Open the database past SQLAlchemy: a page of rows as the driver has them costs a third."""
    database = Places(data_dir).database
    if not database.is_file():
        raise RecordDamaged(database, "no such log: is this the data directory of a server?")
    try:
        with closing(open_read_only(f"file:{quote(str(database.resolve()))}?mode=ro")) as connection:
            yield connection
    except (sqlite3.Error, UnicodeDecodeError) as error:
        raise failure(database, error) from error
    except orjson.JSONDecodeError as error:
        raise RecordDamaged(database, f"cannot be read as a log: {error}") from error


def _decisions(data_dir: Path, after: int, until: int | None) -> Iterator[tuple[int, str, Body, Body | None]]:
    """Yield every decision in order: its place, its invocation, what admission said and what policy said of it."""
    with _opened(data_dir) as connection:
        last = connection.execute("SELECT coalesce(max(seq), 0) FROM events").fetchone()[0]
        yield from _paired(connection, after, last if until is None else min(until, last))


def _paired(connection: sqlite3.Connection, after: int, until: int) -> Iterator[tuple[int, str, Body, Body | None]]:
    held: tuple[int, str, Body] | None = None
    loads = orjson.loads
    for first in range(after, until, PAGE):
        rows = connection.execute(_QUERY, (first, min(first + PAGE, until))).fetchall()
        for seq, invocation, kind, raw in rows:
            body = loads(raw)["body"]
            if kind == "admission":
                if held is not None:
                    yield (*held, None)
                held = (seq, invocation, body)
            elif held is not None and held[1] == invocation and seq == held[0] + 1:
                yield (*held, body)  # what policy said stands right behind what admission said
                held = None
    if held is not None:
        query = "SELECT body FROM events WHERE seq = ? AND kind = 'policy'"
        following = connection.execute(query, (held[0] + 1,)).fetchone()
        yield (*held, None if following is None else loads(following[0])["body"])


def _own(admission: Body, verdict: Body | None) -> Body | None:
    """Return what policy said of the very parameters it was asked about, where more was shown with that."""
    anew = admission.get(recorded.ANEW, verdict)
    return None if anew is None or verdict is None else {**verdict, **anew}


class _Again:
    """Decides again under one policy."""

    def __init__(self, policy: PolicySet) -> None:
        self._policy = policy
        self._agents = recorded.Agents(policy)

    def compare(self, seq: int, invocation: str, admission: Body, verdict: Body | None, kept: Body) -> Changed | None:
        policy, profile = self._policy, admission["profile"]
        proposal, context = recorded.read(kept, profile, policy, self._agents)
        if kept["policy_version"] != policy.digest:
            params = policy.validate_params(proposal.capability, cast("Any", proposal.params), proposal.version)
            if isinstance(params, tuple):
                after, what = "invalid", f"{PARAMS}: {params[0].said}"
                return self._changed(seq, invocation, profile, proposal, _said(kept, verdict), after, what)
            if params != proposal.params:
                proposal = Proposal(
                    capability=proposal.capability, params=params, metadata=proposal.metadata, mode=proposal.mode,
                    preconditions=proposal.preconditions, version=proposal.version,
                )  # fmt: skip
        decision = decide(policy, proposal, context)
        if _same(decision, admission, verdict, kept):
            return None
        before, after = _said(kept, verdict), _says(decision)
        what = _difference(decision, admission, verdict)
        return self._changed(seq, invocation, profile, proposal, before, after, what)

    def _changed(
        self, seq: int, invocation: str, profile: str, proposal: Proposal, before: str, after: str, what: str
    ) -> Changed:
        return Changed(
            seq=seq,
            invocation=invocation,
            capability=proposal.capability,
            profile=profile,
            before=before,
            after=after,
            what=what,
        )


def _same(decision: Decision, admission: Body, verdict: Body | None, kept: Body) -> bool:
    return (
        decision.status == kept["decided"]
        and _same_admission(decision, admission, kept)
        and _same_verdict(decision, verdict)
    )


def _same_admission(decision: Decision, admission: Body, kept: Body) -> bool:
    if admission.get("recheck"):  # what it says of admission may end with a word of the runtime's own
        return True
    found = decision.admission
    if kept["decided"] == Status.AWAITING_APPROVAL and admission.get("status") == Status.DEFERRED:
        # Nobody was asked, for want of room, and that is what was said last.
        return _same_reasons(found.reasons, admission["reasons"][:-1])
    return (
        found.outcome == admission["outcome"]
        and found.retry_after_s == admission.get("retry_after_s")
        and _same_reasons(found.reasons, admission["reasons"])
    )


def _same_verdict(decision: Decision, verdict: Body | None) -> bool:
    found = decision.verdict
    if found is None or verdict is None:
        return found is None and verdict is None
    if found.outcome != verdict["outcome"] or found.effective != verdict["effective"]:
        return False
    changes = verdict["changes"]
    if len(changes) != len(found.changes):
        return False
    if any(one != (kept["param"], kept["requested"], kept["effective"], kept["rule"])
           for one, kept in zip(found.changes, changes, strict=True)):  # fmt: skip
        return False
    return _same_reasons(found.reasons, verdict["reasons"])


def _same_reasons(found: tuple[Reason, ...], kept: list[Mapping[str, str]]) -> bool:
    if len(found) != len(kept):
        return False
    return all(
        one == (other["rule"], other["code"], other["message"], other["remedy"])
        for one, other in zip(found, kept, strict=True)
    )


def _said(kept: Body, verdict: Body | None) -> str:
    return f"{kept['decided']} ({'unchecked' if verdict is None else verdict['outcome']})"


def _says(decision: Decision) -> str:
    return f"{decision.status} ({'unchecked' if decision.verdict is None else decision.verdict.outcome})"


def _difference(decision: Decision, admission: Body, verdict: Body | None) -> str:
    """Name the rules that decide now and did not, and those that did; without any, which parameters differ, or why."""
    found = decision.verdict
    now = {one.rule for one in (*decision.admission.reasons, *(() if found is None else found.reasons))}
    kept: list[Mapping[str, str]] = [*admission["reasons"], *([] if verdict is None else verdict["reasons"])]
    then = {one["rule"] for one in kept}
    rules = [f"+{rule}" for rule in sorted(now - then)] + [f"-{rule}" for rule in sorted(then - now)]
    if rules:
        return ", ".join(rules)
    if found is None or verdict is None:
        return "other reasons"
    return ", ".join(_params(verdict["effective"], found.effective)) or "other reasons"


def _params(before: Mapping[str, Any], after: Params) -> Iterator[str]:
    for name in sorted({*before, *after}):
        if before.get(name) != after.get(name):
            yield f"{name} {before.get(name)} -> {after.get(name)}"
