"""One-step greed: the action with the highest predicted reward, as if sessions had no tomorrow."""

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
"""Logged action vectors to choose from."""
_PAIRS: Final = 2**15
"""Pairs of state and action judged at once."""


class CRMGreedyPolicy(SequencePolicy):
    """Chooses argmax_a E[r | s, a] of the reward model's first part (`CRMConfig.mean_first`).

    Disturbances are at their prior mean, since nobody knows tomorrow's. The model is trained here,
    by squared error on standardised rewards. Items are judged by their embeddings, all of them;
    of vectors, actions that were logged are, as beyond them the model knows nothing.
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
        """Take the candidates and the rewards' mean and spread."""
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
        """Squared errors (B, K) of the standardised rewards."""
        states, actions = self.normalized(windows).states, windows.actions
        if not isinstance(self.head, VectorHead):
            actions = self.candidates[actions]
        predicted = self.model(torch.cat([states, actions], dim=-1)).squeeze(-1)
        standard = (windows.rewards - self.reward_mean) / self.reward_std
        return F.mse_loss(predicted, standard, reduction="none")

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean squared error over all steps of the windows."""
        value = self._errors(windows)[windows.mask].mean()
        return value, {"reward_loss": value.detach()}

    def action_loss(self, windows: Windows) -> Tensor:
        """The same at each window's last step."""
        return self._errors(windows)[:, -1].mean()

    def act(self, windows: Windows) -> Tensor:
        """Of the last step: predicted rewards of all items (B, n_items), or vectors (B, A)."""
        states = self.normalized(windows).states[:, -1]
        values = self._values(states)
        if isinstance(self.head, VectorHead):
            return self.candidates[values.argmax(1)]
        return values

    def _values(self, states: Tensor) -> Tensor:
        """Of every candidate in every state, (B, n_candidates)."""
        first, *rest = self.model
        assert isinstance(first, nn.Linear)
        # The first layer is linear, so that its two halves are computed once a state and once a
        # candidate instead of once a pair.
        size = states.shape[1]
        offered = F.linear(self.candidates, first.weight[:, size:], first.bias)
        known, after = F.linear(states, first.weight[:, :size]), nn.Sequential(*rest)
        chunks = torch.split(known, max(1, _PAIRS // len(offered)))
        return torch.cat([after(rows.unsqueeze(1) + offered).squeeze(-1) for rows in chunks])
