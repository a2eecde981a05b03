"""Result rows: read as they were written, and nothing else is read."""

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.result_rows import result_row
from ucfrec.errors import InputError
from ucfrec.results.row import ResultRow, RowKey, row_from_json

WHOLE = result_row(
    2.5,
    metrics={"length": 3.0},
    log_seed=1,
    evaluation_seed=1_000_000,
    conditions={"budget": "small", "episodes": 5, "rate": 0.5, "on": True, "none": None},
    config_hash="ab",
    data_fingerprint="ef",
    interval=(1.0, 3.0),
    target_return=4.0,
    rule="target return: the largest",
    details={"validation": {"4": [1, {"a": None}]}},
    wall_time_s=0.5,
    peak_memory_mib=300.0,
    command="ucfrec benchmark",
    commit="12",
    versions={"python": "3.11"},
)


@pytest.mark.parametrize("row", [WHOLE, result_row()], ids=["every field", "few fields"])
def test_a_row_is_read_as_it_was_written(row: ResultRow) -> None:
    written = json.loads(json.dumps(row.to_json(), allow_nan=False))
    assert row_from_json(written, "here") == row


def test_what_a_row_does_not_say_is_not_written() -> None:
    assert result_row().to_json().keys() == {
        *("suite", "table", "task", "method", "policy", "environment", "checkpoint"),
        *("training_seed", "metric", "metrics"),
    }


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"suite": 1}, "'suite'"),
        ({"training_seed": True}, "'training_seed'"),
        ({"training_seed": 10**30}, "'training_seed'"),
        ({"evaluation_seed": 1.5}, "'evaluation_seed'"),
        ({"metrics": {"R_cum": float("nan")}}, "'metrics.R_cum'"),
        ({"metrics": {"R_cum": 10**400}}, "'metrics.R_cum'"),
        ({"metrics": {"R_cum": "3"}}, "'metrics.R_cum'"),
        ({"metrics": {"other": 3}}, "its metrics lack 'R_cum'"),
        ({"metrics": [3]}, "'metrics'"),
        ({"interval": [1, 2, 3]}, "'interval"),
        ({"conditions": {"a": [1]}}, "'conditions.a"),
        ({"details": {"a": float("inf")}}, "every number should be finite"),
        ({"wall_time_s": "1"}, "'wall_time_s'"),
        ({"versions": {"numpy": 2}}, "'versions.numpy'"),
        ({"seed": 3}, "'seed': Unexpected"),
    ],
)
def test_what_is_of_another_kind_is_refused(change: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=r"x\.jsonl, line 3 is not a result row") as refused:
        row_from_json(result_row().to_json() | change, "x.jsonl, line 3")
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["suite", "table", "task", "method", "policy", "metric"])
def test_a_missing_field_is_named(name: str) -> None:
    written = result_row().to_json()
    del written[name]
    with pytest.raises(InputError, match=f"'{name}'"):
        row_from_json(written, "here")


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=4,
)


@settings(max_examples=40)
@given(name=st.sampled_from([*WHOLE.to_json(), "other"]), value=_JSON)
def test_whatever_stands_in_a_field_it_is_a_row_or_refused(name: str, value: Any) -> None:
    written = json.loads(json.dumps(WHOLE.to_json() | {name: value}))
    try:
        row = row_from_json(written, "here")
    except InputError:
        return
    assert row_from_json(json.loads(json.dumps(row.to_json(), allow_nan=False)), "again") == row


@settings(max_examples=40)
@given(value=_JSON)
def test_whatever_is_no_row_is_refused(value: Any) -> None:
    with pytest.raises(InputError, match="here is not a result row"):
        row_from_json(value, "here")


def test_a_key_covers_its_rows_and_no_others() -> None:
    names = RowKey.__dataclass_fields__
    key = RowKey(**{name: getattr(WHOLE, name) for name in names})
    assert key.covers(WHOLE)
    more = ResultRow(**vars(WHOLE) | {"conditions": {**WHOLE.conditions, "distractor": 0.0}})
    assert key.covers(more)
    for name in names:
        value: Any = {"budget": "full"} if name == "conditions" else "9"
        value = 9 if name.endswith("seed") else value
        assert not key.covers(ResultRow(**vars(WHOLE) | {name: value})), name
    fewer = {name: value for name, value in WHOLE.conditions.items() if name != "none"}
    assert not key.covers(ResultRow(**vars(WHOLE) | {"conditions": fewer}))


def test_a_line_has_every_number_under_its_name() -> None:
    line = WHOLE.as_line()
    assert (line["R_cum"], line["R_cum_low"], line["R_cum_high"]) == (2.5, 1.0, 3.0)
    assert (line["length"], line["budget"], line["training_seed"]) == (3.0, "small", 0)
