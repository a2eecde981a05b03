"""The boosted click model: tables equal the trees of scikit-learn, and rates leak nothing."""

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support.tagged import tagged_store
from ucfrec.episodes.store import EpisodeStore
from ucfrec.policies.boosted import BoostedPolicy
from ucfrec.runs.config import resolve_config
from ucfrec.runs.start import new_policy
from ucfrec.user_model.session_end import BoostedTrees, fit_trees


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[BoostedPolicy, EpisodeStore]:
    store = tagged_store(tmp_path_factory.mktemp("boosted")).split("train")
    settings = {"policy.context": 6, "policy.boosted": 5}
    policy = new_policy(store, resolve_config("boosted", None, settings)).eval()
    assert isinstance(policy, BoostedPolicy)
    policy.make_solver(store, None, Path(), 0)()
    return policy, store


def test_tables_are_the_trees_of_scikit_learn(
    fitted: tuple[BoostedPolicy, EpisodeStore], monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, store = fitted
    numbers = np.arange(store.n_steps)
    inputs, liked = policy._rows(store, numbers)
    trees = BoostedTrees(**fit_trees(inputs, liked, 0))
    at = store.locate(numbers[:200])
    windows = store.windows(*at, 6)
    monkeypatch.setattr(policy, "_inputs", lambda *_: torch.from_numpy(inputs[:200, None]))
    found = policy._score(windows, windows.actions[:, -1:])[:, 0]
    torch.testing.assert_close(
        found.double(), trees(torch.from_numpy(inputs[:200])), atol=1e-4, rtol=1e-4
    )


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
    inputs, liked = policy._rows(store, np.arange(store.n_steps))
    episodes, _ = store.all_steps()
    items = store.column("item")
    for item in range(3):
        rows = (items == item) & (episodes % 5 == 0)
        assert len(np.unique(inputs[rows, 0])) == 1
        assert {*liked[rows].tolist()} == {True, False}
