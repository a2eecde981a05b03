"""What a session shows of the tastes of its user, where users are new.

Tastes are a level and an affinity, v = (level, affinity), and add v · (1, e_i) to the score of an
item with the vector e_i. Before a session begins they are drawn from N(0, C), where C is how
training users differ. What a step showed is its reward less what the item usually gets, v · (1,
e_i) plus noise. The tastes after some steps are their posterior mean, a ridge regression within the
session (Rasmussen and Williams, 2006, Gaussian Processes for Machine Learning, section 2.1).
"""

from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F

MEMORY: Final = 50
"""Steps of a session that show tastes, the latest ones."""
_LEAST: Final = 1e-6
"""Variance of tastes in every direction, relative to the mean."""


class UserPosterior(nn.Module):
    """Tastes of the users of B sessions, from what was shown to them, and its rewards."""

    root: Tensor
    usual: Tensor
    weight: Tensor

    def __init__(self, items: int, embedding_size: int) -> None:
        super().__init__()
        size = embedding_size + 1
        self.register_buffer("root", torch.zeros(size, size))
        """L with L Lᵀ = C, in units of the standard deviation of the noise."""
        self.register_buffer("usual", torch.zeros(items))
        """The reward of every item with a user without tastes of their own, as `targets`."""
        self.register_buffer("weight", torch.zeros(()))
        """Scores per unit of target; 0 if sessions show nothing."""
        self.known = False
        """Whether sessions show tastes."""

    def weigh(self, weight: Tensor | float) -> None:
        """Set the weight; 0 if sessions show nothing."""
        self.weight.fill_(weight)
        self.known = bool(self.weight != 0)

    def _load_from_state_dict(self, *arguments: Any, **named: Any) -> None:
        super()._load_from_state_dict(*arguments, **named)
        self.weigh(self.weight)

    def forward(self, items: Tensor, vectors: Tensor, targets: Tensor) -> Tensor:
        """Posterior means (B, D + 1) of level and affinity, times `weight`.

        Args:
            items: (B, N) int64 items shown, in any order; −1 for none.
            vectors: (n_items, D) of all items.
            targets: (B, N) what they earned, as `ItemRewardModel.target`.
        """
        shown, items = items >= 0, items.clamp(min=0)
        inputs = F.pad(vectors[items], (1, 0), value=1.0) @ self.root * shown.unsqueeze(2)
        unusual = (targets - self.usual[items]) * shown
        matrix = inputs.mT @ inputs + torch.eye(len(self.root), device=inputs.device)
        solution = _solution(matrix, inputs.mT @ unusual.unsqueeze(2)).squeeze(2)
        return self.weight * (solution @ self.root.T)


def _solution(matrix: Tensor, right: Tensor) -> Tensor:
    """(B, K, 1) solutions of symmetric equations (B, K, K) with eigenvalues of at least 1."""
    if not torch.compiler.is_exporting():
        # Of weights that are NaN the solution is, too, which the decision then says.
        return torch.cholesky_solve(right, torch.linalg.cholesky_ex(matrix).L)
    # ONNX has no factorisation: Gauss-Jordan elimination, which needs no pivots here.
    size = matrix.shape[1]
    system, units = torch.cat([matrix, right], 2), torch.eye(size).unsqueeze(2)
    for k in range(size):
        row = system[:, k : k + 1] / system[:, k : k + 1, k : k + 1]
        system = system - (system[:, :, k : k + 1] - units[k]) * row
    return system[:, :, size:]


def root_of_tastes(tastes: Tensor, vectors: Tensor) -> Tensor:
    """L (D + 1, D + 1) with L Lᵀ ∝ C, the covariance of tastes around 0, such that tastes add 1 to
    the variance of scores.

    Args:
        tastes: (U, D + 1) level and affinity of training users. Where they are few, C is shrunk
            towards equal variances (Ledoit and Wolf, 2004).
        vectors: (M, D) of the items of logged steps.
    """
    from sklearn.covariance import ledoit_wolf

    covariance = torch.from_numpy(ledoit_wolf(tastes.double().numpy(), assume_centered=True)[0])
    inputs = F.pad(vectors.double(), (1, 0), value=1.0)
    variance = ((inputs @ covariance) * inputs).sum(1).mean()
    least = _LEAST * covariance.trace() / len(covariance) * torch.eye(len(covariance))
    root: Tensor = torch.linalg.cholesky((covariance + least) / variance)
    return root.float()
