"""Robustness to distractors and screening: what is measured, resumed and derived."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.control_files import MADE, TINY, control, hopper_like, set_options, write_hdf5
from tests.support.real_data import data_folder
from tests.support.result_rows import result_row
from ucfrec import schema
from ucfrec.benchmark.cells import Budget, Evaluation, open_store
from ucfrec.episodes.store import EpisodeStore
from ucfrec.files.atomic import read_json
from ucfrec.reporting.tables import NONE
from ucfrec.results.rows import ResultRow, read_rows
from ucfrec.runs.record import RunRecord
from ucfrec.runs.start import training_views
from ucfrec_control.benchmark import plan
from ucfrec_control.benchmark.budgets import BUDGETS
from ucfrec_control.benchmark.methods import METHODS, SCREENED
from ucfrec_control.benchmark.robustness import drops, largest_drops, screening_rows
from ucfrec_control.data.d4rl import read_d4rl
from ucfrec_control.data.distractor import DISTRACTORS, add_distractor
from ucfrec_control.figures.figures import make_figures
from ucfrec_control.training.evaluate import evaluate_run
from ucfrec_control.training.screening import ScreeningConfig, read_screening, screen_states
from ucfrec_control.training.train import train_control


@pytest.mark.parametrize("early", [False, True])
def test_a_distractor_tells_of_the_reward(folder: Path, tmp_path: Path, early: bool) -> None:
    store = EpisodeStore.open(folder / "store")
    seen = add_distractor(store, tmp_path / "distracted", early=early)
    assert seen.record.source.others["distractors"][0]["early"] == early
    episodes, steps = store.all_steps()
    told = np.minimum(steps + early, store.lengths[episodes] - 1)
    median = np.median(store.step_values(schema.REWARD, episodes, steps))
    high = store.step_values(schema.REWARD, episodes, told) > median
    before, shown = (s.step_values(schema.OBSERVATION, episodes, steps) for s in (store, seen))
    np.testing.assert_array_equal(shown, np.column_stack([before, high]))


def test_the_largest_drop_of_a_method_is_over_cases_in_the_mean_over_seeds() -> None:
    scores = {"none": (50.0, 100.0), "early": (20.0, 80.0), "stochastic": (40.0, 10.0)}
    rows = [row(kind, scores[kind][seed], seed=seed) for kind in scores for seed in (0, 1)]
    # Lost at 0: early 60 and 20%, stochastic 20 and 90%; at 1, where twice large a return is
    # reached: early 20 and −60%, stochastic −60 and 80%.
    (line,) = largest_drops(rows)
    assert line == {"method": "dt", "at 0": pytest.approx(55), "at 1": pytest.approx(10)}


def row(distractor: str, score: float, method: str = "dt", seed: int = 0) -> ResultRow:
    own = {"conditions": {"distractor": distractor}, "metrics": {"score_at_one": 2 * score}}
    own |= {"suite": "robustness", "task": "d", "method": method, "metric": "score"}
    return result_row(score, training_seed=seed, **own)


def test_drops_compare_with_the_same_seed_without_distractor() -> None:
    rows = [
        row("none", 50.0), row("none", 80.0), row("early", 20.0), row("stochastic", 100.0),
        row("none", -1.0, seed=1), row("early", 5.0, seed=1), row("early", 5.0, method="dc"),
    ]  # fmt: skip
    found = {(d["distractor"], d["training_seed"]): d for d in drops(rows)}
    early = found["early", 0]
    assert (early["clean"], early["score"], early["drop"]) == (80.0, 20.0, 75.0)
    assert (early["score_at_one"], early["drop_at_one"]) == (40.0, 50.0)
    assert found["stochastic", 0]["drop"] == -25
    assert math.isnan(found["early", 1]["drop"])


QUICK = ScreeningConfig(hidden=16, shared_steps=100, own_steps=50, trees=5)


def write_screenable(path: Path) -> Path:
    """One dimension is the reward, another a constant, which causes nothing."""
    columns = hopper_like((30, 8, 25) * 8)
    columns["observations"][:, 4] = 0.0
    return write_hdf5(path, columns | {"rewards": columns["observations"][:, 0]})


@pytest.mark.slow
def test_cells_are_measured_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, results = tmp_path / "out", tmp_path / "rows.jsonl"
    budget = Budget("small", (MADE,), 1, Evaluation(2, 1000), (*TINY, "crm.epochs=1"))
    monkeypatch.setitem(BUDGETS, "small", budget)
    monkeypatch.setattr(plan, "ROBUST", {"dt": METHODS["dt"], **SCREENED})
    kinds = {kind: DISTRACTORS[kind] for kind in ("none", "deterministic")}
    monkeypatch.setattr(plan, "DISTRACTORS", kinds)
    write_screenable(tmp_path / f"{MADE}.hdf5")
    # Begun here, where screening may be made quick, and gone on with by the command.
    monkeypatch.setattr("ucfrec_control.training.screening.ScreeningConfig", lambda: QUICK)
    runs, stages = {}, tmp_path / "stages"
    for cell in plan.robustness_cells(tmp_path, out, budget):
        runs[str(cell.conditions["distractor"]), cell.method] = cell.run
        if cell.options:
            train_control(open_store(cell), cell.run, cell.config, **cell.options, shared=stages)
    command = ("robustness", "--data", tmp_path, "--out", out, "--results", results)
    printed = control(*command)[0]
    rows, before = read_rows(results), results.read_text()
    kinds_of = {(r.method, r.conditions["distractor"]): r.details.get("distractors") for r in rows}
    assert kinds_of.keys() == {(method, kind) for kind, method in runs}
    assert all(bool(added) == (kind != "none") for (_, kind), added in kinds_of.items())
    for r in rows:
        kind = str(r.conditions["distractor"])
        for value, name in ((0.0, "score"), (1.0, "score_at_one")):
            fixed = value if kind != "none" else 0.0
            own = {"targets": [r.target_return], "checkpoints": ("last",), "distractor": fixed}
            (again,) = evaluate_run(runs[kind, r.method], episodes=2, seed=1000, **own)
            assert again["score"] == r.metrics[name]
            assert again["distractor_fixed_to"] == fixed
        if kind == "none" or r.method == "ucf-dropped":
            assert r.metrics["score"] == r.metrics["score_at_one"]
    for dropped in drops(rows):
        assert f"{dropped['drop']:.4g}" in printed
    made, _ = make_figures([], [results], tmp_path / "figures")
    assert {p.stem for p in made} == {f"robustness-small-{MADE}"}
    screened = {r["distractor"]: r for r in screening_rows(rows)}
    assert 4 in screened["none"]["true_flagged"]
    assert screened["none"]["flagged"] == NONE
    details = [r.details for r in rows if r.details.keys() >= {"screening", "distractors"}]
    report = details[0]["screening"]
    assert [d["dimension"] for d in report if d["distractor"]] == [11]
    assert screened["deterministic"]["flagged"] is report[11]["flagged"] is True
    control(*command)
    assert results.read_text() == before
    assert control("robustness", "--show-only", "--results", results)[0] == printed


def test_screening_is_recorded_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Predictors this small reach no larger share of the reward.
    config = replace(QUICK, hidden=8, min_reward_r2=0.5)
    monkeypatch.setattr("ucfrec_control.training.screening.ScreeningConfig", lambda: config)
    store, run = tmp_path / "store", tmp_path / "run"
    control("prepare", write_screenable(tmp_path / "hopper.hdf5"), "--out", store)
    command = ("train", store, "--out", run, "--policy", "bc", "--screen", "copies")
    command += tuple(set_options(("train.steps=2", "policy.dim=8")))
    printed = control(*command)[0]
    screening = read_screening(RunRecord.read(run))
    assert 4 in screening.flagged
    said = ", ".join(map(str, screening.flagged))
    assert f"columns without effect: {said}\n" in printed
    control(*command)
    assert read_screening(RunRecord.read(run)) == screening
    report = tmp_path / "report.json"
    assert screening.describe() in control("screen", store, "--json", report)[0]
    recorded = read_json(run / "run.json")["extra"]["screening"]
    assert read_json(report).items() >= recorded.items()


@pytest.mark.slow
@pytest.mark.realdata
def test_the_distractor_is_flagged_and_no_true_dimension(tmp_path: Path) -> None:
    read = read_d4rl(data_folder("control") / "hopper_medium-zoo.hdf5")
    store = add_distractor(read.write_store(tmp_path / "clean"), tmp_path / "store")
    config = ScreeningConfig(hidden=128, shared_steps=700, own_steps=250, max_transitions=50_000)
    report = screen_states(training_views(store)[0], config, seed=0)
    assert report.flagged == (11,)
    assert store.record.columns[schema.OBSERVATION] == [12]
