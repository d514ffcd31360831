"""The module inside an exported file: `DecisionModule`, a `Decider` that also learns from reported
outcomes. It decides as `DataEngine.decide` does, and learns as `DataEngine.report` does between two
retrains. `bundle.prepare_export` builds it; TorchScript compiles it; `ExportedModel` and the C++
program call the methods in `METHODS`.
"""

import torch
from torch import Tensor, nn

from ..decision.decider import Decider
from ..records import FITS, REASONS, ActionCode, Reason, TraceSpec
from ..traces import can_fit_length, fit_length

# action, reason, lower, upper, n_success, n_failure, embedding
DecisionFields = tuple[int, int, float, float, int, int, Tensor]
FIELDS = ("action", "reason", "lower", "upper", "n_success", "n_failure", "embedding")
METHODS = (
    "forward",
    "decide",
    "learn",
    "stop",
    "settle",
    "safe_mode",
    "restore",
    "predicted",
    "drop",
    "n_references",
)
NONE_PENDING = -1  # in place of an action: no decision is pending


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
        Eager or compiled; its predictor has `neighbours`, like `model.neighbours.Predictor`.
    embedding_shape : pair of int
        (K, d).
    stops_all : bool, default False
        Whether the next `decide` confirms an accepted part of which nothing was reported.

    Attributes
    ----------
    pending_action : int
        Action of the decision whose outcome is not yet reported, or `NONE_PENDING`.
    pending_predicted : int
        What the model alone would have done.
    pending_part, pending_content : int
        Hash of its part (or of its content if the part is unknown), and of its content.
    pending_novel : bool
        Whether its trace was novel.
    pending_lower, pending_upper : float
        Its bound.
    pending_embedding : Tensor of float32, shape (K, d)
    n_unreported : int
        Number of accepted parts since the last label; their outcomes stay unknown.
    """

    pending_embedding: Tensor

    def __init__(
        self,
        spec: TraceSpec,
        decider: Decider,
        embedding_shape: tuple[int, int],
        stops_all: bool = False,
    ) -> None:
        super().__init__()
        self.decider = decider
        self.channels = spec.channels
        self.samples = spec.samples
        self.fit = FITS.index(spec.fit)
        self.n_spaces = embedding_shape[0]
        self.stops_all = stops_all
        self.audit_reason = REASONS.index(Reason.AUDIT)
        self.novel_reason = REASONS.index(Reason.NOVEL)
        self.outside_reason = REASONS.index(Reason.OUTSIDE)
        self.none_pending = NONE_PENDING
        # Plain attributes: assigned to an element of a tensor, a float would go through float32.
        self.pending_action = NONE_PENDING
        self.pending_predicted = 0
        self.pending_part = 0
        self.pending_content = 0
        self.pending_novel = False
        self.pending_lower = 0.0
        self.pending_upper = 1.0
        self.n_unreported = 0
        self.register_buffer("pending_embedding", torch.zeros(embedding_shape))

    @torch.jit.export
    def decide(self, trace: Tensor, part: int = 0) -> DecisionFields:
        """Decide on one trace, and make this the pending decision: its outcome is not known yet.

        Before that, an accept that is still pending is settled (`settle`): it is learned as good,
        or counts as unreported. Any other pending decision is discarded. After a faulty trace no
        decision is pending. If the decider raises, the accept is settled already.

        Parameters
        ----------
        trace : Tensor of any real dtype, shape (T,) or (C, T)
            Another T is cut, padded or resampled, or refused, as `TraceSpec.fit` says.
        part : int, default 0
            Hash of its part's number (`folds.part_hash`); 0 for an unknown part.

        Returns
        -------
        action, reason : int
            Positions in `Action` and `Reason`.
        lower, upper : float
            Bound on the success probability.
        n_success, n_failure : int
            Labels within the radius.
        embedding : Tensor of float32, shape (K, d)
            NaN for a faulty trace, which is verified.

        Raises
        ------
        ValueError
            For another shape; nothing changes then. Compiled, it is a torch.jit.Error.
        """
        x = self.as_trace(trace)
        self.settle()
        (
            fault, content, action, predicted, reason, lower, upper, n_success, n_failure, z, _,
        ) = self.decider(x, part)  # fmt: skip
        pending = action if fault == 0 else self.none_pending
        self.set_pending(pending, predicted, part, content, reason, lower, upper, z)
        return action, reason, lower, upper, n_success, n_failure, z

    def forward(self, trace: Tensor, part: int = 0) -> DecisionFields:
        """Call `decide`, by the name under which `torch.jit.load` calls a module."""
        return self.decide(trace, part)

    def set_pending(
        self,
        action: int,
        predicted: int,
        part: int,
        content: int,
        reason: int,
        lower: float,
        upper: float,
        z: Tensor,
    ) -> None:
        """Make this decision the pending one: the one whose outcome is not reported yet.

        An earlier pending decision is discarded. `action` and `predicted`, what the model alone
        would have done, are `ActionCode`s (0 verify, 1 accept, 2 reject); `lower` and `upper` are
        the bound on the success probability, and z (K, d), which is copied, is the embedding.
        `action` is `NONE_PENDING` (-1) for a faulty trace; then no decision is pending. `part` is
        the hash of the part; if it is 0, the part is unknown, and the hash `content` of the trace
        takes its place. Whether the trace was novel is read from `reason`, a position in `Reason`.
        """
        self.pending_action = action
        self.pending_predicted = predicted
        self.pending_part = part if part != 0 else content
        self.pending_content = content
        self.pending_novel = reason == self.novel_reason
        self.pending_lower = lower
        self.pending_upper = upper
        self.pending_embedding.copy_(z)

    @torch.jit.export
    def learn(self, trace: Tensor, success: bool, part: int = 0) -> int:
        """Learn the outcome of a part: update the decision rule, and make the trace a reference.

        If the trace and its part are those of the pending decision, its bound is used, and no
        decision is pending afterwards. Otherwise the trace is first decided on, because a bound
        must be computed before the label is known; the pending decision then stays pending. A
        faulty trace is ignored. If the index is full, its oldest reference is dropped. The rule
        also learns how many accepts were unreported since the last label, and this count restarts
        at 0.

        Parameters
        ----------
        trace : Tensor of any real dtype, shape (T,) or (C, T)
            Another T is cut, padded or resampled, or refused, as `TraceSpec.fit` says.
        success : bool
            The label.
        part : int, default 0
            Hash of its part's number; 0 for an unknown part.

        Returns
        -------
        int
            Number of references (labelled points) afterwards.

        Raises
        ------
        ValueError
            For another shape. Compiled, it is a torch.jit.Error.
        """
        x = self.as_trace(trace)
        fault, content = self.decider.check(x)
        if fault == 0:
            part_or_content = part if part != 0 else content
            is_pending = self.pending_action != self.none_pending
            if (
                is_pending
                and self.pending_part == part_or_content
                and self.pending_content == content
            ):
                self.learn_pending(success)
            else:
                (
                    _, _, action, predicted, reason, lower, upper, _, _, z, _,
                ) = self.decider(x, part)  # fmt: skip
                novel = reason == self.novel_reason
                self.learn_outcome(
                    lower, upper, novel, z, part_or_content, success, action, predicted
                )
        return self.n_references()

    @torch.jit.export
    def stop(self, trace: Tensor, part: int = 0) -> int:
        """Learn that an accepted part was bad and stopped the line, as `learn` does.

        Whether it was accepted is not checked.
        """
        return self.learn(trace, False, part)

    @torch.jit.export
    def settle(self) -> bool:
        """End the wait for the outcome of a pending accept; return whether it was learned as good.

        A pending accept is the part decided last, if it was accepted and nothing was reported on
        it. With `stops_all` (every line stop is reported) it is learned as good: the decision rule
        is updated, and the trace becomes a reference. Otherwise `n_unreported` grows by 1. Then no
        decision is pending. If the pending decision is no accept, or there is none, nothing
        changes.
        """
        if self.pending_action != ActionCode.ACCEPT.value:
            return False
        if self.stops_all:
            self.learn_pending(True)
            return True
        self.n_unreported += 1
        self.pending_action = self.none_pending
        return False

    @torch.jit.export
    def drop(self) -> None:
        """Discard the pending decision: its part was not passed on, its outcome stays unknown."""
        self.pending_action = self.none_pending

    @torch.jit.export
    def restore(
        self, trace: Tensor, part: int, action: int, reason: int, lower: float, upper: float
    ) -> None:
        """Make an earlier decision, which a journal holds, the pending decision again.

        A pending accept is first settled by `settle`; any other pending decision is discarded. The
        trace, (T,) or (C, T), is embedded anew. `action` (0 verify, 1 accept, 2 reject), `reason`
        (a position in `Reason`) and the bound, `lower` and `upper`, are taken as they are given;
        `part` is the hash of the part, 0 if unknown. What the model alone would have done is VERIFY
        if a force limit decided, the action of the rule as it is now on this bound if the part was
        audited, else `action`. After a faulty trace no decision is pending. Raises ValueError, or
        torch.jit.Error if compiled, for another shape.
        """
        x = self.as_trace(trace)
        self.settle()
        fault, content = self.decider.check(x)
        pending = action if fault == 0 else self.none_pending
        predicted = 0 if reason == self.outside_reason else action
        if reason == self.audit_reason:
            predicted = self.decider.predictor.neighbours.rule.action(lower, upper)
        z = self.decider.predictor.embed(x)
        self.set_pending(pending, predicted, part, content, reason, lower, upper, z)

    @torch.jit.export
    def predicted(self) -> int:
        """Return what the model alone would have done with the trace decided last.

        It differs from the action in an audit, and if a force limit rejects.
        """
        return self.pending_predicted

    @torch.jit.export
    def safe_mode(self) -> int:
        """Return why the safe mode began, as a `SafeMode`; NONE outside of a safe mode."""
        safe_mode: int = self.decider.predictor.neighbours.rule.safe_mode()
        return safe_mode

    @torch.jit.export
    def n_references(self) -> int:
        """Return the number of references."""
        n_references: int = self.decider.predictor.neighbours.references.size()
        return n_references

    def learn_pending(self, success: bool) -> None:
        """Learn the outcome of the pending decision; afterwards no decision is pending.

        The decision rule is updated, and the trace becomes a reference with the label `success`, as
        in `learn_outcome`. It is not checked whether a decision is pending.
        """
        self.learn_outcome(
            self.pending_lower,
            self.pending_upper,
            self.pending_novel,
            self.pending_embedding,
            self.pending_part,
            success,
            self.pending_action,
            self.pending_predicted,
        )
        self.pending_action = self.none_pending

    def learn_outcome(
        self,
        lower: float,
        upper: float,
        novel: bool,
        z: Tensor,
        part: int,
        success: bool,
        action: int,
        predicted: int,
    ) -> None:
        """Update the decision rule with an outcome, and make the trace a reference.

        `success` is the label, and z (K, d) the embedding of the trace. `lower` and `upper` (the
        bound), `novel` (whether the trace was novel), `action` and `predicted` (what the model
        alone would have done; `ActionCode`s) are those of the decision, from before the label was
        known. `part` is the hash of the part; it also gives the part's fold k, and the reference is
        put into embedding space k. The rule gets as inclusion probability the audit rate if the
        part was audited, 1 if it was verified for another reason, and 0 if it was accepted or
        rejected. It also gets `n_unreported`, the number of accepted parts without a report since
        the last label, which restarts at 0. If the index is full, its oldest reference is dropped.
        """
        inclusion_probability = 0.0
        if action == ActionCode.VERIFY.value:
            audit_rate = float(self.decider.audit_rate.item())
            inclusion_probability = 1.0 if predicted == action else audit_rate
        neighbours = self.decider.predictor.neighbours
        neighbours.rule.observe(self.n_unreported, novel)
        neighbours.rule.update(lower, upper, success, predicted, inclusion_probability)
        space = self.decider.toss(part) % self.n_spaces
        neighbours.references.put(z[space], 1.0 if success else 0.0, space, part)
        self.n_unreported = 0

    def as_trace(self, trace: Tensor) -> Tensor:
        """Return a trace (T,) or (C, T) as (C, T) float32 with the samples that the decider takes.

        Another number of samples is cut, padded or resampled, as `TraceSpec.fit` says. Raises
        ValueError, or torch.jit.Error if compiled, for a number of samples that cannot be fitted in
        this way, for no samples, and for another shape.
        """
        x = trace.unsqueeze(0) if trace.dim() == 1 else trace
        fits = x.numel() > 0 and can_fit_length(x.size(-1), self.samples, self.fit)
        if x.dim() != 2 or x.size(0) != self.channels or not fits:
            raise ValueError(
                f"Expected one trace of {self.channels} x {self.samples} samples, got shape "
                f"{trace.size()}."
            )
        x = x.to(torch.float32).contiguous()
        return x if x.size(1) == self.samples else fit_length(x, self.samples, self.fit)
