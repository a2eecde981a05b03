"""Logged steps from whatever arrays callers have: read by value, or refused in one clear line."""

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.support.logged_steps import random_steps
from ucfrec.errors import InputError
from ucfrec.off_policy import LoggedSteps, Modelled, conclude, diagnose, estimate, merge_lists
from ucfrec.off_policy.logged_steps import ItemGroups

LENGTHS = [2, 1, 3] * 20
STEPS = random_steps(LENGTHS)
USER = np.arange(60) // 2
ONES = np.ones(120)
NUMBERS = {
    "reward": np.round(STEPS.reward * 4),
    "propensity": np.exp2(np.round(np.log2(STEPS.propensity))),
    "target": np.exp2(np.round(np.log2(np.maximum(STEPS.target, 0.1)))),
}
"""Values that float16 holds exactly."""
KINDS: dict[str, Callable[[Any], Any]] = {
    "list": lambda values: values.tolist(),
    "shuffled series": lambda values: pd.Series(values).set_axis(range(len(values), 0, -1)),
    "nullable series": lambda values: pd.Series(values).convert_dtypes(),
    "objects": lambda values: values.astype(object),
    "float16": lambda values: values.astype(np.float16),
}


def steps_of(kind: Callable[[Any], Any] = np.asarray, **change: Any) -> LoggedSteps:
    values = {"session": STEPS.session, "user": USER, **NUMBERS}
    return LoggedSteps(**{name: kind(column) for name, column in values.items()} | change)


@pytest.mark.parametrize("kind", KINDS)
def test_values_count_whatever_holds_them(kind: str) -> None:
    model = np.round(np.random.default_rng(1).normal(size=(4, len(STEPS.reward))) * 4)
    expected = replace(steps_of(), model=Modelled(*model))
    steps = replace(steps_of(KINDS[kind]), model=Modelled(*map(KINDS[kind], model)))
    assert estimate(steps, 0) == estimate(expected, 0)
    assert str(conclude(steps, 0)) == str(conclude(expected, 0))
    assert diagnose(steps) == diagnose(expected)


@pytest.mark.parametrize("missing", ["masked", "None", "NaN", "nullable"])
def test_missing_propensities_are_unknown(missing: str) -> None:
    values, unknown = NUMBERS["propensity"], np.arange(len(STEPS.reward)) % 40 == 3
    columns: dict[str, Any] = {
        "masked": np.ma.array(values, mask=unknown),
        "None": np.where(unknown, None, values.astype(object)),
        "NaN": np.where(unknown, np.nan, values),
        "nullable": pd.Series(values).convert_dtypes().mask(unknown),
    }
    propensity = steps_of(propensity=columns[missing]).propensity
    assert type(propensity) is np.ndarray
    np.testing.assert_array_equal(propensity, np.where(unknown, np.nan, values))


def test_rounding_errors_above_one_count_as_one() -> None:
    above = ONES.copy()
    above[4], above[5] = 1.0000000002, 1 + 9e-7
    names = ("propensity", "target")
    steps = steps_of(**dict.fromkeys(names, above))
    for name in names:
        np.testing.assert_array_equal(getattr(steps, name), ONES)
    assert above[4] > 1
    dense = steps_of(propensity=above, target=above, densities=True)
    np.testing.assert_array_equal(dense.target, above)


@pytest.mark.parametrize(
    "ids",
    [
        np.array([f"u{user:02}" for user in USER]),
        pd.Series([f"u{user:02}" for user in USER], dtype="category"),
        pd.Series(USER, dtype="Int64"),
        USER.astype(float),
    ],
)
def test_users_of_any_type_are_the_same_users(ids: Any) -> None:
    assert estimate(steps_of(user=ids), 0) == estimate(steps_of(), 0)


def few_others(values: Any, other: Any) -> Any:
    """The values, of which two others."""
    return np.where(np.arange(len(values)) < 2, other, values)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"reward": 1.0}, r"reward has shape \(\)"),
        ({"propensity": pd.Series(["n/a"] * 120)}, "propensity is no array of numbers"),
        ({"reward": np.ones(119)}, "reward has 119 values for 120 steps"),
        ({"reward": few_others(ONES, np.nan)}, "reward is not finite at 2 of 120 steps"),
        ({"session": STEPS.session + 0.5}, "numbered from 0 in order"),
        ({"session": []}, "there is at least one"),
        ({"user": few_others(USER, np.nan)}, "users are missing, or"),
        ({"user": USER[1:]}, "user has 59 values for 60 sessions"),
        ({"propensity": few_others(ONES, 0)}, "propensities must be above 0 .* 2 of 120 are"),
        ({"propensity": few_others(ONES, 1.5)}, "no density; .* the first is 1.5"),
        ({"target": few_others(ONES, 1.1)}, r"between 0 and 1; 2 of 120 are outside, .* 1\.1$"),
        ({"discount": 0.0}, "above 0 and at most 1"),
        ({"groups": ItemGroups(USER, ONES[:, None])}, "number has 60 values for 120 steps"),
    ],
)
def test_what_cannot_be_read_is_one_clear_error(change: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        steps_of(**change)
    with pytest.raises(InputError, match="modelled q is not finite at 2 of 120"):
        Modelled(ONES, few_others(ONES, np.nan), ONES, ONES)


SLATE = Path(__file__).with_name("fixtures") / "slate.npz"
BY_MODEL = {"independent": "IIPS", "cascade": "PDIS", "whole list": "IPS"}
"""How positions influence each other, and what the Open Bandit Pipeline calls the estimate."""


def estimate_lists(steps: LoggedSteps, positions: str) -> float:
    """PDIS of lists under an assumption."""
    as_assumed = (
        merge_lists(steps) if positions == "whole list" else replace(steps, positions=positions)
    )
    return estimate(as_assumed, seed=0)["PDIS"].value


def test_estimates_agree_with_the_open_bandit_pipeline() -> None:
    with np.load(SLATE) as given:
        order = np.argsort(given["page"], kind="stable")
        page = np.unique(given["page"][order], return_inverse=True)[1]
        place = np.arange(len(page)) - np.searchsorted(page, page)
        columns = (given[name][order] for name in ("reward", "propensity", "target"))
        steps = LoggedSteps(page, *columns, place=place)
        for positions, name in BY_MODEL.items():
            expected = pytest.approx(float(given[name]), rel=1e-9)
            assert estimate_lists(steps, positions) == expected, name


@pytest.mark.parametrize("model", BY_MODEL)
def test_each_estimate_is_right_where_its_model_is(model: str) -> None:
    """Exactly, over every page of three positions and two items; the weaker model errs."""
    behavior, target = np.array([0.7, 0.3]), np.array([0.2, 0.8])
    values = dict.fromkeys(BY_MODEL, 0.0)
    truth = 0.0
    for page in itertools.product((0, 1), repeat=3):
        items = np.array(page)
        seen = {
            "independent": items,
            "cascade": items.cumsum(),
            "whole list": items.sum() * np.arange(1, 4),
        }
        reward = np.asarray(seen[model], dtype=np.float64) ** 2
        chances = behavior[items], target[items]
        steps = LoggedSteps(np.zeros(3, dtype=int), reward, *chances, place=np.arange(3))
        truth += target[items].prod() * reward.sum()
        for positions in values:
            values[positions] += behavior[items].prod() * estimate_lists(steps, positions)
    right = list(BY_MODEL).index(model)
    for place, positions in enumerate(BY_MODEL):
        assert (abs(values[positions] - truth) < 1e-12) == (place >= right), positions
