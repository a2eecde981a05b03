"""Ids of feature tables: those of the log in another type are found, others are refused."""

import warnings
from pathlib import Path

import pandas as pd
import pytest

from ucfrec.errors import InputError, InputNote
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare, validate

START = 1_700_000_000_000
OPTIONS = PrepareOptions(split=(1.0, 0.0, 0.0), embedding_size=2)


def mapping_of(folder: Path, ids: list[object], keys: list[object]) -> LogMapping:
    """Write a log of items `ids` and features of items `keys`."""
    log = pd.DataFrame({"item_id": ids, "user_id": [n % 2 for n in range(len(ids))]})
    log = log.assign(timestamp=START + log.index, reward=log.index)
    log.to_parquet(folder / "log.parquet")
    features = pd.DataFrame({"key": keys, "price": range(len(keys))})
    features.to_parquet(folder / "features.parquet")
    table = FeatureTable((folder / "features.parquet",), "key", ("price",))
    return LogMapping(item_features=(table,))


@pytest.mark.parametrize(
    ("ids", "keys"),
    [
        ([1, 2, 12], ["1", "2", "12"]),
        ([1, 2, 12], [1.0, 2.0, 12.0]),
        (["1", "2", "12"], [1, 2, 12]),
        (["1", "2", "12"], [1.0, 2.0, 12.0]),
    ],
)
def test_ids_of_another_type_are_found(
    tmp_path: Path, ids: list[object], keys: list[object]
) -> None:
    mapping = mapping_of(tmp_path, ids, keys)
    prepare([tmp_path / "log.parquet"], mapping, tmp_path / "store", OPTIONS)
    assert len(pd.read_parquet(tmp_path / "store" / "items.parquet")) == 3


def test_a_key_without_a_character_is_no_item(tmp_path: Path) -> None:
    mapping = mapping_of(tmp_path, ["a", "b", "c"], ["a", "b", "", "c"])
    prepare([tmp_path / "log.parquet"], mapping, tmp_path / "store", OPTIONS)
    items = pd.read_parquet(tmp_path / "store" / "items.parquet")
    assert items.item_id.tolist() == ["a", "b", "c"]


def test_the_index_of_a_frame_is_no_feature(tmp_path: Path) -> None:
    mapping_of(tmp_path, [1, 2, 12], [1, 2, 12])
    features = pd.read_parquet(tmp_path / "features.parquet")
    features.set_index(pd.Index([7, 5, 9])).to_parquet(tmp_path / "indexed.parquet")
    states = []
    for name in ("features", "indexed"):
        table = FeatureTable((tmp_path / f"{name}.parquet",), "key")
        given = LogMapping(item_features=(table,))
        prepare([tmp_path / "log.parquet"], given, tmp_path / name, OPTIONS)
        states.append((tmp_path / name / "item_states.safetensors").read_bytes())
    assert states[0] == states[1]


@pytest.mark.parametrize(
    ("ids", "keys", "message"),
    [
        ([1, 2, 12], [21, 22, 23, 24], r"item_id of the log, which are 1, 2, 12, …, and key is 21"),
        ([1, 2, 12], ["i1", "i2", "i12"], r"key is never such an id; let the key be"),
        ([1, 2, 12], [1.4, 2.4, 11.6], r"key is never such an id"),
        ([2**53, 2**53 + 2], [2.0**53, 2.0**53 + 2], r"key is never such an id"),
        (["a1", "a2", "a12"], [1, 2, 12], r"which are 'a1', 'a12', 'a2', …, and key is '1', '12'"),
        (["1", "2", "12"], ["01", "02", "012"], r"key is '01', '012', '02', …"),
    ],
)
def test_features_of_nothing_in_the_log_are_refused(
    tmp_path: Path, ids: list[object], keys: list[object], message: str
) -> None:
    mapping = mapping_of(tmp_path, ids, keys)
    with pytest.raises(InputError, match=rf"features\.parquet: no row belongs to .*{message}"):
        validate([tmp_path / "log.parquet"], mapping, OPTIONS)


def test_many_items_without_a_row_are_noted(tmp_path: Path) -> None:
    mapping = mapping_of(tmp_path, [1, 2, 3, 4], [1, 2])
    with pytest.warns(
        InputNote, match=r"features\.parquet: 2 of 4 item_ids of the log have no row"
    ):
        validate([tmp_path / "log.parquet"], mapping, OPTIONS)
    mapping = mapping_of(tmp_path, [*range(10)], [*range(9)])
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputNote)
        validate([tmp_path / "log.parquet"], mapping, OPTIONS)


@pytest.mark.parametrize(
    ("name", "key", "kind"),
    [("items.csv", "item_id", "item_features"), ("users.parquet", "user_id", "user_features")],
)
def test_features_beside_a_log_that_is_named_alone_are_noted(
    tmp_path: Path, name: str, key: str, kind: str
) -> None:
    log = pd.DataFrame({"user_id": [1, 1, 2, 2], "item_id": [1, 2, 1, 2], "reward": [0, 1, 0, 1.0]})
    log.assign(timestamp=START + log.index).to_parquet(tmp_path / "log.parquet")
    table, file = pd.DataFrame({key: [1, 2], "age": [3, 4]}), tmp_path / name
    if name.endswith("csv"):
        table.to_csv(file, index=False)
    else:
        table.to_parquet(file)
    logs = [tmp_path / "log.parquet"]
    with pytest.warns(InputNote, match=f"{name} lies beside the log and is not read"):
        validate(logs, LogMapping(), OPTIONS)
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputNote)
        validate(logs, LogMapping(**{kind: (FeatureTable((file,), key, ("age",)),)}), OPTIONS)
