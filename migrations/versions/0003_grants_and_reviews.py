"""Standing grants, and finished sessions that wait for a verdict."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

COUNTER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def text(name: str, *, key: bool = False) -> sa.Column:
    return sa.Column(name, sa.Text, nullable=False, primary_key=key)


def state(name: str, about: str) -> None:
    op.create_table(
        name,
        text("id", key=True),
        sa.Column("created_seq", COUNTER, nullable=False, autoincrement=False),
        text(about),
        text("status"),
        sa.Column("document", sa.LargeBinary, nullable=False),
        text("created_at"),
        text("updated_at"),
    )
    op.create_index(f"{name}_by_age", name, ["created_seq", "id"])
    for column in ("status", about):
        op.create_index(f"{name}_by_{column}", name, [column, "created_seq", "id"])


def upgrade() -> None:
    state("grants", "cell")
    state("reviews", "invocation")


def downgrade() -> None:
    raise NotImplementedError("a record is not taken back")
