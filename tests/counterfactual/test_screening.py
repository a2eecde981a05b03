"""Screening of logs of items finds what measures the reward, and keeps what causes something."""

from pathlib import Path

import numpy as np
import pytest

from tests.support.causes import planted_items, planted_vectors
from ucfrec import schema
from ucfrec.counterfactual import screening
from ucfrec.counterfactual.screening import screen
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError


@pytest.fixture(autouse=True)
def _few_trees(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(screening, "TREES", 25)


@pytest.mark.parametrize("flip", [0.0, 0.15])
def test_in_logs_of_clicks_measurements_are_flagged_and_causes_are_not(
    flip: float, tmp_path: Path
) -> None:
    store = planted_items(tmp_path / "store", flip=flip)
    report = screen(store, seed=0)
    assert report.flagged == (0, 4)
    assert [d.measures_reward for d in report.dimensions] == [True, False, False, False, True]
    assert report.dimensions[0].effect is None
    assert "dimensions without effect: 0, 4" in report.describe()


def test_what_cannot_be_screened_is_refused(tmp_path: Path) -> None:
    columns = {schema.ITEM: np.zeros(8, dtype=np.int64), schema.REWARD: np.arange(8.0)}
    none = EpisodeStore.write(tmp_path / "none", columns, np.full(4, 2))
    for store, message in (
        (none, "no logged observations to screen"),
        (planted_vectors(tmp_path / "vectors"), "are vectors; screen it with ucfrec-control"),
        (planted_items(tmp_path / "few", sessions=8), "screening needs at least 15"),
    ):
        with pytest.raises(InputError, match=message):
            screen(store, seed=0)
