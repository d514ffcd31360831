"""Schema 1, as dengine 0.1 and 0.2 wrote it: decisions with their traces, labels, versions, settings."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0001", None


def upgrade() -> None:
    """Create the tables."""
    op.create_table("setting", *_key("cell_id", "key"), sa.Column("value", sa.String, nullable=False))
    op.create_table(
        "decision",
        *_key("cell_id", "id"),
        sa.Column("time", sa.Double, nullable=False),
        *(sa.Column(name, sa.String, nullable=False) for name in ("action", "predicted")),
        *(sa.Column(name, sa.Double) for name in ("lower", "upper")),
        *(sa.Column(name, sa.BigInteger, nullable=False) for name in ("n_success", "n_failure")),
        sa.Column("embedding", sa.Text),
        sa.Column("model_version", sa.BigInteger, nullable=False),
        sa.Column("reason", sa.String, nullable=False),
        sa.Column("audit", sa.Boolean, nullable=False),
        sa.Column("propensity", sa.Double),
        sa.Column("content_hash", sa.BigInteger, nullable=False),
        sa.Column("quarantined", sa.Boolean, nullable=False),
    )
    op.create_table(
        "trace",
        *_key("cell_id", "decision_id"),
        *(sa.Column(name, sa.Integer, nullable=False) for name in ("channels", "samples")),
        sa.Column("data", sa.LargeBinary, nullable=False),
    )
    op.create_table(
        "label",
        *_key("cell_id", "decision_id"),
        sa.Column("seq", sa.BigInteger, nullable=False),
        sa.Column("time", sa.Double, nullable=False),
        sa.Column("success", sa.Boolean, nullable=False),
        sa.Column("source", sa.String, nullable=False),
        sa.Column("model_version", sa.BigInteger, nullable=False),
        sa.Column("point", sa.LargeBinary),
        sa.Column("content_hash", sa.BigInteger, nullable=False),
        sa.Column("quarantined", sa.Boolean, nullable=False),
        sa.UniqueConstraint("cell_id", "seq", name="label_seq"),
    )
    op.create_index("label_training", "label", ["cell_id", "quarantined", "seq"])
    op.create_table(
        "model_version",
        sa.Column("cell_id", sa.String, primary_key=True),
        sa.Column("retrain", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("version", sa.BigInteger, nullable=False),
        *(sa.Column(name, sa.Double, nullable=False) for name in ("time", "seconds")),
        *(sa.Column(name, sa.BigInteger, nullable=False) for name in ("n_traces", "n_steps")),
        sa.Column("accepted", sa.Boolean, nullable=False),
        sa.Column("reason", sa.Text, nullable=False),
        sa.Column("last_seq", sa.BigInteger, nullable=False),
        sa.Column("state", sa.LargeBinary),
    )
    op.create_index("version_accepted", "model_version", ["cell_id", "accepted", "retrain"])


def _key(*names: str) -> list[sa.Column[str]]:
    return [sa.Column(name, sa.String, primary_key=True) for name in names]
