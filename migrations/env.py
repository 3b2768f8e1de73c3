"""Alembic's environment: runs revisions on the connection that `app.audit.migrate` hands over, inside its
transaction."""

from __future__ import annotations

from alembic import context

from app.audit.tables import metadata

connection = context.config.attributes["connection"]
context.configure(connection=connection, target_metadata=metadata)
context.run_migrations()
