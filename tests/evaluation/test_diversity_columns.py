"""Variety columns of result rows against plain loops over what an environment and a log say."""

import itertools
import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch

from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.rollout import rollout
from ucfrec.acting.uniform import Uniform
from ucfrec.episodes.item_counts import TrainingCounts
from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.diversity import Recommended
from ucfrec.evaluation.diversity_columns import COLUMNS, variety_columns
from ucfrec.evaluation.environment import Environment
from ucfrec.evaluation.evaluate import evaluate_behavior, evaluate_policy
from ucfrec.evaluation.simulated_store import simulated_store
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.start import training_views
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_simulators.kuai.environment import EXITS, KuaiEnv

TAGS = [(0,), (0, 1), (2,), (), (1, 2), (3,)]


def test_columns_are_those_of_plain_loops() -> None:
    rewards = np.random.default_rng(0).random((5, 6)).astype(np.float32)
    env = KuaiEnv(4, rewards, TAGS, EXITS["dorl"], item_ids=np.arange(6) + 10)
    seen = Recommended()
    rollout(env, Uniform(env, 0), 7, 0, seen.record)
    shown, liked = torch.tensor([5, 0, 3, 2, 9, 4]), torch.tensor([9, 0, 1, 1, 0, 1])
    numbers = np.array([1, 0, 2, 3, -1, 5])
    row = variety_columns(env, seen, TrainingCounts(shown, liked, 20), numbers)

    episodes, items = seen.sessions()
    tags = [set(own) or {-1} for own in TAGS]
    popular, positive = [0.0] * 6, Counter[int]()
    for log, number in enumerate(numbers.tolist()):
        if number >= 0:
            popular[number] = int(shown[log]) / 20
            positive.update({tag: int(liked[log]) for tag in tags[number]})
    rarest = min(p for p in popular if p)
    own = []
    for episode in set(episodes.tolist()):
        pairs = list(itertools.combinations(items[episodes == episode].tolist(), 2))
        apart = [1 - len(tags[a] & tags[b]) / len(tags[a] | tags[b]) for a, b in pairs]
        own.append(sum(apart) / len(apart) if apart else 1.0)
    dominant, covered = set(), 0
    for tag, count in sorted(positive.items(), key=lambda pair: (-pair[1], pair[0])):
        covered += count
        dominant |= {tag} if covered <= 0.8 * positive.total() else set()
    expected = [
        len(set(items.tolist())) / 6,
        len(set(items.tolist())) / len(items),
        sum(own) / len(own),
        sum(-math.log(max(popular[i], rarest)) for i in items) / len(items),
        sum(bool(tags[i] & dominant) for i in items) / len(items),
    ]
    np.testing.assert_allclose([row[name] for name in COLUMNS], expected)


def test_what_is_unknown_is_null() -> None:
    catalog = evaluate_behavior(Environment("synthetic-catalog"), "random", 20, 0)
    assert not {"novelty", "majority_category_dominance"} & catalog.metrics.keys()
    assert 0 < catalog["diversity"] <= 1
    taobao = evaluate_behavior(Environment("synthetic-taobao"), "random", 5, 0)
    assert not set(COLUMNS) & taobao.metrics.keys()


def test_a_run_knows_its_training_log(tmp_path: Path) -> None:
    environment = Environment("synthetic-catalog")
    store = EpisodeStore.open(simulated_store(environment, tmp_path, 60, 0))
    settings = ("train.steps=2", "train.validate_every=2", "policy.dim=8")
    train_run(store, tmp_path / "run", resolve_config("popular", None, settings))
    trained = TrainedPolicy.load(tmp_path / "run")
    train, _ = training_views(store)
    shown, liked = Counter[int](), Counter[int]()
    for episode, step in zip(*train.all_steps(), strict=True):
        item = int(train.step_values("item", episode[None], step[None])[0])
        shown[item] += 1
        liked[item] += int(train.step_values("reward", episode[None], step[None])[0])
    assert trained.counts is not None
    assert trained.counts.shown.tolist() == [shown[item] for item in range(200)]
    assert trained.counts.liked.tolist() == [liked[item] for item in range(200)]
    best = DecisionRule(1.0)
    row = evaluate_policy(environment, trained, "popular", 10, 0, best)
    # The one item that it shows is the one shown most.
    assert row["novelty"] == pytest.approx(-math.log(max(shown.values()) / train.n_episodes))
    assert row["majority_category_dominance"] in (0.0, 1.0)
