"""Options that several commands share, and the objects made from them."""

import argparse
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ucfrec.errors import InputError
from ucfrec.files.atomic import require_other_files
from ucfrec.files.remote import Input, uri_or_path

if TYPE_CHECKING:
    from ucfrec.acting.decision import DecisionRule
    from ucfrec.evaluation.environment import Environment
    from ucfrec.logs.mapping import Dataset, LogMapping
    from ucfrec.recommending.exposures import ExposureLog
    from ucfrec.recommending.responder import Responder
    from ucfrec.runs.trained_policy import TrainedPolicy


def environment_options(parser: argparse.ArgumentParser) -> None:
    """Add --env with the options that belong to it, and --seed."""
    env_options(parser, required=True)
    parser.add_argument("--seed", type=int, default=0, help="seed of the sessions (default: 0)")


def env_options(parser: argparse.ArgumentParser, required: bool, use: str = "") -> None:
    """Add --env, --env-folder, --observe and --item-features.

    Args:
        required: whether --env must be given.
        use: what the environment is used for, for the help of --env.
    """
    parser.add_argument(
        "--env",
        required=required,
        help=f"simulator, e.g. synthetic-taobao, or gymnasium:ID, any Gymnasium environment "
        f"(gymnasium:MODULE:ID imports MODULE first){use}",
    )
    parser.add_argument(
        "--env-folder",
        type=Path,
        metavar="FOLDER",
        help="folder with the simulator's files, e.g. its weights (default: none)",
    )
    parser.add_argument(
        "--observe",
        default="",
        metavar="KEY[,KEY…]",
        help="of gymnasium:ID with a dict observation: entries that are observed, one after the "
        "other as one vector (default: none, states come from the items shown and their rewards; "
        "environments of vector actions need one)",
    )
    parser.add_argument(
        "--item-features",
        metavar="SOURCE",
        help="of gymnasium:ID with items: their features, from an attribute of the environment or "
        "a file .npy (a row for each item) or .parquet (with a column item_id from 0) (default: "
        "none)",
    )


def log_options(parser: argparse.ArgumentParser) -> argparse.Action:
    """Add LOGS, which is returned, and how they are read."""
    logs = parser.add_argument(
        "logs",
        nargs="+",
        type=uri_or_path(Input, str),
        metavar="LOGS",
        help="log files (.parquet, .csv, .csv.gz), folders or globs; also at s3://, …",
    )
    parser.add_argument(
        "--dataset",
        metavar="NAME",
        help="kind of logs: generic, kuairand, kuairec, obd, … (default: that of the run, if there "
        "is one, else generic)",
    )
    parser.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="NAME=COLUMN",
        help="file column or SQL expression for a log column, e.g. user_id=uid; repeatable "
        "(default: as in the logs that the run was trained on, or the column of the same name)",
    )
    parser.add_argument(
        "--mapping",
        type=Path,
        metavar="TOML",
        help="file with column mapping, reward and feature tables; --column overrides it "
        "(default: none; a run remembers the columns of its logs)",
    )
    parser.add_argument(
        "--time-format",
        metavar="FORMAT",
        help="how times are written that are text, e.g. '%%d/%%m/%%Y %%H:%%M' (default: ISO 8601, "
        "and dates whose order of day and month the file settles)",
    )
    parser.add_argument(
        "--earliest",
        metavar="TIME",
        help="ISO time before which times are clock errors (default: 2000-01-01)",
    )
    parser.add_argument(
        "--where",
        metavar="SQL",
        help="condition over the log's columns; rows that do not fulfil it are excluded and "
        "counted, e.g. \"user_id NOT IN ('bot-0', 'bot-1')\" (default: none)",
    )
    parser.add_argument(
        "--partitions",
        action="store_true",
        help="read names of folders such as country=DE as columns (default: no)",
    )
    return logs


def runs_given(options: argparse.Namespace) -> list[Path]:
    """The run folders among LOGS, which are no longer among them.

    Raises:
        InputError: there is none.
    """
    from ucfrec.runs.record import RUN

    runs = [Path(path) for path in options.logs if (Path(path) / RUN).is_file()]
    options.logs = [path for path in options.logs if Path(path) not in runs]
    if not runs:
        raise InputError("name a run folder of `ucfrec train` first, then the logs")
    return runs


def memory_option(parser: argparse.ArgumentParser) -> None:
    """Add --memory-limit, of reading logs."""
    parser.add_argument(
        "--memory-limit",
        default="2GB",
        metavar="SIZE",
        help="memory of the process while it reads the logs, from 800MB on; beyond it rows spill "
        "to a scratch folder (default: 2GB)",
    )


_NUMBERS_OF_RULES: Final = (
    (
        "--minimum-target",
        float,
        "RETURN",
        "lower bound of the target, also once a session has reached it",
    ),
    ("--reward-weight", float, "BETA", "weight of the reward model; 0 for none"),
    ("--policy-weight", float, "W", "weight of the policy; 0 for none"),
    (
        "--lookahead",
        float,
        "RETURN",
        "expected return after a step that does not end the session; 0 for none",
    ),
    ("--temperature", float, "TEMPERATURE", "draw items at this temperature; 0 takes the best"),
    ("--top-k", int, "N", "draw from the N best items only"),
    (
        "--explore",
        float,
        "SHARE",
        "share of the requests that draw uniformly from all items that are allowed",
    ),
    ("--explore-top", int, "N", "these draw from the N best items only"),
)
"""Option, type, unit and meaning of numbers that a rule has."""


def rule_options(parser: argparse.ArgumentParser) -> None:
    """Add --checkpoint and the parts of a decision rule that replace those of the run's own."""
    parser.add_argument(
        "--checkpoint",
        choices=["best", "last"],
        default="best",
        help="policy weights: of the lowest validation loss, or the last ones (default: best)",
    )
    rule = parser.add_argument_group(
        "decision rule", "each part is the run's own, chosen at the end of its training, by default"
    )
    target = rule.add_mutually_exclusive_group()
    target.add_argument(
        "--target-return",
        type=float,
        metavar="RETURN",
        help="target return, in units of the reward: of a session, or of every step for "
        "returns-to-go of a horizon or discounted ones",
    )
    target.add_argument(
        "--target-quantile",
        type=float,
        metavar="QUANTILE",
        help="target return: this quantile of the training's, 0 to 1; 1 is the largest",
    )
    target.add_argument(
        "--max-return",
        action="store_true",
        help="target return: the largest that the policy expects in each state",
    )
    for name, kind, unit, text in _NUMBERS_OF_RULES:
        rule.add_argument(name, type=kind, metavar=unit, help=text)
    rule.add_argument(
        "--exclude-seen", action="store_true", help="exclude items that the session has shown"
    )
    rule.add_argument(
        "--tag-window",
        type=int,
        metavar="N",
        help="exclude items that share a tag with one of the last N, unless none remain",
    )
    rule.add_argument(
        "--tag-run",
        type=int,
        metavar="N",
        help="exclude items of one main tag once the last N had it and were liked",
    )


def keep_seen_option(parser: argparse.ArgumentParser) -> None:
    """Add the option on items that users have seen."""
    parser.add_argument(
        "--keep-seen",
        action="store_true",
        help="also recommend items that the user has seen (default: leave them out)",
    )


def filter_seen_option(parser: argparse.ArgumentParser) -> None:
    """Add the option to exclude items that users have seen from what the policy could choose."""
    parser.add_argument(
        "--filter-seen",
        action="store_true",
        help="exclude items that the user was shown before, as serve and recommend do without "
        "--keep-seen: for logs of what they showed",
    )


def item_options(parser: argparse.ArgumentParser) -> None:
    """Add the options on items that users have seen and on items that the run does not know."""
    keep_seen_option(parser)
    parser.add_argument(
        "--skip-unknown",
        action="store_true",
        help="ignore rows with items outside the catalogue of the run, and such candidates "
        "(default: an error)",
    )


def draw_options(parser: argparse.ArgumentParser, place: str) -> None:
    """Add --seed and --exposures, of a rule that draws items."""
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="of the draws of a rule with --temperature or --explore (default: 0)",
    )
    parser.add_argument(
        "--exposures",
        type=Path,
        metavar=place,
        help="write what was shown, with its probability, as Parquet (docs/exposures.md)",
    )


def limit_options(parser: argparse.ArgumentParser) -> None:
    """Add the limits of a request for recommendations."""
    limits = parser.add_argument_group("request limits", "larger requests are rejected")
    for name, most, text in (
        ("--max-bytes", 2**21, "bytes of JSON (default: 2 MiB)"),
        ("--max-k", 1000, "items requested (default: 1,000)"),
        ("--max-history", 5000, "rows (default: 5,000)"),
        ("--max-candidates", 10_000, "items (default: 10,000)"),
    ):
        limits.add_argument(name, type=int, default=most, metavar="N", help=text)


def engine_option(parser: argparse.ArgumentParser, *more: str, more_help: str = "") -> None:
    """Add what computes the network of requests that are not batched.

    Args:
        more: further choices.
        more_help: what they are, for the help.
    """
    parser.add_argument(
        "--engine",
        choices=("torch", "onnxruntime", *more),
        default="torch",
        help="what computes the network of requests that are not batched; onnxruntime is faster, "
        f"but needs ucfrec[export] and some 10 seconds at the start{more_help} (default: torch)",
    )


def spark_option(parser: argparse.ArgumentParser) -> None:
    """Add where Spark is, for an engine of that name."""
    parser.add_argument(
        "--spark-master",
        metavar="MASTER",
        help="with --engine spark: its master, e.g. spark://HOST:7077; inputs and output must lie "
        "where every worker sees them (default: local[*], this machine)",
    )


def spark_given(options: argparse.Namespace) -> str | None:
    """Spark's master, if it is the engine; otherwise None.

    Raises:
        InputError: there is a master, but another engine.
    """
    if options.engine == "spark":
        return options.spark_master or "local[*]"
    if options.spark_master:
        raise InputError("--spark-master is for --engine spark; add it, or omit both")
    return None


def responder_given(options: argparse.Namespace, trained: "TrainedPolicy") -> "Responder":
    """What answers requests, by `--k`, `item_options`, `draw_options`, `engine_option`,
    `limit_options` and `rule_options`.

    Raises:
        InputError: a value is out of range, or the policy's actions are vectors.
    """
    from ucfrec.recommending.requests import Limits
    from ucfrec.recommending.responder import Responder

    limits = Limits(
        bytes=options.max_bytes,
        k=options.max_k,
        history=options.max_history,
        candidates=options.max_candidates,
    )
    return Responder(
        trained,
        limits,
        rule=rule_given(options, trained),
        k=options.k,
        filter_seen=not options.keep_seen,
        skip_unknown=options.skip_unknown,
        seed=options.seed,
        engine=options.engine,
    )


@contextmanager
def exposures_given(
    options: argparse.Namespace, trained: "TrainedPolicy"
) -> "Iterator[ExposureLog | None]":
    """Where `draw_options` say that a server's answers are written; None for nowhere."""
    from ucfrec.recommending.exposures import ExposureLog

    if options.exposures is None:
        yield None
        return
    with closing(ExposureLog(options.exposures, trained)) as log:
        yield log


def rule_given(options: argparse.Namespace, trained: "TrainedPolicy") -> "DecisionRule":
    """The run's decision rule with the parts that `rule_options` name.

    Raises:
        InputError: a value is out of range.
    """
    target = options.target_return
    if options.target_quantile is not None:
        target = trained.target_return(options.target_quantile)
    parts = {each.name: getattr(options, each.name, None) for each in fields(trained.rule)}
    parts |= {"target": target, "exclude_seen": options.exclude_seen or None}
    given = {name: value for name, value in parts.items() if value is not None}
    if options.max_return:
        given["target"] = None
    return replace(trained.rule, **given)


def logs_given(
    options: argparse.Namespace, trained: "TrainedPolicy | None" = None
) -> "tuple[tuple[Path, ...], LogMapping]":
    """Log files and column mapping that `log_options` name.

    Args:
        trained: policy that the logs are for, which remembers the dataset of its training logs.

    Raises:
        InputError: a file is missing, or would be replaced by what is written; or the dataset, a
            --column or the mapping file is unusable.
    """
    from ucfrec.logs.expressions import Expression
    from ucfrec.logs.mapping import LogMapping, columns_given, read_mapping
    from ucfrec.plugins import load_plugin

    given = LogMapping(
        columns_given(options.column),
        time_format=options.time_format,
        earliest=options.earliest,
        where=options.where and Expression(options.where, "--where"),
        partitions=options.partitions,
    )
    if options.mapping is not None:
        given = given.over(read_mapping(options.mapping))
    if trained is not None and options.dataset is None:
        from ucfrec.runs.later_logs import later_logs

        files, mapping = later_logs(trained, options.logs, given)
    else:
        dataset: Dataset = load_plugin("datasets", options.dataset or "generic")
        files, mapping = dataset.resolve(options.logs, given)
    outputs = (getattr(options, name, None) for name in ("out", "exposures", "json"))
    read = [*files]
    if trained is not None:
        of_run = (trained.record.FILE, *trained.record.files)
        read += [trained.folder / name for name in of_run]
    require_other_files((each for each in outputs if isinstance(each, Path)), read)
    return files, mapping


def environment_given(options: argparse.Namespace) -> "Environment":
    """The environment that `env_options` name."""
    from ucfrec.evaluation.environment import Environment

    observe = tuple(key for key in options.observe.split(",") if key)
    features = options.item_features
    return Environment(options.env, options.env_folder, observe=observe, item_features=features)
