"""A store as a frame has the rows of the log, and a notebook shows it."""

from pathlib import Path

import matplotlib as mpl
import pandas as pd

from tests.recommending.test_recommend import random_log
from tests.support.logs import store_of
from ucfrec import EpisodeStore
from ucfrec.logs import LogMapping, prepare


def test_the_frame_has_the_rows_of_the_log(tmp_path: Path) -> None:
    log = random_log(rows=300).assign(propensity=0.25)
    log["user_id"] = "u" + log.user_id.astype(str)
    store = store_of(log, tmp_path, session_by="gap", gap_minutes=60)
    frame = store.to_frame()
    keys = ["user_id", "timestamp", "item_id", "reward", "propensity"]
    found = frame[keys].sort_values(keys, ignore_index=True)
    expected = log[keys].sort_values(keys, ignore_index=True)
    pd.testing.assert_frame_equal(found, expected, check_dtype=False)
    assert frame.session_id.nunique() == len(store)
    assert frame.groupby("session_id").timestamp.apply(lambda t: t.is_monotonic_increasing).all()
    test = store.split("test").to_frame()
    assert set(test.split) == {"test"}
    assert len(test) == (frame.split == "test").sum()


def test_a_notebook_shows_the_store(tmp_path: Path) -> None:
    mpl.use("Agg")
    random_log().to_parquet(tmp_path / "log.parquet")
    prepare([tmp_path / "log.parquet"], LogMapping(), tmp_path / "store")
    store = EpisodeStore.open(tmp_path / "store")
    html = store._repr_html_()
    assert all(f"<td>{name}</td>" in html for name in ("all", "train", "validation", "test"))
    axes = store.plot()
    assert sum(bar.get_height() for bar in axes.patches) == len(store)
