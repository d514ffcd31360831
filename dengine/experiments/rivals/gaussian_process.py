"""Gaussian-process classification, decided by a credible bound on the success probability."""

from __future__ import annotations

import warnings

import numpy as np

from ...decision.bounds import normal_quantile
from ...errors import SettingError
from .base import Floats, Judgement, Labels, Rival, Traces, positive, whole
from .features import Components

NEWEST = 500  # traces to train on: the work of a training grows with their cube


class GaussianProcess(Rival):
    """scikit-learn's Gaussian-process classifier on principal components; the paper's rule on its credible interval.

    n_components : principal components, which keep their proportions.
    amplitude : the largest deviation that the prior of the latent function may have, above 1, in logits. The marginal
        likelihood drives it up where classes part well; then the interval stays wide even amid hundreds of successes.

    The latent function f at a trace has mean m and variance v under Laplace's approximation; the interval of the success
    probability is sigmoid(m -+ z sqrt(v)), z the 1 - alpha/2 normal quantile as with Wilson. It is a credible interval: it
    holds under the prior, a scaled squared exponential of one length scale, both chosen by the marginal likelihood.
    Trained on the newest 500 labels only, because of its cost; nothing is learned between two trainings.
    Source: Rasmussen and Williams (2006), "Gaussian Processes for Machine Learning", Algorithms 3.1 and 3.2.
    Raises SettingError for a scikit-learn before 1.7, which does not tell the latent mean and variance.
    """

    def __init__(
        self, alpha: float, lower_bound: float, seed: int = 0, *, n_components: int = 2, amplitude: float = 3.0
    ) -> None:
        from sklearn.gaussian_process import GaussianProcessClassifier

        super().__init__(alpha, lower_bound, seed)
        if not hasattr(GaussianProcessClassifier, "latent_mean_and_variance"):
            raise SettingError("The rival gp needs scikit-learn 1.7 or newer; pip install -U scikit-learn.")
        self.n_components = whole("n_components", n_components)
        if positive("amplitude", amplitude) <= 1.0:
            raise SettingError(f"Expected amplitude above 1, got {amplitude!r}; 3 is a success rate of 5 to 95 %.")
        self.amplitude = float(amplitude)
        self._components = Components(n_components, whiten=False, seed=seed)

    def _learn(self, X: Traces, good: Labels) -> bool:
        from sklearn.gaussian_process import GaussianProcessClassifier
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel

        newest, labels = X[-NEWEST:], good[-NEWEST:]
        if not self._components.can_fit(newest) or len(np.unique(labels)) < 2:
            return False
        kernel = ConstantKernel(1.0, (0.1, self.amplitude**2)) * RBF(0.5, (0.01, 10.0))
        classifier = GaussianProcessClassifier(kernel, random_state=self.seed)
        with warnings.catch_warnings():  # it warns of an optimum at a limit, and the limit is meant
            warnings.filterwarnings("ignore", message="The optimal value found")
            self._classifier = classifier.fit(self._components.fit(newest), labels)
        return True

    def _judge(self, X: Traces) -> Judgement:
        mean, variance = self._classifier.latent_mean_and_variance(self._components.transform(X))
        lower, upper = credible_interval(mean, variance, self.policy.alpha)
        return Judgement.without_counts(self.policy.actions(lower, upper), lower, upper)


def credible_interval(mean: Floats, variance: Floats, alpha: float) -> tuple[Floats, Floats]:
    """(lower, upper), each (n,), of a probability whose logit is normal with this mean and variance."""
    from scipy.special import expit

    half = normal_quantile(alpha) * np.sqrt(np.maximum(variance, 0.0))
    return np.asarray(expit(mean - half)), np.asarray(expit(mean + half))
