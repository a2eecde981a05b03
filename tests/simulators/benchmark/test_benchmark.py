"""The recommendation benchmark: what it measures, what it reuses, and what its tables say."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from tests.support.real_data import data_folder
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.evaluation.evaluate import evaluate_behavior
from ucfrec.evaluation.world import World
from ucfrec.plugins import Benchmark, load_plugin
from ucfrec.reporting.grid import read_rows
from ucfrec_simulators.benchmark import plan
from ucfrec_simulators.benchmark.cells import JUDGED, METHODS, Judging
from ucfrec_simulators.benchmark.plan import BUDGETS, Plan
from ucfrec_simulators.benchmark.plots import plot_distractor, plot_methods, plot_targets
from ucfrec_simulators.benchmark.tables import distractor_table, method_table, target_table
from ucfrec_simulators.benchmark.tasks import kuairand
from ucfrec_simulators.kuai.environment import EXITS
from ucfrec_simulators.kuai.logs import cut_by_exit, window

TINY = replace(
    BUDGETS["small"],
    seeds=1,
    sessions=60,
    settings=("policy.dim=8", "train.steps=2", "train.validate_every=2", "crm.epochs=1"),
    judging=Judging(episodes=8, validation_episodes=4, quantiles=(0.5, 1.0)),
    sweep_seeds=1,
)


@pytest.fixture
def no_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UCFREC_DATA", str(tmp_path / "nothing"))


@pytest.mark.usefixtures("no_data")
def test_rows_are_those_of_the_evaluation_and_are_measured_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(BUDGETS, "small", TINY)
    some = {name: METHODS[name] for name in ("popular", "dt")}
    monkeypatch.setattr(plan, "METHODS", some)
    suite: Benchmark = load_plugin("benchmarks", "recommendation")
    results = tmp_path / "rows.jsonl"
    said = suite.run("small", ["main"], tmp_path / "out", results, 1)
    assert "kuairand is left out" in said
    rows = read_rows(results)
    assert {(r["env"], r["method"], r["checkpoint"]) for r in rows} == {
        *(("synthetic-catalog", name, None) for name in ("random", "mixture", "optimal")),
        *(("synthetic-catalog", name, c) for name in ("popular", "dt") for c in ("best", "last")),
    }
    played = evaluate_behavior(World("synthetic-catalog"), "optimal", 8, JUDGED)
    found = next(row for row in rows if row["method"] == "optimal")
    assert found["R_cum"] == played["R_cum"]
    assert (found["seed"], found["evaluation_seed"]) == (0, JUDGED)
    tried = next(row for row in rows if row["method"] == "dt")
    best = max(tried["validation"], key=lambda target: tried["validation"][target])
    assert tried["target_return"] == float(best)
    assert (tmp_path / "out" / "small" / "plots").exists() == ("pictures:" in said)
    again = suite.run("small", ["main"], tmp_path / "out", results, 1)
    assert again == said
    assert len(read_rows(results)) == len(rows)


@pytest.mark.usefixtures("no_data")
def test_every_cell_of_every_table_has_a_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan, "MAIN", ("synthetic-taobao", "synthetic-catalog"))
    monkeypatch.setattr(plan, "SWEPT", ("synthetic-taobao",))
    given = Plan(tmp_path, TINY)
    cells = [*given.main(), *given.sweeps(), *given.distractor()]
    trained = [cell for cell in cells if cell.store is not None]
    folders = {(cell.run, cell.config) for cell in trained}
    assert len({run for run, _ in folders}) == len(folders), "a folder for every configuration"
    assert {cell.method for cell in trained} >= {"ucf", "ucf, λ = 0", "ucf, band 1–2"}
    assert not [c for c in trained if c.task == "synthetic-taobao" and c.method == "item-knn"]
    swept = {cell.method: cell.config for cell in given.sweeps()}
    spread = swept["ucf, ε_r = 0.1 σ"].augment.epsilon_r
    rewards = EpisodeStore.open(trained[0].store)  # type: ignore[arg-type]
    catalog = rewards.step_values("reward", *rewards.all_steps())
    assert spread is not None
    assert swept["ucf, ε_r = 0.5 σ"].augment.epsilon_r == pytest.approx(5 * spread)
    assert catalog.std() > 0
    distractors = [cell for cell in given.distractor() if cell.task.endswith("distractor")]
    planted = EpisodeStore.open(distractors[0].store)  # type: ignore[arg-type]
    assert planted.observation_size == 92
    assert [world.rate for world in distractors[0].worlds] == [0.0, 1.0]  # type: ignore[attr-defined]
    assert {cell.judging.quantiles for cell in given.distractor()} == {(1.0,), (0.99,)}


def test_unknown_tables_are_named(tmp_path: Path) -> None:
    suite: Benchmark = load_plugin("benchmarks", "recommendation")
    with pytest.raises(InputError, match="tables are main, distractor, sweeps"):
        suite.run("small", ["table-2"], tmp_path, tmp_path / "rows.jsonl", 1)


def test_tables_give_means_spreads_and_paired_drops() -> None:
    shared = {
        "env": "w",
        "method": "m",
        "checkpoint": "best",
        "target_return": 3.0,
        "distractor": None,
    }
    shared |= {"R_avg_pooled": 0.5, "R_avg_episode": 0.5, "length": 2.0, "coverage": None}
    earned = {None: (10.0, 20.0), 0.0: (5.0, 15.0), 1.0: (8.0, 16.0)}
    rows = [
        shared | {"seed": s, "R_cum": v, "distractor": distractor, "validation": {"3": v + s}}
        for distractor, values in earned.items()
        for s, v in enumerate(values)
    ]
    clean = [row for row in rows if row["distractor"] is None]
    last = clean[0] | {"checkpoint": "last", "R_cum": 99.0}
    assert method_table([*clean, last]).splitlines()[2] == (
        "| w | m | 2 | 15 ± 7.07 | 0.5 ± 0 | 0.5 ± 0 | 2 ± 0 | – | 3 |"
    )
    assert target_table(clean).splitlines()[2] == "| w | m | 3 | 2 | 15.5 ± 7.78 |"
    asked = [row | {"quantiles": [q]} for q in (0.99, 1.0) for row in rows]
    line, less = distractor_table(asked).splitlines()[2:]
    assert less == line.replace("| 1 |", "| 0.99 |")
    assert line == "| w | 1 | m | 2 | 15 ± 7.07 | 10 ± 7.07 | 12 ± 5.66 | 37.5 ± 17.7 |"


def test_pictures_show_the_means(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    shared = {"env": "w", "checkpoint": "best", "target_return": 3.0, "validation": {"3": 1.0}}
    rows = [
        shared
        | {
            "method": method,
            "seed": s,
            "R_cum": s + 1.0,
            "distractor": distractor,
            "quantiles": [1.0],
        }
        for method in ("dt", "ucf")
        for distractor in (None, 0.0, 1.0)
        for s in range(2)
    ]
    clean = [row for row in rows if row["distractor"] is None]
    for plot, given, name in (
        (plot_methods, clean, "methods-w.svg"),
        (plot_targets, clean, "targets-w.svg"),
        (plot_distractor, rows, "distractor-w.svg"),
    ):
        (path,) = plot(given, tmp_path)
        assert path == tmp_path / name
        drawn = path.read_text()
        assert ">ucf<" in drawn
        assert ">dt<" in drawn
        plot(given, tmp_path)
        assert path.read_text() == drawn
    assert plot_distractor(clean, tmp_path) == []


def test_windows_drop_repeats_and_are_cut(tmp_path: Path) -> None:
    log = pa.table(
        {
            "user_id": [2, 1, 1, 1, 1, 2],
            "video_id": [7, 5, 5, 6, 8, 9],
            "time_ms": [50, 20, 20, 10, 30, 5],
            "date": [1, 1, 1, 1, 1, 2],
        }
    )
    pa.parquet.write_table(log, tmp_path / "log.parquet")
    rows = window([tmp_path / "log.parquet"], "time_ms", "date = 1")
    assert rows["video_id"].to_pylist() == [6, 5, 8, 7]
    cut = cut_by_exit(rows, {6: (1,), 5: (1,), 8: (2,)}, EXITS["easyrl4rec-kuairand"])
    # The second video repeats the first one's tag: the user leaves, and comes back for the third.
    assert cut["session_id"].to_pylist() == [0, 0, 1, 2]
    with pytest.raises(InputError, match="no row has date = 9"):
        window([tmp_path / "log.parquet"], "time_ms", "date = 9")


@pytest.mark.realdata
def test_kuairand_learns_before_it_judges(tmp_path: Path) -> None:
    data_folder("kuairand")
    task = kuairand(tmp_path, 0)
    learned, judged = (EpisodeStore.open(tmp_path / name) for name in ("store", "judge"))
    last, first = (
        f(store.step_values("timestamp", *store.all_steps()))
        for f, store in ((np.max, learned), (np.min, judged))
    )
    assert last < first
    assert learned.lengths.max() <= EXITS["easyrl4rec-kuairand"].max_turn
    row = evaluate_behavior(task.worlds[2], "random", 50, 0)
    assert row["length"] == 10
