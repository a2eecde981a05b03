"""What each command does with its options."""

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from ucfrec.collect import collect
from ucfrec.config import resolve_config
from ucfrec.demo import DemoConfig, demo
from ucfrec.errors import InputError
from ucfrec.evaluate import World, evaluate_behavior, evaluate_policy
from ucfrec.files import atomic_file, write_json
from ucfrec.logs.mapping import Dataset, LogMapping, columns_given, read_mapping
from ucfrec.logs.prepare import PrepareOptions, parse_split, prepare, read_histories, validate
from ucfrec.logs.report import format_report
from ucfrec.off_policy import judge_off_policy
from ucfrec.plugins import Benchmark, load_plugin
from ucfrec.recommend import LONGEST_HISTORY, Histories, recommend
from ucfrec.report import write_report
from ucfrec.results import format_rows
from ucfrec.run import describe_run, train_run
from ucfrec.score import logged_sessions, score
from ucfrec.store import EpisodeStore
from ucfrec.trained import TrainedPolicy


def run_demo(options: argparse.Namespace) -> None:
    """`ucfrec demo`."""
    rows = demo(options.out, options.seed, DemoConfig())
    print(format_rows(rows))
    print(f"\nreport: {options.out / 'report.html'}; rows, logs, stores and runs lie beside it")


def run_collect(options: argparse.Namespace) -> None:
    """`ucfrec collect`."""
    world = World(options.env, options.env_folder)
    simulator = world.simulator()
    if options.behavior not in simulator.behaviors:
        known = ", ".join(simulator.behaviors)
        raise InputError(f"{world.name} has no behavior {options.behavior!r}; it has {known}")
    env = simulator.make(256, world.folder)
    actor = simulator.behaviors[options.behavior](env, options.seed)
    played = collect(
        simulator,
        env,
        actor,
        options.sessions,
        options.seed,
        options.out,
        env_name=options.env,
        behavior=options.behavior,
    )
    print(
        f"{options.out}: {options.sessions} sessions, {int(played.lengths.sum())} steps, mean "
        f"return {played.returns.mean():.3f}; reward column {simulator.feedback}"
    )


def run_prepare(options: argparse.Namespace) -> None:
    """`ucfrec prepare`."""
    files, mapping = _logs(options)
    given = {
        "reward": options.reward,
        "session_by": options.session_by,
        "gap_minutes": options.gap_minutes,
        "split": options.split and parse_split(options.split),
    }
    prepared = PrepareOptions(**{name: value for name, value in given.items() if value is not None})
    if options.validate:
        print(format_report(validate(files, mapping, prepared)))
        return
    if options.out is None:
        raise InputError("name the store with --out, or only check with --validate")
    print(format_report(prepare(files, mapping, options.out, prepared)))
    print(f"\nstore: {options.out}")


def _logs(options: argparse.Namespace) -> tuple[tuple[Path, ...], LogMapping]:
    """Files and column mapping of a command that reads logs."""
    dataset: Dataset = load_plugin("datasets", options.dataset)
    given = LogMapping(columns_given(options.column))
    if options.mapping is not None:
        given = given.over(read_mapping(options.mapping))
    return dataset.resolve(options.logs, given)


def run_train(options: argparse.Namespace) -> None:
    """`ucfrec train`."""
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    config = resolve_config(options.policy, options.config, options.set, options.seed)
    record = train_run(EpisodeStore.open(options.store), options.out, config)
    print(describe_run(record))
    print(f"\nrun: {options.out}; TensorBoard reads it too")


def run_evaluate(options: argparse.Namespace) -> None:
    """`ucfrec evaluate`."""
    world = World(options.env, options.env_folder)
    if not options.runs and not options.behavior:
        raise InputError("name a run folder, or a built-in policy with --behavior")
    rows = []
    for run in options.runs:
        trained = TrainedPolicy.load(run, options.checkpoint)
        target = _target(options, trained)
        row = evaluate_policy(world, trained, trained.name, options.episodes, options.seed, target)
        rows.append(row | {"run": str(run), "checkpoint": options.checkpoint})
    rows += [
        evaluate_behavior(world, behavior, options.episodes, options.seed)
        for behavior in options.behavior
    ]
    print(format_rows(rows))
    if options.json is not None:
        write_json(options.json, rows)


def _target(options: argparse.Namespace, trained: TrainedPolicy) -> float:
    if options.target_return is not None:
        return float(options.target_return)
    return trained.target_return(options.target_quantile)


def run_recommend(options: argparse.Namespace) -> None:
    """`ucfrec recommend`."""
    files, mapping = _logs(options)
    trained = TrainedPolicy.load(options.run, options.checkpoint)
    read = read_histories(files, mapping, trained.record["reward"], LONGEST_HISTORY)
    frames = recommend(
        trained,
        map(Histories.from_batch, read),
        options.k,
        target_return=_target(options, trained),
        filter_seen=not options.keep_seen,
        skip_unknown=options.skip_unknown,
    )
    print(f"{options.out}: {_write_frames(options.out, frames):,} rows")


def _write_frames(out: Path, frames: Iterable[pd.DataFrame]) -> int:
    """Write frames as one Parquet file, atomically; returns the rows."""
    rows, writer = 0, None
    with atomic_file(out) as scratch:
        for frame in frames:
            table = pa.Table.from_pandas(frame, preserve_index=False)
            writer = writer or pq.ParquetWriter(scratch, table.schema)
            writer.write_table(table)
            rows += len(frame)
        if writer is not None:
            writer.close()
    return rows


def run_score(options: argparse.Namespace) -> None:
    """`ucfrec score`."""
    files, mapping = _logs(options)
    trained = TrainedPolicy.load(options.run, options.checkpoint)
    with logged_sessions(options.run, trained, files, mapping) as logged:
        print(format_report(logged.report))
        rows = _write_frames(options.out, score(trained, logged, _target(options, trained)))
    print(f"\n{options.out}: {rows:,} rows")


def run_ope(options: argparse.Namespace) -> None:
    """`ucfrec ope`."""
    files, mapping = _logs(options)
    trained = TrainedPolicy.load(options.run, options.checkpoint)
    with logged_sessions(options.run, trained, files, mapping) as logged:
        print(format_report(logged.report))
        judged = judge_off_policy(
            options.run,
            trained,
            logged,
            target_return=_target(options, trained),
            greedy=options.greedy,
            seed=options.seed,
        )
    rows = [row | {"checkpoint": options.checkpoint} for row in judged.rows]
    shown = ("estimator", "policy", "choice", "R_cum", "effective_sessions", "sessions")
    print(f"\n{format_rows(rows, shown)}")
    for warning in judged.warnings:
        print(f"warning: {warning}")
    if options.json is not None:
        write_json(options.json, rows)


def run_report(options: argparse.Namespace) -> None:
    """`ucfrec report`."""
    write_report(options.out, options.runs, options.results)
    print(f"report: {options.out}; open it in a browser")


def run_benchmark(options: argparse.Namespace) -> None:
    """`ucfrec benchmark`."""
    suite: Benchmark = load_plugin("benchmarks", options.suite)
    results = options.results or Path("benchmarks/results") / f"{options.suite}.jsonl"
    tables = options.table or suite.tables
    print(suite.run(options.budget, tables, options.out, results, options.workers))
    print(f"\nrows: {results}")


COMMANDS: dict[str, Callable[[argparse.Namespace], Any]] = {
    "demo": run_demo,
    "collect": run_collect,
    "prepare": run_prepare,
    "train": run_train,
    "evaluate": run_evaluate,
    "recommend": run_recommend,
    "score": run_score,
    "ope": run_ope,
    "report": run_report,
    "benchmark": run_benchmark,
}
