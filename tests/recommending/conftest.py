"""The run that most of these tests ask."""

import pytest

from tests.support.logs import store_of
from tests.support.served import OBSERVED, SETTINGS, observed_log, trained_run
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> TrainedPolicy:
    return trained_run(tmp_path_factory.mktemp("trained"))


@pytest.fixture(scope="module")
def observing(tmp_path_factory: pytest.TempPathFactory) -> TrainedPolicy:
    """A run that sees the two logged columns of observations."""
    folder = tmp_path_factory.mktemp("observing")
    options = {"gap_minutes": 120, "embedding_size": 6}
    store = store_of(observed_log(), folder, OBSERVED, reward="reward", session_by="gap", **options)
    train_run(store, folder / "run", resolve_config("dt", None, SETTINGS))
    return TrainedPolicy.load(folder / "run")
