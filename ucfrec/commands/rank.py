"""`ucfrec rank`: measure how well policies rank items that users were shown and clicked later."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from ucfrec import schema
from ucfrec.commands.options import log_options, logs_given, target_given, target_options
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.evaluation.ranking import MEASURES, Period, compare, rank_steps, rankers_named
from ucfrec.evaluation.ranking_baselines import PolicyRanker, baselines
from ucfrec.files import write_json
from ucfrec.logs.summary import format_report
from ucfrec.off_policy.score import logged_sessions
from ucfrec.provenance import provenance
from ucfrec.reporting.tables import format_rows
from ucfrec.runs.trained_policy import RUN, TrainedPolicy

_SHOWN = ("hit_rate_shown", "hit_rate_liked", "ndcg_liked", "recall_liked", "gauc", "item_rate")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec rank`."""
    log_options(parser)
    parser.add_argument(
        "--k", type=int, default=10, help="items recommended at each step (default: 10)"
    )
    target_options(parser)
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="seed of the bootstrap over users and of the random baseline (default: 0)",
    )
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="also write the rows, with intervals, as JSON"
    )
    parser.usage = "%(prog)s RUN... [LOGS...] [options]"
    parser.epilog = "Without LOGS, the policies rank the test split of the store of the first run."


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec rank` and print one row per policy.

    Raises:
        InputError: a run or log cannot be used, the runs have different stores, or there is no
            test split to rank.
    """
    runs = [Path(path) for path in options.logs if (Path(path) / RUN).is_file()]
    options.logs = [path for path in options.logs if Path(path) not in runs]
    if not runs:
        raise InputError("no run is named; give run folders of `ucfrec train`, then the logs")
    if options.k < 1:
        raise InputError(f"--k is {options.k}; recommend at least 1 item")
    trained = [TrainedPolicy.load(run, options.checkpoint) for run in runs]
    _require_one_catalogue(runs, trained)
    train = _training_store(trained[0])
    if options.logs:
        files, mapping = logs_given(options)
        with logged_sessions(runs[0], trained[0], files, mapping) as logged:
            print(format_report(logged.report), end="\n\n")
            rows = _rows(options, runs, trained, train, logged.store, logged.users)
    else:
        if train is None:
            raise InputError(
                f"{runs[0]}: its store {trained[0].record['store']} is missing or has changed; "
                "name the logs to rank"
            )
        test = train.split("test")
        if not test.n_episodes:
            raise InputError(f"{train.path} has no test split; name later logs to rank")
        users = test.episode_values(schema.USER)
        rows = _rows(options, runs, trained, train, test, users)
    print(format_rows(rows, ("policy", *_SHOWN, "coverage")))
    print(f"\n{_legend(options.k)}")
    if options.json is not None:
        write_json(options.json, rows)


def _require_one_catalogue(runs: list[Path], trained: list[TrainedPolicy]) -> None:
    for run, policy in zip(runs, trained, strict=True):
        if policy.item_states is None:
            raise InputError(
                f"{run}: the actions of this policy are vectors; rank needs a policy over items"
            )
        if policy.record["fingerprint"] != trained[0].record["fingerprint"]:
            raise InputError(
                f"{run} was trained on another store than {runs[0]}; rank them one by one"
            )


def _training_store(trained: TrainedPolicy) -> EpisodeStore | None:
    """The store that the run was trained on; None if it is missing or has changed."""
    path = Path(trained.record["store"])
    if not (path / "meta.json").is_file():
        return None
    store = EpisodeStore.open(path)
    return store if store.meta["fingerprint"] == trained.record["fingerprint"] else None


def _rows(
    options: argparse.Namespace,
    runs: list[Path],
    trained: list[TrainedPolicy],
    train: EpisodeStore | None,
    evaluated: EpisodeStore,
    users: Any,
) -> list[dict[str, Any]]:
    counts = trained[0].counts
    assert counts is not None
    policies = [
        PolicyRanker(policy, target_given(options, policy), policy.name) for policy in trained
    ]
    references = baselines(counts, None if train is None else train.split("train"), options.seed)
    named = rankers_named([*policies, *references])
    k = min(options.k, len(counts.shown))
    ranked = {name: rank_steps(ranker, evaluated, k) for name, ranker in named.items()}
    period = Period.of(evaluated, np.asarray(users))
    reference = next(iter(named))
    common = {
        "k": k,
        "steps": len(period.items),
        "users": len(np.unique(period.users)),
        "reference": reference,
        "seed": options.seed,
        "checkpoint": options.checkpoint,
        "fingerprint": evaluated.meta["fingerprint"],
        "train_fingerprint": trained[0].record["fingerprint"],
        **provenance(),
    }
    rows = []
    for comparison in compare(period, ranked, k, reference, options.seed):
        row: dict[str, Any] = {"policy": comparison.name, "coverage": comparison.coverage}
        for name in MEASURES:
            row[name] = comparison.values[name]
            row[f"{name}_interval"] = list(comparison.intervals[name])
            row[f"{name}_less_{reference}"] = list(comparison.differences[name])
        rows.append(row | common)
    return rows


def _legend(k: int) -> str:
    lines = [f"{name:<16}{MEASURES[name]}" for name in _SHOWN]
    return "\n".join([*lines, f"k is {k}; --json has 95% intervals and paired differences by user"])
