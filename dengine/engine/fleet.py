"""`Peers`: looks in the store for what the other cells of a product have made, a newer version of
the model or corrections, puts such a version in force, and reads the labels of all cells for a
training. `learner.Learner` calls it between two cycles, never within `decide`.

The cells of a product share one store. The labels of peers come with the versions: a cell counts
the labels that the version in force had when it was stored, and the cell's own labels since then. A
cell whose connection is lost goes on with what it has. `Learner._hear_of_peers` shows the order of
the steps.
"""

from __future__ import annotations

import numpy as np

from ..errors import StoreError, VersionError, log
from ..store.records import Clock
from .guard import NOT_READY, guarded
from .live_model import LiveModel
from .resume import ChangedTracesError, add_labels_since, restore_model
from .trainer import TrainedOn

LOOK_SECONDS = 1.0  # between two looks for a newer version


class Peers:
    """The other robot cells of a product, as the store knows them.

    Parameters
    ----------
    live : LiveModel
        Gives way to a peer's newer version; its window takes the labels of all cells.
    clock : callable
        Seconds, of any origin.
    """

    def __init__(self, live: LiveModel, clock: Clock) -> None:
        self._outbox = live.outbox
        self._live = live
        self._window = live.window
        self._clock = clock
        self._looked = -np.inf  # when the store was last asked, by the clock
        self._is_lost = False  # the store gave no answer when it was last asked
        self._refused = 0  # a version that could not be put in force

    @property
    def is_look_due(self) -> bool:
        """Whether the store was not asked in the last `LOOK_SECONDS`."""
        return self._clock() - self._looked >= LOOK_SECONDS

    def look(self) -> tuple[int, int]:
        """Return the numbers of the product's newest version and newest correction of a label.

        A product is several robot cells that share labels and versions. The first number is 0 if
        there is no version that is newer than the one in force here; a version that could not be
        put in force does not count. Raises StoreError if the store fails or gives no answer in
        time. Also after an error, the next look is due LOOK_SECONDS (1 s) after this one began
        (`is_look_due`).
        """
        self._looked = self._clock()
        store = self._outbox.store
        version, correction = self._outbox.call_store(
            lambda: (store.versions.newest_number(), store.corrections.newest_number())
        )
        return version if version > max(self._live.version, self._refused) else 0, correction

    def note_answer(self, error: StoreError | None) -> None:
        """Log that the store gave no answer, or that it answers again.

        `error` is that of the last attempt to ask the store for what the product's other cells
        (robot cells that share labels and versions) stored; None: it answered. Only the first of
        several failures is logged, and only the first answer after a failure.
        """
        product = self._outbox.store.product
        if error is None and self._is_lost:
            log.warning("news of product %s comes again", product)
        elif error is not None and not self._is_lost:
            log.warning(
                "news of product %s cannot be had; the cell goes on without: %s", product, error
            )
        self._is_lost = error is not None

    def read_labels(self) -> None:
        """Add all cells' labels that came after its newest label to the training window.

        The training window holds the newest labelled traces, and the cells are those of the product
        (robot cells that share labels and versions). If more labels came than the window holds,
        only the newest are read. They are read with the corrections (later changes of labels) up to
        `LiveModel.corrected_to`, the newest that the model has; a full window loses its oldest
        label. Labels of traces with a fault, like a NaN, and forgotten (withdrawn) labels are left
        out, and so are labels of damaged traces (missing, or not as they were stored), for which an
        event (a row in the store's log) is recorded. There is no time limit. Raises StoreError, and
        adds nothing, if the store cannot be read, the traces have different shapes, or a label is
        neither 0 nor 1.
        """
        labelled = self._outbox.store.labels.with_traces(
            self._window.capacity,
            first=self._window.newest_seq + 1,
            corrected_to=self._live.corrected_to,
        )
        for seq, trace, label, hash_ in labelled.rows():
            self._window.add(trace, label, hash_, seq)

    def put_in_force(self, number: int) -> bool:
        """Put a version of another cell of the product in force, with this cell's labels.

        A product is several robot cells that share labels and versions. The version gets the
        present decision rule of this cell: nothing is rebuilt, and the other cell's rule is
        ignored. A failure to take over the rule is logged, and the version is in force all the
        same. This cell's labels since the version become its references (labelled points that new
        traces are compared with), and corrections (changes of labels) since then are applied
        (`add_labels_since`), without a time limit. A damaged trace is left out, and reported by an
        event (a row in the store's log).

        A model like umap-learn is fitted again. The labels that it is fitted on are checked against
        the ledger (the store's hash chain); a difference sets `integrity_error` of the outbox, by
        which the engine reaches its store, and every part is verified from then on. If one of the
        traces that it is fitted on is damaged or missing, if the version is damaged, not kept or of
        another model, or if the model raises an error that is no StoreError, that is logged, the
        present version stays in force, and `look` does not return this number again.

        Returns whether the version is in force now. Raises StoreError if the store cannot be read;
        `look` then returns the number again.
        """
        store = self._outbox.store
        try:
            version = self._outbox.call_store(lambda: store.versions.load(number))
            trained_on = TrainedOn.from_state(version.state)
            model = restore_model(self._outbox, self._live.template, version, trained_on)
            add_labels_since(model, store, version, self._window.capacity)
        except Exception as error:  # no exception inside a model reaches the cell
            is_of_version = isinstance(error, VersionError | ChangedTracesError)
            if isinstance(error, StoreError) and not is_of_version:
                raise
            log.exception("version %d of product %s cannot be used", number, store.product)
            self._refused = number
            return False
        guarded(NOT_READY, model.prepare, self._live.newest)
        self._live.swap_in(model, number, trained_on)
        return True
