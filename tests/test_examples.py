"""The notebooks run from start to end, and what they conclude holds."""

import json
import os
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from examples.make_news_log import make_log as make_news
from examples.make_ratings_log import RATINGS
from examples.make_ratings_log import make_log as make_ratings
from examples.make_shop_log import make_log
from examples.simulated_month import Day, Month, plot, simulate, summary
from tests.support.markdown import ROOT
from ucfrec import EpisodeStore, Recommender, prepare
from ucfrec.logs.mapping import read_mapping
from ucfrec.logs.prepare import PrepareOptions, validate

SETTINGS = ("train.learning_rate=1e-3", "policy.dim=32", "policy.context=10")
SETTINGS += ("policy.exposure=true", "rule.sessions=20")
SMALLER = {
    "shop": {
        "SESSIONS, ITEMS = 3000": "SESSIONS, ITEMS = 100",
        "--set policy.dim=32 2>": "--set policy.dim=32 --set rule.sessions=10 2>",
    },
    "evaluation": {
        "--sessions 2500": "--sessions 400",
        "--sessions 800": "--sessions 200",
        "--episodes 400": "--episodes 40",
        "train.steps=600": "train.steps=60",
        '--set policy.dim=32"': '--set policy.dim=32 --set rule.sessions=10 --set crm.epochs=2"',
    },
    "control": {
        "range(150)": "range(60)",
        "train.steps=400": "train.steps=40",
        "--set policy.context=5": "--set policy.context=5 --set crm.epochs=2",
    },
}
"""Numbers of a notebook that its code runs as well without, and whose results nothing checks."""
NOTEBOOKS = tuple(SMALLER)


@pytest.mark.slow
@pytest.mark.skipif(
    find_spec("nbclient") is None or find_spec("ipykernel") is None, reason="needs the extra dev"
)
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_the_notebook_runs(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import nbformat
    from nbclient import NotebookClient

    if name == "control" and (find_spec("h5py") is None or find_spec("mujoco") is None):
        pytest.skip("needs the extra control")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    notebook = nbformat.read(ROOT / "examples" / f"{name}.ipynb", as_version=4)
    source = "".join(cell.source for cell in notebook.cells)
    assert all(source.count(number) == 1 for number in SMALLER[name])
    for cell in notebook.cells:
        for number, smaller in SMALLER[name].items():
            cell.source = cell.source.replace(number, smaller)
    where = {"metadata": {"path": str(ROOT / "examples")}}
    NotebookClient(notebook, timeout=600, kernel_name="python3", resources=where).execute()
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    printed = "".join(o.get("text", "") for cell in code for o in cell.outputs if "text" in o)
    if name == "shop":  # the log supports the own rule, and not a bold one
        assert "per session: – (" in printed or "the log cannot say: " in printed
        assert printed.count("logged: ") == 4


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_the_committed_notebook_has_its_outputs(name: str) -> None:
    notebook = json.loads((ROOT / "examples" / f"{name}.ipynb").read_text(encoding="utf-8"))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(cell["execution_count"] for cell in code)
    outputs = [output for cell in code for output in cell["outputs"]]
    assert any("image/svg+xml" in output.get("data", {}) for output in outputs)
    assert not any(output["output_type"] == "error" for output in outputs)
    assert not any(output.get("name") == "stderr" for output in outputs)  # progress, warnings
    assert "/tmp" not in json.dumps(outputs)


def test_the_shop_has_its_faults_and_logs_its_probabilities(tmp_path: Path) -> None:
    shop = make_log(tmp_path / "shop", sessions=400)
    log = pd.read_parquet(tmp_path / "shop" / "impressions.parquet")
    assert log["revenue"].isna().mean() > 0.9
    assert log["visitor"].value_counts().index[0] == "bot-1"
    assert log["propensity"].between(0, 1, inclusive="neither").all()
    mapping = read_mapping(tmp_path / "shop" / "shop.toml")
    report = validate([tmp_path / "shop" / "impressions.parquet"], mapping, PrepareOptions())
    assert report["dropped"]["duplicate"] > 0
    assert report["dropped"]["null_key"] > 0
    log = log[log["visitor"].notna() & (log["visitor"] != "bot-1")]
    visitors = log["visitor"].str[1:].astype(int).to_numpy()
    products = log["sku"].str[4:].astype(int).to_numpy()
    expected = [shop.propensities(v)[p] for v, p in zip(visitors, products, strict=True)]
    np.testing.assert_allclose(log["propensity"], expected)


SMALL = ("train.steps=40", "policy.dim=16", "policy.context=4", "rule.sessions=4")


@pytest.mark.slow
def test_two_days_of_the_month_close_the_loop_and_are_resumed(tmp_path: Path) -> None:
    month = Month(days=2, sessions=50, users=80, items=110, settings=SMALL)
    assert [each.day for each in simulate(tmp_path, replace(month, days=1))] == [1]
    days = simulate(tmp_path, month)
    assert [each.day for each in days] == [1, 2]
    assert all(0 < each.reward < 20 and 0 < each.frozen < 20 for each in days)
    current = json.loads((tmp_path / "runs" / "promoted.json").read_text())["current"]
    assert current == days[-1].current
    assert "last 2 days" in summary(days)
    shown = pd.concat(map(pd.read_parquet, (tmp_path / "shown-02").glob("*.parquet")))
    log = pd.read_parquet(tmp_path / "log-02.parquet")
    assert len(log) == len(shown) > 0
    assert log.click.sum() == round(days[1].reward * month.sessions)
    plot(days, tmp_path / "month.svg")
    assert (tmp_path / "month.svg").stat().st_size > 1000


@pytest.mark.slow
def test_a_policy_that_is_updated_earns_more_than_one_that_is_not(tmp_path: Path) -> None:
    # Intervals of a day share its log: of four days, one that is unlucky would be a quarter.
    month = Month(days=7, sessions=300, users=600, settings=("train.steps=500", *SETTINGS))
    days: list[Day] = simulate(tmp_path, month)
    reward, frozen = (
        np.mean([getattr(each, name) for each in days[-2:]]) for name in ("reward", "frozen")
    )
    assert reward > 1.15 * frozen
    assert np.mean([found for day in days for found in day.covered if found is not None]) > 0.7


def test_the_publisher_trains_where_sessions_see_all_there_is(tmp_path: Path) -> None:
    make_news(tmp_path, sessions=300)
    mapping = read_mapping(tmp_path / "news.toml")
    prepare([tmp_path / "impressions.parquet"], mapping, tmp_path / "store")
    settings = [*SETTINGS, "train.steps=10", "policy.dim=8"]
    recommender = Recommender("dt", settings=settings)
    recommender.fit(EpisodeStore.open(tmp_path / "store"), tmp_path / "run", refit=False)
    evening, morning = pd.Timestamp("2026-10-18T20:00"), "2026-10-18T08:00"
    frames = [recommender.recommend(k=4, at=time) for time in (evening, morning)]
    frames += [recommender.recommend(k=4, at=evening, candidates=frames[0].item_id.iloc[:9])]
    assert not set.intersection(*(set(frame.request_id) for frame in frames))
    rows = recommender.trained.require_store("").to_frame()
    earlier = rows[rows.timestamp < evening.value // 10**6]
    pd.testing.assert_frame_equal(recommender.recommend(earlier, k=4, at=evening), frames[0])


def test_ratings_drift_to_new_films(tmp_path: Path) -> None:
    log = make_ratings(tmp_path)
    assert len(log) == RATINGS
    assert not log.duplicated(["user", "film"]).any()
    first, later = log[: RATINGS * 8 // 10], log[RATINGS * 9 // 10 :]
    rows = later.film.map(first.film.value_counts()).fillna(0)
    assert 0.15 < (rows < 3).mean() < 0.35
