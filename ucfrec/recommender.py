"""Recommender: train a policy on logs, recommend items, save and load it."""

import re
import shutil
import tempfile
import warnings
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final, Self

import pandas as pd
import pyarrow.parquet as pq

from ucfrec.acting.decision import DecisionRule
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError, InputNote
from ucfrec.files.atomic import atomic_folder
from ucfrec.files.locks import scratch_folder
from ucfrec.fitting.metrics_log import read_metrics
from ucfrec.logs.clean import REASONS
from ucfrec.logs.histories import log_table
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.recommending.histories import histories_of_frame
from ucfrec.recommending.recommend import recommend
from ucfrec.reporting.model_card import write_card
from ucfrec.runs.config import resolve_config
from ucfrec.runs.refit import refit_within
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy

_OPTIONS: Final = (
    (r" or --max-session \d+", ""),
    (r"--column (\w+)=('[^']*'|\.\.\.)", r"mapping=LogMapping({'\1': \2})"),
    (r"--column (\w+)=", r"mapping=LogMapping({'\1': ''})"),
    (r"--where (\"[^\"]*\")", r"mapping=LogMapping(where=\1)"),
    (r"--time-format ('[^']*')", r"mapping=LogMapping(time_format=\1)"),
    (r"--earliest ([\d-]+)", r"mapping=LogMapping(earliest='\1')"),
    (r"--time-format", "LogMapping.time_format"),
    (r"--(where|earliest|partitions|column)", r"LogMapping.\1"),
)
"""Options of commands in messages, and what they are in Python."""


class Recommender:
    """A policy that recommends items, trained from logs.

    Example::

        policy = Recommender("ucf", settings={"train.steps": 2000}).fit("store")
        policy.recommend(histories, k=10)
    """

    def __init__(
        self,
        policy: str = "ucf",
        settings: Mapping[str, Any] | Sequence[str] = (),
        seed: int = 0,
    ) -> None:
        """
        Args:
            policy: its name, "ucf" or a baseline, as for `ucfrec train --policy`.
            settings: as for `ucfrec train --set`: `{"train.steps": 200}`,
                `{"train": {"steps": 200}}` or `["train.steps=200"]`.
            seed: of everything random.

        Raises:
            InputError: the policy or a setting is unknown or out of range.
        """
        self.config = resolve_config(policy, None, settings, seed)
        self._remove_scratch: Callable[[], object] = ExitStack().close
        self._folder: Path | None = None
        self._trained: TrainedPolicy | None = None

    def __repr__(self) -> str:
        if self._trained is None:
            return f"Recommender({self.config.policy_name!r}, not trained)"
        return f"Recommender({self._trained.record.summary})"

    def fit(
        self,
        data: EpisodeStore | pd.DataFrame | Path | str,
        out: Path | str | None = None,
        *,
        reward: str | None = None,
        session_by: str | None = None,
        gap_minutes: float | None = None,
        split: tuple[float, ...] | None = None,
        mapping: LogMapping | None = None,
        refit: bool = False,
    ) -> Self:
        """Train on a store's training episodes; logs are prepared into a temporary store first.

        Args:
            data: a store or its folder; or logs: a file, folder or glob, or a frame with one row
                per interaction: `user_id`, `item_id`, `timestamp` (milliseconds, dates or
                timestamps) and feedback.
            out: run folder, resumed if training was interrupted; None for a temporary one.
            reward: logs only: SQL expression over the feedback columns; see `PrepareOptions`.
            session_by: logs only: "session_id", "gap" or "user"; see `PrepareOptions`.
            gap_minutes: logs only: with "gap", a longer pause (minutes) starts a new session (30).
            split: logs only: shares of training, validation and test (0.8, 0.1, 0.1).
            mapping: logs only: names of the columns, and feature tables.
            refit: go on learning from all rows once everything is chosen, as `ucfrec train` does;
                only later logs can evaluate the policy then.

        Returns:
            This recommender, trained.

        Raises:
            InputError: the data cannot be used, options for logs were given with a store, or `out`
                is a run on other data or settings.
        """
        log_options = {
            "reward": reward,
            "session_by": session_by,
            "gap_minutes": gap_minutes,
            "split": split,
        }
        options = {name: value for name, value in log_options.items() if value is not None}
        temporary = Path(tempfile.gettempdir())
        with ExitStack() as stack:
            if not isinstance(data, EpisodeStore):
                prepared = stack.enter_context(scratch_folder(temporary, "logs"))
                store = _store(data, prepared, mapping, options)
            elif options or mapping is not None:
                raise InputError(f"{data} is prepared already; prepare its logs with other options")
            else:
                store = data
            scratch = stack.enter_context(ExitStack())
            if out is None:
                # Whoever fits next removes the run, should this process be killed.
                out = scratch.enter_context(scratch_folder(temporary, "run")) / "run"
            record = train_run(store, Path(out), self.config)
            if refit:
                refit_within(store, Path(out))
            if warning := record.learned_nothing(read_metrics(Path(out) / "policy")):
                warnings.warn(InputNote(warning), stacklevel=2)
            write_card(Path(out))
            trained = TrainedPolicy.load(Path(out))
            kept = scratch.pop_all()
        self._remove_scratch()
        self._remove_scratch = weakref.finalize(self, kept.close)
        self._trained, self._folder = trained, Path(out)
        return self

    @property
    def run(self) -> Path:
        """The run folder.

        Raises:
            InputError: the recommender is not trained; call `fit` first.
        """
        if self._folder is None:
            raise InputError("this policy is not trained yet; call fit(...) or load(run) first")
        return self._folder

    @property
    def trained(self) -> TrainedPolicy:
        """The policy with the lowest validation loss.

        Raises:
            InputError: the recommender is not trained; call `fit` first.
        """
        if self._trained is None:
            raise InputError("this policy is not trained yet; call fit(...) or load(run) first")
        return self._trained

    def recommend(
        self,
        histories: pd.DataFrame,
        k: int = 10,
        *,
        filter_seen: bool = True,
        candidates: Sequence[Any] | None = None,
        skip_unknown: bool = False,
        rule: DecisionRule | None = None,
        seed: int = 0,
        mapping: LogMapping | None = None,
    ) -> pd.DataFrame:
        """The `k` best next items of every user; nothing is written to disk.

        Rows are read as by `ucfrec prepare`, and sessions are split as those of training. Rows that
        repeat a user, item and time count once. The state is made of at most the last 1,000 rows of
        a user; all rows count as seen.

        Args:
            histories: one row per interaction, in any order: `user_id`, `item_id`, `timestamp`
                (milliseconds, dates or timestamps); `reward`, or the columns of the training
                reward's expression; `session_id`, if the run's sessions are split by it; and
                `observation` (lists of floats), if the run has observations.
            k: number of items per user, at least 1.
            filter_seen: exclude items that the user's history contains.
            candidates: the only item_ids to recommend; None for all.
            skip_unknown: ignore rows of items that are not in the training data.
            rule: the decision rule; None for the run's own, `Recommender.trained.rule`.
            seed: of the draws of a rule with a temperature, or that explores. They also depend on
                the user and the time of the user's last row.
            mapping: names of the columns of `histories`; those that it leaves open are as in the
                training log if `histories` has them, and otherwise as above.

        Returns:
            `user_id`, `rank` (from 1), `item_id`, `score` (log-probability at temperature 1 among
            the items that are left, nats), `propensity` (probability of the item at its position,
            given those before it), `request_id`: k rows per user in the order shown, users in
            sorted order; fewer rows if fewer items remain, as with less than k candidates.

        Raises:
            InputError: the recommender is not trained, an argument is wrong, a column is missing or
                of a wrong type, rows have missing or undefined values, or an item or candidate is
                not in the training data.
        """
        trained = self.trained
        frames = recommend(
            trained,
            histories_of_frame(trained, histories, mapping or LogMapping()),
            k,
            rule=rule,
            seed=seed,
            filter_seen=filter_seen,
            candidates=candidates,
            skip_unknown=skip_unknown,
        )
        with _in_words_of_python():
            return pd.concat(frames, ignore_index=True)

    def save(self, folder: Path | str) -> None:
        """Copy the run to a new folder, which `load` and the command line can read.

        Raises:
            InputError: the folder exists, or the recommender is not trained.
        """
        run = self.run
        with atomic_folder(Path(folder)) as scratch:
            shutil.copytree(run, scratch, dirs_exist_ok=True)

    @classmethod
    def load(cls, run: Path | str) -> Self:
        """Load a recommender from a run folder, made by `save`, `fit` or `ucfrec train`.

        Raises:
            InputError: the folder is not a run folder, or has no checkpoint yet.
        """
        policy = cls()
        policy._folder, policy._trained = Path(run), TrainedPolicy.load(Path(run))
        policy.config = policy._trained.record.config
        return policy


UCF = Recommender
"""A `Recommender`, whose default policy is the Unified Causal Transformer (Algorithm 1)."""


def _store(
    data: pd.DataFrame | Path | str,
    scratch: Path,
    mapping: LogMapping | None,
    options: Mapping[str, Any],
) -> EpisodeStore:
    """The store at `data`, or one prepared from the logs in `data` in the folder `scratch`."""
    if isinstance(data, (str, Path)):
        if (Path(data) / "meta.json").is_file():
            if options or mapping is not None:
                raise InputError(f"{data} is prepared already; prepare its logs with other options")
            return EpisodeStore.open(data)
        logs = data
    else:
        logs = scratch / "logs.parquet"
        pq.write_table(log_table(data, "data"), logs)
    with _in_words_of_python(scratch / "logs.parquet"):
        prepared = PrepareOptions(**options)
        report = prepare([logs], mapping or LogMapping(), scratch / "store", prepared)
    dropped = {reason: rows for reason, rows in report["dropped"].items() if rows}
    if dropped:
        reasons = "; ".join(f"{n:,}: {REASONS.get(name, name)}" for name, n in dropped.items())
        warnings.warn(
            f"{sum(dropped.values()):,} of {report['rows_read']:,} rows were excluded ({reasons})",
            stacklevel=3,
        )
    return EpisodeStore.open(scratch / "store")


@contextmanager
def _in_words_of_python(file: Path | None = None) -> Iterator[None]:
    """Let errors and warnings of the block name arguments, not a scratch file or options.

    Args:
        file: scratch file of the argument `data`.
    """

    def translated(message: object) -> str:
        text = str(message) if file is None else str(message).replace(str(file), "data")
        for option, python in _OPTIONS:
            text = re.sub(option, python, text)
        return text

    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        try:
            yield
        except InputError as error:
            raise InputError(translated(error)) from None
    for each in noted:
        warnings.warn(each.category(translated(each.message)), stacklevel=5)
