"""Runs on `random_log`."""

from collections.abc import Sequence
from pathlib import Path

from tests.recommending.test_recommend import SMALL, random_log
from tests.support.logs import store_of
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run


def random_run(folder: Path, policy: str, settings: Sequence[str] = SMALL) -> Path:
    """A run on the store of `random_log`, which lies beside it; returns its folder."""
    store = store_of(random_log(), folder, reward="reward", session_by="gap", gap_minutes=20)
    train_run(store, folder / "run", resolve_config(policy, None, settings))
    return folder / "run"
