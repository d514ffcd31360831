"""What an engine says of itself: its settings in force, its model, what it can certify, what an exporter takes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from .decision.certificate import Certificate, certificate_of
from .decision.policy import Policy
from .feedback import Feedback
from .keeping import Keeper
from .labels import as_id
from .model.base import Exportable
from .recipe import Recipe
from .records import TraceSpec
from .retraining import EncoderTime
from .settings import EngineSettings
from .store.base import Store
from .store.records import StoredDecision
from .versions import ModelVersions


class EngineFacts:
    """How an engine stands; nothing here changes it."""

    seed: int
    store: Store
    _settings: EngineSettings
    _keeper: Keeper
    _versions: ModelVersions
    _feedback: Feedback

    def find(self, decision_id: str) -> StoredDecision | None:
        """A decision with its trace, and with its label where it has one; None for an unknown id."""
        return self._keeper.find(as_id(decision_id))

    def know_ids(self) -> None:
        """Learn which ids are taken, so that `decide` looks no new one up in the store: quicker, where callers name them.

        It reads every id once, a second for a million of them.
        """
        self.flush()
        self._keeper.recent.know(self.store.decision_ids())

    def flush(self) -> None:
        """Return when all that is known so far is on the disk."""
        self._feedback.store_waiting()
        self._keeper.flush()

    @property
    def retraining(self) -> bool:
        """Whether a retrain is under way in the executor, or waits to be swapped in."""
        return self._versions.busy

    @property
    def swapping(self) -> bool:
        """Whether a version that an executor has trained is on its way in, a step each time that the engine is asked."""
        return self._versions.swapping

    @property
    def encoder_time(self) -> EncoderTime:
        """What the encoder's training took so far."""
        return self._versions.retrainer.encoder_time

    @property
    def recipe(self) -> Recipe:
        """Every setting as it is in force; all but the policy are fixed once the engine is made."""
        return self._settings.recipe

    @property
    def policy(self) -> Policy:
        """The user's numbers as they are in force; `set_policy` changes them."""
        return self._settings.recipe.policy

    @property
    def shadow(self) -> bool:
        """Whether every part is verified, and the model only says what it would have done; `set_shadow` changes it."""
        return self.policy.audit_rate == 1.0

    @property
    def trace(self) -> TraceSpec | None:
        """The traces' contract; None before the first sound trace."""
        return self._settings.trace

    @property
    def model(self) -> Any:
        """The model that answers, a rival as its author knows it; None before the first retrain."""
        return None if self._versions.answering is None else self._versions.answering.user_model

    @property
    def version(self) -> int:
        """Of the model that answers; 0 before the first retrain."""
        return self._versions.version

    @property
    def safe_mode(self) -> str:
        """Why everything is verified, until fresh evidence keeps the tolerance again; "" where it is not."""
        return self._feedback.safe_mode

    @property
    def store_fault(self) -> str:
        """Why the store cannot be written at present, and labels wait in its journal; "" where it can."""
        return self._keeper.fault

    def certificate(self) -> Certificate:
        """What can be said by now, at level 1 - alpha, of what was decided without a check under the policy in force."""
        self.flush()
        return certificate_of(self.store.outcomes(self._settings.policy_since), self.policy)

    @property
    def new_labels(self) -> int:
        """Labels since the last retrain began."""
        return self._versions.new_labels

    def exported(self, trace: TraceSpec | None = None) -> Exportable:
        """The decision as an exporter takes it. ExportError before the first retrain, and for a rival."""
        own, policy = self._versions.newest.exported(trace or self.trace), self.policy
        coin: dict[str, Any] = {"audit_rate": policy.audit_rate, "seed": self.seed, "stops_all": policy.stops == "all"}
        about: dict[str, Any] = {"model_version": self.version, "recipe": self.recipe.to_toml()}
        return replace(own, note=self._keeper.event, **about, **coin)
