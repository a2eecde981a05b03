"""Options that several commands share, and the objects that they stand for."""

import re
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from ucfrec.commands.options import ARGUMENT, EXCLUSIVE, INPUT, Group, Table, settings_given
from ucfrec.errors import InputError
from ucfrec.files.atomic import require_other_files

if TYPE_CHECKING:
    from ucfrec.acting.decision import DecisionRule
    from ucfrec.evaluation.simulator import Environment
    from ucfrec.logs.mapping import Dataset, LogMapping
    from ucfrec.off_policy.evaluate import EstimateOptions
    from ucfrec.off_policy.score import LoggedSessions
    from ucfrec.recommending.exposures import ExposureLog
    from ucfrec.recommending.responder import Responder
    from ucfrec.runs.trained_policy import TrainedPolicy

_UNITS_MS = {"s": 1_000, "m": 60_000, "h": 3_600_000, "d": 86_400_000}


class RunArgument(Table):
    """A run, named before logs."""

    run: Annotated[Path, ARGUMENT, "RUN"]
    """Run folder of `ucfrec train`."""


class LogOptions(Table):
    """Logs, and how they are read."""

    title = "reading logs"

    logs: Annotated[Sequence[str], ARGUMENT, INPUT, "LOGS"]
    """Log files (.parquet, .csv, .csv.gz), folders or globs; also at s3://, …"""
    dataset: Annotated[str | None, "NAME"] = None
    """Kind of logs: generic, kuairand, kuairec, obd, … (default: that of the run, else generic)"""
    column: Annotated[Sequence[str], "NAME=COLUMN"] = ()
    """File column or SQL expression for a log column, e.g. user_id=uid; repeatable (default: as of
    the run, or the column of the same name)"""
    mapping: Annotated[Path | None, "TOML"] = None
    """File with column mapping, reward and feature tables; --column overrides it (default: none)"""
    time_format: Annotated[str | None, "FORMAT"] = None
    """How times are written that are text, e.g. '%d/%m/%Y %H:%M' (default: ISO 8601, and dates
    whose order of day and month the file settles)"""
    earliest: Annotated[str | None, "TIME"] = None
    """ISO time before which times are clock errors (default: 2000-01-01)"""
    where: Annotated[str | None, "SQL"] = None
    """Condition that rows must fulfil, e.g. "user_id NOT IN ('bot-0', 'bot-1')" (default: none)"""
    partitions: bool = False
    """Read names of folders such as country=DE as columns."""
    memory_limit: Annotated[str, "SIZE"] = "2GB"
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
        if self.mapping is not None:
            mapping = mapping.over(read_mapping(self.mapping))
        if trained is not None and self.dataset is None:
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

    spark_master: Annotated[str | None, "MASTER"] = None
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
    target_return: Annotated[float | None, EXCLUSIVE, "RETURN"] = None
    """Target return, in units of the reward, of a session; of every step with a horizon or
    discount"""
    target_quantile: Annotated[float | None, EXCLUSIVE, "QUANTILE"] = None
    """Target return: this quantile of the training's, 0 to 1; 1 is the largest"""
    max_return: Annotated[bool, EXCLUSIVE] = False
    """Target return: the largest that the policy expects in each state."""
    minimum_target: Annotated[float | None, "TARGET"] = None
    reward_weight: Annotated[float | None, "WEIGHT"] = None
    policy_weight: Annotated[float | None, "WEIGHT"] = None
    lookahead: Annotated[float | None, "LOOKAHEAD"] = None
    temperature: Annotated[float | None, "TEMPERATURE"] = None
    top_k: Annotated[int | None, "N"] = None
    explore: Annotated[float | None, "EXPLORE"] = None
    explore_top: Annotated[int | None, "N"] = None
    exclude_seen: bool = False
    tag_window: Annotated[int | None, "N"] = None
    tag_run: Annotated[int | None, "N"] = None

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
        if self.target_quantile is not None:
            parts["target"] = trained.target_return(self.target_quantile)
        elif self.target_return is not None or self.max_return:
            parts["target"] = self.target_return
        return replace(trained.rule, **parts)


class AnswerOptions(RuleOptions):
    """How requests are answered, and the largest that are."""

    title = "answering"
    described_by = "ucfrec.recommending.requests:Limits"
    prefix = "max_"
    engine: str

    k: Annotated[int, Group("")] = 10
    """Items for each user; if a request does not say how many."""
    exposures: Annotated[Path | None, Group(""), "PATH"] = None
    """Write what was shown, with its probability; a folder for requests; see docs/exposures.md"""
    keep_seen: Annotated[bool, Group("")] = False
    """Also recommend items that the user has seen; (default: leave them out)"""
    skip_unknown: bool = False
    """Ignore rows and candidates with items outside the run's catalogue (default: an error)"""
    seed: int = 0
    """Of the draws of a rule with --temperature or --explore."""
    max_bytes: Annotated[int | None, "N"] = None
    max_k: Annotated[int | None, "N"] = None
    max_history: Annotated[int | None, "N"] = None
    max_candidates: Annotated[int | None, "N"] = None

    def make_responder(self, trained: "TrainedPolicy") -> "Responder":
        """What answers requests."""
        from ucfrec.recommending.requests import Limits
        from ucfrec.recommending.responder import Responder

        return Responder(
            trained,
            Limits(**settings_given(self, Limits, "max_")),
            rule=self.make_rule(trained),
            k=self.k,
            filter_seen=not self.keep_seen,
            skip_unknown=self.skip_unknown,
            seed=self.seed,
            engine=self.engine,
        )

    def open_exposures(
        self, trained: "TrainedPolicy"
    ) -> "AbstractContextManager[ExposureLog | None]":
        """Where a server's answers are written; None for nowhere."""
        from ucfrec.recommending.exposures import ExposureLog

        if self.exposures is None:
            return nullcontext()
        return closing(ExposureLog(self.exposures, trained))


class EnvironmentOptions(Table):
    """The parts of an environment."""

    title = "the environment"

    env_folder: Annotated[Path | None, "FOLDER"] = None
    """Folder with the simulator's files, e.g. its weights (default: none)"""
    observe: Annotated[str, "KEY[,KEY…]"] = ""
    """Of gymnasium:ID with a dict observation: entries that are observed, as one vector (default:
    none, states come from the items shown and their rewards)"""
    item_features: Annotated[str | None, "SOURCE"] = None
    """Of gymnasium:ID with items: their features, from an attribute of the environment or a file
    .npy (a row for each item) or .parquet (with a column item_id from 0) (default: none)"""

    def make_environment(self, name: str) -> "Environment":
        """The environment of that name with these parts."""
        from ucfrec.evaluation.simulator import Environment

        observe = tuple(key for key in self.observe.split(",") if key)
        return Environment(name, self.env_folder, observe=observe, item_features=self.item_features)


def find_runs(words: Sequence[str]) -> tuple[list[Path], list[str]]:
    """The run folders among files, and the other files."""
    from ucfrec.runs.record import RUN

    paths = list(dict.fromkeys(map(Path, words)))
    runs = [path for path in paths if (path / RUN).is_file()]
    if not runs:
        raise InputError("name a run folder of `ucfrec train` first, then the logs")
    return runs, [word for word in words if Path(word) not in runs]


def read_duration(option: str, text: str) -> int:
    """Milliseconds of a duration such as `90s`, `30m`, `12h` or `60d`."""
    match = re.fullmatch(r"(\d{1,9}(?:\.\d+)?)([smhd])", text.strip())
    milliseconds = 0 if match is None else round(float(match[1]) * _UNITS_MS[match[2]])
    if not milliseconds:
        raise InputError(f"{option} {text} is not a duration; write e.g. 90s, 30m, 12h or 60d")
    return milliseconds
