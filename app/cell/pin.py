"""Which server a cell believes: the key that its authorizations are signed with, pinned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from app.disk import write_private

if TYPE_CHECKING:
    from pathlib import Path


class LinkRefused(Exception):
    """This server is not one the cell works with: another kernel key, another protocol, a policy unlike its digest."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyPin:
    """Which kernel key the cell believes: `fixed` by flag, or the first one seen, kept in `path`."""

    path: Path
    fixed: str | None = None

    def check(self, key: str) -> None:
        """Accept the key or refuse the server; the first key of an unpinned cell is kept.

        Raises:
            LinkRefused: another key is pinned, or the key cannot be kept.
        """
        try:
            known = self.fixed or self._kept()
            if known is None:
                self._keep(key)
                return
        except OSError as error:
            raise LinkRefused(f"cannot pin the server's key in `{self.path}`: {error.strerror}") from error
        if known != key:
            where = f"in `{self.path}`" if self.fixed is None else "by `--server-key`"
            raise LinkRefused(f"the server signs with the key `{key}`; valid: `{known}`, pinned {where}")

    def _kept(self) -> str | None:
        return self.path.read_text().strip() if self.path.exists() else None

    def _keep(self, key: str) -> None:
        write_private(self.path, f"{key}\n".encode())
