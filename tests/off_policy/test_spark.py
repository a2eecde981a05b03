"""Spark's workers score logged choices as one process does, row by row."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from ucfrec.commands.cli import main
from ucfrec.off_policy import spark as scored_parts


@pytest.mark.parametrize("session_by", [pytest.param("gap", marks=pytest.mark.slow), "session_id"])
def test_rows_are_those_of_one_process(
    folder: Path, spark: Any, session_by: str, tmp_path: Path
) -> None:
    """With new users and items, sessions that go on from the store, and rows that cannot be used"""
    train, log = (pd.read_parquet(folder / f"{name}.parquet") for name in ("train", "rest"))
    run = folder / "run"
    if session_by == "session_id":
        run, options = tmp_path / "run", ["--session-by", "session_id", "--reward", "reward"]
        train, log = (each.assign(session_id=each.timestamp // 10**7) for each in (train, log))
        train.to_parquet(tmp_path / "train.parquet")
        store = str(tmp_path / "store")
        assert main(["prepare", str(tmp_path / "train.parquet"), *options, "--out", store]) == 0
        small = ["train.steps=3", "policy.dim=8", "policy.context=4", "augment.copies=0"]
        settings = [part for each in small for part in ("--set", each)]
        assert main(["train", store, "--out", str(run), *settings]) == 0
    log["timestamp"] += 10**6
    log.loc[log.index[:9], "item_id"] = 999
    log.loc[log.index[9:12], "timestamp"] = 7
    log.loc[log.user_id == 8, "item_id"] = 999
    log.to_parquet(tmp_path / "log.parquet")
    command = ["score", str(run), str(tmp_path / "log.parquet"), "--temperature", "0.7"]
    found = {}
    for engine in ("torch", "spark"):
        out = str(tmp_path / engine)
        assert main([*command, "--engine", engine, "--out", out]) == 0
        found[engine] = pd.read_parquet(out)
    assert len(list((tmp_path / "spark").iterdir())) == 2
    pd.testing.assert_frame_equal(found["spark"], found["torch"], rtol=1e-4, atol=1e-6)
    assert found["spark"].session.nunique() == found["spark"].session.max() + 1 > 100


def test_sessions_are_numbered_over_all_parts(tmp_path: Path) -> None:
    parts = [[0, 0, 1], [0], [0, 1, 2, 2]]
    for number, sessions in enumerate(parts):
        frame = pd.DataFrame({"user_id": number, "session": sessions})
        frame.to_parquet(tmp_path / f"part-{number}.parquet", index=False)
    scored_parts.number_sessions(tmp_path, [2, 1, 3])
    assert pd.read_parquet(tmp_path).session.to_list() == [0, 0, 1, 2, 3, 4, 5, 5]
