"""UMAP's fuzzy graph of neighbours, and the cross-entropy by which points are laid out after it.

Source: McInnes, Healy and Melville (2018), arXiv:1802.03426, sections 3 and 4; the loss by sampling: Sainburg, McInnes and
Gentner (2021), Neural Computation 33(11).
"""

import numpy as np
import torch
from torch import Tensor

A, B = 1.577, 0.895  # of the similarity 1 / (1 + A * d^(2B)), for UMAP's min_dist 0.1


def cross_entropy(z: Tensor, others: Tensor) -> Tensor:
    """UMAP's cross-entropy, sampled: points (E, d), and others (1 + R, E, d), of which the first are joined to them."""
    spread = A * ((z - others).square().sum(2) + 1e-4) ** B  # (1 + R, E); similarity is 1 / (1 + spread)
    return (spread.log1p().sum() - spread[1:].log().sum()) / spread.numel()


def fuzzy_graph(g: Tensor, n_neighbors: int) -> tuple[Tensor, Tensor, Tensor]:
    """Edges (i, j) between neighbours among features (n, P), and their memberships, each (E,).

    UMAP's: exp(-(d - rho) / sigma) of each of the k nearest, rho the least distance, sigma such that these sum to log2(k);
    then a + b - a * b of the two directions.
    """
    n = len(g)
    k = min(n_neighbors, n - 1)
    distance, near = (torch.cdist(g, g) + torch.diag(torch.full((n,), torch.inf))).topk(k, largest=False)  # (n, k)
    beyond = distance - distance[:, :1]
    low, high = torch.zeros(n, 1), 10.0 * beyond[:, -1:] + 1e-6
    for _ in range(32):
        sigma = (low + high) / 2
        above = torch.exp(-beyond / sigma).sum(1, keepdim=True) > max(1.0, float(np.log2(k)))
        low, high = torch.where(above, low, sigma), torch.where(above, sigma, high)
    directed = torch.zeros(n, n).scatter_(1, near, torch.exp(-beyond / high))
    joined = directed + directed.T - directed * directed.T
    i, j = joined.nonzero().unbind(1)
    return i, j, joined[i, j]
