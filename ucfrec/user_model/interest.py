"""Interests of users: what they rewarded more than others do, until a decision."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.arrays import IntArray
from ucfrec.episodes.store import EpisodeStore

_PRIOR = 4.0
"""Rows of a variance of 1 that are added to those of a user."""
_AT_ONCE = 2**17
"""Rows that are summed at once."""


class ShownTastes(nn.Module):
    """What users have shown, which counts in scores with weights."""

    def __init__(self, *shape: int) -> None:
        super().__init__()
        self.weights = nn.Buffer(torch.zeros(shape))
        self.are_known = False
        """Whether any weight differs from 0: a graph that is exported cannot ask a tensor."""

    def weigh(self, weights: Tensor) -> None:
        """Set the weights, or a scalar for all."""
        self.weights.copy_(weights.expand_as(self.weights))
        self.are_known = bool(self.weights.any())

    def _load_from_state_dict(self, *arguments: Any, **options: Any) -> None:
        super()._load_from_state_dict(*arguments, **options)
        if not self.weights.is_meta:  # otherwise the file lacks them, which is said later
            self.weigh(self.weights)


class Interests(ShownTastes):
    """Running rates of user × attribute: what a user adds to the scores of items with a vector.

    Of the rows r of a user until a decision, t_r is the target, t̄_r what its item usually gets, and
    v_r the variance of such a target: the user's rates are (Σ (t_r − t̄_r) (1, e_r)) / (Σ v_r + 4),
    e_r being the vector of the item. Weights turn these D + 1 numbers into level and affinity.
    """

    def __init__(self, users: int, items: int, embedding_size: int) -> None:
        super().__init__(embedding_size + 1)
        self.usual = nn.Buffer(torch.zeros(items))
        """What every item usually gets, as `ItemRewardModel.target`."""
        self.sums = nn.Buffer(torch.zeros(users, embedding_size + 2))
        """Sums of `sum_rows` of the training rows of every user."""
        self.until = nn.Buffer(torch.zeros((), dtype=torch.int64))
        """Time, ms, of the last of these rows; 0 without any."""

    def add_rows(
        self,
        view: EpisodeStore,
        target: Callable[[Tensor], Tensor],
        sum_rows: Callable[[Tensor, Tensor], Tensor],
    ) -> None:
        """Add all rows of a view, whose rewards `target` turns into what is predicted."""
        users = torch.from_numpy(view.episode_values(schema.USER)).long()
        for episodes, steps in view.step_batches(_AT_ONCE):
            items, rewards, times = (
                torch.from_numpy(view.step_values(name, episodes, steps))
                for name in (schema.ITEM, schema.REWARD, schema.TIMESTAMP)
            )
            rows = sum_rows(items.long().unsqueeze(1), target(rewards).unsqueeze(1))
            # Unknown users, −1, are the last row.
            self.sums.index_add_(0, users[episodes] % len(self.sums), rows)
            self.until.clamp_(min=times.max())
        self.sums[-1] = 0.0

    def count_trained(
        self,
        users: Tensor,
        owner: IntArray,
        times: IntArray,
    ) -> Tensor:
        """How many of N rows, at `times` (N,), of the sessions (N,) `owner` of users (B,), are no
        later than training, whose rows the sums of known users hold: (B,) int64."""
        known = (times <= int(self.until)) & (users.numpy()[owner] >= 0)
        return torch.from_numpy(np.bincount(owner[known], minlength=len(users)))

    def sum_rows(
        self,
        items: Tensor,
        targets: Tensor,
        vectors: Tensor,
        binary: Tensor,
    ) -> Tensor:
        """Sums (B, D + 2) over the rows of users, of (t − t̄) (1, e), and of v, for items (B, N),
        −1 for none, with targets (B, N), from 0 to 1 if `binary`, or standardised, and the vectors
        (n_items, D) of all items."""
        valid, items = items >= 0, items.clamp(min=0)
        usual = self.usual[items]
        unusual = ((targets - usual) * valid).unsqueeze(1)
        variance = torch.where(binary, usual * (1 - usual), 1.0) * valid
        of_vectors = (unusual @ vectors[items]).squeeze(1)
        return torch.cat([unusual.sum(2), of_vectors, variance.sum(1, keepdim=True)], 1)

    def rates(self, sums: Tensor) -> Tensor:
        """Rates (B, D + 1) of users with these sums (B, D + 2)."""
        return sums[:, :-1] / (sums[:, -1:] + _PRIOR)


def find_user_rows(view: EpisodeStore) -> EpisodeStore | None:
    """The sessions of a view but for very long ones; None if it names no users or times."""
    if view.has_users and schema.TIMESTAMP in view.record.columns:
        return view.without_long_sessions()
    return None


def sum_before(
    view: EpisodeStore,
    users: Tensor,
    times: Tensor,
    target: Callable[[Tensor], Tensor],
    sum_rows: Callable[[Tensor, Tensor], Tensor],
) -> Tensor:
    """Sums (M, D + 2) of the rows of users (M,), −1 for none, before times (M,), int64 ms; `target`
    turns the rewards of the view into what is predicted."""
    asked_users = users.numpy()
    asked_times = times.numpy()
    nothing = sum_rows(torch.full((1, 1), -1), torch.zeros(1, 1))
    sums = nothing.double().repeat(len(users), 1)
    owners = view.episode_values(schema.USER)
    followed = np.flatnonzero(np.isin(owners, asked_users[asked_users >= 0]))
    view = view.select(followed)
    for episodes, steps in view.step_batches(_AT_ONCE):
        owner = owners[followed[episodes]]
        moments, items, rewards = (
            view.step_values(name, episodes, steps)
            for name in (schema.TIMESTAMP, schema.ITEM, schema.REWARD)
        )
        queries = np.flatnonzero(np.isin(asked_users, owner))
        # By user and time, what is asked before what was shown at the same time.
        both = np.concatenate([asked_users[queries], owner])
        moments = np.concatenate([asked_times[queries], moments])
        is_row = np.arange(len(both)) >= len(queries)
        order = np.lexsort((is_row, moments, both))
        rows = order[is_row[order]] - len(queries)
        earned = target(torch.from_numpy(rewards[rows]))
        numbers = torch.from_numpy(items[rows].astype(np.int64))
        totals = sum_rows(numbers.unsqueeze(1), earned.unsqueeze(1))
        totals = F.pad(totals.double().cumsum(0), (0, 0, 1, 0))
        counts = np.append(0, is_row[order].cumsum())
        first = np.searchsorted(both[order], asked_users[queries])
        last = np.argsort(order)[: len(queries)]
        sums[queries] += totals[counts[last]] - totals[counts[first]]
    return sums.float()
