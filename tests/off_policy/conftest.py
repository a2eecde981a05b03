"""A run on logs in sessions, and other logs to evaluate it on."""

from pathlib import Path

import numpy as np
import pytest

from tests.recommending.test_recommend import SETTINGS, random_log
from ucfrec import UCF, EpisodeStore
from ucfrec.logs import LogMapping, PrepareOptions, prepare
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
