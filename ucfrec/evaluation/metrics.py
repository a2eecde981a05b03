"""Metrics of recommendations, as functions on data frames.

`recommended` has one row per item and user: `user_id`, `item_id` and `rank` (from 1), as
`Recommender.recommend` returns it. `relevant` has the pairs `user_id`, `item_id` of what users
liked later; a pair counts once, and an item that a user is recommended twice at its best rank. The
definitions are those of RecTools where it has the metric. Means are over the users of `relevant` (a
user without recommendations counts 0), or over those of `recommended` where nothing relevant is
asked for.
"""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import pandas as pd
from pandas.api.types import infer_dtype, is_list_like, is_numeric_dtype

from ucfrec.errors import InputError
from ucfrec.results.statistics import group_auc
from ucfrec.schema import ITEM_ID, USER_ID
from ucfrec.settings import require_whole

_RANK = "rank"
_PAIR = [USER_ID, ITEM_ID]
_NUMBERS = ("integer", "floating", "mixed-integer-float", "integer-na", "decimal", "boolean")
"""What pandas calls the types of ids that are equal where their values are."""


def hit_rate(recommended: pd.DataFrame, relevant: pd.DataFrame, k: int = 10) -> float:
    """Share of users with a relevant item among the `k` best.

    Raises:
        InputError: a column is missing, there are no rows, ids are of one kind (numbers, text,
            bytes, UUIDs, …) in one frame and of another in the other, or ranks of a user are not
            distinct whole numbers from 1; as all of these.
    """
    return float(_hits(recommended, relevant, k).groupby(USER_ID)[_RANK].any().mean())


def precision(recommended: pd.DataFrame, relevant: pd.DataFrame, k: int = 10) -> float:
    """Share of `k` places that hold a relevant item, mean over users."""
    hits = _hits(recommended, relevant, k)
    per_user = hits.groupby(USER_ID)[_RANK].count()
    return float((per_user / k).mean())


def recall(recommended: pd.DataFrame, relevant: pd.DataFrame, k: int = 10) -> float:
    """Share of a user's relevant items that are among the `k` best, mean over users."""
    owner = _hits(recommended, relevant, k).groupby(USER_ID)
    return float((owner[_RANK].count() / owner.size()).mean())


def mrr(recommended: pd.DataFrame, relevant: pd.DataFrame, k: int = 10) -> float:
    """Mean over users of 1 / rank of the first relevant item; 0 if none is among the `k` best."""
    first = _hits(recommended, relevant, k).groupby(USER_ID)[_RANK].min()
    return float((1 / first).fillna(0.0).mean())


def mean_average_precision(recommended: pd.DataFrame, relevant: pd.DataFrame, k: int = 10) -> float:
    """MAP: the precision at the rank of each relevant item among the `k` best, summed, divided by
    the number of the user's relevant items; mean over users."""
    hits = _hits(recommended, relevant, k).sort_values([USER_ID, _RANK])
    owner = hits.groupby(USER_ID)
    precisions = (owner.cumcount() + 1) / hits[_RANK]
    return float((precisions.groupby(hits[USER_ID]).sum() / owner.size()).mean())


def ndcg(
    recommended: pd.DataFrame,
    relevant: pd.DataFrame,
    k: int = 10,
    achievable: bool = False,
) -> float:
    """Σ 1 / log2(1 + rank) over a user's relevant items among the `k` best, divided by the ideal;
    mean over users.

    Args:
        achievable: the ideal is `k` relevant items (RecTools' default), or with true as many as the
            user has (RecTools' `divide_by_achievable`, and scikit-learn's `ndcg_score`).
    """
    hits = _hits(recommended, relevant, k)
    owner = hits.groupby(USER_ID)
    gains = (1 / np.log2(1 + hits[_RANK])).groupby(hits[USER_ID]).sum()
    ideal = np.cumsum(1 / np.log2(np.arange(2, k + 2)))
    places = owner.size().clip(upper=k).to_numpy() if achievable else np.full(len(gains), k)
    return float((gains / ideal[places - 1]).mean())


def gauc(scored: pd.DataFrame) -> float:
    """Probability that a liked item scores higher than another one shown to the same user, mean
    over users weighted by rows; users with liked items only, or with none, do not count. `scored`
    has `user_id`, `score` (higher is better) and `liked` (true or false) of each row shown.

    Raises:
        InputError: a column or a score is missing, there are no rows, or `liked` is something else.
    """
    scored = _require(scored, "scored", [USER_ID, "score", "liked"])
    if unusable := (~scored["liked"].isin([0, 1])).sum():
        raise InputError(
            f"scored: liked is neither true nor false in {unusable:,} rows; give true and "
            "false, or 1 and 0, and leave rows out where it is not known"
        )
    if missing := scored["score"].isna().sum():
        raise InputError(f"scored: score is missing in {missing:,} rows; leave them out")
    owner, users = pd.factorize(scored[USER_ID])
    scores, liked = scored["score"].to_numpy(np.float64), scored["liked"].to_numpy(bool)
    above, below = group_auc(scores, liked, owner, len(users))
    return float(above.sum() / below.sum()) if below.any() else float("nan")


def coverage(recommended: pd.DataFrame, catalogue: Collection[Any], k: int = 10) -> float:
    """Share of the catalogue's items, each counted once, that are among the `k` best of a user;
    InputError if it is empty or lacks a recommended item."""
    top = _top(recommended, k)
    return float(top[ITEM_ID].nunique() / _count_items(catalogue, top))


def novelty(recommended: pd.DataFrame, history: pd.DataFrame, k: int = 10) -> float:
    """Mean inverse user frequency of the `k` best, in bits: −log2 of the share of the history's
    users who have the item, mean over a user's items and then over users. `history` has the pairs
    `user_id`, `item_id` of the past; an item that it lacks counts as one user's.
    """
    top, history = _top(recommended, k), _require(history, "history", _PAIR)
    _require_comparable(top[ITEM_ID], history[ITEM_ID], "history")
    users = history.groupby(ITEM_ID)[USER_ID].nunique()
    share = top[ITEM_ID].map(users).fillna(1) / history[USER_ID].nunique()
    bits = pd.Series(-np.log2(share.to_numpy(np.float64)), top.index)
    return float(bits.groupby(top[USER_ID]).mean().mean())


def diversity(recommended: pd.DataFrame, features: pd.DataFrame, k: int = 10) -> float:
    """Number of features in which two of a user's `k` best items differ (Hamming distance), mean
    over pairs and then over users; a user with one item counts 0. `features` have one row per item,
    `item_id` as the index; InputError if an item has none or two, or a feature is a list.
    """
    top = _top(recommended, k)
    if not features.shape[1]:
        raise InputError("features has no columns; give one per feature, item_id being the index")
    if not features.index.is_unique:
        twice = features.index[features.index.duplicated()][0]
        raise InputError(f"features has several rows of item {twice}; give one row per item")
    for name in features:
        if any(map(is_list_like, features[name])):
            raise InputError(f"features: {name} holds lists; give one column per value of them")
    places = features.index.get_indexer(pd.Index(top[ITEM_ID]))
    if (places < 0).any():
        absent = top[ITEM_ID][places < 0]
        raise InputError(
            f"features: {absent.nunique():,} recommended items have no row, such as "
            f"{absent.iloc[0]}; add them, item_id being the index"
        )
    numbered = pd.DataFrame({USER_ID: top[USER_ID], _RANK: top[_RANK], "place": places})
    pairs = numbered.merge(numbered, on=USER_ID)
    pairs = pairs[pairs[f"{_RANK}_x"] < pairs[f"{_RANK}_y"]]
    values = np.stack([pd.factorize(features[name])[0] for name in features], axis=1)
    differ = (values[pairs["place_x"]] != values[pairs["place_y"]]).sum(axis=1)
    of_users = pd.Series(differ, pairs[USER_ID].to_numpy()).groupby(level=0).mean()
    return float(of_users.reindex(top[USER_ID].unique(), fill_value=0.0).mean())


def serendipity(
    recommended: pd.DataFrame,
    relevant: pd.DataFrame,
    history: pd.DataFrame,
    catalogue: Collection[Any],
    k: int = 10,
) -> float:
    """How much earlier relevant items come than by popularity: max(0, p_user − p_any) of relevant
    items and 0 of others, mean over a user's `k` best and then over users.

    p_user = (n + 1 − rank) / n of n items in the catalogue, and p_any the same by the rank of the
    item's popularity in the rows of the history; 0 for items that it lacks. InputError if the
    catalogue lacks a recommended item.
    """
    top = _top(recommended, k)
    n = _count_items(catalogue, top)
    relevant = _require(relevant, "relevant", _PAIR, top)
    history = _require(history, "history", [ITEM_ID], top)
    popularity = history[ITEM_ID].value_counts().rank(method="dense", ascending=False)
    by_all = ((n + 1 - top[ITEM_ID].map(popularity)) / n).fillna(0.0)
    earlier = ((n + 1 - top[_RANK]) / n - by_all).clip(lower=0.0)
    pairs = pd.MultiIndex.from_frame(top[_PAIR])
    hit = pairs.isin(pd.MultiIndex.from_frame(relevant[_PAIR]))
    return float((earlier * hit).groupby(top[USER_ID]).mean().mean())


def _top(recommended: pd.DataFrame, k: int) -> pd.DataFrame:
    """The rows among the `k` best of each user."""
    recommended = _require(recommended, "recommended", [*_PAIR, _RANK])
    k, ranks = require_whole("k", k), recommended[_RANK]
    if not is_numeric_dtype(ranks) or not (ranks >= 1).all():
        lowest = ranks.min() if is_numeric_dtype(ranks) else ranks.iloc[0]
        raise InputError(f"recommended: rank is {lowest} in a row; ranks count from 1, as numbers")
    if (odd := (ranks % 1 != 0) | recommended.duplicated([USER_ID, _RANK], keep=False)).any():
        raise InputError(
            f"recommended: in {odd.sum():,} rows rank is no whole number, or that of another row "
            "of the user; number the rows of each user 1, 2, 3, …"
        )
    return recommended[ranks <= k]


def _hits(recommended: pd.DataFrame, relevant: pd.DataFrame, k: int) -> pd.DataFrame:
    """One row per relevant pair, with its `rank` if it is among the `k` best, else NaN."""
    top = _top(recommended, k).sort_values(_RANK).drop_duplicates(_PAIR)
    pairs = _require(relevant, "relevant", _PAIR, recommended).drop_duplicates()
    return pairs.merge(top, on=_PAIR, how="left")


def _count_items(catalogue: Collection[Any], top: pd.DataFrame) -> int:
    """Number of distinct items of a catalogue that has all the recommended ones."""
    items = pd.Series(list(catalogue), dtype=None if len(catalogue) else object).drop_duplicates()
    if items.empty:
        raise InputError("catalogue is empty; give the item_ids of all items")
    _require_comparable(top[ITEM_ID], items, "catalogue")
    absent = top[ITEM_ID][~top[ITEM_ID].isin(items)]
    if len(absent):
        raise InputError(
            f"catalogue lacks {absent.nunique():,} recommended items, such as {absent.iloc[0]}; "
            "give the item_ids of all items"
        )
    return len(items)


def _require_comparable(ids: pd.Series, reference: pd.Series, of_others: str) -> None:
    """Check that ids of `recommended` and of another frame are of one kind: 7 is not "7"."""
    kind, theirs = _kind(ids), _kind(reference)
    if kind != theirs:
        raise InputError(
            f"{ids.name} holds {kind} in recommended, but {theirs} in {of_others}; convert one of "
            "them with astype"
        )


def _kind(ids: pd.Series) -> str:
    name = infer_dtype(np.asarray(ids), skipna=True)
    if name == "mixed":  # objects that pandas does not know
        return f"{type(ids.iloc[0]).__name__} objects"
    return "text" if name == "string" else "numbers" if name in _NUMBERS else name


def _require(
    frame: pd.DataFrame,
    name: str,
    columns: Sequence[str],
    beside: pd.DataFrame | None = None,
) -> pd.DataFrame:
    """The columns of a frame, without categories, once it has rows and is found to have columns of
    the kinds of those of `recommended`, if given."""
    absent = [column for column in columns if column not in frame]
    if absent:
        raise InputError(f"{name} has no column {', '.join(absent)}; rename the one that it is in")
    if frame.empty:
        raise InputError(f"{name} has no rows")
    if beside is not None:
        for column in columns:
            _require_comparable(beside[column], frame[column], name)
    of_category = [c for c in columns if isinstance(frame[c].dtype, pd.CategoricalDtype)]
    # pandas 2 would count categories without rows as users and items.
    return frame[[*columns]].astype(dict.fromkeys(of_category, object))
