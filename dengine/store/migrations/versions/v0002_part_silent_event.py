"""Schema 2, of dengine 0.3 to 0.5: numbers of parts, accepted parts that nothing was heard of, events."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0002", "0001"


def upgrade() -> None:
    """Add the columns and the table."""
    op.add_column("decision", sa.Column("part", sa.String))
    op.add_column("label", sa.Column("silent", sa.BigInteger, nullable=False, server_default=sa.text("0")))
    op.create_table(
        "event",
        sa.Column("cell_id", sa.String, primary_key=True),
        sa.Column("number", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("time", sa.Double, nullable=False),
        sa.Column("kind", sa.String, nullable=False),
        sa.Column("text", sa.Text, nullable=False),
    )
