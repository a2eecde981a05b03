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
from ucfrec.policies.heads import ItemHead, VectorHead
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
_HELD_OUT = 10
"""Without validation episodes, one in this many says how many trees are best."""
_LEARNING_RATE = 0.1
_PENALTIES = (300.0, 1000.0, 3000.0, 10_000.0)
"""Steps that L2 penalties of the regression on pairs of attributes count as."""
_PAIRS = 10
"""Number of the input that is the sum of the effects of pairs of attributes."""
_DECIMALS = 3
_SPLITS = LEAVES - 1

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
    vectors, it is the mean logged action. Only an exposure term is learned by gradient, and only by
    shares of steps.

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
            self.head.out.bias.copy_(torch.atanh(mean.clamp(-_WITHIN, _WITHIN)))

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
        terms = held_out.liked * F.logsigmoid(scores) + dislikes * F.logsigmoid(-scores)
        best = len(scores) - 1 - int(terms.sum(1).flip(0).argmax())  # of equal ones, the longest
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
    temperature, which is chosen on held-out steps. States and returns are not used.
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
        # Imported here because loading a trained policy does not need scipy.
        from scipy import sparse

        episodes, steps = train.all_steps()
        items = train.step_values(schema.ITEM, episodes, steps)
        rewards = train.step_values(schema.REWARD, episodes, steps)
        low = float(rewards.min())
        self.reward_low.fill_(low if low < rewards.max() else low - 1)
        shape = (train.n_episodes, len(self.cosines))
        liked = sparse.csr_matrix(
            (rewards - float(self.reward_low), (episodes, items)), shape=shape
        )
        lengths = np.sqrt(np.asarray(liked.multiply(liked).sum(axis=0))).ravel()
        columns = (liked @ sparse.diags(1 / np.where(lengths > 0, lengths, 1.0))).tocsc()
        at_once = max(1, min(_ROWS, _AT_ONCE // shape[1]))
        for start in range(0, shape[1], at_once):
            rows = slice(start, start + at_once)
            cosines = torch.from_numpy((columns[:, rows].T @ columns).toarray()).float()
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
        numbers = np.linspace(0, held_out.n_steps - 1, min(held_out.n_steps, _ROWS), dtype=np.int64)
        episodes, steps = held_out.locate(numbers)
        windows = held_out.windows(episodes, steps, self.config.context)
        windows = windows.to(self.cosines.device)
        shown, items = Shown.before_last(windows), windows.actions[:, -1:]
        scores = self.similarity(shown.items, shown.rewards)
        of_shown = scores.gather(1, items).mean()
        assert isinstance(self.head, ItemHead)
        low, high = 0.0, _HOTTEST
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            expected = (middle * scores + self.head.bias).softmax(-1).mul(scores).sum(-1).mean()
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
    a tenth of the training episodes without these. Returns are not used.
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
    split_inputs: Tensor
    split_thresholds: Tensor
    leaves: Tensor
    base: Tensor
    trees: Tensor
    effects: Tensor

    def __init__(self, config: BoostedConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        n_items, splits = sizes["items"], (_SPLITS, TREES)
        self._context = 3 * sizes["action"] + 2
        """Number of the first entry of a state that is of the user or observed."""
        for name, value in (
            ("reward_low", torch.zeros(())),
            ("reward_high", torch.zeros(())),
            ("impressions", torch.zeros(n_items)),
            ("liked", torch.zeros(n_items)),
            ("directions", torch.zeros(n_items, sizes["action"])),
            ("tag", torch.arange(n_items)),
            ("split_inputs", torch.zeros(splits, dtype=torch.int64)),
            ("split_thresholds", torch.zeros(splits)),
            ("leaves", torch.zeros(TREES, 2**_SPLITS)),
            ("base", torch.zeros(())),
            ("trees", torch.zeros((), dtype=torch.int64)),
            ("effects", torch.zeros(n_items, 1 + sizes["state"] - self._context)),
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
            held_out = None
            if validation is not None:
                numbers = draw_numbers(validation.n_steps, _MAX_ROWS, seed)
                held_out = self._rows(validation, numbers)
            elif not self.trees:
                rows = train.locate(numbers)[0] % _HELD_OUT == 0
                held_out = inputs[rows], liked[rows]
                inputs, liked = inputs[~rows], liked[~rows]
            count = TREES if held_out else int(self.trees)
            settings = {"max_iter": count, "learning_rate": _LEARNING_RATE, "early_stopping": False}
            tables = fit_trees(inputs, liked, seed, **settings)
            if held_out:
                count = _best_number(BoostedTrees(**tables), *held_out)
            self.trees.fill_(count)
            self.base.copy_(tables["base"])
            self.leaves[:count] = tables["leaves"][:count]
            self.split_inputs[:, :count] = tables["inputs"][:count].T
            self.split_thresholds[:, :count] = tables["thresholds"][:count].T

        return solve

    def _training_rows(self, train: EpisodeStore, numbers: IntArray) -> tuple[Array, BoolArray]:
        """Inputs (M, F) of the trees at training steps (M,), from other folds of the episodes, and
        which were liked; sets the effects of pairs of attributes to those of all folds."""
        folds = np.arange(train.n_episodes) % _FOLDS
        parts = (train.select(np.flatnonzero(folds == fold)) for fold in range(_FOLDS))
        of_folds = [torch.stack([c.shown, c.liked]) for c in map(TrainingCounts.of, parts)]
        whole = torch.stack([self.impressions, self.liked]).cpu()
        counts = whole.unsqueeze(1) - torch.stack(of_folds, 1)  # (2, folds, n_items) of the others
        inputs, liked = self._rows(train, numbers, counts, folds)
        episodes, steps = train.locate(numbers)
        context = inputs[:, _PAIRS + 1 :][:, : self.effects.shape[1] - 1]
        scores, effects = _fit_pairs(
            train.item_states.tags.numpy().reshape(len(self.tag), -1),
            train.step_values(schema.ITEM, episodes, steps).astype(np.int64),
            np.insert(context.astype(np.float64), 0, 1.0, axis=1),
            liked - 1 / (1 + np.exp(-inputs[:, 0])),
            folds[episodes],
        )
        inputs[:, _PAIRS] = scores.round(_DECIMALS)
        self.effects.copy_(torch.from_numpy(effects))
        return inputs, liked

    def _rows(
        self,
        view: EpisodeStore,
        numbers: IntArray,
        counts: Tensor | None = None,
        folds: IntArray | None = None,
    ) -> tuple[Array, BoolArray]:
        """Inputs (M, F) of the trees at steps (M,) of a view, and which were liked; with counts
        (2, folds, n_items) of shown and liked ones for each of the `folds` (E,) of its episodes."""
        inputs, target, device = [], [], self.impressions.device
        for begin in range(0, len(numbers), _ROWS_AT_ONCE):
            episodes, steps = view.locate(numbers[begin : begin + _ROWS_AT_ONCE])
            windows = view.windows(episodes, steps, self.config.context)
            items, of_items = windows.actions[:, -1:], None
            if counts is not None and folds is not None:
                of_items = counts[:, torch.from_numpy(folds[episodes]).unsqueeze(1), items]
                of_items = of_items.to(device)
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
        action and reward are not read; counts (2, B, C) of shown and liked ones, or None for all
        rows."""
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
        pairs = effects[..., 0] + (effects[..., 1:] @ context.mT).squeeze(-1)
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
            _round(pairs),
        )
        attributes = (context, self.directions[items])
        parts = [torch.stack([weights.expand_as(none) for weights in columns], dim=-1)]
        parts += [values.expand(*none.shape, -1) for values in attributes]
        return torch.cat(parts, dim=-1)

    def _score(self, windows: Windows, items: Tensor) -> Tensor:
        """Log-odds (B, C) of a like of items as of `_inputs`."""
        inputs = self._inputs(windows, items)
        tables = (self.split_inputs.T, self.split_thresholds.T, self.leaves)
        inner, thresholds, leaves = (table[: int(self.trees)].cpu() for table in tables)
        trees = BoostedTrees(inner, thresholds, leaves, self.base.cpu())
        parts = torch.split(inputs.flatten(0, 1).cpu(), _ROWS_AT_ONCE)
        return torch.cat([trees(rows) for rows in parts]).view(inputs.shape[:2]).to(inputs)

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
    (M, C), the first of which is 1, with an attribute of their item: 1, or whether it has a tag.

    Context and attributes are taken as independent, so that two small decompositions solve it. The
    penalty is the one that predicts other folds best.

    Args:
        tags: (n_items, T) as of `ItemStates`.
        items: (M,) item of each step.
        folds: (M,) fold of each step, from 0.

    Returns:
        Predictions (M,) from the other folds, and effects (n_items, C) of context by all of them.
    """
    from scipy import sparse

    columns = np.pad(tags + 1, ((0, 0), (1, 0)))  # 0 for all items, and for no tag
    has = (columns > 0) | (np.arange(columns.shape[1]) == 0)
    bounds = np.arange(len(columns) + 1) * columns.shape[1]
    shape = (len(columns), int(columns.max()) + 1)
    attributes = sparse.csr_matrix((has.ravel().astype(float), columns.ravel(), bounds), shape)
    shown, count = attributes[items], len(items)
    spread, axes = np.linalg.eigh(context.T @ context)
    spreads, bases = np.linalg.eigh((shown.T @ shown).toarray() / count)
    variance = np.outer(spread, spreads).clip(0)
    rows = [np.flatnonzero(folds == fold) for fold in range(_FOLDS)]
    weighted = context * residuals[:, None]
    moments = np.stack([axes.T @ (shown[part].T @ weighted[part]).T @ bases for part in rows])

    def solve(sums: Float64Array, share: float, penalty: float) -> Float64Array:
        slopes = axes @ (sums / (share * variance + penalty)) @ bases.T
        return np.asarray(attributes @ slopes.T)

    total, best, lowest = moments.sum(0), _PENALTIES[-1], math.inf
    scores = np.zeros(count)
    for penalty in _PENALTIES:
        predicted = np.zeros(count)
        for part, sums in zip(rows, moments, strict=True):
            effects = solve(total - sums, 1 - len(part) / count, penalty)
            predicted[part] = (effects[items[part]] * context[part]).sum(1)
        loss = float(((predicted - residuals) ** 2).sum())
        if loss < lowest:
            best, lowest, scores = penalty, loss, predicted
    return scores, solve(total, 1.0, best)


def _best_number(trees: BoostedTrees, inputs: Array, liked: BoolArray) -> int:
    """How many of the trees have the lowest log loss at held-out steps."""
    total = torch.zeros(())
    for begin in range(0, len(inputs), _ROWS_AT_ONCE):
        rows = slice(begin, begin + _ROWS_AT_ONCE)
        odds = trees.stages(torch.from_numpy(inputs[rows]))
        target = torch.from_numpy(liked[rows]).to(odds).expand_as(odds)
        total = total + F.binary_cross_entropy_with_logits(odds, target, reduction="none").sum(1)
    return 1 + int(total.argmin())
