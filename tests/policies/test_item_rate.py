"""The item's rate: what it equals, and that nothing but the item matters."""

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support.tagged import tagged_store
from ucfrec.episodes.item_counts import TrainingCounts
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.policies.item_rate import liked_rates
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy


def test_rates_are_shrunk_to_the_mean() -> None:
    counts = TrainingCounts(torch.tensor([0, 10, 1000]), torch.tensor([0, 10, 100]), 5)
    mean = 110.5 / 1011
    expected = [mean, (10 + 10 * mean) / 20, (100 + 10 * mean) / 1010]
    np.testing.assert_allclose(liked_rates(counts), expected, rtol=1e-6)


def test_the_best_item_is_shown_first_and_tags_are_left_out(tmp_path: Path) -> None:
    store = tagged_store(tmp_path)
    settings = ["rule.choose=false", "rule.default_tag_window=2", "policy.context=4"]
    train_run(store, tmp_path / "run", resolve_config("item-rate", None, settings))
    trained = TrainedPolicy.load(tmp_path / "run")
    assert trained.rule.tag_window == 2
    counts = TrainingCounts.of(store.split("train"))
    order = liked_rates(counts).argsort(descending=True, stable=True)
    actor = trained.actor(3)
    actor.begin(np.arange(3))
    shown = []
    for _ in range(3):
        items, _ = actor.act(np.zeros((3, 0), dtype=np.float32), np.ones(3, dtype=bool))
        actor.observe(items, np.ones(3, dtype=np.float32))
        assert len(set(items)) == 1
        shown.append(int(np.flatnonzero(trained.item_ids == items[0])[0]))
    assert shown[0] == int(order[0])
    tags = store.item_states.tags
    kept = [set(tags[item].tolist()) - {-1} for item in shown]
    assert not kept[0] & kept[1]
    assert not kept[2] & (kept[0] | kept[1])


def test_vectors_have_no_rate(tmp_path: Path) -> None:
    columns = {
        "observation": np.zeros((8, 2), dtype=np.float32),
        "action": np.zeros((8, 1), dtype=np.float32),
        "reward": np.arange(8, dtype=np.float32),
    }
    store = EpisodeStore.write(tmp_path / "store", columns, np.array([4, 4]))
    with pytest.raises(InputError, match="store of items"):
        train_run(store, tmp_path / "run", resolve_config("item-rate", None, []))
