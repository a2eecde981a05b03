"""Off-policy estimates against a world whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from ucfrec.errors import InputError
from ucfrec.ope import LoggedSteps, estimate

BEHAVIOR, TARGET, PAYS = np.array([0.5, 0.3, 0.2]), np.array([0.2, 0.3, 0.5]), np.arange(3.0)


def logged(sessions: int, seed: int = 0) -> LoggedSteps:
    actions = np.random.default_rng(seed).choice(3, size=2 * sessions, p=BEHAVIOR)
    left = np.tile([2.0, 1.0], sessions) - 1
    mean = float(TARGET @ PAYS)
    return LoggedSteps(
        session=np.repeat(np.arange(sessions), 2),
        reward=PAYS[actions],
        propensity=BEHAVIOR[actions],
        target=TARGET[actions],
        q=PAYS[actions] + left * mean,
        v=(left + 1) * mean,
    )


def test_every_estimator_finds_the_truth() -> None:
    truth = 2 * float(TARGET @ PAYS)
    for name, found in estimate(logged(20_000), seed=0).items():
        assert found.value == pytest.approx(truth, abs=0.1), name


def test_the_behavior_itself_is_its_own_mean() -> None:
    steps = logged(500)
    steps = replace(steps, target=steps.propensity)
    found = estimate(steps, seed=0)
    for name in ("IPS", "SNIPS", "PDIS"):
        assert found[name].value == pytest.approx(steps.reward.sum() / 500)
        assert found[name].effective_sessions == pytest.approx(500)


def test_a_propensity_of_zero_is_an_input_error() -> None:
    with pytest.raises(InputError, match="propensities"):
        estimate(replace(logged(5), propensity=np.zeros(10)), seed=0)
