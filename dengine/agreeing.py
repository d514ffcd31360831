"""What an engine and its traces agreed on: their contract, set once, by a user, a sister cell or the first sound trace."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .contracts import as_agreed
from .deciding import DecisionMaker
from .errors import StoreError
from .facts import EngineFacts
from .fleet import trace_of_sisters
from .records import TraceSpec

log = logging.getLogger("dengine")


class TraceAgreement(EngineFacts):
    """The part of `DataEngine` that knows the traces' contract."""

    _maker: DecisionMaker
    _settings_waiting: bool

    def agree_on(self, trace: TraceSpec, inferred: bool = False) -> TraceSpec:
        """Set the traces' contract, where none is set yet; returns the one in force. inferred : from a first trace."""
        if self.trace is None:
            trace = trace_of_sisters(self._keeper) or trace
            self._settings = replace(self._settings, trace=trace, inferred=inferred)
            self._maker.agree_on(trace)
            self._save_settings()
        return self._settings.trace or trace

    def _as_trace(self, trace: ArrayLike) -> NDArray[np.float32]:
        x = as_agreed(trace, self.trace, self._settings.inferred and self.version + self.new_labels == 0)
        if self.trace is None and (spec := self._maker.first_contract(x, trace)) is not None:
            if self.agree_on(spec, inferred=True) != spec:  # a sister's trace came first
                return as_agreed(trace, self.trace, False)
        elif self._settings_waiting:
            self._save_settings()
        return x

    def _save_settings(self) -> None:
        """Store the settings, or do it before the next decision, if the store is away."""
        try:
            self._keeper.ask(lambda: self.store.save_settings(self._settings.to_store()))
            self._settings_waiting = False
        except StoreError:
            self._settings_waiting = True
            log.exception("the settings are stored later")
