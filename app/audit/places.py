"""The files of a data directory, and the log's key pair in it."""

from __future__ import annotations

import os
import secrets
from dataclasses import dataclass
from typing import TYPE_CHECKING

from app.audit.checkpoint import KEY_BYTES, NoteInvalid, Signer, Verifier, parse_signer, parse_verifier
from app.audit.errors import RecordDamaged
from app.disk import sync_folder

if TYPE_CHECKING:
    from pathlib import Path

FOR_OTHERS = 0o077


@dataclass(frozen=True, slots=True)
class Places:
    """Where a log keeps what: database, checkpoints outside it, keys, lock, telemetry."""

    folder: Path

    @property
    def database(self) -> Path:
        """The events, the checkpoints and the runtime's state."""
        return self.folder / "reins.db"

    @property
    def written(self) -> tuple[Path, ...]:
        """The files that hold the log while it is written; SQLite keeps what is newest beside the database."""
        return self.database, self.database.with_name(f"{self.database.name}-wal"), self.checkpoints

    @property
    def checkpoints(self) -> Path:
        """The checkpoints once more, outside the database."""
        return self.folder / "checkpoints.log"

    @property
    def secret_key(self) -> Path:
        """The key that signs checkpoints, mode 0600."""
        return self.folder / "log.key"

    @property
    def public_key(self) -> Path:
        """The key that verifies them; keep a copy elsewhere."""
        return self.folder / "log.pub"

    @property
    def lock(self) -> Path:
        """Held by the one process that may write."""
        return self.folder / "log.lock"

    @property
    def telemetry(self) -> Path:
        """One MCAP file for every session."""
        return self.folder / "telemetry"


def create_key(places: Places) -> Signer:
    """Make a key of a new log and write both halves, the secret one readable by its owner alone.

    Raises:
        OSError: the directory cannot be written.
    """
    name = f"reins/log-{secrets.token_hex(6)}"
    signer = Signer(name=name, seed=secrets.token_bytes(KEY_BYTES))
    write_durably(places.secret_key, signer.text() + "\n", mode=0o600)
    write_durably(places.public_key, signer.verifier.text() + "\n", mode=0o644)
    return signer


def load_key(places: Places) -> Signer:
    """Read the signing key of an existing log.

    Raises:
        RecordDamaged: missing, readable by others, not a key, or not the other half of `log.pub`.
    """
    path = places.secret_key
    try:
        text = path.read_text()
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise RecordDamaged(
            path, "the key that signed this log is missing: restore it, or start a new data directory"
        ) from None
    except UnicodeDecodeError as error:
        raise RecordDamaged(path, f"is no text, so it is no key: {error}") from error
    if mode & FOR_OTHERS:
        raise RecordDamaged(path, f"others may read the key (mode `{mode & 0o777:o}`): valid is `600`")
    try:
        signer = parse_signer(text)
    except NoteInvalid as error:
        raise RecordDamaged(path, str(error)) from error
    if not places.public_key.exists():
        write_durably(places.public_key, signer.verifier.text() + "\n", mode=0o644)
    elif load_verifier(places) != signer.verifier:
        raise RecordDamaged(places.public_key, "is not the public half of `log.key`")
    return signer


def load_verifier(places: Places) -> Verifier:
    """Read the verifying key of a log.

    Raises:
        RecordDamaged: missing or not a key.
    """
    try:
        return parse_verifier(places.public_key.read_text())
    except FileNotFoundError:
        raise RecordDamaged(places.public_key, "no such key: is this the data directory of a server?") from None
    except (NoteInvalid, UnicodeDecodeError) as error:
        raise RecordDamaged(places.public_key, str(error)) from error


def write_durably(path: Path, text: str, *, mode: int) -> None:
    """Write a whole file so that after a crash either nothing or all of it is there.

    Raises:
        OSError: the directory cannot be written.
    """
    draft = path.with_name(path.name + ".new")
    draft.unlink(missing_ok=True)
    descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(descriptor, "w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)
    sync_folder(path.parent)
