"""The radius-neighbour decision: `RadiusNeighbours` counts the labels around one embedded trace in
a `RadiusIndex` and asks a `DecisionRule` for bound and action. The module compiles to TorchScript.
`WilsonRadiusClassifier` and the model's `Predictor` are built on it.
"""

import torch
from torch import Tensor, nn

from ..records import REASONS, ActionCode, Reason
from .references import RadiusIndex
from .rule import DecisionRule

CERTAIN = REASONS.index(Reason.CERTAIN)
UNCERTAIN = REASONS.index(Reason.UNCERTAIN)


def fade(probability: float, n_labels: int, prior_labels: float) -> float:
    """Return a probability that is drawn towards 1/2 while few labels are known.

    Its logit is multiplied by `n_labels` / (`n_labels` + `prior_labels`), where `prior_labels` says
    how strongly it is drawn, as a number of labels. If `prior_labels` is 0, the probability is
    returned unchanged; otherwise it is 1/2 without labels.
    """
    if prior_labels == 0.0:
        return probability
    share = n_labels / (n_labels + prior_labels)
    success: float = probability**share
    failure: float = (1.0 - probability) ** share
    return success / (success + failure)


class RadiusNeighbours(nn.Module):
    """Counts the references around one embedded trace and asks the rule.

    Parameters
    ----------
    references : RadiusIndex
        The labelled points.
    rule : DecisionRule
        Turns the counts into a bound and an action.
    radius : float
        Radius within which labels count, in units of the scaled embedding, surface included.
    scored : bool, default False
        Whether to decide by a score: the first coordinate in each embedding space must be a
        probability of success, and the bound of `rule` must only sort parts. The mean of these
        probabilities is then both ends of the bound: it uses all labels except the part's own. For
        a rule with `prior_labels` the mean is drawn towards 1/2 (`fade`). The counts are returned
        all the same.
    """

    def __init__(
        self, references: RadiusIndex, rule: DecisionRule, radius: float, scored: bool = False
    ) -> None:
        super().__init__()
        self.scored = scored
        self.prior_labels = float(rule.prior_labels)
        self.references = references
        self.rule = rule
        self.radius = float(radius)
        self.certain = CERTAIN
        self.uncertain = UNCERTAIN
        self.safe_mode = REASONS.index(Reason.SAFE_MODE)

    @torch.jit.export
    def reason(self, action: int) -> int:
        """Return the position in `Reason` of why the rule chose this action, an `ActionCode`.

        CERTAIN for an accept or a reject, SAFE_MODE for a verify while the rule is in a safe mode,
        else UNCERTAIN.
        """
        if action != ActionCode.VERIFY.value:
            return self.certain
        return self.uncertain if self.rule.safe_mode() == 0 else self.safe_mode

    def forward(self, z: Tensor, part: int = 0) -> tuple[int, float, float, int, int]:
        """Decide on one embedded trace; the decision rule and the references do not change.

        Parameters
        ----------
        z : Tensor of float32, shape (K, d)
            The scaled embedding in each of the K embedding spaces. Space k holds the references
            (labelled points) whose labels the encoder of the space was not trained on.
        part : int, default 0
            Hash of the part that the trace is of. References of this part do not count; 0 for an
            unknown part, which excludes none.

        Returns
        -------
        action : int
            0 verify, 1 accept, 2 reject, as the decision rule chooses.
        lower, upper : float
            Bound on the success probability, from the counts. If the module is `scored`, the first
            coordinate in each of the K spaces is a probability of success: both are the mean of
            these, drawn towards 1/2 by the rule's `prior_labels` and the number of all references
            (`fade`), and the action follows from this mean.
        n_success, n_failure : int
            Labels within the radius; several labels of one part may count as fewer
            (`RadiusIndex.count_votes`).
        """
        distances = self.references.squared_distances(z, part)
        n_success, n_failure = self.references.count_near(distances, self.radius)
        if self.scored:
            score = float(z.select(1, 0).mean().item())
            score = fade(score, distances.size(0), self.prior_labels)
            return self.rule.action(score, score), score, score, n_success, n_failure
        action, lower, upper = self.rule(n_success, n_failure)
        return action, lower, upper, n_success, n_failure
