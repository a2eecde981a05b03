"""CDT4Rec (Wang et al., SIGIR 2023): a Decision Transformer that also estimates the reward."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.policies.dt import DTConfig, DTPolicy
from ucfrec.settings import Weight, settings_table


@settings_table("policy")
class CDT4RecConfig(DTConfig):
    """Settings of CDT4Rec; the backbone is DT, as in its public code."""

    reward_weight: Weight = 0.5
    """Weight of the squared error of the standardised reward; 0 gives DT. The public code adds both
    losses unweighted and does not standardise rewards."""


class CDT4RecPolicy(DTPolicy):
    """DT with a causal reward estimator on its hidden states.

    The hidden state of s_t attends to those of a_0, …, a_t (keys and values). The result and the
    state together predict r_t, and the error also trains the shared blocks. The public code
    concatenates the hidden states of a_t and s_t instead, and never trains its reward head.
    """

    Config = CDT4RecConfig
    config: CDT4RecConfig
    reward_mean: Tensor
    reward_std: Tensor

    def __init__(self, config: CDT4RecConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        dim = config.dim
        self.register_buffer("reward_mean", torch.zeros(()))
        self.register_buffer("reward_std", torch.ones(()))
        self.attention = nn.MultiheadAttention(dim, config.heads, batch_first=True)
        self.estimate = nn.Sequential(nn.Linear(2 * dim, dim), nn.ReLU(), nn.Linear(dim, 1))

    def start_from(self, train: EpisodeStore) -> None:
        """Set the mean and standard deviation of the training rewards."""
        rewards = torch.from_numpy(train.step_values(schema.REWARD, *train.all_steps()))
        self.reward_mean.copy_(rewards.mean())
        self.reward_std.copy_(rewards.std(correction=0).clamp(min=1e-6))

    def estimated_rewards(self, hidden: Tensor, mask: Tensor) -> Tensor:
        """Estimates (B, K) of the logged actions' standardised rewards.

        Args:
            hidden: (B, 3K, d) outputs of `transform`.
            mask: (B, K) bool, false at padding.
        """
        states, actions = hidden[:, 1::3], hidden[:, 2::3]
        length = mask.shape[1]
        later = torch.ones(length, length, dtype=torch.bool, device=mask.device).triu(1)
        diagonal = torch.eye(length, dtype=torch.bool, device=mask.device)
        hidden_keys = (later | ~mask.unsqueeze(1)) & ~diagonal  # (B, K, K)
        attended, _ = self.attention(
            states,
            actions,
            actions,
            attn_mask=hidden_keys.repeat_interleave(self.config.heads, dim=0),
            need_weights=False,
        )
        return self.estimate(torch.cat([attended, states], dim=-1)).squeeze(-1)  # type: ignore[no-any-return]

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Action loss plus weighted reward loss over all steps, and scalars to log."""
        mask = windows.mask
        normalized = self.normalize(windows)
        hidden = self.transform(normalized)
        imitation, scalars = self.imitation(hidden[:, 1::3], normalized)
        rewards = (windows.rewards - self.reward_mean) / self.reward_std
        reward_loss = (self.estimated_rewards(hidden, mask) - rewards).square()[mask].mean()
        return imitation + self.config.reward_weight * reward_loss, {
            **scalars,
            "reward_loss": reward_loss.detach(),
        }
