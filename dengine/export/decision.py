"""The module inside an exported file: `DecisionModule`, a `Decider` that also learns from reported
outcomes. It decides as `DataEngine.decide` does, and learns as `DataEngine.report` does between two
retrains. `bundle.prepare_export` builds it; TorchScript compiles it; `ExportedModel` and the C++
program call the exported methods.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..decision.decider import Decider, Predicted
from ..records import FITS, ActionCode, TraceSpec
from ..traces import can_fit_length, fit_length

FIELDS = ("action", "reason", "lower", "upper", "n_success", "n_failure", "embedding")


class DecidedTrace(NamedTuple):
    """What `DecisionModule` keeps of a decision until the outcome of the part is known.

    Attributes
    ----------
    action, predicted : int
        `ActionCode`s (0 verify, 1 accept, 2 reject): what was decided, and what the model alone
        would have done.
    part : int
        Hash of the part; 0 for an unknown part.
    content : int
        Hash of the content of the trace.
    reason : int
        Position in `Reason`.
    lower, upper : float
        Bound on the success probability.
    embedding : Tensor of float32, shape (K, d)
    """

    action: int
    predicted: int
    part: int
    content: int
    reason: int
    lower: float
    upper: float
    embedding: Tensor


class DecisionModule(nn.Module):
    """Decides on raw traces, keeps the pending decision, and learns its outcome.

    A labelled trace becomes a reference in the space of its fold; the oldest reference leaves
    first, whatever its label. The rule is updated with each outcome. Encoder and novelty gate stay
    as they are. All state, the pending decision included, is saved with the module.

    Parameters
    ----------
    spec : TraceSpec
        Shape of the traces, and how other lengths are fitted to it.
    decider : Decider
        Eager or compiled; its predictor is a `model.neighbours.Predictor`.
    n_spaces : int
        K, the number of embedding spaces.
    stops_all : bool
        Whether the next `decide` confirms an accepted part of which nothing was reported.

    Attributes
    ----------
    pending : DecidedTrace or None
        The decision whose outcome is not yet reported.
    last_predicted : int
        What the model alone would have done with the trace decided last.
    n_unreported : int
        Number of accepted parts since the last label whose outcome was not reported, without the
        pending one; always 0 with `stops_all`.
    """

    pending: DecidedTrace | None

    def __init__(
        self,
        spec: TraceSpec,
        decider: Decider,
        n_spaces: int,
        stops_all: bool,
    ) -> None:
        super().__init__()
        self.decider = decider
        self.channels = spec.channels
        self.samples = spec.samples
        self.fit = FITS.index(spec.fit)
        self.n_spaces = n_spaces
        self.stops_all = stops_all
        self.pending = None
        self.last_predicted = ActionCode.VERIFY.value
        self.n_unreported = 0

    @torch.jit.export
    def decide(self, trace: Tensor, part: int = 0) -> Predicted:
        """Decide on one trace, and make this the pending decision: its outcome is not known yet.

        Before that, an accept that is still pending is settled (`settle`): with `stops_all` (every
        bad accepted part is reported) it is learned as good, otherwise it counts as unreported. Any
        other pending decision is discarded. After a faulty trace (NaN, infinite, constant, too
        large or at the sensor's limit) no decision is pending. Afterwards `predicted` returns what
        the model alone would have done, without force limits (an operator's limits of the signal)
        and audits (random checks of parts about which the model is certain). If the model raises,
        the accept is settled already.

        Parameters
        ----------
        trace : Tensor of any real dtype, shape (T,) or (C, T)
            Another T is cut, padded or resampled, or refused, as `TraceSpec.fit` says.
        part : int, default 0
            Hash of the number by which a user names the part (`folds.part_hash`), 0 if it has none.
            References (labelled points) of this part do not count; without a number, those of equal
            traces.

        Returns
        -------
        action, reason : int
            Action: 0 verify (the part needs the slow check), 1 accept, 2 reject. Reason: position
            in `Reason`.
        lower, upper : float
            Bound on the probability that the part is good; (0, 1) for a faulty trace, for a novel
            one (unlike all training traces), or if a force limit decides.
        n_success, n_failure : int
            Good and bad labels within the radius; 0 for a faulty or a novel trace, or if a force
            limit decides.
        embedding : Tensor of float32, shape (K, d)
            A point in each of the K embedding spaces; NaN for a faulty trace, which is verified.

        Raises
        ------
        ValueError
            For another shape, or a T that is refused; nothing changes then. Compiled, it is a
            torch.jit.Error.
        """
        x = self.as_trace(trace)
        self.settle()
        (
            fault, content, action, predicted, reason, lower, upper, n_success, n_failure, z, _,
        ) = self.decider(x, part)  # fmt: skip
        self.last_predicted = predicted
        self.pending = None
        if fault == 0:
            self.pending = DecidedTrace(
                action, predicted, part, content, reason, lower, upper, z.clone()
            )
        return action, reason, lower, upper, n_success, n_failure, z

    def forward(self, trace: Tensor, part: int = 0) -> Predicted:
        """Do and return what `decide` does; a loaded module that is called runs this method."""
        return self.decide(trace, part)

    @torch.jit.export
    def learn(self, trace: Tensor, success: bool, part: int = 0) -> int:
        """Learn the outcome of a part: update the decision rule, and make the trace a reference.

        A reference is a labelled point with which later traces are compared; if there is no room,
        the oldest is dropped. If the trace and its part are those of the pending decision (whose
        outcome is not known yet), its bound on the success probability is used, and no decision is
        pending afterwards. Otherwise the trace is first decided on, because a bound must be
        computed before the label is known; the pending decision then stays pending. The rule also
        learns how many accepted parts had no report since the last label, and this count restarts
        at 0. A faulty trace (NaN, infinite, constant, too large or at the sensor's limit) is
        ignored: nothing changes.

        Parameters
        ----------
        trace : Tensor of any real dtype, shape (T,) or (C, T)
            Another T is cut, padded or resampled, or refused, as `TraceSpec.fit` says.
        success : bool
            The label: whether the part is good.
        part : int, default 0
            Hash of the number by which a user names the part (`folds.part_hash`), 0 if it has none.

        Returns
        -------
        int
            Number of references afterwards.

        Raises
        ------
        ValueError
            For another shape, or a T that is refused. Compiled, it is a torch.jit.Error.
        """
        x = self.as_trace(trace)
        fault, content = self.decider.check(x)
        if fault == 0:
            pending = self.pending
            if pending is not None and pending.part == part and pending.content == content:
                self.learn_outcome(pending, success)
                self.pending = None
            else:
                (
                    _, _, action, predicted, reason, lower, upper, _, _, z, _,
                ) = self.decider(x, part)  # fmt: skip
                self.learn_outcome(
                    DecidedTrace(action, predicted, part, content, reason, lower, upper, z), success
                )
        return self.n_references()

    @torch.jit.export
    def stop(self, trace: Tensor, part: int = 0) -> int:
        """Learn that an accepted part was bad and stopped the line: `learn` with the label bad.

        Whether it was accepted is not checked. Returns the number of references, and raises what
        `learn` raises.
        """
        return self.learn(trace, False, part)

    @torch.jit.export
    def settle(self) -> bool:
        """End the wait for the outcome of a pending accept; return whether it was learned as good.

        A pending accept is the part decided last, if it was accepted and nothing was reported on
        it. With `stops_all` (every bad accepted part is reported, so silence means good) it is
        learned as good: the decision rule is updated, and the trace becomes a reference (a labelled
        point with which later traces are compared). Otherwise `n_unreported`, the count of such
        parts, grows by 1. Then no decision is pending. If the last decision was no accept, or no
        decision is pending, nothing changes, and False is returned.
        """
        pending = self.pending
        if pending is None or pending.action != ActionCode.ACCEPT.value:
            return False
        self.pending = None
        if self.stops_all:
            self.learn_outcome(pending, True)
            return True
        self.n_unreported += 1
        return False

    @torch.jit.export
    def drop(self) -> None:
        """Discard the pending decision: its part was not passed on, its outcome stays unknown.

        Nothing is learned, and an accept does not count as unreported. Without a pending decision
        nothing changes.
        """
        self.pending = None

    @torch.jit.export
    def restore(
        self, trace: Tensor, part: int, action: int, reason: int, lower: float, upper: float
    ) -> None:
        """Make an earlier decision, which a journal holds, the pending decision again.

        The outcome of a pending decision is not known yet. If an accept is pending already, it is
        settled first (`settle`): learned as good, or counted as unreported. Any other pending
        decision is discarded. The trace, (T,) or (C, T), is embedded anew. `action` (0 verify, 1
        accept, 2 reject), `reason` (a position in `Reason`) and the bound on the success
        probability, `lower` and `upper`, are taken as they are given; `part` is the hash of the
        part's number, 0 if it has none. What `predicted` returns afterwards, the action of the
        model alone, is `action`, with two exceptions: VERIFY if a force limit (an operator's limit
        of the signal) decided, and what the rule now makes of this bound if the part was audited
        (checked at random although the model was certain). After a faulty trace (NaN, infinite,
        constant, too large or at the sensor's limit) no decision is pending. Raises ValueError, or
        torch.jit.Error if compiled, for another shape, or a T that `TraceSpec.fit` refuses.
        """
        x = self.as_trace(trace)
        self.settle()
        fault, content = self.decider.check(x)
        predicted = 0 if reason == self.decider.outside_reason else action
        if reason == self.decider.audit_reason:
            predicted = self.decider.predictor.neighbours.rule.action(lower, upper)
        self.last_predicted = predicted
        self.pending = None
        if fault == 0:
            z = self.decider.predictor.embed(x)
            self.pending = DecidedTrace(action, predicted, part, content, reason, lower, upper, z)

    @torch.jit.export
    def predicted(self) -> int:
        """Return what the model alone would have done with the trace decided (or restored) last.

        It is an `ActionCode` (0 verify, 1 accept, 2 reject), 0 before the first decision and after
        `decide` got a faulty trace. It differs from the action in an audit, and if a force limit
        rejects. `learn` does not change it.
        """
        return self.last_predicted

    @torch.jit.export
    def safe_mode(self) -> int:
        """Return why the safe mode began, as the integer of a `SafeMode`; 0 (NONE) outside of a
        safe mode.
        """
        safe_mode: int = self.decider.predictor.neighbours.rule.safe_mode()
        return safe_mode

    @torch.jit.export
    def n_references(self) -> int:
        """Return the number of references, the labelled points in all embedding spaces together."""
        n_references: int = self.decider.predictor.neighbours.references.size()
        return n_references

    def learn_outcome(self, decided: DecidedTrace, success: bool) -> None:
        """Update the decision rule with an outcome, and make the trace a reference.

        `decided` is the decision, from before the label was known, and `success` the label. A
        reference is a labelled point with which later traces are compared. The hash of the part's
        number (of the content of its trace, if it has none) gives the part's fold k, one of K
        permanent groups, and the reference is put into embedding space k, which was trained without
        the labels of fold k. If there is no room, the oldest reference is dropped. The rule gets
        the bounds of the success probability, the label, what the model alone would have done, and
        the probability with which the outcome would be asked for: the audit rate if the part was
        audited (checked at random although the model was certain), 1 if it was verified for another
        reason, and 0 if it was accepted or rejected. It also gets whether the trace was novel
        (unlike all training traces), and `n_unreported`, the number of accepted parts without a
        report since the last label, which restarts at 0. `pending` (the last decision, while its
        outcome is not known) is not changed.
        """
        inclusion_probability = 0.0
        if decided.action == ActionCode.VERIFY.value:
            audit_rate = float(self.decider.audit_rate.item())
            inclusion_probability = 1.0 if decided.predicted == decided.action else audit_rate
        predictor = self.decider.predictor
        neighbours = predictor.neighbours
        neighbours.rule.observe(self.n_unreported, decided.reason == predictor.novel)
        neighbours.rule.update(
            decided.lower, decided.upper, success, decided.predicted, inclusion_probability
        )
        part = decided.part if decided.part != 0 else decided.content
        space = self.decider.toss(part) % self.n_spaces
        neighbours.references.put(decided.embedding[space], 1.0 if success else 0.0, space, part)
        self.n_unreported = 0

    def as_trace(self, trace: Tensor) -> Tensor:
        """Return a trace (T,) or (C, T) as (C, T) float32, with the number of samples of the model.

        Another number of samples is cut, padded or resampled, as `TraceSpec.fit` says. A trace that
        has the right shape and dtype already, and is contiguous, is not copied. NaN and infinities
        pass. Raises ValueError, or torch.jit.Error if compiled, for a number of samples that cannot
        be fitted in this way, for no samples, and for another number of channels C or of
        dimensions.
        """
        x = trace.unsqueeze(0) if trace.dim() == 1 else trace
        is_whole = x.dim() == 2 and x.size(0) == self.channels and x.numel() > 0
        if not is_whole or not can_fit_length(x.size(-1), self.samples, self.fit):
            raise ValueError(
                f"Expected one trace of {self.channels} x {self.samples} samples, got shape "
                f"{trace.size()}."
            )
        x = x.to(torch.float32).contiguous()
        return x if x.size(1) == self.samples else fit_length(x, self.samples, self.fit)
