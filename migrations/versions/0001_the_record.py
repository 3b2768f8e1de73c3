"""The record: events and checkpoints that only grow, and the runtime's state beside them.

A revision stays as it was written; `app.audit.tables` is what all revisions together must come to, and a test compares
them.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

APPEND_ONLY = ("events", "checkpoints")

COUNTER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def text(name: str, *, nullable: bool = False, key: bool = False) -> sa.Column:
    return sa.Column(name, sa.Text, nullable=nullable, primary_key=key)


def counter(name: str, *, key: bool = False) -> sa.Column:
    return sa.Column(name, COUNTER, nullable=False, primary_key=key, autoincrement=False)


def data(name: str) -> sa.Column:
    return sa.Column(name, sa.LargeBinary, nullable=False)


def upgrade() -> None:
    op.create_table(
        "events",
        counter("seq", key=True),
        text("at"),
        text("kind"),
        text("invocation", nullable=True),
        text("actor"),
        data("body"),
    )
    op.create_index("events_by_invocation", "events", ["invocation", "seq"])
    op.create_index("events_by_kind", "events", ["kind", "seq"])
    op.create_index("events_by_actor", "events", ["actor", "seq"])
    op.create_index("events_by_at", "events", ["at"])
    op.create_table(
        "checkpoints", counter("size", key=True), counter("first"), text("note"), data("frontier"), data("leaves")
    )
    op.create_table(
        "invocations",
        text("id", key=True),
        counter("created_seq"),
        text("status"),
        text("capability"),
        text("agent"),
        text("cell", nullable=True),
        text("profile"),
        data("document"),
        text("created_at"),
        text("updated_at"),
    )
    op.create_index("invocations_by_age", "invocations", ["created_seq", "id"])
    for column in ("status", "capability", "agent", "cell"):
        op.create_index(f"invocations_by_{column}", "invocations", [column, "created_seq", "id"])
    op.create_table(
        "escalations",
        text("id", key=True),
        counter("created_seq"),
        text("invocation"),
        text("status"),
        text("expires_at", nullable=True),
        data("document"),
        text("created_at"),
        text("updated_at"),
    )
    op.create_index("escalations_by_age", "escalations", ["created_seq", "id"])
    for column in ("status", "invocation"):
        op.create_index(f"escalations_by_{column}", "escalations", [column, "created_seq", "id"])
    op.create_table(
        "idempotency",
        text("agent", key=True),
        text("key", key=True),
        text("request_digest"),
        text("invocation", nullable=True),
        text("status"),
        text("created_at"),
    )
    op.create_table("permits_used", text("permit", key=True), text("invocation"), text("used_at"))
    op.create_table(
        "cell_progress",
        text("cell", key=True),
        counter("up_seq"),
        text("journal"),
        text("updated_at"),
    )
    op.create_table("settings", text("name", key=True), data("value"), text("updated_at"))
    op.create_table("probes", counter("id", key=True), text("at"), data("filler"))
    refuse_changes(op.get_bind().dialect.name)


def refuse_changes(dialect: str) -> None:
    """Triggers speak a language of their own in every database."""
    match dialect:
        case "sqlite":
            for table in APPEND_ONLY:
                for verb in ("UPDATE", "DELETE"):
                    op.execute(
                        f"CREATE TRIGGER {table}_refuse_{verb.lower()} BEFORE {verb} ON {table} "
                        f"BEGIN SELECT RAISE(ABORT, '{table} only grow'); END"
                    )
        case "postgresql":
            op.execute(
                "CREATE FUNCTION refuse_change() RETURNS trigger LANGUAGE plpgsql AS "
                "$$ BEGIN RAISE EXCEPTION '% only grow', TG_TABLE_NAME; END $$"
            )
            for table in APPEND_ONLY:
                op.execute(
                    f"CREATE TRIGGER {table}_refuse_change BEFORE UPDATE OR DELETE OR TRUNCATE ON {table} "
                    "FOR EACH STATEMENT EXECUTE FUNCTION refuse_change()"
                )
        case _:
            raise NotImplementedError(f"no triggers for `{dialect}`: valid are sqlite, postgresql")


def downgrade() -> None:
    raise NotImplementedError("a record is not taken back")
