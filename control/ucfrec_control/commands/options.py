"""Options that several commands share, and their values."""

import argparse
import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from ucfrec.benchmark.cells import Budget, Cell, Measurement
from ucfrec.benchmark.grid import run_grid
from ucfrec.commands.benchmark import ROWS_REMEDY, GridOptions
from ucfrec.commands.options import ARGUMENT, POSITIVE, SEED, Table
from ucfrec.errors import InputError, damage_explained, one_line
from ucfrec.results.rows import ResultRow, benchmarking
from ucfrec_control.benchmark.budgets import budget_of
from ucfrec_control.benchmark.methods import METHODS
from ucfrec_control.benchmark.plan import set_contexts
from ucfrec_control.data.d4rl import read_d4rl
from ucfrec_control.data.minari import is_minari, read_minari
from ucfrec_control.data.trajectories import Trajectories
from ucfrec_control.environments.scores import find_task


def finite_number(text: str) -> float:
    """The number that `text` is. ArgumentTypeError if it is none, or not finite."""
    value = math.nan
    with suppress(ValueError):
        value = float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text:.40} is not a finite number")
    return value


def context_given(text: str) -> tuple[str, int]:
    """The value of `--context`. ArgumentTypeError if `text` is not METHOD=STEPS."""
    method, _, steps = text.partition("=")
    if method not in METHODS or not steps.isdecimal() or not 1 <= int(steps[:6]) <= 1000:
        raise argparse.ArgumentTypeError(f"{text:.40} is not METHOD=STEPS, as in ucf=8")
    return method, int(steps)


class SourceOptions(Table):
    """A dataset to read."""

    source: Annotated[str, ARGUMENT]
    """HDF5 file, Minari identifier, or folder of one."""
    env: str | None = None
    """Environment of the data, if the file does not name it."""
    download: bool = False
    """Let Minari fetch the dataset."""

    def read_source(self) -> Trajectories:
        """Read the dataset. InputError if it is missing, damaged, of another format, or of other
        sizes than `--env` has."""
        if is_minari(self.source):
            return read_minari(self.source, self.env, self.download)
        return read_d4rl(Path(self.source), self.env)


class ControlGridOptions(GridOptions):
    """The data of a benchmark, how much of it is measured, and where its rows are."""

    data: Path | None = None
    """Folder of the HDF5 files."""
    context: Annotated[Sequence[tuple[str, int]], context_given, "METHOD=STEPS"] = ()
    """Steps of history of a method; repeatable (default: the budget's)"""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Numbers of the policies' products; bfloat16 is for CPUs with avx512_bf16 or AMX, and GPUs"""
    budget: Literal["small", "medium", "full"] = "small"
    """small (a quick look: policies have not learned all they can), medium (averaged weights, 10
    times the windows, about 25 core hours for the main table), full (the steps, seeds and episodes
    of the papers)"""
    seeds: Annotated[int | None, POSITIVE] = None
    """Training seeds of every method, from 0 (default: set by --budget)"""
    out: Path = Path("runs/control")
    workers: Annotated[int, POSITIVE] = 1

    def require_data(self) -> Path:
        """The folder of the HDF5 files. InputError if no folder is given."""
        if self.data is None:
            raise InputError(
                "name the folder of the HDF5 files with --data, or give --show-only for the rows "
                "that are there"
            )
        return self.data

    def explain_rows(self) -> AbstractContextManager[None]:
        """For the block that prints rows: with --show-only, an `InputError` says what they lack.
        Rows that were just measured lack nothing: there an error is ours, and keeps its trace."""
        return damage_explained(self.rows_file, ROWS_REMEDY) if self.show_only else nullcontext()

    def measure(self, cells: Iterable[Cell], how: Measurement, describe: str) -> list[ResultRow]:
        """The rows of cells, which are measured where they have none."""
        return run_grid(cells, how, self.rows_file, self.workers, describe, self.again)

    def narrow_budget(
        self, budget: Budget, files: Sequence[str] = (), evaluation_seed: int | None = None
    ) -> Budget:
        """`budget` with the seeds, contexts and precision of the options."""
        budget = budget.narrow(files, self.seeds, evaluation_seed=evaluation_seed)
        if self.precision != "float32":
            precision = f"train.precision={self.precision}"
            budget = replace(budget, settings=(*budget.settings, precision))
        return set_contexts(budget, dict(self.context))


class SuiteOptions(ControlGridOptions):
    """Options that select what a suite measures."""

    file: Annotated[Sequence[str], "NAME"] = ()
    """Measure only this file; repeatable (default: all of the budget)"""
    method: Annotated[Sequence[str], "NAME"] = ()
    """Measure only this method; repeatable (default: all of the budget)"""
    evaluation_seed: Annotated[int | None, SEED, "SEED"] = None
    """Seed of the evaluated episodes, as of evaluate; the same for every training seed (default:
    set by --budget)"""

    def make_suite_rows(
        self,
        suite: str,
        table: str,
        how: Measurement,
        list_cells: Callable[[Path, Path, Budget, Sequence[str]], Iterable[Cell]],
        describe: str = "",
    ) -> list[ResultRow]:
        """The rows that a command shows: with --show-only those of the file, else those of cells.

        Args:
            table: the one that is measured and shown; "" for all of the suite.
            list_cells: lists the cells of data, folder, budget and methods.
            describe: name of the benchmark in progress output; "" for `suite`.
        """
        budget = budget_of(table or suite, self.budget)
        budget = self.narrow_budget(budget, self.file, self.evaluation_seed)
        if self.show_only:
            return self.read_rows(suite, [table] if table else [])
        with benchmarking(self.rows_file):
            cells = list_cells(self.require_data(), self.out, budget, self.method)
            return self.measure(cells, how, describe or suite)


def describe_source(trajectories: Trajectories) -> str:
    """A text with a dataset's size, mean return, score and dropped steps."""
    source, returns = trajectories.source, trajectories.returns
    task = find_task(source["env_id"] or source["dataset"])
    score = f", normalised {task.score(returns.mean()):.2f}" if task else ""
    dropped = [f"{count} {what.replace('_', ' ')}" for what, count in source["dropped"].items()]
    name, env_id = one_line(source["dataset"]), one_line(source["env_id"] or "unknown")
    return (
        f"{name}: {len(returns)} trajectories, {len(trajectories.rewards)} steps, environment "
        f"{env_id}\n"
        f"mean return {returns.mean():.3f}{score}; dropped: {', '.join(dropped)}"
    )
