"""Item-based nearest neighbours (Sarwar et al., 2001): items liked in the same sessions."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import PolicyConfig, SequencePolicy, require_items
from ucfrec.policies.heads import ItemHead
from ucfrec.settings import settings_table

_ROWS = 1024
_HOTTEST = 64.0
"""Largest factor on the cosines."""
_HALVINGS = 30


@settings_table("policy")
class ItemKNNConfig(PolicyConfig):
    """Settings of item-kNN; of the general policy settings, only `context` has an effect."""

    neighbors: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    """Neighbours of each item, those with the highest cosines; at most the number of items."""


class ItemKNNPolicy(SequencePolicy):
    """Scores items by their cosines to the session's earlier items, weighted by their rewards.

    Cosines are between columns of the session × item matrix of rewards minus the lowest reward.
    A bias per item, the log of its share of the training steps, is added to the cosines times a
    temperature, which is chosen on held-out steps. States and returns are not used.
    """

    Config = ItemKNNConfig
    chosen = ("temperature",)
    config: ItemKNNConfig
    neighbors: Tensor
    cosines: Tensor
    reward_low: Tensor
    temperature: Tensor

    def __init__(self, config: ItemKNNConfig, sizes: Mapping[str, int]) -> None:
        require_items("item-knn", sizes)
        super().__init__(config, sizes)
        shape = (sizes["items"], min(config.neighbors, sizes["items"]))
        self.register_buffer("neighbors", torch.zeros(shape, dtype=torch.int64))
        self.register_buffer("cosines", torch.zeros(shape))
        self.register_buffer("reward_low", torch.zeros(()))
        self.register_buffer("temperature", torch.ones(()))

    def start_from(self, train: EpisodeStore) -> None:
        """Find the neighbours of every item; an item is a neighbour of itself."""
        # Imported here because loading a trained policy does not need scipy.
        from scipy import sparse

        episodes, steps = train.all_steps()
        items = train.step_values(schema.ITEM, episodes, steps)
        rewards = train.step_values(schema.REWARD, episodes, steps)
        self.reward_low.fill_(float(rewards.min()))
        shape = (train.n_episodes, len(self.cosines))
        liked = sparse.csr_matrix((rewards - rewards.min(), (episodes, items)), shape=shape)
        lengths = np.sqrt(np.asarray(liked.multiply(liked).sum(axis=0))).ravel()
        columns = (liked @ sparse.diags(1 / np.where(lengths > 0, lengths, 1.0))).tocsc()
        for start in range(0, shape[1], _ROWS):
            rows = slice(start, start + _ROWS)
            cosines = torch.from_numpy((columns[:, rows].T @ columns).toarray()).float()
            self.cosines[rows], self.neighbors[rows] = cosines.topk(self.cosines.shape[1])

    def make_solver(
        self, train: EpisodeStore, validation: EpisodeStore | None, folder: Path, seed: int
    ) -> Callable[[], None]:
        """Chooses the temperature; everything else is set by `start_from`."""
        return lambda: None if validation is None else self._choose_temperature(validation)

    @torch.no_grad()
    def _choose_temperature(self, held_out: EpisodeStore) -> None:
        """Minimise the negative log-likelihood, convex in the temperature, by bisection."""
        numbers = np.linspace(0, held_out.n_steps - 1, min(held_out.n_steps, _ROWS), dtype=np.int64)
        windows = held_out.windows(*held_out.locate(numbers), self.config.context)
        windows = windows.to(self.cosines.device)
        scores, shown = self.features(windows)[:, -1], windows.actions[:, -1:]
        of_shown = scores.gather(1, shown).mean()
        assert isinstance(self.head, ItemHead)
        low, high = 0.0, _HOTTEST
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            expected = (middle * scores + self.head.bias).softmax(-1).mul(scores).sum(-1).mean()
            low, high = (low, middle) if expected > of_shown else (middle, high)
        self.temperature.fill_((low + high) / 2)

    def features(self, windows: Windows) -> Tensor:
        """Cosines to the earlier items, summed with their rewards as weights, (B, K, n_items).

        Windows must not be normalised.
        """
        weights = (windows.rewards - self.reward_low) * windows.mask
        weighted = self.cosines[windows.actions] * weights.unsqueeze(-1)  # (B, K, neighbours)
        scores = weighted.new_zeros(*windows.mask.shape, len(self.cosines))
        scores.scatter_add_(-1, self.neighbors[windows.actions], weighted)
        # Row t sums earlier steps only. Subtracting step t from its sum would round.
        return F.pad(scores.cumsum(1)[:, :-1], (0, 0, 1, 0))

    def similarity(self, items: Tensor, rewards: Tensor) -> Tensor:
        """Cosines to some items, summed with their rewards as weights, (B, n_items).

        Args:
            items: (B, N) int64; −1 for none.
            rewards: (B, N) of these, in reward units.
        """
        weights = (rewards - self.reward_low) * (items >= 0)
        known = items.clamp(min=0)
        weighted = (self.cosines[known] * weights.unsqueeze(-1)).flatten(1)
        scores = weighted.new_zeros(len(items), len(self.cosines))
        return scores.scatter_add_(1, self.neighbors[known].flatten(1), weighted)

    def _logits(self, windows: Windows) -> Tensor:
        assert isinstance(self.head, ItemHead)
        return self.temperature * self.features(windows) + self.head.bias

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean negative log-likelihood (nats) of the logged items, and scalars to log."""
        value = F.cross_entropy(self._logits(windows)[windows.mask], windows.actions[windows.mask])
        return value, {"action_loss": value.detach()}

    def action_loss(self, windows: Windows) -> Tensor:
        """Mean negative log-likelihood (nats) over the windows' last steps."""
        return F.cross_entropy(self.act(windows), windows.actions[:, -1])

    def act(self, windows: Windows) -> Tensor:
        """Logits over items at the last step, (B, n_items)."""
        return self._logits(windows)[:, -1]
