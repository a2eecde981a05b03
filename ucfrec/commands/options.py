"""Options of commands: one maker of single options, one for fields of settings tables, and the
options that several commands share with the objects that they stand for.

Options in a titled group are listed by name in `--help`, and described in `--help-all`.
"""

import argparse
import re
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ucfrec.errors import InputError
from ucfrec.files.atomic import require_other_files
from ucfrec.files.remote import Input, Output, uri_or_path

if TYPE_CHECKING:
    from ucfrec.acting.decision import DecisionRule
    from ucfrec.evaluation.simulator import Environment
    from ucfrec.logs.mapping import Dataset, LogMapping
    from ucfrec.recommending.exposures import ExposureLog
    from ucfrec.recommending.responder import Responder
    from ucfrec.runs.trained_policy import TrainedPolicy

Options = argparse._ActionsContainer
"""A parser or a group of its options."""
INPUT: Final = uri_or_path(Input, str)
INPUT_FOLDER: Final = uri_or_path(Input, Path)
OUTPUT: Final = uri_or_path(Output, Path)
RULE: Final = {
    "minimum_target": float,
    "reward_weight": float,
    "policy_weight": float,
    "lookahead": float,
    "temperature": float,
    "top_k": int,
    "explore": float,
    "explore_top": int,
    "exclude_seen": bool,
    "tag_window": int,
    "tag_run": int,
}
"""Fields of `DecisionRule` that are options of their names."""
_UNITS_MS: Final = {"s": 1_000, "m": 60_000, "h": 3_600_000, "d": 86_400_000}


class FieldHelp(str):
    """`MODULE:TABLE.FIELD`, whose docstring is the help: imported only if it is shown."""

    def read(self) -> str:
        """The meaning of the field, with its default if that is a value."""
        module, _, name = self.partition(":")
        table, _, field = name.partition(".")
        info = getattr(import_module(module), table).__pydantic_fields__[field]
        text, default = " ".join(info.description.split()).rstrip("."), info.default
        # A rule's fields are those of the run by default.
        if table != "DecisionRule" and default is not None and default is not False:
            text = f"{text} (default: {default})"
        return text.replace("%", "%%")


def option(
    parser: Options, name: str, kind: Any, text: str, metavar: str | None = None, **more: Any
) -> argparse.Action:
    """Add one option or positional argument.

    Args:
        kind: its type, or its default, of which it has the type; False for a flag; a list of
            choices.
        text: its help; a default is added.
        more: as for `add_argument`.
    """
    if kind is False:
        return parser.add_argument(name, action="store_true", help=text, **more)
    if metavar is not None:
        more["metavar"] = metavar
    if isinstance(kind, list):
        return parser.add_argument(name, choices=kind, help=text, **more)
    if callable(kind):
        return parser.add_argument(name, type=kind, help=text, **more)
    text = f"{text} (default: {kind})"
    return parser.add_argument(name, type=type(kind), default=kind, help=text, **more)


def table_options(
    parser: Options, table: str, fields: Mapping[str, Any], prefix: str = "", **names: str
) -> None:
    """Add an option for each of some fields of a settings table; unset ones stay unset.

    Args:
        table: `MODULE:TABLE`.
        fields: name and type.
        prefix: of the options' names.
        names: of options that are called otherwise than their field.
    """
    for field, kind in fields.items():
        name = f"--{prefix}{names.get(field, field).replace('_', '-')}"
        more: dict[str, Any] = {"action": "store_true"}
        if kind is not bool:
            unit = "N" if kind is int else field.rpartition("_")[2].upper()
            more = {"type": kind, "metavar": unit}
        if kind is tuple:
            more = {"type": float, "nargs": 2, "metavar": ("LEAST", "MOST")}
        dest, text = f"{table.partition(':')[2]}.{field}", FieldHelp(f"{table}.{field}")
        parser.add_argument(name, dest=dest, default=argparse.SUPPRESS, help=text, **more)


def table_values(options: argparse.Namespace, table: str) -> dict[str, Any]:
    """The fields of a settings table that the command line names."""
    return {
        name.partition(".")[2]: tuple(value) if isinstance(value, list) else value
        for name, value in vars(options).items()
        if name.startswith(f"{table}.")
    }


def setting_option(parser: Options, text: str) -> None:
    """Add --set."""
    unit = "TABLE.FIELD=VALUE"
    option(parser, "--set", str, f"{text} (default: none)", unit, action="append", default=[])


def run_option(parser: Options) -> None:
    """Add RUN."""
    option(parser, "run", Path, "run folder of `ucfrec train`", "RUN")


def environment_options(parser: argparse.ArgumentParser) -> None:
    """Add --env with the options that belong to it, and --seed."""
    env_options(parser, required=True)
    option(parser, "--seed", 0, "seed of the sessions")


def env_options(parser: argparse.ArgumentParser, required: bool, use: str = "") -> None:
    """Add --env, --env-folder, --observe and --item-features.

    Args:
        use: what the environment is used for, for the help of --env.
    """
    option(
        parser,
        "--env",
        str,
        "simulator, e.g. synthetic-taobao, or gymnasium:ID, any Gymnasium environment "
        f"(gymnasium:MODULE:ID imports MODULE first){use}",
        required=required,
    )
    group = parser.add_argument_group("the environment")
    option(
        group,
        "--env-folder",
        Path,
        "folder with the simulator's files, e.g. its weights (default: none)",
        "FOLDER",
    )
    option(
        group,
        "--observe",
        str,
        "of gymnasium:ID with a dict observation: entries that are observed, one after the "
        "other as one vector (default: none, states come from the items shown and their rewards; "
        "environments of vector actions need one)",
        "KEY[,KEY…]",
        default="",
    )
    option(
        group,
        "--item-features",
        str,
        "of gymnasium:ID with items: their features, from an attribute of the environment or "
        "a file .npy (a row for each item) or .parquet (with a column item_id from 0) (default: "
        "none)",
        "SOURCE",
    )


def log_options(
    parser: argparse.ArgumentParser, metavar: str = "LOGS", nargs: str = "+"
) -> argparse._ArgumentGroup:
    """Add LOGS and how they are read; returns the group of the latter."""
    text = "log files (.parquet, .csv, .csv.gz), folders or globs; also at s3://, …"
    option(parser, "logs", INPUT, text, metavar, nargs=nargs)
    group = parser.add_argument_group("reading logs")
    option(
        group,
        "--dataset",
        str,
        "kind of logs: generic, kuairand, kuairec, obd, … (default: that of the run, if there "
        "is one, else generic)",
        "NAME",
    )
    option(
        group,
        "--column",
        str,
        "file column or SQL expression for a log column, e.g. user_id=uid; repeatable "
        "(default: as in the logs that the run was trained on, or the column of the same name)",
        "NAME=COLUMN",
        action="append",
        default=[],
    )
    option(
        group,
        "--mapping",
        Path,
        "file with column mapping, reward and feature tables; --column overrides it "
        "(default: none; a run remembers the columns of its logs)",
        "TOML",
    )
    option(
        group,
        "--time-format",
        str,
        "how times are written that are text, e.g. '%%d/%%m/%%Y %%H:%%M' (default: ISO 8601, "
        "and dates whose order of day and month the file settles)",
        "FORMAT",
    )
    text = "ISO time before which times are clock errors (default: 2000-01-01)"
    option(group, "--earliest", str, text, "TIME")
    option(
        group,
        "--where",
        str,
        "condition over the log's columns; rows that do not fulfil it are excluded and "
        "counted, e.g. \"user_id NOT IN ('bot-0', 'bot-1')\" (default: none)",
        "SQL",
    )
    option(group, "--partitions", False, "read names of folders such as country=DE as columns")
    return group


def memory_option(parser: Options, more: str = "") -> None:
    """Add --memory-limit, of reading logs."""
    text = "memory of the process while it reads the logs, from 800MB on; beyond it rows spill "
    option(parser, "--memory-limit", "2GB", f"{text}to a scratch folder{more}", "SIZE")


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
    return list(dict.fromkeys(runs))


def rule_options(parser: argparse.ArgumentParser) -> None:
    """Add --checkpoint and the parts of a decision rule that replace those of the run's own."""
    rule = parser.add_argument_group(
        "decision rule", "each part is the run's own, chosen at the end of its training, by default"
    )
    text = "policy weights: of the lowest validation loss, or the last ones (default: best)"
    option(rule, "--checkpoint", ["best", "last"], text, default="best")
    target = rule.add_mutually_exclusive_group()
    option(
        target,
        "--target-return",
        float,
        "target return, in units of the reward: of a session, or of every step for "
        "returns-to-go of a horizon or discounted ones",
        "RETURN",
    )
    text = "target return: this quantile of the training's, 0 to 1; 1 is the largest"
    option(target, "--target-quantile", float, text, "QUANTILE")
    text = "target return: the largest that the policy expects in each state"
    option(target, "--max-return", False, text)
    table_options(rule, "ucfrec.acting.decision:DecisionRule", RULE)


def keep_seen_option(parser: Options) -> None:
    """Add the option on items that users have seen."""
    text = "also recommend items that the user has seen; (default: leave them out)"
    option(parser, "--keep-seen", False, text)


def filter_seen_option(parser: Options) -> None:
    """Add the option to exclude items that users have seen from what the policy could choose."""
    option(
        parser,
        "--filter-seen",
        False,
        "exclude items that the user was shown before, as serve and recommend do without "
        "--keep-seen: for logs of what they showed",
    )


def answer_options(
    parser: argparse.ArgumentParser, exposures: str, *engines: str
) -> argparse._ArgumentGroup:
    """Add what `recommend` and `serve` share, and return the group of the finer points.

    Args:
        exposures: what --exposures takes, FILE or DIR.
        engines: choices besides torch and onnxruntime.
    """
    option(parser, "--k", 10, "items for each user; if a request does not say how many")
    option(
        parser,
        "--exposures",
        Path,
        "write what was shown, with its probability, as Parquet; see docs/exposures.md",
        exposures,
    )
    keep_seen_option(parser)
    group = parser.add_argument_group("answering")
    option(
        group,
        "--skip-unknown",
        False,
        "ignore rows with items outside the catalogue of the run, and such candidates "
        "(default: an error)",
    )
    option(group, "--seed", 0, "of the draws of a rule with --temperature or --explore")
    text = (
        "what computes the network of requests that are not batched; onnxruntime is faster, "
        "but needs ucfrec[export] and some 10 seconds at the start"
    )
    if "spark" in engines:
        text += (
            "; spark: with LOGS, Spark's workers each recommend to some of the users and "
            "write the parts of a folder --out"
        )
    choices = ["torch", "onnxruntime", *engines]
    option(group, "--engine", choices, f"{text} (default: torch)", default="torch")
    limits = parser.add_argument_group("request limits", "larger requests are rejected")
    sizes = dict.fromkeys(("bytes", "k", "history", "candidates"), int)
    table_options(limits, "ucfrec.recommending.requests:Limits", sizes, "max-")
    return group


def spark_option(parser: Options) -> None:
    """Add where Spark is, for an engine of that name."""
    option(
        parser,
        "--spark-master",
        str,
        "with --engine spark: its master, e.g. spark://HOST:7077; inputs and output must lie "
        "where every worker sees them (default: local[*], this machine)",
        "MASTER",
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
    """What answers requests, by `answer_options` and `rule_options`.

    Raises:
        InputError: a value is out of range, or the policy's actions are vectors.
    """
    from ucfrec.recommending.requests import Limits
    from ucfrec.recommending.responder import Responder

    return Responder(
        trained,
        Limits(**table_values(options, "Limits")),
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
    """Where --exposures says that a server's answers are written; None for nowhere."""
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
    parts = table_values(options, "DecisionRule")
    if options.target_quantile is not None:
        parts["target"] = trained.target_return(options.target_quantile)
    elif options.target_return is not None or options.max_return:
        parts["target"] = options.target_return
    return replace(trained.rule, **parts)


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

    mapping = LogMapping(
        columns_given(options.column),
        time_format=options.time_format,
        earliest=options.earliest,
        where=options.where and Expression(options.where, "--where"),
        partitions=options.partitions,
    )
    if options.mapping is not None:
        mapping = mapping.over(read_mapping(options.mapping))
    if trained is not None and options.dataset is None:
        from ucfrec.runs.later_logs import later_logs

        files, mapping = later_logs(trained, options.logs, mapping)
    else:
        dataset: Dataset = load_plugin("datasets", options.dataset or "generic")
        files, mapping = dataset.resolve(options.logs, mapping)
    outputs = (getattr(options, name, None) for name in ("out", "exposures", "json"))
    inputs = [*files]
    if trained is not None:
        names = (trained.record.FILE, *trained.record.files)
        inputs += [trained.folder / name for name in names]
    require_other_files((path for path in outputs if isinstance(path, Path)), inputs)
    return files, mapping


def environment_given(options: argparse.Namespace) -> "Environment":
    """The environment that `env_options` name."""
    from ucfrec.evaluation.simulator import Environment

    observe = tuple(key for key in options.observe.split(",") if key)
    features = options.item_features
    return Environment(options.env, options.env_folder, observe=observe, item_features=features)


def read_duration(option: str, text: str) -> int:
    """Milliseconds of a duration such as `90s`, `30m`, `12h` or `60d`.

    Raises:
        InputError: it is written otherwise, or is 0.
    """
    match = re.fullmatch(r"(\d{1,9}(?:\.\d+)?)([smhd])", text.strip())
    milliseconds = 0 if match is None else round(float(match[1]) * _UNITS_MS[match[2]])
    if not milliseconds:
        raise InputError(f"{option} {text} is not a duration; write e.g. 90s, 30m, 12h or 60d")
    return milliseconds
