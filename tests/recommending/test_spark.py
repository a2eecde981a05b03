"""Spark's workers recommend what one process does, row by row."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.recommending.test_recommend import SETTINGS, random_log
from ucfrec import EpisodeStore, Recommender
from ucfrec.commands.cli import main
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare

RULES = {
    "drawn": ["--k", "6", "--temperature", "1.5", "--seed", "3"],
    "explored": ["--k", "2", "--explore", "0.5", "--explore-top", "5", "--keep-seen"],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, and logs of text ids in two files, some of whose rows cannot be used."""
    folder = tmp_path_factory.mktemp("spark")
    log = random_log().assign(user_id=lambda log: "é" + log.user_id.astype(str))
    log.to_parquet(folder / "train.parquet")
    options = PrepareOptions(reward="reward", session_by="gap", gap_minutes=20)
    prepare([folder / "train.parquet"], LogMapping(), folder / "store", options)
    Recommender("ucf", settings=SETTINGS).fit(EpisodeStore.open(folder / "store"), folder / "run")
    later = log.sample(frac=1, random_state=1).assign(shown=log.item_id)
    later.loc[later.user_id == "é7", "reward"] = np.nan
    later.loc[later.index[:9], "timestamp"] = 5
    later.loc[later.index[9:20], "shown"] = 999
    (folder / "logs").mkdir()
    later = later.drop(columns="item_id")
    later.iloc[:800].to_parquet(folder / "logs" / "b.parquet")
    later.iloc[700:].to_csv(folder / "logs" / "a.csv", index=False)
    return folder


@pytest.mark.parametrize("rule", [pytest.param("drawn", marks=pytest.mark.slow), "explored"])
def test_rows_are_those_of_one_process(folder: Path, spark: Any, rule: str, tmp_path: Path) -> None:
    command = ["recommend", str(folder / "run"), str(folder / "logs"), *RULES[rule]]
    command += ["--column", "item_id=shown", "--skip-unknown", "--where", "user_id <> 'é3'"]
    found, shown = {}, {}
    for engine in ("torch", "spark"):
        out, exposures = tmp_path / engine, tmp_path / f"{engine}-shown"
        options = ["--engine", engine, "--out", str(out), "--exposures", str(exposures)]
        assert main([*command, *options]) == 0
        found[engine], shown[engine] = pd.read_parquet(out), pd.read_parquet(exposures)
    assert len(list((tmp_path / "spark").glob("part-*.parquet"))) == 2
    numbers = ["score", "propensity"]
    pd.testing.assert_frame_equal(found["spark"], found["torch"], rtol=1e-4, atol=1e-6)
    assert found["spark"].user_id.nunique() == 38
    whose = ["user_id", "item_id", "request_id", "position", "run", "rule"]
    pd.testing.assert_frame_equal(shown["spark"][whose], shown["torch"][whose])
    assert not found["spark"][numbers].isna().any(axis=None)
    assert {path.name for path in tmp_path.iterdir()} == {
        name + end for name in ("torch", "spark") for end in ("", "-shown")
    }


def test_what_a_worker_refuses_is_one_clear_error(
    folder: Path, spark: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["recommend", str(folder / "run"), str(folder / "logs"), "--out", str(tmp_path / "r")]
    command += ["--column", "item_id=shown"]
    assert main([*command, "--engine", "spark"]) == 2
    assert "rows have an item_id that the policy does not know" in (said := capsys.readouterr().err)
    assert "Traceback" not in said
    assert main([*command, "--engine", "spark", "--approximate"]) == 2
    assert "--approximate" in capsys.readouterr().err
    assert main([*command, "--spark-master", "local[1]"]) == 2
    assert not list(tmp_path.iterdir())
