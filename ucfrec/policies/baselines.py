"""Simple policies: of the state, popularity, neighbours, factors, and boosted trees on rates."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float64Array, IntArray
from ucfrec.episodes.states import TrainingCounts, least_liked, liked_rewards
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Shown, Windows
from ucfrec.policies.base import Context, PolicyConfig, SequencePolicy, standardise
from ucfrec.policies.heads import VectorHead
from ucfrec.policies.ucf import Dropout
from ucfrec.settings import settings_table
from ucfrec.user_model.reward_report import draw_numbers
from ucfrec.user_model.running import HALF_LIVES_OF_DEMAND, fit_mixture
from ucfrec.user_model.session_end import LEAVES, TREES, BoostedTrees, fit_trees

PRIOR = 10.0
"""Steps at the mean rate that are added to every item's own."""
_SMOOTHING = 1.0
"""Likes that are added to all items together."""
_WITHIN = 0.999
"""Largest share of an action's range that the hyperbolic tangent of the head is to reach."""
_ROWS = 1024
_AT_ONCE = 2**24
"""Largest number of pairs of an item with a row, or with another item, in memory at once."""
_HOTTEST = 64.0
"""Largest factor on the cosines of neighbours."""
_HALVINGS = 30
_MAX_ROWS = 300_000
_ROWS_AT_ONCE = 4096
_FOLDS = 5
_LEARNING_RATE = 0.1
_PENALTY = 1000.0
"""L2 penalty of the regression on pairs of attributes."""
_PAIRS = 10
"""Number of the input that is the sum of the effects of pairs of attributes."""
_DECIMALS = 3
_SPLITS = LEAVES - 1
_TABLES = ("inputs", "thresholds", "leaves")

_Scored = Literal["steps", "likes", "rate"]
LikedOf = Callable[[EpisodeStore, Array], BoolArray]


@settings_table("policy")
class BCConfig(PolicyConfig):
    """Settings of behaviour cloning, a two-layer perceptron on the current state."""

    context: Context = 1
    """K, steps of a training window; each prediction uses its own state only."""


class BCPolicy(SequencePolicy):
    """Imitates the logging policy; returns-to-go and history are not used."""

    Config = BCConfig
    config: BCConfig

    def __init__(self, config: BCConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        dim = config.dim
        self.net = nn.Sequential(
            nn.Linear(sizes["state"], dim),
            nn.ReLU(),
            Dropout(config.dropout),
            nn.Linear(dim, dim),
            nn.ReLU(),
            nn.LayerNorm(dim),
        )

    def features(self, windows: Windows) -> Tensor:
        """Features (B, K, d), each from its own state."""
        return self.net(windows.states)  # type: ignore[no-any-return]


class ScoringPolicy(SequencePolicy):
    """Scores items in a way of its own, without features."""

    def features(self, windows: Windows) -> Tensor:
        """(B, K, d) of zeros."""
        return windows.states.new_zeros((*windows.mask.shape, self.config.dim))


class PopularPolicy(ScoringPolicy):
    """Scores items by their training rows, whatever the session shows: only biases matter.

    The score is the logarithm of the item's share of all `steps`, one step added to each item; the
    logarithm of its share of the `likes`; or the log-odds of its `rate` of liked steps. For action
    vectors, it is the mean logged action. With `steps`, an exposure term is learned by gradient.

    Where recent rows count more, a row that is h half-lives older than the last training row counts
    2^−h; rates have one half-life, shares of likes are a mixture of those of several.
    """

    scored_by: ClassVar[_Scored] = "steps"
    mixture: Tensor

    def __init__(self, config: PolicyConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        if self.chosen:
            self.register_buffer("mixture", torch.tensor(HALF_LIVES_OF_DEMAND).isinf().double())

    def make_solver(
        self,
        train: EpisodeStore,
        validation: EpisodeStore | None,
        folder: Path,
        seed: int,
    ) -> Callable[[], None] | None:
        """Sets the biases, unless settings add something to learn; likes are of items only."""
        config = self.config
        if self.scored_by != "steps":
            return lambda: self._set_scores(train, validation)
        if config.exposure:
            return None
        return lambda: self._set_mean(train)

    @torch.no_grad()
    def _set_mean(self, train: EpisodeStore) -> None:
        if isinstance(self.head, VectorHead):
            actions = torch.from_numpy(train.column(schema.ACTION))
            mean = actions.double().mean(0).to(self.head.scale) / self.head.scale
            inside = mean.clamp(-_WITHIN, _WITHIN)
            self.head.out.bias.copy_(torch.atanh(inside))

    @torch.no_grad()
    def _set_scores(self, train: EpisodeStore, validation: EpisodeStore | None) -> None:
        if self.chosen and validation is not None:
            self.mixture.copy_(self.choose_mixture(train, validation))
        mixture = self.mixture if self.chosen else None
        self.head.get_parameter("bias").copy_(self.scores_of(train, mixture))

    @classmethod
    def scores_of(
        cls,
        train: EpisodeStore,
        mixture: Tensor | None = None,
        liked_of: LikedOf = liked_rewards,
    ) -> Tensor:
        """Log-odds (n_items,) of the rate of likes, or logarithms of the shares of likes, with the
        weights (H,) of the half-lives; None for all rows alike."""
        if mixture is None:
            return cls._score(TrainingCounts.of(train, liked_of))
        weighted = zip(mixture.tolist(), HALF_LIVES_OF_DEMAND, strict=True)
        parts = [
            cls._score(TrainingCounts.of(train, liked_of, hours)).double() + math.log(weight)
            for weight, hours in weighted
            if weight
        ]
        return torch.stack(parts).logsumexp(0).float()

    @classmethod
    def _score(cls, counts: TrainingCounts) -> Tensor:
        if cls.scored_by == "rate":
            return torch.logit(shrink_rates(counts))
        likes = counts.liked.double() + _SMOOTHING / len(counts.liked)
        return torch.log(likes / likes.sum())

    @classmethod
    def choose_mixture(
        cls,
        train: EpisodeStore,
        validation: EpisodeStore,
        liked_of: LikedOf = liked_rewards,
    ) -> Tensor:
        """The weights (H,) of the half-lives with the lowest loss on validation episodes: that of
        likes by rates, where one half-life has all weight, otherwise that of the liked items."""
        counts = [TrainingCounts.of(train, liked_of, hours) for hours in HALF_LIVES_OF_DEMAND]
        scores = torch.stack([cls._score(totals).double() for totals in counts])
        held_out = TrainingCounts.of(validation, liked_of)
        likes = torch.where(counts[-1].shown > 0, held_out.liked, 0).double()
        if cls.scored_by == "likes":
            return torch.from_numpy(fit_mixture(scores.exp().numpy(), likes.numpy()))
        dislikes = held_out.shown - held_out.liked
        terms = held_out.liked * F.logsigmoid(scores)
        terms = terms + dislikes * F.logsigmoid(-scores)
        of_longest = terms.sum(1).flip(0)
        best = len(scores) - 1 - int(of_longest.argmax())  # of equal ones, the longest
        return F.one_hot(torch.tensor(best), len(scores)).double()


class ItemRatePolicy(PopularPolicy):
    """`PopularPolicy` by the rate of likes; with a tag window, a usual baseline."""

    items_only = "item-rate"
    scored_by = "rate"


class RecentRatePolicy(PopularPolicy):
    """`PopularPolicy` by the rate of likes, with the half-life that fits validation rows best."""

    items_only = "recent-rate"
    chosen = ("mixture",)
    scored_by: ClassVar[_Scored] = "rate"


class RecentClicksPolicy(RecentRatePolicy):
    """`PopularPolicy` by shares of likes, with the half-lives that fit validation rows best."""

    items_only = "recent-clicks"
    scored_by = "likes"


def shrink_rates(counts: TrainingCounts) -> Tensor:
    """Share of each item's training steps that were liked, (n_items,), with `PRIOR` steps at the
    mean, which has half a step of both outcomes more, so that no rate is 0 or 1."""
    impressions, liked = counts.shown.double(), counts.liked.double()
    mean = (liked.sum() + 0.5) / (impressions.sum() + 1)
    rates: Tensor = (liked + PRIOR * mean) / (impressions + PRIOR)
    return rates.float()


@settings_table("policy")
class ItemKNNConfig(PolicyConfig):
    """Settings of item-kNN; of the general policy settings, only `context` has an effect."""

    neighbors: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    """Neighbours of each item, those with the highest cosines; at most the number of items."""


class ItemKNNPolicy(ScoringPolicy):
    """Scores items by their cosines to the session's earlier items, weighted by their rewards.

    Cosines are between columns of the session × item matrix of rewards minus the lowest reward.
    A bias per item, the log of its share of the training steps, is added to the cosines times a
    temperature, chosen on held-out steps. States and returns are not used.
    """

    Config = ItemKNNConfig
    items_only = "item-knn"
    chosen = ("temperature",)
    config: ItemKNNConfig
    neighbors: Tensor
    cosines: Tensor
    reward_low: Tensor
    temperature: Tensor

    def __init__(self, config: ItemKNNConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        shape = (sizes["items"], min(config.neighbors, sizes["items"]))
        self.register_buffer("neighbors", torch.zeros(shape, dtype=torch.int64))
        self.register_buffer("cosines", torch.zeros(shape))
        self.register_buffer("reward_low", torch.zeros(()))
        self.register_buffer("temperature", torch.ones(()))

    def start_from(self, train: EpisodeStore) -> None:
        """Find the neighbours of every item; an item is a neighbour of itself."""
        from scipy import sparse  # here, because loading a trained policy does not need it

        episodes, steps = train.all_steps()
        items = train.step_values(schema.ITEM, episodes, steps)
        rewards = train.step_values(schema.REWARD, episodes, steps)
        low = float(rewards.min())
        self.reward_low.fill_(low if low < rewards.max() else low - 1)
        shape = (train.n_episodes, len(self.cosines))
        liked = sparse.csr_matrix(
            (rewards - float(self.reward_low), (episodes, items)), shape=shape
        )
        squares = np.asarray(liked.multiply(liked).sum(axis=0))
        lengths = np.sqrt(squares).ravel()
        scales = 1 / np.where(lengths > 0, lengths, 1.0)
        columns = (liked @ sparse.diags(scales)).tocsc()
        at_once = max(1, min(_ROWS, _AT_ONCE // shape[1]))
        for start in range(0, shape[1], at_once):
            rows = slice(start, start + at_once)
            products = (columns[:, rows].T @ columns).toarray()
            cosines = torch.from_numpy(products).float()
            self.cosines[rows], self.neighbors[rows] = cosines.topk(self.cosines.shape[1])

    def make_solver(
        self,
        train: EpisodeStore,
        validation: EpisodeStore | None,
        folder: Path,
        seed: int,
    ) -> Callable[[], None]:
        """Chooses the temperature; everything else is set by `start_from`."""
        return lambda: None if validation is None else self._choose_temperature(validation)

    @torch.no_grad()
    def _choose_temperature(self, held_out: EpisodeStore) -> None:
        """Minimise the negative log-likelihood, convex in the temperature, by bisection."""
        count = min(held_out.n_steps, _ROWS)
        numbers = np.linspace(0, held_out.n_steps - 1, count, dtype=np.int64)
        episodes, steps = held_out.locate(numbers)
        windows = held_out.windows(episodes, steps, self.config.context).to(self.cosines.device)
        shown = Shown.before_last(windows)
        items = windows.actions[:, -1:]
        scores = self.similarity(shown.items, shown.rewards)
        of_shown = scores.gather(1, items).mean()
        bias = self.head.get_parameter("bias").detach()
        seen = scores.new_zeros(len(scores), len(bias) + 1, dtype=torch.bool)
        places = shown.items % seen.shape[1]  # the last is for none
        seen = seen.scatter_(1, places, True)[:, :-1]
        if not seen.gather(1, items).any():  # sessions in which no item is shown twice
            bias = bias.where(~seen, -torch.inf)
        low = 0.0
        high = _HOTTEST
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            probabilities = (middle * scores + bias).softmax(-1)
            expected = probabilities.mul(scores).sum(-1).mean()
            low, high = (low, middle) if expected > of_shown else (middle, high)
        self.temperature.fill_((low + high) / 2)

    def similarity(self, items: Tensor, rewards: Tensor) -> Tensor:
        """Cosines to items (B, N), −1 for none, summed by their rewards (B, N), (B, n_items)."""
        weights = (rewards - self.reward_low) * (items >= 0)
        items = items.clamp(min=0)
        weighted = (self.cosines[items] * weights.unsqueeze(-1)).flatten(1)
        scores = weighted.new_zeros(len(items), len(self.cosines))
        return scores.scatter_add_(1, self.neighbors[items].flatten(1), weighted)

    def action_loss(self, windows: Windows) -> Tensor:
        """Mean negative log-likelihood (nats) over the windows' last steps."""
        return F.cross_entropy(self.act(windows), windows.actions[:, -1])

    def act(self, windows: Windows) -> Tensor:
        """Logits over items at the last step, (B, n_items)."""
        shown = Shown.before_last(windows)
        scores = self.similarity(shown.items, shown.rewards)
        return self.temperature * scores + self.head.get_parameter("bias")


@settings_table("policy")
class BoostedConfig(PolicyConfig):
    """Settings of the boosted click model; `context` − 1 is the number of items of history."""

    boosted: Annotated[int, Field(ge=1, le=10**6)] = 256
    """Items that the trees score, those with the highest rates; others have the item's rate."""


class BoostedPolicy(ScoringPolicy):
    """Scores items by the log-odds of a like, predicted by gradient-boosted trees.

    The trees (scikit-learn's histogram boosting) see the columns of `_inputs`: rates, counts, the
    likeness of the item to the session's, effects of pairs of attributes, and the attributes. In
    training, rates and effects are those of other folds of the episodes, because its own row would
    tell the trees what they predict. Their number has the lowest loss on validation episodes, or on
    a fifth of the training episodes without these. Returns are not used.
    """

    Config = BoostedConfig
    config: BoostedConfig
    items_only = "boosted"
    chosen = ("trees",)
    reward_low: Tensor
    reward_high: Tensor
    impressions: Tensor
    liked: Tensor
    directions: Tensor
    tag: Tensor
    base: Tensor
    trees: Tensor
    effects: Tensor

    def __init__(self, config: BoostedConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        n_items = sizes["items"]
        splits = (TREES, _SPLITS)
        self._context = 3 * sizes["action"] + 2  # where features of users begin in `ItemStates`
        for name, value in (
            ("reward_low", torch.zeros(())),
            ("reward_high", torch.zeros(())),
            ("impressions", torch.zeros(n_items)),
            ("liked", torch.zeros(n_items)),
            ("directions", torch.zeros(n_items, sizes["action"])),
            ("tag", torch.arange(n_items)),
            ("tree_inputs", torch.zeros(splits, dtype=torch.int64)),
            ("tree_thresholds", torch.zeros(splits)),
            ("tree_leaves", torch.zeros(TREES, 2**_SPLITS)),
            ("base", torch.zeros(())),
            ("trees", torch.zeros((), dtype=torch.int64)),
            ("effects", torch.zeros(n_items, 1 + max(0, sizes["state"] - self._context))),
        ):
            self.register_buffer(name, value)

    def start_from(self, train: EpisodeStore) -> None:
        """Set counts, directions and first tags of the items, and the range of the rewards."""
        counts, states = TrainingCounts.of(train), train.item_states
        rewards = train.column(schema.REWARD)
        self.reward_low.fill_(float(rewards.min()))
        self.reward_high.fill_(float(rewards.max()))
        self.impressions.copy_(counts.shown)
        self.liked.copy_(counts.liked)
        self.directions.copy_(F.normalize(states.embeddings, dim=1))
        if states.tags.shape[1]:
            self.tag.copy_(states.tags[:, 0])

    def make_solver(
        self,
        train: EpisodeStore,
        validation: EpisodeStore | None,
        folder: Path,
        seed: int,
    ) -> Callable[[], None]:
        """Fits the trees."""

        def solve() -> None:
            numbers = draw_numbers(train.n_steps, _MAX_ROWS, seed)
            inputs, liked = self._training_rows(train, numbers)
            held_out, count = None, 0 if validation is not None else int(self.trees)
            if validation is not None:
                later = draw_numbers(validation.n_steps, _MAX_ROWS, seed)
                held_out = self._rows(validation, later)
            elif not count:
                rows = train.locate(numbers)[0] % _FOLDS == _FOLDS - 1
                held_out = inputs[rows], liked[rows]
                inputs, liked = inputs[~rows], liked[~rows]
            settings = {"learning_rate": _LEARNING_RATE, "early_stopping": False}
            tables = fit_trees(inputs, liked, seed, max_iter=count or TREES, **settings)
            if held_out is not None:
                count = _best_number(BoostedTrees(**tables), *held_out)
            self.trees.fill_(count)
            self.base.copy_(tables["base"])
            for name in _TABLES:
                self.get_buffer(f"tree_{name}")[:count] = tables[name][:count]

        return solve

    def _training_rows(self, train: EpisodeStore, numbers: IntArray) -> tuple[Array, BoolArray]:
        """Inputs (M, F) of the trees at training steps (M,), from other folds of the episodes, and
        which were liked; sets the effects of pairs of attributes to those of all folds."""
        folds = np.arange(train.n_episodes) % _FOLDS
        parts = (train.select(folds == fold) for fold in range(_FOLDS))
        counts = map(TrainingCounts.of, parts)
        of_folds = [torch.stack([fold.shown, fold.liked]) for fold in counts]
        whole = torch.stack([self.impressions, self.liked]).cpu()
        # (2, folds, n_items).
        of_others = whole.unsqueeze(1) - torch.stack(of_folds, 1)
        inputs, liked = self._rows(train, numbers, of_others)
        episodes, steps = train.locate(numbers)
        items = train.items_at(episodes, steps)
        tags = train.item_states.tags.numpy().reshape(len(self.tag), -1)
        inputs[:, _PAIRS] = 1  # before the context
        context = inputs[:, _PAIRS : _PAIRS + self.effects.shape[1]].astype(np.float64)
        residuals = liked - 1 / (1 + np.exp(-inputs[:, 0]))
        scores, effects = _fit_pairs(tags, items, context, residuals, folds[episodes])
        inputs[:, _PAIRS] = scores.round(_DECIMALS)
        self.effects.copy_(torch.from_numpy(effects))
        return inputs, liked

    def _rows(
        self,
        view: EpisodeStore,
        numbers: IntArray,
        counts: Tensor | None = None,
    ) -> tuple[Array, BoolArray]:
        """Inputs (M, F) of the trees at steps (M,) of a view, and which were liked; with counts
        (2, folds, n_items) of shown and liked ones for each fold of its episodes."""
        inputs, target, device = [], [], self.impressions.device
        for begin in range(0, len(numbers), _ROWS_AT_ONCE):
            episodes, steps = view.locate(numbers[begin : begin + _ROWS_AT_ONCE])
            windows = view.windows(episodes, steps, self.config.context)
            items, of_items = windows.actions[:, -1:], None
            if counts is not None:
                folds = torch.from_numpy(episodes % _FOLDS).unsqueeze(1)
                of_items = counts[:, folds, items].to(device)
            rows = self._inputs(windows.to(device), items.to(device), of_items)
            inputs.append(rows[:, 0].cpu().numpy())
            rewards = view.step_values(schema.REWARD, episodes, steps)
            target.append(liked_rewards(view, rewards))
        return np.concatenate(inputs), np.concatenate(target)

    def _find_liked(self, windows: Windows) -> Tensor:
        """(B, K) 1 at liked steps, as of `ucfrec.episodes.states`, otherwise 0."""
        least = least_liked(self.reward_low, self.reward_high)
        return ((windows.rewards >= least) & windows.mask).float()

    def _rate(self, liked: Tensor, impressions: Tensor) -> Tensor:
        """Log-odds of rates of likes, shrunk to the mean by `PRIOR` rows."""
        mean = (self.liked.sum() + 0.5) / (self.impressions.sum() + 1)
        return torch.logit((liked + PRIOR * mean) / (impressions + PRIOR))

    def _inputs(
        self,
        windows: Windows,
        items: Tensor,
        counts: Tensor | None = None,
    ) -> Tensor:
        """Inputs (B, C, F) of the trees for items (C,) or (B, C) at the windows' last steps, whose
        action and reward are not read; counts (2, B, C) of shown and liked ones, None for all."""
        valid = windows.mask[:, :-1].float()  # (B, N)
        earlier = windows.actions[:, :-1]
        liked = self._find_liked(windows)[:, :-1]
        if counts is None:
            counts = torch.stack([self.impressions[items], self.liked[items]])
        shown_of, liked_of = counts
        count = valid.sum(1, keepdim=True)
        likes = liked.sum(1, keepdim=True)
        cosines = self.directions[items] @ self.directions[earlier].mT  # (B, C, N)
        # Products of other batches differ in the last bits, which could change a tree's branch.
        cosines = _round(cosines)
        none = cosines.new_zeros(cosines.shape[:2])
        alike = self.tag[items].unsqueeze(-1) == self.tag[earlier].unsqueeze(1)
        tagged, liked_tagged = (
            (alike.float() @ weights.unsqueeze(-1)).squeeze(-1) for weights in (valid, liked)
        )
        whole = (likes + 1) / (count + 2)
        context = standardise(windows.states, self.state_mean, self.state_std)
        context = context[:, -1:, self._context :]  # (B, 1, F + O)
        effects = self.effects[items]
        products = effects[..., 1:] @ context.mT
        pairs = effects[..., 0] + products.squeeze(-1)
        likeness_to_liked = (cosines @ liked.unsqueeze(-1)).squeeze(-1)
        likeness = (cosines @ valid.unsqueeze(-1)).squeeze(-1)
        columns = (
            self._rate(liked_of, shown_of),
            torch.log1p(shown_of),
            self._rate(likes, count),
            count,
            liked[:, -1:] - 1 + valid[:, -1:] if earlier.shape[1] else none[:, :1],
            _round(likeness_to_liked / likes.clamp(min=1)),
            _round(likeness / count.clamp(min=1)),
            cosines[..., -1] * valid[:, -1:] if earlier.shape[1] else none,
            torch.logit((liked_tagged + 2 * whole) / (tagged + 2)),
            tagged,
            _round(pairs),
        )
        rates = torch.stack([weights.expand_as(none) for weights in columns], dim=-1)
        attributes = (context, self.directions[items])
        expanded = [part.expand(*none.shape, -1) for part in attributes]
        return torch.cat([rates, *expanded], dim=-1)

    def _score(self, windows: Windows, items: Tensor) -> Tensor:
        """Log-odds (B, C) of a like of items as of `_inputs`."""
        inputs = self._inputs(windows, items)
        count = int(self.trees)
        buffers = {name: self.get_buffer(f"tree_{name}") for name in _TABLES}
        tables = {name: table[:count].cpu() for name, table in buffers.items()}
        trees = BoostedTrees(**tables, base=self.base.cpu())
        parts = torch.split(inputs.flatten(0, 1).cpu(), _ROWS_AT_ONCE)
        scores = torch.cat([trees(rows) for rows in parts])
        return scores.view(inputs.shape[:2]).to(inputs)

    @torch.no_grad()
    def act(self, windows: Windows) -> Tensor:
        """Log-odds of a like of all items at the last step, (B, n_items)."""
        rates = self._rate(self.liked, self.impressions)
        best = rates.topk(min(self.config.boosted, len(rates))).indices
        boosted = self._score(windows, best)
        # Others have their rate and what the session adds to those that the trees score.
        added = (boosted - rates[best]).mean(1, keepdim=True)
        return (rates + added).index_copy(1, best, boosted)

    def action_loss(self, windows: Windows) -> Tensor:
        """Mean log loss (nats) of likes at the windows' last steps."""
        scores = self._score(windows, windows.actions[:, -1:])[:, 0]
        return F.binary_cross_entropy_with_logits(scores, self._find_liked(windows)[:, -1])


def _round(values: Tensor) -> Tensor:
    return torch.round(values, decimals=_DECIMALS)


def _fit_pairs(
    tags: IntArray,
    items: IntArray,
    context: Float64Array,
    residuals: Float64Array,
    folds: IntArray,
) -> tuple[Float64Array, Float64Array]:
    """Ridge regression of residuals (M,) of steps on all products of an entry of their context
    (M, C), the first of which is 1, with 1 or a tag of their items (M,), by `tags` (n_items, T):
    predictions (M,) from other `folds` (M,), and effects (n_items, C) of context by all of them.
    Context and tags are taken as independent, so that two small decompositions solve it."""
    from scipy import sparse

    columns = np.pad(tags + 1, ((0, 0), (1, 0)))  # 0 for all items, and for no tag
    weights = (columns > 0) | (np.arange(columns.shape[1]) == 0)
    bounds = np.arange(len(columns) + 1) * columns.shape[1]
    shape = (len(columns), int(columns.max()) + 1)
    entries = weights.ravel().astype(float)
    attributes = sparse.csr_matrix((entries, columns.ravel(), bounds), shape)
    design, weighted = attributes[items], context.T * residuals
    spread, axes = np.linalg.eigh(context.T @ context)
    moments = (design.T @ design).toarray() / len(items)
    spreads, bases = np.linalg.eigh(moments)
    variance = np.outer(spread, spreads).clip(0)

    def solve(rows: BoolArray) -> Float64Array:
        moments = axes.T @ (weighted[:, rows] @ design[rows]) @ bases
        slopes = axes @ (moments / (rows.mean() * variance + _PENALTY)) @ bases.T
        return np.asarray(attributes @ slopes.T)

    predicted = np.zeros(len(items))
    for fold in range(_FOLDS):
        rows = folds == fold
        effects = solve(~rows)[items[rows]]
        predicted[rows] = (effects * context[rows]).sum(1)
    return predicted, solve(folds >= 0)


def _best_number(
    trees: BoostedTrees,
    inputs: Array,
    liked: BoolArray,
) -> int:
    """How many of the trees have the lowest log loss at held-out steps."""
    losses = torch.zeros(())
    for begin in range(0, len(inputs), _ROWS_AT_ONCE):
        rows = slice(begin, begin + _ROWS_AT_ONCE)
        odds = trees.stages(torch.from_numpy(inputs[rows]))
        signed = torch.where(torch.from_numpy(liked[rows]), -odds, odds)
        losses = losses + F.softplus(signed).sum(1)
    return 1 + int(losses.argmin())
