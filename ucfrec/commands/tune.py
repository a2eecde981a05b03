"""`ucfrec tune`: search the settings of a training on validation rows."""

import argparse
from pathlib import Path

from ucfrec.commands.options import option, setting_option
from ucfrec.errors import InputError
from ucfrec.policies.registry import policy_names


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec tune`."""
    option(parser, "store", Path, "episode store to train on", "STORE")
    text = "folder of the search; an unfinished search in it is resumed"
    option(parser, "--out", Path, text, "DIR", required=True)
    option(
        parser,
        "--policy",
        str,
        f"policy; {', '.join(policy_names())}; repeatable to search the policy too (default: ucf)",
        "NAME",
        action="append",
    )
    option(parser, "--trials", 30, "trainings that the search has at the end", "N")
    option(
        parser,
        "--metric",
        ["value", "ndcg", "gauc"],
        "what is maximised: the return of a session in the user model, or NDCG or GAUC on "
        "validation rows (default: value)",
        default="value",
    )
    option(parser, "--k", 10, "items recommended, of --metric ndcg")
    option(
        parser,
        "--space",
        Path,
        "settings to search, one table per section; each a list of choices or "
        "{low = …, high = …, log = true} (default: learning rate, steps, width, dropout, "
        "context, exposure features and augmentation of networks, neighbours of item-knn; with "
        "ndcg and gauc also the reward weight)",
        "TOML",
    )
    setting_option(parser, "a setting that all trials have, e.g. train.steps=2000; repeatable")
    option(parser, "--workers", 1, "trainings side by side, each in a process", "N")
    option(
        parser,
        "--no-pruning",
        False,
        "train every trial to its end; (default: end those whose validation loss is above the "
        "median of earlier ones)",
    )
    option(parser, "--seed", 0, "seed of the search and of every training")
    parser.epilog = "Needs ucfrec[tune] (Optuna). The test split stays unseen."


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec tune` and print the best settings.

    Raises:
        InputError: the store, a policy or a setting cannot be used, Optuna is not installed, or
            the folder holds another search.
    """
    from ucfrec.reporting.tables import text_table
    from ucfrec.runs.config import settings_given
    from ucfrec.tuning.report import BEST_TOML, PAGE, importances, write_report
    from ucfrec.tuning.space import Search, read_space
    from ucfrec.tuning.study import BEST, Plan, finished, tune

    if options.k < 1:
        raise InputError(f"--k is {options.k}; recommend at least 1 item")
    search = Search(
        tuple(dict.fromkeys(options.policy or ["ucf"])),
        settings_given(options.set),
        options.metric == "value",
        options.seed,
        None if options.space is None else read_space(options.space),
    )
    out = options.out
    plan = Plan(options.store, out, search, options.metric, options.k, not options.no_pruning)
    study = tune(plan, options.trials, options.workers)
    write_report(study, plan)
    best, weights = study.best_trial, importances(study)
    lines = [
        (name, f"{value:.4g}" if isinstance(value, float) else value, f"{weights.get(name, 0):.2f}")
        for name, value in best.params.items()
    ]
    print(text_table(("setting", "best", "importance"), lines))
    print(
        f"\n{options.metric} {study.best_value:.6g} in trial {best.number}, of "
        f"{len(finished(study))} trials; selected on validation rows\n"
        f"settings: {out / BEST_TOML}\nall trials: {out / PAGE}\n"
        f"next: ucfrec ope {out / BEST}, its value on the test split, which no trial has seen"
    )
