"""The simulated launches have the gains that they are said to have."""

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest


def test_the_gain_of_a_launch_is_that_of_its_sessions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    arm, users = import_module("launches").make_arm("catalogue", 5), 8000
    better = arm.improve(0.1, [5])
    assert better.value(users, []) / arm.value(users, []) == pytest.approx(1.1, abs=0.005)
    for policy in (arm, better):
        log, (value,) = policy.play(users, [6]), policy.value(users, [])
        returns = np.bincount(log["user_id"], log["reward"], users) / 2
        assert abs(returns.mean() - value) < 4 * returns.std() / users**0.5
