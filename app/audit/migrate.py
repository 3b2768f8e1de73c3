"""Brings the database to the newest revision, from any working directory, all of it or nothing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from alembic import command
from alembic.config import Config

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


def migrate(connection: Connection) -> None:
    """Run the missing revisions in one transaction on an autocommit connection.

    Raises:
        FileNotFoundError: the revisions are not installed.
        sqlalchemy.exc.SQLAlchemyError, alembic.util.CommandError: a revision failed; the database is as it was.
    """
    config = Config()
    config.set_main_option("script_location", str(migrations_folder()).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    connection.exec_driver_sql(BEGIN_WRITE[connection.dialect.name])
    try:
        command.upgrade(config, "head")
    except BaseException:
        connection.exec_driver_sql("ROLLBACK")
        raise
    connection.exec_driver_sql("COMMIT")
