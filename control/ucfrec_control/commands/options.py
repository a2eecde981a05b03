"""Options that several commands share, and their values."""

import argparse
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

from ucfrec.benchmark.cells import Budget, Cell
from ucfrec.benchmark.grid import Measurement
from ucfrec.commands.grid_options import budget_options, grid_options, rows_of
from ucfrec.errors import InputError, one_line
from ucfrec.results.rows import ResultRow
from ucfrec_control.benchmark.budgets import budget_of
from ucfrec_control.benchmark.methods import METHODS
from ucfrec_control.benchmark.plan import set_contexts
from ucfrec_control.data.d4rl import read_d4rl
from ucfrec_control.data.minari import is_minari, read_minari
from ucfrec_control.data.trajectories import Trajectories
from ucfrec_control.environments.environments import note_unknown
from ucfrec_control.environments.scores import find_task

BUDGETS: Final = {
    "small": "a quick look: policies have not learned all they can",
    "medium": "averaged weights, 10 times the windows; about 20 core hours for the main table",
    "full": "the steps, seeds and episodes of the papers",
}
"""What the budgets are, by name."""
MAX_RETURN = "max"
"""`--target` for the largest return that the policy expects in each state."""


def target_given(text: str) -> float | None:
    """The value of `--target`: a number, or None for `MAX_RETURN`.

    Raises:
        ArgumentTypeError: `text` is neither.
    """
    if text == MAX_RETURN:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text:.40} is no target; give a number or {MAX_RETURN}")
    return value


def source_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that name a dataset to read."""
    parser.add_argument(
        "source", metavar="SOURCE", help="HDF5 file, Minari identifier, or folder of one"
    )
    parser.add_argument("--env", help="environment of the data, if the file does not name it")
    parser.add_argument("--download", action="store_true", help="let Minari fetch the dataset")


def context_option(parser: argparse.ArgumentParser) -> None:
    """Add the option for the history of single methods."""
    parser.add_argument(
        "--context",
        dest="contexts",
        type=context_given,
        action="append",
        default=[],
        metavar="METHOD=STEPS",
        help="steps of history of a method; repeatable (default: the budget's)",
    )


def context_given(text: str) -> tuple[str, int]:
    """The value of `--context`.

    Raises:
        ArgumentTypeError: `text` is not METHOD=STEPS.
    """
    method, _, steps = text.partition("=")
    if method not in METHODS or not steps.isdecimal() or not 1 <= int(steps[:6]) <= 1000:
        raise argparse.ArgumentTypeError(f"{text:.40} is not METHOD=STEPS, as in ucf=8")
    return method, int(steps)


def data_option(parser: argparse.ArgumentParser) -> None:
    """Add the option for the folder of a benchmark's data."""
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="folder of the HDF5 files")


def data_given(options: argparse.Namespace) -> Path:
    """The folder of the HDF5 files.

    Raises:
        InputError: no folder is given.
    """
    if options.data is None:
        raise InputError(
            "name the folder of the HDF5 files with --data, or give --show-only for the rows that "
            "are there"
        )
    folder: Path = options.data
    return folder


def control_grid_options(parser: argparse.ArgumentParser, budget: bool = True) -> None:
    """Add the options for what a benchmark measures, and where it keeps its runs and rows."""
    if budget:
        budget_options(parser, "--file", "--seeds", BUDGETS)
    grid_options(parser, "runs/control", 1)


def rows_of_suite(
    options: argparse.Namespace,
    suite: str,
    how: Measurement[Cell],
    cells: Callable[..., Iterable[Cell]],
) -> list[ResultRow]:
    """The rows that a command shows, as `ucfrec.commands.grid_options.rows_of`.

    Args:
        cells: makes the cells of data, folder, budget and methods.
    """
    budget = narrow_budget(budget_of(suite, options.budget), options)

    def list_cells() -> Iterable[Cell]:
        return cells(data_given(options), options.out, budget, options.methods)

    return rows_of(options, suite, (), list_cells, how)


def read_source(options: argparse.Namespace) -> Trajectories:
    """Read the dataset that the options of `source_options` name.

    Raises:
        InputError: it is missing, damaged, of another format, or of other sizes than `--env` has.
    """
    if options.env is not None:
        note_unknown(options.env)
    if is_minari(options.source):
        return read_minari(options.source, options.env, options.download)
    return read_d4rl(Path(options.source), options.env)


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


def narrow_budget(budget: Budget, options: argparse.Namespace) -> Budget:
    """`budget` with the files, seeds and contexts of the options.

    Raises:
        InputError: `--seeds` is below 1.
    """
    budget = budget.narrowed(
        options.tasks, options.training_seeds, evaluation_seed=options.evaluation_seed
    )
    return set_contexts(budget, dict(options.contexts))
