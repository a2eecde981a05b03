"""Item-based nearest neighbours (Sarwar et al., 2001): items liked in the same sessions."""

from collections.abc import Mapping
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.base import PolicyConfig, SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.settings import settings_table

_ROWS = 1024


@settings_table("policy")
class ItemKNNConfig(PolicyConfig):
    """Settings of the nearest neighbours; of the general ones, only `context` matters."""

    neighbors: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    """Items with the highest cosines that count for each item; all, of a smaller catalogue."""


class ItemKNNPolicy(SequencePolicy):
    """Scores items by their cosine to what the session so far liked, weighted by reward.

    Cosines are of the columns of the session × item matrix of rewards above the lowest one. Only a
    temperature and each item's bias are learned by gradient; states and returns do not enter.
    """

    Config = ItemKNNConfig
    config: ItemKNNConfig
    neighbors: Tensor
    cosines: Tensor
    reward_low: Tensor

    def __init__(self, config: ItemKNNConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        if not isinstance(self.head, ItemHead):
            raise InputError("item-knn recommends items; this store's actions are vectors")
        shape = (sizes["items"], min(config.neighbors, sizes["items"]))
        self.register_buffer("neighbors", torch.zeros(shape, dtype=torch.int64))
        self.register_buffer("cosines", torch.zeros(shape))
        self.register_buffer("reward_low", torch.zeros(()))
        self.temperature = nn.Parameter(torch.ones(()))

    def start_from(self, train: EpisodeStore) -> None:
        """Find the neighbours of every item, itself among them."""
        from scipy import sparse  # reading a trained policy does without

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

    def features(self, windows: Windows) -> Tensor:
        """(B, K, n_items) summed cosines to the items before, weighted by reward.

        Takes windows as they are: rewards are not normalised.
        """
        weights = (windows.rewards - self.reward_low) * windows.mask
        given = self.cosines[windows.actions] * weights.unsqueeze(-1)  # (B, K, neighbours)
        scores = given.new_zeros(*windows.mask.shape, len(self.cosines))
        scores.scatter_add_(-1, self.neighbors[windows.actions], given)
        return scores.cumsum(1) - scores

    def _logits(self, windows: Windows) -> Tensor:
        assert isinstance(self.head, ItemHead)
        return self.temperature * self.features(windows) + self.head.bias

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Negative log-likelihood of the logged items."""
        value = F.cross_entropy(self._logits(windows)[windows.mask], windows.actions[windows.mask])
        return value, {"action_loss": value.detach()}

    def action_loss(self, windows: Windows) -> Tensor:
        """The same at each window's last step."""
        return F.cross_entropy(self.act(windows), windows.actions[:, -1])

    def act(self, windows: Windows) -> Tensor:
        """Logits over items at the last step (B, n_items)."""
        return self._logits(windows)[:, -1]
