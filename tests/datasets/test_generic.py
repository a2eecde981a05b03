"""Which files of a folder are the log, and which are features of items and users."""

from pathlib import Path

import pandas as pd
import pytest

from tests.support.logs import random_log
from ucfrec.errors import InputError
from ucfrec.logs.mapping import FeatureTable, LogMapping, read_mapping
from ucfrec.logs.prepare import validate
from ucfrec_datasets import generic

LOG = random_log(40, users=7, items=5)
ITEMS = pd.DataFrame({"item_id": range(5), "price": range(5)})


@pytest.mark.parametrize("given", [".", "*.parquet", "**/*.parquet", "log.parquet items.parquet"])
def test_folders_called_like_tables_are_tables(tmp_path: Path, given: str) -> None:
    parts = [tmp_path / "log.parquet" / f"part-{n}.snappy.parquet" for n in range(2)]
    items = tmp_path / "items.parquet" / "part-0.parquet"
    for file in (*parts, items):
        file.parent.mkdir(exist_ok=True)
        (file.parent / "_SUCCESS").touch()
        (file.parent / f".{file.name}").touch()
    LOG.iloc[:20].to_parquet(parts[0])
    LOG.iloc[20:].to_parquet(parts[1])
    ITEMS.to_parquet(items)
    paths = [tmp_path / path for path in given.split()]
    files, mapping = generic.DATASET.resolve(paths, LogMapping())
    assert files == tuple(parts)
    assert mapping.item_features == (FeatureTable((items,), "item_id"),)
    assert validate(files, mapping)["rows_read"] == 40


def test_feature_tables_of_the_mapping_are_no_log(tmp_path: Path) -> None:
    LOG.to_parquet(tmp_path / "log.parquet")
    ITEMS.to_parquet(tmp_path / "videos.parquet")
    (tmp_path / "m.toml").write_text(
        f'[[item_features]]\nfiles = ["../{tmp_path.name}/videos.parquet"]\nkey = "item_id"\n'
        '[[user_features]]\nfiles = ["log.parquet"]\nkey = "user_id"\nfirst_by = "timestamp"\n'
        'columns = ["item_id"]\n'
    )
    mapping = read_mapping(tmp_path / "m.toml")
    files, resolved = generic.DATASET.resolve([tmp_path], mapping)
    assert files == (tmp_path / "log.parquet",)
    assert resolved == mapping
    assert validate(files, resolved)["rows_read"] == 40


def test_a_log_called_like_features_is_told_of(tmp_path: Path) -> None:
    LOG.to_parquet(tmp_path / "users.parquet")
    with pytest.raises(InputError, match=r"users.parquet: every file is called .* rename it"):
        generic.DATASET.resolve([tmp_path], LogMapping())
