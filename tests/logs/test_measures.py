"""Moments of batches are those of all numbers; distributions equal those that pandas finds."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.support.logs import store_of
from ucfrec import schema
from ucfrec.arrays import Array
from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs import measures
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.logs.measures import Moments


def test_batches_give_the_moments_of_all() -> None:
    generator = np.random.default_rng(0)
    values = 1e9 + generator.normal(size=(2, 1000)) * [[1], [3]]
    moments = Moments(2)
    for part in np.split(values, [0, 1, 10, 700], axis=1):
        moments.add(*part)
    assert moments.count == 1000
    np.testing.assert_allclose(moments.mean, values.mean(axis=1), rtol=1e-15)
    np.testing.assert_allclose(moments.covariance, np.cov(values, ddof=0), rtol=1e-6)


START = 1_700_000_000_000


def prepared(tmp_path: Path, rewards: Array, mapping: LogMapping | None = None) -> EpisodeStore:
    """A store of sessions of several lengths, with items of several popularities."""
    generator = np.random.default_rng(0)
    rows = len(rewards)
    log = pd.DataFrame(
        {
            "user_id": np.sort(generator.geometric(0.05, rows)),
            "item_id": generator.geometric(0.2, rows),
            "timestamp": START + np.arange(rows) * 1000,
            "reward": rewards,
        }
    ).sample(frac=1, random_state=1)
    return store_of(log, tmp_path, mapping or LogMapping(), split=(1.0, 0.0, 0.0), embedding_size=2)


def counted(values: Array, found: dict[str, Any]) -> None:
    """Check bins and quantiles against the values themselves."""
    edges = found["edges"]
    expected = [((values >= a) & (values < b)).sum() for a, b in itertools.pairwise(edges)]
    assert [*found["counts"]] == expected
    assert sum(expected) == len(values)
    exact = np.quantile(values, [float(q) for q in found["quantiles"]], method="inverted_cdf")
    assert list(found["quantiles"].values()) == pytest.approx(exact.tolist())


def test_lengths_popularity_and_few_rewards(tmp_path: Path) -> None:
    rewards = np.random.default_rng(1).integers(3, size=900) / 2
    store = prepared(tmp_path, rewards)
    summary = store.record.source.model_dump()["summary"]
    counted(store.lengths, summary["session_lengths"])
    assert summary["session_lengths"]["edges"][:4] == (1, 2, 4, 8)
    items = store.step_values(schema.ITEM, *store.all_steps())
    counted(np.bincount(items), summary["item_popularity"])
    assert [*summary["rewards"]["values"]] == [0, 0.5, 1]
    assert [*summary["rewards"]["counts"]] == np.bincount((rewards * 2).astype(int)).tolist()


def test_items_that_were_never_shown_are_counted(tmp_path: Path) -> None:
    pd.DataFrame({"item_id": range(1, 301), "price": 1.5}).to_csv(tmp_path / "f.csv", index=False)
    features = (FeatureTable((tmp_path / "f.csv",), "item_id"),)
    store = prepared(tmp_path, np.arange(400) % 2, LogMapping(item_features=features))
    popularity = store.record.source.model_dump()["summary"]["item_popularity"]
    shown = len(np.unique(store.step_values(schema.ITEM, *store.all_steps())))
    assert popularity["edges"][:2] == (0, 1)
    assert popularity["counts"][0] == 300 - shown
    assert sum(popularity["counts"]) == 300


def test_many_rewards_fall_into_equal_bins_and_none_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rewards = np.random.default_rng(1).standard_cauchy(1200)
    found = prepared(tmp_path, rewards).record.source.model_dump()["summary"]["rewards"]
    assert len(found["counts"]) == 20
    assert sum(found["counts"]) == 1200
    np.testing.assert_allclose(np.diff(found["edges"]), np.ptp(found["edges"]) / 20)
    low, high = found["quantiles"]["0.01"], found["quantiles"]["0.99"]
    assert (found["edges"][0], found["edges"][-1]) == pytest.approx((low, high))
    assert low == pytest.approx(np.quantile(rewards, 0.01, method="inverted_cdf"))
    inner = np.histogram(rewards, found["edges"])[0][1:-1]
    assert np.abs(np.array(found["counts"][1:-1]) - inner).max() <= 1  # a value on an edge
    assert found["counts"][0] == (rewards < found["edges"][1]).sum()
    # A larger log is sampled, to the same answer whatever the order of its rows.
    monkeypatch.setattr(measures, "SAMPLE_ROWS", 400)
    (tmp_path / "again").mkdir()
    sampled = prepared(tmp_path / "again", rewards).record.source.model_dump()["summary"]["rewards"]
    assert abs(sampled["quantiles"]["0.5"]) < 0.5
    assert sum(sampled["counts"]) == 1200
