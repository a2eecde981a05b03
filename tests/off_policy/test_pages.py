"""Pages: each model of the reward, against enumeration and the Open Bandit Pipeline."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.logged_steps import random_steps
from ucfrec.errors import InputError
from ucfrec.off_policy import LoggedSteps, as_pages, conclude, estimate
from ucfrec.off_policy.estimators import session_terms
from ucfrec.off_policy.pages import number_pages

SLATE = Path(__file__).with_name("fixtures") / "slate.npz"
BY_MODEL = {"independent": "IIPS", "cascade": "PDIS", "slate": "IPS"}


def rows(n: int, seed: int = 0) -> LoggedSteps:
    return random_steps([1] * n, seed)


def test_estimates_agree_with_the_open_bandit_pipeline() -> None:
    with np.load(SLATE) as given:
        steps = LoggedSteps(
            np.arange(len(given["page"])), given["reward"], given["propensity"], given["target"]
        )
        found = estimate(as_pages(steps, given["page"]), seed=0)
        for name in BY_MODEL.values():
            assert found[name].value == pytest.approx(float(given[name]), rel=1e-9), name


@pytest.mark.parametrize("model", BY_MODEL)
def test_each_estimate_is_right_where_its_model_is(model: str) -> None:
    """Exactly, over every page of three positions and two items; the weaker model errs."""
    behavior, target = np.array([0.7, 0.3]), np.array([0.2, 0.8])
    values = dict.fromkeys(("IIPS", "PDIS", "IPS"), 0.0)
    truth = 0.0
    for page in itertools.product((0, 1), repeat=3):
        items = np.array(page)
        seen = {
            "independent": items,
            "cascade": items.cumsum(),
            "slate": items.sum() * np.arange(1, 4),
        }
        reward = np.asarray(seen[model], dtype=np.float64) ** 2
        steps = LoggedSteps(np.arange(3), reward, behavior[items], target[items])
        found = estimate(as_pages(steps, np.zeros(3, dtype=np.int64)), seed=0)
        truth += target[items].prod() * reward.sum()
        for name in values:
            values[name] += behavior[items].prod() * found[name].value
    right = list(BY_MODEL).index(model)
    for place, name in enumerate(BY_MODEL.values()):
        assert (abs(values[name] - truth) < 1e-12) == (place >= right), name


def test_steps_of_a_page_lie_anywhere_and_keep_their_order() -> None:
    steps = replace(rows(6), user=np.array([5, 7, 5, 7, 5, 7]))
    pages = as_pages(steps, np.array([30, 10, 30, 10, 30, 20]))
    np.testing.assert_array_equal(pages.session, [0, 0, 1, 2, 2, 2])
    np.testing.assert_array_equal(pages.reward, steps.reward[[1, 3, 5, 0, 2, 4]])
    np.testing.assert_array_equal(pages.user, [7, 7, 5])
    assert pages.model is not None
    assert steps.model is not None
    np.testing.assert_array_equal(pages.model.q, steps.model.q[[1, 3, 5, 0, 2, 4]])


def test_the_cascade_follows_the_positions() -> None:
    steps, page = rows(6), np.array([0, 1, 0, 1, 0, 1])
    pages = as_pages(steps, page, np.array([2, 0, 0, 1, 1, 2]))
    np.testing.assert_array_equal(pages.reward, steps.reward[[2, 4, 0, 1, 3, 5]])


def test_rows_of_one_user_within_ten_milliseconds_are_a_page() -> None:
    user = np.array([3, 8, 3, 3, 8, 3])
    time = np.array([1000, 1003, 1009, 1018, 1014, 1029])
    np.testing.assert_array_equal(number_pages(user, time), [0, 2, 0, 0, 3, 1])


def test_normalised_weights_ignore_the_scale_of_a_position() -> None:
    page, position = np.repeat(np.arange(200), 3), np.tile(np.arange(3), 200)
    pages = as_pages(rows(600), page)
    scaled = replace(pages, propensity=pages.propensity * np.array([1, 0.5, 0.1])[position])
    one, other = estimate(pages, 0), estimate(scaled, 0)
    assert other["SNIIPS"].value == pytest.approx(one["SNIIPS"].value)
    assert other["IIPS"].value != pytest.approx(one["IIPS"].value)
    ratios = pages.target / pages.propensity
    expected = sum(
        (ratios * pages.reward)[position == t].sum() / ratios[position == t].sum() for t in range(3)
    )
    assert one["SNIIPS"].value == pytest.approx(expected)


def test_influences_of_uneven_pages_are_derivatives() -> None:
    lengths = np.array([3, 1, 2, 3, 2, 1, 3])
    page = np.repeat(np.arange(7 * 2000), np.tile(lengths, 2000))
    few = rows(lengths.sum())
    many = LoggedSteps(
        np.arange(len(page)),
        np.tile(few.reward, 2000),
        np.tile(few.propensity, 2000),
        np.tile(few.target, 2000),
    )
    pages = as_pages(many, page)
    above = session_terms(pages)["SNIIPS"].above
    value, kept = above.mean(), np.arange(len(above)) > 0
    without = session_terms(pages.select(kept))["SNIIPS"].above.mean()
    assert (value - without) * kept.sum() == pytest.approx(above[0] - value, rel=0.01, abs=1e-3)


def test_pages_have_a_verdict_and_no_fqe() -> None:
    found = estimate(as_pages(rows(300), np.arange(300) // 3), 0)
    assert {"DM", "DR", "IIPS"} <= set(found)
    assert "FQE" not in found  # its Q is of one position
    assert conclude(as_pages(rows(300), np.arange(300) // 3), 0).estimator == "DR"


def test_sessions_of_several_steps_are_no_positions() -> None:
    with pytest.raises(InputError, match=r"only 2 sessions for 4 steps: .* one session a row"):
        as_pages(random_steps([2, 2]), np.zeros(4, dtype=np.int64))
    with pytest.raises(InputError, match=r"page has shape \(2,\)"):
        as_pages(rows(3), np.zeros(2, dtype=np.int64))
