"""What an older run sees of new rows: its own items and users, and others as unknown."""

from pathlib import Path

import numpy as np

from tests.support.later import later_log, later_mapping
from tests.support.served import trained_run
from tests.support.tagged import ITEMS
from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs.append import append_logs
from ucfrec.updating.new_rows import as_known


def test_unknown_items_and_users_have_no_number(tmp_path: Path) -> None:
    trained = trained_run(tmp_path)
    later_log().to_parquet(tmp_path / "later.parquet")
    logs, mapping = [tmp_path / "later.parquet"], later_mapping(tmp_path)
    append_logs(tmp_path / "store", logs, tmp_path / "grown", mapping)
    newest = EpisodeStore.open(tmp_path / "grown").split("test")
    known = as_known(newest, trained)
    items = newest.step_values("item", *newest.all_steps())
    expected = np.where(items < ITEMS, items, -1)
    assert (expected < 0).any()
    np.testing.assert_array_equal(known.step_values("item", *known.all_steps()), expected)
    np.testing.assert_array_equal(known.lengths, newest.lengths)
    assert known.state_size == trained.record.sizes["state"]
    assert known.episode_values("user").max() < len(trained.user_ids)
