"""Records of runs: every entry that is read has its type."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ucfrec.errors import InputError
from ucfrec.runs.record import require_run_record

RECORD: dict[str, Any] = {
    "config": {"policy_name": "bc", "seed": 0, "train": {"steps": 3}},
    "sizes": {"state": 4, "action": 2, "items": 0},
    "fingerprint": "f1",
    "observation_size": 4,
    "return_quantiles": {"0.5": 1.0, "1.0": 2},
    "return_to_go": {"definition": "session", "discount": 0.9, "horizon": 1},
    "reward": "reward",
    "train_episodes": 3,
    "train_steps": 9,
    "session_by": None,
}
PATH = Path("run") / "run.json"
anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=5,
)


def test_a_record_passes() -> None:
    require_run_record(PATH, RECORD)


@pytest.mark.parametrize("name", [name for name in RECORD if name != "session_by"])
def test_a_missing_entry_is_named(name: str) -> None:
    record = {key: value for key, value in RECORD.items() if key != name}
    with pytest.raises(InputError, match=rf"run\.json is damaged: its {name} is None"):
        require_run_record(PATH, record)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("config", {"policy_name": "bc"}),
        ("config", {"policy_name": "no such", "seed": 0}),
        ("config", {"policy_name": 3, "seed": 0}),
        ("config", {"policy_name": ["bc"], "seed": 0}),
        ("config", {"policy_name": "bc", "seed": "x"}),
        ("config", {"policy_name": "bc", "seed": 0, "train": {"steps": "many"}}),
        ("sizes", {"state": -1, "action": 2, "items": 0}),
        ("sizes", {"state": 10**30, "action": 2, "items": 0}),
        ("return_quantiles", {"half": 1.0}),
        ("return_quantiles", {}),
        ("return_quantiles", {"0.5": float("nan")}),
        ("session_gap_ms", "soon"),
        ("screening", {"how": "drop"}),
        ("screening", {"dimensions": [{"dimension": 0, "causes": "no"}]}),
        ("mean_return", 10**400),
        ("policy", []),
    ],
)
def test_an_entry_of_another_type_is_named(name: str, value: object) -> None:
    with pytest.raises(InputError, match=r"run\.json") as caught:
        require_run_record(PATH, {**RECORD, name: value})
    assert str(caught.value).isprintable()


@given(name=st.sampled_from(sorted(RECORD)), value=anything)
def test_no_value_gives_another_error(name: str, value: object) -> None:
    with suppress(InputError):
        require_run_record(PATH, {**RECORD, name: value})
