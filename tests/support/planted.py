"""A reward whose truth is known: r = f(s, a) + u, with u of 30% of the variance."""

import functools
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.counterfactual.reward_model import CausalRewardModel, CRMConfig, CRMReport, fit_crm
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Transitions

STATE, ACTION = 7, 2
CONSTANT = 6
"""The state dimension that never varies; 3, 4 and 5 are no causes of the reward."""
_F_STD = 0.993
"""Of f over the planted states and actions."""
STEPS, EPISODES = 3_000, 60
"""Of `planted_store`."""
FIT = CRMConfig(epochs=6, learning_rate=2e-3)


def f(states: Tensor, actions: Tensor) -> Tensor:
    return (
        torch.sin(1.5 * states[:, 0])
        + 0.5 * states[:, 1] * actions[:, 0]
        + 0.5 * torch.tanh(states[:, 2] + actions[:, 1])
    )


@dataclass(frozen=True)
class Planted:
    transitions: Transitions
    disturbance: Tensor


def planted(steps: int, seed: int, share: float = 0.3) -> Planted:
    rng = np.random.default_rng(seed)
    mixing = np.eye(CONSTANT) + 0.4 * np.random.default_rng(99).normal(size=(CONSTANT, CONSTANT))
    varying = rng.normal(size=(steps, CONSTANT)) @ mixing
    states = np.concatenate([varying, np.full((steps, 1), 0.1)], axis=1)
    s = torch.from_numpy(states.astype(np.float32))
    a = torch.from_numpy(rng.normal(size=(steps, ACTION)).astype(np.float32))
    u = torch.from_numpy(rng.normal(size=steps).astype(np.float32))
    u = u * _F_STD * (share / (1 - share)) ** 0.5
    last = torch.zeros(steps, dtype=torch.bool)
    return Planted(Transitions(s, a, f(s, a) + u, torch.zeros_like(s), last), u)


@functools.cache
def fitted() -> tuple[CausalRewardModel, CRMReport]:
    """The reward model of the planted truth, fitted once for all tests."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        train, held_out = planted(20_000, 0).transitions, planted(4_000, 1).transitions
        return fit_crm(train, held_out, FIT, Path(folder), seed=0)


def affine_correlation(z: Tensor, u: Tensor) -> float:
    """Correlation of u with the affine map of z nearest to it."""
    columns = torch.cat([z, torch.ones(len(z), 1)], dim=1).double()
    weights = torch.linalg.lstsq(columns, u.double().unsqueeze(1)).solution
    return float(torch.corrcoef(torch.stack([(columns @ weights)[:, 0], u.double()]))[0, 1])


@functools.cache
def planted_store() -> EpisodeStore:
    """Planted steps in episodes of unequal length, the last ten for validation."""
    rng = np.random.default_rng(5)
    cuts = np.sort(rng.choice(np.arange(1, STEPS), EPISODES - 1, replace=False))
    t = planted(STEPS, 3).transitions
    columns = {schema.OBSERVATION: t.states.numpy(), schema.ACTION: t.actions.numpy()}
    columns[schema.REWARD] = t.rewards.numpy()
    split = (np.arange(EPISODES) >= EPISODES - 10).astype(np.uint8)
    folder = Path(tempfile.mkdtemp()) / "store"
    lengths = np.diff(np.concatenate([[0], cuts, [STEPS]]))
    return EpisodeStore.write(folder, columns, lengths, {schema.SPLIT: split})
