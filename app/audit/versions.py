"""The table `policies`, compared with the log: who brought a version, what it promises, what was proved of it, its use.

Nobody signs a row, and from these follows what is proved before it decides, and whether anybody sees that a promise is
given up. So whoever decides takes them from the log, and an auditor compares.

| event | states of the version it names |
|---|---|
| the first of all | who brought it |
| any with `promises` | what it promises; what was proved with other promises counts no more |
| `awaiting_second` | the word of the first of two engineers, until it comes into force |
| `proposed`, `proved` | what was proved of it |
| `refuted`, `undecided` | why nothing was |
| `policy_activated` | that it came into force; where an engineer wanted it, for whom and why |

The files of a version that are kept (`policy_files`) are those of its digest, which every decision names in the log.

Not stated, so not compared: what earlier releases did not say of the promises that a start brought.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import orjson

from app.governance.bundle import digest as digest_of
from app.governance.model import EventKind

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from app.audit.event import Event
    from app.audit.reader import Reader, Row

PAGE: Final = 500
KINDS: Final = (EventKind.POLICY_VERSION, EventKind.POLICY_ACTIVATED)
KEPT_ACTIVATIONS: Final = 100  # of one version in its row; the log holds all of them
_ACTIVATION: Final = ("by", "why", "former", "direction")
_BY_A_START: Final = ["server"]
_PROVED: Final = frozenset({"proposed", "proved"})
_DOUBTED: Final = frozenset({"refuted", "undecided"})


class Told(NamedTuple):
    """What the log says of one version; `promises` is None where it promises nothing, and unless `promised` unsaid."""

    by: str
    promised: bool = False
    promises: str | None = None
    proved: str = ""
    doubt: str = ""
    awaiting: Mapping[str, Any] | None = None  # the word of the first of two engineers
    in_force: bool = False  # once at least
    entered: tuple[Mapping[str, Any], ...] = ()  # by the word of engineers


def told_of(events: Iterable[Event]) -> dict[str, Told]:
    """Return what events of `KINDS`, in order, say of versions, by digest."""
    found: dict[str, Told] = {}
    for event in events:
        body: dict[str, Any] = event.payload()
        named = body["policy_version"]
        found[named] = _follow(found.get(named, Told(event.actor)), event.kind, body)
    return found


def _follow(known: Told, kind: str, body: Mapping[str, Any]) -> Told:
    if "promises" in body:
        if known.promised and known.promises != body["promises"]:
            known = known._replace(proved="", doubt="")
        known = known._replace(promised=True, promises=body["promises"])
    if kind == EventKind.POLICY_ACTIVATED:
        by_engineers = ({name: body[name] for name in _ACTIVATION},) if "by" in body else ()
        return known._replace(in_force=True, awaiting=None, entered=(*known.entered, *by_engineers))
    if body["op"] == "awaiting_second":
        return known._replace(awaiting=body["awaiting"])
    if body["op"] in _PROVED:
        return known._replace(proved=body.get("proved", ""), doubt="")
    return known._replace(doubt=body["op"]) if body["op"] in _DOUBTED else known


def differing(document: Mapping[str, Any], told: Told) -> list[str]:
    """Return which fields of a version's document are not what the log says of them."""
    stated: dict[str, Any] = {"by": told.by, "proved": told.proved, "doubt": told.doubt, "awaiting": told.awaiting}
    if told.promised:
        stated["promises"] = told.promises
    wrong = [name for name, value in stated.items() if document.get(name) != value]
    return wrong if _are_of(document.get("activations"), told) else [*wrong, "activations"]


def _are_of(stored: Any, told: Told) -> bool:  # noqa: ANN401  # whatever the row holds
    """Say whether activations are those of the log; every start says what is in force, and few bring anything there."""
    try:
        wanted = [{name: one[name] for name in _ACTIVATION} for one in stored if one["by"] != _BY_A_START]
        whole = len(stored) < KEPT_ACTIVATIONS
    except (KeyError, TypeError):
        return False
    known = list(told.entered) if whole else list(told.entered)[len(told.entered) - len(wanted) :]
    return wanted == known and (told.in_force or not stored)


def version_wrong(row: Row, told: Mapping[str, Told]) -> str | None:
    """Say how a row of `policies` disagrees with the log; None where it does not."""
    known = told.get(row["id"])
    if known is None:
        return "the table `policies` knows it, the log does not"
    try:
        document: Any = orjson.loads(row["document"])
    except (orjson.JSONDecodeError, TypeError):
        document = None
    if not isinstance(document, dict) or document.get("digest") != row["id"]:  # pyright: ignore[reportUnknownMemberType]
        return "what the table `policies` holds is no document of it"
    wrong = differing(document, known)  # pyright: ignore[reportUnknownArgumentType]
    named = ", ".join(f"`{name}`" for name in wrong)
    return f"{named} in the table `policies` is not what the log says" if wrong else None


def version_problems(reader: Reader, *, limit: int) -> list[str]:
    """Compare the rows about versions with the log; return the first that say something else, or are missing, in words.

    A writer may go on meanwhile: a row that changed while the log was read is left for the next time.

    Args:
        reader: the log's.
        limit: how many to name at most.

    Raises:
        RecordDamaged: the database cannot be read.
    """
    before = {row["id"]: row for row in reader.rows("policies")}
    told = told_of(sorted(event for kind in KINDS for event in _all(reader, kind)))
    rows = {row["id"]: row for row in reader.rows("policies")}
    found = [
        f"`{name}`: {wrong}"
        for name, row in rows.items()
        if before.get(name) == row and (wrong := version_wrong(row, told)) is not None
    ]
    found += [
        f"`{name}`: the log knows it, the table `policies` does not" for name in sorted(told.keys() - rows.keys())
    ]
    found += [
        f"`{row['digest']}`: the files that are kept of it are not those of its digest"
        for row in reader.rows("policy_files")
        if not _are_files_of(row)
    ]
    return found[:limit]


def _are_files_of(row: Row) -> bool:
    try:
        files: dict[str, str] = orjson.loads(row["files"])
        return digest_of(files) == row["digest"]
    except (orjson.JSONDecodeError, TypeError, AttributeError):
        return False


def _all(reader: Reader, kind: str) -> Iterator[Event]:
    after = 0
    while page := reader.events(kind=kind, after=after, limit=PAGE):
        yield from page
        after = page[-1].seq
