"""An engine whose product other cells make too: their labels become its references, their newer versions answer here.

Labels of a product have one sequence over all its cells. An engine's window holds every label up to its newest there: one
of its own is a reference at once, and waits for the peers' before it until it enters the window. News is asked for between
two cycles, never by `decide`; a cell whose connection is lost goes on with what it has.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import StoreError
from ..model.base import EngineModel
from ..recipe import Recipe
from ..records import TraceSpec, trace_in
from ..store.base import Store
from ..store.records import ModelVersion, without_rule
from .resume import join_since, known_to, restored
from .settings import EngineSettings, must_allow
from .trainer import TrainedOn
from .versions import ModelVersions

log = logging.getLogger("dengine")
NEWS_SECONDS = 1.0  # between two questions for news
MOST = 200  # labels taken in at once: each is embedded, some tenths of a millisecond
ROUNDS = 5  # of them before a retrain: after a long absence it need not know all


def agreed(settings: EngineSettings, store: Store) -> EngineSettings:
    """An engine's settings with its product's contract of traces, where a peer has one and the engine none yet."""
    return replace(settings, trace=peers_trace(store)) if settings.trace is None else settings


def peers_trace(store: Store) -> TraceSpec | None:
    """The contract of traces that a product's cells have agreed on; None where there is none, or no product."""
    return next(filter(None, map(trace_in, store.peers_settings().values())), None)


def as_peers(asked: Mapping[str, Any], store: Store, allow_import: bool | Collection[str]) -> dict[str, Any]:
    """What a new engine is asked for; what was left open, as a peer has it if there is one, where `must_allow` lets it."""
    known = next(iter(store.peers_settings().values()), {})
    filled = dict(asked)
    if filled.get("seed") is None:
        filled["seed"] = int(known.get("seed", 0))
    chosen = any(filled.get(name) is not None for name in ("reducer", "recipe", "model"))
    if "recipe" in known and not chosen and "described" not in known:  # an object must be handed in
        filled["recipe"] = Recipe.from_toml(known["recipe"])
        must_allow(filled["recipe"], "a peer in the store", allow_import)
    return filled


class Fleet:
    """What one engine takes in of its product: a `versions.LabelCount` of all its cells' labels."""

    shared = True

    def __init__(self, store: Store, versions: ModelVersions) -> None:
        self.store, self.versions = store, versions
        self._ahead: dict[int, tuple[NDArray[np.float32], int, int]] = {}  # own labels, peers' missing
        self._since: list[tuple[int, bool]] = []  # labels since the newest retrain began: number, and whether it is own
        self._trained_to = 0  # newest label that the newest retrain knew
        self._told_to = 0  # newest own label: the rule was told of all until there
        self._holds_to = 0  # references hold every label until there, the window perhaps not yet
        self._refused = 0  # a version that could not be taken over
        self._asked = -np.inf
        self._lost = False
        self._window = versions.retrainer.window

    def resume(self) -> None:
        """The engine has gone on from the store."""
        n, seq = self.versions.new_labels, self._window.snapshot().seq
        self._since = [(int(number), False) for number in seq[len(seq) - n :]]
        self._trained_to = int(seq[-n - 1]) if len(seq) > n else 0
        self._told_to, self._asked = self._window.newest_seq, self.versions.clock()

    def state(self) -> dict[str, NDArray[Any]]:
        """What a version has to say of this cell."""
        return {"told_to": np.array(self._told_to)}

    def keep(self, trace: NDArray[np.float32], label: int, hash_: int, seq: int) -> None:
        """Take a label of this cell that was stored, and is a reference already."""
        self._ahead[seq], self._told_to = (trace, label, hash_), max(seq, self._told_to)
        if seq == self._window.newest_seq + 1:
            self._admit(trace, label, hash_, seq)

    def _admit(self, trace: NDArray[np.float32], label: int, hash_: int, seq: int) -> None:
        own = self._ahead.pop(seq, None) is not None
        self._window.add(trace, label, hash_, seq)
        if seq > self._trained_to:
            self._count([*self._since, (seq, own)])
        model = self.versions.answering
        if not own and seq > self._holds_to and model is not None:
            model.add_safely(model.place_safely(trace, hash_), label, hash_, seq)

    def _count(self, since: list[tuple[int, bool]]) -> None:
        self._since, self.versions.new_labels = since, len(since)

    def due(self, retrain_every: int) -> bool:
        """Whether a retrain is this cell's turn: the label that makes it due is its own, or nobody did it for long."""
        if self.versions.clock() - self._asked >= NEWS_SECONDS:
            self.take_in()
        if not self._turn(retrain_every):
            return False
        self._take_in_all()  # a peer's version may have come
        return self._turn(retrain_every)

    def _turn(self, retrain_every: int) -> bool:
        due, late = self._since[retrain_every - 1 : retrain_every], self._since[2 * retrain_every - 1 :]  # a peer's turn
        return any(own for _, own in (*due, *late))

    def begin(self) -> None:
        """A retrain begins: it knows as much of the product as can be had, and counting starts anew."""
        self._take_in_all()
        self.begin_counting()

    def _take_in_all(self) -> None:
        for _ in range(ROUNDS):
            if self.take_in() < MOST:
                return

    def take_in(self) -> int:
        """Take in the peers' newest version and labels, `MOST` at most; returns how many. A lost connection is none."""
        try:
            self.versions.journal_cleared()
            seq = self._window.newest_seq
            news = self.versions.outbox.ask(lambda: self.store.news_since(seq, MOST))
            newer = news.version > max(self.versions.version, self._refused)
            if newer:
                self.versions.store_waiting()  # the next model is to know of them too
            version = self.versions.outbox.ask(self.store.last_version) if newer else None
        except StoreError as error:
            if not self._lost:
                log.warning("news of product %s cannot be had; the cell goes on without: %s", self.store.product, error)
            self._lost, self._asked = True, self.versions.clock()
            return 0
        if self._lost:
            log.warning("news of product %s comes again", self.store.product)
        self._lost = False
        if version is not None:
            self._take_over(version)
        labelled = news.labelled
        for row in zip(labelled.traces, labelled.labels, labelled.hashes, labelled.seq, strict=True):
            self._admit(row[0], int(row[1]), int(row[2]), int(row[3]))
        if news.correction > self.versions.corrected_to:
            try:
                self.versions.correct(own=False)
            except StoreError as error:  # asked for again with the next news
                log.warning("corrections of product %s cannot be had yet: %s", self.store.product, error)
        n = len(labelled.seq)
        self._asked = self.versions.clock() if n < MOST else -np.inf  # more is waiting: the next cycle goes on
        return n

    def _take_over(self, version: ModelVersion) -> None:
        """Let a peer's version answer, with every label since and this cell's own rule; one that fails is left alone."""
        versions = self.versions
        trained_on = TrainedOn.from_state(version.state)
        try:
            model = restored(self.store, versions.template, without_rule(version.state))
            if model is None:
                raise StoreError("a trace that it was fitted on has changed; see `dengine verify`.")
            join_since(model, self.store, version, self._window)
        except Exception as error:  # what fails in a model is recorded, and the version before goes on answering
            log.exception("version %d of product %s cannot be taken over", version.version, self.store.product)
            self._refused = self._refused if isinstance(error, StoreError) else version.version
            return
        model.prepare_safely(versions.newest)
        self._holds_to = known_to(version)
        self._add_ahead(model, self._holds_to)
        versions.take_over(model, version.version, trained_on)
        self._trained_to = trained_on.counts_from
        self._count([each for each in self._since if each[0] > self._trained_to])

    def _add_ahead(self, model: EngineModel, last_seq: int) -> None:
        for seq, (trace, label, hash_) in self._ahead.items():
            if seq > last_seq:
                model.add_safely(model.place_safely(trace, hash_), label, hash_, seq)

    def swapped(self, model: EngineModel) -> None:
        """A version that this cell trained answers: labels of its own that wait for peers' before them are in it too."""
        self._holds_to = 0
        self._add_ahead(model, 0)

    def begin_counting(self) -> None:
        """Count the labels of the next retrain from here."""
        self._trained_to = self._window.newest_seq
        self._count([])

    def recount(self, counts_from: int) -> None:
        """The window was filled anew: what was forgotten does not count, and what counts again does."""
        own = {number for number, mine in self._since if mine}
        seq = self._window.snapshot().seq.tolist()
        self._count([(number, number in own) for number in seq if number > self._trained_to])

    def complete(self) -> None:
        """Take in all news, before a person changes something; StoreError where it cannot be had."""
        self._take_in_all()
        if self._lost or self._ahead:
            raise StoreError(f"News of product {self.store.product!r} cannot be had now; try it again.")
