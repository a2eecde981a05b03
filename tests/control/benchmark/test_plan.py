"""Every table's cells are what their names say, and %BC goes through the benchmark."""

import sys
from dataclasses import replace
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from types import FrameType

import numpy as np
import pytest

from tests.support.control_files import hopper_like, write_hdf5
from ucfrec.acting.decision import DecisionRule
from ucfrec.errors import InputError
from ucfrec.runs.config import Config, resolve_config
from ucfrec_control.benchmark import robustness
from ucfrec_control.benchmark.budgets import BUDGETS, SWEEPS, Budget
from ucfrec_control.benchmark.cells import (
    OF_ITEMS,
    ROBUSTNESS,
    code_of,
    key,
    measure_robustness,
    measure_scores,
)
from ucfrec_control.benchmark.folders import run_name
from ucfrec_control.benchmark.methods import EQUAL_TIME, MAIN, METHODS, PAPER, PURSUING, TABLES
from ucfrec_control.benchmark.plan import benchmark, cells_of
from ucfrec_control.benchmark.rates import settings_of
from ucfrec_control.commands.benchmark import budgets_of
from ucfrec_control.data.distractor import zoo_store
from ucfrec_control.environments.scores import find_kind, require_task
from ucfrec_control.training.evaluate import load_run
from ucfrec_control.training.rl_baselines import ALGORITHMS
from ucfrec_control.training.train import find_preset


def resolved(table: str, budget: Budget, file: str) -> dict[str, Config]:
    """Configuration of every row of a table that the core trains."""
    task, kind = require_task(file).name, find_kind(file)
    return {
        method: resolve_config(
            learner,
            None,
            settings_of(budget, "small", learner, (*own, *budget.of_methods.get(method, ()))),
            0,
            find_preset(task, kind, learner).tables,
        )
        for method, (learner, own) in TABLES[table].items()
        if learner not in ALGORITHMS
    }


@pytest.mark.parametrize("size", ["small", "full"])
@pytest.mark.parametrize("table", TABLES)
def test_every_row_of_every_table_is_a_configuration_of_its_own(table: str, size: str) -> None:
    budget = budgets_of(table)[size]
    for file in budget.files:
        configs = resolved(table, budget, file)
        assert len(set(map(repr, configs.values()))) == len(configs)
        for config in configs.values():
            assert config.train.warmup_steps < config.train.steps


def test_rows_have_the_settings_that_they_are_named_after() -> None:
    budget = SWEEPS["full"]
    file = budget.files[0]
    for name, config in resolved("lambda", budget, file).items():
        if name in PAPER:
            continue
        assert config.policy.lambda_mask == float(name.removeprefix("ucf-lambda-"))
    for table in ("gate", "band", "augmentation"):
        for name, config in resolved(table, budget, file).items():
            if name in PAPER:
                continue
            kind = next((k for k in ("faithful", "noise") if name.startswith(k)), "tangent")
            assert config.csg.kind == kind
            assert (config.augment.epsilon_r == 1e9) == name.endswith("wo-gate")
            assert (config.augment.copies == 0) == name.endswith("wo-count")
            assert (config.csg.band[0] == 0) == name.endswith("wo-lower")
            assert (config.csg.lambda_band == 0) == name.endswith("wo-band")
            assert (config.augment.edits_per_copy == 1) == ("algorithm-5" in name)
    for table in TABLES:
        paper = [resolved(table, budgets_of(table)["full"], file)[name] for name in PAPER]
        assert [config.policy_name for config in paper] == ["ucf-paper", "ucf-paper"]
        assert [config.augment.edits_per_copy for config in paper] == [0, 1]
        assert {(c.crm.learning_rate, c.crm.epochs) for c in paper} == {(3e-4, 40)}  # Table 4
    main = resolved(MAIN, BUDGETS["full"], file)
    assert (main["ucf"].augment.copies > 0, main["dt"].augment.copies) == (True, 0)
    assert main["ucf-wo-arch"].policy_name == "dt"
    assert main["ucf-wo-arch"].augment.copies > 0
    for size in ("small", "full"):
        timed = resolved(EQUAL_TIME, BUDGETS[size], file)
        steps = {name: config.train.steps for name, config in timed.items()}
        assert steps["bc-25-x8"] == 8 * steps["dt-wo-time"] == 8 * steps["lsdt-wo-time"]
        assert 2 * steps["ucf-x3"] == 3 * steps["ucf-wo-count-x2"] == 6 * steps["dc-wo-time"]
    pursuing = resolved(PURSUING, BUDGETS["full"], file)
    for name, config in (pursuing | resolved(EQUAL_TIME, BUDGETS["full"], file)).items():
        if name in PAPER or name.startswith("bc"):
            continue
        policy = config.policy
        assert policy.max_timestep == 1
        assert policy.best_share == (0.25 if "-best-25" in name else 1.0)
        assert policy.advantage_weights == name.endswith(("-weights", "-both"))
        assert policy.max_return == name.endswith(("-max-return", "-both"))
        assert (config.augment.copies > 0) == (name.startswith("ucf") and "-wo-count" not in name)
    assert [main[m].policy.best_share for m in ("bc", "bc-10", "bc-25")] == [1.0, 0.1, 0.25]


@pytest.mark.parametrize("size", ["small", "full"])
def test_a_method_of_two_tables_is_one_configuration(size: str) -> None:
    """They share their runs."""
    for file in SWEEPS[size].files:
        named: dict[str, Config] = {}
        for table in TABLES:
            for method, config in resolved(table, budgets_of(table)[size], file).items():
                assert named.setdefault(method, config) == config


def test_seeds_are_fewer_for_some_methods_and_for_antmaze() -> None:
    small, full = BUDGETS["small"], BUDGETS["full"]
    files = ("hopper_medium-zoo", "antmaze-umaze-v2")
    assert small.fewer_seeds.keys() <= METHODS.keys()
    assert [small.seeds_of(file, "cql") for file in files] == [1, 1]
    assert [small.seeds_of(files[0], f"dt{time}") for time in ("", "-wo-time")] == [1, 4]
    assert [small.seeds_of(file, "ucf") for file in files] == [4, 4]
    assert [full.seeds_of(file, "cql") for file in files] == [5, 4]


def test_robustness_trains_rows_of_the_benchmark() -> None:
    learners = {"ucf" if m in robustness.SCREENED else m for m in robustness.METHODS}
    assert learners <= METHODS.keys()
    for budget in robustness.BUDGETS.values():
        for file in budget.files:
            assert learners <= resolved(MAIN, budget, file).keys()


@pytest.mark.slow
def test_the_best_trajectories_are_cloned_and_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Good trajectories act one way and the others the other way: who clones which is seen."""
    columns = hopper_like((30, 8, 25, 20) * 10)
    ends = np.flatnonzero(columns["terminals"] | columns["timeouts"])
    lengths = np.diff(ends, prepend=-1)
    good = np.arange(len(lengths)) % 5 == 0
    columns["rewards"][:] = np.repeat(np.where(good, 5.0, 1.0) / lengths, lengths)
    columns["actions"][:] = np.repeat(np.where(good, 0.8, -0.8), lengths)[:, None]
    write_hdf5(tmp_path / "hopper_medium-made.hdf5", columns)
    rows = {m: METHODS[m] for m in ("bc", "bc-10", "bc-25")}
    monkeypatch.setitem(TABLES, MAIN, rows)
    settings = ("train.steps=50", "train.warmup_steps=5", "train.learning_rate=1e-2")
    settings += ("train.validate_every=25", "policy.dim=16")
    budget = Budget(("hopper_medium-made",), 2, 2, settings)
    results = tmp_path / "rows.jsonl"
    found = benchmark(tmp_path, tmp_path / "runs", results, budget, "tiny", 1)
    checkpoints = ("last", "best")
    assert [(row.training_seed, row.method, row.checkpoint) for row in found] == list(
        product(range(2), rows, checkpoints)
    )
    assert "benchmark main: 6 cells, 6 of them left to measure" in capfd.readouterr().err
    seen = np.random.default_rng(0).normal(size=(20, 11)).astype(np.float32)
    chosen = {}
    for method in rows:
        runs = tmp_path / "runs" / "tiny" / "hopper_medium-made"
        run = runs / run_name(method, code_of(METHODS[method][0]), 0)
        actor = load_run(run, "last").actor(len(seen), DecisionRule(1.0))
        actor.begin(np.arange(len(seen)))
        chosen[method] = actor.act(seen, np.ones(len(seen), dtype=bool))[0].mean()
    # One in five is good: all of the best 10%, four fifths of the best 25%.
    assert chosen["bc"] < -0.2 < 0.2 < chosen["bc-25"] < chosen["bc-10"]


IMPORTED_BY_THEM_ALONE = (
    *("ucfrec.acting.sessions", "ucfrec.episodes.group_auc", "ucfrec.processes"),
)
"""Modules that `code_version` leaves out together with `OF_ITEMS`."""


@pytest.mark.slow
@pytest.mark.parametrize("table", [MAIN, ROBUSTNESS])
def test_no_cell_runs_code_of_items(table: str, tmp_path: Path) -> None:
    """Rows stay valid when that code changes, so they must not depend on it."""
    write_hdf5(tmp_path / "hopper_medium-zoo.hdf5", hopper_like((30, 8, 25) * 8))
    settings = ("train.steps=2", "train.warmup_steps=1", "train.validate_every=2", "crm.epochs=1")
    small = replace(BUDGETS["small"], files=("hopper_medium-zoo",), seeds=1, episodes=1)
    budget = replace(small, settings=(*small.settings, *settings, "csg.epochs=1"))
    given = tmp_path, tmp_path / "runs", budget, "small"
    if table == MAIN:
        (cell,) = cells_of(*given, MAIN, ["ucf"])
    else:
        (cell,) = robustness.robustness_cells(*given, ["ucf"], ["deterministic"])
    called: set[str] = set()

    def remember(frame: FrameType, event: str, argument: object) -> None:
        if frame.f_code.co_name != "<module>":
            called.add(frame.f_code.co_filename)

    measure = measure_scores if table == MAIN else measure_robustness
    before = sys.gettrace()
    sys.settrace(remember)
    try:
        measure(cell, key(cell))
    finally:
        sys.settrace(before)
    assert str(source_of("ucfrec.policies.ucf")) in called
    left_out = (*OF_ITEMS, *IMPORTED_BY_THEM_ALONE)
    assert [name for name in left_out if str(source_of(name)) in called] == []


def source_of(module: str) -> Path:
    spec = find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin)


def test_cells_of_one_learner_run_through_the_same_code() -> None:
    codes = {learner: code_of(learner) for learner in ("ucf", "dt", "iql", "cql")}
    assert codes["ucf"] != codes["dt"]
    assert codes["iql"] == codes["cql"] != codes["dt"]


def test_a_store_of_other_data_of_the_same_name_is_refused(tmp_path: Path) -> None:
    stores = tmp_path / "stores"
    for folder, seed in (("first", 0), ("moved", 0), ("other", 1)):
        (tmp_path / folder).mkdir()
        write_hdf5(tmp_path / folder / "hopper_medium-made.hdf5", hopper_like((30, 8) * 8, seed))
    made = zoo_store(tmp_path / "first", stores, "hopper_medium-made")
    assert zoo_store(tmp_path / "moved", stores, "hopper_medium-made") == made
    with pytest.raises(InputError, match="made from other data"):
        zoo_store(tmp_path / "other", stores, "hopper_medium-made")
    # Rows may be made again where the store is left of the data.
    assert zoo_store(tmp_path / "gone", stores, "hopper_medium-made") == made
    write_hdf5(tmp_path / "first" / "hopper_medium-made.hdf5", hopper_like((30, 8) * 8, 1))
    with pytest.raises(InputError, match="made from other data"):
        zoo_store(tmp_path / "first", stores, "hopper_medium-made")
