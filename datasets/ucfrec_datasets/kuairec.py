"""KuaiRec (Gao et al., 2022): official CSV files, with features."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from ucfrec.logs.mapping import Dataset, LogMapping, Release
from ucfrec_datasets.generic import Resolved, official_files, official_table
from ucfrec_datasets.kuairand import PROFILE

TRAINING, EVALUATION = "big_matrix", "small_matrix"
FEATURES: Final = ("user_features", "item_categories", "item_daily_features")
USERS, CATEGORIES, DAILY = FEATURES

USER_COLUMNS: Final = (*PROFILE, *(f"onehot_feat{n}::VARCHAR" for n in range(18)))

CATEGORY_COLUMNS: Final = ("feat::INTEGER[]",)

DAILY_COLUMNS: Final = (
    "video_type",
    "upload_dt::DATE",
    "upload_type",
    "ln(1 + coalesce(video_duration, 0))",
    "video_width > video_height",
    "video_tag_id::VARCHAR",
)
"""Features that do not change from day to day. The 45 statistics are excluded: those of a later day
contain how users received the video on the days of the evaluation."""

MAPPING: Final = LogMapping(
    columns={"item_id": "video_id", "timestamp": "timestamp * 1000"},
    reward="least(watch_ratio, 5)",
    # A user saw about 1,700 videos in two months, so sessions are visits rather than users.
    session_by="gap",
)


def _resolve(paths: Sequence[str | Path], mapping: LogMapping) -> Resolved:
    """The given matrices, or `big_matrix` of a given folder, with features of the logs' folder.

    `small_matrix` is read only if a path names it, because the `kuairec` simulator is made from it.
    """
    logs, files = official_files(paths, TRAINING, FEATURES)
    defaults = LogMapping(
        item_features=(
            *official_table(files, CATEGORIES, "video_id", CATEGORY_COLUMNS),
            *official_table(files, DAILY, "video_id", DAILY_COLUMNS, first_by="date"),
        ),
        user_features=official_table(files, USERS, "user_id", USER_COLUMNS),
    )
    return logs, mapping.over(defaults).over(MAPPING)


DATASET: Final = Dataset(
    summary="KuaiRec: the official folder (its big_matrix), or files of it (CSV or Parquet)",
    resolve=_resolve,
    releases={
        "kuairec": Release(
            url="https://zenodo.org/records/18164998/files/KuaiRec.zip",
            homepage="https://kuairec.com",
            licence="CC BY-SA 4.0",
            checksum="md5:261550d472c48eff4990fb13c0e5bcf7",
            size=431_964_858,
            parts={"all": "KuaiRec 2.0/data"},
        )
    },
)
