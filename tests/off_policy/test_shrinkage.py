"""Shrunk weights against the Open Bandit Pipeline, and what tuning them must do."""

from dataclasses import replace

import numpy as np
import pytest

from tests.support.logged_steps import random_steps, reference
from ucfrec.off_policy import LoggedSteps, Modelled, estimate
from ucfrec.off_policy.shrinkage import DR_KINDS, IPS_KINDS, mean_squared_error, shrunk, tune

STRENGTHS = {
    "clipped IPS": "λ ipw",
    "sub-Gaussian IPS": "λ sub",
    "SWITCH-DR": "λ switch",
    "DRos": "λ os",
    "sub-Gaussian DR": "λ sub",
}


@pytest.mark.parametrize("name", STRENGTHS)
def test_estimates_errors_and_choices_agree_with_open_bandit_pipeline(name: str) -> None:
    steps, expected = reference("bandit")
    assert steps.model is not None
    kind = (IPS_KINDS | DR_KINDS)[name]
    doubly_robust = name in DR_KINDS
    left = steps.reward - steps.model.q if doubly_robust else steps.reward
    value = steps.model.v if doubly_robust else np.zeros(len(left))
    weights = steps.session_weights
    kept = kind.shrink(weights, float(expected[STRENGTHS[name]]))
    assert (value + kept * left).mean() == pytest.approx(float(expected[name]), rel=1e-6)
    grid = expected["lambdas"] / (100 if "Gaussian" in name else 1)
    errors = [mean_squared_error(weights, kind.shrink(weights, each), left, value) for each in grid]
    np.testing.assert_allclose(errors, expected[f"{name} errors"], rtol=1e-6)
    chosen = tune(kind.shrink, grid, weights, left, value)
    tuned = (value + kind.shrink(weights, chosen) * left).mean()
    assert tuned == pytest.approx(float(expected[f"{name} tuned"]), rel=1e-6)


def test_one_extreme_is_the_unshrunk_estimate() -> None:
    weights = np.array([0.0, 0.5, 1.0, 40.0])
    for name, kind in (IPS_KINDS | DR_KINDS).items():
        unshrunk = 0.0 if "Gaussian" in name else np.inf
        assert unshrunk in kind.candidates
        np.testing.assert_allclose(kind.shrink(weights, unshrunk), weights)
        for candidate in kind.candidates:
            kept = kind.shrink(weights, candidate)
            assert (kept >= 0).all()
            assert kept.max() <= weights.max()


def test_shrinking_is_tuned_to_err_less_where_weights_are_heavy() -> None:
    """Squared errors over 100 logs of 500 sessions whose weights are lognormal."""
    squared = dict.fromkeys(("none", *IPS_KINDS, *DR_KINDS), 0.0)
    for seed in range(100):
        rng = np.random.default_rng(seed)
        weights = rng.lognormal(-1.125, 1.5, 500)
        earned, model = (rng.random(500) < 0.3).astype(float), np.full(500, 0.35)
        squared["none"] += ((weights * earned).mean() - 0.3) ** 2
        for name, kind in (IPS_KINDS | DR_KINDS).items():
            value = model if name in DR_KINDS else 0 * model
            chosen = tune(kind.shrink, kind.candidates, weights, earned - value, value)
            kept = kind.shrink(weights, chosen)
            squared[name] += ((value + kept * (earned - value)).mean() - 0.3) ** 2
    for name in (*IPS_KINDS, *DR_KINDS):
        assert squared[name] < 0.85 * squared["none"], name


def test_doubly_robust_kinds_are_for_single_steps() -> None:
    assert set(shrunk(random_steps([2, 1, 3]))) == set(IPS_KINDS)
    assert set(shrunk(random_steps([1, 1, 1]))) == set(IPS_KINDS) | set(DR_KINDS)


def test_only_unshrunk_weights_have_an_interval() -> None:
    """SWITCH-DR that switches everything off is DM, whose sampling error says nothing."""
    rng = np.random.default_rng(0)
    weights = rng.lognormal(-1.125, 1.5, 500)
    earned = (rng.random(500) < 0.3).astype(float)
    steps = LoggedSteps(
        np.arange(500),
        earned,
        np.full(500, 1e-3),
        np.minimum(weights * 1e-3, 1),
        Modelled(*np.full((4, 500), 0.3)),
    )
    found = estimate(steps, 0)
    for name in (*IPS_KINDS, *DR_KINDS):
        kept = shrunk(steps)[name][2]
        assert (found[name].low is None) is bool((kept != steps.session_weights).any()), name
    assert found["SWITCH-DR"].low is None
    near = estimate(replace(steps, target=steps.propensity * 0.999), 0)
    assert near["clipped IPS"].low is not None
