"""Fitted Q evaluation finds values that simulation finds too."""

from pathlib import Path

import numpy as np
import pytest

from ucfrec.episodes.store import EpisodeStore
from ucfrec_control.data.trajectories import Trajectories
from ucfrec_control.training.fqe import _Model

DISCOUNT, STEPS = 0.9, 20


def simulate(gain: float, noise: float, episodes: int, seed: int) -> tuple[np.ndarray, ...]:
    """States, actions and rewards (E, T) of s' = .8 s + a + ε, a = −gain·s + noise, r = 1 − s²."""
    rng = np.random.default_rng(seed)
    state, columns = rng.normal(size=episodes), []
    for _ in range(STEPS):
        action = -gain * state + noise * rng.normal(size=episodes)
        columns.append((state, action, 1 - state**2))
        state = 0.8 * state + action + 0.1 * rng.normal(size=episodes)
    return tuple(np.array(columns).transpose(1, 2, 0))


@pytest.mark.parametrize("gain", [0.0, 0.5])
def test_a_value_is_within_its_interval_of_the_simulated_one(tmp_path: Path, gain: float) -> None:
    states, actions, rewards = simulate(0.2, 0.4, 200, seed=0)
    # Neither the unit of what was observed nor the middle of the actions matters.
    flat = [v.reshape(-1, 1).astype(np.float32) for v in (states / 2**30, 1000 + actions)]
    lengths, cut = np.full(200, STEPS), np.zeros(200, dtype=bool)
    source = {"where": "here", "dataset": "line", "env_id": None, "versions": {}}
    logged = rewards.ravel().astype(np.float32)
    Trajectories(*flat, logged, lengths, cut, None, source).write_store(tmp_path / "store")
    model = _Model(EpisodeStore.open(tmp_path / "store"), DISCOUNT)
    fit = model.fit(1000 - gain * 2**30 * flat[0])
    assert fit.converged
    # All states of a policy count, so the simulated episodes have to last as long as they can.
    later = np.concatenate([simulate(gain, 0.0, 4000, seed)[2] for seed in (1, 2)])
    values = later @ DISCOUNT ** np.arange(STEPS)
    end = later[:, -1].mean() * DISCOUNT**STEPS / (1 - DISCOUNT)
    assert abs(fit.value - values.mean() - end) < max(2 * fit.half_width, 0.1)
    assert 0 < fit.half_width < 1
    # Of what was logged, the method says what it returned; what it adds later is no part of it.
    ending, returns = model.fit(flat[1], to_limit=True), rewards @ DISCOUNT ** np.arange(STEPS)
    assert ending.value == pytest.approx(returns.mean(), abs=0.1)
    later = model.estimate_later(ending.weights).mean()
    assert 0.5 < model.fit(flat[1]).value - ending.value == pytest.approx(later)
