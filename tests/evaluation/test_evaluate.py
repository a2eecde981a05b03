"""Coverage, diversity and novelty against plain loops, and what must never hold."""

import math
from collections import Counter
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.rollout import Uniform, rollout
from ucfrec.episodes.states import TrainingCounts
from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.collect import collect_store
from ucfrec.evaluation.evaluate import (
    diversity,
    evaluate_behavior,
    evaluate_policy,
    variety_columns,
)
from ucfrec.evaluation.simulator import COLUMNS, Environment
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.start import training_views
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_simulators.kuai.environment import EXITS, KuaiEnv

N, TAGS = 12, 5


def environment(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    lengths = rng.integers(1, 7, size=rng.integers(1, 8))
    episodes = np.repeat(np.arange(len(lengths)), lengths)
    items = rng.integers(N, size=len(episodes))
    return episodes, items, rng.random((N, TAGS)) < 0.4


@given(st.integers(0, 999))
def test_diversity_is_that_of_a_plain_loop(seed: int) -> None:
    episodes, items, incidence = environment(seed)

    def jaccard(a: int, b: int) -> float:
        one, other = set(np.flatnonzero(incidence[a])), set(np.flatnonzero(incidence[b]))
        return 1.0 if a == b else len(one & other) / max(len(one | other), 1)

    own = []
    for episode in np.unique(episodes):
        shown = items[episodes == episode].tolist()
        pairs = [1 - jaccard(a, b) for a, b in combinations(shown, 2)]
        own.append(np.mean(pairs) if pairs else 1.0)
    assert diversity(episodes, items, incidence) == pytest.approx(np.mean(own))


TAGS_OF_ITEMS = [(0,), (0, 1), (2,), (), (1, 2), (3,)]


def test_columns_are_those_of_plain_loops() -> None:
    rewards = np.random.default_rng(0).random((5, 6)).astype(np.float32)
    env = KuaiEnv(4, rewards, TAGS_OF_ITEMS, EXITS["dorl"], item_ids=np.arange(6) + 10)
    seen: list[tuple[np.ndarray, np.ndarray]] = []
    rollout(env, Uniform(env, 0), 7, 0, lambda step: seen.append((step.episodes, step.actions)))
    shown, liked = torch.tensor([5, 0, 3, 2, 9, 4]), torch.tensor([9, 0, 1, 1, 0, 1])
    numbers = np.array([1, 0, 2, 3, -1, 5])
    row = variety_columns(env, seen, TrainingCounts(shown, liked, 20), numbers)
    steps = np.hstack(seen)
    episodes, items = steps[:, steps[0].argsort(kind="stable")]
    tags = [set(own) or {-1} for own in TAGS_OF_ITEMS]
    popular = [0.0] * 6
    for log, number in enumerate(numbers.tolist()):
        if number >= 0:
            popular[number] = int(shown[log]) / 20
    rarest = min(p for p in popular if p)
    incidence = np.array([[tag in own for tag in range(-1, 4)] for own in tags])
    expected = [
        len(set(items.tolist())) / 6,
        len(set(items.tolist())) / len(items),
        diversity(episodes, items, incidence),
        sum(-math.log(max(popular[i], rarest)) for i in items) / len(items),
    ]
    np.testing.assert_allclose([row[name] for name in COLUMNS], expected)


def test_what_is_unknown_is_null() -> None:
    catalog = evaluate_behavior(Environment("synthetic-catalog"), "random", 20, 0)
    assert "novelty" not in catalog.metrics
    assert 0 < catalog["diversity"] <= 1
    taobao = evaluate_behavior(Environment("synthetic-taobao"), "random", 5, 0)
    assert not set(COLUMNS) & taobao.metrics.keys()


def test_a_run_knows_its_training_log(tmp_path: Path) -> None:
    environment = Environment("synthetic-catalog")
    store = EpisodeStore.open(collect_store(environment, tmp_path, 60, 0))
    settings = ("train.steps=2", "train.validate_every=2", "policy.dim=8")
    train_run(store, tmp_path / "run", resolve_config("popular", None, settings))
    trained = TrainedPolicy.load(tmp_path / "run")
    train, _ = training_views(store)
    shown, liked = Counter[int](), Counter[int]()
    for episode, step in zip(*train.all_steps(), strict=True):
        item = int(train.step_values("item", episode[None], step[None])[0])
        shown[item] += 1
        liked[item] += int(train.step_values("reward", episode[None], step[None])[0])
    assert trained.counts.shown.tolist() == [shown[item] for item in range(200)]
    assert trained.counts.liked.tolist() == [liked[item] for item in range(200)]
    best = DecisionRule(1.0)
    row = evaluate_policy(environment, trained, "popular", 10, 0, best)
    # The one item that it shows is the one shown most.
    assert row["novelty"] == pytest.approx(-math.log(max(shown.values()) / train.n_episodes))
