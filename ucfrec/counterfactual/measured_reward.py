"""Which observation dimensions measure the reward, although they are logged with the state.

A dimension d_t that records what was earned (r_t, or r_{t+1}) is a leak: where it is fixed, nothing
changes. It predicts the reward as a cause would, but depends on nothing else: what the rest tells
of it, the action above all, it tells through the reward. So

1. the rest (other dimensions, action, next action) helps to predict d_t;
2. the reward alone predicts d_t at least as well;
3. given the reward, the rest hardly helps any more.

A cause fails one of these. If the logging policy did not see it, the action tells nothing of it
(1); if the policy did, the action tells of it with or without the reward (3). A dimension of a
process that goes on, such as a position or a user's feature, is told by other dimensions (3).
"""

from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np
import numpy.typing as npt
import torch
from pydantic import Field
from scipy import stats
from torch import Tensor, nn

from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import IntArray
from ucfrec.errors import InputError
from ucfrec.fitting.random_state import random_state_kept
from ucfrec.settings import BatchSize, Count, LearningRate, Share, Width, settings_table

CLIP: Final = 10.0
"""Standardised values beyond this many standard deviations are clipped."""
_HELD_OUT_EVERY = 5
_CHUNK = 4096
_REST, _REWARD = 0, 1


@settings_table("measurement")
class MeasurementConfig:
    """Predictor of a dimension, and how much must be left for a cause."""

    hidden: Width = 128
    """Width of its two hidden layers."""
    steps: Count = 2000
    """Updates."""
    batch_size: BatchSize = 512
    """Transitions of an update."""
    learning_rate: LearningRate = 3e-3
    """Highest step size of the updates."""
    min_told: Share = 0.003
    """Least share of a dimension's variance that the rest must tell without the reward."""
    most_left: Share = 0.25
    """Largest share of that which the rest may add to the reward."""
    level: Annotated[float, Field(gt=0, lt=1)] = 0.001
    """Level of the tests that the rest and the reward tell of the dimension at all."""


@dataclass(frozen=True)
class MeasuredReward:
    """The verdict on every observation dimension."""

    flags: tuple[bool, ...]
    """Whether the dimension measures the reward."""
    told: tuple[float, ...]
    """Share of the dimension's variance that the rest tells without the reward."""
    told_by_reward: tuple[float, ...]
    """Share that the reward alone tells."""
    left: tuple[float, ...]
    """Share that the rest adds to the reward."""
    transitions: int


@random_state_kept()
def measured_reward(
    train: EpisodeStore, config: MeasurementConfig, most: int, seed: int
) -> MeasuredReward:
    """Test every observation dimension on held-out episodes.

    Args:
        train: a view of the training episodes, with observations.
        config: of the test.
        most: largest number of transitions used.
        seed: of the predictor.

    Raises:
        InputError: there are too few episodes with two steps or more to hold some out.
    """
    data = _Steps.of(train, most, seed)
    held_out = held_out_of(data.episodes)
    if len(np.unique(data.episodes[held_out])) < 3:
        raise InputError(
            f"{train.path} has {train.n_episodes} training episodes, too few of them with two "
            f"steps or more; screening needs at least {3 * _HELD_OUT_EVERY}"
        )
    torch.manual_seed(seed)
    predictor = _fitted(data, np.flatnonzero(~held_out), config)
    rows = np.flatnonzero(held_out)
    flags, told, told_by_reward, left = [], [], [], []
    for dimension in range(data.columns.shape[1]):
        errors = _errors(predictor, data, rows, dimension)
        variance = max(float(errors[0][0].mean()), 1e-12)
        of_rest = (errors[0][0] - errors[1][0]) / variance
        of_reward = (errors[0][0] - errors[0][1]) / variance
        added = float((errors[0][1] - errors[1][1]).mean()) / variance
        rest, reward = float(of_rest.mean()), float(of_reward.mean())
        certain = all(
            clustered_p_value(each, data.episodes[rows]) < config.level
            for each in (of_rest, of_reward)
        )
        told.append(rest)
        told_by_reward.append(reward)
        left.append(added)
        enough = certain and rest >= config.min_told
        flags.append(enough and reward >= rest and added <= config.most_left * rest)
    return MeasuredReward(
        tuple(flags), tuple(told), tuple(told_by_reward), tuple(left), len(data.columns)
    )


@dataclass(frozen=True)
class _Steps:
    """Standardised steps that have a successor."""

    columns: Tensor
    """(N, O) logged observations."""
    rest: Tensor
    """(N, R) the rest of the state, the action and the next one."""
    rewards: Tensor
    """(N, 2) of the step and of the next one."""
    episodes: IntArray

    @classmethod
    def of(cls, view: EpisodeStore, most: int, seed: int) -> "_Steps":
        episodes, steps = view.all_steps()
        inner = np.flatnonzero(steps < view.lengths[episodes] - 1)
        if len(inner) > most:
            inner = np.sort(np.random.default_rng(seed).choice(inner, most, replace=False))
        if not len(inner):
            raise InputError(f"{view.path} has no episode of two steps; nothing can be screened")
        now = view.transitions(episodes[inner], steps[inner])
        then = view.transitions(episodes[inner], steps[inner] + 1)
        size = view.observation_size
        others = now.states[:, : now.states.shape[1] - size]
        return cls(
            columns=standardised(now.states[:, -size:]),
            rest=standardised(torch.cat([others, now.actions, then.actions], dim=1)),
            rewards=standardised(torch.stack([now.rewards, then.rewards], dim=1)),
            episodes=episodes[inner],
        )


class _Predictor(nn.Module):
    """Predicts one dimension from the rest, from the reward, from both or from neither."""

    def __init__(self, data: _Steps, hidden: int) -> None:
        super().__init__()
        size = data.columns.shape[1]
        inputs = 2 * size + data.rest.shape[1] + data.rewards.shape[1] + 2
        self.net = nn.Sequential(
            nn.Linear(inputs, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU(),
            nn.Linear(hidden, size),
        )  # fmt: skip

    def errors(self, data: _Steps, rows: Tensor, dimensions: Tensor, known: Tensor) -> Tensor:
        """Squared errors (B,).

        Args:
            data: all steps.
            rows: (B,) of them.
            dimensions: (B,) predicted in each.
            known: (B, 2) 1 where the rest, and the reward, are known.
        """
        target = nn.functional.one_hot(dimensions, data.columns.shape[1]).float()
        rest, reward = known[:, _REST, None], known[:, _REWARD, None]
        inputs = [
            data.columns[rows] * (1 - target) * rest, target, data.rest[rows] * rest,
            data.rewards[rows] * reward, known,
        ]  # fmt: skip
        predicted = self.net(torch.cat(inputs, dim=1))
        squared: Tensor = ((predicted - data.columns[rows]) * target).sum(1).square()
        return squared


def _fitted(data: _Steps, seen: npt.NDArray[Any], config: MeasurementConfig) -> _Predictor:
    predictor, rows = _Predictor(data, config.hidden), torch.from_numpy(seen)
    optimizer = torch.optim.Adam(predictor.parameters(), lr=config.learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, config.learning_rate, config.steps)
    for _ in range(config.steps):
        batch = rows[torch.randint(len(rows), (config.batch_size,))]
        dimensions = torch.randint(data.columns.shape[1], (config.batch_size,))
        known = torch.randint(2, (config.batch_size, 2)).float()
        loss = predictor.errors(data, batch, dimensions, known).mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
    return predictor


@torch.no_grad()
def _errors(
    predictor: _Predictor, data: _Steps, rows: IntArray, dimension: int
) -> list[list[Tensor]]:
    """Squared errors (B,) at `rows`, by whether the rest and whether the reward is known."""

    def of(known: tuple[int, int]) -> Tensor:
        parts = []
        for chunk in torch.split(torch.from_numpy(rows), _CHUNK):
            dimensions = torch.full((len(chunk),), dimension)
            given = torch.tensor(known).float().expand(len(chunk), 2)
            parts.append(predictor.errors(data, chunk, dimensions, given))
        return torch.cat(parts)

    return [[of((rest, reward)) for reward in (0, 1)] for rest in (0, 1)]


def held_out_of(episodes: IntArray) -> npt.NDArray[np.bool_]:
    """Which steps are held out: those of every fifth episode."""
    return np.asarray(episodes % _HELD_OUT_EVERY == _HELD_OUT_EVERY // 2)


def standardised(values: Tensor) -> Tensor:
    """Columns with mean 0 and standard deviation 1, clipped; constant ones are 0."""
    std, mean = torch.std_mean(values, dim=0)
    return ((values - mean) / torch.where(std > 1e-6, std, 1.0)).clamp(-CLIP, CLIP)


def clustered_p_value(differences: Tensor, episodes: IntArray) -> float:
    """Of a mean of at most 0, one-sided, where whole episodes (not steps) are independent.

    Args:
        differences: (B,).
        episodes: (B,) of which episode each is.
    """
    _, cluster = np.unique(episodes, return_inverse=True)
    counts = np.bincount(cluster)
    values = differences.double().numpy()
    residual = np.bincount(cluster, values) - counts * values.mean()
    # Cluster-robust standard error of the mean.
    error = np.sqrt((residual**2).sum() * len(counts) / (len(counts) - 1)) / len(values)
    return float(stats.t.sf(values.mean() / max(error, 1e-300), len(counts) - 1))
