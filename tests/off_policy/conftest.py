"""A run on logs in sessions, and other logs to evaluate it on."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.recommending.test_recommend import SETTINGS, random_log
from ucfrec import UCF, EpisodeStore
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.off_policy.score import LoggedSessions, read_logged_sessions
from ucfrec.runs.trained_policy import TrainedPolicy


@pytest.fixture(scope="package")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, and the logs to score: other sessions, some of a user the run never saw."""
    folder = tmp_path_factory.mktemp("score")
    log = random_log().sample(frac=1, random_state=1)
    log.iloc[:1000].to_parquet(folder / "train.parquet")
    options = PrepareOptions(reward="reward", session_by="gap", gap_minutes=20)
    prepare([folder / "train.parquet"], LogMapping(), folder / "store", options)
    UCF(settings=SETTINGS).fit(EpisodeStore.open(folder / "store"), folder / "run")
    rest = log.iloc[1000:].assign(propensity=1 / 30)
    rest["user_id"] = np.where(rest.user_id == 5, 10**6, rest.user_id)
    rest.to_parquet(folder / "rest.parquet")
    return folder


@pytest.fixture
def trained(folder: Path) -> TrainedPolicy:
    return TrainedPolicy.load(folder / "run")


@pytest.fixture
def log(folder: Path) -> pd.DataFrame:
    return pd.read_parquet(folder / "rest.parquet")


Read = Callable[..., AbstractContextManager[LoggedSessions]]


@pytest.fixture
def read(trained: TrainedPolicy, tmp_path: Path) -> Read:
    """Reads a frame for the run, with rows of unknown items or without."""

    def read(log: pd.DataFrame, keep: bool = False) -> AbstractContextManager[LoggedSessions]:
        log.to_parquet(tmp_path / "log.parquet")
        return read_logged_sessions(trained, [tmp_path / "log.parquet"], LogMapping(), keep)

    return read


@pytest.fixture
def logged(read: Read, log: pd.DataFrame) -> Iterator[LoggedSessions]:
    with read(log) as logged:
        yield logged
