"""Stores and runs on `random_log`."""

from collections.abc import Sequence
from pathlib import Path

from tests.recommending.test_recommend import SMALL, random_log
from tests.support.logs import store_of
from ucfrec import EpisodeStore
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run


def random_store(folder: Path) -> EpisodeStore:
    """The store of `random_log`, at `folder / "store"`, beside its log."""
    return store_of(random_log(), folder, reward="reward", session_by="gap", gap_minutes=20)


def random_run(
    folder: Path, policy: str, settings: Sequence[str] = SMALL, name: str = "run"
) -> Path:
    """A run `name` on `random_store`; returns its folder."""
    train_run(random_store(folder), folder / name, resolve_config(policy, None, settings))
    return folder / name
