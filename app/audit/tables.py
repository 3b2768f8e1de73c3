"""The tables of the record and of the runtime's state, in SQL that SQLite and PostgreSQL both speak.

What only one of them speaks stands in mappings by dialect, or in the migrations.
`events` and `checkpoints` are append-only. The others are mutable state that the runtime needs after a restart; every
change of theirs rides in the transaction of the events that caused it. Times are RFC 3339 texts of one width, so that
they compare as text.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sqlalchemy import BigInteger, Column, Index, Integer, LargeBinary, MetaData, Table, Text

if TYPE_CHECKING:
    from collections.abc import Mapping

metadata = MetaData()

# SQLite counts rows by themselves only in a column of type INTEGER; PostgreSQL needs 64 bits said.
Counter = BigInteger().with_variant(Integer(), "sqlite")

events = Table(
    "events",
    metadata,
    Column("seq", Counter, primary_key=True, autoincrement=False),
    Column("at", Text, nullable=False),
    Column("kind", Text, nullable=False),
    Column("invocation", Text, nullable=True),
    Column("actor", Text, nullable=False),
    Column("body", LargeBinary, nullable=False),
    Index("events_by_invocation", "invocation", "seq"),
    Index("events_by_kind", "kind", "seq"),
    Index("events_by_actor", "actor", "seq"),
    Index("events_by_at", "at"),
)

checkpoints = Table(
    "checkpoints",
    metadata,
    Column("size", Counter, primary_key=True, autoincrement=False),
    Column("first", Counter, nullable=False),  # the first event this batch added
    Column("note", Text, nullable=False),  # the signed tree head
    Column("frontier", LargeBinary, nullable=False),  # the tree's right edge, so that opening need not read every event
    Column("leaves", LargeBinary, nullable=False),  # the batch's leaf hashes: they name the one event that was altered
)

invocations = Table(
    "invocations",
    metadata,
    Column("id", Text, primary_key=True),
    Column("created_seq", Counter, nullable=False),
    Column("status", Text, nullable=False),
    Column("capability", Text, nullable=False),
    Column("agent", Text, nullable=False),
    Column("cell", Text, nullable=True),
    Column("profile", Text, nullable=False),
    Column("document", LargeBinary, nullable=False),
    Column("created_at", Text, nullable=False),
    Column("updated_at", Text, nullable=False),
    Index("invocations_by_age", "created_seq", "id"),
    Index("invocations_by_status", "status", "created_seq", "id"),
    Index("invocations_by_capability", "capability", "created_seq", "id"),
    Index("invocations_by_agent", "agent", "created_seq", "id"),
    Index("invocations_by_cell", "cell", "created_seq", "id"),
)

escalations = Table(
    "escalations",
    metadata,
    Column("id", Text, primary_key=True),
    Column("created_seq", Counter, nullable=False),
    Column("invocation", Text, nullable=False),
    Column("status", Text, nullable=False),
    Column("expires_at", Text, nullable=True),
    Column("document", LargeBinary, nullable=False),
    Column("created_at", Text, nullable=False),
    Column("updated_at", Text, nullable=False),
    Index("escalations_by_age", "created_seq", "id"),
    Index("escalations_by_status", "status", "created_seq", "id"),
    Index("escalations_by_invocation", "invocation", "created_seq", "id"),
)

grants = Table(
    "grants",
    metadata,
    Column("id", Text, primary_key=True),
    Column("created_seq", Counter, nullable=False),
    Column("cell", Text, nullable=False),
    Column("status", Text, nullable=False),
    Column("document", LargeBinary, nullable=False),
    Column("created_at", Text, nullable=False),
    Column("updated_at", Text, nullable=False),
    Index("grants_by_age", "created_seq", "id"),
    Index("grants_by_status", "status", "created_seq", "id"),
    Index("grants_by_cell", "cell", "created_seq", "id"),
)

reviews = Table(
    "reviews",
    metadata,
    Column("id", Text, primary_key=True),
    Column("created_seq", Counter, nullable=False),
    Column("invocation", Text, nullable=False),
    Column("status", Text, nullable=False),
    Column("document", LargeBinary, nullable=False),
    Column("created_at", Text, nullable=False),
    Column("updated_at", Text, nullable=False),
    Index("reviews_by_age", "created_seq", "id"),
    Index("reviews_by_status", "status", "created_seq", "id"),
    Index("reviews_by_invocation", "invocation", "created_seq", "id"),
)

policies = Table(
    "policies",
    metadata,
    Column("id", Text, primary_key=True),  # the digest of its files
    Column("created_seq", Counter, nullable=False),
    Column("status", Text, nullable=False),
    Column("document", LargeBinary, nullable=False),
    Column("created_at", Text, nullable=False),
    Column("updated_at", Text, nullable=False),
    Index("policies_by_age", "created_seq", "id"),
    Index("policies_by_status", "status", "created_seq", "id"),
)

policy_files = Table(
    "policy_files",
    metadata,
    Column("digest", Text, primary_key=True),
    Column("files", LargeBinary, nullable=False),  # JSON, path → text: what the digest is over
    Column("created_at", Text, nullable=False),
)

idempotency = Table(
    "idempotency",
    metadata,
    Column("agent", Text, primary_key=True),
    Column("key", Text, primary_key=True),
    Column("request_digest", Text, nullable=False),
    Column("invocation", Text, nullable=True),
    Column("status", Text, nullable=False),
    Column("created_at", Text, nullable=False),
)

permits_used = Table(
    "permits_used",
    metadata,
    Column("permit", Text, primary_key=True),
    Column("invocation", Text, nullable=False),
    Column("used_at", Text, nullable=False),
)

cell_progress = Table(
    "cell_progress",
    metadata,
    Column("cell", Text, primary_key=True),
    Column("up_seq", Counter, nullable=False),  # the last report of the cell's journal that the log holds
    Column("journal", Text, nullable=False),  # which journal that number counts in
    Column("updated_at", Text, nullable=False),
)

settings = Table(
    "settings",
    metadata,
    Column("name", Text, primary_key=True),  # for instance `profile/workcell-1`, `estop/workcell-1`
    Column("value", LargeBinary, nullable=False),
    Column("updated_at", Text, nullable=False),
)

probes = Table(
    "probes",
    metadata,
    Column("id", Counter, primary_key=True, autoincrement=False),
    Column("at", Text, nullable=False),
    Column("filler", LargeBinary, nullable=False),  # a probe must need room on the disk, or it proves nothing
)

# Tables a `RowWrite` may name; and the columns the store fills in on insertion and never changes.
STATE: Mapping[str, Table] = {
    table.name: table
    for table in (
        invocations,
        escalations,
        grants,
        reviews,
        policies,
        policy_files,
        idempotency,
        permits_used,
        cell_progress,
        settings,
        probes,
    )
}
STORE_GIVEN = "created_seq"
KEPT_ON_REPLACE = frozenset({STORE_GIVEN, "created_at"})

# What a connection of each dialect is told at its start. FULL: a commit is on the disk before it is acknowledged.
# temp_store: what a statement of many rows may have to undo is kept in memory, not in a file.
# recursive_triggers: a REPLACE deletes too, and is refused like any deletion (other connections: revision 0002).
ON_CONNECT: Mapping[str, tuple[str, ...]] = {
    "sqlite": (
        "PRAGMA journal_mode=WAL",
        "PRAGMA synchronous=FULL",
        "PRAGMA wal_autocheckpoint=1000",
        "PRAGMA recursive_triggers=ON",
        "PRAGMA busy_timeout=100",
        "PRAGMA temp_store=MEMORY",
    ),
    "postgresql": ("SET synchronous_commit = on",),
}
BEGIN_WRITE: Mapping[str, str] = {"sqlite": "BEGIN IMMEDIATE", "postgresql": "BEGIN"}
