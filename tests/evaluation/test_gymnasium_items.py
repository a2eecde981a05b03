"""Item features of Gymnasium environments, from files and attributes."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.support.gymnasium_environments import ITEMS
from ucfrec.errors import InputError
from ucfrec.evaluation.environment import Environment
from ucfrec.evaluation.gymnasium_items import item_table

ID = "tests.support.gymnasium_environments:ucfrec-test/Discrete-v0"


@pytest.fixture
def env() -> gymnasium.Env[Any, Any]:
    return gymnasium.make(ID)


def test_an_attribute_is_found_through_wrappers(env: gymnasium.Env[Any, Any]) -> None:
    expected = {"item_id": [0, 1, 2, 3], "features": [[0, 1], [2, 3], [4, 5], [6, 7]]}
    for source in ("vectors", "unwrapped.vectors", "unwrapped.vectors.T.T"):
        assert item_table(source, env, ITEMS).to_pydict() == expected


def test_arrays_are_read_from_files(env: gymnasium.Env[Any, Any], tmp_path: Path) -> None:
    path = tmp_path / "items.npy"
    np.save(path, np.array([3, 1, 4, 1]))
    assert item_table(str(path), env, ITEMS)["features"].to_pylist() == [3, 1, 4, 1]
    np.save(path, np.array([[1, 0, 1], [0, 0, 0], [0, 1, 0], [1, 1, 1]], dtype=np.bool_))
    tags = item_table(str(path), env, ITEMS)["tags"]
    assert tags.to_pylist() == [[0, 2], [], [1], [0, 1, 2]]
    assert pa.types.is_integer(tags.type.value_type)


def test_rows_of_a_parquet_file_are_put_in_order(
    env: gymnasium.Env[Any, Any], tmp_path: Path
) -> None:
    path = tmp_path / "items.parquet"
    pq.write_table(pa.table({"kind": ["c", "a", "d", "b"], "item_id": [2, 0, 3, 1]}), path)
    table = item_table(str(path), env, ITEMS)
    assert table.to_pydict() == {"kind": ["a", "b", "c", "d"], "item_id": [0, 1, 2, 3]}


def test_unusable_features_are_refused(env: gymnasium.Env[Any, Any], tmp_path: Path) -> None:
    def refused(source: str | Path, said: str) -> None:
        with pytest.raises(InputError, match=said):
            item_table(str(source), env, ITEMS)

    refused("absent", "absent is neither a .npy or .parquet file nor an attribute")
    refused("vectors.absent", "neither a .npy or .parquet file nor an attribute")
    refused("played", r"an array of float64 of shape \(0,\); give numbers with one row for each")
    refused(tmp_path / "absent.npy", "cannot be read")
    refused(tmp_path / "absent.parquet", "cannot be read")
    path = tmp_path / "x.npy"
    np.save(path, np.array([{}, 1, 2, 3], dtype=object))
    refused(path, "cannot be read")
    np.save(path, np.array([0.0, np.nan, 1, 2]))
    refused(path, "not finite")
    path = tmp_path / "x.parquet"
    pq.write_table(pa.table({"item_id": [0, 1, 1, 3]}), path)
    refused(path, "has 4 rows; give each item_id from 0 to 3 once")
    pq.write_table(pa.table({"item": [0, 1, 2, 3]}), path)
    refused(path, "has no whole numbers as item_id")


def test_environments_of_vectors_have_no_items() -> None:
    name = ID.replace("Discrete", "Box")
    environment = Environment(f"gymnasium:{name}", observe=("secret",), item_features="vectors")
    with pytest.raises(InputError, match="takes vectors, not items"):
        environment.simulator().make(1, None)
