"""Open Bandit Dataset (Saito et al., 2021): impressions of two policies with true propensities."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.logs.mapping import SUFFIXES, Dataset, FeatureTable, LogMapping, Release, log_files
from ucfrec_datasets.generic import Resolved

CAMPAIGNS: Final = ("all", "men", "women")
"""Each has items of its own, which it numbers from 0."""
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


def _resolve(paths: Sequence[str | Path], mapping: LogMapping) -> Resolved:
    """Logs of one campaign, with item features of the same paths or of the first log's folder.

    Items are called `<campaign>/<number>`, so that no run of one campaign reads the logs of another
    as its own.
    """
    files = log_files(paths)
    logs = tuple(file for file in files if not file.name.startswith(ITEMS))
    if not logs:
        raise InputError(f"{files[0]} has features, not impressions; name a log, e.g. all.csv")
    item_id = mapping.columns.get(schema.ITEM_ID)
    campaigns = {} if item_id else {_campaign(log): log for log in reversed(logs)}
    if None in campaigns:
        raise InputError(
            f"{campaigns[None]}: neither the file nor its folder is named after a campaign "
            f"({', '.join(CAMPAIGNS)}), whose items have numbers of their own; rename the file,"
            " e.g. random_men.csv"
        )
    if len(campaigns) > 1:
        raise InputError(
            f"{' and '.join(map(str, campaigns.values()))} are of the campaigns "
            f"{' and '.join(map(str, campaigns))}, which share no item; prepare one campaign at a "
            "time"
        )
    campaign = next(iter(campaigns), None)
    item_id = item_id or f"concat('{campaign}/', item_id)"
    items = [
        file
        for file in (*files, *log_files([logs[0].parent]))
        if file.name.startswith(ITEMS) and _campaign(file) in (None, campaign or _campaign(file))
    ]
    defaults = LogMapping(
        {schema.ITEM_ID: item_id},
        # The folders of all policies have the same item table of a campaign.
        item_features=(FeatureTable((items[0],), item_id, ITEM_FEATURES),) if items else (),
        user_features=(FeatureTable(logs, USER, USER_FEATURES, first_by='"timestamp"'),),
    )
    return logs, mapping.over(defaults).over(MAPPING)


def _campaign(file: Path) -> str | None:
    """The campaign that a file (`men.csv`, `random_men.parquet`) or its folder is named after."""
    stem = file.name
    for suffix in SUFFIXES:
        stem = stem.removesuffix(suffix)
    names = (stem.rpartition("_")[2], file.resolve().parent.name.rpartition("_")[2])
    return next((name for name in names if name in CAMPAIGNS), None)


DATASET: Final = Dataset(
    summary="Open Bandit Dataset: folders of a policy and campaign, or files (CSV or Parquet)",
    resolve=_resolve,
    releases={
        "open-bandit": Release(
            url="https://research.zozo.com/data_release/open_bandit_dataset.zip",
            homepage="https://research.zozo.com/data.html",
            licence="CC BY 4.0",
            checksum="sha256:e8ec18196582a5937381a1776382ca940689b90a18d2dcd1fb635be6df614d78",
            size=412_931_917,
            parts={
                f"{policy}/{campaign}": f"open_bandit_dataset/{policy}/{campaign}"
                for policy in ("random", "bts")
                for campaign in CAMPAIGNS
            },
        )
    },
)
