"""Verification of a log from its stored bytes: nothing the writer remembers is taken on trust.

    1. Every checkpoint is signed by the log's key, they follow each other without gap, and what stands beside is right.
    2. Every event's place, its columns and its bytes agree, and its bytes hash to the leaf its checkpoint vouches for.
    3. The recomputed root is the signed root at every checkpoint; behind the last one stands no event.
    4. The file outside the database holds the same checkpoints, the last one excepted, which may still be on its way.
    5. Checkpoints that somebody kept elsewhere are of this log: whoever has its key can make all of the above hold for
       another history, but not for one whose head is known (consistency, RFC 9162, from the events themselves).

It reads events by their place: an index that hides one from a query, and the state beside the log, are no part of it.
A writer may go on meanwhile: the walk ends where the log ended when it began.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import sleep
from typing import TYPE_CHECKING, TypeAlias

from app.audit.checkpoint import Checkpoint, NoteInvalid, Verifier
from app.audit.checkpoint_file import read_notes
from app.audit.errors import RecordDamaged, RecordUnreadable
from app.audit.event import Event, read_columns
from app.audit.merkle import Frontier, leaf_hash, split_hashes
from app.audit.reader import MAX_LIMIT, Batch, Extent, Reader

if TYPE_CHECKING:
    from app.audit.places import Places

Progress: TypeAlias = Callable[[int, int], None]
"""Told how many events are verified, and of how many."""
Kept: TypeAlias = Mapping[int, bytes]
"""The roots of checkpoints that were kept elsewhere, by how many events they vouch for."""
BATCHES_AT_A_TIME = 32
PAUSE_EVERY = 25
NOT_THERE = (FileNotFoundError, IsADirectoryError, NotADirectoryError)  # what the system says for sure of a file


@dataclass(frozen=True, slots=True, kw_only=True)
class Verification:
    """What verification found.

    `size` events, from the first on, are good and have the tree root `root` (base64); `checkpoint` is the signed note
    that covers them. Where the log is not good, `first_bad` is the first event that is altered, missing or not vouched
    for, and `problem` says what is wrong.
    """

    ok: bool
    size: int
    root: str
    checkpoint: str | None
    first_bad: int | None = None
    problem: str | None = None


class _Bad(Exception):  # carries a finding to the end of the walk
    def __init__(self, seq: int, problem: str) -> None:
        self.seq = seq
        self.problem = problem
        super().__init__(problem)


def verify_log(
    places: Places,
    verifier: Verifier,
    *,
    kept: Kept | None = None,
    pause_s: float = 0.0,
    progress: Progress | None = None,
) -> Verification:
    """Verify the log in a data directory; never raises for what is stored there, or is not, but reports it.

    Args:
        places: the data directory's files.
        verifier: the key that must have signed its checkpoints.
        kept: checkpoints by that key that were kept elsewhere, and have to be of this very log.
        pause_s: how long to step aside after every 25 events, so that a server whose process this runs in goes on.
        progress: told after every few batches how far it has come.

    Raises:
        RecordUnreadable: it cannot be verified now: the process has no descriptor left, or the disk does not answer.
    """
    walk = _Walk(places, verifier, kept or {}, pause_s, progress)
    try:
        walk.run()
    except _Bad as bad:
        return walk.result(bad.seq, bad.problem)
    except (RecordDamaged, *NOT_THERE) as error:
        return walk.result(walk.frontier.size + 1, str(error))
    except OSError as error:
        path = Path(error.filename or places.checkpoints)  # what fails while it is read bears no name
        raise RecordUnreadable(path, error.strerror or str(error)) from error
    return walk.result(None, None)


class _Walk:
    """One pass from the first event to the last, holding what is known to be good so far."""

    def __init__(
        self, places: Places, verifier: Verifier, kept: Kept, pause_s: float, progress: Progress | None
    ) -> None:
        self.places = places
        self.pause_s = pause_s
        self.progress = progress
        self.verifier = verifier
        self.frontier = Frontier()
        self.note: str | None = None
        self._kept = dict(sorted(kept.items()))  # those that are still to come
        self._kept_good: tuple[Frontier, str | None] = self.frontier, None
        self._outside_gone = False
        self._not_outside: list[tuple[Frontier, str | None]] = []

    def result(self, first_bad: int | None, problem: str | None) -> Verification:
        return Verification(
            ok=problem is None,
            size=self.frontier.size,
            root=b64encode(self.frontier.root()).decode(),
            checkpoint=self.note,
            first_bad=first_bad,
            problem=problem,
        )

    def run(self) -> None:
        reader = Reader(self.places.database)
        try:
            before = reader.extent()
            # The file's length is taken between two looks at the database, for it may be neither ahead nor far behind.
            outside = self._read_outside()
            extent = reader.extent()
            if extent.first < 0 or (extent.last and extent.first != 1):
                raise _Bad(min(extent.first, 1), f"the first event is `{extent.first}`")
            self._compare_kept()
            while self.frontier.size < extent.signed:
                batches = reader.batches(after=self.frontier.size, until=extent.signed, limit=BATCHES_AT_A_TIME)
                if not batches:
                    raise _Bad(self.frontier.size + 1, "the checkpoints vanished while they were read")
                for batch in batches:
                    grown = self._grow(reader, batch)
                    self._outside(batch, outside, before.signed)
                    self.frontier, self.note = grown, batch.note
                    self._compare_kept()
                if self.progress is not None:
                    self.progress(self.frontier.size, extent.signed)
        finally:
            reader.close()
        self._end(extent, outside)

    def _read_outside(self) -> Iterator[str]:
        """Return the notes in the file outside; none where it is gone, and the walk still says how the events fare."""
        try:
            return read_notes(self.places.checkpoints, self.places.checkpoints.stat().st_size)
        except FileNotFoundError:
            self._outside_gone = True
            return iter(())

    def _end(self, extent: Extent, outside: Iterator[str]) -> None:
        if self._kept:
            told = f"a checkpoint kept elsewhere vouches for `{max(self._kept)}` events"
            raise _Bad(extent.signed + 1, f"{told}, here are `{extent.signed}`: the end was cut off")
        if extent.last > extent.signed:
            raise _Bad(extent.signed + 1, f"no checkpoint vouches for the events after `{extent.signed}`")
        if self._outside_gone:
            self.frontier, self.note = Frontier(), None
            raise _Bad(
                1,
                f"`{self.places.checkpoints}`, the checkpoints outside the database, is missing: the `{extent.signed}` "
                "events are as the checkpoints inside have them, but nothing outside says that none were taken off the "
                "end; valid: restore the file from a copy",
            )
        if len(self._not_outside) > 1:
            self.frontier, self.note = self._not_outside[0]
            raise _Bad(self.frontier.size + 1, f"`{self.places.checkpoints}` lacks the last checkpoints")
        if next(outside, None) is not None:
            raise _Bad(extent.signed + 1, f"`{self.places.checkpoints}` vouches for more events: the end was cut off")

    def _compare_kept(self) -> None:
        """Compare what has been walked with what was kept of it; only what ended a batch was ever signed."""
        here = self.frontier
        while self._kept and (size := next(iter(self._kept))) <= here.size:
            if self._kept.pop(size) != here.root() or size != here.size:
                self.frontier, self.note = self._kept_good
                raise _Bad(
                    self.frontier.size + 1,
                    f"the first `{size}` events are not those that a checkpoint kept elsewhere vouches for: they were "
                    "written anew, and signed anew",
                )
            self._kept_good = here, self.note

    def _grow(self, reader: Reader, batch: Batch) -> Frontier:
        size = self.frontier.size
        if batch.first != size + 1 or batch.size < batch.first:
            raise _Bad(size + 1, f"the checkpoint that covers event `{size + 1}` is missing")
        head = self._head(batch)
        vouched = self._vouched(batch, head)
        leaves = list(self._leaves(reader, batch, vouched))
        grown = self.frontier.extend(leaves)
        if grown.root() != head.root:
            raise _Bad(batch.first, f"the events `{batch.first}` to `{batch.size}` are not those that were signed")
        if vouched is None or batch.frontier != grown.pack():
            raise _Bad(batch.first, f"what stands beside the checkpoint at `{batch.size}` was altered")
        return grown

    def _head(self, batch: Batch) -> Checkpoint:
        try:
            head = self.verifier.open(batch.note)
        except NoteInvalid as error:
            raise _Bad(batch.first, f"the checkpoint at `{batch.size}`: {error}") from error
        if head.size != batch.size:
            raise _Bad(batch.first, f"the checkpoint at `{batch.size}` is signed for `{head.size}` events")
        return head

    def _vouched(self, batch: Batch, head: Checkpoint) -> tuple[bytes, ...] | None:
        """Return the stored leaf hashes if they are those that were signed: they name the very event that is bad."""
        try:
            leaves = split_hashes(batch.leaves)
        except ValueError:
            return None
        complete = len(leaves) == batch.size - self.frontier.size
        return leaves if complete and self.frontier.extend(leaves).root() == head.root else None

    def _leaves(self, reader: Reader, batch: Batch, vouched: tuple[bytes, ...] | None) -> Iterator[bytes]:
        for expected, event in enumerate(self._events(reader, batch), batch.first):
            if event is None or event.seq != expected:
                raise _Bad(expected, f"event `{expected}` is missing")
            leaf = leaf_hash(event.body) if type(event.body) is bytes else b""  # SQLite keeps any type anywhere
            if not leaf or (vouched is not None and leaf != vouched[expected - batch.first]):
                raise _Bad(expected, f"the bytes of event `{expected}` were altered")
            if not agrees(event):
                raise _Bad(expected, f"the columns of event `{expected}` are not what its bytes say")
            if self.pause_s and expected % PAUSE_EVERY == 0:
                sleep(self.pause_s)
            yield leaf

    def _events(self, reader: Reader, batch: Batch) -> Iterator[Event | None]:
        """Yield the stored events of a batch, and None where they end before it does."""
        seq = self.frontier.size
        while seq < batch.size:
            page = reader.events(after=seq, limit=min(MAX_LIMIT, batch.size - seq))
            if not page:
                yield None
            yield from page
            seq += len(page)

    def _outside(self, batch: Batch, outside: Iterator[str], due: int) -> None:
        """Compare with the next checkpoint in the file outside; those up to `due` were committed before it was read."""
        note = next(outside, None)
        if note is None:
            if batch.size <= due:
                self._not_outside.append((self.frontier, self.note))
        elif note != batch.note:
            raise _Bad(batch.first, f"`{self.places.checkpoints}` holds another checkpoint than that at `{batch.size}`")


def agrees(event: Event) -> bool:
    """Say whether an event's columns are what its bytes say."""
    try:
        return read_columns(event.body) == event
    except ValueError:
        return False
