"""KuaiRand (Pure, 1K and 27K; Gao et al., 2022): official CSV or Parquet files, with features."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from ucfrec.errors import InputError
from ucfrec.logs.mapping import Dataset, LogMapping, Release, log_files
from ucfrec_datasets.generic import Resolved, official_table

LOGS: Final = ("log_standard_", "log_random_")
FEATURES: Final = ("user_features_", "video_features_basic_", "video_features_statistic_")
USERS, BASIC, STATISTIC = FEATURES

PROFILE: Final = (
    "user_active_degree",
    "is_lowactive_period = 1",
    "is_live_streamer = 1",
    "is_video_author = 1",
    "ln(1 + follow_user_num)",
    "ln(1 + fans_user_num)",
    "ln(1 + friend_user_num)",
    "ln(1 + register_days)",
)
"""Columns of users that KuaiRec has too."""
USER_COLUMNS: Final = (
    *PROFILE,
    *(f"onehot_feat{n}::VARCHAR" for n in (0, 1, 2, 4, 5, 6, *range(9, 18))),
)
"""Without onehot features 3, 7 and 8, which have 1,471, 118 and 454 values among 27,285 users."""

BASIC_COLUMNS: Final = (
    "video_type",
    "upload_dt::DATE",
    "upload_type",
    "ln(1 + video_duration)",
    "server_width > server_height",
    "music_type::VARCHAR",
    "string_split(tag, ',')",
)

STATISTIC_COLUMNS: Final = (
    "ln(1 + show_cnt)",
    "ln(1 + play_cnt)",
    "play_progress",
    "complete_play_cnt / play_cnt",
    "valid_play_cnt / play_cnt",
    "long_time_play_cnt / play_cnt",
    "short_time_play_cnt / play_cnt",
    "like_cnt / play_cnt",
    "comment_cnt / play_cnt",
    "follow_cnt / play_cnt",
    "share_cnt / play_cnt",
    "collect_cnt / play_cnt",
)
"""Daily means over the whole month of the logs, validation and test split included: with them, the
item embeddings contain some information on the days of the evaluation."""

MAPPING: Final = LogMapping(
    columns={"item_id": "video_id", "timestamp": "time_ms", "is_random": "is_rand"},
    reward="is_click",
    # The releases have only a user's rows on a sample of videos, not whole visits: with pauses of
    # half an hour, 87% of the sessions would have a single row.
    session_by="user",
)


def _resolve(paths: Sequence[str | Path], mapping: LogMapping) -> Resolved:
    """All given logs, with user and basic video features of the same paths or the logs' folder.

    Logs may have any name if none is called as in the releases.
    """
    files = log_files(paths)
    plain = tuple(file for file in files if not file.name.startswith(FEATURES))
    logs = tuple(file for file in plain if file.name.startswith(LOGS)) or plain
    if not logs:
        raise InputError(
            f"no KuaiRand log among {len(files)} file(s) such as {files[0]}, only tables of "
            f"features; name the log too, e.g. {LOGS[0]}*"
        )
    candidates = (*files, *log_files([logs[0].parent]))
    # Video statistics are used only if a path names their file.
    statistics = [Path(path) for path in paths if Path(path).name.startswith(STATISTIC)]
    defaults = LogMapping(
        item_features=(
            *official_table(candidates, BASIC, "video_id", BASIC_COLUMNS),
            *official_table(statistics, STATISTIC, "video_id", STATISTIC_COLUMNS),
        ),
        user_features=official_table(candidates, USERS, "user_id", USER_COLUMNS),
    )
    return logs, mapping.over(defaults).over(MAPPING)


DATASET: Final = Dataset(
    summary="KuaiRand Pure, 1K or 27K: the official folder, or files of it (CSV or Parquet)",
    resolve=_resolve,
    releases={
        "kuairand-pure": Release(
            url="https://zenodo.org/records/10439422/files/KuaiRand-Pure.tar.gz",
            homepage="https://kuairand.com",
            licence="CC BY-SA 4.0",
            checksum="md5:0820331067a3784d9691136f772b35a7",
            size=47_432_272,
            parts={"all": "KuaiRand-Pure/data"},
        )
    },
)
