"""Options that several commands share, and the objects that they stand for."""

from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from ucfrec.commands.options import ARGUMENT, INPUT, Table, settings_given
from ucfrec.errors import InputError
from ucfrec.files.atomic import require_other_files

if TYPE_CHECKING:
    from ucfrec.acting.decision import DecisionRule
    from ucfrec.logs.mapping import Dataset, LogMapping
    from ucfrec.off_policy.evaluate import EstimateOptions
    from ucfrec.off_policy.score import LoggedSessions
    from ucfrec.runs.trained_policy import TrainedPolicy


class RunArgument(Table):
    """A run, named before logs."""

    run: Annotated[Path, ARGUMENT]
    """Run folder of `ucfrec train`."""


class LogOptions(Table):
    """Logs, and how they are read."""

    title = "reading logs"
    described_by = "ucfrec.logs.mapping:LogMapping"

    logs: Annotated[Sequence[str], ARGUMENT, INPUT]
    """Log files (.parquet, .csv, .csv.gz), folders or globs; also at s3://, …"""
    dataset: str | None = None
    """Kind of logs: generic, kuairand, kuairec, obd, … (default: that of the run, else generic)"""
    column: Annotated[Sequence[str], "NAME=COLUMN"] = ()
    """File column or SQL expression for a log column, e.g. user_id=uid; repeatable (default: as of
    the run, or the column of the same name)"""
    mapping: Path | None = None
    """TOML file with column mapping, reward and feature tables; --column overrides it (default:
    none)"""
    time_format: str | None = None
    earliest: Annotated[str | None, "TIME"] = None
    where: Annotated[str | None, "SQL"] = None
    partitions: bool = False
    memory_limit: str = "2GB"
    """Memory of the process while it reads the logs, from 800MB on; beyond it rows spill to disk"""

    def find_logs(
        self,
        logs: Sequence[str],
        trained: "TrainedPolicy | None" = None,
        outputs: Iterable[Path | None] = (),
    ) -> "tuple[tuple[Path, ...], LogMapping]":
        """Log files and the mapping of their columns.

        Args:
            trained: policy that the logs are for, which remembers the dataset of its training logs.
            outputs: files that the command writes.
        """
        from ucfrec.logs.expressions import Expression
        from ucfrec.logs.mapping import LogMapping, read_columns, read_mapping
        from ucfrec.plugins import load_plugin

        mapping = LogMapping(
            read_columns(self.column),
            time_format=self.time_format,
            earliest=self.earliest,
            where=self.where and Expression(self.where, "--where"),
            partitions=self.partitions,
        )
        if self.mapping:
            mapping = mapping.over(read_mapping(self.mapping))
        if trained is not None and not self.dataset:
            from ucfrec.runs.later_logs import later_logs

            files, mapping = later_logs(trained, logs, mapping)
        else:
            dataset: Dataset = load_plugin("datasets", self.dataset or "generic")
            files, mapping = dataset.resolve(logs, mapping)
        inputs = [*files]
        if trained is not None:
            names = (trained.record.FILE, *trained.record.files)
            inputs += [trained.folder / name for name in names]
        require_other_files((path for path in outputs if path is not None), inputs)
        return files, mapping

    def read_sessions(
        self,
        policies: "Sequence[TrainedPolicy]",
        logs: Sequence[str],
        output: Path | None,
        keep_unknown: bool = False,
        options: "EstimateOptions | None" = None,
    ) -> "AbstractContextManager[LoggedSessions]":
        """Sessions of logs, read as the first policy was trained, with what the options of an
        estimate need; those of the test split of the policies' store if no logs are named."""
        from ucfrec.off_policy.score import held_out_sessions, read_logged_sessions

        if not logs:
            return nullcontext(held_out_sessions(policies))
        files, mapping = self.find_logs(logs, policies[0], [output])
        return read_logged_sessions(
            policies[0],
            files,
            mapping,
            keep_unknown,
            self.memory_limit,
            measures=options.measures if options else (),
            by=options.by if options else None,
        )


class SparkOption(Table):
    """Where Spark is, for a field `engine` that has it."""

    title = "engine"
    engine: str

    spark_master: str | None = None
    """With --engine spark: its master, e.g. spark://HOST:7077, whose workers see all inputs and
    outputs (default: local[*], this machine)"""

    def find_spark(self) -> str | None:
        """Spark's master, if it is the engine; otherwise None."""
        if self.engine == "spark":
            return self.spark_master or "local[*]"
        if self.spark_master:
            raise InputError("--spark-master is for --engine spark; add it, or omit both")
        return None


class RuleOptions(Table):
    """The weights of a run, and the parts of a decision rule that replace those of its own."""

    title = (
        "decision rule; each part is the run's own, chosen at the end of its training, by default"
    )
    described_by = "ucfrec.acting.decision:DecisionRule"
    shows_defaults = False

    checkpoint: Literal["best", "last"] = "best"
    """Weights of the lowest validation loss or the last ones, for runs without a refit"""
    target: str | None = None
    """Target return, in units of the reward, of a session; of every step with a horizon or
    discount; q0.9 for a quantile of the training's"""
    minimum_target: float | None = None
    reward_weight: float | None = None
    policy_weight: float | None = None
    lookahead: float | None = None
    temperature: float | None = None
    top_k: int | None = None
    explore: float | None = None
    explore_top: int | None = None
    by_marginal_gain: bool = False
    exclude_seen: bool = False
    tag_window: int | None = None
    tag_run: int | None = None

    def load(self, run: Path, split: bool = False) -> "TrainedPolicy":
        """The policy of a run, with the weights that the command line names."""
        from ucfrec.runs.trained_policy import TrainedPolicy

        trained = TrainedPolicy.load(run, self.checkpoint, split=split)
        if self.checkpoint == "last" and trained.record.refit_of is not None:
            raise InputError(
                f"--checkpoint last: {run} acts by weights that went on learning from all rows to "
                "the end, of which there is one checkpoint; leave it out, or train with --no-refit"
            )
        return trained

    def make_rule(self, trained: "TrainedPolicy") -> "DecisionRule":
        """The run's decision rule with the parts that the command line names."""
        from ucfrec.acting.decision import DecisionRule

        parts = settings_given(self, DecisionRule)
        if self.target:
            parts["target"] = read_target("--target", self.target, trained)
        return replace(trained.rule, **parts)


def read_target(option: str, text: str, trained: "TrainedPolicy") -> float:
    """The target return that an option names: in units of the reward, or `q` and a quantile."""
    value = read_number(option, text.removeprefix("q"), "5 or q0.9")
    return trained.target_return(value) if text.startswith("q") else value


def read_number(option: str, word: str, example: str) -> float:
    """The number that an option holds, or an error with an example of one."""
    try:
        return float(word)
    except ValueError:
        raise InputError(f"{option}: {word!r} is not a number; write e.g. {example}") from None


def find_runs(words: Sequence[str]) -> tuple[list[Path], list[str]]:
    """The run folders among files, and the other files."""
    from ucfrec.runs.record import RUN

    paths = list(dict.fromkeys(map(Path, words)))
    runs = [path for path in paths if (path / RUN).is_file()]
    if not runs:
        raise InputError("name a run folder of `ucfrec train` first, then the logs")
    return runs, [word for word in words if Path(word) not in runs]
