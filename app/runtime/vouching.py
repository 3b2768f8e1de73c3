"""Who stands behind a change of what is in force, as the log has it.

What loosens takes two engineers, so nobody's word may come from a row that nobody signs, and none from a time of day: a
clock may be put back. A word is about one version in the place of another. It stands as long as that other one has been
in force all the while since; where that left and came back, it was about another change. Whoever is no engineer any
more stands behind nothing (`Versions.may_vouch`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

from app.audit.versions import KINDS
from app.governance.model import EventKind
from app.runtime.recollection import events_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from app.audit.event import Event
    from app.audit.store import AuditStore

NOBODY: Final[frozenset[str]] = frozenset()


class Vouching(NamedTuple):
    """Who `asked` for a version in the place of what is in force, and who `brought` it, compared with that."""

    asked: frozenset[str] = NOBODY
    brought: frozenset[str] = NOBODY

    def others(self, name: str) -> frozenset[str]:
        """Return whoever stands behind it beside somebody."""
        return (self.asked | self.brought) - {name}


async def vouching(store: AuditStore, digest: str) -> Vouching:
    """Return who has said already that a version should take the place of what is in force.

    Raises:
        RecordDamaged: the log cannot be read.
    """
    return standing(await words_of(store), digest)


async def words_of(store: AuditStore) -> list[Event]:
    """Return all that the log says of versions, in order. Raises `RecordDamaged`."""
    return sorted([event for kind in KINDS for event in await events_of(store, kind=kind)])


def standing(events: Iterable[Event], digest: str) -> Vouching:
    """Return whose words on a version stand behind the last of these events, all of both kinds, in order."""
    present, found = "", Vouching()
    for event in events:
        body: dict[str, Any] = event.payload()
        named = body["policy_version"]
        if event.kind == EventKind.POLICY_ACTIVATED:
            present, found = named, found if named == present else Vouching()
        elif named != digest:
            continue
        elif body["op"] == "awaiting_second" and body["awaiting"]["against"] == present:
            found = found._replace(asked=found.asked | {event.actor})
        elif body["op"] == "proposed" and body["against"] == present:
            found = found._replace(brought=found.brought | {event.actor})
    return found
