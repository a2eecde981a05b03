"""Logged steps from whatever arrays callers have: read by value, or refused with a count."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.support.logged_steps import random_steps
from ucfrec.errors import InputError
from ucfrec.off_policy.diagnostics import diagnose
from ucfrec.off_policy.estimators import estimate
from ucfrec.off_policy.logged_steps import ItemGroups, LoggedSteps, Modelled
from ucfrec.off_policy.verdict import conclude

LENGTHS = [2, 1, 3] * 20
STEPS = random_steps(LENGTHS)
USER = np.arange(60) // 2
NUMBERS = {
    "reward": np.round(STEPS.reward * 4),
    "propensity": np.exp2(np.round(np.log2(STEPS.propensity))),
    "target": np.exp2(np.round(np.log2(np.maximum(STEPS.target, 0.1)))),
}
"""Values that float16 holds exactly."""
KINDS: dict[str, Callable[[Any], Any]] = {
    "list": lambda values: values.tolist(),
    "tuple": lambda values: tuple(values.tolist()),
    "series": pd.Series,
    "shuffled series": lambda values: pd.Series(values).set_axis(range(len(values), 0, -1)),
    "nullable series": lambda values: pd.Series(values).convert_dtypes(),
    "objects": lambda values: values.astype(object),
    "float16": lambda values: values.astype(np.float16),
    "float32": lambda values: values.astype(np.float32),
    "masked without a mask": np.ma.array,
}


def steps_of(kind: Callable[[Any], Any] = np.asarray, **change: Any) -> LoggedSteps:
    given = {"session": STEPS.session, "user": USER, **NUMBERS}
    return LoggedSteps(**{name: kind(values) for name, values in given.items()} | change)


@pytest.mark.parametrize("kind", KINDS)
def test_values_count_whatever_holds_them(kind: str) -> None:
    expected, found = steps_of(), steps_of(KINDS[kind])
    assert estimate(found, 0) == estimate(expected, 0)
    assert str(conclude(found, 0)) == str(conclude(expected, 0))
    assert diagnose(found) == diagnose(expected)


@pytest.mark.parametrize("kind", KINDS)
def test_what_models_say_counts_whatever_holds_it(kind: str) -> None:
    values = np.round(np.random.default_rng(1).normal(size=(4, len(STEPS.reward))) * 4)
    expected = replace(steps_of(), model=Modelled(*values))
    found = replace(steps_of(), model=Modelled(*map(KINDS[kind], values)))
    assert estimate(found, 0) == estimate(expected, 0)


@pytest.mark.parametrize("missing", ["masked", "None", "NaN", "nullable"])
@pytest.mark.parametrize("name", ["propensity", "cluster_propensity"])
def test_missing_propensities_are_unknown(name: str, missing: str) -> None:
    values, lacks = NUMBERS["propensity"], np.arange(len(STEPS.reward)) % 40 == 3
    given: dict[str, Any] = {
        "masked": np.ma.array(values, mask=lacks),
        "None": np.where(lacks, None, values.astype(object)),
        "NaN": np.where(lacks, np.nan, values),
        "nullable": pd.Series(values).convert_dtypes().mask(lacks),
    }
    more = {"cluster_target": NUMBERS["target"]} if name == "cluster_propensity" else {}
    found = getattr(steps_of(**{name: given[missing]}, **more), name)
    assert found.dtype == np.float64
    assert not np.ma.isMaskedArray(found)
    np.testing.assert_array_equal(found, np.where(lacks, np.nan, values))


def test_arrays_of_the_right_type_are_not_copied() -> None:
    session, propensity, target = STEPS.session, STEPS.propensity, STEPS.target
    found = LoggedSteps(session, STEPS.reward, propensity, target, STEPS.model, USER)
    for name in ("session", "reward", "propensity", "target", "user"):
        given = USER if name == "user" else getattr(STEPS, name)
        assert np.shares_memory(getattr(found, name), given), name


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
def test_products_of_narrow_floats_stay_finite(kind: type[np.floating[Any]]) -> None:
    propensity = np.full(3000, 2.0**-9, dtype=kind)
    steps = LoggedSteps(np.repeat([0, 1], 1500), np.ones(3000), propensity, np.ones(3000, kind))
    assert np.isfinite(steps.weights).all()
    for name, one in estimate(steps, 0).items():
        assert np.isfinite(one.value), name


def test_rounding_errors_above_one_count_as_one() -> None:
    n, given = len(STEPS.reward), np.ones(len(STEPS.reward))
    given[4], given[5] = 1.0000000002, 1 + 9e-7
    found = steps_of(propensity=given, target=given, cluster_propensity=given, cluster_target=given)
    for name in ("propensity", "target", "cluster_propensity", "cluster_target"):
        np.testing.assert_array_equal(getattr(found, name), np.ones(n))
    assert given[4] > 1
    dense = steps_of(propensity=given, target=given, densities=True)
    np.testing.assert_array_equal(dense.target, given)


@pytest.mark.parametrize(
    "ids",
    [
        np.array([f"u{user:02}" for user in USER]),
        pd.Series([f"u{user:02}" for user in USER]),
        pd.Series([f"u{user:02}" for user in USER], dtype="category"),
        pd.Series(USER, dtype="Int64"),
        USER.astype(float),
        pd.to_datetime(pd.Series(USER), unit="D"),
    ],
)
def test_users_of_any_type_are_the_same_users(ids: Any) -> None:
    assert estimate(steps_of(user=ids), 0) == estimate(steps_of(), 0)


def lacking(values: Any, masked: bool) -> Any:
    """The values, of which the first two are missing."""
    few = np.arange(len(values)) < 2
    return np.ma.array(values, mask=few) if masked else np.where(few, None, values.astype(object))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(
    "name", ["session", "reward", "target", "cluster_target", "user", "by_step", "model", "groups"]
)
def test_what_must_be_there_is_refused_with_a_count(name: str, masked: bool) -> None:
    ones = np.ones(len(STEPS.reward))
    whole: dict[str, Any] = {"cluster_propensity": ones, "cluster_target": ones}
    values = lacking({"session": STEPS.session, "user": USER}.get(name, ones), masked)
    nested = {
        "model": lambda: Modelled(ones, values, ones, ones),
        "groups": lambda: ItemGroups(values, ones[:, None].astype(np.float32)),
    }
    steps_of(**whole)
    with pytest.raises(InputError, match=r"\b2 of (120|60) (places|steps)"):
        steps_of(**whole | {name: nested.get(name, lambda: values)()})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"reward": 1.0}, r"reward has shape \(\); give an array with 1 dimension"),
        ({"session": 0}, r"session has shape \(\)"),
        ({"user": 3}, r"user has shape \(\)"),
        ({"target": pd.DataFrame({"target": NUMBERS["target"]})}, r"shape \(120, 1\)"),
        ({"reward": [[1.0], [1.0, 2.0]]}, "reward is not an array"),
        ({"reward": ["high"] * 120}, "reward has values of type .*; give numbers"),
        ({"propensity": pd.Series(["n/a"] * 120)}, "propensity has values of type"),
        ({"reward": NUMBERS["reward"].astype("M8[s]")}, "reward has values of type datetime64"),
        ({"reward": NUMBERS["reward"] * 1j}, "reward has values of type complex128"),
        ({"session": STEPS.session + 0.5}, "session is not a whole number at 120 of 120 places"),
        ({"session": STEPS.session.astype(np.uint8) - np.uint8(1)}, "numbered from 0 in order"),
        ({"user": pd.Series(["a", 1] * 30)}, "user mixes ids of several types"),
    ],
)
def test_what_cannot_be_read_is_one_clear_error(change: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        steps_of(**change)
