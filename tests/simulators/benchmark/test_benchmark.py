"""The recommendation benchmark: what it measures, what it reuses, and what its tables say."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tests.support.real_data import data_folder
from tests.support.result_rows import result_row
from ucfrec.benchmark.cells import Budget, Evaluation, describe_updates, make_key
from ucfrec.benchmark.suite import Benchmark, BenchmarkRequest
from ucfrec.benchmark.suite import measure as measured
from ucfrec.commands.cli import main
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.evaluation.evaluate import evaluate_behavior
from ucfrec.evaluation.simulator import Environment
from ucfrec.files.atomic import read_json
from ucfrec.plugins import load_plugin
from ucfrec.results.rows import ResultRow, append_rows, read_rows
from ucfrec.runs.config import resolve_config
from ucfrec.runs.record import RUN
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_simulators.benchmark import plan
from ucfrec_simulators.benchmark.measure import measure
from ucfrec_simulators.benchmark.methods import BUDGETS, METHODS
from ucfrec_simulators.benchmark.plan import RecommendationCells
from ucfrec_simulators.benchmark.tasks import Log, kuairand
from ucfrec_simulators.kuai.environment import EXITS
from ucfrec_simulators.kuai.logs import cut_by_exit, part_of, window


def planned(folder: Path, budget: Budget, **request: Any) -> RecommendationCells:
    given = BenchmarkRequest(budget.name, [], folder, folder / "rows.jsonl", 1, **request)
    return RecommendationCells(given, budget)


UPDATES = "the paper's settings, 0.02% of its updates"
SETTINGS = ("policy.dim=8", "train.steps=2", "train.validate_every=2", "crm.epochs=1")
FEW = {"evaluation": Evaluation(episodes=8, seed=1_000_000), "settings": SETTINGS}
TINY = replace(BUDGETS["small"], seeds=2, logs=1, sessions=60, **FEW)


@pytest.fixture
def no_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UCFREC_DATA", str(tmp_path / "nothing"))


def assert_rules_are_those_of_the_runs(rows: Sequence[ResultRow], out: Path) -> None:
    runs = {TrainedPolicy.load(path.parent).rule for path in out.rglob(RUN)}
    trained = [row for row in rows if row.training_seed is not None]
    assert {row.rule for row in trained} == {f"{rule} ({rule.hash})" for rule in runs}
    of_dt = [row for row in rows if row.method == "dt+shared"]
    assert {row.target_return for row in of_dt} <= {rule.target for rule in runs}
    records = [read_json(path) for path in out.rglob(RUN)]
    own = [record["rule"]["estimate"] for record in records if "rule" in record]
    names = ("estimated_value", "estimated_value_error")
    printed = [row for row in of_dt if names[0] in row.metrics]
    assert sorted(tuple(row.metrics[name] for name in names) for row in printed) == sorted(
        (each["value"], each["error"]) for each in own if not each["doubts"]
    )


@pytest.mark.slow
@pytest.mark.usefixtures("no_data")
def test_rows_are_evaluated_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = replace(TINY, logs=2, tasks=("kuairand", "synthetic-catalog"))
    monkeypatch.setitem(BUDGETS, "small", tiny)
    some = {name: METHODS[name] for name in ("popular", "dt+shared")}
    monkeypatch.setattr(plan, "METHODS", some)
    suite: Benchmark = load_plugin("benchmarks", "recommendation")
    results = tmp_path / "rows.jsonl"
    request = BenchmarkRequest("small", ["main"], tmp_path / "out", results, 1)
    said = measured(suite, request)
    assert "kuairand is excluded" in said
    rows = read_rows(results)
    built_in = [(name, None, None) for name in ("random", "mixture", "optimal")]
    # Seed by seed, so that an interrupted table is one of fewer seeds.
    trained = [(n, log, s) for s in (0, 1) for log in (0, 1) for n in some]
    assert [(r.method, r.log_seed, r.training_seed) for r in rows] == [*built_in, *trained]
    assert len({r.data_fingerprint for r in rows if r.training_seed is not None}) == 2
    played = evaluate_behavior(Environment("synthetic-catalog"), "optimal", 8, 1_000_000)
    found = next(row for row in rows if row.method == "optimal")
    assert (found.value, found.interval) == (played.value, played.interval)
    # Whatever the training seed, the same episodes are reported.
    assert {row.evaluation_seed for row in rows} == {1_000_000}
    assert_rules_are_those_of_the_runs(rows, tmp_path / "out")
    assert str(tmp_path) not in results.read_text()
    assert measured(suite, request) == said
    assert len(read_rows(results)) == len(rows)
    # Trained and simulated again: the same numbers.
    monkeypatch.setattr(plan, "METHODS", {"popular": METHODS["popular"]})
    weights = {path.stat().st_mtime_ns for path in tmp_path.rglob("best.safetensors")}
    measured(suite, replace(request, again=True))
    again = read_rows(results)
    assert len(again) == len(rows)
    first, second = (sorted((r.method, str(r.log_seed), r.value) for r in x) for x in (rows, again))
    assert first == second
    written = {path.stat().st_mtime_ns for path in tmp_path.rglob("best.safetensors")}
    assert len(written - weights) == 4
    measured(suite, replace(request, evaluation_seed=5, log_seed=3, logs=1))
    last = read_rows(results)[-1]
    assert (last.evaluation_seed, last.log_seed) == (5, 3)
    assert last.data_fingerprint != again[-1].data_fingerprint


@pytest.mark.slow
def test_any_gymnasium_environment_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(BUDGETS, "small", replace(TINY, seeds=1))
    monkeypatch.setattr(plan, "METHODS", {name: METHODS[name] for name in ("item-knn", "dt")})
    name = "gymnasium:tests.support.gymnasium_environments:ucfrec-test/Discrete-v0"
    command = ["benchmark", "recommendation", "--env", name, "--observe", "secret"]
    command += ["--out", str(tmp_path / "out"), "--workers", "1"]
    assert main([*command, "--table", "sweeps"]) == 2
    assert "--env gives the table main only" in capsys.readouterr().err
    assert main(command) == 0
    title = f"{name} --observe secret"
    assert f"| {title} | dt | 1 |" in capsys.readouterr().out
    rows = read_rows(tmp_path / "out" / "results.jsonl")
    assert [row.method for row in rows] == ["random", "item-knn", "dt"]
    assert {(row.task, row.environment, row.log_seed) for row in rows[1:]} == {(title, title, 0)}
    assert rows[0].metrics["length"] == 5


@pytest.mark.usefixtures("no_data")
def test_every_cell_of_every_table_has_a_configuration(tmp_path: Path) -> None:
    pages, catalog = ("synthetic-taobao",), ("synthetic-catalog",)
    tasks_of = {"shared": catalog, "sweeps": pages, "distractor": pages}
    budget = replace(TINY, seeds=1, tasks=(*pages, *catalog), tasks_of=tasks_of)
    given = planned(tmp_path, budget)
    tables = {name: list(given.cells(name)) for name in ("main", *tasks_of)}
    trained = [cell for cells in tables.values() for cell in cells if cell.store is not None]
    folders = {(cell.run, cell.config) for cell in trained}
    assert len({run for run, _ in folders}) == len(folders), "a folder for every configuration"
    of_pages = {cell.method for cell in trained if cell.task in pages}
    assert not of_pages & {"item-knn", "dt+shared"}
    of_catalog = {cell.method: cell.config for cell in trained if cell.task in catalog}
    for name, shared in (("dt", False), ("dt+shared", True)):
        config = of_catalog[name]
        assert (config.policy.exposure, config.rule.choose) == (shared, shared)
    swept = {cell.method: cell.config for cell in tables["sweeps"]}
    smallest = swept["ucf, ε_r = 0.02 σ"].augment.epsilon_r
    store = EpisodeStore.open(trained[0].store)
    rewards = store.step_values("reward", *store.all_steps())
    assert smallest == pytest.approx(0.02 * rewards.std())
    distractors = [cell for cell in tables["distractor"] if cell.task.endswith("distractor")]
    assert EpisodeStore.open(distractors[0].store).observation_size == 92
    assert [environment.rate for environment in distractors[0].environments] == [0.0, 1.0]
    for cells in tables.values():
        paper = [cell for cell in cells if cell.method == "ucf-paper"]
        assert {cell.task for cell in paper} == {cell.task for cell in cells}
        for cell in paper:
            assert describe_updates(cell) == {"updates": UPDATES}
            assert cell.config.train.steps == 2
            length = replace(cell.config.train, steps=10_000, warmup_steps=500, validate_every=500)
            assert replace(cell.config, train=length) == resolve_config("ucf-paper")
    assert BUDGETS["full"].shorten(METHODS["ucf-paper"])[0] == "train.steps=10000", "not longer"


@pytest.mark.usefixtures("no_data")
def test_a_named_task_is_measured_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(plan._PACKAGES, "sardine-static", "not_installed")
    budget = replace(TINY, tasks=("sardine-static", "synthetic-catalog"))
    assert planned(tmp_path, budget).missing() == ["sardine-static"]
    for task, table in product(("synthetic-catalog", "synthetic-taobao"), ("main", "sweeps")):
        named = planned(tmp_path, replace(TINY, seeds=1), tasks=[task])
        assert {cell.task for cell in named.cells(table)} == {task}
        assert named.missing() == []


@pytest.mark.slow
@pytest.mark.usefixtures("no_data")
def test_the_distractor_is_off_and_on(tmp_path: Path) -> None:
    budget = replace(TINY, sessions=300, settings=(*TINY.settings, "rule.sessions=10"))
    given = planned(tmp_path, budget, tasks=["synthetic-catalog"])
    cells = [cell for cell in given.cells("distractor") if cell.task.endswith("distractor")]
    (cell, *_) = (cell for cell in cells if cell.method == "bc")
    rows = measure(cell, make_key(cell))
    assert {row.conditions["distractor"] for row in rows} == {0.0, 1.0}
    assert {row.target_return for row in rows} == {None}


def test_show_only_measures_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "rows.jsonl"
    arguments = ["benchmark", "recommendation", "--show-only", "--results", str(path)]
    assert main(arguments) == 2
    assert "rows.jsonl has no rows of recommendation, main" in capsys.readouterr().err
    paper = result_row(3.0, training_seed=1).extended({"updates": UPDATES})
    append_rows(path, [result_row(10.0), result_row(20.0), paper])
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert "| w | m | 2 | 11.5 ± 12 |" in printed, "the last of a seed counts"
    assert f"\n\nucf-paper…: {UPDATES}\n" in printed
    assert main(["benchmark", "recommendation", "--out", "out", "--table", "table-2"]) == 2
    assert "no table is called table-2; there are main, shared, dist" in capsys.readouterr().err


def test_a_given_log_is_dealt_out_by_session() -> None:
    log = pa.table({"session_id": np.repeat(np.arange(500), 3), "row": np.arange(1500)})
    parts = [part_of(log, part, 2) for part in (0, 1)]
    sessions = [set(part["session_id"].to_pylist()) for part in parts]
    assert not sessions[0] & sessions[1]
    assert sorted(row for part in parts for row in part["row"].to_pylist()) == list(range(1500))
    assert min(map(len, sessions)) > 200


def test_windows_drop_repeats_and_are_cut(tmp_path: Path) -> None:
    users, videos, times = [2, 1, 1, 1, 1, 2], [7, 5, 5, 6, 8, 9], [50, 20, 20, 10, 30, 5]
    log = pa.table({"user_id": users, "video_id": videos, "time_ms": times, "date": [1] * 5 + [2]})
    pa.parquet.write_table(log, tmp_path / "log.parquet")
    rows = window([tmp_path / "log.parquet"], "time_ms", "date = 1")
    assert rows["video_id"].to_pylist() == [6, 5, 8, 7]
    cut = cut_by_exit(rows, {6: (1,), 5: (1,), 8: (2,)}, EXITS["easyrl4rec-kuairand"])
    # The second video repeats the first one's tag: the user leaves, and comes back for the third.
    assert cut["session_id"].to_pylist() == [0, 0, 1, 2]
    with pytest.raises(InputError, match="no row satisfies date = 9"):
        window([tmp_path / "log.parquet"], "time_ms", "date = 9")


@pytest.mark.slow
@pytest.mark.realdata
def test_kuairand_learns_from_what_came_before_its_environments(tmp_path: Path) -> None:
    data_folder("kuairand")
    task = kuairand(tmp_path, Log(0, 0))
    names = ("store", "environment-store")
    learned, played = (EpisodeStore.open(tmp_path / name) for name in names)
    learned_at, played_at = (s.step_values("timestamp", *s.all_steps()) for s in (learned, played))
    assert learned_at.max() < played_at.min()
    assert learned.lengths.max() <= EXITS["easyrl4rec-kuairand"].max_turn
    assert evaluate_behavior(task.environments[2], "random", 50, 0)["length"] == 10


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"methods": ["dt", "nothing"]}, "no method is called nothing"),
        ({"tasks": ["nowhere"]}, "no task is called nowhere"),
        ({"budget": "huge"}, "no budget is called huge"),
    ],
)
def test_unknown_cells_are_refused(given: dict[str, Any], message: str, tmp_path: Path) -> None:
    suite, out = load_plugin("benchmarks", "recommendation"), tmp_path / "out"
    asked = {"budget": "small", "tables": ["main"], "results": tmp_path / "rows.jsonl"}
    with pytest.raises(InputError, match=message):
        measured(suite, BenchmarkRequest(**{**asked, **given}, out=out, workers=1))
    assert not out.exists()
