"""Stability indices: the formula, and that they rise with the change."""

from pathlib import Path

import numpy as np
import pytest

from tests.support.later import later_log, later_mapping
from tests.support.served import trained_run
from tests.support.tagged import ITEMS
from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs.append import append_logs
from ucfrec.updating.drift import (
    describe,
    popularity_index,
    restrict_to_run,
    reward_index,
    stability_index,
)


def test_the_index_is_that_of_the_formula() -> None:
    old, new = np.array([5000.0, 5000.0]), np.array([6000.0, 4000.0])
    expected = 0.1 * np.log(0.6 / 0.5) - 0.1 * np.log(0.4 / 0.5)
    assert stability_index(old, new) == pytest.approx(expected, rel=1e-3)
    assert stability_index(old, 3 * old) == pytest.approx(0, abs=1e-6)


def test_popularity_that_moves_to_rare_items_is_seen() -> None:
    rng = np.random.default_rng(0)
    shares = 1 / np.arange(1, 101)
    old = rng.multinomial(100_000, shares / shares.sum())
    same = rng.multinomial(5000, shares / shares.sum())
    assert popularity_index(old, same) < 0.02
    assert popularity_index(old, same[::-1]) > 0.25


def test_rewards_of_two_values_and_of_many_are_compared() -> None:
    rng = np.random.default_rng(0)
    clicks = (rng.random((2, 5000)) < 0.1) * 1.0
    assert reward_index(*clicks) < 0.01
    assert reward_index(clicks[0], (rng.random(5000) < 0.5) * 1.0) > 0.25
    prices = rng.lognormal(size=(2, 5000))
    assert reward_index(*prices) < 0.02
    assert reward_index(prices[0], 3 * prices[1]) > 0.25


def test_drift_is_described_with_and_without_a_reward_model() -> None:
    found = {"unknown_items": 0.1, "unknown_users": 0.5, "item_popularity": 0.3, "rewards": 0.01}
    assert "10.0% of the new rows have new items, 50.0% new users" in describe(found)
    model = {"predicted": 0.2, "observed": 0.3, "calibration_error": 0.1, "slope": 0.9}
    assert "predicts 0.2, observed 0.3" in describe(found | model)


def test_unknown_items_and_users_have_no_number(tmp_path: Path) -> None:
    trained = trained_run(tmp_path)
    later_log().to_parquet(tmp_path / "later.parquet")
    logs, mapping = [tmp_path / "later.parquet"], later_mapping(tmp_path)
    append_logs(tmp_path / "store", logs, tmp_path / "grown", mapping)
    newest = EpisodeStore.open(tmp_path / "grown").split("test")
    known = restrict_to_run(newest, trained)
    items = newest.step_values("item", *newest.all_steps())
    expected = np.where(items < ITEMS, items, -1)
    assert (expected < 0).any()
    np.testing.assert_array_equal(known.step_values("item", *known.all_steps()), expected)
    np.testing.assert_array_equal(known.lengths, newest.lengths)
    assert known.state_size == trained.record.sizes["state"]
    assert known.episode_values("user").max() < len(trained.user_ids)
