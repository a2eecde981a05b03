"""Models of future reward: sums in chunks, what they report, and Q that runs away."""

from collections.abc import Iterator

import numpy as np
import pytest

from ucfrec.arrays import Float32Array
from ucfrec.off_policy.fqe import ModelReport, fit_models
from ucfrec.off_policy.logged_steps import Modelled


def chain(sessions: int = 300, length: int = 4, seed: int = 0) -> tuple[Float32Array, ...]:
    """Sessions with a reward of their x at every step; features 1, x and x · steps left."""
    rng = np.random.default_rng(seed)
    x = np.repeat(rng.normal(size=sessions), length)
    left = np.tile(np.arange(length, 0, -1), sessions)
    features = np.column_stack([np.ones(len(x)), x, x * left]).astype(np.float32)
    return features, x + 0.01 * rng.normal(size=len(x)), np.repeat(np.arange(sessions), length)


def fitted(
    features: Float32Array, reward: Float32Array, session: Float32Array, rows: int
) -> tuple[Modelled, ModelReport]:
    def chunks() -> Iterator[tuple[Float32Array, Float32Array]]:
        for begin in range(0, len(features), rows):
            yield features[begin : begin + rows], features[begin : begin + rows]

    return fit_models(chunks, reward, session, seed=0)


@pytest.mark.parametrize("rows", [1, 7, 512])
def test_chunks_change_nothing(rows: int) -> None:
    """Also where a session lies in several."""
    features, reward, session = chain()
    found = fitted(features, reward, session, rows)[0]
    whole = fitted(features, reward, session, len(features))[0]
    for name, values in vars(whole).items():
        np.testing.assert_allclose(vars(found)[name], values, rtol=1e-3, atol=1e-4)


def test_q_is_what_is_still_to_come() -> None:
    features, reward, session = chain(3000)
    modelled, report = fitted(features, reward, session, 512)
    # The penalty takes off a little.
    assert np.abs(modelled.q - features[:, 2]).mean() < 0.03
    assert np.abs(modelled.reward - features[:, 1]).mean() < 0.01
    assert 4 < report.iterations < 40
    assert report.converged
    assert report.reward_r2 > 0.99
    assert report.td_loss < 1e-3
    assert abs(report.td_bias) < 0.01


def test_a_model_that_knows_nothing_reports_so() -> None:
    features, reward, session = chain()
    rng = np.random.default_rng(1)
    noise = np.column_stack([features[:, 0], rng.normal(size=(len(features), 2))])
    report = fitted(noise.astype(np.float32), reward, session, 512)[1]
    assert report.reward_r2 < 0.02
    assert report.td_loss == pytest.approx(reward.var(), rel=0.1)
    assert report.columns()["model_reward_r2"] == report.reward_r2
    assert f"{report.td_loss:.3g} squared" in str(report)


def test_q_that_runs_away_is_stopped_and_said() -> None:
    """The evaluated policy's features are five times the logged: each step multiplies Q."""
    features, reward, session = chain(length=40)
    ones = np.ones((len(features), 1), dtype=np.float32)
    logged = np.hstack([ones, 1 + features[:, [1]] ** 2])
    five = logged * np.array([1, 5], dtype=np.float32)

    def chunks() -> Iterator[tuple[Float32Array, Float32Array]]:
        yield logged, five

    report = fit_models(chunks, np.abs(reward), session, seed=0)[1]
    assert not report.converged
    assert report.iterations < 400
    assert np.isfinite(report.td_loss)
