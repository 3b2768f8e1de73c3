"""The one writer of the log, without concurrency: stage a batch, commit it, or take it back.

    stage    on the event loop   give places, sign the checkpoint, make the statements
    commit   in the commit thread   rows, events and the checkpoint, in one transaction
    follow   in the commit thread   the checkpoint into the file outside, while the callers are answered already
    adopt    on the event loop   only now the tree in memory grows
    take_back                    ROLLBACK; the next stage looks first what the disk really holds

The tree is a value, so the memory cannot run ahead of the disk: a batch that fails takes its tree along.
"""

from __future__ import annotations

import fcntl
import os
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa
from alembic.util import CommandError
from sqlalchemy.exc import DatabaseError, SQLAlchemyError

from app.audit.checkpoint import NoteInvalid
from app.audit.checkpoint_file import CheckpointFile
from app.audit.errors import RecordDamaged, RecordUnavailable, RowExists, StoreInUse
from app.audit.merkle import Frontier, leaf_hash
from app.audit.migrate import migrate
from app.audit.places import Places, create_key, load_key
from app.audit.reader import SCHEMA, Reader
from app.audit.rows import Batches, Writing, prepared, primary_key, same_key
from app.audit.schema import schema_problems
from app.audit.tables import ON_CONNECT, STATE, STORE_GIVEN, checkpoints, events
from app.audit.verification import verify_log
from app.clock import rfc3339, wall_s
from app.disk import displaced

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping, Sequence

    from app.audit.event import Event, RowWrite, Submission
    from app.audit.verification import Progress

PROBE_BYTES = 32 * 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class Staged:
    """A batch ready to be written: what every submission gets, the statements, and the tree that will hold."""

    answers: tuple[tuple[Event, ...] | RowExists, ...]
    events: tuple[Event, ...]
    writings: tuple[Writing, ...]
    frontier: Frontier
    note: str


class Ledger:
    """The database with its lock, its key and its checkpoint file, opened for writing."""

    def __init__(self, places: Places, *, progress: Progress | None = None) -> None:
        """Open or create the log, bring its tables up to date, and verify all of it: what follows believes it.

        Args:
            places: the data directory's files.
            progress: told how many events are verified, and of how many.

        Raises:
            RecordUnavailable: the directory or the database cannot be written.
            RecordDamaged: what is stored contradicts its signatures, or parts of it are missing.
            StoreInUse: another process writes here.
        """
        self.places = places
        self._suspect = False
        self._due_outside: str | None = None  # the note the file has to end in, where that is not sure
        with ExitStack() as opened, naming_failures(places):
            places.folder.mkdir(parents=True, exist_ok=True)
            opened.callback(os.close, take_lock(places))
            self._engine = sa.create_engine(
                sa.URL.create("sqlite", database=str(places.database)),
                isolation_level="AUTOCOMMIT",
                connect_args={"check_same_thread": False},
            )
            opened.callback(self._engine.dispose)
            self._check_key(made_here := not places.database.exists())
            self._connection = connect(self._engine)
            opened.callback(self._connection.close)
            self._check_key(made_here or self._connection.execute(SCHEMA).first() is None)
            migrate(self._connection)
            dialect = self._engine.dialect.name
            self._replace = {name: prepared(table, dialect, replaces=True) for name, table in STATE.items()}
            self._insert_event = prepared(events, dialect)
            self._insert_checkpoint = prepared(checkpoints, dialect)
            self._batches = Batches(
                self._connection, [*self._replace.values(), self._insert_event, self._insert_checkpoint]
            )
            self.frontier, self.note = self._restore()
            new = self.frontier.size == 0 and not places.secret_key.exists()
            self.signer = create_key(places) if new else load_key(places)
            self._check_end()
            if self.frontier.size and not places.checkpoints.exists():
                raise RecordDamaged(places.checkpoints, "the checkpoints outside the database are missing")
            self._file = CheckpointFile(places.checkpoints)
            opened.callback(self._file.close)
            self._check_outside()
            self._check_all(progress)
            if not made_here:
                self._check_schema()
            # The lock as well: where it is deleted, another server takes a new one, and both would write.
            self._held = {path: path.stat() for path in (*places.written, places.lock)}
            self._opened = opened.pop_all()

    # -- writing -----------------------------------------------------------------------------------------------------

    def stage(self, batch: Sequence[Submission]) -> Staged:
        """Make a batch ready; what conflicts with rows written once is left out and answered so.

        Nothing else writes here, and no batch is staged before the last one is committed or taken back: what is read
        here holds until this batch is committed.

        Raises:
            Exception: the database cannot be read, in SQLAlchemy's words or its driver's; call `take_back`.
        """
        if self._suspect:
            self.frontier, self.note = self._restore()
            self._due_outside = self.note
            self._suspect = False
        seq = self.frontier.size
        taken: set[tuple[object, ...]] = set()
        answers: list[tuple[Event, ...] | RowExists] = []
        sealed: list[Event] = []
        rows: dict[str, list[Mapping[str, Any]]] = {}
        for submission in batch:
            once = [row for row in submission.rows if row.once]
            conflict = self._conflict(once, taken) if once else None
            if conflict is not None:
                answers.append(conflict)
                continue
            first = seq + 1
            mine = tuple([prepared.seal(first + place) for place, prepared in enumerate(submission.events)])
            for row in submission.rows:
                rows.setdefault(row.table, []).append({**row.values, STORE_GIVEN: first})
            seq += len(mine)
            sealed.extend(mine)
            answers.append(mine)
        writings = [self._replace[name].of(values) for name, values in rows.items()]
        frontier, note = self.frontier, self.note
        if sealed:
            leaves = [leaf_hash(event.body) for event in sealed]
            frontier = frontier.extend(leaves)
            note = self.signer.sign(frontier.size, frontier.root())
            checkpoint = {"size": frontier.size, "first": sealed[0].seq, "note": note}
            checkpoint |= {"frontier": frontier.pack(), "leaves": b"".join(leaves)}
            writings += (self._insert_event.in_order(sealed), self._insert_checkpoint.of([checkpoint]))
        return Staged(
            answers=tuple(answers), events=tuple(sealed), writings=tuple(writings), frontier=frontier, note=note
        )

    def commit(self, staged: Staged) -> None:
        """Write a staged batch, in any thread; not before the file outside has caught up with the last one.

        Raises:
            Exception: the driver's, or OSError: nothing was acknowledged; call `take_back`.
        """
        if self._due_outside is not None:
            self._file.missing = self._due_outside if self._due_outside != (self._file.last or "") else None
            self._due_outside = None
        self._check_names()  # what is refused below is in the database all the same, and would be again at every try
        self._file.catch_up()
        try:
            self._batches.write(staged.writings)
        except Exception as error:
            self._write_over(error)
            raise
        self._check_names()  # what went into a file without a name is not recorded

    def _write_over(self, failure: Exception) -> None:
        """Put a probe where a batch may lie that could not be made durable, before anybody is told that it failed.

        SQLite writes a transaction behind the last one that was committed, syncs it, and only then counts it. So a sync
        that fails leaves a whole transaction there, which the next start would take for committed. Whatever is
        written next begins in the same place. It may be refused a sync as well: nothing stands behind it then.
        """
        try:
            self._connection.connection.rollback()
            self._batches.write([self._replace["probes"].of([probe()])])
        except Exception as error:
            failure.add_note(f"what may be left of it could not be written over: {describe(error)}")
            self._connection.connection.rollback()

    def displaced(self) -> str | None:
        """Return which file of the log is not the one under its name any more; in any thread."""
        found = (displaced(path, held, f"record's file `{path.name}`") for path, held in self._held.items())
        return next((why for why in found if why is not None), None)

    def _check_names(self) -> None:
        if (why := self.displaced()) is not None:
            raise OSError(why)

    def follow(self, staged: Staged) -> str | None:
        """Write the checkpoint of a committed batch into the file outside, in the thread that committed it.

        Returns why it could not be written, if so; no further batch is committed then before it stands there.
        """
        if not staged.events:  # rows alone: the tree stayed as it was
            return None
        try:
            self._file.append(staged.note)
        except Exception as error:  # the thread it runs in has nobody who would hear of it: health has to say so
            return f"checkpoint file: {describe(error)}"
        return None

    def adopt(self, staged: Staged) -> None:
        """Let the tree in memory be that of a committed batch."""
        self.frontier, self.note = staged.frontier, staged.note

    def take_back(self) -> None:
        """Undo a batch that failed; the tree in memory never held it.

        Raises:
            sqlalchemy.exc.SQLAlchemyError: the database is beyond undoing; the next `stage` will say so too.
        """
        self._suspect = True  # a commit that failed may have reached the disk all the same
        self._connection.connection.rollback()

    def close(self) -> None:
        """Let go of the database, the file and the lock."""
        self._opened.close()

    def _conflict(self, rows: Sequence[RowWrite], taken: set[tuple[object, ...]]) -> RowExists | None:
        mine: set[tuple[object, ...]] = set()
        for row in rows:
            key = primary_key(row)
            place = (row.table, *key)
            if place in taken or place in mine or self._connection.execute(same_key(row)).first():
                return RowExists(row.table, key)
            mine.add(place)
        taken |= mine
        return None

    # -- opening -----------------------------------------------------------------------------------------------------

    def _check_key(self, nothing_there: bool) -> None:
        """Refuse to begin a second log with the key of a first: it would have signed two histories.

        A key is made when the tables are there, so one without them is no start that was interrupted.
        """
        if nothing_there and self.places.secret_key.exists():
            raise RecordDamaged(
                self.places.secret_key,
                f"the log it signed is gone: restore `{self.places.database.name}` and "
                f"`{self.places.checkpoints.name}`, or start a new data directory",
            )

    def _restore(self) -> tuple[Frontier, str]:
        newest = (
            sa.select(checkpoints.c.size, checkpoints.c.note, checkpoints.c.frontier)
            .order_by(checkpoints.c.size.desc())
            .limit(1)
        )
        row = self._connection.execute(newest).first()
        if row is None:
            return Frontier(), ""
        try:
            return Frontier.unpack(row.size, row.frontier), row.note
        except ValueError as error:
            raise RecordDamaged(self.places.database, f"the checkpoint at `{row.size}`: {error}") from error

    def _check_end(self) -> None:
        """Compare where the events end, and what the tree would go on from, with the last signed checkpoint."""
        size = self.frontier.size
        database = self.places.database
        last = self._connection.execute(sa.select(sa.func.max(events.c.seq))).scalar() or 0
        if last != size:
            raise RecordDamaged(database, f"the last event is `{last}`, the last checkpoint is at `{size}`")
        if not size:
            return
        try:
            signed = self.signer.verifier.open(self.note)
        except ValueError as error:
            raise RecordDamaged(database, f"its checkpoints: {error}") from error
        if (size, self.frontier.root()) != (signed.size, signed.root):
            raise RecordDamaged(database, f"what stands beside the checkpoint at `{size}` is not what was signed")

    def _check_all(self, progress: Progress | None) -> None:
        """Verify the log from its stored bytes, columns included: by them a start asks who decided what."""
        if not self.frontier.size:
            return
        found = verify_log(self.places, self.signer.verifier, progress=progress)
        if not found.ok:
            raise RecordDamaged(self.places.database, f"at event `{found.first_bad}`: {found.problem}")

    def _check_schema(self) -> None:
        """Compare the database with what the migrations make: its triggers keep the log, one more could hide events.

        It comes last, so that a log that is damaged itself is said to be.
        """
        reader = Reader(self.places.database)
        try:
            problems = schema_problems(reader)
        finally:
            reader.close()
        if problems:
            raise RecordDamaged(self.places.database, problems[0])

    def _check_outside(self) -> None:
        """Compare the end of the checkpoint file with the database, and write the note that a crash kept from it."""
        newest = sa.select(checkpoints.c.size, checkpoints.c.note).order_by(checkpoints.c.size.desc()).limit(2)
        rows = self._connection.execute(newest).all()
        notes = [row.note for row in rows]
        outside = self._file.last
        if outside in notes[:1] or (outside is None and not notes):
            return
        if outside in notes[1:] or (outside is None and len(notes) == 1):
            self._file.append(notes[0])
            return
        raise RecordDamaged(self.places.checkpoints, self._disagreement(outside))

    def _disagreement(self, outside: str | None) -> str:
        size = self.frontier.size
        if outside is None:
            return f"holds no checkpoint, the database has `{size}` events"
        try:
            head = self.signer.verifier.open(outside)
        except NoteInvalid as error:
            return f"its last checkpoint is not one of this log: {error}"
        if head.size > size:
            return f"vouches for `{head.size}` events, the database has `{size}`: its end was cut off"
        return f"its last checkpoint, at `{head.size}`, is not among the database's last"


def probe() -> dict[str, str | int | bytes | None]:
    """Return the one row that is written to find out whether anything can be, and that says nothing."""
    return {"id": 1, "at": rfc3339(wall_s()), "filler": bytes(PROBE_BYTES)}


def connect(engine: sa.Engine) -> sa.Connection:
    """Open a connection with the settings that make a commit durable."""
    connection = engine.connect()
    for statement in ON_CONNECT[engine.dialect.name]:
        connection.exec_driver_sql(statement)
    return connection


def take_lock(places: Places) -> int:
    """Hold the directory for this process; the system lets go when it dies.

    Raises:
        StoreInUse: another process holds it.
        OSError: the lock cannot be made.
    """
    descriptor = os.open(places.lock, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise StoreInUse(places.folder) from None
    return descriptor


@contextmanager
def naming_failures(places: Places) -> Generator[None]:
    """Turn what the system and the database say while opening into what it means for the record.

    Raises:
        RecordDamaged: the database is none, or belongs to a newer version.
        RecordUnavailable: the directory or the database cannot be written.
    """
    try:
        yield
    except (SQLAlchemyError, OSError) as error:
        # An `OperationalError` is the world's fault; a plain `DatabaseError` is the file's.
        if type(error) is DatabaseError:
            raise RecordDamaged(places.database, describe(error)) from error
        raise RecordUnavailable(describe(error)) from error
    except CommandError as error:
        raise RecordDamaged(places.database, f"its tables are of another version: {error}") from error


def describe(error: BaseException) -> str:
    """Return what a database or system error says, without the statement it struck."""
    return str(getattr(error, "orig", None) or error)
