"""`run.json`, the record of a run: provenance, configuration and the report of every stage."""

import math
import os
from collections.abc import Container, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    TypeAdapter,
)

from ucfrec.acting.decision import SavedRule
from ucfrec.choosing.choice import RankingReport, RuleEvidence, RuleRecord
from ucfrec.counterfactual.augmentation import AugmentationReport
from ucfrec.episodes.item_table import ITEM_STATES
from ucfrec.episodes.record import Source, StoreRecord
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError, damage_explained
from ucfrec.files.atomic import read_json
from ucfrec.files.record import RUN_RECORD, SMALL, Count, Entry, Number, Record, Text
from ucfrec.fitting.loop import Fit
from ucfrec.policies.registry import BUILT_IN, policy_class, policy_names
from ucfrec.results.evidence import Evidence, Relation
from ucfrec.runs.config import Config, config_from_dict
from ucfrec.schema import SessionBy
from ucfrec.user_model.reward_report import ItemRewardReport

_Report = TypeVar("_Report")
_REFERENCES = (("popularity", "by popularity"), ("uniform", "at random"))
RUN = RUN_RECORD
REFIT = "refit"
"""Folder in that of a run, a run of its own, whose weights have learned from all rows."""
STORE_SUFFIX = "-store"
"""Added to the name of a run, it is the default name of its own store beside it."""
CANDIDATES = "candidates.json"
"""File of the decision rules that the choice tried."""


def _complete(sizes: dict[str, int]) -> dict[str, int]:
    of_items = {"users", "tags"} if sizes.get("items") else set()
    if missing := {"state", "action", "items", *of_items} - sizes.keys():
        raise ValueError(f"there is no size {', '.join(sorted(missing))}")
    return sizes


def _whole(value: object) -> object:
    if isinstance(value, Mapping) and value.keys() != {"definition", "horizon"}:
        raise ValueError("it needs definition and horizon")
    return value


def _levels(quantiles: dict[str, float]) -> dict[str, float]:
    if not quantiles or not all(0 <= float(level) <= 1 for level in quantiles):
        raise ValueError("there are none, or one is not of a share")
    return quantiles


class TrainingRecord(Record):
    """What every training records, of whatever library."""

    FILE: ClassVar[str] = RUN
    KIND: ClassVar[str] = f"a run folder: it has no {RUN}; train one first"
    REMEDY: ClassVar[str] = "train it again"

    library: Text = "ucfrec"
    """What trained the policy."""
    command: Text
    config: Any
    """Settings."""
    policy: Any = None
    """Report of the training; None until it has ended."""
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**32)]
    fingerprint: Text
    """Of the store."""
    sizes: Annotated[dict[str, Count], AfterValidator(_complete)]
    """Of states, actions, the catalogue (0 for vectors), its tags and the users."""
    data: Source
    """What the store was made from."""
    versions: dict[Text, Text]
    """Of packages."""
    wall_time_s: Number
    """Of all stages, resumptions included."""
    dropped_observations: tuple[Count, ...] = ()
    """Columns of the logged observation that the policy does not see, ascending."""
    extra: dict[Text, Any] = Field(default_factory=dict)
    """Entries of the program that trained it, which `ucfrec` keeps and does not read."""


class Candidate(Entry):
    """A decision rule that was tried, with what was measured of it."""

    model_config = ConfigDict(extra="allow")

    rule: SavedRule
    value: Number | None = None
    """Mean return of a session in the user model; None for a rule that was not simulated."""
    evidence: RuleEvidence | None = None


class UpdateVerdict(Entry):
    """Whether a new run is better than the old one (`ucfrec.updating.verdict`)."""

    decided_by: Text
    """The measure that decides."""
    differences: dict[Text, Evidence]
    """By each measure, what the newest rows say of the new run against the old one."""
    steps: Count
    """Rows that the runs are compared on, which neither was trained on."""
    users: Count

    @property
    def harms(self) -> str:
        """The measures by which the new run is reliably worse, with their evidence; "" for none."""
        return "; ".join(
            f"{measure} {evidence.format()}"
            for measure, evidence in self.differences.items()
            if evidence.standing() == "worse"
        )

    @property
    def result(self) -> Relation:
        """Worse if it harms any measure, else what the deciding one shows."""
        return "worse" if self.harms else self.differences[self.decided_by].standing()


class Update(Entry):
    """How a run came from an older one (`ucfrec.updating.update`)."""

    of: Text
    """Name of the older run."""
    run: Text
    """Its fingerprint."""
    settings_from_nothing: dict[str, Any]
    """Those of a training that does not start from the weights of another run."""
    episodes: Annotated[int, Field(ge=1)]
    """Number of episodes of the new logs, which are the last of the store."""
    appended: dict[str, Any]
    """Other counts of the new logs; see `ucfrec.logs.append.append_logs`."""
    drift: dict[str, Any] | None = None
    """See `ucfrec.updating.verdict`."""
    verdict: UpdateVerdict | None = None


class RunRecord(TrainingRecord):
    """The content of `run.json`; entries of stages that have not ended are None."""

    library: Literal["ucfrec"] = "ucfrec"
    config: Annotated[Config, PlainValidator(config_from_dict), PlainSerializer(asdict)]
    store: Text
    """Folder of the store when the run began."""
    policy_package: Text | None = None
    """Distribution that the policy is a plug-in of, whose version is in `versions`; None if the
    policy is built in."""
    store_from_run: Text | None
    """The same as seen from the run; None on another drive of Windows."""
    reward: Text
    """The expression that computed the rewards."""
    session_by: SessionBy | None
    session_gap_ms: Count | None
    observation_size: Count
    train_episodes: Count
    train_steps: Count
    return_to_go: Annotated[ReturnToGo, BeforeValidator(_whole)]
    return_quantiles: Annotated[dict[str, Number], AfterValidator(_levels)]
    """Of the training sessions' returns, by share."""
    mean_return: Number
    reference_losses: dict[str, Number] | None = None
    """Mean negative log-likelihood (nats) of the logged items over all validation steps: `uniform`
    if all are equally probable, `popularity` if their probability is their share of the training
    steps, with one added to every count. None if actions are vectors."""
    refit_of: dict[str, Any] | None = None
    """Configuration and rule of the run that this one repeats on all rows (`ucfrec.runs.refit`)."""
    update: Update | None = None
    """None for a run that was trained from scratch."""
    augmentation: AugmentationReport | None = None
    policy: Fit | None = None
    reward_model: ItemRewardReport | None = None
    rule: RuleRecord | None = None
    ranking: RankingReport | None = None
    """Of a policy of items whose rule was not chosen."""

    @classmethod
    def of(cls, value: Mapping[str, Any], path: Path) -> Self:
        """See `Record.of`; a policy that is not installed or cannot be imported is no damage."""
        config = value.get("config")
        name = config.get("policy_name") if isinstance(config, Mapping) else None
        if isinstance(name, str) and name not in BUILT_IN:
            if name not in policy_names():
                package, numbers = str(value.get("policy_package") or ""), value.get("versions")
                number = numbers.get(package, "") if isinstance(numbers, Mapping) else ""
                source = f"package {package} {number}".rstrip() if package else "an unknown package"
                raise InputError(
                    f"{path}: trained with policy {name!r} (of {source}), which is not installed: "
                    "install it"
                )
            policy_class(name)
        return super().of(value, path)

    @property
    def name(self) -> str:
        """Name of the method, with a suffix if its use of augmentation is not the default."""
        name, augmented = self.config.policy_name, self.config.augment.augments
        if augmented == policy_class(name).augmented:
            return name
        return f"{name}-{'augmented' if augmented else 'no-augmentation'}"

    @property
    def summary(self) -> str:
        """One line: the method and the size of its training data."""
        items = f"{self.sizes['items']:,} items, " if self.sizes["items"] else ""
        return (
            f"{self.name!r}, trained on {self.train_steps:,} steps, {self.train_episodes:,} "
            f"episodes, {items}reward={self.reward}"
        )

    @property
    def settings(self) -> dict[str, Any]:
        """The configuration as JSON, for hashes and tables."""
        return asdict(self.config)

    @property
    def finished(self) -> Fit:
        """The report of the policy's training; InputError if it has not ended."""
        if self.policy is None:
            raise InputError("the training of the run has not ended; train it to its end first")
        return self.policy

    def is_of(self, store: StoreRecord) -> bool:
        """Whether the run was trained on a store: on the same steps and item states."""
        run_states, store_states = self.files.get(ITEM_STATES), store.files.get(ITEM_STATES)
        # A store whose states a caller made lists no file of them.
        same_states = run_states is None or store_states is None or run_states == store_states
        return self.fingerprint == store.fingerprint and same_states

    def learned_nothing(self, logged: Container[str]) -> str:
        """A warning if a policy of items predicts logged choices no better than popularity or
        chance does.

        Args:
            logged: names of the scalars that the training logged; without `action_loss` among them,
                the validation loss is not a log-likelihood of items and cannot be compared.

        Returns:
            What was found and what to do; empty if nothing was, or can be compared.
        """
        best = math.nan if self.policy is None else self.policy.best_validation
        losses = self.reference_losses or {}
        least, how = min((losses.get(name, math.inf), how) for name, how in _REFERENCES)
        if "action_loss" not in logged or not best >= least:
            return ""
        return (
            f"the best validation loss, {best:.4g}, is not below {least:.4g}, the loss of "
            f"showing items {how}: the policy learned nothing about users; add features of users "
            "and items or more history, train with more steps, or use --policy recent-clicks "
            "(expected where the log was drawn at random)"
        )

    def describe(self, logged: Container[str] = ()) -> str:
        """What a finished run did, a few lines of text; `logged` as in `learned_nothing`."""
        lines = [] if self.augmentation is None else _describe_augmentation(self.augmentation)
        fit = self.finished
        outcome = f"best validation loss {fit.best_validation:.4g} at step {fit.best_step}"
        if self.refit_of is not None:
            outcome = f"trained on all rows, up to step {fit.best_step}"
        lines.append(f"policy        {outcome} of {fit.steps}, {fit.seconds:.0f} s")
        if warning := self.learned_nothing(logged):
            lines.append(f"warning       {warning}")
        if self.rule is not None and self.reward_model is not None:
            lines += _describe_rule(self.rule, self.reward_model, self.mean_return)
        if (ranking := self.ranking) is not None and self.rule is None:
            lines.append(
                f"ranking       NDCG@10 {ranking.ndcg:.3f}, hit rate {ranking.hits:.3f} at "
                f"{ranking.rows:,} validation rows; items shown most lately have "
                f"{ranking.baseline_ndcg:.3f}, {ranking.baseline_hits:.3f}"
            )
        return "\n".join(lines)


def read_record(run: Path) -> RunRecord:
    """The record of a run, its small files verified; InputError if damaged, or no run folder."""
    record = RunRecord.read(run)
    record.require(run, small=SMALL)
    return record


def refit_of_run(run: Path, record: RunRecord) -> RunRecord | None:
    """The record of a run's finished refit; None without one.

    A refit whose training or last steps were interrupted is not used.
    """
    if not (run / REFIT / RUN).is_file():
        return None
    refit = read_record(run / REFIT)
    whole = refit.policy is not None and (refit.rule is None) == (record.rule is None)
    return refit if whole else None


def read_candidates(run: Path) -> tuple[Candidate, ...]:
    """The decision rules that the choice of a run tried, if any. InputError if they are damaged."""
    path = run / CANDIDATES
    return _read_stage(path, tuple[Candidate, ...]) if path.exists() else ()


def read_augmentation(path: Path) -> AugmentationReport:
    """The report of an augmentation, even during training; InputError if it is damaged."""
    return _read_stage(path, AugmentationReport)


def _read_stage(path: Path, kind: type[_Report]) -> _Report:
    with damage_explained(path, RunRecord.REMEDY):
        return TypeAdapter(kind).validate_python(read_json(path))


def place_of(store: Path, run: Path) -> dict[str, str | None]:
    """Entries of the record of a run: where its store lies, and as seen from the run."""
    store, seen_from_run = store.resolve(), None
    with suppress(ValueError):  # there is no path to another drive of Windows
        seen_from_run = os.path.relpath(store, run.resolve())
    return {"store": str(store), "store_from_run": seen_from_run}


def store_of(run: Path, record: RunRecord) -> EpisodeStore | None:
    """The store that a run was trained on; None where it is gone or changed.

    It is looked for where it lies as seen from the run, so that both can be moved or copied
    together, and where it lay when the run was trained. InputError if it is damaged.
    """
    seen_from_run = os.path.normpath(run.resolve() / (record.store_from_run or record.store))
    for path in (Path(seen_from_run), Path(record.store)):
        if (path / StoreRecord.FILE).is_file():
            store = EpisodeStore.open(path)
            if record.is_of(store.record):
                return store
    return None


def verify_run(run: Path) -> None:
    """Read every file of a finished run and compare it with its checksum; InputError if one has
    another, or the run is not finished."""
    record = read_record(run)
    if record.policy is None:
        raise InputError(f"{run} cannot be verified: its training has not ended; train it again")
    for name, fault in record.faults(run):
        raise InputError(f"{run / name} {fault}; restore the file, or train again")
    if (run / REFIT / RUN).is_file():
        verify_run(run / REFIT)


def _describe_augmentation(report: AugmentationReport) -> list[str]:
    lines = []
    if report.proposals:
        lines.append(
            f"augmentation  {report.copies:,} augmented episodes, {report.acceptance:.1%} of their "
            "edits accepted"
        )
    if (actions := report.actions) is not None:
        lines.append(f"other actions {actions.copies:,} augmented steps of {actions.proposals:,}")
    lines.append(
        f"bound         δ + ε_r = {report.delta:.3g} + {report.epsilon_r:.3g}: {report.verdict}"
    )
    return [*lines, *(f"warning       {warning}" for warning in report.warnings)]


def _describe_rule(choice: RuleRecord, model: ItemRewardReport, logged: float) -> list[str]:
    """Lines on the user model, the rule, and its estimated return, or why there is none."""
    indent = " " * 14
    lines = [
        f"user model    held-out loss {model.loss:.4f}, "
        f"{model.item_loss - model.loss:.4f} below that of item effects alone",
        f"decision rule {choice.rule}",
    ]
    if (estimate := choice.estimate) is None:
        return [
            *lines,
            f"{indent}It ranked best of {choice.tried} rules in the validation period.",
            f"{indent}Selected by the {choice.chosen_by}{choice.warning}",
        ]
    lines += [
        f"{indent}Of {choice.tried} ways to turn the policy into recommendations, tried on "
        "simulated users, it has the best return",
        f"{indent}(or one level with it) that the log supports.",
    ]
    if estimate.doubts:
        lines += [f"{indent}Its return is not estimated: {doubt}." for doubt in estimate.doubts]
    else:
        first, second = estimate.halves
        lines.append(
            f"{indent}Estimated return of a session: {estimate.value:.4g} ± {estimate.error:.2g}, "
            f"of the halves {first:.4g} and {second:.4g}; logged sessions have {logged:.4g}."
        )
    lines[-1] += choice.warning.replace("; WARNING", f"\n{indent}WARNING")
    return lines
