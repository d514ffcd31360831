"""Random histories of cells, driven through the public interface of `DataEngine`.

    >>> with History(CASES["pooled, audits"], seed=0, folder=Path("out")) as history:
    ...     history.play()

`draw_steps` turns a seed into a list of steps: parts, late reports, corrections, forgotten labels,
rollbacks, releases, retrains, restarts, killed processes and looks at the status. `History` plays
them on real SQLite stores with a clock that counts calls, so that each row of the store says after
which call it came. It keeps a `Diary` of what it did. `recount` computes from store and diary what
must have happened.
"""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dengine import Action, DataEngine, Decision, Policy, Recipe, SqlStore
from dengine.errors import ReportError

from .directions import Directions

SAMPLES = 12
N_REPEATED = 8  # parts that come again; fewer than 20, so that a part has one vote
WAIT = 60.0  # seconds that a store waits for a busy disk
# How often each step comes after a part.
OFTEN = {
    "late": 0.25,
    "again": 0.03,
    "correct": 0.04,
    "forget": 0.02,
    "bring back": 0.015,
    "roll back": 0.02,
    "release": 0.02,
    "retrain": 0.015,
    "restart": 0.015,
    "kill": 0.01,
    "look": 0.015,
}


@dataclass(frozen=True)
class Case:
    """One kind of histories.

    Parameters
    ----------
    policy : Policy
    n_cells : int, default 1
        Cells that share one product.
    folds : int, default 5
    n_parts : int, default 70
        Of all cells together.
    """

    policy: Policy
    n_cells: int = 1
    folds: int = 5
    n_parts: int = 70


LOOSE = {"alpha": 0.3, "lower_bound": 0.75, "label_within": 15}
PRICES = (5.0, 15.0, 15.0)
CASES = {
    "local": Case(Policy(**LOOSE)),
    "local, all stops": Case(Policy(stops="all", **LOOSE)),
    "pooled": Case(Policy(guarantee="pooled", stops="all", **LOOSE)),
    "pooled, audits": Case(Policy(guarantee="pooled", audit_rate=0.3, **LOOSE), folds=2),
    "cost": Case(Policy(guarantee="cost", stops="all", prices=PRICES, **LOOSE), folds=2),
    "cost, audits": Case(Policy(guarantee="cost", audit_rate=0.3, prices=PRICES, **LOOSE)),
    "two cells, pooled": Case(Policy(guarantee="pooled", stops="all", **LOOSE), n_cells=2),
    "three cells, cost, audits": Case(
        Policy(guarantee="cost", audit_rate=0.3, prices=PRICES, **LOOSE), n_cells=3
    ),
}


@dataclass(frozen=True)
class Step:
    """One step of a history.

    Attributes
    ----------
    kind : str
        "part", or a name in `OFTEN`.
    cell : int
    u : tuple of 4 floats
        Uniform random numbers, by which the step chooses.
    trace : array of float32, shape (SAMPLES,)
        Of a part.
    part : str or None
        Number of a part.
    good : bool
        The truth of a part.
    """

    kind: str
    cell: int
    u: tuple[float, ...]
    trace: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    part: str | None = None
    good: bool = True


def draw_steps(case: Case, seed: int) -> list[Step]:
    """Return the steps of a history.

    Good parts rise and bad ones fall. In a stretch in the second half parts that look good are
    mostly bad, so that safe modes begin. One part in eight comes again, under its number or as the
    very same trace, and one in forty has a constant trace.
    """
    rng = np.random.default_rng([seed, case.n_cells, case.folds])
    ramp = np.linspace(-1.0, 1.0, SAMPLES)
    begin = int(rng.integers(case.n_parts // 2, case.n_parts - 10))
    spoiled = range(begin, begin + int(rng.integers(10, 35)))
    steps: list[Step] = []
    repeated: list[Step] = []
    for i in range(case.n_parts):
        good = bool(rng.random() < 0.75)
        trace = (20.0 + (3.0 if good else -3.0) * ramp + rng.normal(0.0, 1.2, SAMPLES)).astype("f4")
        if rng.random() < 0.06 or (i in spoiled and rng.random() < 0.7):
            good = not good
        part = str(i) if rng.random() < 0.5 else None
        cell = int(rng.integers(case.n_cells))
        u = tuple(rng.random(4).tolist())
        step = Step("part", cell, u, trace, part, good)
        if rng.random() < 0.025:
            step = Step("part", cell, u, np.full(SAMPLES, 7.0, np.float32), part, good)
        elif repeated and rng.random() < 0.125:
            earlier = repeated[int(rng.integers(len(repeated)))]
            again = earlier.trace
            if earlier.part is not None:  # the very same trace has one fold and one vote without
                again = (again + rng.normal(0.0, 0.1, SAMPLES)).astype("f4")
            step = Step("part", cell, u, again, earlier.part, earlier.good)
        elif len(repeated) < N_REPEATED:
            repeated.append(step)
        steps.append(step)
        for kind, often in OFTEN.items():
            if rng.random() < often:
                cell = int(rng.integers(case.n_cells))
                steps.append(Step(kind, cell, tuple(rng.random(4).tolist())))
    return steps


@dataclass
class Diary:
    """What a history did, by the clock of the stores.

    Attributes
    ----------
    reports : dict of (int, str) to (float, bool)
        Time and label of each report that was taken, by cell and decision.
    corrections : list of (float, int, str, bool or None)
        Time, cell, decision and new label.
    restarts : list of (float, int)
        When a cell was closed, or killed, and opened again.
    counts : dict of str to int
        How often each step did something.
    """

    reports: dict[tuple[int, str], tuple[float, bool]] = field(default_factory=dict)
    corrections: list[tuple[float, int, str, bool | None]] = field(default_factory=list)
    restarts: list[tuple[float, int]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)


class History:
    """Plays the steps of a seed.

    Parameters
    ----------
    case : Case
    seed : int
    folder : Path
        For the store, `engine.db`; there must be none.
    on_look : callable, optional
        Called with the history and the number of a cell at each look, after each restart, and at
        the end.

    Attributes
    ----------
    diary : Diary
    """

    def __init__(
        self,
        case: Case,
        seed: int,
        folder: Path,
        on_look: Callable[["History", int], object] | None = None,
    ) -> None:
        self.case = case
        self.seed = seed
        self.path = folder / "engine.db"
        self.diary = Diary()
        self.now = 0.0
        self._on_look = on_look
        self._owed: list[tuple[int, str, bool]] = []  # reports to come
        self._last: list[str | None] = [None] * case.n_cells  # decision of each cell
        recipe = Recipe(
            Directions(case.folds), policy=case.policy, novelty=0.0, folds=case.folds, radius=0.4
        )
        self.engines = [
            DataEngine(
                recipe=recipe,
                store=self._store(cell),
                seed=seed,
                replaying=True,
                clock=count(2.0, 2.0).__next__,
            )
            for cell in range(case.n_cells)
        ]

    def __enter__(self) -> "History":
        return self

    def __exit__(self, *_: object) -> None:
        for engine in self.engines:
            engine.close()

    def _store(self, cell: int) -> SqlStore:
        product = "gear" if self.case.n_cells > 1 else None
        return SqlStore(
            self.path,
            f"cell {cell}",
            clock=lambda: self.now,
            product=product,
            wait=WAIT,
            keep_versions=None,
        )

    @contextlib.contextmanager
    def _call(self, cell: int, kind: str) -> Iterator[DataEngine]:
        """Count a call of an engine; cells of a product first hear of one another."""
        engine = self.engines[cell]
        self.now += 1.0
        if self.case.n_cells > 1:
            engine.poll()
            self.now += 1.0
        yield engine
        if self.case.n_cells > 1:
            engine.flush()
        self.diary.counts[kind] = self.diary.counts.get(kind, 0) + 1

    def play(self) -> None:
        """Play all steps."""
        steps: dict[str, Callable[[Step], None]] = {
            "part": self._decide,
            "late": self._report_late,
            "again": self._report_again,
            "correct": self._correct,
            "forget": self._forget,
            "bring back": self._bring_back,
            "roll back": self._roll_back,
            "release": self._release,
            "retrain": self._retrain,
            "restart": self._restart,
            "kill": self._kill,
            "look": self._look,
        }
        for step in draw_steps(self.case, self.seed):
            steps[step.kind](step)
        for cell in range(self.case.n_cells):
            self._look(Step("look", cell, ()))

    def _decide(self, step: Step) -> None:
        """One part: its outcome is reported now, later or never."""
        with self._call(step.cell, "decisions") as engine:
            decision = engine.decide(step.trace, part=step.part)
        self._last[step.cell] = decision.id
        when = self._when(decision, step)
        if when == "now":
            self._report(step.cell, decision.id, step.good)
        elif when == "late":
            self._owed.append((step.cell, decision.id, step.good))

    def _when(self, decision: Decision, step: Step) -> str:
        """Return when a part's outcome is reported: "now", "late" or "never"."""
        u = step.u[0]
        knows_all = self.case.policy.stops == "all"
        if decision.action is Action.VERIFY:
            return "now" if u < 0.8 else "late" if u < 0.98 else "never"
        if decision.action is Action.REJECT:
            return "late" if u < 0.3 else "never"
        if step.good:  # the next decision confirms a part that nobody reported
            return "now" if u < 0.15 else "never" if knows_all or u < 0.9 else "late"
        if knows_all:
            return "now" if u < 0.5 else "late"
        return "now" if u < 0.4 else "late" if u < 0.7 else "never"

    def _report(self, cell: int, id_: str, good: bool, kind: str = "reports") -> None:
        with self._call(cell, kind) as engine:
            self.diary.reports[cell, id_] = self.now, good
            engine.report(id_, good)

    def _report_late(self, step: Step) -> None:
        if self._owed:
            cell, id_, good = self._owed.pop(int(step.u[0] * len(self._owed)))
            self._report(cell, id_, good, "late reports")
            # Until the store has the label of a check that was overdue, its absence counts as well.
            self.engines[cell].flush()

    def _report_again(self, step: Step) -> None:
        """A second report of the same label is refused."""
        labelled = [id_ for cell, id_ in self.diary.reports if cell == step.cell]
        if labelled:
            id_ = labelled[int(step.u[0] * len(labelled))]
            with self._call(step.cell, "second reports") as engine, pytest.raises(ReportError):
                engine.report(id_, self.diary.reports[step.cell, id_][1])

    def _labelled(self, step: Step, is_forgotten: bool = False) -> str | None:
        """Return a decision that has a label, or of which the label was forgotten, or None."""
        forgotten: dict[tuple[int, str], bool] = {}
        for _, cell, id_, success in self.diary.corrections:
            forgotten[cell, id_] = success is None
        ids = [
            id_
            for cell, id_ in self.diary.reports
            if cell == step.cell and forgotten.get((cell, id_), False) == is_forgotten
        ]
        return ids[int(step.u[0] * len(ids))] if ids else None

    def _correct(self, step: Step) -> None:
        id_ = self._labelled(step)
        if id_ is not None:
            with self._call(step.cell, "corrections") as engine:
                self._note(engine.correct(id_, step.u[1] < 0.5), step.cell, id_, step.u[1] < 0.5)

    def _note(self, changed: Any, cell: int, id_: str, success: bool | None) -> None:
        if changed.event is not None:
            self.diary.corrections.append((self.now, cell, id_, success))

    def _forget(self, step: Step) -> None:
        id_ = self._labelled(step)
        if id_ is not None:
            with self._call(step.cell, "forgotten") as engine:
                self._note(engine.forget(id_), step.cell, id_, None)

    def _bring_back(self, step: Step) -> None:
        id_ = self._labelled(step, is_forgotten=True)
        if id_ is not None:
            with self._call(step.cell, "brought back") as engine:
                self._note(engine.correct(id_, step.u[1] < 0.7), step.cell, id_, step.u[1] < 0.7)

    def _roll_back(self, step: Step) -> None:
        with self._call(step.cell, "rollbacks") as engine:
            if engine.version > 1:
                engine.rollback(1 + int(step.u[0] * engine.version))

    def _release(self, step: Step) -> None:
        with self._call(step.cell, "releases") as engine:
            engine.release()

    def _retrain(self, step: Step) -> None:
        with self._call(step.cell, "retrains by hand") as engine:
            engine.retrain()

    def _restart(self, step: Step) -> None:
        """Close a cell and open it again: it must be as it was."""
        with self._call(step.cell, "restarts") as engine:
            engine.flush()
            before = self._state(engine)
            engine.close()
            self._open(step.cell)
            after = self._state(self.engines[step.cell])
            assert after == before, f"a restart changed {before} to {after}"
        self._look(step)

    def _kill(self, step: Step) -> None:
        """Open a cell again without closing its engine, after its store wrote all that waited.

        `tests.slow.faults` ends processes by SIGKILL.
        """
        with self._call(step.cell, "killed") as engine:
            engine.flush()
            engine.store.close()
            self._open(step.cell)

    def _open(self, cell: int) -> None:
        self.engines[cell] = DataEngine.open(
            self._store(cell),
            reducer=Directions(self.case.folds),
            replaying=True,
            clock=count(2.0, 2.0).__next__,
        )
        self.diary.restarts.append((self.now, cell))

    def _state(self, engine: DataEngine) -> Any:
        """Return what an engine has learned: version, rule, and what it says of some traces."""
        model = engine.model
        rule = {} if model is None else model.rule.state_dict()
        traces = np.stack([step.trace for step in self._probes()])
        return (
            engine.version,
            engine.safe_mode,
            engine.state.new_labels if self.case.n_cells == 1 else None,
            {name: value.tolist() for name, value in rule.items()},
            [] if model is None else model.predict_many(traces),
        )

    def _probes(self) -> list[Step]:
        steps = draw_steps(self.case, self.seed)[:40]
        return [step for step in steps if step.kind == "part" and step.trace.std() > 0.0][:6]

    def _look(self, step: Step) -> None:
        with self._call(step.cell, "looks"):
            if self._on_look is not None:
                self._on_look(self, step.cell)
