"""Functions that restore a stored version bit for bit: its model, later labels and corrections.
`live_model.LiveModel` uses these functions when a store is opened, `learner.Learner` for a rollback
and after labels were forgotten, and `fleet.Peers` when another cell's version is put in force.
"""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from ..errors import StoreError
from ..model.base import EngineModel
from ..store.records import Correction, ModelVersion, without_rule
from .guard import NO_REFERENCE, guarded
from .trainer import TrainedOn

if TYPE_CHECKING:
    from ..store.outbox import Outbox
    from ..store.sql import SqlStore


class ChangedTracesError(StoreError):
    """A version must be fitted again, on traces of which some are missing or damaged."""


def restore_model(
    outbox: Outbox,
    template: EngineModel,
    version: ModelVersion,
    trained_on: TrainedOn,
    *,
    with_rule: bool = False,
) -> EngineModel:
    """Return a new model in the state of a stored version, made from the untrained `template`.

    A model whose fit is not stored, but only the numbers of its traces, like umap-learn or a
    baseline (a model that the user handed in), is trained again on the traces of `trained_on`.
    Their labels are taken as they were after the correction `trained_on.corrected_to`; a correction
    changes or withdraws a label. A trace whose label was withdrawn by then is left out, and does
    not count as missing. The labels are first compared with the ledger, the store's hash chain. A
    difference sets `outbox.integrity_error`, after which every part is verified, and the model is
    trained nevertheless. The new model and the template share one decision rule object. It stays as
    it is, but with `with_rule` it gets the stored state, if the version holds one.

    Raises ChangedTracesError if one of these traces is missing or damaged; an event in the store's
    log names the damaged ones. Raises StoreError, KeyError, ValueError or NotImplementedError for a
    state that cannot be restored, like that of another reducer; StoreError for a label that is
    neither 0 nor 1, for traces of different shapes, and if the store does not answer; and what the
    training raises.
    """
    state = version.state if with_rule else without_rule(version.state)
    model = template.successor()
    if not model.needs_refit(state):
        return model.set_state(state)
    store = outbox.store
    first = int(trained_on.seq[0])
    outbox.check_integrity(first - 1)  # only the newest labels were checked before
    data = store.labels.with_traces(
        first=first, last=int(trained_on.seq[-1]), corrected_to=trained_on.corrected_to
    )
    kept = np.isin(data.seq, trained_on.seq)
    corrected = {
        correction.seq: correction.success
        for correction in store.corrections.after()
        if correction.number <= trained_on.corrected_to
    }
    # A forgotten label is not among the data although nothing is damaged.
    n_forgotten = sum(corrected.get(seq, True) is None for seq in trained_on.seq.tolist())
    if kept.sum() + n_forgotten < len(trained_on.seq):
        raise ChangedTracesError(
            f"Expected the traces that version {version.version} was fitted on as they were "
            "stored, some have changed; see `dengine verify`, and restore the store from a copy."
        )
    model.train(data.traces[kept], data.labels[kept], data.hashes[kept], numbers=data.seq[kept])
    return model.set_state(state)


def find_clean_start(
    store: SqlStore, template: EngineModel, newest: EngineModel, trained_on: TrainedOn
) -> tuple[EngineModel, str]:
    """Return a model for the next training to start from, which saw no label that is forgotten now.

    A label is forgotten if a person withdrew it. If `newest`, whose weights learned from the labels
    that `trained_on` names, saw no such label, it is returned. It is also returned if each training
    of it begins anew, as of a baseline (a model that the user handed in), or of a model that must
    be fitted again after loading, since its versions lack the fit. Otherwise the newest stored
    version that saw no such label is returned, as a new model with the decision rule of `template`;
    the version may also be of another robot cell with which this cell shares labels. Versions that
    are damaged or not kept, or whose loading or restoring raises StoreError for another reason, are
    passed over. If there is none, it is `template`, the untrained model with its initial weights.

    Returns
    -------
    start : EngineModel
    note : str
        Says which of these it is; "" for `newest`.

    Raises
    ------
    StoreError
        If the corrections or the list of versions cannot be read.
    KeyError, ValueError, NotImplementedError
        For a version of another reducer that cannot be restored.
    """
    corrections = {correction.seq: correction for correction in store.corrections.after()}

    def is_clean(trained_on: TrainedOn) -> bool:
        """Return whether weights that were trained on these labels saw none that is forgotten now.

        A label that was forgotten before the training does not count: the training left it out.
        """
        return not any(
            correction.success is None
            and correction.number > trained_on.corrected_to
            and trained_on.has_seen(correction.seq)
            for correction in corrections.values()
        )

    if is_clean(trained_on) or not newest.keeps_references:
        return newest, ""
    for stored in reversed(store.versions.all()):
        with suppress(StoreError):  # of a version that is not kept, or damaged
            version = store.versions.load(stored.report.version)
            model = template.successor()
            if model.needs_refit(version.state):
                return newest, ""
            if is_clean(TrainedOn.from_state(version.state)):
                model.set_state(without_rule(version.state))
                return (
                    model,
                    f"from version {version.version}, which never saw the forgotten labels",
                )
    return template, "from initial weights, which never saw the forgotten labels"


def add_labels_since(
    model: EngineModel,
    store: SqlStore,
    version: ModelVersion,
    capacity: int,
    shared_to: int | None = None,
) -> int:
    """Add the labels since a version, as references, to its restored model, if it lacks them.

    References are embedded labelled traces, which a model counts near a new trace. Let N be the
    number of the newest label that the version was trained on, or that was stored when a rollback
    put the version in force again. The labels are those after N; a baseline (a model that the user
    handed in) gets those after the newest label that it was trained on. Up to number `shared_to`
    they are those of all robot cells of the product (cells that share labels), and after it only
    this cell's own. None stands for N, so that an engine that opens a store counts what it counted
    before. At most the `capacity` newest of the shared labels are read, and as many of the cell's
    own.

    Corrections since the version was stored, which change or withdraw a label, are applied between
    the labels, in the order in which they came, so that the model is the same bit for bit. A
    correction that the model cannot take (`apply_correction` returns False) is skipped without a
    message. A baseline, which cannot be corrected, gets the labels as they count now. A label that
    the model cannot take is logged and skipped; one whose trace is damaged is skipped, and noted as
    an event in the store's log.

    Returns the number of the newest correction in the store. Raises StoreError if the store cannot
    be read, for a label that is neither 0 nor 1, and for traces of different shapes.
    """
    corrected_to = int(version.state.get("corrected_to", 0))
    # A baseline cannot be corrected afterwards, so it gets each label as it counts now; another
    # model gets it as it was when the version was stored, and then the corrections.
    as_of = corrected_to if model.keeps_references else None
    trained_on = TrainedOn.from_state(version.state)
    # Stored references include labels that came later. A baseline has no stored references: it was
    # trained again, without those labels.
    references = set(version.state["numbers"].tolist() if "points" in version.state else [])
    trained_to = trained_on.counts_from if references else int(trained_on.seq[-1])
    first = max(trained_to + 1, min(references, default=0))
    shared_to = trained_on.counts_from if shared_to is None else shared_to
    shared = store.labels.with_traces(capacity, first=first, last=shared_to, corrected_to=as_of)
    own = store.labels.with_traces(
        capacity, first=max(first, shared_to + 1), corrected_to=as_of, cell_only=True
    )
    corrections = deque(store.corrections.after(corrected_to))
    newest = corrections[-1].number if corrections else corrected_to
    points = {
        label.seq: label.point
        for label in store.labels.past(version.last_seq)
        if label.model_version == version.version
    }
    for seq, trace, label, hash_ in (*shared.rows(), *own.rows()):
        if seq in references:
            continue
        while corrections and corrections[0].newest_seq < seq:
            apply_correction(model, store, corrections.popleft())
        # The point is unknown where an earlier version answered the decision.
        guarded(NO_REFERENCE, model.add_reference, trace, label, hash_, seq, point=points.get(seq))
    for correction in corrections:
        apply_correction(model, store, correction)
    return newest


def apply_correction(model: EngineModel, store: SqlStore, correction: Correction) -> bool:
    """Change the reference of a corrected label: relabel it, remove it or add it again.

    A reference is an embedded labelled trace, which the model counts near a new trace. It is
    removed if the label was withdrawn, and added again if a withdrawn label is to count again. If
    the model cannot take a reference that is added again, the error is logged, and the next version
    learns the label from the store. If its trace is damaged, it is not added, which is noted as an
    event in the store's log.

    Returns
    -------
    bool
        False if the model keeps references and cannot change this one: nothing is changed, and the
        model must be trained again. True in all other cases, even if nothing is changed: the model
        is a baseline (handed in by the user), which keeps no references; the model has no reference
        of this label any more; the trace has a fault and was never a reference; or the trace is
        damaged and would have to be added again.

    Raises
    ------
    StoreError
        For a reference that is added again, if the store cannot be read, or the label as it was
        reported is neither 0 nor 1.
    """
    if not model.keeps_references:
        return True
    label = None if correction.success is None else int(correction.success)
    if correction.was is not None or label is None:
        return model.change_reference(correction.seq, correction.content_hash, label)
    # A version of a peer may have it already.
    model.change_reference(correction.seq, correction.content_hash, None)
    # As it was reported, of whichever cell; no row if the trace has a fault or is damaged.
    data = store.labels.with_traces(first=correction.seq, last=correction.seq, corrected_to=0)
    for seq, trace, _, hash_ in data.rows():
        guarded(NO_REFERENCE, model.add_reference, trace, label, hash_, seq)
    return True
