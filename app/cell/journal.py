"""The cell's journal: what it did, kept on disk until the server's log has it.

One file, one line per record: `crc32 json`, appended with a single write. The file has a name of its own (`id`), drawn
when it is made: sequence numbers rise by one and never repeat under that name, across restarts and compactions, and
whoever counts them knows a file that was lost and made anew from one that goes on. A line that was torn by a crash can
only be the last one; it is cut off on opening and the loss is said. Any other damaged line means that the file is not
what the cell wrote, and it is refused.

There are two kinds of records: *entries*, which go up to the server, and *marks*, small facts a cell needs about itself
after a restart (permits it has used, the latch, the session that was open). Every entry may carry marks with it, so
that both become durable in the same write. Compaction drops acknowledged entries and keeps the last value of each mark.

What could not be written did not happen: every failure of the disk is `JournalUnavailable`, and whoever moves must not.
"""

from __future__ import annotations

import contextlib
import math
import os
import secrets
import zlib
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple, cast

import orjson

from app.disk import displaced, full, sync_folder

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from app.governance.model import Json

COMPACT_BYTES: Final = 4 * 1024 * 1024
USED: Final = "used:"
FORGOTTEN: Final = "forgotten_s"
BEGUN: Final = "begun_s"
KEEP_PERMITS: Final = 1000
MOST_MARKS: Final = 2 * KEEP_PERMITS
ID_BYTES: Final = 12


class JournalUnavailable(Exception):
    """The journal cannot be read or written; says the system's reason. Nothing may move.

    The file is named where it cannot be opened, which is said to who started the cell. What comes later goes up to the
    server, which shows it to everybody: where a cell keeps its files concerns nobody there.
    """


class JournalDamaged(JournalUnavailable):
    """What the journal holds cannot be read, and will not be at another start."""


class Entry(NamedTuple):
    """One thing that happened on the cell: the fields of the link's `UpEvent`."""

    seq: int
    at_s: float
    tick: int
    kind: str
    invocation: str | None
    actor: str
    body: dict[str, Json]


class Journal:
    """An append-only file of entries. Not thread-safe: one thread at a time writes, the one whose turn it is."""

    def __init__(self, path: Path, *, boot: str, now_s: float | None = None) -> None:
        """Open or create the file and read what is in it.

        Args:
            path: The file; its directory must exist.
            boot: Name of this run of the cell's process.
            now_s: Wall time, seconds since the epoch, for a file that is made; without it nobody knows when it was.

        Raises:
            JournalDamaged: a line that is not the last is damaged.
            JournalUnavailable: the file cannot be opened or named.
        """
        self.path = path
        self.boot = boot
        self.id = ""
        self.torn_bytes = 0
        self.acknowledged = 0
        self.first_seq = 1
        """The oldest entry that the file still holds, the next one where it holds none; for any thread to read."""
        self.marks: dict[str, Json] = {}
        self._entries: deque[Entry] = deque()
        self._seq = self._found = 0
        self._broken: str | None = None
        self._unnamed = False  # a power cut may leave the path to a file that is not this one any more
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
            self._load()
            self._found = self._seq  # what stood in the file as this run found it
            sync_folder(path.parent)
            if not self.id:
                self._name(now_s)
        except OSError as error:
            raise JournalUnavailable(f"cannot open journal `{path}`: {error.strerror}") from error

    # -- writing -------------------------------------------------------------------------------------------------------

    def append(
        self,
        *,
        at_s: float,
        tick: int,
        kind: str,
        invocation: str | None,
        actor: str,
        body: dict[str, Json],
        marks: Mapping[str, Json] | None = None,
    ) -> Entry:
        """Write one entry, and marks with it; survives the process at once, the machine after `sync`.

        Raises:
            JournalUnavailable: it could not be written; the journal is as it was before.
        """
        entry = Entry(self._seq + 1, at_s, tick, kind, invocation, actor, body)
        self._write({"e": list(entry), **({"m": dict(marks)} if marks else {})})
        self._seq = entry.seq
        self._entries.append(entry)
        self.marks.update(marks or {})
        return entry

    def mark(self, marks: Mapping[str, Json]) -> None:
        """Write marks without an entry; None removes one. Raises `JournalUnavailable`."""
        self._write({"m": dict(marks)})
        self.marks.update(marks)

    def number_behind(self, seq: int) -> None:
        """Number behind `seq` what this run wrote: the log holds that much of a journal whose file had lost its end.

        The log has other reports under the numbers that were given since the file was opened, and would take these for
        them. Nothing of this run may have been reported yet.

        Raises:
            JournalUnavailable: it could not be written.
        """
        if seq <= self._found:
            return
        own = [entry for entry in self._entries if entry.seq > self._found]
        self._entries = deque(entry._replace(seq=number) for number, entry in enumerate(own, seq + 1))
        self._seq, self.acknowledged, self._found = seq + len(own), seq, seq
        self.compact()

    def sync(self) -> None:
        """Return only when everything appended is on the disk. Raises `JournalUnavailable`."""
        self._check()
        try:
            os.fsync(self._file)
        except OSError as error:
            # After a failed fsync nobody knows what the disk holds: the file is not used again in this run.
            self._broken = error.strerror or "fsync failed"
            raise JournalUnavailable(f"cannot sync the journal: {error.strerror}") from error

    def require_room(self) -> None:
        """Return where a session's record could be written, as far as that can be told without writing it.

        Raises:
            JournalUnavailable: the file is out of use or not under its name any more, its disk is read-only or has no
                room (`app.disk`).
        """
        self._check()
        if (why := full(self._file, "journal")) is not None:
            raise JournalUnavailable(why)

    def acknowledge(self, seq: int) -> None:
        """Forget entries up to `seq`: the server's log has them. Compacts the file when it has grown.

        A log that has fewer of them than before was put back to an older copy: what the file holds behind `seq` still,
        is owed to it again.

        Raises:
            JournalUnavailable: the file could not be read, or the compacted one not be written.
        """
        if seq < self.acknowledged:
            self._owe_again(seq)
            return
        self.acknowledged = max(self.acknowledged, min(seq, self._seq))
        while self._entries and self._entries[0].seq <= self.acknowledged:
            self._entries.popleft()
        if self._size() > COMPACT_BYTES:
            self.compact()

    def compact(self) -> None:
        """Write the file anew with what is still needed, and put it in the old one's place in one step.

        Raises:
            JournalUnavailable: it could not be written, and the old file stands; or it could, and nobody knows under
                which name it would be found after a power cut: nothing counts as written until that is made good.
        """
        self._check()
        self._write_anew()

    def _write_anew(self) -> None:
        kept: dict[str, Json] = {name: value for name, value in self.marks.items() if value is not None}
        lines = [_line({"j": self.id, "m": kept, "s": self._seq, "a": self.acknowledged})]
        lines += [_line({"e": list(entry)}) for entry in self._entries]
        draft = self.path.with_name(self.path.name + ".new")
        try:
            fresh = os.open(draft, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC, 0o600)
            try:
                _write_all(fresh, b"".join(lines))
                os.fsync(fresh)
                draft.replace(self.path)
            except OSError:
                os.close(fresh)
                raise
        except OSError as error:
            raise JournalUnavailable(f"cannot compact the journal: {error.strerror}") from error
        # From here on the old file has no name, whatever follows: what is written there would be gone with the process.
        os.close(self._file)
        self._file = fresh
        self.marks = kept
        self._find_first()
        self._unnamed = True
        try:
            sync_folder(self.path.parent)
        except OSError as error:
            raise JournalUnavailable(f"cannot sync the journal's folder: {error.strerror}") from error
        self._unnamed = False

    def close(self) -> None:
        """Let go of the file."""
        os.close(self._file)
        self._broken = "closed"

    # -- reading -------------------------------------------------------------------------------------------------------

    @property
    def last_seq(self) -> int:
        """Return the newest sequence number; 0 before the first entry."""
        return self._seq

    @property
    def healthy(self) -> bool:
        """Say whether the last write went through."""
        return self._broken is None and not self._unnamed

    def unacknowledged(self, after: int = 0) -> tuple[Entry, ...]:
        """Return the entries behind a sequence number that the server has not acknowledged, in order."""
        return tuple(entry for entry in self._entries if entry.seq > after)

    def recall(self, after: int, before: int) -> tuple[Entry, ...]:
        """Return the entries between two numbers that the file holds, acknowledged or not; in any thread.

        Raises:
            JournalUnavailable: it cannot be read.
        """
        try:
            records = map(_record, self.path.read_bytes().splitlines(keepends=True))  # the last may be half written yet
        except OSError as error:
            raise JournalUnavailable(f"cannot read the journal: {error.strerror}") from error
        found = (_entry(fields) for record in records if record and isinstance(fields := record.get("e"), list))
        return tuple(entry for entry in found if after < entry.seq < before)

    def used_permits(self) -> frozenset[str]:
        """Return the identifiers of permits that were bound and have not been forgotten."""
        names = tuple(self.marks)  # in one step: another thread may be writing
        return frozenset(name.removeprefix(USED) for name in names if name.startswith(USED))

    @property
    def forgotten_s(self) -> float:
        """Return the latest expiry of the permits that were forgotten; minus infinity where none was."""
        latest = self.marks.get(FORGOTTEN)
        return float(latest) if isinstance(latest, (int, float)) else -math.inf

    @property
    def begun_s(self) -> float:
        """Return when the file was made: permits bound before are not in it; minus infinity where nobody knows."""
        begun = self.marks.get(BEGUN)
        return float(begun) if isinstance(begun, (int, float)) else -math.inf

    def forget_permits(self, now_s: float) -> None:
        """Forget used permits that have expired, where they have become many, and keep the latest expiry among them.

        Time alone would not refuse them from now on: a clock that ran ahead is put back. Whoever verifies refuses what
        expires by `forgotten_s`, and that is all there is until then. So what expired first goes first, and the newest
        stay beyond their expiry: of what was used while a clock ran ahead, each is known by its name once it is put
        back.

        Raises:
            JournalUnavailable: it could not be written; nothing is forgotten.
        """
        if len(self.marks) <= MOST_MARKS:
            return
        used = {
            name: until
            for name, until in self.marks.items()
            if name.startswith(USED) and isinstance(until, (int, float))
        }
        oldest = sorted(used, key=used.__getitem__)[:-KEEP_PERMITS]
        gone = {name: used[name] for name in oldest if used[name] < now_s}
        if gone:
            self.mark({**dict.fromkeys(gone), FORGOTTEN: max(self.forgotten_s, *gone.values())})
            self.marks = {name: value for name, value in self.marks.items() if value is not None}

    # -- inside --------------------------------------------------------------------------------------------------------

    def _owe_again(self, seq: int) -> None:
        older = self.recall(seq, self._entries[0].seq if self._entries else self._seq + 1)
        self._entries.extendleft(reversed(older))
        if older:
            self.acknowledged = older[0].seq - 1

    def _find_first(self) -> None:
        self.first_seq = self._entries[0].seq if self._entries else self._seq + 1

    def _check(self) -> None:
        if self._broken is not None:
            raise JournalUnavailable(f"the journal is out of use: {self._broken}")
        if self._unnamed:  # not synced again but written anew: after a sync that failed another one says nothing
            self._write_anew()
        if (why := displaced(self.path, os.fstat(self._file), "journal")) is not None:
            raise JournalUnavailable(why)

    def _size(self) -> int:
        return os.fstat(self._file).st_size

    def _write(self, record: dict[str, object]) -> None:
        self._check()
        try:
            line = _line(record)
        except TypeError as error:
            raise JournalUnavailable(f"cannot write the journal: {error}") from error
        try:
            size = self._size()
            try:
                _write_all(self._file, line)
            except OSError:
                self._undo(size)
                raise
        except OSError as error:
            raise JournalUnavailable(f"cannot write the journal: {error.strerror}") from error

    def _undo(self, size: int) -> None:
        """Cut off half a line; if even that fails, the file is not used again in this run."""
        try:
            os.ftruncate(self._file, size)
        except OSError as error:
            self._broken = error.strerror or "truncation failed"

    def _load(self) -> None:
        data = self.path.read_bytes()
        good = 0
        for line in data.splitlines(keepends=True):
            record = _record(line)
            if record is None:
                if good + len(line) != len(data):
                    raise JournalDamaged(f"journal `{self.path}` is damaged at byte `{good}`, before its last line")
                self.torn_bytes = len(line)
                os.ftruncate(self._file, good)
                os.fsync(self._file)
                break
            self._take(record)
            good += len(line)
        self.marks = {name: value for name, value in self.marks.items() if value is not None}
        self._find_first()

    def _name(self, now_s: float | None) -> None:
        """Give the file its name, durably: nothing is reported under one that a power cut would take back."""
        name = f"jrn_{secrets.token_hex(ID_BYTES)}"
        marks: dict[str, Json] = {} if now_s is None else {BEGUN: now_s}
        self._write({"j": name, "m": marks})
        self.sync()
        self.id = name
        self.marks.update(marks)

    def _take(self, record: dict[str, Json]) -> None:
        if isinstance(name := record.get("j"), str):
            self.id = name
        if isinstance(marks := record.get("m"), dict):
            self.marks.update(marks)
        if isinstance(seq := record.get("s"), int):
            self._seq = max(self._seq, seq)
        if isinstance(seen := record.get("a"), int):
            self.acknowledged = max(self.acknowledged, seen)
        if isinstance(fields := record.get("e"), list):
            entry = _entry(fields)
            if self._entries and entry.seq <= self._entries[-1].seq:
                raise JournalUnavailable(f"journal `{self.path}` repeats sequence number `{entry.seq}`")
            self._seq = max(self._seq, entry.seq)
            self._entries.append(entry)


def _entry(fields: list[Json]) -> Entry:
    return Entry(*cast("tuple[int, float, int, str, str | None, str, dict[str, Json]]", tuple(fields)))


def _line(record: Mapping[str, object]) -> bytes:
    text = orjson.dumps(record)
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _record(line: bytes) -> dict[str, Json] | None:
    """Return what a line holds, or None if it is not whole."""
    if not line.endswith(b"\n") or line[8:9] != b" ":
        return None
    text = line[9:-1]
    with contextlib.suppress(ValueError):
        if int(line[:8], 16) == zlib.crc32(text):
            return cast("dict[str, Json]", orjson.loads(text))
    return None


def _write_all(file: int, data: bytes) -> None:
    while data:
        data = data[os.write(file, data) :]
