"""What an auditor does with a data directory, read-only, whether or not a server runs on it."""

from __future__ import annotations

import hashlib
import os
import stat
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from time import sleep
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, Unpack

from app.audit.checkpoint import NoteInvalid, Verifier
from app.audit.errors import EventUnreadable, RecordDamaged
from app.audit.merkle import Frontier, leaf_hash
from app.audit.places import Places, load_verifier
from app.audit.reader import MAX_LIMIT, EventFilters, Reader
from app.audit.schema import schema_problems
from app.audit.verification import Verification, verify_log
from app.disk import sync_folder

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator
    from io import BufferedWriter

    from app.audit.event import Event
    from app.audit.searching import Words

MAX_FAULTS = 10
_KINDS: Final = {
    stat.S_IFDIR: "directory",
    stat.S_IFLNK: "symbolic link",
    stat.S_IFIFO: "named pipe",
    stat.S_IFSOCK: "socket",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Export:
    """What was exported: a line of `events` is the exact bytes of an event, `checkpoint` the note that signs them."""

    events: Path
    checkpoint: Path
    count: int
    sha256: str


def verify_file(data_dir: Path, verifier: Verifier | None = None) -> Verification:
    """Verify the log in a data directory.

    Args:
        data_dir: the directory of a server.
        verifier: the log's public key as kept elsewhere; by default the one beside the log, which whoever can rewrite
            the log can replace as well.

    Raises:
        RecordDamaged: there is no log, or no public key.
    """
    places = Places(data_dir)
    key = verifier or load_verifier(places)
    with reading(data_dir):
        return verify_log(places, key)


def show(data_dir: Path, invocation: str, words: Words | None = None) -> list[Event]:
    """Return all events under an invocation, in order; with `words`, those that hold them, or cannot be read.

    Raises:
        RecordDamaged: there is no log, or it cannot be read.
    """
    with reading(data_dir) as reader:
        return [event for event in walk(reader, invocation=invocation) if _may_hold(words, event)]


class Tail(NamedTuple):
    """Events in order, and the `seq` behind which others go on."""

    events: list[Event]
    end: int


def tail(data_dir: Path, *, limit: int = 20, after: int | None = None, words: Words | None = None) -> Tail:
    """Return the last events, however far back they stand; with `words`, the last that hold them, or cannot be read.

    With `after`, those among the first `limit` behind that `seq`, to go on from there.

    Raises:
        RecordDamaged: there is no log, or it cannot be read.
        ValueError: a limit out of bounds.
    """
    with reading(data_dir) as reader:
        if after is not None:
            page = reader.events(after=after, limit=limit)
            return Tail([event for event in page if _may_hold(words, event)], page[-1].seq if page else after)
        end = reader.extent().last
        if words is None:
            found = reader.events(before=end + 1, newest=True, limit=limit)
        else:
            behind = walk(reader, before=end + 1, newest=True)
            found = list(islice((event for event in behind if _may_hold(words, event)), limit))
        return Tail(found[::-1], end)


def _may_hold(words: Words | None, event: Event) -> bool:
    """Say whether an event holds words, or nobody can say: whoever shows it says that."""
    try:
        return words is None or words.held_by(event)
    except EventUnreadable:
        return True


def export(data_dir: Path, out: Path, format: Literal["jsonl"] = "jsonl") -> Export:  # the CLI's word
    """Write the events up to the newest checkpoint, one a line, and that checkpoint beside them (`….checkpoint`).

    Who has both and the public key can check them without this program: SHA-256(0x00 ‖ line) are the leaves.

    What is written is what the checkpoint signs: every event has its place, and their root is the signed one.

    Raises:
        RecordDamaged: there is no log, it cannot be read, or its events are not those that were signed; nothing is
            written then.
        ValueError: another format, something else where a file is to be (a directory, a link, a device), or a place
            within the data directory.
        OSError: the files cannot be written; then neither is there.
    """
    if format != "jsonl":
        raise ValueError(f"`{format}` is no export format: valid is `jsonl`")
    note_path = out.parent / f"{out.name}.checkpoint"
    for path in (out, note_path):
        _check_place(path, data_dir)
    if not out.parent.is_dir():
        raise ValueError(f"`{out}` is in no directory: valid is a name in one that is there")
    verifier = load_verifier(Places(data_dir))
    digest = hashlib.sha256()
    frontier = Frontier()
    with reading(data_dir) as reader, _drafted(note_path) as note_file, _drafted(out) as file:
        size, note = reader.head()
        for page in _pages(reader, size):
            lines = b"".join(event.body + b"\n" for event in page)
            file.write(lines)
            digest.update(lines)
            frontier = frontier.extend([leaf_hash(event.body) for event in page])
        _check_signed(reader.database, verifier, frontier, size, note)
        note_file.write(note.encode())
        for one in (file, note_file):
            one.flush()
            os.fsync(one.fileno())
        # Two names cannot change at once. So the old checkpoint goes first: events may be without one after a crash,
        # which says what it is, and never beside another's, which would look forged.
        note_path.unlink(missing_ok=True)
        sync_folder(out.parent)
        Path(file.name).replace(out)
        try:
            sync_folder(out.parent)
            Path(note_file.name).replace(note_path)
        except OSError:
            out.unlink()
            raise
        sync_folder(out.parent)
    return Export(events=out, checkpoint=note_path, count=size, sha256=digest.hexdigest())


def _pages(reader: Reader, size: int) -> Iterator[list[Event]]:
    """Yield the events up to a place, page by page.

    Raises:
        RecordDamaged: one is missing, or what stands for it is no bytes.
    """
    seq = 0
    while seq < size:
        page = reader.events(after=seq, limit=min(MAX_LIMIT, size - seq))
        for expected, event in enumerate(page, seq + 1):
            if event.seq != expected or type(event.body) is not bytes:
                raise RecordDamaged(reader.database, f"event `{expected}` is missing or no event: nothing is exported")
        if not page:
            raise RecordDamaged(reader.database, f"event `{seq + 1}` is missing: nothing is exported")
        yield page
        seq += len(page)


def _check_signed(database: Path, verifier: Verifier, frontier: Frontier, size: int, note: str) -> None:
    """Compare the root of what was read with the newest checkpoint.

    Raises:
        RecordDamaged: it is not the one that was signed.
    """
    if not size:
        return
    try:
        head = verifier.open(note)
    except NoteInvalid as error:
        raise RecordDamaged(database, f"the checkpoint at `{size}`: {error}: nothing is exported") from error
    if (head.size, head.root) != (size, frontier.root()):
        raise RecordDamaged(database, f"the events up to `{size}` are not those that were signed: nothing is exported")


def _check_place(path: Path, data_dir: Path) -> None:
    """Refuse to write where the record is, and over or through what is no file.

    Raises:
        ValueError: it names the place, and what would be valid.
    """
    if path.resolve().is_relative_to(data_dir.resolve()):
        raise ValueError(f"`{path}` lies in the data directory, which holds the record: valid is another one")
    for place in (path, _draft_of(path)):
        if (kind := _other_than_file(place)) is not None:
            raise ValueError(f"`{place}` is a {kind}: valid is the name of a file, of a new one or of one to replace")


def _draft_of(path: Path) -> Path:
    return path.parent / f"{path.name}.partial"  # `.` has no name, and is a directory


def _other_than_file(path: Path) -> str | None:
    """Return what stands at a path, where that is something that no export may replace, or write through."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return None
    return None if stat.S_ISREG(mode) else _KINDS.get(stat.S_IFMT(mode), "device")


@contextmanager
def _drafted(path: Path) -> Generator[BufferedWriter]:
    """Open `….partial` beside a path to fill and rename it; what is not renamed is removed."""
    draft = _draft_of(path)
    with draft.open("wb") as file:
        try:
            yield file
        finally:
            draft.unlink(missing_ok=True)


def database_problems(data_dir: Path, *, within_s: float | None = None) -> list[str] | None:
    """Compare the schema with the migrations, and let SQLite compare its indexes with its tables.

    An empty list means all agree, None that the time ran out.

    Verification walks the events by their place alone. A query by invocation, kind or actor goes by an index, and one
    that lost an entry would leave an event out though every event is good. Triggers that are gone let events be changed
    from now on, and one too many may keep the next ones out.

    Args:
        data_dir: the directory of a server.
        within_s: how long it may take; None has no limit.

    Raises:
        RecordDamaged: there is no log, or it cannot be read.
    """
    with reading(data_dir) as reader:
        faults = schema_problems(reader)[:MAX_FAULTS] or reader.faults(MAX_FAULTS, within_s=within_s)
        if faults is None:
            return None
        return [f"`{reader.database}`: {line}" for fault in faults for line in fault.splitlines()]


def telemetry_problems(data_dir: Path, *, pause_s: float = 0.0) -> list[str]:
    """Compare every telemetry file with the digest that the log holds for it; an empty list means all agree.

    Args:
        data_dir: the directory of a server.
        pause_s: how long to step aside after every file.

    Raises:
        RecordDamaged: there is no log, or it cannot be read.
    """
    with reading(data_dir) as reader:
        findings: list[str] = []
        for event in walk(reader, kind="telemetry"):
            finding = telemetry_problem(Places(data_dir).telemetry, event)
            findings += [] if finding is None else [finding]
            sleep(pause_s)
    return findings


def telemetry_problem(folder: Path, event: Event) -> str | None:
    """Say what is wrong with the file a `telemetry` event vouches for."""
    match event.payload():
        case {"file": str(name), "sha256": str(expected)} if Path(name).name == name:
            path = folder / name
        case _:
            return None  # a session that left no file says so in its own words
    try:
        # What stands there may be a pipe, whose opening waits for somebody to write.
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        return f"event `{event.seq}`: `{path}`: {error.strerror}"
    return None if found == expected else f"event `{event.seq}`: `{path}` is not the file that was recorded"


def walk(
    reader: Reader, *, before: int | None = None, newest: bool = False, **filters: Unpack[EventFilters]
) -> Iterator[Event]:
    """Yield events page by page; arguments as `Reader.events`."""
    after = 0
    while page := reader.events(after=after, before=before, newest=newest, limit=MAX_LIMIT, **filters):
        yield from page
        after, before = (after, page[-1].seq) if newest else (page[-1].seq, before)


@contextmanager
def reading(data_dir: Path) -> Generator[Reader]:
    """Open a data directory for reading.

    Raises:
        RecordDamaged: there is no log in it, or what is there is none; so do all reads, which also raise
            `RecordUnreadable` where it cannot be read now.
    """
    if not data_dir.is_dir():
        raise RecordDamaged(data_dir, "no such directory")
    reader = Reader(Places(data_dir).database)
    try:
        yield reader
    finally:
        reader.close()
