"""What an engine says of its own past: the history, and the explanation of a decision; and both of a store alone."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import TYPE_CHECKING

from .errors import DengineError
from .history import history
from .model.base import EngineModel
from .records import Action, Reason
from .resuming import Telling, resume
from .settings import EngineSettings
from .store.base import Store
from .store.views import PastDecision
from .versions import ModelVersions
from .window import Window

if TYPE_CHECKING:
    from .explaining import Explanation

log = logging.getLogger("dengine")


class EngineReview:
    """The part of `DataEngine` that looks back."""

    store: Store
    _versions: ModelVersions

    def history(
        self,
        last: int | None = None,
        action: Action | str | None = None,
        reason: Reason | str | None = None,
        label: str | None = None,
        since: float | None = None,
        until: float | None = None,
        predicted: Action | str | None = None,
    ) -> Iterator[PastDecision]:
        """The decisions so far, newest last, as they were recorded; arguments and errors as in `history.history`."""
        return history(self.store, last, action, reason, label, since, until, predicted)

    def explain(self, decision_id: str, neighbours: int = 10) -> Explanation:
        """Why a decision came out as it did, with the `neighbours` nearest references; ReportError for an unknown id."""
        from .explaining import Records, explain

        versions = self._versions
        return explain(decision_id, Records(self.store, lambda: versions.answering, versions.version), neighbours)


def explain_stored(store: Store, decision_id: str, neighbours: int = 10) -> Explanation:
    """`DataEngine.explain` of a store that no engine has open here; nothing in it changes."""
    from .explaining import Records, explain

    last = store.past_retrains()
    version = max((each.report.version for each in last if each.report.accepted), default=0)
    return explain(decision_id, Records(store, lambda: _present(store), version), neighbours)


def _present(store: Store) -> EngineModel | None:
    """The model that answers now, rebuilt; None where it needs an object that the store cannot name."""
    try:
        settings, template = EngineSettings.from_store(store.settings(), "the store").with_template(None)
        telling = Telling(settings.told_since, settings.began_in)
        return resume(store, template, Window(settings.recipe.window), telling).model
    except DengineError as error:
        log.info("the present model cannot be rebuilt from the store alone: %s", error)
        return None
