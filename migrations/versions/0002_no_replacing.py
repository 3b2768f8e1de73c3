"""Refuse a REPLACE of what is recorded.

SQLite deletes the row in the way of an `INSERT OR REPLACE` without firing the triggers of deletion, unless the
connection itself asked for `recursive_triggers`; whoever opens the file with another program has not. So an insertion
is refused where the row is there already. PostgreSQL needs nothing: there only an UPDATE replaces, and that is refused.
"""

from __future__ import annotations

from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

KEYS = {"events": "seq", "checkpoints": "size"}


def upgrade() -> None:
    if op.get_bind().dialect.name != "sqlite":
        return
    for table, key in KEYS.items():
        op.execute(
            f"CREATE TRIGGER {table}_refuse_replace BEFORE INSERT ON {table} "  # noqa: S608  # names of ours
            f"WHEN EXISTS (SELECT 1 FROM {table} WHERE {key} = NEW.{key}) "
            f"BEGIN SELECT RAISE(ABORT, '{table} only grow'); END"
        )


def downgrade() -> None:
    raise NotImplementedError("a record is not taken back")
