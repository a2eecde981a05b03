"""What each command does with its options."""

import argparse
import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from ucfrec.cli import Commands
from ucfrec.config import resolve_config
from ucfrec.errors import InputError
from ucfrec.files import write_json
from ucfrec.results import format_rows, provenance
from ucfrec.run import describe_run
from ucfrec.store import EpisodeStore
from ucfrec_control.benchmark import BUDGETS, MAIN, SWEEPS, Budget, benchmark
from ucfrec_control.collect import SHOWN as COLLECTED
from ucfrec_control.collect import CollectConfig, collect
from ucfrec_control.d4rl import read_d4rl, write_d4rl
from ucfrec_control.distractor import add_distractor
from ucfrec_control.evaluate import CHECKPOINTS, SHOWN, evaluate_run
from ucfrec_control.minari import is_minari, read_minari, write_minari
from ucfrec_control.robustness import BUDGETS as ROBUSTNESS_BUDGETS
from ucfrec_control.robustness import SHOWN as SHOWN_DROPS
from ucfrec_control.robustness import SHOWN_LOSSES, drops, loss_rises, robustness
from ucfrec_control.scores import find_task
from ucfrec_control.screening import ScreeningConfig, describe_screening, screen
from ucfrec_control.screening_table import SHOWN as SHOWN_SCREENING
from ucfrec_control.screening_table import screening_rows, screening_table
from ucfrec_control.tables import against_first, over_seeds, score_table
from ucfrec_control.train import SCREENINGS, dataset_of, preset_of, train_control
from ucfrec_control.trajectories import PACKAGES, Trajectories
from ucfrec_control.video import record_episode


def run_prepare(options: argparse.Namespace) -> None:
    """`ucfrec-control prepare`."""
    trajectories = _read(options)
    trajectories.write_store(options.out)
    print(f"{_describe(trajectories)}\n\nstore: {options.out}")


def run_collect(options: argparse.Namespace) -> None:
    """`ucfrec-control collect`."""
    config = CollectConfig(
        steps=options.steps, every=options.every, fraction=options.fraction, size=options.size
    )
    rows = collect(options.env, options.out, options.seed, config)
    print(format_rows(rows, COLLECTED))
    print(f"\nfiles: {options.out}")


def run_convert(options: argparse.Namespace) -> None:
    """`ucfrec-control convert`."""
    trajectories = _read(options)
    if options.target.endswith((".hdf5", ".h5")):
        written = Path(options.target)
        if written.exists():
            raise InputError(f"{written} exists already; remove it or name another file")
        write_d4rl(trajectories, written)
    else:
        written = write_minari(trajectories, options.target)
    print(f"{_describe(trajectories)}\n\nwritten: {written}")


def _read(options: argparse.Namespace) -> Trajectories:
    if is_minari(options.source):
        return read_minari(options.source, options.env, options.download)
    return read_d4rl(Path(options.source), options.env)


def _describe(trajectories: Trajectories) -> str:
    source, returns = trajectories.source, trajectories.returns
    task = find_task(source["env_id"], source["dataset"])
    score = f", normalised {task.score(returns.mean()):.2f}" if task else ""
    dropped = [f"{count} {what.replace('_', ' ')}" for what, count in source["dropped"].items()]
    return (
        f"{source['dataset']}: {len(returns)} trajectories, {len(trajectories.rewards)} steps, "
        f"environment {source['env_id'] or 'unknown'}\n"
        f"mean return {returns.mean():.3f}{score}; dropped: {', '.join(dropped)}"
    )


def run_distract(options: argparse.Namespace) -> None:
    """`ucfrec-control distract`."""
    store = EpisodeStore.open(options.store)
    add_distractor(store, options.out, options.flip, options.seed, options.early)
    print(f"store: {options.out}; dimension {store.observation_size} is the distractor")


def run_screen(options: argparse.Namespace) -> None:
    """`ucfrec-control screen`."""
    report = screen(EpisodeStore.open(options.store), ScreeningConfig(), options.seed)
    print(describe_screening(report))
    if options.json is not None:
        write_json(options.json, dataclasses.asdict(report) | provenance(PACKAGES))


def run_screen_all(options: argparse.Namespace) -> None:
    """`ucfrec-control screen-all`."""
    rows = screening_table(options.data, options.out, options.results, options.workers)
    print(f"{format_rows(screening_rows(rows), SHOWN_SCREENING)}\n\nrows: {options.results}")


def run_train(options: argparse.Namespace) -> None:
    """`ucfrec-control train`."""
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    store = EpisodeStore.open(options.store)
    preset = preset_of(dataset_of(store), options.policy)
    config = resolve_config(
        options.policy, options.config, options.set, options.seed, preset.tables
    )
    record = train_control(store, options.out, config, screening=options.screen)
    print(describe_run(record))
    if options.screen:
        found = ", ".join(map(str, record["dataset"][SCREENINGS[options.screen]])) or "none"
        print(f"screening     dimensions that cause nothing: {found}")
    print(f"\nrun: {options.out}; TensorBoard reads it too")


def run_evaluate(options: argparse.Namespace) -> None:
    """`ucfrec-control evaluate`."""
    if options.video is not None:
        _record(options)
    rows: list[dict[str, Any]] = []
    for run in options.runs:
        rows += evaluate_run(
            run,
            episodes=options.episodes,
            seed=options.seed,
            env_id=options.env,
            targets=options.target,
            checkpoints=CHECKPOINTS if options.checkpoint == "both" else (options.checkpoint,),
            distractor=options.distractor,
        )
    print(format_rows([_shown(row) for row in rows], SHOWN))
    for warning in dict.fromkeys(text for row in rows for text in row["warnings"]):
        print(f"warning: {warning}", file=sys.stderr)
    if options.json is not None:
        write_json(options.json, [row | provenance(PACKAGES) for row in rows])


def _record(options: argparse.Namespace) -> None:
    if len(options.runs) != 1:
        raise InputError(f"--video shows one run; {len(options.runs)} were given")
    earned = record_episode(
        options.runs[0],
        options.video,
        seed=options.seed,
        checkpoint="best" if options.checkpoint == "best" else "last",
        env_id=options.env,
        target=next(iter(options.target), None),
        distractor=options.distractor,
    )
    print(f"{options.video}: an episode of return {earned:.1f}\n")


def run_benchmark(options: argparse.Namespace) -> None:
    """`ucfrec-control benchmark`."""
    rows = benchmark(
        options.data,
        options.out,
        options.results,
        _budget(BUDGETS if options.table == MAIN else SWEEPS, options),
        options.budget,
        options.workers,
        options.table,
        options.method,
    )
    print(format_rows([_shown(row) for row in rows], SHOWN))
    for checkpoint in CHECKPOINTS:
        table = score_table(rows, checkpoint)
        print(f"\nscores of the {checkpoint} checkpoint, mean ± standard deviation over seeds")
        print(format_rows(table, list(table[0])))
    last = [row for row in rows if row["checkpoint"] == "last"]
    by, values = ("dataset", "method"), ("score", "validation_loss")
    shown = (*values, "acceptance")
    print("\nlast checkpoint, mean ± standard deviation over seeds")
    print(format_rows(over_seeds(last, by, shown), (*by, *shown)))
    if options.table != MAIN:
        print(f"\nless {last[0]['method']} of the same seed, mean ± standard error")
        print(format_rows(against_first(last, values), (*by, *values)))
    print(f"\nrows: {options.results}")


def _budget(known: Mapping[str, Budget], options: argparse.Namespace) -> Budget:
    """The budget asked for, with the files and seeds asked for."""
    budget = known[options.budget]
    seeds = budget.seeds if options.seeds is None else options.seeds
    if seeds < 1:
        raise InputError(f"--seeds is {seeds}; at least one is needed")
    return dataclasses.replace(budget, files=tuple(options.file) or budget.files, seeds=seeds)


def run_robustness(options: argparse.Namespace) -> None:
    """`ucfrec-control robustness`."""
    rows = robustness(
        options.data,
        options.out,
        options.results,
        _budget(ROBUSTNESS_BUDGETS, options),
        options.budget,
        options.workers,
        options.method,
    )
    by = ("dataset", "distractor", "method")
    for found, values in ((drops(rows), SHOWN_DROPS), (loss_rises(rows), SHOWN_LOSSES)):
        print(f"{format_rows(over_seeds(found, by, values), (*by, *values))}\n")
    print(f"{format_rows(screening_rows(rows), SHOWN_SCREENING)}\n\nrows: {options.results}")


def run_figures(options: argparse.Namespace) -> None:
    """`ucfrec-control figures`."""
    from ucfrec_control.figures import make_figures  # matplotlib takes half a second to import

    made, missing = make_figures(options.runs, options.results, options.out)
    print("\n".join(map(str, made)))
    for what in missing:
        print(f"missing: {what}", file=sys.stderr)


def _shown(row: Mapping[str, Any]) -> dict[str, Any]:
    interval = f"{row['score']:.1f} [{row['score_low']:.1f}, {row['score_high']:.1f}]"
    asked = "none" if row["target_return"] is None else f"{row['target_return']:g}"
    earned = f"{row['return']:.1f}"
    return {**row, "score": interval, "target_return": asked, "return": earned}


COMMANDS: Commands = {
    "prepare": run_prepare,
    "collect": run_collect,
    "convert": run_convert,
    "distract": run_distract,
    "screen": run_screen,
    "screen-all": run_screen_all,
    "train": run_train,
    "evaluate": run_evaluate,
    "benchmark": run_benchmark,
    "robustness": run_robustness,
    "figures": run_figures,
}
