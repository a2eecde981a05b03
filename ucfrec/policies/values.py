"""State values: what a session earned from here on average, and at its best."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.episodes.windows import Windows

BEST: float = 0.99
"""τ of the expectile that stands for the best return within the logs (Reinformer)."""
_CLIP = (-5.0, 3.0)
"""Range of the standardised advantage in the exponent of a weight."""


class ValueHead(nn.Module):
    """V(s_t), the mean of the return-to-go Ĝ_t, and V_τ(s_t), its expectile at τ = `BEST`.

    It reads the state and the step's number only, never Ĝ_t or what follows. The expectile
    minimises E[|τ − 1(Ĝ < V)| (Ĝ − V)²] (Zhuang et al., ICML 2024). Values are in units of the
    policy's return scale.
    """

    def __init__(self, state_size: int, dim: int) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(state_size + 1, dim), nn.ReLU(), nn.Linear(dim, dim), nn.ReLU(),
            nn.Linear(dim, 2),
        )  # fmt: skip

    def forward(self, windows: Windows) -> Tensor:
        """Mean and expectile (B, K, 2), from normalised windows."""
        time = torch.log1p(windows.timesteps.float()).unsqueeze(-1) / 5
        return self.net(torch.cat([windows.states, time], dim=-1))  # type: ignore[no-any-return]

    @staticmethod
    def loss(values: Tensor, returns: Tensor) -> Tensor:
        """Squared error of the mean plus the expectile's, over M steps.

        Args:
            values: (M, 2).
            returns: (M,) returns-to-go.
        """
        error = returns - values[:, 1]
        slope = torch.where(error < 0, 1 - BEST, BEST)
        return F.mse_loss(values[:, 0], returns) + (slope * error.square()).mean()


def advantage_weights(values: Tensor, returns: Tensor) -> Tensor:
    """exp(clip((Ĝ_t − V(s_t)) / σ)) of M steps, (M,), σ the advantages' standard deviation.

    Args:
        values: (M, 2) from `ValueHead`.
        returns: (M,) returns-to-go.

    Returns:
        Weights with mean 1, without gradient.
    """
    advantage = (returns - values[:, 0]).detach()
    weights = (advantage / advantage.std(correction=0).clamp(min=1e-6)).clamp(*_CLIP).exp()
    return weights / weights.mean()
