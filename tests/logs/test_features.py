"""Features: ids of another type are found, others refused; which items share a tag."""

import warnings
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.support.logs import START, random_log, store_of
from ucfrec.episodes.states import DISTINCT_TAGS, TAGS_PER_ITEM, ItemStates
from ucfrec.errors import InputNote
from ucfrec.logs.features import item_tags
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare, validate

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


TEXT, REAL = ["1", "2", "12"], [1.0, 2.0, 12.0]


@pytest.mark.parametrize(
    ("ids", "keys"), [([1, 2, 12], TEXT), ([1, 2, 12], REAL), (TEXT, [1, 2, 12]), (TEXT, REAL)]
)
def test_ids_of_another_type_are_found(tmp_path: Path, ids: list[Any], keys: list[Any]) -> None:
    mapping = mapping_of(tmp_path, ids, keys)
    prepare([tmp_path / "log.parquet"], mapping, tmp_path / "store", OPTIONS)
    assert len(pd.read_parquet(tmp_path / "store" / "items.parquet")) == 3


def test_a_key_without_a_character_is_no_item(tmp_path: Path) -> None:
    mapping = mapping_of(tmp_path, ["a", "b", "c"], ["a", "b", "", "c"])
    prepare([tmp_path / "log.parquet"], mapping, tmp_path / "store", OPTIONS)
    items = pd.read_parquet(tmp_path / "store" / "items.parquet")
    assert items.item_id.tolist() == ["a", "b", "c"]


def test_many_items_without_a_row_are_noted(tmp_path: Path) -> None:
    mapping = mapping_of(tmp_path, [1, 2, 3, 4], [1, 2])
    told = r"features\.parquet: 2 of 4 item_ids of the log have no row"
    with pytest.warns(InputNote, match=told):
        validate([tmp_path / "log.parquet"], mapping, OPTIONS)
    mapping = mapping_of(tmp_path, [*range(10)], [*range(9)])
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputNote)
        validate([tmp_path / "log.parquet"], mapping, OPTIONS)


Lists = list[list[str | None] | None]


def tags_of(*columns: Lists, separate: bool = False) -> np.ndarray:
    """Tags of items 100, 101, …, whose numbers run the other way; a table a column or one."""
    count = len(columns[0])
    connection = duckdb.connect()
    connection.execute(
        f"CREATE TABLE items AS SELECT {count} - 1 - i AS number, 100 + i AS item_id, "
        f"1 AS train_count FROM range({count}) t(i)"
    )
    groups = [[column] for column in columns] if separate else [list(columns)]
    for name, group in enumerate(groups):
        declared = ", ".join(f"f{n} VARCHAR[]" for n in range(len(group)))
        connection.execute(f"CREATE TABLE t{name} (id BIGINT, {declared})")
        for item in range(count):
            marks = ", ".join("?" * (len(group) + 1))
            row = [100 + item, *(column[item] for column in group)]
            connection.execute(f"INSERT INTO t{name} VALUES ({marks})", row)
    names = [f"t{name}" for name in range(len(groups))]
    return item_tags(connection, names, count)[::-1]


def shared(tags: np.ndarray, one: int, other: int) -> int:
    return len((set(tags[one].tolist()) & set(tags[other].tolist())) - {-1})


words = st.lists(st.sampled_from(["a", "b", "c", "it's", "", None]), max_size=5)
catalogues = st.lists(st.one_of(st.none(), words), min_size=1, max_size=7)


@given(catalogues)
def test_items_share_as_many_tags_as_their_lists_share_words(lists: Lists) -> None:
    tags = tags_of(lists)
    sets = [{word for word in words or [] if word is not None} for words in lists]
    for one, first in enumerate(sets):
        row = tags[one].tolist()
        kept = [tag for tag in row if tag >= 0]
        assert len(set(kept)) == len(kept), "no tag twice"
        assert row == kept + [-1] * (len(row) - len(kept)), "padding comes last"
        for other, second in enumerate(sets):
            assert shared(tags, one, other) == len(first & second)
    # Numbers have no gaps: a matrix of items and tags has no empty column.
    assert set(tags[tags >= 0].tolist()) == set(range(int(tags.max(initial=-1)) + 1))


@pytest.mark.parametrize("separate", [False, True])
def test_columns_of_lists_are_told_apart(separate: bool) -> None:
    kind: Lists = [["x"], ["y"], None, None]
    mood: Lists = [["y", "z"], ["z"], ["z"], []]
    tags = tags_of(kind, mood, separate=separate)
    assert [shared(tags, 0, other) for other in range(4)] == [3, 1, 1, 0]
    # y of one column is not y of the other.
    assert shared(tags, 1, 0) == 1
    assert shared(tags, 3, 2) == 0


def test_at_most_sixteen_tags_are_kept_the_most_frequent() -> None:
    many = [f"tag {n:02}" for n in range(TAGS_PER_ITEM + 9)]
    lists: Lists = [[*many], many[9:], [*many[9:], "own"], ["own"]]
    tags = tags_of(lists)
    assert tags.shape == (4, TAGS_PER_ITEM)
    assert (tags[:3] >= 0).all()
    # All sixteen of item 0 are among those that the others have too.
    assert shared(tags, 0, 1) == TAGS_PER_ITEM
    assert (tags[3] >= 0).sum() == 1
    # At most a thousand of a catalogue.
    lists = [[f"tag {n}" for n in range(i, i + 8)] for i in range(0, 16_000, 8)]
    tags = tags_of([*lists, None])
    assert int(tags.max()) == DISTINCT_TAGS - 1
    assert len(np.unique(tags[tags >= 0])) == DISTINCT_TAGS


def test_a_store_keeps_the_tags_of_its_catalogue(tmp_path: Path) -> None:
    lists = [["a"], ["a", "b"], ["b"], [], ["c"], ["c", "a"]]
    frame = pd.DataFrame({"item_id": range(6), "tags": lists})
    frame.to_parquet(tmp_path / "items.parquet")
    table = FeatureTable((tmp_path / "items.parquet",), "item_id")
    given = LogMapping(item_features=(table,))
    states = store_of(random_log(items=6), tmp_path, given, embedding_size=4).item_states
    assert states.tags.shape == (6, 2)
    assert [shared(states.tags.numpy(), 1, other) for other in range(6)] == [1, 2, 1, 0, 0, 1]
    states.save(tmp_path / "states.safetensors")
    assert torch.equal(ItemStates.load(tmp_path / "states.safetensors").tags, states.tags)
