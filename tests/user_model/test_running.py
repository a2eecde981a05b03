"""Running rates are of earlier rows only, and tell what new items are worth."""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.support.logs import START, store_of, write
from ucfrec import EpisodeStore, Recommender
from ucfrec.acting.decision import DecisionRule
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.user_model.running import AGES, HALF_LIVES, HALF_LIVES_OF_DEMAND, Demand, RunningRates

HOUR, DAY, ITEMS = 3_600_000, 86_400_000, 60
ALL_ALIKE = torch.tensor(HALF_LIVES_OF_DEMAND).isinf().float()


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


def test_new_items_are_judged_by_what_they_earned(store: EpisodeStore, tmp_path: Path) -> None:
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


def drifting_store(folder: Path, drift: bool) -> EpisodeStore:
    """Items in demand for a day each, or the same ones all the time."""
    rng, days = np.random.default_rng(0), np.repeat(np.arange(40), 100)
    items = rng.integers(30, size=len(days)) + (days if drift else 20)
    log = pd.DataFrame({"user_id": rng.integers(200, size=len(days)), "item_id": items})
    times = START + days * DAY + rng.integers(DAY, size=len(days))
    log = log.assign(timestamp=np.sort(times), reward=rng.integers(2, size=len(days)) * 1.0)
    return store_of(log, folder, LogMapping(session_by="user"))


def test_demand_is_that_of_earlier_steps_and_follows_drift(tmp_path: Path) -> None:
    store = drifting_store(tmp_path, drift=True)
    train, validation = store.split("train"), store.split("validation")
    demand = Demand.of(train, validation, ALL_ALIKE)
    assert demand is not None
    assert demand.mixture[:3].sum() > 0.5
    torch.testing.assert_close(demand.logs.exp().sum(1), torch.ones(len(demand.logs)))
    # At the begin of each bin, an independent count of the steps before it.
    items, times = (train.column(name) for name in ("item", "timestamp"))
    bins = (times - demand.bins.begin) // demand.bins.width
    n_items = demand.logs.shape[1]
    for place in (0, 7, len(demand.logs) - 1):
        expected = np.zeros(n_items)
        for weight, hours in zip(demand.mixture.tolist(), HALF_LIVES_OF_DEMAND, strict=True):
            before = bins < place
            age = (place - 1 - bins[before]) * demand.bins.width / HOUR
            sums = 1.0 * np.bincount(items[before], 0.5 ** (age / hours), n_items)
            sums += 1.0 if math.isinf(hours) else 1 / n_items
            expected += weight * sums / sums.sum()
        np.testing.assert_allclose(demand.logs[place].exp().numpy(), expected, rtol=1e-4)
    # Held-out steps are likelier than under shares of all steps.
    later = torch.from_numpy(validation.column("item")).long()
    later = later[torch.from_numpy(train.item_counts() > 0)[later]]
    constant = torch.from_numpy(train.item_counts() + 1.0)
    gain = demand.logs[-1][later] - torch.log(constant / constant.sum())[later]
    assert gain.mean() > 0.5


def test_steady_demand_changes_nothing(tmp_path: Path) -> None:
    store = drifting_store(tmp_path, drift=False)
    train, validation = store.split("train"), store.split("validation")
    assert Demand.of(train, validation, ALL_ALIKE) is None
