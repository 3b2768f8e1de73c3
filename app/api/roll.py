"""The roll: who may come in, as the record knows it.

Principals stand in a file, and the record must tell who held which token when. So what the file says is compared with
the `principal` events of the log at the start and once a second: whoever is new counts only when that is recorded,
whoever is gone stops counting at once. A token is named by the first eight bytes of its digest, which find it again
in the file and say nothing about the token.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final

from app.api.auth import LOOK_AGAIN_S, as_read
from app.audit.errors import RecordUnavailable
from app.audit.event import EventDraft
from app.clock import rfc3339
from app.governance.model import EventKind, Role

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.api.auth import Credential, Principals
    from app.audit.store import AuditStore

log = logging.getLogger(__name__)

ACTOR: Final = "server"
NAME_BYTES: Final = 8
PAGE: Final = 1000


class Roll:
    """Keeps the record's word on principals and the principals in force the same."""

    def __init__(self, principals: Principals, store: AuditStore) -> None:
        """Take what is compared; nothing is read yet."""
        self._principals = principals
        self._store = store
        self._recorded: dict[str, dict[str, Any]] = {}
        self._named: dict[str, str] = {}  # everyone who was ever on it and is no cell, by how their names are read

    async def open(self) -> None:
        """Read what the log says already, and record what it does not.

        Raises:
            RecordUnavailable: it cannot be recorded, so nobody counts.
        """
        after, since = 0, dict[str, int]()
        while True:
            events = await self._store.events(kind=EventKind.PRINCIPAL, after=after, limit=PAGE)
            for event in events:
                self._note(event.payload())
                since[str(event.payload()["credential"])] = after = event.seq
            if len(events) < PAGE:
                break
        await self._end_expired(since)
        self._principals.keep_roll()
        await self.update()

    async def _end_expired(self, since: Mapping[str, int]) -> None:
        """End the tokens that the record has outlived: a clock that was put back makes none of them hold again."""
        for credential in self._principals.look().values():
            seq, until_s = since.get(_name(credential)), credential.expires_at_s
            if seq and until_s is not None and await self._store.events(after=seq, since=until_s, limit=1):
                self._principals.end(credential)

    async def update(self) -> None:
        """Look at the file again, record what changed, and let it count.

        Raises:
            RecordUnavailable: nothing new counts.
        """
        found = self._principals.look()
        words = changes(self._recorded, {_name(credential): _entry(credential) for credential in found.values()})
        if words:
            await self._store.append([EventDraft(kind=EventKind.PRINCIPAL, actor=ACTOR, body=word) for word in words])
            for word in words:
                self._note(word)
        self._principals.admit(found)

    async def keep(self) -> None:
        """Update once a second, until cancelled; what could not be recorded is tried again."""
        while True:
            await asyncio.sleep(LOOK_AGAIN_S)
            try:
                await self.update()
            except RecordUnavailable as error:
                log.warning("a change of principals is not recorded, so what is new does not count yet: %s", error)

    def alike(self, name: str) -> str | None:
        """Return who is, or ever was, on the roll under a name that reads like this one; cells do not count."""
        listed = (credential.principal for credential in self._principals.look().values())
        new = {as_read(one.name): one.name for one in listed if one.role is not Role.CELL}  # may not be recorded yet
        return self._named.get(as_read(name)) or new.get(as_read(name))

    def _note(self, word: Mapping[str, Any]) -> None:
        entry = dict(word)
        op, credential = entry.pop("op"), str(entry["credential"])
        if entry["role"] != Role.CELL:
            self._named[as_read(entry["principal"])] = entry["principal"]
        if op == "withdrawn":
            self._recorded.pop(credential, None)
        else:
            self._recorded[credential] = entry


def changes(before: Mapping[str, Mapping[str, Any]], now: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the words that lead from one roll to another: `added`, `changed` or `withdrawn`, each with its entry."""
    words = [
        {"op": "changed" if credential in before else "added", **entry}
        for credential, entry in now.items()
        if before.get(credential) != entry
    ]
    return words + [{"op": "withdrawn", **before[credential]} for credential in before if credential not in now]


def _name(credential: Credential) -> str:
    return credential.digest[:NAME_BYTES].hex()


def _entry(credential: Credential) -> dict[str, Any]:
    until_s, who = credential.expires_at_s, credential.principal
    entry = {
        "credential": _name(credential),
        "principal": who.name,
        "role": who.role.value,
        "expires_at": None if until_s is None else rfc3339(until_s),
    }
    return entry if who.station is None else {**entry, "station": who.station}  # there they take the controls first
