"""Running rates are of earlier rows only, and tell what new items are worth."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.support.logs import START, store_of, write
from ucfrec import EpisodeStore, Recommender
from ucfrec.acting.decision import DecisionRule
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.user_model.running import AGES, HALF_LIVES, RunningRates

HOUR, DAY, ITEMS = 3_600_000, 86_400_000, 60


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> EpisodeStore:
    """Items live for two days; every second one is clicked often, which no feature says."""
    folder, rng = tmp_path_factory.mktemp("running"), np.random.default_rng(0)
    begins = START + (np.arange(ITEMS) - 8) * 6 * HOUR
    times = np.sort(START + rng.integers(0, 12 * DAY, 8000))
    alive = [np.flatnonzero((begins <= time) & (time < begins + 2 * DAY)) for time in times]
    items = np.array([rng.choice(some) for some in alive])
    clicked = rng.random(len(items)) < np.where(items % 2, 0.5, 0.1)
    log = pd.DataFrame({"user_id": rng.integers(300, size=len(items)), "item_id": items})
    log = log.assign(timestamp=times, reward=clicked * 1.0)
    table = pd.DataFrame({"item_id": range(ITEMS), "available_from": begins})
    table = table.assign(available_until=begins + 2 * DAY)
    features = FeatureTable((write(table, folder / "items.parquet"),), "item_id")
    return store_of(log, folder, LogMapping(item_features=(features,)))


def test_rates_and_ages_are_those_of_the_rows_before(store: EpisodeStore) -> None:
    rates = RunningRates.of(store, lambda rewards: rewards)
    assert rates is not None
    items, times, rewards = (store.column(name) for name in ("item", "timestamp", "reward"))
    mean, generator = rewards.mean(dtype=np.float64), np.random.default_rng(1)
    for number in generator.integers(len(items), size=40):
        item, time = int(items[number]), int(times[number])
        begin, width = rates.bins.begin, rates.bins.width
        bins = (time - begin) // width - 1 - (times - begin) // width
        of_item = (items == item) & (bins >= 0)
        expected = []
        for hours in HALF_LIVES:
            weights = 0.5 ** (bins[of_item] * width / HOUR / hours)
            total = (weights * (rewards[of_item] - mean)).sum()
            expected.append(total / (weights.sum() + 20))
        episodes, steps = store.locate(np.array([number]))
        offer = store.offer(episodes, steps)
        inputs = rates.inputs(offer, torch.tensor([item]))[0]
        assert inputs[:-AGES].tolist() == pytest.approx(expected, abs=1e-6)
        days = (time - (START + (item - 8) * 6 * HOUR)) / DAY
        assert inputs[-AGES:].tolist() == pytest.approx([days, np.log1p(24 * days)], rel=1e-5)
        weights = torch.from_numpy(generator.normal(size=len(inputs))).float()
        together = rates.sum_all(offer, weights)[0, item]
        assert float(together) == pytest.approx(float(inputs @ weights), abs=1e-5)


def test_new_items_are_judged_by_what_they_earned_so_far(
    store: EpisodeStore, tmp_path: Path
) -> None:
    settings = ["train.steps=3", "policy.dim=8", "policy.context=4", "rule.sessions=40"]
    recommender = Recommender("dc", settings=[*settings, "augment.copies=0"])
    trained = recommender.fit(store, tmp_path / "run", refit=True).trained
    effects = {entry.effect: entry.kept for entry in trained.record.reward_model.effects}
    assert effects["running"]
    time = int(store.column("timestamp").max())
    rule = DecisionRule(1.0, reward_weight=1.0, policy_weight=0.0)
    items = recommender.recommend(k=3, filter_seen=False, at=time, rule=rule).item_id
    assert (items % 2).mean() > 0.9
    # The weights of the split know what was earned before its end alone.
    split = type(trained).load(trained.folder, split=True)
    later = torch.tensor([time]), torch.tensor([trained.record.data.split_times_ms[0]])
    sums = [split.reward_model.sum_running(split.offers.at(when)) for when in later]
    newest = store.item_states.embeddings.shape[0] - 3
    assert torch.equal(split.reward_model.latest[:, newest:], torch.zeros(len(HALF_LIVES), 3))
    assert sums[0].shape == sums[1].shape == (1, ITEMS)
