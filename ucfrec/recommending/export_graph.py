"""The graph of a trained policy under its rule, for export: from a session to scores of items.

It is built from the trained parts. Where these use operations that ONNX lacks or whose result has a
size that depends on the data (finding non-zero entries, sparse products), the same sums are written
another way here.
"""

import copy
from dataclasses import replace
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.sessions import Sessions
from ucfrec.episodes.exposure import GAIN, ExposureTerm, Likeness, Shown
from ucfrec.errors import InputError
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.user_model.reward import ItemRewardModel

INPUTS: Final = ("items", "rewards", "steps", "collected", "users", "excluded", "observations")
OUTPUTS: Final = ("scores", "top_items", "top_scores")
_CHUNK: Final = 2**16
"""Items among which the best are looked for at once."""


class RuleGraph(nn.Module):
    """Scores of all items for B sessions, as `Decider.scores`, and the `k` best."""

    def __init__(self, trained: TrainedPolicy, rule: DecisionRule, k: int) -> None:
        """
        Args:
            trained: a policy of items.
            rule: its decision rule.
            k: number of items to choose.

        Raises:
            InputError: the policy has vector actions, or scores items in a way of its own.
        """
        super().__init__()
        states, policy = trained.item_states, trained.policy
        if states is None or not isinstance(policy.head, ItemHead):
            raise InputError(
                "this policy's actions are vectors; only policies of items can be exported"
            )
        if type(policy).act is not SequencePolicy.act:
            raise InputError(
                f"policies of kind {trained.name!r} score items in a way of their own, which "
                "cannot be exported; train one that predicts from a sequence, such as ucf, dt or bc"
            )
        self.n_items = len(states.embeddings)
        if not 1 <= k <= min(self.n_items, _CHUNK):
            most = min(self.n_items, _CHUNK)
            raise InputError(f"--k is {k}; give a whole number from 1 to {most:,}")
        decider = trained.decider(rule)
        self.states, self.k = states, k
        self.context, self.observation_size = (
            policy.config.context,
            trained.record.observation_size,
        )
        self.head = _Head(policy.head)
        self.policy = _with_head(policy, self.head)
        self.reward = None if not rule.reward_weight else _Reward(decider.reward_model)
        self.tags = _Likeness(decider.likeness) if rule.tag_window else None
        self.main_tags = decider.main_tags
        if self.main_tags is not None:
            self.register_buffer("main_tag", self.main_tags.tags)
        self._decider = replace(decider, policy=self.policy)
        self._rule = decider.rule
        reach = self.context - 1 + states.window
        self.length = max(reach, decider.reach)
        """L, items before the step that are read."""

    def forward(
        self,
        items: Tensor,
        rewards: Tensor,
        steps: Tensor,
        collected: Tensor,
        users: Tensor,
        excluded: Tensor,
        observations: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Scores (B, n_items), the k best items (B, k) and their log-probabilities (B, k).

        Args:
            items: (B, L) int64 items shown in the session, the latest last; −1 before it began.
            rewards: (B, L) float32, 0 before the session began.
            steps: (B,) int64 number of items that the session has shown.
            collected: (B,) float64 sum of the session's rewards.
            users: (B,) int64 numbers of the users in the training logs, −1 for others.
            excluded: (B, E) int64 items that may not be shown; padded with −1.
            observations: (B, K, O) float32 of the last K steps, the one to decide included; None if
                the policy has none.
        """
        sessions = Sessions(items, rewards, steps, collected, users, observations)
        windows = self._decider.asked(sessions.windows(self.states, self.context), collected)
        normalized = self.policy.normalized(windows)
        features = self.policy.last_features(normalized)
        shown = sessions.shown
        scores = self.head.logits(features, shown, normalized.returns_to_go[:, -1])
        if self.reward is not None:
            scores = scores + self._rule.reward_weight * self.reward(
                windows.states[:, -1], shown, users
            )
        scores = _put(scores, excluded, torch.full_like(excluded, -torch.inf, dtype=scores.dtype))
        if self.tags is not None:
            scores = self._without_recent_tags(scores, shown)
        if self.main_tags is not None:
            main = self.get_buffer("main_tag")
            tired = replace(self.main_tags, tags=main).tired(shown, self._rule.tag_run).unsqueeze(1)
            scores = _left(scores, (main == tired) & (tired >= 0))
        return scores, *_best(scores, self.k)

    def _without_recent_tags(self, scores: Tensor, shown: Shown) -> Tensor:
        assert self.tags is not None
        recent = shown.items[:, : self._rule.tag_window]
        alike = self.tags.to_all(recent, torch.ones_like(recent, dtype=scores.dtype))
        return _left(scores, alike > 0)


def _left(scores: Tensor, without: Tensor) -> Tensor:
    """Scores (B, n_items) with −∞ where `without`, but in rows where nothing would remain."""
    left = scores.masked_fill(without, -torch.inf)
    none = left.amax(1, keepdim=True) == -torch.inf
    return torch.where(none, scores, left)


def _with_head(policy: SequencePolicy, head: "_Head") -> SequencePolicy:
    """The policy with another head; all else is shared."""
    other = copy.copy(policy)
    other._modules = {**policy._modules, "head": head}
    return other


def _put(scores: Tensor, items: Tensor, values: Tensor) -> Tensor:
    """Scores (B, n) with values (B, N) in the places of items (B, N), but for items −1."""
    places = torch.where(items < 0, scores.shape[1], items)
    return F.pad(scores, (0, 1)).scatter(1, places, values)[:, :-1]


def _added(scores: Tensor, items: Tensor, values: Tensor) -> Tensor:
    """Scores (B, n) with values (B, N) added in the places of items (B, N), but for items −1."""
    places = torch.where(items < 0, scores.shape[1], items)
    return F.pad(scores, (0, 1)).scatter_add(1, places, values)[:, :-1]


def _best(scores: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The k best items (B, k), −1 where fewer are left, and their log-probabilities (B, k).

    Exact: the best of all are among the best of each chunk.
    """
    n = scores.shape[1]
    chunks = -(-n // _CHUNK)
    if chunks > 1:
        padded = F.pad(scores, (0, chunks * _CHUNK - n), value=-torch.inf)
        best = padded.view(-1, chunks, _CHUNK).topk(k, dim=-1)
        offsets = torch.arange(0, chunks * _CHUNK, _CHUNK).view(1, -1, 1)
        numbers = (best.indices + offsets).flatten(1)
        values, places = best.values.flatten(1).topk(k, dim=-1)
        items = numbers.gather(1, places)
    else:
        values, items = scores.topk(k, dim=-1)
    left = values > -torch.inf
    highest = torch.where(left[:, :1], values[:, :1], 0.0)
    total = (scores - highest).exp().sum(1, keepdim=True).log() + highest
    return torch.where(left, items, -1), torch.where(left, values - total, -torch.inf)


class _Head(nn.Module):
    """The item head, with the vectors of all items computed once."""

    def __init__(self, head: ItemHead) -> None:
        super().__init__()
        with torch.no_grad():
            vectors = head.all_vectors()
        self.register_buffer("vectors", vectors.detach())
        self.register_buffer("bias", head.bias.detach())
        self.exposure = None if head.exposure is None else _Exposure(head.exposure)

    def embed(self, actions: Tensor) -> Tensor:
        """Embed int64 items (B, K) as (B, K, d)."""
        return self.get_buffer("vectors")[actions]

    def logits(self, features: Tensor, shown: Shown, returns: Tensor) -> Tensor:
        """Logits (B, n_items) from features (B, d); returns-to-go (B,) are normalised."""
        vectors, bias = self.get_buffer("vectors"), self.get_buffer("bias")
        logits: Tensor = features @ vectors.T / features.shape[-1] ** 0.5 + bias
        if self.exposure is not None:
            logits = self.exposure(logits, shown, returns)
        return logits


class _Likeness(nn.Module):
    """Sums of likeness, see `Likeness`, read from the items' tags instead of multiplied."""

    def __init__(self, likeness: Likeness | None) -> None:
        super().__init__()
        assert likeness is not None
        self.n_tags = int(likeness.n_tags) if likeness.tags.shape[1] else 0
        tags = likeness.tags
        self.register_buffer("tags", torch.where(tags < 0, self.n_tags, tags))
        self.register_buffer("directions", likeness.directions)

    def to_all(self, items: Tensor, weights: Tensor) -> Tensor:
        """Likeness (B, n_items) of all items to items (B, N), weighted by weights (B, N)."""
        weights = weights.masked_fill(items < 0, 0.0)
        items = items.clamp(min=0)
        if not self.n_tags:
            directions = self.get_buffer("directions")
            profile = (weights.unsqueeze(1) @ directions[items]).squeeze(1)
            return profile @ directions.T
        tags = self.get_buffer("tags")
        places = tags[items].flatten(1)
        spread = weights.unsqueeze(-1).expand(-1, -1, tags.shape[1]).flatten(1)
        empty = weights.new_zeros(items.shape[0], self.n_tags + 1)
        # Padding has a place of its own, which is read as 0.
        profile = F.pad(empty.scatter_add(1, places, spread)[:, :-1], (0, 1))
        columns = [profile.index_select(1, tags[:, n]) for n in range(tags.shape[1])]
        return torch.stack(columns).sum(0)


class _Exposure(nn.Module):
    """The exposure term of a policy; see `ExposureTerm`."""

    def __init__(self, term: ExposureTerm) -> None:
        super().__init__()
        self.lags, self.likeness = term.lags, _Likeness(term.likeness)
        self.low, self.high = float(term.reward_low), float(term.reward_high)
        self.first, self.last = float(term.knots[0]), float(term.knots[-1])
        self.register_buffer("knots", term.knots)
        self.register_buffer("table", (GAIN * (term.common + term.by_lag)).detach())

    def forward(self, logits: Tensor, shown: Shown, returns: Tensor) -> Tensor:
        """Logits (B, n_items) with the additions of what was shown."""
        items, rewards = shown.items[:, : self.lags], shown.rewards[:, : self.lags]
        knots, table = self.get_buffer("knots"), self.get_buffer("table")
        at = returns.clamp(self.first, self.last)
        right = (knots.unsqueeze(0) < at.unsqueeze(1)).sum(1).clamp(1, len(knots) - 1)
        low, high = knots[right - 1], knots[right]
        share = ((at - low) / (high - low)).view(1, -1, 1)
        weights = table.index_select(1, right - 1) * (1 - share)
        weights = weights + table.index_select(1, right) * share
        liked = ((rewards - self.low) / (self.high - self.low)).clamp(0, 1)
        repeated, alike = weights[0] + weights[1] * liked, weights[2] + weights[3] * liked
        return _added(logits + self.likeness.to_all(items, alike), items, repeated)


class _Reward(nn.Module):
    """The reward model's scores of all items; see `ItemRewardModel.scores`."""

    def __init__(self, model: ItemRewardModel | None) -> None:
        super().__init__()
        assert model is not None
        self.model, self.lags, self.likeness = model, model.lags, _Likeness(model.likeness)

    def forward(self, states: Tensor, shown: Shown, users: Tensor) -> Tensor:
        items, repeated, alike = self.model.exposures(shown)
        added = _added(self.likeness.to_all(items, alike), items, repeated)
        tastes = self.model.tastes_after(shown)
        added = added + self.model.query(states, users, tastes) @ self.model.vectors.T
        return self.model.item + self.model.level(states, users, tastes).unsqueeze(1) + added
