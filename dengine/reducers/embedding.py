"""Features and heads as one module: what answers in the engine, and what export saves."""

import torch
from torch import Tensor, nn

from .features import Features
from .logistic import CrossFittedScores


class FeatureEmbedding(nn.Module):
    """(B, C, T) raw traces -> (B, K, d).

    A linear layer at the end of the features and the heads are one matrix here, `fold` says which.
    """

    weight: Tensor
    bias: Tensor

    def __init__(self, features: Features, head: CrossFittedScores) -> None:
        super().__init__()
        self.features = features
        self.head = head
        self.register_buffer("weight", torch.zeros(len(head.weight), len(features.gain)), persistent=False)
        self.register_buffer("bias", torch.zeros_like(head.bias), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) float32 -> (B, K, d) float32."""
        out: Tensor = self.head.places(nn.functional.linear(self.features.clipped(x), self.weight, self.bias))
        return out

    def fold(self) -> None:
        """Set the matrix from what features and heads are now."""
        weight, bias = self.features.folded(self.head.weight, self.head.bias)
        self.weight.copy_(weight)
        self.bias.copy_(bias)
