"""Faults that come in from outside: labels that are none, ids that are none, models and rivals that fail, damaged bytes."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np

from dengine import Action, DataEngine, Reason, export_torchscript, load_exported
from dengine.errors import DengineError, ReportError, TraceError

from .harness import RECIPE, Cell, Outcome, Place, refused, stream

NO_LABELS = (100, -1, 255, 2, "0", "1", "NG", b"\x01", None, float("nan"), float("inf"), 0.5, [True], np.array([1, 0]))
NO_IDS = (None, 7, float("nan"), "", "x" * 1_000_000, "nul\0", b"id", ("a",))


def labels(outcome: Outcome, place: Place) -> None:
    """Labels that are none."""
    cell = Cell(place, outcome)
    cell.play(60)
    for said in NO_LABELS:
        decision = cell.engine.decide(stream().X[0])
        outcome.injected += 1
        with refused(outcome, ReportError):
            cell.engine.report(decision.id, said)
        cell.engine.flush()
        outcome.must(cell.engine.store.get_decision(decision.id).success is None, f"{said!r} was stored")
    cell.play(60)
    cell.finish()


def ids(outcome: Outcome, place: Place) -> None:
    """Ids that are none, with a trace and without."""
    cell = Cell(place, outcome)
    cell.play(60)
    for said in NO_IDS:
        for trace in (None, stream().X[0]):
            outcome.injected += 1
            with refused(outcome, ReportError):
                cell.engine.report(said, False, trace=trace)
    cell.play(60)
    cell.finish()


def traces(outcome: Outcome, place: Place) -> None:
    """Traces that no sensor gives: NaN, infinite, constant, empty, of another length."""
    cell = Cell(place, outcome)
    cell.play(60)
    good = stream().X[0]
    for bad in (good * np.nan, np.full_like(good, np.inf), np.zeros_like(good)):
        outcome.injected += 1
        outcome.must(cell.engine.decide(bad).action is Action.VERIFY, "a bad trace was not verified")
    for bad in (good[:-1], np.zeros((3, len(good))), np.array([]), "trace", None):
        outcome.injected += 1
        with refused(outcome, TraceError):
            cell.engine.decide(bad)
    cell.play(60)
    cell.finish()


def first_trace(outcome: Outcome, place: Place) -> None:
    """A first trace that is bad, and one of three samples: neither is the contract."""
    engine = DataEngine(recipe=RECIPE, store=place.store())
    outcome.injected += 2
    with refused(outcome, TraceError):
        engine.decide(np.arange(3.0))
    outcome.must(engine.decide(np.full(50, np.nan)).action is Action.VERIFY, "NaN was not verified")
    outcome.must(engine.decide(stream().X[0]).reason is Reason.NO_MODEL, "a good trace did not set the contract")
    engine.close()


class _Rival:
    """A rival whose counts no database holds, or that raises."""

    def __init__(self, raises: bool) -> None:
        self.raises = raises

    def fit(self, X: Any, y: Any) -> _Rival:
        return self

    def add(self, x: Any, y: Any) -> None: ...

    def count(self, X: Any) -> Any:
        if self.raises:
            raise ValueError("a rival's own fault")
        return np.array([2**70], dtype=object), np.array([0], dtype=object)

    def predict_interval(self, X: Any) -> Any:
        return np.array([0.99]), np.array([1.0])

    def decide(self, X: Any) -> Any:
        return [Action.ACCEPT]


def rivals(outcome: Outcome, place: Place) -> None:
    """A rival that counts 2^70 successes, and one that raises."""
    for i, raises in enumerate((False, True)):
        engine = DataEngine(model=_Rival(raises), store=Place(f"{place.url}-{i}").store())
        for j in range(30):
            try:
                decision = engine.decide(stream().X[j])
                engine.report(decision.id, bool(stream().y[j]))
            except Exception as error:  # what reaches the cell is what is counted
                outcome.tell(error)
        try:
            engine.retrain()
            decision = engine.decide(stream().X[40])
            outcome.injected += 1
            outcome.must(decision.action is Action.VERIFY, "nonsense of a rival was not verified")
            engine.report(decision.id, True)
            engine.close()
        except Exception as error:
            outcome.tell(error)


def damaged_version(outcome: Outcome, place: Place) -> None:
    """The newest version's bytes changed in the store: the one before it answers."""
    cell = Cell(place, outcome)
    cell.play(200)
    cell.engine.close()
    _execute(
        place, "UPDATE model_version SET state = zeroblob(500) WHERE retrain = (SELECT max(retrain) FROM model_version)"
    )
    _goes_on(cell)


def damaged_trace(outcome: Outcome, place: Place) -> None:
    """A labelled trace's bytes changed in the store: it is left out of training."""
    cell = Cell(place, outcome)
    cell.play(120)
    cell.engine.close()
    victim = next(iter(cell.acknowledged))
    _execute(place, f"UPDATE trace SET data = zeroblob(length(data)) WHERE decision_id = '{victim}'")
    cell.acknowledged.pop(victim)
    _goes_on(cell)


def _execute(place: Place, statement: str) -> None:
    with sqlite3.connect(place.url) as connection:
        connection.execute(statement)
    connection.close()


def _goes_on(cell: Cell) -> None:
    cell.outcome.injected += 1
    try:
        cell.engine = DataEngine.open(cell.place.store())
    except DengineError as error:
        cell.outcome.tell(error)
        return
    told = [event.kind for event in cell.engine.store.events()]
    cell.outcome.must("damaged" in told, f"no event tells of it, only {told}")
    cell.play(60)
    cell.finish()


def onto_the_store(outcome: Outcome, place: Place) -> None:
    """An export onto the store itself, and onto a planted link."""
    cell = Cell(place, outcome)
    cell.play(120)
    cell.engine.flush()
    content = Path(place.url).read_bytes()
    link = Path(place.url).with_suffix(".ts")
    link.symlink_to(place.url)
    for target in (Path(place.url), link):
        outcome.injected += 1
        with refused(outcome, DengineError):
            export_torchscript(cell.engine, target, force=True)
    outcome.must(Path(place.url).read_bytes() == content, "the store was overwritten")
    cell.finish()


def damaged_export(outcome: Outcome, place: Place) -> None:
    """An exported file with one bit flipped."""
    cell = Cell(place, outcome)
    cell.play(120)
    path = export_torchscript(cell.engine, Path(place.url).with_suffix(".ts"))
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(10):
        changed = bytearray(whole)
        changed[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        path.write_bytes(changed)
        outcome.injected += 1
        with refused(outcome, DengineError):
            load_exported(path)
    cell.finish()


def second_engine(outcome: Outcome, place: Place) -> None:
    """A second engine on the cell."""
    cell = Cell(place, outcome)
    for _ in range(5):
        cell.play(25)
        outcome.injected += 1
        with refused(outcome, DengineError):
            DataEngine.open(place.store())
    cell.finish()


def torn_journal(outcome: Outcome, place: Place) -> None:
    """The journal's last record cut in the middle, as a killed process leaves it."""
    cell = Cell(place, outcome)
    cell.play(100)
    cell.engine.close()
    journal = place.store().own()
    journal.append([b"x" * 4000])
    end = journal.end
    journal.let_go()
    with journal.path.open("r+b") as file:
        file.truncate(end - 1000)
    outcome.injected += 1
    cell.engine = DataEngine.open(place.store())
    kinds = [event.kind for event in cell.engine.store.events()]
    outcome.must("journal" in kinds, "nothing tells of the dropped record")
    cell.finish()


ON_SQLITE = (
    *(labels, ids, traces, first_trace, rivals, damaged_version, damaged_trace, onto_the_store, damaged_export),
    *(second_engine, torn_journal),
)
