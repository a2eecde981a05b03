"""A gradient-boosted click model on rates and likeness: the usual ranker of clicks in practice."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, IntArray
from ucfrec.episodes.states import TrainingCounts, least_liked, liked_rewards
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import PolicyConfig, SequencePolicy, require_items
from ucfrec.policies.baselines import PRIOR
from ucfrec.settings import settings_table
from ucfrec.user_model.session_end import LEAVES, TREES, fit_trees

_MAX_ROWS: Final = 300_000
_AT_ONCE: Final = 4096
_FOLDS: Final = 5
_DECIMALS: Final = 3
_SPLITS: Final = LEAVES - 1


@settings_table("policy")
class BoostedConfig(PolicyConfig):
    """Settings of the boosted click model; `context` − 1 is the number of items of history."""

    boosted: Annotated[int, Field(ge=1, le=10**6)] = 256
    """Items that the trees score, those with the highest rates; others have the item's rate."""


class BoostedPolicy(SequencePolicy):
    """Scores items by the log-odds of a like, predicted by gradient-boosted trees.

    The trees (scikit-learn's histogram boosting) see the item's rate of likes and its count in the
    training rows, the session's rate, its length and whether its last item was liked, the likeness
    of the item to those that were liked, to all and to the last one, and the rate of likes among
    the session's items with the same first tag. In training, an item's rate is that of other folds
    of the episodes, because its own row would tell the trees what they predict. States and returns
    are not used.
    """

    Config = BoostedConfig
    config: BoostedConfig
    impressions: Tensor
    liked: Tensor
    directions: Tensor
    tag: Tensor
    reward_low: Tensor
    reward_high: Tensor
    split_inputs: Tensor
    split_thresholds: Tensor
    leaves: Tensor
    base: Tensor

    def __init__(self, config: BoostedConfig, sizes: Mapping[str, int]) -> None:
        require_items("boosted", sizes)
        super().__init__(config, sizes)
        n_items, splits = sizes["items"], (_SPLITS, TREES)
        for name, value in (
            ("impressions", torch.zeros(n_items)),
            ("liked", torch.zeros(n_items)),
            ("directions", torch.zeros(n_items, sizes["action"])),
            ("tag", torch.arange(n_items)),
            ("reward_low", torch.zeros(())),
            ("reward_high", torch.zeros(())),
            ("split_inputs", torch.zeros(splits, dtype=torch.int64)),
            ("split_thresholds", torch.zeros(splits)),
            ("leaves", torch.zeros(TREES, 2**_SPLITS)),
            ("base", torch.zeros(())),
        ):
            self.register_buffer(name, value)

    def start_from(self, train: EpisodeStore) -> None:
        """Set counts, directions and first tags of the items, and the range of the rewards."""
        counts, states = TrainingCounts.of(train), train.item_states
        self.impressions.copy_(counts.shown)
        self.liked.copy_(counts.liked)
        self.directions.copy_(F.normalize(states.embeddings, dim=1))
        if states.tags.shape[1]:
            self.tag.copy_(states.tags[:, 0])
        rewards = train.column(schema.REWARD)
        self.reward_low.fill_(float(rewards.min()))
        self.reward_high.fill_(float(rewards.max()))

    def make_solver(
        self, train: EpisodeStore, validation: EpisodeStore | None, folder: Path, seed: int
    ) -> Callable[[], None]:
        """Fits the trees."""

        def solve() -> None:
            steps = np.arange(train.n_steps)
            if len(steps) > _MAX_ROWS:
                sample = np.random.default_rng(seed).choice(len(steps), _MAX_ROWS, replace=False)
                steps = np.sort(sample)
            inputs, liked = self._rows(train, steps)
            trees = fit_trees(inputs, liked, seed)
            self.base.copy_(trees["base"])
            count = len(trees["leaves"])
            self.leaves[:count] = trees["leaves"]
            self.split_inputs[:, :count] = trees["inputs"].T
            self.split_thresholds[:, :count] = trees["thresholds"].T

        return solve

    def _rows(self, train: EpisodeStore, numbers: IntArray) -> tuple[Array, BoolArray]:
        """Inputs (M, F) of the trees at training steps (M,), and which were liked."""
        folds = np.arange(train.n_episodes) % _FOLDS
        whole, in_folds = torch.stack([self.impressions, self.liked]).cpu(), list[Tensor]()
        for fold in range(_FOLDS):
            of_fold = TrainingCounts.of(train.select(np.flatnonzero(folds == fold)))
            in_folds.append(whole - torch.stack([of_fold.shown, of_fold.liked]))
        counts = torch.stack(in_folds, dim=1)  # (2, folds, n_items), without the fold
        inputs, target = [], []
        for begin in range(0, len(numbers), _AT_ONCE):
            episodes, steps = train.locate(numbers[begin : begin + _AT_ONCE])
            windows = train.windows(episodes, steps, self.config.context)
            items = windows.actions[:, -1:]
            of_items = counts[:, torch.from_numpy(folds[episodes]).unsqueeze(1), items]
            device = self.impressions.device
            rows = self._inputs(windows.to(device), items.to(device), of_items.to(device))
            inputs.append(rows[:, 0].cpu().numpy())
            rewards = train.step_values(schema.REWARD, episodes, steps)
            target.append(liked_rewards(train, rewards))
        return np.concatenate(inputs), np.concatenate(target)

    def _rate(self, liked: Tensor, impressions: Tensor) -> Tensor:
        """Log-odds of rates of likes, shrunk to the mean by `PRIOR` rows."""
        mean = (self.liked.sum() + 0.5) / (self.impressions.sum() + 1)
        return torch.logit((liked + PRIOR * mean) / (impressions + PRIOR))

    def _inputs(self, windows: Windows, items: Tensor, counts: Tensor | None = None) -> Tensor:
        """Inputs (B, C, F) of the trees for C items at the windows' last steps.

        Args:
            windows: B windows; their last action and reward are not read.
            items: (C,), or (B, C) int64.
            counts: (2, B, C) how often the items were shown and liked; None for all training rows.
        """
        valid = windows.mask[:, :-1].float()  # (B, N)
        earlier, rewards = windows.actions[:, :-1], windows.rewards[:, :-1]
        liked = valid * (rewards >= least_liked(self.reward_low, self.reward_high))
        if counts is None:
            counts = torch.stack([self.impressions[items], self.liked[items]])
        shown_of, liked_of = counts
        count, likes = valid.sum(1, keepdim=True), liked.sum(1, keepdim=True)
        cosines = self.directions[items] @ self.directions[earlier].mT  # (B, C, N)
        # Products of other batches differ in the last bits, which could change a tree's branch.
        cosines = _round(cosines)
        none = cosines.new_zeros(cosines.shape[:2])
        alike = self.tag[items].unsqueeze(-1) == self.tag[earlier].unsqueeze(1)
        tagged, liked_tagged = (
            (alike.float() @ weights.unsqueeze(-1)).squeeze(-1) for weights in (valid, liked)
        )
        whole = (likes + 1) / (count + 2)
        columns = (
            self._rate(liked_of, shown_of),
            torch.log1p(shown_of),
            self._rate(likes, count),
            count,
            liked[:, -1:] - 1 + valid[:, -1:] if earlier.shape[1] else none[:, :1],
            _round((cosines @ liked.unsqueeze(-1)).squeeze(-1) / likes.clamp(min=1)),
            _round((cosines @ valid.unsqueeze(-1)).squeeze(-1) / count.clamp(min=1)),
            cosines[..., -1] * valid[:, -1:] if earlier.shape[1] else none,
            torch.logit((liked_tagged + 2 * whole) / (tagged + 2)),
            tagged,
        )
        return torch.stack([weights.expand_as(none) for weights in columns], dim=-1)

    def _score(self, windows: Windows, items: Tensor) -> Tensor:
        """Log-odds (B, C) of a like of items as of `_inputs`."""
        inputs = self._inputs(windows, items)
        scores = []
        for rows in torch.split(inputs.flatten(0, 1), _AT_ONCE):
            columns = rows.T.contiguous()
            which = torch.zeros(TREES, len(rows), dtype=torch.int64, device=rows.device)
            for split in range(_SPLITS):
                left = columns[self.split_inputs[split]] <= self.split_thresholds[split, :, None]
                which |= left.long() << split
            scores.append(self.leaves.gather(1, which).sum(0))
        return self.base + torch.cat(scores).view(inputs.shape[:2])

    def features(self, windows: Windows) -> Tensor:
        """(B, K, d) of zeros; the policy scores items in a way of its own."""
        return windows.states.new_zeros(*windows.mask.shape, self.config.dim)

    @torch.no_grad()
    def act(self, windows: Windows) -> Tensor:
        """Log-odds of a like of all items at the last step, (B, n_items)."""
        rates = self._rate(self.liked, self.impressions)
        best = rates.topk(min(self.config.boosted, len(rates))).indices
        boosted = self._score(windows, best)
        # Others have their rate and what the session adds to those that the trees score.
        added = (boosted - rates[best]).mean(1, keepdim=True)
        return (rates + added).index_copy(1, best, boosted)

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """See `action_loss`."""
        value = self.action_loss(windows)
        return value, {"like_loss": value.detach()}

    def action_loss(self, windows: Windows) -> Tensor:
        """Mean log loss (nats) of likes at the windows' last steps."""
        least = least_liked(self.reward_low, self.reward_high)
        liked = (windows.rewards[:, -1] >= least).float()
        scores = self._score(windows, windows.actions[:, -1:])[:, 0]
        return F.binary_cross_entropy_with_logits(scores, liked)


def _round(values: Tensor) -> Tensor:
    return torch.round(values, decimals=_DECIMALS)
