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


def test_items_of_the_catalogue_count_once() -> None:
    for name, before in (("coverage", ()), ("serendipity", (RELEVANT, HISTORY))):
        function: Callable[..., float] = getattr(metrics, name)
        expected = function(RECOMMENDED, *before, CATALOGUE, 5)
        assert function(RECOMMENDED, *before, pd.Series(CATALOGUE * 2), 5) == expected
        assert function(RECOMMENDED, *before, {*CATALOGUE}, 5) == expected


def test_liked_may_be_any_true_and_false() -> None:
    rows = pd.DataFrame({"user_id": 1, "score": [1.0, 2.0, 3.0], "liked": [False, True, True]})
    for kind in ("int", "float", "boolean", "object"):
        assert metrics.gauc(rows.astype({"liked": kind})) == 1


def with_text(frame: pd.DataFrame, column: str = "item_id") -> pd.DataFrame:
    return frame.astype({column: str})


SHOWN = pd.DataFrame({"user_id": [1, 1], "score": [1.0, 2.0], "liked": [0, 1]})
WRONG: dict[str, tuple[Callable[[], float], str]] = {
    "no rank": (
        lambda: metrics.recall(RECOMMENDED.drop(columns="rank"), RELEVANT),
        "recommended has no column rank",
    ),
    "nothing relevant": (
        lambda: metrics.mrr(RECOMMENDED, RELEVANT.head(0)),
        "relevant has no rows",
    ),
    "k of 0": (lambda: metrics.hit_rate(RECOMMENDED, RELEVANT, 0), "k is 0; give a whole number"),
    "part of an item": (lambda: metrics.precision(RECOMMENDED, RELEVANT, k=2.5), "k is 2.5"),
    "k as float": (lambda: metrics.ndcg(RECOMMENDED, RELEVANT, k=2.0), "k is 2.0; give a whole"),
    "ranks from 0": (
        lambda: metrics.ndcg(RECOMMENDED.assign(rank=RECOMMENDED["rank"] - 1), RELEVANT),
        "rank is 0 in a row; ranks count from 1",
    ),
    "equal ranks": (
        lambda: metrics.precision(RECOMMENDED.assign(rank=1), RELEVANT),
        r"in \d+ rows rank is no whole number, or that of another row of the user",
    ),
    "halves of ranks": (
        lambda: metrics.ndcg(RECOMMENDED.assign(rank=RECOMMENDED["rank"] + 0.5), RELEVANT),
        "rank is no whole number",
    ),
    "no score": (
        lambda: metrics.gauc(SHOWN.assign(score=[np.nan, 1.0])),
        "score is missing in 1 rows",
    ),
    "no ranks": (lambda: metrics.mrr(RECOMMENDED.assign(rank=np.nan), RELEVANT), "rank is nan"),
    "text as rank": (lambda: metrics.mrr(RECOMMENDED.assign(rank="1"), RELEVANT), "rank is 1 in"),
    "relevant text": (
        lambda: metrics.hit_rate(RECOMMENDED, with_text(RELEVANT)),
        "item_id holds numbers in recommended, but text in relevant; convert one of them",
    ),
    "categories of text": (
        lambda: metrics.recall(with_text(RECOMMENDED).astype({"item_id": "category"}), RELEVANT),
        "item_id holds text in recommended, but numbers in relevant",
    ),
    "users as text": (
        lambda: metrics.hit_rate(RECOMMENDED, with_text(RELEVANT, "user_id")),
        "user_id holds numbers in recommended, but text in relevant",
    ),
    "history of text": (
        lambda: metrics.novelty(RECOMMENDED, with_text(HISTORY)),
        "item_id holds numbers in recommended, but text in history",
    ),
    "popularity of text": (
        lambda: metrics.serendipity(RECOMMENDED, RELEVANT, with_text(HISTORY), CATALOGUE),
        "item_id holds numbers in recommended, but text in history",
    ),
    "serendipity of text": (
        lambda: metrics.serendipity(RECOMMENDED, with_text(RELEVANT), HISTORY, CATALOGUE),
        "item_id holds numbers in recommended, but text in relevant",
    ),
    "catalogue of text": (
        lambda: metrics.coverage(RECOMMENDED, [*map(str, CATALOGUE)]),
        "item_id holds numbers in recommended, but text in catalogue",
    ),
    "no catalogue": (lambda: metrics.coverage(RECOMMENDED, []), "catalogue is empty"),
    "small catalogue": (
        lambda: metrics.serendipity(RECOMMENDED, RELEVANT, HISTORY, CATALOGUE[:1]),
        "catalogue lacks .* recommended items, such as",
    ),
    "liked unknown": (
        lambda: metrics.gauc(SHOWN.assign(liked=[1.0, np.nan])),
        "liked is neither true nor false in 1 rows",
    ),
    "liked as text": (
        lambda: metrics.gauc(with_text(SHOWN, "liked")),
        "liked is neither true nor false in 2 rows",
    ),
    "an item without features": (
        lambda: metrics.diversity(RECOMMENDED, FEATURES.drop(index=100)),
        "1 recommended items have no row, such as 100",
    ),
    "features twice": (
        lambda: metrics.diversity(RECOMMENDED, pd.concat([FEATURES, FEATURES])),
        "features has several rows of item .*; give one row per item",
    ),
    "features as lists": (
        lambda: metrics.diversity(RECOMMENDED, FEATURES.assign(tags=[["a"]] * len(FEATURES))),
        "features: tags holds lists",
    ),
    "no features": (
        lambda: metrics.diversity(RECOMMENDED, FEATURES[[]]),
        "features has no columns",
    ),
}
"""Measurements, and why they are refused."""


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_measured(case: str) -> None:
    use, message = WRONG[case]
    with pytest.raises(InputError, match=message):
        use()
