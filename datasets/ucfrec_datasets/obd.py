"""Open Bandit Dataset (Saito et al., 2021): impressions of two policies with true propensities."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from ucfrec.errors import InputError
from ucfrec.logs.mapping import Dataset, FeatureTable, LogMapping, log_files

ITEMS: Final = "item_context"
USER_FEATURES: Final = tuple(f"user_feature_{n}" for n in range(4))
USER: Final = f"concat_ws('-', {', '.join(f'left({name}, 8)' for name in USER_FEATURES)})"
"""The logs have no user ids, so users with equal features count as one. A feature has fewer than
ten values, hashes that differ in their first eight digits."""
ITEM_FEATURES: Final = tuple(f"item_feature_{n}" for n in range(4))

MAPPING: Final = LogMapping(
    columns={
        "user_id": USER,
        "timestamp": "\"timestamp\"::TIMESTAMPTZ AT TIME ZONE 'UTC'",
        "propensity": "propensity_score",
        "session_id": "concat_ws(' ', \"timestamp\", position)",
        # Position on the page, which is known before the item is chosen.
        "observation": "[position = 1, position = 2, position = 3]::FLOAT[]",
    },
    reward="click",
    session_by="session_id",
)


def _resolve(paths: Sequence[str | Path], given: LogMapping) -> tuple[tuple[Path, ...], LogMapping]:
    """All given logs, with item features of the same paths or the logs' folder."""
    named = log_files(paths)
    logs = tuple(file for file in named if not file.name.startswith(ITEMS))
    if not logs:
        raise InputError(f"{named[0]} has features, not impressions; name a log, e.g. all.csv")
    candidates = (*named, *log_files([logs[0].parent]))
    items = [file for file in candidates if file.name.startswith(ITEMS)]
    defaults = LogMapping(
        # The folders of all campaigns have the same item table.
        item_features=(FeatureTable((items[0],), "item_id", ITEM_FEATURES),) if items else (),
        user_features=(FeatureTable(logs, USER, USER_FEATURES, first_by='"timestamp"'),),
    )
    return logs, given.over(defaults).over(MAPPING)


DATASET: Final = Dataset(
    summary="Open Bandit Dataset: folders of a policy and campaign, or files (CSV or Parquet)",
    resolve=_resolve,
)
