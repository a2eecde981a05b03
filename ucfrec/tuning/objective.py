"""What a trial of a search is measured by, on validation rows."""

from typing import Final

import numpy as np

from ucfrec import schema
from ucfrec.episodes.earlier import UserRows
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.evaluation.liked import LikedByRange
from ucfrec.evaluation.ranking import Later, Period, measure, rank_steps
from ucfrec.evaluation.ranking_baselines import PolicyRanker
from ucfrec.runs.record import RunRecord
from ucfrec.runs.trained_policy import TrainedPolicy

VALUE: Final = "value"
METRICS: Final = {
    VALUE: "return of a session in the user model, under the decision rule that training selects",
    "ndcg": "NDCG of liked items among the k recommended, on validation rows",
    "gauc": "probability that a liked item scores above another one shown to the user, on "
    "validation rows",
}
_MEASURES: Final = {"ndcg": "ndcg_liked", "gauc": "gauc"}


def measured(trained: TrainedPolicy, store: EpisodeStore, metric: str, k: int) -> float:
    """The metric of a finished run; higher is better.

    Args:
        trained: the run's policy.
        store: the store that it was trained on.
        metric: one of `METRICS`.
        k: items recommended, of "ndcg".

    Raises:
        InputError: the run or its validation rows do not have the metric.
    """
    if metric == VALUE:
        return _value(trained.record)
    validation = store.split("validation")
    assert trained.item_states is not None
    users = validation.episode_values(schema.USER)
    period = Period.of(validation, users, LikedByRange(trained.item_states))
    ranker, k = PolicyRanker(trained, None, trained.name), min(k, period.n_items)
    rows = UserRows.of(validation, users, store.split("train"))
    ranked = rank_steps(ranker, Later(validation, rows, filter_seen=True), k)
    above, below = measure(period, ranked, k)[_MEASURES[metric]]
    if not below.any():
        raise InputError(
            f"{store.path}: no validation row is liked, so there is no {metric}; use another "
            "--metric, or a later split"
        )
    return float(np.sum(above) / np.sum(below))


def _value(record: RunRecord) -> float:
    value = None if record.rule is None else record.rule.simulated
    if value is None:
        raise InputError(
            "the decision rule of this training is not selected in the user model, so there is no "
            "estimated value; use --metric ndcg or gauc"
        )
    return value[0]
