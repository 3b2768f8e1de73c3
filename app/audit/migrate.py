"""Brings the database to the newest revision, from any working directory, all of it or nothing."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from alembic import command
from alembic.config import Config
from alembic.script import ScriptDirectory

from app.audit.tables import BEGIN_WRITE

if TYPE_CHECKING:
    from sqlalchemy import Connection

PACKAGE = Path(__file__).resolve().parents[1]


def migrations_folder() -> Path:
    """Return where the revisions lie: inside the package when installed, at the repository's root in a checkout.

    Raises:
        FileNotFoundError: neither place has them.
    """
    places = (PACKAGE / "shipped" / "migrations", PACKAGE.parent / "migrations")
    for place in places:
        if (place / "env.py").is_file():
            return place
    raise FileNotFoundError(f"no migrations in `{places[0]}` nor in `{places[1]}`")


def configuration() -> Config:
    """Return what Alembic has to know.

    Raises:
        FileNotFoundError: the revisions are not installed.
    """
    config = Config()
    config.set_main_option("script_location", str(migrations_folder()).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    return config


@cache
def revisions() -> frozenset[str]:
    """Return every revision's name.

    Raises:
        FileNotFoundError: the revisions are not installed.
    """
    return frozenset(script.revision for script in ScriptDirectory.from_config(configuration()).walk_revisions())


def migrate(connection: Connection, revision: str = "head") -> None:
    """Run the missing revisions, up to one, in one transaction on an autocommit connection.

    Raises:
        FileNotFoundError: the revisions are not installed.
        sqlalchemy.exc.SQLAlchemyError, alembic.util.CommandError: a revision failed; the database is as it was.
    """
    config = configuration()
    config.attributes["connection"] = connection
    connection.exec_driver_sql(BEGIN_WRITE[connection.dialect.name])
    try:
        command.upgrade(config, revision)
    except BaseException:
        connection.exec_driver_sql("ROLLBACK")
        raise
    connection.exec_driver_sql("COMMIT")
