"""A trained policy, read back from its run folder."""

from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.policy_actor import PolicyActor
from ucfrec.acting.scorer import Scorer
from ucfrec.arrays import Array, Float32Array, IntArray
from ucfrec.episodes.item_table import OFFERS, IdLookup
from ucfrec.episodes.offers import Offers
from ucfrec.episodes.states import ItemStates, TrainingCounts
from ucfrec.episodes.store import ITEM_STATES, EpisodeStore
from ucfrec.errors import InputError, damage_explained, warn_user
from ucfrec.files.atomic import read_json
from ucfrec.files.parquet import read_ids
from ucfrec.fitting.checkpoint import REMEDY, load_module, load_tensors
from ucfrec.fitting.loop import load_trained
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.registry import policy_class, policy_package
from ucfrec.processes import random_state_kept
from ucfrec.provenance import config_hash, versions
from ucfrec.runs.record import REFIT, RUN, RunRecord, read_record, refit_of_run, store_of
from ucfrec.user_model.reward import FITTED, ItemRewardModel
from ucfrec.user_model.session_end import SessionEnd, load_session_end

AUGMENTATION = "augmentation.json"
ITEMS, USERS = "items.parquet", "users.parquet"
COUNTS = "training_counts.safetensors"
RETURNS = "training_returns.safetensors"
RULE = "decision_rule.json"
REWARD_MODEL = "reward_model"
INPUTS = (ITEM_STATES, OFFERS, ITEMS, USERS, COUNTS, RETURNS)
"""Files of a run that training does not change."""


@dataclass(frozen=True)
class TrainedPolicy:
    """A policy loaded from a run folder, with all that acting and recommending need."""

    folder: Path
    policy: SequencePolicy
    record: RunRecord
    item_states: ItemStates | None
    """Builds states from items; None if the logged observation is the state."""
    item_ids: Array | None
    """(n_items,) item identifiers in the logs; None if actions are vectors."""
    user_ids: Array
    """(n_users,) user identifiers in the logs; empty if the store has none."""
    training_returns: Float32Array
    """(M,) returns-to-go that targets are set for, sorted, in reward units: those of sessions, or
    of steps if a target is set again at every step (`ReturnToGo.per_session`)."""
    rule: DecisionRule
    reward_model: ItemRewardModel | None = None
    """Of the rewards of items, for rules with a reward weight; None if the run fitted none."""
    counts: TrainingCounts | None = None
    """Item counts of the training steps; None if actions are vectors or the run lacks the file."""
    session_end: SessionEnd | None = None
    """When users leave, for decision rules with a lookahead; None if the run fitted none."""
    offers: Offers | None = None
    """When items are available; None where all always are."""

    @classmethod
    def load(
        cls,
        run: Path,
        checkpoint: str = "best",
        in_training: bool = False,
        split: bool = False,
    ) -> "TrainedPolicy":
        """Load a policy from a run folder; warns where its training has not ended.

        Args:
            checkpoint: `best` (lowest validation loss) or `last` weights.
            in_training: whether the training that has not ended is what asks.
            split: the weights that learned from the training split only, which the other splits can
                evaluate; otherwise those of the refit, if the run has one.

        Raises:
            InputError: `run` is not a run folder, or has no checkpoint yet.
        """
        record, folder = read_record(run), run
        if not (in_training or split) and (refit := refit_of_run(run, record)) is not None:
            record, folder = refit, run / REFIT
        if record.policy is None and not in_training:
            warn_user(
                f"the training in {run} has not ended: later weights may be better, and its "
                "decision rule is not chosen yet; train again with the same command"
            )
        _note_other_version(run, record)
        config, path = record.config, folder / "policy" / f"{checkpoint}.safetensors"
        weights, fitted = f"policy/{path.name}", f"{REWARD_MODEL}/{FITTED}"
        record.require(folder, ITEM_STATES, OFFERS, weights, fitted)  # however large
        build = partial(policy_class(config.policy_name), config.policy, record.sizes)
        with random_state_kept():
            policy = load_module(path, build, load_trained(path))
        policy.eval()
        states, models, reward_model = folder / ITEM_STATES, folder / REWARD_MODEL, None
        offers = folder / OFFERS
        if (models / FITTED).exists():
            tensors, _ = load_tensors(models / FITTED)
            build_model = partial(ItemRewardModel, record.sizes)
            reward_model = load_module(models / FITTED, build_model, tensors).eval()
        with damage_explained(folder / RETURNS, REMEDY):
            returns = load_tensors(folder / RETURNS)[0]["returns"]
            is_vector = returns.dim() == 1 and returns.dtype == torch.float32 and len(returns)
            if not is_vector or not bool(torch.isfinite(returns).all()):
                raise ValueError("returns are not a vector of finite numbers")
        trained = cls(
            run,
            policy,
            record,
            ItemStates.load(states) if states.exists() else None,
            _read_ids(folder / ITEMS, schema.ITEM_ID) if states.exists() else None,
            _read_ids(folder / USERS, schema.USER_ID),
            np.asarray(returns.numpy()),
            read_rule(folder / RULE),
            reward_model,
            TrainingCounts.load(folder / COUNTS) if (folder / COUNTS).exists() else None,
            load_session_end(models, reward_model),
            Offers.load(folder / OFFERS, record.sizes["items"]) if offers.exists() else None,
        )
        trained._require_equal_sizes()
        return trained

    def _require_equal_sizes(self) -> None:
        """Check that the files of the run agree in their catalogue and in the size of states."""
        record, states = self.record, self.item_states
        sizes, dropped = record.sizes, record.dropped_observations
        most = record.observation_size + len(dropped)
        if list(dropped) != sorted({*dropped}) or (dropped and dropped[-1] >= most):
            raise InputError(
                f"{self.folder / RUN} is damaged: of {most} columns of the observations it names "
                f"{dropped!s:.60} as dropped; {REMEDY}"
            )
        state = record.observation_size + (0 if states is None else states.size)
        checks: list[tuple[str, Any, Any]] = []
        if states is not None:
            shape = sizes["items"], sizes["action"]
            checks.append((ITEM_STATES, shape, states.embeddings.shape))
            # A store that was not made from logs has no tables of items and users.
            if (self.folder / ITEMS).exists():
                checks.append((ITEMS, sizes["items"], len(self.items)))
            if len(states.user_features) and (self.folder / USERS).exists():
                checks.append((USERS, len(states.user_features), len(self.user_ids)))
        if self.counts is not None:
            shapes = self.counts.shown.shape, self.counts.liked.shape
            checks.append((COUNTS, ((sizes["items"],),) * 2, shapes))
        for name, stated, actual in (*checks, (RUN, sizes["state"], state)):
            if stated != actual:
                raise InputError(
                    f"{self.folder / name} does not fit the run: it has {actual}, the run "
                    f"{stated}; {REMEDY}"
                )

    def __repr__(self) -> str:
        return f"TrainedPolicy({self.record.summary})"

    @property
    def name(self) -> str:
        """Name of the method; see `RunRecord.name`."""
        return self.record.name

    @cached_property
    def fingerprint(self) -> str:
        """A hash of data, configuration and weights that tells trained runs apart."""
        weights = {name: seal for name, seal in self.record.files.items() if "safetensors" in name}
        of = {"data": self.record.fingerprint, "config": self.record.settings, "weights": weights}
        return config_hash(of)

    @cached_property
    def items(self) -> IdLookup:
        """Looks up `item_ids`."""
        assert self.item_ids is not None
        return IdLookup(self.item_ids)

    @cached_property
    def users(self) -> IdLookup:
        """Looks up `user_ids`."""
        return IdLookup(self.user_ids)

    @property
    def logged_observation_size(self) -> int:
        """Columns that observations must have; 0 if the policy sees none."""
        size = self.record.observation_size
        return size and size + len(self.record.dropped_observations)

    def training_store(self) -> EpisodeStore | None:
        """The store that the run was trained on; see `store_of`."""
        return store_of(self.folder, self.record)

    def require_store(self, remedy: str) -> EpisodeStore:
        """`training_store`; an `InputError` that ends with `remedy` if it is gone or changed."""
        store = self.training_store()
        if store is None:
            raise InputError(
                f"{self.folder}: its store {self.record.store} is gone or has changed; {remedy}"
            )
        return store

    def target_return(self, quantile: float) -> float:
        """The exact `quantile` (0 to 1, else InputError) of `training_returns`, in reward units."""
        if not 0 <= quantile <= 1:
            raise InputError(f"the target quantile is {quantile}; give a number from 0 to 1")
        return float(np.quantile(self.training_returns.astype(np.float64), quantile))

    def scorer(self, rule: DecisionRule | None = None) -> Scorer:
        """The policy under `rule`, by default the run's own; InputError if it does not fit. The
        weights must not change after the first call."""
        return self._scorer.under(rule or self.rule)

    @cached_property
    def _scorer(self) -> Scorer:
        return Scorer(
            self.policy,
            self.rule,
            self.item_states,
            self.record.return_to_go,
            self.reward_model,
            self.session_end,
        )

    def item_scorer(self, rule: DecisionRule | None = None) -> Scorer:
        """`scorer` of a policy of items; an `InputError` if its actions are vectors."""
        if self.item_states is None:
            raise InputError(
                "this policy's actions are vectors; recommending needs a policy trained on items"
            )
        return self.scorer(rule)

    def actor(
        self,
        episodes: int,
        rule: DecisionRule | None = None,
        item_numbers: IntArray | None = None,
        seed: int = 0,
    ) -> PolicyActor:
        """An actor for `episodes` parallel environments.

        Args:
            rule: the decision rule; None for the run's own.
            item_numbers: (n_items,) the environment's index of each item, −1 for items that it
                lacks; None if the `item_ids` are these indices.
            seed: of the draws of a rule with a temperature.
        """
        return PolicyActor(
            self.scorer(rule),
            episodes,
            self.record.observation_size,
            self.item_states,
            self.item_ids if item_numbers is None else item_numbers,
            self.user_ids,
            seed,
            self.record.dropped_observations,
        )


def read_rule(path: Path) -> DecisionRule:
    """The decision rule in a file of a run; InputError if it holds something else."""
    return DecisionRule.from_dict(read_json(path), str(path))


def _note_other_version(run: Path, record: RunRecord) -> None:
    """Warn if the policy is a plug-in that is installed in another version, or from elsewhere."""
    name, package = record.config.policy_name, record.policy_package
    if package is None:
        return
    now = policy_package(name)
    trained = f"{package} {record.versions.get(package, '')}"
    if trained != (installed := f"{now} {versions([now] if now else []).get(now, '')}"):
        warn_user(
            f"{run} was trained with {trained}, but {installed} is installed: its policy {name!r} "
            "may behave differently"
        )


def _read_ids(path: Path, column: str) -> Array:
    return read_ids(path, column) if path.exists() else np.empty(0, dtype=np.int64)


@dataclass(frozen=True)
class RunOnWorkers:
    """Which policy the workers load; small, as it is sent to them with each task."""

    folder: Path
    checkpoint: str
    fingerprint: str

    @lru_cache(maxsize=1)  # noqa: B019
    def load(self) -> TrainedPolicy:
        """The policy, kept for the worker's next task; InputError if the folder has no such run."""
        # A worker has one core; the cluster runs as many workers as it has cores.
        torch.set_num_threads(1)
        trained = TrainedPolicy.load(self.folder, self.checkpoint)
        if trained.fingerprint != self.fingerprint:
            raise InputError(
                f"{self.folder} has changed since the command started, or is another folder on a "
                "worker; run it again once all workers see the same run"
            )
        return trained
