"""Group AUC against its definition."""

import numpy as np
import pytest

from ucfrec.episodes.group_auc import group_auc, ratio_with_error


def test_group_auc_is_the_mean_over_pairs_of_a_user() -> None:
    rng = np.random.default_rng(0)
    owner = rng.integers(6, size=60)
    scores, liked = rng.integers(5, size=60).astype(float), rng.random(60) < 0.4
    liked[owner == 2] = True
    above, below = group_auc(scores, liked, owner, 7)
    for user in range(7):
        good, bad = scores[(owner == user) & liked], scores[(owner == user) & ~liked]
        pairs = [(a > b) + 0.5 * (a == b) for a in good for b in bad]
        size = (owner == user).sum() if pairs else 0
        assert below[user] == size
        assert above[user] == pytest.approx(size * np.mean(pairs) if pairs else 0.0)


def test_the_error_of_a_ratio_is_that_of_resampled_users() -> None:
    rng = np.random.default_rng(1)
    below = rng.integers(1, 20, size=300).astype(float)
    above = below * np.clip(rng.normal(0.6, 0.2, size=300), 0, 1)
    ratio, error = ratio_with_error(above, below)
    drawn = rng.integers(300, size=(2000, 300))
    resampled = above[drawn].sum(1) / below[drawn].sum(1)
    assert ratio == pytest.approx(above.sum() / below.sum())
    assert error == pytest.approx(resampled.std(), rel=0.1)
    assert np.isnan(ratio_with_error(np.zeros(3), np.zeros(3))).all()
