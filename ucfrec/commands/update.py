"""`ucfrec update`: bring a run up to date with new logs."""

import argparse
from pathlib import Path

from ucfrec.commands.options import (
    filter_seen_option,
    log_options,
    logs_given,
    memory_option,
    option,
    read_duration,
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec update`."""
    option(
        parser,
        "run",
        Path,
        "finished run on the older logs; or a folder of runs, for the one that was promoted",
        "RUN",
    )
    memory_option(log_options(parser, "NEW_LOGS"))
    text = "folder of the new run; an interrupted update in it is resumed"
    option(parser, "--out", Path, text, "RUN2", required=True)
    text = "folder of the store with the new rows (default: RUN2-store, beside RUN2)"
    option(parser, "--store", Path, text, "STORE")
    option(
        parser,
        "--window",
        str,
        "exclude sessions that ended longer ago, before the end of the new logs, e.g. 60d or "
        "12h (default: keep all)",
        "TIME",
    )
    text = "shares of the new rows in order of time (default: 0.6,0.2,0.2); older rows train"
    option(parser, "--split", str, text, "TRAIN,VALIDATION,TEST")
    option(
        parser,
        "--no-refit",
        False,
        "once the runs are compared, do not go on learning from the validation and test rows; "
        "(default: RUN2 acts by the weights that learned from all rows)",
    )
    filter_seen_option(parser)
    option(parser, "--seed", int, "of everything random (default: that of RUN)")
    option(parser, "--threads", int, "CPU threads (default: all cores)")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec update` and print what was read, the drift and the verdict.

    Raises:
        InputError: the run or the logs cannot be used, or --out holds something else.
    """
    import torch

    from ucfrec.logs.append import SPLIT, AppendOptions
    from ucfrec.logs.prepare import parse_split
    from ucfrec.reporting.model_card import write_card
    from ucfrec.runs.promoted import promoted
    from ucfrec.runs.record import RUN
    from ucfrec.runs.trained_policy import TrainedPolicy
    from ucfrec.updating import drift, verdict
    from ucfrec.updating.update import UpdateOptions, update_run

    if options.threads is not None:
        torch.set_num_threads(options.threads)
    run = options.run
    if not (run / RUN).is_file() and (current := promoted(run)) is not None:
        run = current.run(run)
    old = TrainedPolicy.load(run)
    files, mapping = logs_given(options, old)
    append = AppendOptions(
        window_ms=None if options.window is None else read_duration("--window", options.window),
        split=SPLIT if options.split is None else parse_split(options.split),
        memory_limit=options.memory_limit,
    )
    record = update_run(
        run,
        files,
        options.out,
        store=options.store,
        mapping=mapping,
        options=UpdateOptions(
            append,
            seed=options.seed,
            refit=not options.no_refit,
            filter_seen=options.filter_seen,
        ),
    )
    write_card(options.out)
    update = record.update
    assert update is not None
    assert update.drift is not None
    assert update.verdict is not None
    counts = update.appended
    print(
        f"new rows      {counts['steps']:,} of {counts['rows_read']:,} read"
        f" ({counts['not_newer']:,} not newer than the store); {counts['new_users']:,} new users, "
        f"{counts['new_items']:,} new items; {counts['expired_steps']:,} old rows excluded"
    )
    print(record.describe())
    if record.rule is not None and record.rule.rule != old.rule:
        print(f"rule changed  {old.rule} → {record.rule.rule}")
    print(f"{drift.describe(update.drift)}\n{verdict.describe(update.verdict)}")
    print(f"\nrun: {options.out}")
    if update.verdict.result == "worse":
        print("next: keep the old run; more new rows, or train from scratch with ucfrec train")
    else:
        print(f"next: ucfrec promote {options.out}, if `serve` follows its folder")
