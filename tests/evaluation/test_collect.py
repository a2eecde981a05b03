"""Collected sessions are logs like anybody's."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ucfrec.acting.rollout import Episodes
from ucfrec.errors import InputError
from ucfrec.evaluation import collect as module
from ucfrec.evaluation.collect import collect
from ucfrec.evaluation.simulator import Simulator
from ucfrec_simulators import synthetic_catalog
from ucfrec_simulators.taobao import synthetic as synthetic_taobao

FLOATS = pa.list_(pa.float32())
KEYS = dict.fromkeys(("user_id", "session_id", "timestamp"), pa.int64())


def run(simulator: Simulator, out: Path, sessions: int = 300, seed: int = 3) -> Episodes:
    env = simulator.make(32, None)
    actor = simulator.behaviors["mixture"](env, seed)
    return collect(simulator, env, actor, sessions, seed, out, env_name="e", behavior="mixture")


def types(out: Path) -> dict[str, pa.DataType]:
    schema = pq.read_schema(out / "sessions.parquet")
    return dict(zip(schema.names, schema.types, strict=True))


def test_catalog_sessions_have_users_items_and_propensities(tmp_path: Path) -> None:
    played = run(synthetic_catalog.SIMULATOR, tmp_path / "logs")
    floats = {"observation": FLOATS, "is_click": pa.float32(), "propensity": pa.float32()}
    assert types(tmp_path / "logs") == KEYS | {"item_id": pa.int64()} | floats
    log = pq.read_table(tmp_path / "logs" / "sessions.parquet").to_pandas()
    assert len(log) == played.lengths.sum()
    assert log["propensity"].between(0, 1, inclusive="right").all()
    assert (log.groupby("session_id")["user_id"].nunique() == 1).all()
    # A user's features are the user's in every session.
    first = log["observation"].map(lambda values: values[0])
    assert (first.groupby(log["user_id"]).nunique() == 1).all()
    items = pq.read_table(tmp_path / "logs" / "items.parquet").to_pandas()
    assert set(log["item_id"]) <= set(items["item_id"])
    record = json.loads((tmp_path / "logs" / "collect.json").read_text())
    assert (record["behavior"], record["sessions"], record["seed"]) == ("mixture", 300, 3)
    assert record["mean_return"] == pytest.approx(played.returns.mean())
    assert {"ucfrec", "gymnasium", "numpy", "torch", "python"} == set(record["versions"])


def test_taobao_sessions_have_actions(tmp_path: Path) -> None:
    played = run(synthetic_taobao.SIMULATOR, tmp_path / "logs")
    floats = {"action": FLOATS, "observation": FLOATS, "clicks": pa.float32()}
    assert types(tmp_path / "logs") == KEYS | floats
    assert not (tmp_path / "logs" / "items.parquet").exists()
    log = pq.read_table(tmp_path / "logs" / "sessions.parquet").to_pandas()
    log = log.sort_values(["session_id", "timestamp"])
    assert (log["user_id"] == log["session_id"]).all()
    actions, observations = np.stack(log["action"]), np.stack(log["observation"])
    assert actions.shape == (len(log), 27)
    assert np.abs(actions).max() <= 1
    # The pages turned and the clicks before, as observed, are those of the rows before.
    step = log.groupby("session_id").cumcount().to_numpy()
    np.testing.assert_array_equal(observations[:, -1], step)
    before = log.groupby("session_id")["clicks"].shift(fill_value=0)
    np.testing.assert_array_equal(observations[:, 88], before)
    clicks = log.groupby("session_id")["clicks"].sum().to_numpy()
    np.testing.assert_array_equal(clicks, played.returns)


def test_no_rows_of_a_user_share_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Sessions that start every second and last up to 20 overlap, the more so for 50 users.
    monkeypatch.setattr(module, "SESSION_MS", 1000)
    simulator = synthetic_catalog.SIMULATOR
    env = synthetic_catalog.SyntheticCatalog(32, n_users=50)
    actor = simulator.behaviors["optimal"](env, 0)
    collect(simulator, env, actor, 400, 0, tmp_path / "logs", env_name="e", behavior="optimal")
    log = pq.read_table(tmp_path / "logs" / "sessions.parquet").to_pandas()
    assert not log.duplicated(["user_id", "timestamp"]).any()
    steps = log.sort_values(["session_id", "timestamp"]).groupby("session_id")["timestamp"].diff()
    assert (steps.dropna() == 1000).all()


def test_long_logs_are_written_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(synthetic_taobao.SIMULATOR, tmp_path / "whole")
    monkeypatch.setattr(module, "ROWS_PER_GROUP", 500)
    run(synthetic_taobao.SIMULATOR, tmp_path / "pieces")
    pieces = pq.ParquetFile(tmp_path / "pieces" / "sessions.parquet")
    assert pieces.num_row_groups > 3
    whole = pq.read_table(tmp_path / "whole" / "sessions.parquet")
    assert pieces.read().equals(whole)


def test_bad_input_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="sessions is 0"):
        run(synthetic_catalog.SIMULATOR, tmp_path / "logs", sessions=0)
    (tmp_path / "there").mkdir()
    with pytest.raises(InputError, match="exists already"):
        run(synthetic_catalog.SIMULATOR, tmp_path / "there")
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
