"""State values: the mean return from here on, and at its best."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.episodes.windows import Windows
from ucfrec.fitting.distributed import joint_moments

BEST: float = 0.99
"""τ of the expectile that stands for the best return within the logs (Reinformer)."""
_CLIP = (-5.0, 3.0)
"""Range of the standardised advantage in the exponent of a weight."""


class ValueHead(nn.Module):
    """V(h_t), the mean of the return-to-go Ĝ_t, and V_τ(h_t), its expectile at τ = `BEST`.

    The history h_t is what the policy sees but the returns-to-go: states and step numbers up to t
    and actions before t, within the context. The expectile minimises E[|τ − 1(Ĝ < V)| (Ĝ − V)²]
    (Zhuang et al., ICML 2024). Values are in units of the policy's return scale.
    """

    def __init__(self, state_size: int, dim: int) -> None:
        super().__init__()
        self.embed = nn.Linear(state_size + 1 + dim, dim)
        self.history = nn.GRU(dim, dim, batch_first=True)
        self.out = nn.Sequential(nn.Linear(dim, dim), nn.ReLU(), nn.Linear(dim, 2))

    def forward(self, windows: Windows, actions: Tensor) -> Tensor:
        """Mean and expectile (B, K, 2).

        Args:
            windows: normalised.
            actions: (B, K, d) the embedded actions of the windows; no gradient goes into them.
        """
        mask = windows.mask
        time = torch.log1p(windows.timesteps.float()).unsqueeze(-1) / 5
        taken = actions.detach().masked_fill(~mask.unsqueeze(-1), 0.0)
        before = F.pad(taken, (0, 0, 1, 0))[:, :-1]
        tokens = F.relu(self.embed(torch.cat([windows.states, time, before], dim=-1)))
        # Padding is moved from the left to the right, where it follows every step.
        padding, steps = (~mask).sum(1, keepdim=True), torch.arange(mask.shape[1]).to(mask.device)
        found, _ = self.history(_taken(tokens, (steps + padding).clamp(max=mask.shape[1] - 1)))
        return self.out(_taken(found, (steps - padding).clamp(min=0)))  # type: ignore[no-any-return]

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


def _taken(values: Tensor, steps: Tensor) -> Tensor:
    """The rows (B, K) `steps` of `values` (B, K, d)."""
    return values.gather(1, steps.unsqueeze(-1).expand_as(values))


def advantage_weights(values: Tensor, returns: Tensor) -> Tensor:
    """exp(clip((Ĝ_t − V(s_t)) / σ)) of M steps, (M,), σ the advantages' standard deviation.

    Args:
        values: (M, 2) from `ValueHead`.
        returns: (M,) returns-to-go.

    Returns:
        Weights without gradient, with mean 1 over the steps of all processes.
    """
    advantage = (returns - values[:, 0]).detach()
    deviation = joint_moments(advantage)[1]
    weights = (advantage / deviation.clamp(min=1e-6)).clamp(*_CLIP).exp()
    return weights / joint_moments(weights)[0]
