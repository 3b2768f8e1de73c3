"""Versions of policy, and the files of each by digest."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

COUNTER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def text(name: str, *, key: bool = False) -> sa.Column:
    return sa.Column(name, sa.Text, nullable=False, primary_key=key)


def upgrade() -> None:
    op.create_table(
        "policies",
        text("id", key=True),
        sa.Column("created_seq", COUNTER, nullable=False, autoincrement=False),
        text("status"),
        sa.Column("document", sa.LargeBinary, nullable=False),
        text("created_at"),
        text("updated_at"),
    )
    op.create_index("policies_by_age", "policies", ["created_seq", "id"])
    op.create_index("policies_by_status", "policies", ["status", "created_seq", "id"])
    op.create_table(
        "policy_files",
        text("digest", key=True),
        sa.Column("files", sa.LargeBinary, nullable=False),
        text("created_at"),
    )


def downgrade() -> None:
    raise NotImplementedError("a record is not taken back")
