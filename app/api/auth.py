"""Who is asking: bearer tokens, and the principals behind them. Who may use which route says `app.api.access`.

The server keeps SHA-256 digests, never tokens. The first start writes `tokens.json` (for people to read once, mode
0600), `cell.token` (for cells) and `principals.json` (the digests) into the data directory. `principals.json` is looked
at again at most once a second, so that a token issued or withdrawn by the command line counts without a restart and no
request waits for a file. While it cannot be read, what was read last holds, and health says so.
"""

from __future__ import annotations

import contextlib
import fcntl
import hmac
import logging
import math
import secrets
import unicodedata
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import orjson

from app import clock
from app.api.problems import Problem
from app.audit.archive import reading
from app.audit.places import Places
from app.config import CELL_ID, VALID_CELL_ID
from app.disk import lay_by, replace_private, write_private
from app.governance.model import Role
from app.governance.policy_model import GOVERNANCE
from app.runtime.drafts import GRANTED, SERVER
from app.runtime.invocation import Principal

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping

    from starlette.datastructures import Headers

log = logging.getLogger(__name__)

TOKENS_FILE = "tokens.json"
CELL_TOKEN_FILE = "cell.token"  # noqa: S105  # a file name
PRINCIPALS_FILE = "principals.json"
CELLS_FOLDER = "cells"  # a folder by name for each cell that the server has started
LOOK_AGAIN_S = 1.0
CHALLENGE = 'Bearer realm="reins"'

# The key in tokens.json, the name that stands in the record, and the role.
FIRST_PRINCIPALS: tuple[tuple[str, str, Role], ...] = (
    ("agent", "planner", Role.AGENT),
    ("operator", "operator", Role.OPERATOR),
    ("operator_2", "operator_2", Role.OPERATOR),
    ("engineer", "engineer", Role.ENGINEER),
    ("auditor", "auditor", Role.AUDITOR),
)
CELL_NAME = "cell"
MACHINES = frozenset({SERVER, CELL_NAME, GOVERNANCE})  # what the record calls those who are nobody


class PrincipalsUnreadable(Exception):
    """`principals.json` is missing a field or is no JSON; the server does not start on it."""

    def __init__(self, path: Path, problem: str) -> None:
        """Name the file and what is wrong with it."""
        self.problem = problem
        super().__init__(f"`{path}`: {problem}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Credential:
    """A principal, the SHA-256 digest of its token, and until when it holds (wall seconds; None: for good)."""

    principal: Principal
    digest: bytes
    expires_at_s: float | None = None

    def expired(self, now_s: float) -> bool:
        """Say whether the token holds no longer."""
        return self.expires_at_s is not None and self.expires_at_s <= now_s


class Principals:
    """The tokens the server knows, held in memory."""

    def __init__(self, path: Path) -> None:
        """Read the file. Raises `PrincipalsUnreadable`."""
        self._path = path
        self._stamp = _stamp(path)
        self._until_s: dict[Credential, float] = {}
        self._found = self._known = self._timed(_read(path))
        self._next_look_s = clock.monotonic_s() + LOOK_AGAIN_S
        self._on_roll = False
        self._problem: str | None = None

    def keep_roll(self) -> None:
        """Let whoever is new from now on count only once `admit` says so."""
        self._on_roll = True
        self._known = {}

    def look(self) -> Mapping[bytes, Credential]:
        """Look at the file now and return what it says, by digest; whoever is gone from it no longer counts."""
        # A file that vanished or broke while running takes nobody's stop button away: what was read last holds.
        try:
            self._read_again()
        except PrincipalsUnreadable as error:
            self._note(error.problem)
        except OSError as error:
            self._note(error.strerror or type(error).__name__)
        else:
            self._note(None)
        return self._found

    def _read_again(self) -> None:
        stamp = _stamp(self._path)
        if stamp == self._stamp:
            return
        self._found = self._timed(_read(self._path))
        self._stamp = stamp
        old = self._known
        self._known = {
            digest: credential
            for digest, credential in self._found.items()
            if not self._on_roll or old.get(digest) == credential
        }

    def _timed(self, found: dict[bytes, Credential]) -> dict[bytes, Credential]:
        """Note how long what was read may hold from now on, unless that is known."""
        late_s = clock.monotonic_s() - clock.wall_s()
        self._until_s = {
            one: self._until_s.get(one, one.expires_at_s + late_s)
            for one in found.values()
            if one.expires_at_s is not None
        }
        return found

    def end(self, credential: Credential) -> None:
        """Let a token hold no longer, whatever the clock says."""
        self._until_s[credential] = -math.inf

    def _over(self, credential: Credential) -> bool:
        """Say whether a token that was read holds no longer; a clock that is put back makes that no later."""
        until_s = self._until_s.get(credential, math.inf)
        return credential.expired(clock.wall_s()) or clock.monotonic_s() >= until_s

    def _note(self, problem: str | None) -> None:
        """Keep why the file cannot be read, and log it once for each change."""
        if problem == self._problem:
            return
        self._problem = problem
        if problem is None:
            log.warning("`%s` can be read again, and counts as it is", self._path)
        else:
            log.warning("`%s`: %s; what was read last holds, withdrawn tokens included", self._path, problem)

    def trouble(self) -> str | None:
        """Say why no token that is issued or withdrawn now would count; None where it would. Names no path."""
        if self._problem is None:
            return None
        return (
            f"`{PRINCIPALS_FILE}`: {self._problem}; what was read last holds, so that a token withdrawn since then "
            "counts still; valid: mend the file"
        )

    def admit(self, found: Mapping[bytes, Credential]) -> None:
        """Let what `look` returned count, as far as it still stands in the file."""
        self._known = {
            digest: credential for digest, credential in found.items() if self._found.get(digest) == credential
        }

    def may_give(self, name: str) -> bool:
        """Say whether somebody of that name has the token of an operator, as the file says, that has not expired."""
        return self._holds(name, Role.OPERATOR)

    def may_vouch(self, name: str) -> bool:
        """Say the same of an engineer's token."""
        return self._holds(name, Role.ENGINEER)

    def has(self, token: str) -> bool:
        """Say whether a token stands in the file and has not expired; before the record says so, it may not count."""
        found = self._found.get(sha256(token.encode()).digest())
        return found is not None and not self._over(found)

    def _holds(self, name: str, role: Role) -> bool:
        # What is found, and not what counts: at a start nobody counts before the record says so.
        return any(
            one.principal.name == name and one.principal.role is role and not self._over(one)
            for one in self._found.values()
        )

    def authenticate(self, headers: Headers) -> Principal:
        """Return who the request's bearer token stands for.

        Raises:
            Problem: 401 `token_missing`, `token_invalid` or `token_expired`; 400 `given_twice`.
        """
        # Straight from the list: asking the mapping costs more than everything else here.
        bearers = [value for name, value in headers.raw if name == b"authorization"]
        if len(bearers) > 1:  # whoever passed this on may have gone by the other one
            raise Problem("given_twice", f"`Authorization` is given {len(bearers)} times: valid is once")
        given = bearers[0] if bearers else b""
        scheme, _, token = given.decode("latin-1").partition(" ")
        if scheme.lower() != "bearer" or not token:
            raise Problem(
                "token_missing",
                "the request bears no token: valid is the header `Authorization: Bearer <token>`",
                headers={"WWW-Authenticate": CHALLENGE},
            )
        return self.recognize(token.strip())

    def recognize(self, token: str) -> Principal:
        """Return who a token stands for.

        Raises:
            Problem: 401 `token_invalid` or `token_expired`.
        """
        self._look_again()
        # Looking up by digest and comparing digests tells nothing about the token by its timing.
        digest = sha256(token.encode("utf-8", "surrogateescape")).digest()
        credential = self._known.get(digest)
        if credential is None or not hmac.compare_digest(credential.digest, digest):
            raise _refused("token_invalid", "the token is not known here")
        if credential.expires_at_s is not None and self._over(credential):
            raise _refused("token_expired", f"the token expired at `{clock.rfc3339(credential.expires_at_s)}`")
        return credential.principal

    def _look_again(self) -> None:
        now_s = clock.monotonic_s()
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + LOOK_AGAIN_S
        self.look()


def open_principals(data_dir: Path) -> Principals:
    """Return the principals of a data directory; the first start makes them and writes their tokens.

    Raises:
        PrincipalsUnreadable: the file is there and is not in its form.
        OSError: the directory cannot be written.
    """
    path = data_dir / PRINCIPALS_FILE
    if not path.exists():
        tokens = {key: _new_token(role) for key, _, role in FIRST_PRINCIPALS}
        cell_token = _new_token(Role.CELL)
        rows = [_row(name, role, tokens[key], None) for key, name, role in FIRST_PRINCIPALS]
        rows.append(_row(CELL_NAME, Role.CELL, cell_token, None))
        write_private(data_dir / TOKENS_FILE, orjson.dumps(tokens, option=orjson.OPT_INDENT_2) + b"\n")
        write_private(data_dir / CELL_TOKEN_FILE, cell_token.encode() + b"\n")
        listed = orjson.dumps({"principals": rows}, option=orjson.OPT_INDENT_2) + b"\n"
        write_private(path, listed)  # last: it ends the start
    lay_by(path)
    return Principals(path)


def issue_token(
    data_dir: Path, *, name: str, role: Role, ttl_s: float | None = None, station: str | None = None
) -> str:
    """Add a token for a principal and return it; it is not kept anywhere else.

    Args:
        data_dir: the server's data directory, after its first start.
        name: what the record will call the principal.
        role: what it may do.
        ttl_s: how long the token holds; None: for good.
        station: the cell that its bearer stands at, where they may take the controls from who does not; of a cell's
            token the only one that may dial in by it.

    Raises:
        ValueError: an empty name, or one with control characters or blanks around it; one that the record uses for a
            machine, or for somebody of another role; one that reads like another's, or like a standing grant's; a
            station that names no cell, or of somebody who is neither an operator nor a cell.
        PrincipalsUnreadable: the file is not in its form.
        RecordDamaged: the record cannot be read, so that nobody knows which cells there are.
        OSError: the directory cannot be read or written, or no server has made it.
    """
    if not name or len(name) > 128 or not name.isprintable() or name != name.strip():
        raise ValueError(
            f"`{name}` is no principal name: valid are 1 to 128 printable characters, no blank around them"
        )
    if role is not Role.CELL and as_read(name) in map(as_read, _machines(data_dir)):
        raise ValueError(f"`{name}` is what the record calls a machine: valid is another name")
    if as_read(name).startswith(GRANTED):  # of who approved a launch, the record could not tell which it was
        raise ValueError(f"`{name}` is what the record calls a standing grant: valid is another name")
    if station is not None and role not in {Role.OPERATOR, Role.CELL}:
        raise ValueError(f"the station `{station}` is where an operator takes over: valid is none with `{role}`")
    if station is not None and CELL_ID.fullmatch(station) is None:  # who stands there would be taken for remote
        raise ValueError(f"the station `{station}` is no name of a cell: valid are {VALID_CELL_ID}")
    token = _new_token(role)
    expires_at = None if ttl_s is None else clock.rfc3339(clock.wall_s() + ttl_s)
    path = data_dir / PRINCIPALS_FILE
    path.stat()  # where no server has kept principals, no lock is left behind either
    with _locked(data_dir / (PRINCIPALS_FILE + ".lock")):
        row: dict[str, str | None] = _row(name, role, token, expires_at)
        known = _rows(path)
        other = next((one["role"] for one in known if one["name"] == name and one["role"] != role.value), None)
        if other is not None:
            raise ValueError(f"`{name}` has the role `{other}` already: valid is that role, or another name")
        names = [one["name"] for one in known]
        alike = next((one for one in names if as_read(one) == as_read(name)), name)
        if name not in names and alike != name:  # two people who read as one would count as two approvers
            raise ValueError(f"`{name}` reads like `{alike}`, who is there already: valid is that, or another name")
        rows = [*known, row if station is None else {**row, "station": station}]
        write_private(path, orjson.dumps({"principals": rows}, option=orjson.OPT_INDENT_2) + b"\n")
        lay_by(path)
    return token


def issued(data_dir: Path) -> list[Credential]:
    """Return every token that is kept for a data directory, the oldest first. Errors as `issue_token`."""
    path = data_dir / PRINCIPALS_FILE
    return [_credential(path, row) for row in _rows(path)]


def withdraw_tokens(data_dir: Path, name: str, *, but_newest: bool = False) -> int:
    """Forget every token of a principal, or all but the one that was issued last; return how many were forgotten.

    Raises:
        ValueError: nobody of that name has one.
        PrincipalsUnreadable: the file is not in its form.
        OSError: the directory cannot be read or written, or no server has made it.
    """
    path = data_dir / PRINCIPALS_FILE
    path.stat()
    with _locked(data_dir / (PRINCIPALS_FILE + ".lock")):
        known = _rows(path)
        theirs = [row for row in known if row["name"] == name]
        gone = theirs[:-1] if but_newest else theirs
        kept = [row for row in known if row not in gone]
        if not theirs:
            names = ", ".join(f"`{one}`" for one in dict.fromkeys(str(row["name"]) for row in known))
            raise ValueError(f"`{name}` has no token: valid are {names}")
        replace_private(path, orjson.dumps({"principals": kept}, option=orjson.OPT_INDENT_2) + b"\n")  # it restrains
        lay_by(path)
    return len(known) - len(kept)


def as_read(name: str) -> str:
    """Return what a reader tells names apart by: not by capitals, nor by how wide a blank is or how coded an accent."""
    return " ".join(unicodedata.normalize("NFKC", name).casefold().split())


def _machines(data_dir: Path) -> set[str]:
    """Return whom the record calls by a name and who is nobody: cells that were started here, or joined, among them."""
    folder = data_dir / CELLS_FOLDER
    started = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    if not Places(data_dir).database.exists():  # no server has run yet
        return {*MACHINES, *started}
    with reading(data_dir) as reader:
        return {*MACHINES, *started, *(row["cell"] for row in reader.rows("cell_progress"))}


def _refused(code: str, detail: str) -> Problem:
    challenge = f'{CHALLENGE}, error="invalid_token", error_description="{code}"'
    return Problem(code, detail, headers={"WWW-Authenticate": challenge})


def _new_token(role: Role) -> str:
    return f"reins_{role.value}_{secrets.token_urlsafe(32)}"


def _row(name: str, role: Role, token: str, expires_at: str | None) -> dict[str, str | None]:
    return {
        "name": name,
        "role": role.value,
        "sha256": sha256(token.encode()).hexdigest(),
        "expires_at": expires_at,
    }


def _rows(path: Path) -> list[dict[str, Any]]:
    """Return the entries of a file, each in its form. Raises `PrincipalsUnreadable`."""
    try:
        document: object = orjson.loads(path.read_bytes())
    except orjson.JSONDecodeError as error:
        raise PrincipalsUnreadable(path, f"line {error.lineno}: {error.msg}") from error
    match document:
        case {"principals": list()}:
            rows = cast("dict[str, list[dict[str, Any]]]", document)["principals"]
        case _:
            raise PrincipalsUnreadable(path, "valid is an object with the list `principals`")
    for row in rows:
        _credential(path, row)
    return rows


def _read(path: Path) -> dict[bytes, Credential]:
    return {credential.digest: credential for credential in (_credential(path, row) for row in _rows(path))}


def _credential(path: Path, row: object) -> Credential:
    match row:
        case {"name": str(name), "role": str(role), "sha256": str(digest), "expires_at": str() | None as expires_at}:
            station = cast("dict[str, object]", row).get("station")
            if not isinstance(station, str | None):
                raise PrincipalsUnreadable(path, f"the entry of `{name}`: `station` is the name of a cell, or absent")
            if name in MACHINES and role != Role.CELL:
                raise PrincipalsUnreadable(path, f"the entry of `{name}`: that is what the record calls a machine")
            try:
                return Credential(
                    principal=Principal(name=name, role=Role(role), station=station),
                    digest=bytes.fromhex(digest),
                    expires_at_s=None if expires_at is None else _moment(expires_at),
                )
            except ValueError as error:
                raise PrincipalsUnreadable(path, f"the entry of `{name}`: {error}") from error
        case _:
            raise PrincipalsUnreadable(path, "an entry has `name`, `role`, `sha256` and `expires_at`")


def _moment(text: str) -> float:
    """Return the wall seconds of a time that the record can write down as well. Raises `ValueError`."""
    moment_s = clock.parse_rfc3339(text)
    clock.rfc3339(moment_s)  # an offset may lead out of the years that have four digits
    return moment_s


def _stamp(path: Path) -> tuple[int, int, int]:
    status = path.stat()
    return status.st_mtime_ns, status.st_ino, status.st_size


@contextlib.contextmanager
def _locked(path: Path) -> Generator[None]:
    with path.open("w") as handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
