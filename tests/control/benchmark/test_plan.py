"""Every table's cells are what their names say, and %BC goes through the benchmark."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from tests.support.control_files import MADE, hopper_like, write_hdf5, write_made
from ucfrec.acting.decision import DecisionRule
from ucfrec.benchmark.cells import Budget, Evaluation
from ucfrec.benchmark.grid import run_grid
from ucfrec.errors import InputError
from ucfrec.results.rows import read_rows
from ucfrec.runs.config import Config, resolve_config
from ucfrec_control.benchmark import plan
from ucfrec_control.benchmark.budgets import BUDGETS, budget_of
from ucfrec_control.benchmark.measure import SCORE_MEASUREMENT
from ucfrec_control.benchmark.methods import EQUAL_TIME, MAIN, METHODS, PAPER, PURSUING, TABLES
from ucfrec_control.benchmark.plan import chosen_rates, score_cells, settings_of
from ucfrec_control.commands.options import ControlGridOptions
from ucfrec_control.data.distractor import zoo_store
from ucfrec_control.environments.scores import find_kind, find_task
from ucfrec_control.training.evaluate import load_run
from ucfrec_control.training.rl_baselines import ALGORITHMS
from ucfrec_control.training.train import find_preset


def resolved(table: str, budget: Budget, file: str) -> dict[str, Config]:
    """Configuration of every row of a table that the core trains."""
    task, kind, configs = find_task(file).name, find_kind(file), {}
    for name, method in TABLES[table].items():
        if method.policy not in ALGORITHMS:
            presets = find_preset(task, kind, method.policy).tables
            settings = settings_of(budget, name, method)
            configs[name] = resolve_config(method.policy, None, settings, 0, presets)
    return configs


@pytest.mark.parametrize("size", BUDGETS)
def test_every_row_of_a_table_is_a_configuration_of_its_own(size: str) -> None:
    """The same in all tables, which share its runs."""
    for file in {file for table in TABLES for file in budget_of(table, size).tasks}:
        named: dict[str, Config] = {}
        for table in TABLES:
            budget = budget_of(table, size)
            configs = resolved(table, budget, file) if file in budget.tasks else {}
            assert len(set(map(repr, configs.values()))) == len(configs)
            for method, config in configs.items():
                assert config.train.warmup_steps < config.train.steps
                assert named.setdefault(method, config) == config


def test_rows_have_the_settings_that_they_are_named_after() -> None:
    file = budget_of("gate", "full").tasks[0]
    rows = {table: resolved(table, budget_of(table, "full"), file) for table in TABLES}
    paper = {table: [configs.pop(name) for name in PAPER] for table, configs in rows.items()}
    for name, config in rows["lambda"].items():
        assert config.policy.lambda_mask == float(name.rpartition("-")[2])
    for table in ("gate", "band"):
        for name, config in rows[table].items():
            assert config.csg.kind == ("faithful" if name.startswith("ucf-paper") else "tangent")
            assert (config.augment.epsilon_r == 1e9) == name.endswith("wo-gate")
            assert (config.augment.copies == 0) == name.endswith("wo-count")
            assert (config.csg.band[0] == 0) == name.endswith("wo-lower")
            assert (config.csg.lambda_band == 0) == name.endswith("wo-band")
            assert (config.augment.edits_per_copy == 1) == ("algorithm-5" in name)
    for configs in paper.values():
        assert [config.augment.edits_per_copy for config in configs] == [0, 1]
        assert {(c.crm.learning_rate, c.crm.epochs) for c in configs} == {(3e-4, 40)}  # Table 4
    ablated, of_paper = (rows[MAIN][f"{name}-wo-arch"] for name in ("ucf", "ucf-paper"))
    assert (ablated.policy_name, ablated.augment.copies > 0) == ("dt", True)
    (whole, _), without = paper[MAIN], rows[MAIN]["ucf-paper-wo-count"]
    assert of_paper.policy == rows[MAIN]["dt"].policy
    assert (of_paper.crm, of_paper.csg, of_paper.augment) == (whole.crm, whole.csg, whole.augment)
    assert replace(without, augment=whole.augment) == whole
    steps = {name: config.train.steps for name, config in rows[EQUAL_TIME].items()}
    assert steps["bc-25-x8"] == 8 * steps["dt-wo-time"] == 8 * steps["lsdt-wo-time"]
    assert 2 * steps["ucf-x3"] == 3 * steps["ucf-wo-count-x2"] == 6 * steps["dc-wo-time"]
    pursuing = rows[PURSUING] | rows[EQUAL_TIME]
    for name in (name for name in pursuing if not name.startswith("bc")):
        config, policy = pursuing[name], pursuing[name].policy
        assert policy.max_timestep == 1
        assert policy.best_share == (0.25 if "-best-25" in name else 1.0)
        assert (config.augment.copies > 0) == (name.startswith("ucf") and "-wo-count" not in name)


@pytest.mark.parametrize("size", BUDGETS)
def test_a_budget_shortens_the_papers_training_and_changes_nothing_else(size: str) -> None:
    for file in budget_of(MAIN, size).tasks:
        presets = find_preset(find_task(file).name, find_kind(file), "ucf-paper").tables
        preset = resolve_config("ucf-paper", presets=presets)
        config = resolved(MAIN, budget_of(MAIN, size), file)["ucf-paper"]
        share = config.train.steps / preset.train.steps
        assert config.train.warmup_steps == preset.train.warmup_steps * share
        lengths = ("steps", "warmup_steps", "validate_every")
        own = {name: getattr(preset.train, name) for name in lengths}
        assert replace(config, train=replace(config.train, **own)) == preset


def test_methods_have_the_context_and_the_precision_that_are_asked_for(tmp_path: Path) -> None:
    write_made(tmp_path)
    medium = replace(budget_of(MAIN, "medium"), tasks=(MADE,), tasks_of={})
    options = ControlGridOptions(context=[("dc-wo-time", 20)], precision="bfloat16")
    budget = options.narrow_budget(medium)
    cells = [*score_cells(tmp_path, tmp_path / "out", budget, MAIN)]
    assert {cell.config.train.precision for cell in cells} == {"bfloat16"}
    contexts = {cell.method: cell.config.policy.context for cell in cells}
    assert contexts.pop("dc-wo-time") == 20
    assert {contexts[name] for name in ("ucf", "dt-wo-time")} == {8}


@pytest.mark.parametrize("table", TABLES)
def test_a_row_has_the_rate_of_its_policy(table: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rates = {name: float(number) for number, name in enumerate(chosen_rates("small"), start=1)}
    monkeypatch.setattr(plan, "chosen_rates", lambda budget: rates)
    for name, method in TABLES[table].items():
        if name.startswith("ucf-paper"):
            continue  # the paper's own
        settings = settings_of(BUDGETS["full"], name, method)
        searched = next(name for name in rates if name.partition("-wo-time")[0] == method.policy)
        own = "" if method.policy in ALGORITHMS else "train."
        assert f"{own}learning_rate={rates[searched]:g}" in settings, name


@pytest.mark.slow
def test_the_best_trajectories_are_cloned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Good trajectories act one way and the others the other way: who clones which is seen."""
    columns = hopper_like((30, 8, 25, 20) * 10)
    ends = np.flatnonzero(columns["terminals"] | columns["timeouts"])
    lengths = np.diff(ends, prepend=-1)
    good = np.arange(len(lengths)) % 5 == 0
    columns["rewards"][:] = np.repeat(np.where(good, 5.0, 1.0) / lengths, lengths)
    columns["actions"][:] = np.repeat(np.where(good, 0.8, -0.8), lengths)[:, None]
    write_hdf5(tmp_path / f"{MADE}.hdf5", columns)
    rows = {m: METHODS[m] for m in ("bc", "bc-10", "bc-25")}
    monkeypatch.setitem(TABLES, MAIN, rows)
    settings = ("train.steps=50", "train.warmup_steps=5", "train.learning_rate=1e-2")
    settings += ("train.validate_every=25", "policy.dim=16")
    budget = Budget("tiny", (MADE,), 2, Evaluation(2, 1000), settings)
    cells = list(score_cells(tmp_path, tmp_path / "runs", budget, MAIN))
    run_grid(cells, SCORE_MEASUREMENT, tmp_path / "rows.jsonl", 1)
    keys = [(r.training_seed, r.method, r.checkpoint) for r in read_rows(tmp_path / "rows.jsonl")]
    assert keys == list(product(range(2), rows, ("last", "best")))
    seen = np.random.default_rng(0).normal(size=(20, 11)).astype(np.float32)
    chosen = {}
    for cell in (cell for cell in cells if cell.training_seed == 0):
        actor = load_run(cell.run, "last").actor(len(seen), DecisionRule(1.0))
        actor.begin(np.arange(len(seen)))
        chosen[cell.method] = actor.act(seen, np.ones(len(seen), dtype=bool))[0].mean()
    # One in five is good: all of the best 10%, four fifths of the best 25%.
    assert chosen["bc"] < -0.2 < 0.2 < chosen["bc-25"] < chosen["bc-10"]


def test_a_store_of_other_data_of_the_same_name_is_refused(tmp_path: Path) -> None:
    stores = tmp_path / "stores"
    for folder, seed in (("first", 0), ("moved", 0), ("other", 1)):
        (tmp_path / folder).mkdir()
        write_hdf5(tmp_path / folder / f"{MADE}.hdf5", hopper_like((30, 8) * 8, seed))
    made = zoo_store(tmp_path / "first", stores, MADE)
    # Rows may be made again where the store is left of the data.
    for folder in ("moved", "gone"):
        assert zoo_store(tmp_path / folder, stores, MADE) == made
    write_made(tmp_path / "first")
    for folder in ("other", "first"):
        with pytest.raises(InputError, match="made from other data"):
            zoo_store(tmp_path / folder, stores, MADE)
