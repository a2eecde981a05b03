"""Stores and runs on `random_log`."""

from collections.abc import Sequence
from pathlib import Path

from tests.recommending.test_recommend import SMALL, random_log
from ucfrec import EpisodeStore
from ucfrec.logs import LogMapping, PrepareOptions, prepare
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run


def random_store(folder: Path) -> EpisodeStore:
    """The store of `random_log`, at `folder / "store"`, beside its log."""
    random_log().to_parquet(folder / "log.parquet")
    options = PrepareOptions(reward="reward", session_by="gap", gap_minutes=20)
    prepare([folder / "log.parquet"], LogMapping(), folder / "store", options)
    return EpisodeStore.open(folder / "store")


def random_run(
    folder: Path, policy: str, settings: Sequence[str] = SMALL, name: str = "run"
) -> Path:
    """A run `name` on `random_store`; returns its folder."""
    train_run(random_store(folder), folder / name, resolve_config(policy, None, settings))
    return folder / name
