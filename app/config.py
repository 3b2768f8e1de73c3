"""The settings, read once: flags and `REINS_*` variables become one frozen value; nothing else reads the environment.

The data directory as `reins serve` keeps it (mode 0700):

```
tokens.json     bearer tokens as first issued (0600)
kernel.key      the key authorizations are signed with (0600)
server.json     where the running server listens, and its process
cells/<id>/     what a child cell keeps: journal, pinned kernel key, lock with its process
```

The record itself (database, checkpoints, telemetry) is laid out by `app.audit`, beside these.
"""

from __future__ import annotations

import base64
import math
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from collections.abc import Mapping

DEFAULT_PROFILE: Final = "human-shared"  # the strictest
CELL_TOKEN_VARIABLE: Final = "REINS_CELL_TOKEN"  # noqa: S105  # the variable's name
MAX_CELLS: Final = 16
_KEY_BYTES: Final = 32
CELL_ID: Final = re.compile(r"[a-z0-9][a-z0-9_-]{0,39}")
VALID_CELL_ID: Final = "lower-case letters, digits, `-` and `_`, up to 40"
_PACKAGE: Final = Path(__file__).resolve().parent


class ConfigError(Exception):
    """A setting says something that cannot be used: names it, its value, and what would be valid."""

    def __init__(self, name: str, value: object, valid: str) -> None:
        """Keep the facts and write the message."""
        self.name, self.value, self.valid = name, value, valid
        super().__init__(f"`{name}` is `{value}`; valid: {valid}")


@dataclass(frozen=True, slots=True, kw_only=True)
class DataDir:
    """Where things lie in a data directory."""

    root: Path

    @property
    def tokens(self) -> Path:
        """Return the path of the bearer tokens as first issued."""
        return self.root / "tokens.json"

    @property
    def kernel_key(self) -> Path:
        """Return the path of the key that authorizations are signed with."""
        return self.root / "kernel.key"

    @property
    def server(self) -> Path:
        """Return the path of the note that says where the running server listens."""
        return self.root / "server.json"

    def cell(self, cell_id: str) -> Path:
        """Return the folder of a child cell."""
        return self.root / "cells" / cell_id

    def create(self) -> None:
        """Make the directory, readable by its owner alone.

        Raises:
            ConfigError: it cannot be made or is not a directory.
        """
        try:
            self.root.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError("data", self.root, f"a directory this user may write ({error.strerror})") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What `reins serve` is told. `pace` is simulated seconds per second while a session works, 0 as fast as it goes.

    `prove` has what is in force proved behind the start, if nobody did before.
    """

    host: str = "127.0.0.1"
    port: int = 8000
    data: Path = field(default_factory=lambda: Path("data"))
    policies: Path | None = None
    profile: str = DEFAULT_PROFILE
    cells: int = 1
    pace: float = 1.0
    seed: int = 0
    scenario: str | None = None
    robot: str | None = None
    take_policies: bool = False
    prove: bool = True

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        _demand(0 <= self.port <= 65535, "port", self.port, "0 (any free one) to 65535")
        _demand(0 <= self.cells <= MAX_CELLS, "cells", self.cells, f"0 to {MAX_CELLS}")
        check_pace(self.pace)
        _check_seed(self.seed)

    @property
    def layout(self) -> DataDir:
        """Return the layout of the data directory, by absolute path."""
        return DataDir(root=self.data.resolve())

    def cell_ids(self) -> tuple[str, ...]:
        """Return the names of the child cells: `workcell-1`, `workcell-2` and so on."""
        return tuple(f"workcell-{number}" for number in range(1, self.cells + 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class CellSettings:
    """What `reins cell` is told.

    `server` is the server's address; with `server_file` it is read again from that file before every dial, so that a
    child finds a server that came back at another port. `parent` is the process that started it, if one did.
    `server_key` pins the kernel's key (base64).
    """

    id: str
    token: str = field(repr=False)
    data: Path
    server: str | None = None
    server_file: Path | None = None
    server_key: str | None = None
    pace: float = 1.0
    seed: int = 0
    scenario: str | None = None
    robot: str | None = None
    parent: int | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        _demand(CELL_ID.fullmatch(self.id) is not None, "id", self.id, VALID_CELL_ID)
        _demand(bool(self.token), "token", "", f"a cell's token in the variable {CELL_TOKEN_VARIABLE}")
        fits = self.token.isascii() and self.token.isprintable()  # whoever would send it says it, in a log
        _demand(fits, "token", "…", f"printable ASCII characters in the variable {CELL_TOKEN_VARIABLE}")
        one = (self.server is None) != (self.server_file is None)
        _demand(one, "server", self.server, "either an address like http://127.0.0.1:8000 or a server file")
        valid = "http:// or https://, a host and a port up to 65535, for instance http://127.0.0.1:8000"
        _demand(self.server is None or _is_address(self.server), "server", self.server, valid)
        valid = f"the kernel's public key: {_KEY_BYTES} bytes in base64, as a cell keeps it in kernel.pub"
        _demand(self.server_key is None or _is_key(self.server_key), "server key", self.server_key, valid)
        check_pace(self.pace)
        _check_seed(self.seed)


def _is_address(text: str) -> bool:
    """Say whether there can be a server at an address; whether there is one, dialling tells."""
    try:
        parts = urlsplit(text)
        host, port = parts.hostname or "", parts.port
        host.encode("idna")
    except ValueError:  # a port beyond 65535 or no number, a bracket left open, a name that none can be asked for
        return False
    plain = text.isprintable() and " " not in text and text.startswith(("http://", "https://"))
    others = parts.query or parts.fragment or "@" in parts.netloc  # a user name would be sent in the token's place
    return plain and bool(host) and port != 0 and not others


def _is_key(text: str) -> bool:
    """Say whether a text is a key just as a server writes it: it is compared letter by letter."""
    try:
        key = base64.b64decode(text, validate=True)
    except ValueError:
        return False
    return len(key) == _KEY_BYTES and base64.b64encode(key).decode() == text


def cell_terms(settings: Settings | CellSettings) -> dict[str, object]:
    """Return what a cell is started with and keeps, by name."""
    return {
        "pace": settings.pace,
        "seed": settings.seed,
        "scenario": settings.scenario,
        "robot": settings.robot,
    }


def check_pace(pace: float) -> None:
    """Refuse a pace that is no number of simulated seconds per second. Raises `ConfigError`."""
    valid = "0 (as fast as possible), or 0.05 to 100 times real time"
    _demand(math.isfinite(pace) and (pace == 0 or 0.05 <= pace <= 100), "pace", pace, valid)


def _check_seed(seed: int) -> None:
    _demand(seed >= 0, "seed", seed, "0 or more")


def find_policies(flag: Path | None, called: str = "policies") -> Path:
    """Return the policy directory: the one named, else `./policies`, else the one shipped with Reins.

    Args:
        flag: the directory that was named, if one was.
        called: what the command calls it.

    Raises:
        ConfigError: the one named is no directory, or none is installed.
    """
    if flag is not None:
        _demand(flag.is_dir(), called, flag, "a directory of policy files")
        return flag.resolve()
    places = (Path("policies"), _PACKAGE.parent / "policies", _PACKAGE / "shipped" / "policies")
    for place in places:
        if (place / "site.yaml").is_file():
            return place.resolve()
    raise ConfigError("policies", "", "a directory given with --policies, or `policies` in the working directory")


def cell_token(environ: Mapping[str, str] | None = None) -> str:
    """Return the cell's token from the environment, as out of a file that ends its line; empty where there is none."""
    return (os.environ if environ is None else environ).get(CELL_TOKEN_VARIABLE, "").strip()


def _demand(holds: bool, name: str, value: object, valid: str) -> None:
    if not holds:
        raise ConfigError(name, value, valid)
