"""Options that several commands share, and their values."""

import argparse
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from ucfrec.benchmark.cells import Budget, Cell
from ucfrec.commands.grid_options import budget_options, grid_options
from ucfrec.commands.options import option
from ucfrec.errors import InputError, one_line
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
    option(parser, "source", str, "HDF5 file, Minari identifier, or folder of one", "SOURCE")
    option(parser, "--env", str, "environment of the data, if the file does not name it")
    option(parser, "--download", False, "let Minari fetch the dataset")


def context_given(text: str) -> tuple[str, int]:
    """The value of `--context`.

    Raises:
        ArgumentTypeError: `text` is not METHOD=STEPS.
    """
    method, _, steps = text.partition("=")
    if method not in METHODS or not steps.isdecimal() or not 1 <= int(steps[:6]) <= 1000:
        raise argparse.ArgumentTypeError(f"{text:.40} is not METHOD=STEPS, as in ucf=8")
    return method, int(steps)


def control_grid_options(parser: argparse.ArgumentParser, whole: bool = True) -> None:
    """Add the options for what a benchmark measures, and where its data, runs and rows are.

    Args:
        whole: whether files, methods and the seed of the evaluation can be chosen.
    """
    option(parser, "--data", Path, "folder of the HDF5 files", "FOLDER")
    option(
        parser,
        "--context",
        context_given,
        "steps of history of a method; repeatable (default: the budget's)",
        "METHOD=STEPS",
        dest="contexts",
        action="append",
        default=[],
    )
    if whole:
        budget_options(parser, "--file", "--seeds", BUDGETS)
    else:
        option(parser, "--budget", list(BUDGETS), "(default: small)", default="small")
        text = "training seeds (default: set by --budget)"
        option(parser, "--seeds", int, text, "N", dest="training_seeds")
        parser.set_defaults(tasks=[], evaluation_seed=None)
    grid_options(parser, "runs/control", 1)


def list_cells(
    options: argparse.Namespace, budget: Budget, cells: Callable[[Path, Budget], Iterator[Cell]]
) -> Iterator[Cell]:
    """The cells of the folder of the data and of `budget` with the files, seeds and contexts of the
    options.

    Raises:
        InputError: no folder is given, or `--seeds` is below 1.
    """
    if options.data is None:
        raise InputError(
            "name the folder of the HDF5 files with --data, or give --show-only for the rows that "
            "are there"
        )
    seed = options.evaluation_seed
    narrow = budget.narrowed(options.tasks, options.training_seeds, evaluation_seed=seed)
    return cells(options.data, set_contexts(narrow, dict(options.contexts)))


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
