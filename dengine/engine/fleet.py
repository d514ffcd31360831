"""`Peers`: reads from the store what the other cells of a product have learned, labels and the
newest version of the model, and takes it over: labels become references, a newer version is put in
force. `learner.Learner` calls it between two cycles, never within `decide`.

The cells of a product share one store. A cell whose connection is lost goes on with what it has.
`Learner._take_in_news` shows the order of the steps.
"""

from __future__ import annotations

import numpy as np

from ..errors import StoreError, log
from ..store.outbox import Outbox
from ..store.records import ModelVersion, ProductNews, without_rule
from .guard import NOT_READY, guarded
from .labels import ProductLabels
from .live_model import LiveModel
from .resume import add_labels_since, newest_reference, restore_model
from .trainer import Clock, TrainedOn, TrainingWindow

NEWS_SECONDS = 1.0  # between two questions for news
MOST = 200  # labels taken in at once: each is embedded, some tenths of a millisecond
ROUNDS = 5  # of them before a retrain: after a long absence it need not know all


class Peers:
    """The other cells of a product, as the store knows them.

    Their news are the labels, versions and corrections that they stored.

    Parameters
    ----------
    outbox : Outbox
    live : LiveModel
        Gives way to a peer's newer version.
    window : TrainingWindow
    labels : ProductLabels
        Takes the peers' labels.
    clock : callable
        Seconds, of any origin.

    Attributes
    ----------
    labels : ProductLabels
    is_lost : bool
        The last request for news failed.
    """

    def __init__(
        self,
        outbox: Outbox,
        live: LiveModel,
        window: TrainingWindow,
        labels: ProductLabels,
        clock: Clock,
    ) -> None:
        self._outbox = outbox
        self._live = live
        self._window = window
        self.labels = labels
        self._clock = clock
        self.is_lost = False
        self._asked = -np.inf  # when news was asked for, by the clock
        self._refused = 0  # a version that could not be taken over

    def resume(self) -> None:
        """Count the time to the next request for news from now, because the store was just read."""
        self._asked = self._clock()

    @property
    def is_news_due(self) -> bool:
        """Whether news was not asked for in the last `NEWS_SECONDS`."""
        return self._clock() - self._asked >= NEWS_SECONDS

    def fetch_news(self) -> tuple[ProductNews, bool]:
        """Ask the store for the news of the product: labels, a version and corrections.

        If there is a new version or label, the store is checked against its ledger, which may set
        the outbox's `integrity_error`.

        Returns
        -------
        news : ProductNews
            It holds at most `MOST` labels, those that follow the newest label of the training
            window; labels of this cell are among them.
        has_newer_version : bool
            Whether the news names a newer version than the one in force. A version that could not
            be taken over before does not count.

        Raises
        ------
        StoreError
            If the store gives no answer in time.
        """
        store = self._outbox.store
        newest = self._window.newest_seq
        news = self._outbox.call_store(lambda: store.labels.news_since(newest, MOST))
        has_newer_version = news.version > max(self._live.version, self._refused)
        if has_newer_version or len(news.labelled.seq):
            self._outbox.call_store(lambda: self._outbox.check_integrity(since=newest))
        return news, has_newer_version

    def note_loss(self, error: StoreError) -> None:
        """Note that a request for news failed: set `is_lost`, and ask again after `NEWS_SECONDS`.

        News is what the other cells of the product stored. Only the first of several losses is
        logged.
        """
        if not self.is_lost:
            product = self._outbox.store.product
            log.warning(
                "news of product %s cannot be had; the cell goes on without: %s", product, error
            )
        self.is_lost = True
        self._asked = self._clock()

    def take_in(self, news: ProductNews) -> None:
        """Add labels that the product's cells stored to the training window, in their order.

        They count for the next retrain. A label of another cell becomes a reference of the model in
        force, unless it is one already.
        """
        labelled = news.labelled
        rows = zip(labelled.traces, labelled.labels, labelled.hashes, labelled.seq, strict=True)
        for trace, label, hash_, seq in rows:
            self.labels.admit(trace, int(label), int(hash_), int(seq))

    def note_taken(self, n_labels: int) -> None:
        """Note that news came, with this number of labels: clear `is_lost`.

        If `is_lost` was set, the return of the news is logged. The next request is due after
        `NEWS_SECONDS`, or at once if as many labels came as one request gives at most.
        """
        if self.is_lost:
            log.warning("news of product %s comes again", self._outbox.store.product)
        self.is_lost = False
        self._asked = self._clock() if n_labels < MOST else -np.inf

    def take_over(self, version: ModelVersion) -> None:
        """Put a version that another cell of the product trained in force, with the labels since.

        It gets this cell's rule as it is: nothing is rebuilt, and the peer's rule is ignored. If
        the version cannot be restored, that is logged, and the present version stays in force; it
        is tried again with later news only if the store was the reason. Nothing is raised.
        """
        store = self._outbox.store
        trained_on = TrainedOn.from_state(version.state)
        try:
            model = restore_model(self._outbox, self._live.template, without_rule(version.state))
            if model is None:
                raise StoreError("a trace that it was fitted on has changed; see `dengine verify`.")
            add_labels_since(model, store, version, self._window)
        except Exception as error:  # no exception inside a model reaches the cell
            log.exception(
                "version %d of product %s cannot be taken over", version.version, store.product
            )
            if not isinstance(error, StoreError):
                self._refused = version.version
            return
        guarded(NOT_READY, model.prepare, self._live.newest)
        self.labels.take_over(model, newest_reference(version), trained_on.counts_from)
        self._live.swap_in(model, version.version, trained_on)
