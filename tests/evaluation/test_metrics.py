"""Metrics on frames: RecTools' numbers, scikit-learn's, and what cannot be measured.

The script that had RecTools 0.19.0 make its numbers:
`git show 9733b2b8:tests/evaluation/fixtures/make_rectools_metrics.py`.
"""

import json
from collections.abc import Callable
from itertools import permutations
from pathlib import Path
from typing import Any
from uuid import UUID

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
    for kind in ("int", "float", "boolean", "object"):
        assert metrics.gauc(rows.astype({"liked": kind})) == pytest.approx(expected)


KINDS: dict[str, Callable[[Any], Any]] = {
    "text": str,
    "bytes": lambda number: bytes([number % 256, number // 256]),
    "UUID": lambda number: UUID(int=number),
}
UNUSED = pd.CategoricalDtype([*range(-3, 200)])


def converted(frame: pd.DataFrame, convert: Callable[[Any], Any]) -> pd.DataFrame:
    pairs = {name: [*map(convert, frame[name])] for name in ("user_id", "item_id")}
    return frame.assign(**pairs)


@pytest.mark.parametrize("kind", [*KINDS, "category"])
def test_ids_may_be_of_any_kind_but_only_of_one(kind: str) -> None:
    of_category = {"user_id": UNUSED, "item_id": UNUSED}
    frames = [
        frame.astype(of_category) if kind == "category" else converted(frame, KINDS[kind])
        for frame in (RECOMMENDED, RELEVANT)
    ]
    for name in ("recall", "ndcg", "mean_average_precision"):
        expected = FIXTURE["values"]["5"][name]
        assert getattr(metrics, name)(*frames, 5) == pytest.approx(expected)
    if kind in ("bytes", "UUID"):
        with pytest.raises(InputError, match=f"holds {kind}.* in recommended, but text in relev"):
            metrics.recall(frames[0], converted(RELEVANT, str), 5)


@pytest.mark.parametrize("order", [*permutations(range(3))])
def test_an_item_that_is_recommended_twice_counts_at_its_best_rank(order: tuple[int, ...]) -> None:
    twice = pd.DataFrame({"user_id": 1, "item_id": ["A", "B", "A"], "rank": [1, 2, 3]})
    liked = pd.DataFrame({"user_id": [1], "item_id": ["A"]})
    assert metrics.mrr(twice.iloc[[*order]], liked, 3) == 1.0


def with_text(frame: pd.DataFrame, column: str = "item_id") -> pd.DataFrame:
    return frame.astype({column: str})


SHOWN = pd.DataFrame({"user_id": [1, 1], "score": [1.0, 2.0], "liked": [0, 1]})
CATEGORIES = with_text(RECOMMENDED).astype({"item_id": "category"})
LISTS = FEATURES.assign(tags=[["a"]] * len(FEATURES))


def ranked(change: Callable[[pd.Series], Any]) -> pd.DataFrame:
    return RECOMMENDED.assign(rank=change(RECOMMENDED["rank"]))


NUMBERS = "item_id holds numbers in recommended, but text in"
WRONG: list[tuple[str, tuple[Any, ...], str]] = [
    ("recall", (RECOMMENDED.drop(columns="rank"), RELEVANT), "recommended has no column rank"),
    ("mrr", (RECOMMENDED, RELEVANT.head(0)), "relevant has no rows"),
    ("hit_rate", (RECOMMENDED, RELEVANT, 0), "k is 0; give a whole number"),
    ("ndcg", (ranked(lambda rank: rank - 1), RELEVANT), "rank is 0 in a row; ranks count from 1"),
    ("precision", (ranked(lambda _: 1), RELEVANT), r"in \d+ rows .* or that of another row of the"),
    ("gauc", (SHOWN.assign(score=[np.nan, 1.0]),), "score is missing in 1 rows"),
    ("gauc", (SHOWN.assign(liked=[1.0, np.nan]),), "liked is neither true nor false in 1 rows"),
    ("gauc", (with_text(SHOWN, "liked"),), "liked is neither true nor false in 2 rows"),
    ("hit_rate", (RECOMMENDED, with_text(RELEVANT)), f"{NUMBERS} relevant; convert one of them"),
    ("recall", (CATEGORIES, RELEVANT), "holds text in recommended, but numbers in relevant"),
    ("coverage", (RECOMMENDED, [*map(str, CATALOGUE)]), f"{NUMBERS} catalogue"),
    ("coverage", (RECOMMENDED, []), "catalogue is empty"),
    ("serendipity", (RECOMMENDED, RELEVANT, HISTORY, CATALOGUE[:1]), "catalogue lacks .* such as"),
    ("diversity", (RECOMMENDED, FEATURES.drop(index=100)), "1 .* have no row, such as 100"),
    ("diversity", (RECOMMENDED, pd.concat([FEATURES] * 2)), "features has several rows of item"),
    ("diversity", (RECOMMENDED, LISTS), "features: tags holds lists"),
    ("diversity", (RECOMMENDED, FEATURES[[]]), "features has no columns"),
]
"""Metric, what it is asked about, and why that is refused."""


@pytest.mark.parametrize(("metric", "arguments", "says"), WRONG)
def test_what_cannot_be_measured(metric: str, arguments: tuple[Any, ...], says: str) -> None:
    with pytest.raises(InputError, match=says):
        getattr(metrics, metric)(*arguments)
