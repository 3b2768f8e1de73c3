"""Everything an auditor can have compared in a data directory, for the command and the server alike.

1. The log with its signed checkpoints, from the stored bytes (`verification`).
2. The database's schema with what the migrations make, and its indexes with its tables: a query goes by them.
3. The table `invocations` with what the log makes of them (`projection`): what the console lists is read from there.
4. The tables `escalations`, `grants` and `reviews` with the newest event about each of their documents (`documents`):
   what is pending, and what is granted, is read from there when a server starts.
5. The table `policies` with what the log says of versions (`versions`): who brought them, and what was proved of them.
6. The rows about cells with what the log says of their stops and reports (`cells`): at a start they decide.
7. The telemetry files with the digests that the log holds.

The last six mean something only where the log is good, so they are left out where it is not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from app.audit.archive import MAX_FAULTS, database_problems, reading, telemetry_problems
from app.audit.cells import cell_problems
from app.audit.checkpoint_file import read_kept
from app.audit.documents import document_problems
from app.audit.errors import RecordDamaged
from app.audit.places import Places, load_verifier
from app.audit.projection import projection_problems
from app.audit.verification import Verification, verify_log
from app.audit.versions import version_problems

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from app.audit.checkpoint import Verifier
    from app.audit.verification import Kept

WITHIN_S: Final = 30.0  # how long a server lets SQLite read its file; the command has no such limit


@dataclass(frozen=True, slots=True, kw_only=True)
class Examination:
    """What was found: `log`, and the first things wrong beside it, in words.

    `database` is None where there was not the time to read all of it.
    """

    log: Verification
    database: tuple[str, ...] | None = ()
    state: tuple[str, ...] = ()
    telemetry: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Say whether nothing is wrong, as far as was looked."""
        return self.log.ok and not (self.database or self.state or self.telemetry)

    @property
    def problem(self) -> str | None:
        """Return the first thing that is wrong, the log's own before all others."""
        return self.log.problem or next(iter((*(self.database or ()), *self.state, *self.telemetry)), None)


def examine(
    places: Places,
    verifier: Verifier,
    *,
    kept: Kept | None = None,
    pause_s: float = 0.0,
    within_s: float | None = None,
) -> Examination:
    """Compare everything there is in a data directory; never raises for what is stored there, but reports it.

    Args:
        places: the data directory's files.
        verifier: the key that must have signed the log's checkpoints.
        kept: checkpoints that were kept elsewhere.
        pause_s: how long to step aside again and again, so that a server whose process this runs in goes on.
        within_s: how long SQLite may read its file; None has no limit.

    Raises:
        RecordUnreadable: the log or what stands beside it in the database cannot be read now.
    """
    log = verify_log(places, verifier, kept=kept, pause_s=pause_s)
    if not log.ok:
        return Examination(log=log)
    return Examination(
        log=log,
        database=_found(lambda: database_problems(places.folder, within_s=within_s)),
        state=_found(lambda: _state_problems(places, pause_s)) or (),
        telemetry=_found(lambda: telemetry_problems(places.folder, pause_s=pause_s)) or (),
    )


def examine_file(data_dir: Path, verifier: Verifier | None = None, kept: Path | None = None) -> Examination:
    """Compare everything there is in a data directory that no server of this process has open.

    Args:
        data_dir: the directory of a server.
        verifier: the log's public key as kept elsewhere; by default the one beside the log, which whoever can rewrite
            the log can replace as well.
        kept: a file of checkpoints as kept elsewhere, all of which have to be of this very log.

    Raises:
        RecordDamaged: there is no log, or no public key.
        NoteInvalid: that file holds something else.
        OSError: that file cannot be read.
        RecordUnreadable: it cannot be read now.
    """
    places = Places(data_dir)
    key = verifier or load_verifier(places)
    heads = None if kept is None else read_kept(kept, key)
    with reading(data_dir):
        return examine(places, key, kept=heads)


def _state_problems(places: Places, pause_s: float) -> list[str]:
    with reading(places.folder) as reader:
        found = projection_problems(reader, limit=MAX_FAULTS, pause_s=pause_s)
        found += document_problems(reader, limit=MAX_FAULTS, pause_s=pause_s)
        found += version_problems(reader, limit=MAX_FAULTS)
        return (found + cell_problems(reader, limit=MAX_FAULTS))[:MAX_FAULTS]


def _found(look: Callable[[], list[str] | None]) -> tuple[str, ...] | None:
    try:
        found = look()
    except RecordDamaged as error:
        return (str(error),)
    return None if found is None else tuple(found)
