"""From Parquet logs to recommendations, with logs that look like a video app's.

Run it with `python examples/logs_to_recommendations.py [FOLDER]`; it takes under a minute on two
cores. Nothing is downloaded: the first part makes the logs, so that the last part can say how good
the recommendations truly are. With logs of your own you start at part 2.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

from ucfrec import EpisodeStore, Recommender
from ucfrec.arrays import Float64Array
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.logs.summary import format_report

USERS, VIDEOS, TOPICS = 500, 240, 6
SETTINGS = {
    "train": {"steps": 500, "learning_rate": 3e-3, "warmup_steps": 50, "cosine": True},
    "policy": {"dim": 32, "context": 8},
    "crm": {"epochs": 4},
}
COLUMNS = {"user_id": "uid", "item_id": "video", "timestamp": "time_s * 1000"}
"""What ucfrec calls a column, and how the logs of part 1 express it."""


# Part 1: made-up logs.
#
# Every user likes two of six topics. Half of the sessions were served by a good recommender, which
# mostly shows liked topics; the other half by a bad one, which shows anything. The column names and
# units are not ours on purpose: times are seconds, and what counts is how long a video was watched.


def make_logs(folder: Path) -> Float64Array:
    """Write `views.parquet` and `videos.csv`.

    Returns:
        (USERS, VIDEOS) how much of each video each user would watch on average, from 0 to 1.
    """
    rng = np.random.default_rng(0)
    topic = np.arange(VIDEOS) % TOPICS
    liked = np.argsort(rng.random((USERS, TOPICS)), axis=1)[:, :2]
    likes = (topic[None, :, None] == liked[:, None, :]).any(axis=2)  # (USERS, VIDEOS)
    appeal = np.where(likes, 0.8, 0.15) + rng.normal(0, 0.05, VIDEOS)
    rows = []
    for user in range(USERS):
        clock = 1_700_000_000 + int(rng.integers(86_400))
        for _ in range(6):
            good = rng.random() < 0.5
            clock += 40_000  # many hours of silence: a new session
            for _ in range(int(rng.integers(5, 13))):
                pool = np.flatnonzero(likes[user]) if good and rng.random() < 0.8 else None
                video = int(rng.choice(VIDEOS if pool is None else pool))
                share = float(np.clip(rng.normal(appeal[user, video], 0.2), 0, 1.5))
                duration = 20_000 + 500 * video
                rows.append((f"u{user:03}", f"v{video:03}", clock, int(share * duration), duration))
                clock += 30
    names = ["uid", "video", "time_s", "play_ms", "duration_ms"]
    pd.DataFrame(rows, columns=names).to_parquet(folder / "views.parquet")
    videos = {"video": [f"v{i:03}" for i in range(VIDEOS)], "topic": [f"t{t}" for t in topic]}
    pd.DataFrame(videos).to_csv(folder / "videos.csv", index=False)
    return appeal


# Part 2: from logs to a store of sessions.
#
# A mapping says which column of your files is which log column; SQL expressions may convert units.
# The reward is a SQL expression too: here the share of the video that was watched, at most 1.
# Half an hour of silence ends a session. The report says what was read, dropped and kept.


def prepare_logs(folder: Path) -> EpisodeStore:
    """Write the store and return it."""
    mapping = LogMapping(
        columns=COLUMNS,
        item_features=(FeatureTable((folder / "videos.csv",), "video", ("topic",)),),
    )
    options = PrepareOptions(reward="least(play_ms / duration_ms, 1)", session_by="gap")
    report = prepare([folder / "views.parquet"], mapping, folder / "store", options)
    print(format_report(report), end="\n\n")
    return EpisodeStore.open(folder / "store")


# Part 3: train.
#
# `Recommender` trains on the training split and keeps the weights with the best validation loss.
# The run folder can be resumed, and read by every `ucfrec` command. The settings make it small.


def train(store: EpisodeStore, folder: Path) -> Recommender:
    """Train a small UCF."""
    return Recommender("ucf", SETTINGS).fit(store, folder / "run")


# Part 4: recommend, and look at what it is worth.
#
# Histories are rows like those of the logs, one an interaction; the policy knows how its reward is
# computed from them. Because we made the users up, we can look up how much of each recommended
# video they would truly watch. With real logs nobody can: `judge_three_ways.py` shows what can be
# done then.


def true_value(frame: pd.DataFrame, appeal: Float64Array) -> float:
    """Mean share that the users of `frame` would watch of its videos."""
    users = frame["user_id"].str[1:].astype(int)
    videos = frame["item_id"].str[1:].astype(int)
    return float(appeal[users, videos].mean())


def main(folder: Path) -> dict[str, float]:
    """Run all parts; returns the true value of what was logged, popular and recommended."""
    appeal = make_logs(folder)
    policy = train(prepare_logs(folder), folder)

    views = pd.read_parquet(folder / "views.parquet")
    recommended = policy.recommend(views, k=5, mapping=LogMapping(COLUMNS))
    print(recommended.head(5).to_string(index=False), end="\n\n")

    logged = views.rename(columns={"uid": "user_id", "video": "item_id"})
    share = (logged["play_ms"] / logged["duration_ms"]).clip(upper=1)
    best = share.groupby(logged["item_id"]).mean().nlargest(5).index
    everyone = logged[["user_id"]].drop_duplicates()
    popular = everyone.merge(pd.DataFrame({"item_id": best}), how="cross")
    found = {
        "random": float(appeal.mean()),
        "logged": true_value(logged, appeal),
        "same five for everybody": true_value(popular, appeal),
        "recommended": true_value(recommended, appeal),
    }
    for name, value in found.items():
        print(f"{name:<24} {value:.2f} of a video is watched on average")
    return found


if __name__ == "__main__":
    if len(sys.argv) > 1:
        chosen = Path(sys.argv[1])
        chosen.mkdir(parents=True)
        main(chosen)
    else:
        with tempfile.TemporaryDirectory() as scratch:
            main(Path(scratch))
