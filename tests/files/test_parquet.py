"""Parquet files that claim too much, or hold something else than ids; tables to write."""

import os
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.evaluation.gymnasium_environment import item_table
from ucfrec.files.parquet import read_ids, require_plausible_rows, write_frames
from ucfrec.logs.join import join_feedback
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.reporting.items import read_features


def test_a_pipe_is_refused_and_not_read(tmp_path: Path) -> None:
    env = gymnasium.make("CartPole-v1")
    readers: dict[str, list[Callable[[Path], object]]] = {
        "items.parquet": [lambda p: read_ids(p, "item_id"), read_features],
        "items.csv": [read_features],
        "items.npy": [lambda p: item_table(str(p), env, 2)],
    }
    for name, calls in readers.items():
        os.mkfifo(tmp_path / name)
        for call in calls:
            with pytest.raises(InputError, match=f"{name} is not a regular file"):
                call(tmp_path / name)


@pytest.mark.parametrize(
    "column", [pa.array([1, None]), pa.array([[1], [2]]), pa.array([b"a", b"b"]), pa.array([0.5])]
)
def test_what_are_no_ids_is_named(tmp_path: Path, column: pa.Array) -> None:
    pq.write_table(pa.table({"item_id": column}), tmp_path / "ids.parquet")
    with pytest.raises(InputError, match=r"ids\.parquet: item_id is .* not ids"):
        read_ids(tmp_path / "ids.parquet", "item_id")


def test_damage_is_named(tmp_path: Path) -> None:
    path = tmp_path / "ids.parquet"
    with pytest.raises(InputError, match="does not exist"):
        read_ids(path, "item_id")
    pq.write_table(pa.table({"item_id": pa.array(range(1000))}), path)
    with pytest.raises(InputError, match="no column 'user_id'"):
        read_ids(path, "user_id")
    content = path.read_bytes()
    for cut in (0, 3, 100, len(content) - 5):
        path.write_bytes(content[:cut])
        with pytest.raises(InputError, match="is damaged") as caught:
            read_ids(path, "item_id")
        assert "\n" not in str(caught.value)


def test_a_small_file_of_very_many_equal_rows_is_refused_at_once(tmp_path: Path) -> None:
    path, rows = tmp_path / "log.parquet", 2_000_000
    columns = {"user_id": 1, "item_id": 2, "timestamp": 1_700_000_000_000, "reward": 1}
    block = pa.table({name: np.full(rows, value) for name, value in columns.items()})
    with pq.ParquetWriter(path, block.schema, compression="zstd") as writer:
        writer.write_table(block, row_group_size=rows)
    assert path.stat().st_size < 100_000
    with pytest.raises(InputError, match=r"claims 2,000,000 rows in [\d,]+ bytes, so nearly all"):
        prepare([path], LogMapping(), tmp_path / "store", PrepareOptions())
    with pytest.raises(InputError, match="so nearly all"):
        read_ids(path, "item_id")
    require_plausible_rows(path, 1_000_000)
    assert [each.name for each in tmp_path.iterdir()] == ["log.parquet"]


# Tables to write.


def test_a_table_is_of_the_kind_that_its_name_says(tmp_path: Path) -> None:
    frames = [pd.DataFrame({"user_id": ["a", "b,"], "score": [0.1, 1e-300]}) for _ in range(2)]
    for name in ("t", "t.parquet", "t.CSV"):
        read = pd.read_csv if name.endswith("CSV") else pd.read_parquet
        assert write_frames(tmp_path / name, frames) == 4
        pd.testing.assert_frame_equal(read(tmp_path / name), pd.concat(frames, ignore_index=True))
    with pytest.raises(InputError, match="CSV has no lists, as in the column tags; name a file"):
        write_frames(tmp_path / "tags.csv", [pd.DataFrame({"tags": [[1, 2]]})])
    assert len([*tmp_path.iterdir()]) == 3


@pytest.mark.parametrize("name", ["next.json", "next.csv.gz"])
def test_tables_of_another_kind_are_refused_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    out, says = str(tmp_path / name), f"{name}: tables are written as Parquet or CSV; name a"
    recommend = ["recommend", "no run", "no log", "--out"]
    for command in (
        [*recommend, out],
        [*recommend, "a.csv", "--exposures", out],
        ["score", "no run", "no log", "--out", out],
    ):
        assert main(command) == 2
        assert says in capsys.readouterr().err
    with pytest.raises(InputError, match=says):
        join_feedback([tmp_path], [tmp_path], tmp_path / name, 1)
