"""`ucfrec train`: train a policy on an episode store."""

import argparse
import shutil
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ucfrec.commands.options import INPUT_FOLDER, option, setting_option
from ucfrec.errors import InputError, InputNote
from ucfrec.policies.registry import policy_names

if TYPE_CHECKING:
    from ucfrec.episodes.store import EpisodeStore


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec train`."""
    training_options(parser)
    option(
        parser,
        "--refit",
        Path,
        "go on training this finished run on all rows of the store, with its settings and "
        "decision rule, in another folder (default: a new training)",
        "RUN",
    )
    option(
        parser,
        "--no-refit",
        False,
        "keep the weights of the training rows; (default: once everything is chosen, go on "
        "learning from all rows; `rank` and `ope` on the test split use the weights before that)",
    )
    option(
        parser,
        "--evidence",
        int,
        "effective users that the decision rule must leave in the validation sessions; where "
        "the log has propensities, so that `ope` can estimate its value; 0 for any (default: 200)",
        "N",
    )


def training_options(
    parser: argparse.ArgumentParser, policies: Sequence[str] | None = None
) -> None:
    """Add the options of `train` for `ucfrec` and for other programs with this command.

    Args:
        policies: names of those that the program trains, others are refused; None for all.
    """
    parser.epilog = "Every setting, its range and meaning: ucfrec settings --policy NAME"
    text = "episode store to train on; also at s3://, gs://, hdfs://, …"
    option(parser, "store", INPUT_FOLDER, text, "STORE")
    text = "folder of the run; an unfinished run in it is resumed"
    option(parser, "--out", Path, text, "RUN", required=True)
    names = ", ".join(policies or policy_names())
    text = f"policy: {names} (default: ucf)"
    option(parser, "--policy", str, text, "NAME", default="ucf", choices=policies)
    text = "file of settings with one table per section (default: none)"
    option(parser, "--config", Path, text, "TOML")
    setting_option(parser, "one setting, e.g. train.steps=2000; overrides --config; repeatable")
    option(parser, "--seed", 0, "seed of weights and batches")
    option(parser, "--threads", int, "CPU threads (default: all cores)")
    option(
        parser,
        "--screen",
        ["drop", "copies"],
        "what to do with observation columns without effect; train without them, or add "
        "copies of the sessions that intervene on them (default: not screened)",
    )


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec train`.

    Raises:
        InputError: the store or a setting cannot be used, or --out holds a different run.
    """
    import torch

    from ucfrec.fitting.distributed import joined

    if options.threads is not None:
        torch.set_num_threads(options.threads)
    with joined():
        _train(options)


def _train(options: argparse.Namespace) -> None:
    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.fitting.distributed import leads, wait
    from ucfrec.fitting.metrics_log import read_metrics
    from ucfrec.reporting.model_card import write_card
    from ucfrec.runs.config import resolve_config
    from ucfrec.runs.record import REFIT, RUN, read_record
    from ucfrec.runs.refit import refit
    from ucfrec.runs.screened import train_screened

    if not leads():
        warnings.simplefilter("ignore", InputNote)  # the leader prints them
        wait()  # until the leader has begun the run
    store = EpisodeStore.open(options.store)
    if options.refit is not None:
        settings = (options.config, options.set or None, options.screen, options.evidence)
        if any(setting is not None for setting in settings):
            raise InputError(
                "--refit takes all settings of the run; omit --config, --set, --screen and "
                "--evidence"
            )
        record = refit(store, options.refit, options.out)
    else:
        if options.evidence is not None:
            options.set.append(f"rule.evidence={options.evidence}")
        config = resolve_config(options.policy, options.config, options.set, options.seed)
        record = train_screened(store, options.out, config, options.screen)
    if options.no_refit:
        shutil.rmtree(options.out / REFIT, ignore_errors=True)
    elif options.refit is None:
        _refit(store, options.out)
    if not leads():
        return
    card = write_card(options.out)
    print(record.describe(read_metrics(options.out / "policy")))
    if (options.out / REFIT / RUN).exists():
        whole = read_record(options.out / REFIT)
        print(f"refit         {whole.train_steps:,} rows, all of the store")
    print(f"\nrun: {options.out} (TensorBoard can open it)\nmodel card: {card}")
    if record.rule is None:
        print(f"next: ucfrec evaluate {options.out} --env NAME, in a simulator of these actions")
    else:
        print(
            f"next: ucfrec ope {options.out}, its value on the test split of the store\n"
            f"      ucfrec recommend {options.out} LOGS --out FILE, the next items of every user"
        )


def _refit(store: "EpisodeStore", run: Path) -> None:
    """Let the run go on learning from all rows; processes of `torchrun` do not."""
    from ucfrec.fitting import distributed
    from ucfrec.runs.refit import refit_within

    if distributed.processes() == 1:
        refit_within(store, run)
    elif distributed.leads():
        warnings.warn(
            "several processes do not learn from all rows; run the same command in one process, "
            "which then only does that",
            InputNote,
            stacklevel=2,
        )
