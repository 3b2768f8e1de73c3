"""The tables the revisions make are the tables the program uses."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from sqlalchemy.dialects import postgresql

from app.audit.errors import RecordDamaged
from app.audit.migrate import migrate, migrations_folder
from app.audit.places import Places
from app.audit.rows import replacement
from app.audit.store import AuditStore
from app.audit.tables import STATE, metadata
from tests.audit.conftest import fill, invocation_row


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
def connection(tmp_path: Path) -> Iterator[sa.Connection]:
    engine = sa.create_engine(f"sqlite:///{tmp_path / 'a.db'}", isolation_level="AUTOCOMMIT")
    with engine.connect() as opened:
        yield opened
    engine.dispose()


def test_revisions_come_to_the_tables_in_use(connection: sa.Connection) -> None:
    migrate(connection)
    assert compare_metadata(MigrationContext.configure(connection), metadata) == []
    indexes = {index.name for table in metadata.tables.values() for index in table.indexes}
    found = {index["name"] for table in metadata.tables for index in sa.inspect(connection).get_indexes(table)}
    assert found == indexes


def test_running_them_again_changes_nothing(connection: sa.Connection) -> None:
    migrate(connection)
    before = connection.exec_driver_sql("SELECT sql FROM sqlite_master").all()
    migrate(connection)
    assert connection.exec_driver_sql("SELECT sql FROM sqlite_master").all() == before


def test_works_from_any_directory(connection: sa.Connection, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    migrate(connection)
    assert sa.inspect(connection).has_table("events")


def test_a_revision_that_fails_leaves_nothing_behind(connection: sa.Connection) -> None:
    connection.exec_driver_sql("CREATE TABLE probes (id INTEGER)")  # stands in the way of the last table
    with pytest.raises(sa.exc.OperationalError, match="probes"):
        migrate(connection)
    assert sa.inspect(connection).get_table_names() == ["probes"]


def test_finds_the_revisions_an_installed_package_ships(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.audit.migrate.PACKAGE", tmp_path / "app")
    with pytest.raises(FileNotFoundError, match="no migrations"):
        migrations_folder()
    for folder in (tmp_path / "migrations", tmp_path / "app" / "shipped" / "migrations"):
        folder.mkdir(parents=True)
        (folder / "env.py").write_text("")
        assert migrations_folder() == folder


def put_back(database: Path, revision: str) -> None:
    """Let a record lie in a database that only ever came to an older revision."""
    older = database.with_suffix(".older")
    engine = sa.create_engine(f"sqlite:///{older}")
    config = Config()
    config.set_main_option("script_location", str(migrations_folder()))
    config.set_main_option("path_separator", "os")
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, revision)
    with engine.connect() as connection:
        connection.exec_driver_sql(f"ATTACH '{database}' AS newest")
        for table in sorted({*sa.inspect(connection).get_table_names()} - {"alembic_version"}):
            names = ", ".join(column["name"] for column in sa.inspect(connection).get_columns(table))
            connection.exec_driver_sql(f"INSERT INTO {table} ({names}) SELECT {names} FROM newest.{table}")  # noqa: S608
        connection.commit()
    engine.dispose()
    older.replace(database)


REVISIONS = sorted(path.name[:4] for path in (migrations_folder() / "versions").glob("*.py"))


@pytest.mark.anyio
@pytest.mark.parametrize("revision", REVISIONS)
async def test_a_record_of_any_revision_is_brought_up_and_goes_on(tmp_path: Path, revision: str) -> None:
    store = AuditStore.open(tmp_path)
    await fill(store)
    await store.append([], rows=[invocation_row("inv_1")])
    await store.close()
    database = Places(tmp_path).database
    put_back(database, revision)
    engine = sa.create_engine(f"sqlite:///{database}")
    with engine.connect() as connection:
        assert connection.exec_driver_sql("SELECT version_num FROM alembic_version").scalar() == revision
        assert set(sa.inspect(connection).get_table_names()) <= {*metadata.tables, "alembic_version"}
    reopened = AuditStore.open(tmp_path)
    await fill(reopened, 1)
    assert (await reopened.verify()).size == 15
    assert await reopened.row("invocations", id="inv_1") is not None
    await reopened.close()
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), metadata) == []
    with engine.begin() as connection, pytest.raises(sa.exc.IntegrityError, match="only grow"):
        connection.exec_driver_sql("REPLACE INTO events SELECT * FROM events")
    engine.dispose()


@pytest.mark.anyio
async def test_does_not_start_on_the_tables_of_a_newer_version(tmp_path: Path) -> None:
    await AuditStore.open(tmp_path).close()
    engine = sa.create_engine(f"sqlite:///{Places(tmp_path).database}")
    with engine.begin() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
    engine.dispose()
    with pytest.raises(RecordDamaged, match="another version"):
        AuditStore.open(tmp_path)


@pytest.mark.parametrize("table", [*metadata.tables.values()], ids=lambda table: table.name)
def test_tables_can_be_said_to_postgresql(table: sa.Table) -> None:
    text = str(sa.schema.CreateTable(table).compile(dialect=postgresql.dialect()))
    assert "BIGINT" in text or "TEXT" in text
    if table.name in STATE:
        upsert = str(replacement(table, "postgresql").compile(dialect=postgresql.dialect()))
        assert "ON CONFLICT" in upsert
