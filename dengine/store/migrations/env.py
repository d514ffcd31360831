"""What Alembic runs: migrations on the connection that it is given, within the transaction that is under way there."""

from __future__ import annotations

from alembic import context

context.configure(connection=context.config.attributes["connection"], version_table="dengine_migration")
with context.begin_transaction():
    context.run_migrations()
