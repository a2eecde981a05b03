"""Clicks and click rate that forget: the half-life that fits the validation rows, and its use."""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.support.logs import store_of
from ucfrec.episodes.item_counts import TrainingCounts
from ucfrec.episodes.store import EpisodeStore
from ucfrec.policies.recent import HALF_LIVES, RecentClicksPolicy, RecentRatePolicy, decayed_counts
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy

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
    whole, half = decayed_counts(train, math.inf), decayed_counts(train, 24.0)
    exact = TrainingCounts.of(train)
    torch.testing.assert_close(whole.shown, exact.shown.double())
    torch.testing.assert_close(whole.liked, exact.liked.double())
    times = train.column("timestamp")
    weights = 0.5 ** ((times.max() - times) / 86_400_000)
    expected = np.bincount(train.column("item"), weights, ITEMS)
    np.testing.assert_allclose(half.shown, expected, rtol=1e-9)


@pytest.mark.parametrize("kind", [RecentRatePolicy, RecentClicksPolicy])
def test_the_half_life_is_short_where_tastes_change(
    tmp_path: Path, kind: type[RecentRatePolicy]
) -> None:
    found = {}
    for drifts in (False, True):
        (tmp_path / str(drifts)).mkdir()
        store = drifting_store(tmp_path / str(drifts), drifts)
        found[drifts] = kind.best(store.split("train"), store.split("validation"))
    assert found[True] <= 24 < 96 <= found[False]
    assert {*found.values()} <= {*HALF_LIVES}


def test_a_run_beats_the_item_rate_where_tastes_change(tmp_path: Path) -> None:
    store = drifting_store(tmp_path, drifts=True)
    test, rates = store.split("test"), []
    liked = test.column("reward") > 0
    for name in ("item-rate", "recent-rate", "recent-clicks"):
        run = tmp_path / name
        train_run(store, run, resolve_config(name, None, ["rule.choose=false"]))
        policy = TrainedPolicy.load(run).policy
        best = policy.head.bias.topk(5).indices.numpy()  # type: ignore[operator]
        shown = np.isin(test.column("item"), best)
        rates.append(liked[shown].mean())
    assert min(rates[1:]) > rates[0] + 0.1
