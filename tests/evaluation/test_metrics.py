"""Metrics on frames: RecTools' numbers, scikit-learn's, and what cannot be measured."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sklearn.metrics import ndcg_score, roc_auc_score

from ucfrec.errors import InputError
from ucfrec.evaluation import metrics

FIXTURE = json.loads((Path(__file__).parent / "fixtures" / "rectools_metrics.json").read_text())
RECOMMENDED, RELEVANT, HISTORY = (
    pd.DataFrame(FIXTURE[name]) for name in ("recommended", "relevant", "history")
)
FEATURES = pd.DataFrame(FIXTURE["features"]).set_index("item_id")
CATALOGUE = FIXTURE["catalogue"]
ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "coverage": (CATALOGUE,),
    "novelty": (HISTORY,),
    "diversity": (FEATURES,),
    "serendipity": (RELEVANT, HISTORY, CATALOGUE),
}
CASES = [(int(k), name, v) for k, found in FIXTURE["values"].items() for name, v in found.items()]


def measured(name: str, recommended: pd.DataFrame, k: int) -> float:
    if name == "ndcg_achievable":
        return metrics.ndcg(recommended, RELEVANT, k, achievable=True)
    function: Callable[..., float] = getattr(metrics, name)
    return function(recommended, *ARGUMENTS.get(name, (RELEVANT,)), k)


@pytest.mark.parametrize(("k", "name", "expected"), CASES)
def test_as_rectools_in_any_order_of_rows(k: int, name: str, expected: float) -> None:
    assert measured(name, RECOMMENDED, k) == pytest.approx(expected, rel=1e-12)
    shuffled = RECOMMENDED.sample(frac=1, random_state=0)
    assert measured(name, shuffled, k) == pytest.approx(expected, rel=1e-12)


def test_achievable_ndcg_is_scikit_learns() -> None:
    ranks = pd.DataFrame({"user_id": 1, "item_id": range(6), "rank": range(1, 7)})
    liked = pd.DataFrame({"user_id": 1, "item_id": [1, 4, 5]})
    truth = ranks.item_id.isin(liked.item_id).to_numpy(int)
    expected = ndcg_score([truth], [-ranks["rank"].to_numpy()], k=5)
    assert metrics.ndcg(ranks, liked, 5, achievable=True) == pytest.approx(expected)


def test_gauc_is_the_weighted_mean_of_auc_over_users() -> None:
    rng = np.random.default_rng(0)
    rows = pd.DataFrame({"user_id": rng.integers(8, size=200), "score": rng.integers(9, size=200)})
    rows["liked"] = rng.random(200) < 0.3
    rows.loc[rows.user_id == 3, "liked"] = True  # does not count
    counted = rows[rows.user_id != 3]
    aucs = [roc_auc_score(g.liked, g.score) for _, g in counted.groupby("user_id")]
    expected = np.average(aucs, weights=counted.groupby("user_id").size())
    assert metrics.gauc(rows) == pytest.approx(expected)
    assert np.isnan(metrics.gauc(rows[rows.user_id == 3]))


def test_ids_may_be_text() -> None:
    text = [each.astype(str) for each in (RECOMMENDED[["user_id", "item_id"]], RELEVANT)]
    recommended = text[0].assign(rank=RECOMMENDED["rank"])
    expected = FIXTURE["values"]["5"]["recall"]
    assert metrics.recall(recommended, text[1], 5) == pytest.approx(expected)


def test_what_cannot_be_measured() -> None:
    with pytest.raises(InputError, match="recommended has no column rank"):
        metrics.recall(RECOMMENDED.drop(columns="rank"), RELEVANT)
    with pytest.raises(InputError, match="relevant has no rows"):
        metrics.mrr(RECOMMENDED, RELEVANT.head(0))
    with pytest.raises(InputError, match="k is 0"):
        metrics.hit_rate(RECOMMENDED, RELEVANT, 0)
    with pytest.raises(InputError, match="1 recommended items have no row, such as 100"):
        metrics.diversity(RECOMMENDED, FEATURES.drop(index=100))
