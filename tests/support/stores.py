"""Decisions, labels and reports as tests make them, and into a store, as a journal brings them."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from dengine.records import Action, Decision, Reason, RetrainReport, Source
from dengine.store import NewLabel, SqlStore, StoredDecision


def decision(
    name: str, action: Action = Action.VERIFY, reason: Reason = Reason.UNCERTAIN, version: int = 0
) -> Decision:
    return Decision(
        name, action, action, 0.2, 1.0, 1, 0, ((0.1, 0.2), (0.3, 0.4)), version, reason, False, 1.0
    )


def trace(seed: int = 0, shape: tuple[int, ...] = (2, 30)) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def label(
    name: str, success: bool = True, silent: int = 0, source: Source = Source.VERIFICATION
) -> NewLabel:
    return NewLabel(name, success, source, 0, None, silent)


def report(version: int, accepted: bool = True) -> RetrainReport:
    return RetrainReport(
        version, 0.25, 100, 60, accepted, "improved" if accepted else "the gate held"
    )


def execute(file: Path | str, *statements: str) -> None:
    """Behind a store's back."""
    with sqlite3.connect(file) as connection:
        for statement in statements:
            connection.execute(statement)


@contextmanager
def held(file: Path) -> Iterator[None]:
    """Another process holds the database, so that records wait in journals."""
    with closing(sqlite3.connect(file, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield
        other.execute("ROLLBACK")


def put_decision(
    store: SqlStore,
    made: Decision | str,
    values: np.ndarray | None = None,
    content_hash: int = 1,
    quarantined: bool = False,
) -> np.ndarray:
    """A decision, or a plain one of this name, and its trace, (C, T) or (T,); returns the trace."""
    values = np.array(trace() if values is None else values, dtype=np.float32, ndmin=2)
    made = decision(made) if isinstance(made, str) else made
    store.apply_records([StoredDecision(made, values, content_hash, quarantined, store.clock())])
    return values


def labelled(item: StoredDecision, success: bool) -> list[StoredDecision | NewLabel]:
    """A decision that was labelled when it was made."""
    text = label(item.decision.id, bool(success))
    return [item, replace(text, time=item.time, content_hash=item.content_hash, decided=item.time)]


def put_labels(store: SqlStore, *labels: NewLabel) -> list[int]:
    """Labels of decisions that are there; returns their numbers, in the order given."""
    now, taken = store.clock(), []
    for label in labels:
        stored = store.decisions.get(label.decision_id, trace=False)
        known = {"content_hash": stored.content_hash, "decided": stored.time}
        taken.append(replace(label, time=now, **known))
    numbers = dict(store.apply_records(taken))
    return [numbers[label.decision_id] for label in labels]


def put_label(
    store: SqlStore, name: str, success=True, source=Source.VERIFICATION, version=0, point=None, silent=0
) -> int:  # fmt: skip
    """One label; returns its number."""
    return put_labels(store, NewLabel(name, success, source, version, point, silent))[0]
