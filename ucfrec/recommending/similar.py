"""Items that a trained policy sees as similar to others."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Final

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.recommending.recommend import RANK, SCORE
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.settings import require_ids, require_whole

SIMILAR_ITEM: Final = "similar_item_id"
_ITEMS_AT_ONCE = 1024


def similar_items(
    trained: TrainedPolicy, items: Iterable[Any] | None = None, k: int = 10
) -> pd.DataFrame:
    """The `k` most similar other items of each item, by the cosine of the items' vectors.

    The vectors are those by which the policy scores items; of a policy that scores items in a way
    of its own, such as `item-knn`, the store's embeddings of the items.

    Args:
        items: item_ids; None for all.

    Returns:
        `item_id`, `rank` (from 1), `similar_item_id`, `score` (cosine, −1 to 1).

    Raises:
        InputError: the policy's actions are vectors, an item is not known, or `items` or `k` is
            something else.
    """
    k = require_whole("k", k)
    chosen = None if items is None else require_ids("items", items, schema.ITEM_ID)
    vectors = F.normalize(_vectors(trained), dim=1)
    ids = trained.items.ids
    items_asked = np.arange(len(ids)) if chosen is None else trained.items.numbers(chosen)
    if chosen is not None and (items_asked < 0).any():
        unknown = chosen[items_asked < 0]
        raise InputError(
            f"{len(unknown)} of {len(chosen)} items are not in the training data, such as "
            f"{unknown[0]}; leave them out"
        )
    k = min(k, len(ids) - 1)
    frames = []
    for begin in range(0, len(items_asked), _ITEMS_AT_ONCE):
        numbers = torch.from_numpy(items_asked[begin : begin + _ITEMS_AT_ONCE])
        cosines = (vectors[numbers] @ vectors.T).scatter(1, numbers.unsqueeze(1), -torch.inf)
        best = cosines.topk(k, dim=1)
        columns = {
            schema.ITEM_ID: ids[numbers.numpy().repeat(k)],
            RANK: np.tile(np.arange(1, k + 1), len(numbers)),
            SIMILAR_ITEM: ids[best.indices.numpy().ravel()],
            SCORE: best.values.numpy().ravel(),
        }
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames, ignore_index=True)


def _vectors(trained: TrainedPolicy) -> Tensor:
    """(n_items, d)."""
    scorer = trained.item_scorer(replace(trained.rule, reward_weight=0.0, lookahead=0.0))
    if scorer.has_factors:
        return torch.from_numpy(scorer.vectors()[:, :-1])
    assert trained.item_states is not None
    return trained.item_states.embeddings
