"""Result rows written out."""

from collections.abc import Mapping, Sequence
from typing import Any

from ucfrec.results.rows import ResultRow


def result_row(value: float = 1.0, **fields: Any) -> ResultRow:
    """A row of a recommendation table: R_cum is `value`, beside `metrics` and other `fields`."""
    given: dict[str, Any] = {"suite": "recommendation", "table": "main", "metric": "R_cum"}
    given |= {"task": "w", "environment": "w", "method": "m", "policy": "m"}
    given |= {"training_seed": 0, "checkpoint": "best"} | fields
    given["metrics"] = {given["metric"]: value, **fields.get("metrics", {})}
    return ResultRow(**given)


def distractor_rows(values: Mapping[float | None, Sequence[float]]) -> list[ResultRow]:
    """Rows of a method without a distractor, with it off and on: a value a seed."""
    metrics = {"R_avg_pooled": 0.5, "R_avg_episode": 0.5, "length": 2.0}
    shared = {"metrics": metrics, "target_return": 3.0}
    return [
        result_row(value, **shared, training_seed=seed, conditions=conditions)
        for quantile in ("0.99", "1")
        for rate, own in values.items()
        for conditions in [{"distractor": rate, "quantiles": quantile}]
        for seed, value in enumerate(own)
    ]
