"""Recommender: train a policy on logs, recommend items, measure it, save and load it."""

import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, fields
from datetime import date
from html import escape
from pathlib import Path
from typing import Any, Self

import pandas as pd

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError, InputNote
from ucfrec.evaluation.ranking_table import require_one_catalogue
from ucfrec.evaluation.simulator import Environment
from ucfrec.files.atomic import atomic_folder, scratch_folder
from ucfrec.fitting.checkpoint import read_metrics
from ucfrec.fitting.loop import Callbacks, Watcher
from ucfrec.logs.append import AppendOptions
from ucfrec.logs.mapping import LogFiles
from ucfrec.logs.rows import DAY_MS
from ucfrec.off_policy.evaluate import DEFAULTS, EstimateOptions, OffPolicyReport
from ucfrec.off_policy.score import score
from ucfrec.policies.registry import policy_class
from ucfrec.provenance import shorten_paths
from ucfrec.python_api.given_data import (
    Columns,
    Logs,
    open_files,
    prepare_store,
    read_histories,
    read_logs,
    read_split,
    require_logs,
    use_words_of_python,
)
from ucfrec.python_api.training import Scratch, keep_beside, train_policy
from ucfrec.recommending.export import Exported, export
from ucfrec.recommending.exposures import exposures_written
from ucfrec.recommending.recommend import decide, read_time, similar_items
from ucfrec.reporting.measuring import TEST_SPLIT, estimate_return, evaluate_in, rank_policies
from ucfrec.reporting.model_card import write_card
from ucfrec.reporting.page import write_report
from ucfrec.results.rows import Evaluation, Ranking, ResultTable
from ucfrec.runs.config import TABLES, resolve_config, settings_given
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.settings import (
    check_arguments,
    require_ids,
    require_kind,
    require_list,
    require_number,
    require_seed,
    require_whole,
)
from ucfrec.updating.update import UpdateOptions, update_run

_OWN = ("policy", "settings", "seed")
_checked = check_arguments(
    {
        **dict.fromkeys(("k", "episodes"), require_whole),
        "seed": require_seed,
        **dict.fromkeys(("gap_minutes", "window_days"), require_number),
        **dict.fromkeys(("reward", "session_by", "dataset", "liked"), require_kind("text", str)),
        **dict.fromkeys(("out", "run", "folder", "file"), require_kind("a path", str, Path)),
        "exposures": require_kind("a path", str, Path),
        **dict.fromkeys(("on_step", "on_validation"), require_kind("a function", Callable)),
        **dict.fromkeys(("data", "logs"), require_logs),
        **dict.fromkeys(
            ("filter_seen", "skip_unknown", "new_session"), require_kind("true or false", bool)
        ),
        "split": read_split,
        "histories": require_kind("a pandas DataFrame with one row per interaction", pd.DataFrame),
        "rule": require_kind("a DecisionRule", DecisionRule),
        "options": require_kind("EstimateOptions", EstimateOptions),
        "environment": require_kind("the name of a simulator or an Environment", str, Environment),
    }
)
"""Decorator of methods: the check of each argument by its name."""


class Recommender:
    """A policy that recommends items, trained from logs.

    Its methods raise `InputError` if it is not trained yet, or if data or an argument cannot be
    used. Several have the arguments `rule`, the decision rule, None for the run's own, and
    `mapping`, of the columns of logs: what it leaves open is as in the training log.

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
        """
        self.policy, self.settings, self.seed = policy, settings, seed
        self.config = resolve_config(policy, None, settings, seed)
        self._scratch: Scratch | None = None
        self._trained: TrainedPolicy | None = None

    def __repr__(self) -> str:
        if self._trained is None:
            return f"Recommender({self.config.policy_name!r}, not trained)"
        return f"Recommender({self._trained.record.summary})"

    def _repr_html_(self) -> str:
        lines = [repr(self), *([] if self._trained is None else [str(self._trained.rule)])]
        return "".join(f"<p>{escape(line)}</p>" for line in lines)

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The arguments of the constructor, as scikit-learn's estimators have it; with `deep`, also
        every setting, as `table__field`."""
        params = {name: getattr(self, name) for name in _OWN}
        if deep:
            for table in TABLES:
                values = asdict(getattr(self.config, table))
                params |= {f"{table}__{name}": value for name, value in values.items()}
        return params

    def set_params(self, **params: Any) -> Self:
        """Change arguments of the constructor, or settings as `train__steps=200`, before `fit`.

        Another policy keeps the settings that it has too.
        """
        policy, seed = params.pop("policy", self.policy), params.pop("seed", self.seed)
        settings = params.pop("settings", None)
        if settings is None:
            settings = self.settings
            if policy != self.policy:
                names = {f"policy.{field.name}" for field in fields(policy_class(policy).Config)}
                settings = {
                    name: value
                    for name, value in settings_given(settings).items()
                    if name in names or not name.startswith("policy.")
                }
        if params:
            changes = {name.replace("__", ".", 1): value for name, value in params.items()}
            # Texts `table.field=value` come first, so that the new values count.
            settings = settings_given(settings) | changes
        self.config = resolve_config(policy, None, settings, seed)
        self.policy, self.settings, self.seed = policy, settings, seed
        return self

    @_checked
    def fit(
        self,
        data: EpisodeStore | Logs,
        out: Path | str | None = None,
        *,
        reward: str | None = None,
        session_by: str | None = None,
        gap_minutes: float | None = None,
        split: Sequence[float | str | date] | None = None,
        mapping: Columns | None = None,
        dataset: str | None = None,
        refit: bool = False,
        on_step: Watcher | None = None,
        on_validation: Watcher | None = None,
    ) -> Self:
        """Train on a store's training episodes; returns this recommender. Logs are prepared first.

        Args:
            data: a store or its folder; or logs: files, folders and globs, what
                `ucfrec_datasets.load` returns, or a frame with one row per interaction: `user_id`,
                `item_id`, `timestamp` (milliseconds, dates or timestamps) and feedback.
            out: run folder, resumed if training was interrupted; a store prepared from logs is kept
                beside it, as `OUT-store`. None for temporary ones, which last as long as this
                recommender.
            reward: logs only: SQL expression over the feedback columns; see `PrepareOptions`.
            session_by: logs only: "session_id", "gap" or "user"; see `PrepareOptions`.
            gap_minutes: logs only: with "gap", a longer pause (minutes) starts a new session (30).
            split: logs only: shares of training, validation and test (0.8, 0.1, 0.1), or the two
                times at which validation and test begin: ISO text, dates or milliseconds (UTC).
            mapping: logs only: names of the columns, and feature tables; a dictionary of names is
                enough. Or a TOML file, as for `ucfrec prepare --mapping`.
            dataset: files only: the dataset adapter, as for `ucfrec prepare --dataset`.
            refit: go on learning from all rows once everything is chosen, as `ucfrec train` does;
                `rank` and `ope` on the test split use the weights before that.
            on_step: called after every update with the step and `{"loss": …}`.
            on_validation: called after every validation with the step and all that is logged.
        """
        names = ("reward", "session_by", "gap_minutes", "split", "dataset")
        values = zip(names, (reward, session_by, gap_minutes, split, dataset), strict=True)
        options = {name: value for name, value in values if value is not None}
        with ExitStack() as stack:
            # Whoever fits next removes what is left, should this process be killed.
            parent = Path(tempfile.gettempdir()) if out is None else Path(out).absolute().parent
            folder = stack.enter_context(scratch_folder(parent, "run"))
            run = folder / "run" if out is None else Path(out).absolute()
            store = prepare_store(data, mapping, folder, options)
            if out is not None and store.path.parent == folder:
                store = keep_beside(run, store)
            watchers = Callbacks(on_step, on_validation)
            record = train_policy(store, run, self.config, refit, watchers)
            if warning := record.learned_nothing(read_metrics(run / "policy")):
                with use_words_of_python():
                    warnings.warn(InputNote(warning), stacklevel=2)
            trained = TrainedPolicy.load(run)
            scratch = Scratch(stack.pop_all()) if any(folder.iterdir()) else None
        self._trained, self._scratch = trained, scratch
        return self

    @property
    def run(self) -> Path:
        """The run folder."""
        folder = self.trained.folder
        if not folder.is_dir():
            raise InputError(
                f"the run folder {folder} is gone, as a temporary one is once its recommender is; "
                "call save(folder) before it is, or fit(..., out)"
            )
        return folder

    @property
    def trained(self) -> TrainedPolicy:
        """The policy with the lowest validation loss."""
        if self._trained is None:
            raise InputError("this policy is not trained yet; call fit(...) or load(run) first")
        return self._trained

    def _load_for(self, logs: Logs | None) -> TrainedPolicy:
        """The policy that logs can evaluate: the test split, the weights before a refit."""
        run, trained = self.run, self.trained
        if logs is not None or trained.record.refit_of is None:
            return trained
        return TrainedPolicy.load(run, split=True)

    @_checked
    def recommend(
        self,
        histories: pd.DataFrame | None = None,
        k: int = 10,
        *,
        users: Iterable[Any] | None = None,
        filter_seen: bool = True,
        candidates: Iterable[Any] | None = None,
        skip_unknown: bool = False,
        new_session: bool = False,
        at: str | float | None = None,
        rule: DecisionRule | None = None,
        seed: int = 0,
        mapping: Columns | None = None,
        exposures: Path | str | None = None,
    ) -> pd.DataFrame:
        """The `k` best next items of every user.

        Rows are read as by `ucfrec prepare`, which drops rows with a warning, and sessions are
        split as those of training. Rows that repeat a user, item and time count once. The state is
        made of at most the last 1,000 rows of a user; all rows count as seen.

        Args:
            histories: one row per interaction, as for `fit`, in any order: with `reward`, or the
                columns of the training reward's expression; `session_id`, if the run's sessions
                are split by it; and `observation` (lists of floats), if the run has observations.
                None for the rows of the store that the policy was trained on.
            k: number of items per user, at least 1.
            users: the only user_ids to recommend to; None for all of the histories.
            filter_seen: exclude items that the user's history contains.
            candidates: the only item_ids to recommend; None for all.
            skip_unknown: ignore rows of items that are not in the training data, and such
                candidates where others are left.
            new_session: whether users begin a new session; otherwise their latest one goes on.
            at: time of the requests, ISO 8601 or ms: only items that are available then are
                recommended, and rows from then on are not read. None for now.
            seed: of the draws of a rule with a temperature, or that explores. They also depend on
                the user and the time of the user's last row.
            mapping: names of the columns of `histories`; those that it leaves open are as in the
                training log if `histories` has them, and otherwise as above.
            exposures: Parquet file for what is shown, with its probabilities, for `join_feedback`;
                None for none.

        Returns:
            `user_id`, `rank` (from 1), `item_id`, `score` (log-probability at temperature 1 among
            the items that are left, nats), `propensity` (probability of the item at its position,
            given those before it), `request_id`: k rows per user in the order shown, users in
            sorted order; fewer rows if fewer items remain, as with less than k candidates.
        """
        trained = self.trained
        allowed = None
        if candidates is not None:
            allowed = require_ids("candidates", candidates, schema.ITEM_ID)
        decisions = decide(
            trained,
            read_histories(trained, histories, mapping, users, read_time(at)),
            k,
            rule=rule,
            seed=seed,
            filter_seen=filter_seen,
            candidates=allowed,
            skip_unknown=skip_unknown,
            new_session=new_session,
            at=at,
        )
        with ExitStack() as stack, use_words_of_python():
            frames: Iterable[pd.DataFrame] = (frame for frame, _ in decisions)
            if exposures is not None:
                hashed = (rule or trained.rule).hash
                written = exposures_written(
                    Path(exposures),
                    trained,
                    hashed,
                    decisions,
                    allowed,
                    excludes_seen=filter_seen,
                    at=at,
                )
                frames = stack.enter_context(written)
            return pd.concat(frames, ignore_index=True)

    @_checked
    def recommend_to_items(self, items: Iterable[Any] | None = None, k: int = 10) -> pd.DataFrame:
        """The `k` most similar other items of each item, by the cosine of the policy's vectors.

        Args:
            items: item_ids; None for all.
            k: number of similar items, at least 1.

        Returns:
            `item_id`, `rank` (from 1), `similar_item_id`, `score` (cosine, −1 to 1).
        """
        return similar_items(self.trained, items, k)

    @_checked
    def rank(
        self,
        logs: Logs | None = None,
        k: int = 10,
        *,
        others: "Recommender | Iterable[Recommender]" = (),
        rule: DecisionRule | None = None,
        filter_seen: bool = True,
        liked: str | None = None,
        seed: int = 0,
        mapping: Columns | None = None,
    ) -> Ranking:
        """How this policy, others and baselines rank what users were shown later: `ucfrec rank`.

        Args:
            logs: later logs, as for `fit`; None for the test split of the store.
            k: items recommended at each step.
            others: policies trained on the same store, ranked beside this one; or only one.
            filter_seen: exclude items that the user has seen before a step.
            liked: truth value over the column reward, such as "reward >= 4"; None for at least 60%
                of the way from the lowest training reward to the highest.
            seed: of the bootstrap over users and of the random baseline.
        """
        beside = require_list("others", others, "a Recommender", Recommender)
        policies = [policy._load_for(logs) for policy in (self, *beside)]
        require_one_catalogue(policies)
        rules = [rule or policies[0].rule, *(policy.rule for policy in policies[1:])]
        with read_logs(policies[0], logs, mapping, keep_unknown=False) as logged:
            return rank_policies(
                list(zip(policies, rules, strict=True)),
                logged,
                _name_logs(logs),
                k=k,
                filter_seen=filter_seen,
                liked=liked,
                seed=seed,
            )

    @_checked
    def ope(
        self,
        logs: Logs | None = None,
        *,
        rule: DecisionRule | None = None,
        options: EstimateOptions = DEFAULTS,
        seed: int = 0,
        mapping: Columns | None = None,
    ) -> OffPolicyReport:
        """Estimate the return of a session from logs alone, with a verdict: `ucfrec ope`.

        Reports of several rules or policies are compared by
        `ucfrec.off_policy.selection.choose({"a": report, "b": …}, seed)`.

        Args:
            logs: logs with propensities, as for `fit`; None for the test split of the store.
            options: what is estimated, and how.
            seed: of the folds and the bootstrap.
        """
        trained = self._load_for(logs)
        reading = read_logs(trained, logs, mapping, True, options.measures, options.by)
        with reading as logged:
            return estimate_return(
                (trained, rule or trained.rule),
                logged,
                [_name_logs(logs)],
                options=options,
                seed=seed,
            )

    @_checked
    def evaluate(
        self,
        environment: str | Environment,
        episodes: int = 1000,
        *,
        rule: DecisionRule | None = None,
        behaviors: Iterable[str] = (),
        seed: int = 0,
    ) -> Evaluation:
        """Measure the return in a simulator: `ucfrec evaluate`.

        Args:
            environment: name of a simulator, such as "synthetic-taobao", or an `Environment`.
            episodes: number of episodes of each policy.
            behaviors: built-in policies of the simulator to evaluate beside it, such as "random".
            seed: of the episodes.
        """
        trained = self.trained
        beside = require_list("behaviors", behaviors, "the name of a behavior", str)
        simulated = Environment(environment) if isinstance(environment, str) else environment
        return evaluate_in(
            simulated,
            [(trained, rule or trained.rule)],
            beside,
            episodes=episodes,
            seed=seed,
        )

    @_checked
    def score(
        self,
        logs: Logs,
        *,
        rule: DecisionRule | None = None,
        mapping: Columns | None = None,
    ) -> pd.DataFrame:
        """The policy's probability of every logged choice: `ucfrec score`.

        Args:
            logs: as for `fit`.

        Returns:
            One row per logged step; see `ucfrec.off_policy.score.score`.
        """
        trained = self._load_for(logs)
        with read_logs(trained, logs, mapping, keep_unknown=False) as logged:
            return pd.concat(score(trained, logged, rule), ignore_index=True)

    @_checked
    def update(
        self,
        logs: Logs,
        out: Path | str,
        *,
        window_days: float | None = None,
        refit: bool = True,
        allow_argmax: bool = False,
        mapping: Columns | None = None,
    ) -> Self:
        """Bring the policy up to date with new logs: `ucfrec update`.

        Args:
            logs: new logs, as for `fit`; rows that are not newer than the store are left out.
            out: folder of the new run; the store with the new rows is beside it, with `-store`
                added to its name.
            window_days: leave out sessions that ended longer ago, before the end of the new logs;
                None to keep all.
            refit: go on learning from all rows once both policies are compared.
            allow_argmax: let a decision rule that draws items come to take the best; new logs then
                have no propensities to evaluate from.

        Returns:
            The new recommender; this one is not changed. `trained.record.update` has the drift and
            the verdict on both.
        """
        window = None if window_days is None else round(window_days * DAY_MS)
        append = AppendOptions(window)
        options = UpdateOptions(append, refit=refit, allow_argmax=allow_argmax)
        opened = open_files(self.trained, logs, mapping)
        with opened as (files, columns, frame), use_words_of_python(frame):
            update_run(self.run, files, Path(out), mapping=columns, options=options)
        write_card(Path(out))
        return self.load(out)

    @_checked
    def export(
        self,
        folder: Path | str,
        k: int | None = None,
        *,
        rule: DecisionRule | None = None,
    ) -> Exported:
        """Write the policy with its rule as an ONNX graph: `ucfrec export`.

        Args:
            folder: folder to make.
            k: items that the graph chooses; None for 100, or all if there are fewer.
        """
        with use_words_of_python():
            return export(self.trained, Path(folder), rule=rule, k=k)

    @_checked
    def report(
        self,
        file: Path | str,
        results: ResultTable | Path | str | Iterable[ResultTable | Path | str] = (),
        items: Path | str | None = None,
    ) -> Path:
        """Write one HTML page about the training and results, and return it: `ucfrec report`.

        Args:
            file: HTML file to write.
            results: what `evaluate`, `ope`, `rank` returned, or files of `--json`; one or several.
            items: file with item features to show beside sample recommendations.
        """
        what = "what evaluate, ope or rank returned, or files of --json"
        tables = [results] if isinstance(results, ResultTable) else results
        tables = require_list("results", tables, what, ResultTable, Path, str)
        with tempfile.TemporaryDirectory() as scratch, use_words_of_python():
            files = []
            for number, result in enumerate(tables):
                if isinstance(result, ResultTable):
                    files.append(Path(scratch) / f"{number}.json")
                    result.save(files[-1])
                else:
                    files.append(Path(result))
            write_report(Path(file), [self.run], files, None if items is None else Path(items))
        return Path(file)

    @_checked
    def save(self, folder: Path | str) -> None:
        """Copy the run to a new folder, which `load` and the command line can read."""
        run = self.run
        with atomic_folder(Path(folder)) as scratch:
            shutil.copytree(run, scratch, dirs_exist_ok=True)

    @classmethod
    @_checked
    def load(cls, run: Path | str) -> Self:
        """Load a recommender from a run folder, made by `save`, `fit` or `ucfrec train`."""
        policy = cls()
        policy._trained = TrainedPolicy.load(Path(run).absolute())
        policy.config = config = policy._trained.record.config
        policy.policy, policy.seed = config.policy_name, config.seed
        defaults = asdict(resolve_config(config.policy_name))
        policy.settings = {
            f"{table}.{name}": value
            for table in TABLES
            for name, value in asdict(getattr(config, table)).items()
            if value != defaults[table][name]
        }
        return policy


UCF = Recommender
"""A `Recommender`, whose default policy is the Unified Causal Transformer."""


def _name_logs(logs: Logs | None) -> str:
    """What a model card calls the logs that a measurement is on."""
    if logs is None:
        return TEST_SPLIT
    if isinstance(logs, pd.DataFrame):
        return "a frame"
    files = logs.files if isinstance(logs, LogFiles) else logs
    paths = [files] if isinstance(files, (str, Path)) else files
    return ", ".join(shorten_paths(str(path)) for path in paths)
