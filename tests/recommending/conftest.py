"""The run that most of these tests ask."""

import pytest

from tests.support.served import trained_run
from ucfrec.runs.trained_policy import TrainedPolicy


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> TrainedPolicy:
    return trained_run(tmp_path_factory.mktemp("trained"))
