"""Popular items, rates and recent ones: what they equal, and the half-life that fits best."""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.support.logs import store_of
from tests.support.tagged import tagged_store
from ucfrec.commands.cli import main
from ucfrec.episodes.states import TrainingCounts
from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.baselines import (
    _PENALTY,
    BoostedPolicy,
    RecentClicksPolicy,
    RecentRatePolicy,
    _fit_pairs,
    shrink_rates,
)
from ucfrec.results.rows import read_results
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.start import new_policy
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.user_model.running import HALF_LIVES_OF_DEMAND

ITEMS, DAYS = 20, 10


def drifting_store(folder: Path, drifts: bool) -> EpisodeStore:
    """A log in which, if it drifts, other items are liked every day."""
    rng, n = np.random.default_rng(0), 8000
    log = pd.DataFrame(
        {"user_id": rng.integers(60, size=n), "item_id": rng.integers(ITEMS, size=n)}
    )
    days = np.sort(rng.random(n)) * DAYS
    log["timestamp"] = 1_700_000_000_000 + (days * 86_400_000).astype(np.int64)
    favourite = (log.item_id + (days.astype(int) if drifts else 0)) % 10 < 3
    log["reward"] = (rng.random(n) < np.where(favourite, 0.8, 0.1)).astype(float)
    return store_of(log, folder, reward="reward", session_by="user", split=(0.85, 0.05, 0.1))


def test_counts_halve_with_every_half_life(tmp_path: Path) -> None:
    train = drifting_store(tmp_path, drifts=False).split("train")
    times, items = train.column("timestamp"), train.column("item")
    for half_life in (math.inf, 24.0):
        counts = TrainingCounts.of(train, half_life=half_life)
        weights = 0.5 ** ((times.max() - times) / 3_600_000 / half_life)
        np.testing.assert_allclose(counts.shown, np.bincount(items, weights, ITEMS), rtol=1e-9)
        weights *= train.column("reward")
        np.testing.assert_allclose(counts.liked, np.bincount(items, weights, ITEMS), rtol=1e-9)


@pytest.mark.parametrize("kind", [RecentRatePolicy, RecentClicksPolicy])
def test_drift_shortens_half_lives(tmp_path: Path, kind: type[RecentRatePolicy]) -> None:
    for drifts in (False, True):
        (folder := tmp_path / str(drifts)).mkdir()
        store = drifting_store(folder, drifts)
        mixture = kind.choose_mixture(store.split("train"), store.split("validation"))
        short = mixture[torch.tensor(HALF_LIVES_OF_DEMAND) <= 24].sum()
        assert short > 0.2 if drifts else short < 0.01


def test_rates_are_shrunk_to_the_mean() -> None:
    counts = TrainingCounts(torch.tensor([0, 10, 1000]), torch.tensor([0, 10, 100]), 5)
    mean = 110.5 / 1011
    expected = [mean, (10 + 10 * mean) / 20, (100 + 10 * mean) / 1010]
    np.testing.assert_allclose(shrink_rates(counts), expected, rtol=1e-6)


def test_the_best_item_is_shown_first_and_tags_are_left_out(tmp_path: Path) -> None:
    store = tagged_store(tmp_path)
    settings = ["rule.choose=false", "rule.default_tag_window=2", "policy.context=4"]
    train_run(store, tmp_path / "run", resolve_config("item-rate", None, settings))
    trained, shown = TrainedPolicy.load(tmp_path / "run"), list[int]()
    order = shrink_rates(TrainingCounts.of(store.split("train"))).argsort(descending=True)
    actor = trained.actor(1)
    actor.begin(np.arange(1))
    for _ in range(3):
        items, _ = actor.act(np.zeros((1, 0), dtype=np.float32), np.ones(1, dtype=bool))
        actor.observe(items, np.ones(1, dtype=np.float32))
        shown.append(int(np.flatnonzero(trained.item_ids == items[0])[0]))
    assert shown[0] == int(order[0])
    seen = [set(store.item_states.tags[item].tolist()) - {-1} for item in shown]
    assert not seen[0] & seen[1]
    assert not seen[2] & (seen[0] | seen[1])


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> EpisodeStore:
    """Users who like the items of one of four kinds; a policy of no user has a GAUC of .5."""
    folder, rng, n = tmp_path_factory.mktemp("peers"), np.random.default_rng(0), 12_000
    log = pd.DataFrame({"user_id": rng.integers(120, size=n), "item_id": rng.integers(40, size=n)})
    own = log.user_id % 4 == log.item_id % 4
    log["reward"] = (rng.random(n) < np.where(own, 0.8, 0.05)).astype(float)
    log["timestamp"] = 1_700_000_000_000 + 60_000 * np.arange(n)
    # Most of what is shown was liked: gSASRec sees which items were shown, and no rewards.
    log = log[(log.reward > 0) | (rng.random(n) < 0.05)]
    return store_of(log, folder, reward="reward", session_by="user")


@pytest.mark.parametrize("name", ["gsasrec", "boosted"])
def test_peers_win_where_users_differ(store: EpisodeStore, tmp_path: Path, name: str) -> None:
    run, out = str(tmp_path / name), tmp_path / "rows.json"
    settings = ["train.steps=300", "train.learning_rate=0.01", "train.validate_every=100"]
    settings += ["policy.dim=16", "policy.context=10", "rule.choose=false", "train.warmup_steps=0"]
    words = [word for each in settings for word in ("--set", each)]
    command = ["train", str(store.path), "--out", run, "--policy", name, *words, "--no-refit"]
    assert main(command) == 0
    assert main(["rank", run, "--keep-seen", "--json", str(out)]) == 0
    rows = {row.method: row.metrics for row in read_results(out)}
    best = max(rows[other]["hit_rate_liked"] for other in ("most clicked", "item click rate"))
    assert rows[name]["hit_rate_liked"] > best + 0.15
    assert rows[name]["gauc"] > 0.7


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[BoostedPolicy, EpisodeStore]:
    store = tagged_store(tmp_path_factory.mktemp("boosted")).split("train")
    settings = {"policy.context": 6, "policy.boosted": 5}
    policy = new_policy(store, resolve_config("boosted", None, settings)).eval()
    policy.make_solver(store, None, Path(), 0)()
    return policy, store


def test_only_the_best_items_are_boosted(fitted: tuple[BoostedPolicy, EpisodeStore]) -> None:
    policy, store = fitted
    windows = store.windows(*store.locate(np.arange(40)), 6)
    scores = policy.act(windows)
    rates = policy._rate(policy.liked, policy.impressions)
    others = rates.argsort(descending=True)[5:]
    apart = scores[:, others] - rates[others]
    torch.testing.assert_close(apart, apart[:, :1].expand_as(apart))
    best = rates.topk(5).indices
    torch.testing.assert_close(scores[:, best], policy._score(windows, best))


def test_a_row_does_not_tell_the_trees_what_they_predict(
    fitted: tuple[BoostedPolicy, EpisodeStore],
) -> None:
    """The rate of an item is the same in a fold whether the row itself was liked or not."""
    policy, store = fitted
    inputs, liked = policy._training_rows(store, np.arange(store.n_steps))
    episodes, items = store.all_steps()[0], store.column("item")
    for item in range(3):
        rows = (items == item) & (episodes % 5 == 0)
        assert len(np.unique(inputs[rows, 0])) == 1
        assert {*liked[rows].tolist()} == {True, False}


def test_effects_of_pairs_are_a_ridge_regression_on_other_folds() -> None:
    """Where every fold has all pairs of two user attributes and six items equally often."""
    rng = np.random.default_rng(0)
    tags = np.array([[0, -1], [1, -1], [0, 1], [2, 0], [-1, -1], [2, 1]])
    kinds, items, folds = (values.ravel() for values in np.indices((2, 6, 5)).repeat(40, axis=1))
    context = np.column_stack([np.ones(len(kinds)), 2.0 * kinds - 1])
    has_tag = (tags[:, :, None] == np.arange(3)).any(axis=1)
    attributes = np.insert(has_tag.astype(float), 0, 1.0, axis=1)[items]
    residuals = 0.3 * context[:, 1] * attributes[:, 2] + rng.normal(size=len(kinds))
    predicted, effects = _fit_pairs(tags, items, context, residuals, folds)
    pairs = (context[:, :, None] * attributes[:, None, :]).reshape(len(kinds), -1)
    gram, others = pairs[folds != 0].T @ pairs[folds != 0], residuals[folds != 0]
    penalised = gram + _PENALTY * np.eye(len(gram))
    slopes = np.linalg.solve(penalised, pairs[folds != 0].T @ others)
    np.testing.assert_allclose(predicted[folds == 0], pairs[folds == 0] @ slopes, atol=1e-12)
    assert effects[1, 1] - effects[0, 1] > 0.1


def attribute_store(folder: Path, effect: float) -> EpisodeStore:
    """Users of two groups in short sessions; by an effect, each likes the items of one tag."""
    rng, n = np.random.default_rng(0), 12_000
    log = pd.DataFrame({"user_id": rng.integers(1000, size=n), "item_id": rng.integers(30, size=n)})
    own = log.user_id % 2 == log.item_id % 2
    log["reward"] = (rng.random(n) < np.where(own, 0.4 + effect, 0.4 - effect)).astype(float)
    log["timestamp"] = 1_700_000_000_000 + 60_000 * np.arange(n)
    names = [["red", "blue"][number % 2] for number in range(1000)]
    users = pd.DataFrame({"user_id": range(1000), "group": names})
    items = pd.DataFrame({"item_id": range(30), "tags": [[name] for name in names[:30]]})
    tables = []
    for key, frame in (("user_id", users), ("item_id", items)):
        frame.to_parquet(folder / f"{key}.parquet")
        tables.append((FeatureTable((folder / f"{key}.parquet",), key),))
    mapping = LogMapping(user_features=tables[0], item_features=tables[1])
    options = {"session_by": "user", "embedding_size": 4, "split": (0.5, 0.4, 0.1)}
    return store_of(log, folder, mapping, reward="reward", **options)


def fit_solved(store: EpisodeStore, name: str = "boosted") -> SequencePolicy:
    train = store.split("train")
    policy = new_policy(train, resolve_config(name, None, {"policy.context": 4})).eval()
    policy.start_from(train)
    policy.make_solver(train, store.split("validation"), Path(), 0)()
    return policy


def test_neighbours_count_where_sessions_show_no_item_twice(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    items = [rng.permutation(5)[:4] + 5 * rng.integers(4) for _ in range(300)]  # of four kinds
    log = pd.DataFrame({"user_id": np.arange(1200) // 4, "item_id": np.concatenate(items)})
    log = log.assign(reward=1.0, timestamp=1_700_000_000_000 + 60_000 * np.arange(1200))
    store = store_of(log, tmp_path, reward="reward", session_by="user")
    assert fit_solved(store, "item-knn").temperature > 4  # 2.3 if it could show items again


def test_users_with_an_attribute_get_items_with_the_tag_they_like(tmp_path: Path) -> None:
    store = attribute_store(tmp_path, effect=0.25)
    policy, test = fit_solved(store), store.split("test")
    episodes = np.arange(test.n_episodes)
    windows = test.windows(episodes, np.zeros_like(episodes), 4)  # without history
    scores, group = policy.act(windows), windows.states[:, -1, -1].numpy() > 0
    tagged = store.item_states.tags[:, 0] == 0
    gain = (scores[:, tagged].mean(1) - scores[:, ~tagged].mean(1)).numpy()
    shown, rewards = tagged.numpy()[test.column("item")], test.column("reward")
    for value in (False, True):
        rows = group[test.all_steps()[0]] == value
        liked = rewards[rows & shown].mean() - rewards[rows & ~shown].mean()
        assert (np.sign(liked) * gain[group == value]).min() > 0.5


def test_noise_grows_few_trees_and_a_refit_keeps_their_number(tmp_path: Path) -> None:
    numbers = []
    for effect in (0.0, 0.25):
        (tmp_path / str(effect)).mkdir()
        store = attribute_store(tmp_path / str(effect), effect)
        policy = fit_solved(store)
        numbers.append(int(policy.trees))
        train = store.split("train")
        refit = new_policy(train, resolve_config("boosted", None, {"policy.context": 4}))
        refit.start_from(train)
        refit.trees.copy_(policy.trees)
        refit.make_solver(train, None, Path(), 0)()
        torch.testing.assert_close(refit.state_dict(), policy.state_dict())
    assert numbers[0] < 10 < numbers[1]
