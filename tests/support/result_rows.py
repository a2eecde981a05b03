"""Result rows made by hand."""

from typing import Any

from ucfrec.reporting.result_row import ResultRow


def result_row(value: float = 1.0, **fields: Any) -> ResultRow:
    """A row of a recommendation table with `value` as R_cum; `fields` as they differ from it.

    `metrics` are added to R_cum, other fields replace those of the row.
    """
    given: dict[str, Any] = {
        "suite": "recommendation",
        "table": "main",
        "task": "w",
        "environment": "w",
        "method": "m",
        "policy": "m",
        "training_seed": 0,
        "checkpoint": "best",
        "metric": "R_cum",
    }
    metric = fields.get("metric", given["metric"])
    metrics = {metric: value, **fields.pop("metrics", {})}
    return ResultRow(**given | {"metrics": metrics} | fields)
