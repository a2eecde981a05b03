"""Reports of the reward model of items: calibration."""

from pathlib import Path

import pytest

from tests.support.tagged import tagged_store
from ucfrec.runs.run import training_views
from ucfrec.user_model.reward_fit import fit_item_reward_model
from ucfrec.user_model.reward_report import calibrate
from ucfrec.user_model.reward_rows import RewardRows


def test_calibration_undoes_a_stretched_and_shifted_score(tmp_path: Path) -> None:
    train, validation = training_views(tagged_store(tmp_path))
    model, _ = fit_item_reward_model(train, validation, tmp_path / "model", 0)
    rows = RewardRows.of(train, model.lags, 10_000, 0)
    slope, intercept = calibrate(model, rows)
    for name in ("item", "user", "state", "affinity", "interaction", "exposure"):
        model.get_buffer(name).mul_(2)
    model.item.add_(1)
    assert calibrate(model, rows)[0] == pytest.approx(slope / 2, rel=1e-3)
    assert calibrate(model, rows)[1] == pytest.approx(intercept - slope / 2, abs=1e-3)
