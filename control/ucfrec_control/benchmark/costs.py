"""What the cells of the control benchmarks cost here, by the time of a few steps of each."""

import time
from collections.abc import Callable
from functools import cache
from typing import Final

import numpy as np
import torch

from ucfrec.benchmark.cells import Cell, opened
from ucfrec.benchmark.suite import Costs
from ucfrec.processes import random_state_kept
from ucfrec.runs.start import new_policy, training_views
from ucfrec_control.benchmark.measure import rl_config_of, targets_of
from ucfrec_control.environments.environments import SIDE_BY_SIDE, environment_of_data, make_env
from ucfrec_control.training.rl_baselines import ALGORITHMS, timed_updates
from ucfrec_control.training.train import dataset_of

_TIMED: Final = 5
_WARM: Final = 2
_EPISODE_STEPS: Final = 1000
"""Longest episode of the tasks."""


def costs() -> Costs:
    """The costs of cells; steps are timed once for each task, policy and setting, on one thread."""
    trained: dict[object, float] = {}

    def training(cell: Cell) -> float:
        kind = _environment(cell), cell.policy, cell.settings
        if kind not in trained:
            trained[kind] = _training(cell)
        return trained[kind]

    return Costs(
        training,
        _evaluation,
        "by the time of a few steps of each training; reward models, generators and screening are "
        "not counted",
    )


def _environment(cell: Cell) -> str:
    return environment_of_data(dataset_of(opened(cell)))


def _evaluation(cell: Cell) -> float:
    """Seconds of all evaluated episodes; an upper bound where episodes end early."""
    episodes = cell.evaluation.episodes
    if not episodes:
        return 0.0
    rounds = -(-episodes // SIDE_BY_SIDE) * _EPISODE_STEPS
    checkpoints = 1 if cell.policy in ALGORITHMS else 2
    step = _environment_step(_environment(cell), min(episodes, SIDE_BY_SIDE))
    return checkpoints * rounds * step * max(1, len(targets_of(cell)))


@random_state_kept()
def _training(cell: Cell) -> float:
    """Seconds of all updates of a cell's training."""
    store = opened(cell)
    if cell.policy in ALGORITHMS:
        rl = rl_config_of(cell)
        return rl.steps * timed_updates(store, rl, _TIMED)
    config, (train, _) = cell.config, training_views(store)
    policy, generator = new_policy(train, config), np.random.default_rng(0)
    optimizer = torch.optim.AdamW(policy.parameters())

    def update() -> None:
        steps = train.draw_steps(generator, config.train.batch_size)
        loss, _ = policy.loss(train.windows(*steps, policy.config.context))
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()

    return config.train.steps * _seconds(update)


@cache
def _environment_step(environment: str, episodes: int) -> float:
    """Seconds of one step of the episodes that run side by side."""
    env = make_env(environment, episodes)
    env.reset(seed=0)
    seconds = _seconds(lambda: env.step(env.action_space.sample()))
    env.close()
    return seconds


def _seconds(action: Callable[[], object]) -> float:
    """Seconds of one call, once it is warm, on one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for _ in range(_WARM):
            action()
        began = time.perf_counter()
        for _ in range(_TIMED):
            action()
        return (time.perf_counter() - began) / _TIMED
    finally:
        torch.set_num_threads(threads)
