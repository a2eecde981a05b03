"""How long the cells of a benchmark will take here, from the time of a few steps of each."""

import time
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
import torch

from ucfrec.episodes.store import EpisodeStore
from ucfrec.fitting.random_state import random_state_kept
from ucfrec.runs.start import new_policy, training_views
from ucfrec_control.benchmark.cells import Cell
from ucfrec_control.environments.environments import SIDE_BY_SIDE, environment_of_data, make_env
from ucfrec_control.learners.rl_baselines import ALGORITHMS, timed_updates
from ucfrec_control.learners.train import dataset_of

_TIMED: Final = 5
_WARM: Final = 2
_EPISODE_STEPS: Final = 1000
"""Longest episode of the tasks."""


def estimated_hours(cells: Sequence[Cell], workers: int) -> float:
    """Hours that training and evaluation take, without reward models and generators; an upper bound
    where episodes end early.

    Steps are timed once for each task, learner and setting, on one thread.

    Args:
        cells: of `ucfrec_control.benchmark.plan.cells_of`, whose stores exist.
        workers: number of processes, each with a core of its own.
    """
    trained: dict[object, float] = {}
    played: dict[object, float] = {}
    threads, total = torch.get_num_threads(), 0.0
    torch.set_num_threads(1)
    try:
        for cell in cells:
            environment = environment_of_data(dataset_of(EpisodeStore.open(cell.store)))
            kind = (environment, cell.learner, cell.settings, *cell.rl.items())
            if kind not in trained:
                trained[kind] = _training(cell)
            if not cell.episodes:
                total += trained[kind]
                continue
            if environment not in played:
                played[environment] = _step_of(environment, cell.episodes)
            rounds = -(-cell.episodes // SIDE_BY_SIDE) * _EPISODE_STEPS
            both = 1 if cell.learner in ALGORITHMS else 2
            evaluated = both * rounds * played[environment] * max(1, len(cell.targets))
            total += trained[kind] + evaluated
    finally:
        torch.set_num_threads(threads)
    return total / workers / 3600


def announcement(workers: int) -> Callable[[Sequence[Cell]], str]:
    """What a benchmark of so many processes says of the cells that are left, before it starts."""

    def said(cells: Sequence[Cell]) -> str:
        hours = estimated_hours(cells, workers)
        return (
            f"about {hours:.1f} hours here with --workers {workers}, by the time of a few steps of "
            "each training; reward models, generators and screening are not counted"
        )

    return said


@random_state_kept()
def _training(cell: Cell) -> float:
    """Seconds of all updates of a cell's training."""
    store = EpisodeStore.open(cell.store)
    if cell.learner in ALGORITHMS:
        return cell.rl_config.steps * timed_updates(store, cell.rl_config, _TIMED)
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


def _step_of(environment: str, episodes: int) -> float:
    """Seconds of one step of the episodes that are played side by side."""
    env = make_env(environment, min(episodes, SIDE_BY_SIDE))
    env.reset(seed=0)
    seconds = _seconds(lambda: env.step(env.action_space.sample()))
    env.close()
    return seconds


def _seconds(action: Callable[[], object]) -> float:
    """Seconds of one call, once it is warm."""
    for _ in range(_WARM):
        action()
    began = time.perf_counter()
    for _ in range(_TIMED):
        action()
    return (time.perf_counter() - began) / _TIMED
