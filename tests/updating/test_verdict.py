"""The verdict finds a better and a worse run, and doubts what the log cannot tell."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.support.later import later_log, later_mapping
from tests.support.logs import store_of
from tests.support.served import trained_run
from tests.support.tagged import ITEMS
from ucfrec import Recommender
from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Array
from ucfrec.episodes.store import EpisodeStore, UserRows
from ucfrec.logs.append import append_logs
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.updating.verdict import (
    compare_runs,
    describe,
    popularity_index,
    restrict_to_run,
    reward_index,
    stability_index,
)

LOGGED_ITEMS = 12


def logged(
    folder: Path, items: Array, propensity: Any, split: tuple[float, ...], **columns: Any
) -> EpisodeStore:
    """Five rows of each user, in which low items are liked."""
    rows, chance = np.arange(len(items)), np.random.default_rng(1).random(len(items))
    log = pd.DataFrame({"user_id": rows // 5, "item_id": items, "propensity": propensity})
    log["timestamp"] = 1_700_000_000_000 + rows * 1000
    log["reward"] = (chance < 0.8 - 0.06 * items) * 1.0
    return store_of(log.assign(**columns), folder, split=split)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> TrainedPolicy:
    """A policy of item rates on a log of uniform draws, in which low items are liked."""
    folder = tmp_path_factory.mktemp("verdict")
    items = np.random.default_rng(0).integers(LOGGED_ITEMS, size=12_000)
    store = logged(folder, items, 1 / LOGGED_ITEMS, (0.6, 0.1, 0.3))
    Recommender("item-rate").fit(store, folder / "run")
    trained = TrainedPolicy.load(folder / "run")
    return replace(trained, rule=DecisionRule(trained.rule.target, temperature=0.3))


def rows_of_test(trained: TrainedPolicy) -> EpisodeStore:
    return EpisodeStore.open(trained.folder.parent / "store").split("test")


def newest(rows: EpisodeStore) -> UserRows:
    return UserRows.of(rows, rows.episode_values("user"), None)


def reversed_of(trained: TrainedPolicy) -> TrainedPolicy:
    """A run that shows the items which are liked least."""
    policy = TrainedPolicy.load(trained.folder).policy
    for name, value in policy.state_dict().items():
        if value.shape == (LOGGED_ITEMS,) and value.is_floating_point() and "count" not in name:
            value.copy_(-value)
    return replace(trained, policy=policy)


def test_a_better_and_a_worse_run_are_told_apart(trained: TrainedPolicy) -> None:
    bad = reversed_of(trained)
    for new, old, result in ((trained, bad, "better"), (bad, trained, "worse")):
        found = compare_runs(new, old, newest(rows_of_test(trained)), 0)
        assert (found.result, found.decided_by) == (result, "reward per step")
        assert {each.standing() for each in found.differences.values()} == {result}
        assert describe(found).count(f"\n  {result}") == 2
        assert bool(found.harms) == (result == "worse")


def test_a_run_is_level_with_itself(trained: TrainedPolicy) -> None:
    found = compare_runs(trained, trained, newest(rows_of_test(trained)), 0)
    assert found.result == "level"
    assert all(each.value == 0 for each in found.differences.values())


def rows_of(
    trained: TrainedPolicy, store: EpisodeStore, propensities: Array | None
) -> EpisodeStore:
    """The rows with other propensities, or none."""
    steps = {name: store.column(name) for name in ("item", "reward", "timestamp")}
    if propensities is not None:
        steps["propensity"] = propensities
    episodes = {n: store.episode_values(n) for n in ("user", "terminated")}
    return EpisodeStore.from_arrays(steps, store.lengths, episodes, trained.item_states)


def test_without_propensities_the_ranking_decides(trained: TrainedPolicy) -> None:
    blind = rows_of(trained, rows_of_test(trained), None)
    found = compare_runs(trained, reversed_of(trained), newest(blind), 0)
    assert (found.result, found.decided_by) == ("better", "ndcg_liked")
    assert len(found.differences) == 1


def test_clicks_on_what_the_old_run_showed_do_not_speak_for_it(
    trained: TrainedPolicy, tmp_path: Path
) -> None:
    shares = 1.3 ** np.arange(LOGGED_ITEMS)
    shares /= shares.sum()
    items = np.random.default_rng(0).choice(LOGGED_ITEMS, p=shares, size=6000)
    rows = logged(tmp_path, items, shares[items], (0.1, 0.1, 0.8)).split("test")
    found = compare_runs(trained, reversed_of(trained), newest(rows), 0).differences
    assert found["ndcg_liked"].standing() == "better"
    blind = rows_of(trained, rows, None)
    found = compare_runs(trained, reversed_of(trained), newest(blind), 0).differences
    assert found["ndcg_liked"].standing() == "worse"


def test_wrong_propensities_are_doubted(trained: TrainedPolicy) -> None:
    rows = rows_of_test(trained)
    wrong = rows_of(trained, rows, np.full(rows.n_steps, 5 / LOGGED_ITEMS, dtype=np.float32))
    found = compare_runs(trained, trained, newest(wrong), 0)
    assert (found.result, found.decided_by) == ("open", "reward per step")
    assert "where 1 is expected" in found.differences["reward per step"].reasons[0]
    assert "reward per step – (the new run: " in describe(found)


def test_seen_items_are_compared_as_served(trained: TrainedPolicy, tmp_path: Path) -> None:
    rng, users = np.random.default_rng(0), 400
    items = np.concatenate([rng.permutation(LOGGED_ITEMS)[:5] for _ in range(users)])
    propensity = 1 / (LOGGED_ITEMS - np.tile(np.arange(5), users))
    newest = []
    for name, columns in (("unsaid", {}), ("seen", {"excludes_seen": True})):
        (tmp_path / name).mkdir()
        store = logged(tmp_path / name, items, propensity, (0.2, 0.2, 0.6), **columns)
        rows = store.split("test")
        newest.append(UserRows.of(rows, rows.episode_values("user"), store.split("train")))
    uniform = replace(trained, rule=DecisionRule(trained.rule.target, temperature=1e6))
    wrong, right = (compare_runs(uniform, uniform, each, 0) for each in newest)
    assert "excludes_seen" in describe(wrong)
    assert "mean weight" not in describe(right)


def test_a_difference_among_few_users_is_doubted(trained: TrainedPolicy) -> None:
    rows = rows_of_test(trained)
    users = rows.episode_values("user")
    few = rows.select(np.flatnonzero(users < np.unique(users)[9]))
    found = compare_runs(trained, reversed_of(trained), newest(few), 0)
    assert (found.result, found.users) == ("open", 9)
    assert all(
        "fewer than 10, have such rows" in str(each.reasons) for each in found.differences.values()
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
