"""When users leave: the probability that a session ends with a step, fitted to logged steps."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.episodes.exposure import Likeness, Shown
from ucfrec.episodes.store import EpisodeStore

_PENALTY: Final = 1.0
"""L2 penalty of the logistic regression on standardised inputs."""


@dataclass(frozen=True)
class LoggedEnds:
    """Logged steps, what was shown before each, and whether it ended its session."""

    shown: Shown
    """The items shown before, (N, L)."""
    items: Tensor
    """(N,) int64 items shown at the step."""
    rewards: Float64Array
    """(N,) in reward units."""
    steps: IntArray
    """(N,) number of the step in its session."""
    ended: BoolArray
    """(N,)."""

    @classmethod
    def of(cls, store: EpisodeStore, lags: int, most: int, seed: int) -> "LoggedEnds":
        """Steps of a view of a store of items, at most `most` of them, drawn at random.

        The last step of a user's last session, and of a session that was cut, is left out: the
        log may simply have ended there.
        """
        users = store.episode_values(schema.USER) if store.has_users else np.arange(len(store))
        last_session = np.zeros(len(store), dtype=bool)
        last_session[len(store) - 1 - np.unique(users[::-1], return_index=True)[1]] = True
        # Of an episode whose end is unknown, all steps but the last are known.
        known = store.lengths - (last_session | ~store.terminated)
        ends = np.cumsum(known)
        numbers = np.arange(int(ends[-1]))
        if len(numbers) > most:
            drawn = np.random.default_rng(seed).choice(len(numbers), most, replace=False)
            numbers = np.sort(drawn)
        episodes = np.searchsorted(ends, numbers, side="right")
        steps = numbers - (ends - known)[episodes]
        ended = steps == store.lengths[episodes] - 1
        window = store.windows(episodes, steps, lags + 1)
        rewards = window.rewards[:, -1].double().numpy()
        return cls(Shown.before_last(window), window.actions[:, -1], rewards, steps, ended)


@dataclass(frozen=True)
class SessionEnd:
    """A logistic regression of whether a session ends with a step.

    Inputs are the number of the step, its reward, and how often and how alike the item was shown in
    the last 1, 3 and all of the steps before.
    """

    likeness: Likeness
    tensors: Mapping[str, Tensor]
    """float64 `mean` and `scale` (F,) of the inputs, and `weights` (F,) and `bias` ()."""

    @classmethod
    def fit(cls, likeness: Likeness, logged: LoggedEnds) -> "SessionEnd":
        """Fit the regression; where all steps end sessions or none does, that is the model."""
        from sklearn.linear_model import LogisticRegression

        inputs = _inputs(likeness, *_given(logged))
        mean, weights = np.zeros(inputs.shape[1]), np.zeros(inputs.shape[1])
        scale, bias = (
            np.ones(inputs.shape[1]),
            np.full(1, np.inf if logged.ended.any() else -np.inf),
        )
        if logged.ended.any() and not logged.ended.all():
            mean, spread = inputs.mean(0), inputs.std(0)
            scale = np.where(spread > 0, spread, 1.0)
            model = LogisticRegression(C=1 / _PENALTY, max_iter=1000)
            model.fit((inputs - mean) / scale, logged.ended)
            weights, bias = model.coef_[0], model.intercept_
        fitted = {"mean": mean, "scale": scale, "weights": weights, "bias": bias}
        return cls(likeness, {name: torch.from_numpy(each) for name, each in fitted.items()})

    def probabilities(
        self, shown: Shown, items: Tensor, rewards: Float64Array, steps: IntArray
    ) -> Float64Array:
        """Probabilities (M,) that sessions end with a step; arguments as in `LoggedEnds`."""
        inputs = torch.from_numpy(_inputs(self.likeness, shown, items, rewards, steps))
        inputs = (inputs - self.tensors["mean"]) / self.tensors["scale"]
        return torch.sigmoid(inputs @ self.tensors["weights"] + self.tensors["bias"]).numpy()


def _given(logged: LoggedEnds) -> tuple[Shown, Tensor, Float64Array, IntArray]:
    return logged.shown, logged.items, logged.rewards, logged.steps


def _inputs(
    likeness: Likeness, shown: Shown, items: Tensor, rewards: Float64Array, steps: IntArray
) -> Float64Array:
    columns = [np.log1p(steps), steps, np.minimum(steps, 1), rewards]
    repeated = (shown.items == items.unsqueeze(1)).double()
    for reach in (1, 3, shown.items.shape[1]):
        recent = shown.items.clone()
        recent[:, reach:] = -1
        profile = likeness.profile(recent, torch.ones(recent.shape))
        alike = likeness.to_items(profile, items.unsqueeze(1))
        columns += [repeated[:, :reach].sum(1).numpy(), alike.numpy(), (alike > 0).numpy()]
    return np.stack(columns, axis=1).astype(np.float64)
