"""Greedy policy: the action with the highest predicted immediate reward."""

from collections.abc import Mapping
from typing import Final

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.counterfactual.reward_model import mlp
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import PolicyConfig, SequencePolicy
from ucfrec.policies.heads import VectorHead

_CANDIDATES: Final = 512
"""Number of logged action vectors to choose from."""
_PAIRS: Final = 2**15
"""Pairs of state and action that are evaluated at once."""


class CRMGreedyPolicy(SequencePolicy):
    """Chooses argmax_a E[r | s, a] of the reward model's first part (`CRMConfig.mean_first`).

    Disturbances are set to their prior mean, because future ones are unknown. The model is trained
    here, by squared error on standardised rewards. The candidates are all items, represented by
    their embeddings, or a sample of the logged action vectors, beyond which the model has no data.
    """

    reward_mean: Tensor
    reward_std: Tensor
    candidates: Tensor

    def __init__(self, config: PolicyConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        self.model = mlp(sizes["state"] + sizes["action"], config.dim, 2, 1)
        for name in ("reward_mean", "reward_std"):
            self.register_buffer(name, torch.zeros(()))
        count = sizes["items"] or _CANDIDATES
        self.register_buffer("candidates", torch.zeros(count, sizes["action"]))

    def start_from(self, train: EpisodeStore) -> None:
        """Set the candidates, and the mean and standard deviation of the rewards."""
        episodes, steps = train.all_steps()
        rewards = train.step_values(schema.REWARD, episodes, steps)
        self.reward_mean.fill_(float(rewards.mean()))
        self.reward_std.fill_(max(float(rewards.std()), 1e-6))
        if isinstance(self.head, VectorHead):
            drawn = np.random.default_rng(0).integers(len(episodes), size=_CANDIDATES)
            actions = train.step_values(schema.ACTION, episodes[drawn], steps[drawn])
            self.candidates.copy_(torch.from_numpy(actions))
        else:
            self.candidates.copy_(self.head.embeddings)

    def features(self, windows: Windows) -> Tensor:
        """Standardised states (B, K, S)."""
        return windows.states

    def _errors(self, windows: Windows) -> Tensor:
        """Squared errors (B, K) of the predicted standardised rewards."""
        states, actions = self.normalized(windows).states, windows.actions
        if not isinstance(self.head, VectorHead):
            actions = self.candidates[actions]
        predicted = self.model(torch.cat([states, actions], dim=-1)).squeeze(-1)
        standard = (windows.rewards - self.reward_mean) / self.reward_std
        return F.mse_loss(predicted, standard, reduction="none")

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean squared error of standardised rewards over all steps, and scalars to log."""
        value = self._errors(windows)[windows.mask].mean()
        return value, {"reward_loss": value.detach()}

    def action_loss(self, windows: Windows) -> Tensor:
        """Mean squared error of standardised rewards over the windows' last steps."""
        return self._errors(windows)[:, -1].mean()

    def act(self, windows: Windows) -> Tensor:
        """At the last step: predicted standardised rewards of all items (B, n_items), or the best
        action vectors (B, A)."""
        states = self.normalized(windows).states[:, -1]
        values = self._values(states)
        if isinstance(self.head, VectorHead):
            return self.candidates[values.argmax(1)]
        return values

    def _values(self, states: Tensor) -> Tensor:
        """Predicted standardised rewards (B, n_candidates) in states (B, S)."""
        first, *rest = self.model
        assert isinstance(first, nn.Linear)
        # The first layer is linear: its state part is computed once per state and its action part
        # once per candidate, instead of both once per pair.
        size = states.shape[1]
        of_actions = F.linear(self.candidates, first.weight[:, size:], first.bias)
        of_states, remaining = F.linear(states, first.weight[:, :size]), nn.Sequential(*rest)
        chunks = torch.split(of_states, max(1, _PAIRS // len(of_actions)))
        return torch.cat([remaining(rows.unsqueeze(1) + of_actions).squeeze(-1) for rows in chunks])
