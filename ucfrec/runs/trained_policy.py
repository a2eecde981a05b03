"""A trained policy, read back from its run folder."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import Decider, DecisionRule
from ucfrec.acting.policy_actor import PolicyActor
from ucfrec.checksums import sealed_record
from ucfrec.counterfactual.item_reward_model import FITTED, ItemRewardModel
from ucfrec.episodes.exposure import Likeness
from ucfrec.episodes.item_counts import TrainingCounts
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import ITEM_STATES
from ucfrec.errors import InputError
from ucfrec.files import read_json
from ucfrec.fitting.checkpoint import load_tensors, load_weights
from ucfrec.fitting.random_state import random_state_kept
from ucfrec.parquet_files import read_ids
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.registry import policy_class
from ucfrec.runs.config import config_from_dict
from ucfrec.runs.record import require_run_record

RUN, AUGMENTATION = "run.json", "augmentation.json"
ITEMS, USERS = "items.parquet", "users.parquet"
COUNTS = "training_counts.safetensors"
RETURNS = "training_returns.safetensors"
RULE = "decision_rule.json"
REWARD_MODEL = "reward_model"
INPUTS = (ITEM_STATES, ITEMS, USERS, COUNTS, RETURNS)
"""Files of a run that training does not change."""


@dataclass(frozen=True)
class TrainedPolicy:
    """A policy loaded from a run folder, with all that acting and recommending need."""

    folder: Path
    """The run folder."""
    policy: SequencePolicy
    record: Mapping[str, Any]
    """Content of `run.json`."""
    item_states: ItemStates | None
    """Builds states from items; None if the logged observation is the state."""
    item_ids: npt.NDArray[Any] | None
    """(n_items,) item identifiers in the logs; None if actions are vectors."""
    user_ids: npt.NDArray[Any]
    """(n_users,) user identifiers in the logs; empty if the store has none."""
    training_returns: npt.NDArray[np.float32]
    """(M,) returns-to-go that targets are set for, sorted, in reward units: those of sessions, or
    of steps if a target is set anew at every step (`ReturnToGo.per_session`)."""
    rule: DecisionRule
    """The decision rule of the run."""
    reward_model: ItemRewardModel | None = None
    """Of the rewards of items, for decision rules with a tilt; None if the run fitted none."""
    counts: TrainingCounts | None = None
    """Item counts of the training steps; None if actions are vectors or the run lacks the file."""

    @classmethod
    def load(cls, run: Path, checkpoint: str = "best") -> "TrainedPolicy":
        """Load a policy from a run folder.

        Args:
            run: the folder.
            checkpoint: `best` (lowest validation loss) or `last` weights.

        Raises:
            InputError: `run` is not a run folder, or has no checkpoint yet.
        """
        record = read_record(run)
        config = config_from_dict(record["config"])
        with random_state_kept():
            policy = policy_class(config.policy_name)(config.policy, record["sizes"])
        path = run / "policy" / f"{checkpoint}.safetensors"
        load_weights(path, policy, _weights(path))
        policy.eval()
        states = run / ITEM_STATES
        return cls(
            run,
            policy,
            record,
            ItemStates.load(states) if states.exists() else None,
            _ids(run / ITEMS, schema.ITEM_ID) if states.exists() else None,
            _ids(run / USERS, schema.USER_ID),
            load_tensors(run / RETURNS)[0]["returns"].numpy(),
            _rule(run / RULE),
            _reward_model(run / REWARD_MODEL / FITTED, record["sizes"]),
            TrainingCounts.load(run / COUNTS) if (run / COUNTS).exists() else None,
        )

    def __repr__(self) -> str:
        return f"TrainedPolicy({describe_trained(self.record)})"

    @property
    def name(self) -> str:
        """Name of the learner; see `learner_of`."""
        return learner_of(self.record)

    @cached_property
    def item_index(self) -> "pd.Index[Any]":
        """Looks up `item_ids`."""
        index: pd.Index[Any] = pd.Index(self.item_ids)  # type: ignore[arg-type]
        return index

    @cached_property
    def user_index(self) -> "pd.Index[Any]":
        """Looks up `user_ids`."""
        index: pd.Index[Any] = pd.Index(self.user_ids)
        return index

    @cached_property
    def likeness(self) -> Likeness | None:
        """How alike the items are; None if actions are vectors."""
        return None if self.item_states is None else Likeness.of(self.item_states)

    @property
    def returns(self) -> ReturnToGo:
        """What the returns-to-go of the training counted."""
        return ReturnToGo(**self.record["return_to_go"])

    def target_return(self, quantile: float) -> float:
        """The `quantile` (0 to 1) of `training_returns`, exact, in reward units.

        Raises:
            InputError: the quantile is not between 0 and 1.
        """
        if not 0 <= quantile <= 1:
            raise InputError(f"the target quantile is {quantile}; give a number from 0 to 1")
        return float(np.quantile(self.training_returns.astype(np.float64), quantile))

    def decider(self, rule: DecisionRule | None = None) -> Decider:
        """The policy under `rule`, by default the run's own."""
        rule = rule or self.rule
        likeness = self.likeness if rule.tag_window else None
        return Decider(self.policy, rule, self.returns, self.reward_model, likeness)

    def actor(
        self,
        episodes: int,
        rule: DecisionRule | None = None,
        item_numbers: npt.NDArray[np.int64] | None = None,
        seed: int = 0,
    ) -> PolicyActor:
        """An actor for `episodes` parallel environments.

        Args:
            episodes: number of environments.
            rule: the decision rule; None for the run's own.
            item_numbers: (n_items,) the environment's index of each item, −1 for items that it
                lacks; None if the `item_ids` are these indices.
            seed: of the draws of a rule with a temperature.
        """
        return PolicyActor(
            self.decider(rule),
            episodes,
            self.record["observation_size"],
            self.item_states,
            self.item_ids if item_numbers is None else item_numbers,
            self.user_ids,
            seed,
        )


def read_record(run: Path) -> dict[str, Any]:
    """The content of a run's `run.json`, complete once the run has finished.

    Raises:
        InputError: `run` is not a run folder.
    """
    if not (run / RUN).exists():
        raise InputError(f"{run} is not a run folder: it has no {RUN}; train one first")
    record, sealed = sealed_record(run, RUN, "train again")
    if sealed is not None:
        sealed.require_small()
    require_run_record(run / RUN, record)
    return record


def duplicates_of(record: Mapping[str, Any]) -> str:
    """The rule for duplicates that the logs of a run were prepared with."""
    rule = record.get("data", {}).get("duplicates")
    # Older stores have no such entry, and a store of somebody else may have any.
    return rule if rule in ("highest", "lowest", "first", "last") else "highest"


def describe_trained(record: Mapping[str, Any]) -> str:
    """One line on a run's record: the learner and the size of its training data."""
    facts = [
        repr(learner_of(record)),
        f"trained on {record['train_steps']:,} steps",
        f"{record['train_episodes']:,} episodes",
    ]
    if record["sizes"]["items"]:
        facts.append(f"{record['sizes']['items']:,} items")
    return ", ".join([*facts, f"reward={record['reward']}"])


def learner_of(record: Mapping[str, Any]) -> str:
    """Name of the learner of a run's record.

    Followed by `-augmented` or `-no-augmentation` if the run's use of edited copies is not the
    learner's default.
    """
    config = config_from_dict(record["config"])
    augmented = config.augment.copies > 0
    if augmented == policy_class(config.policy_name).augmented:
        return config.policy_name
    return f"{config.policy_name}-{'augmented' if augmented else 'no-augmentation'}"


def _weights(path: Path) -> dict[str, Tensor]:
    tensors, _ = load_tensors(path)
    return {name: t for name, t in tensors.items() if not name.startswith("optimizer.")}


def _rule(path: Path) -> DecisionRule:
    values = read_json(path)
    if not isinstance(values, Mapping):
        raise InputError(f"{path} is not a decision rule; train the policy again")
    return DecisionRule.from_dict(values, str(path))


def _reward_model(path: Path, sizes: Mapping[str, int]) -> ItemRewardModel | None:
    if not path.exists():
        return None
    model = ItemRewardModel(sizes)
    load_weights(path, model, load_tensors(path)[0])
    return model.eval()


def _ids(path: Path, column: str) -> npt.NDArray[Any]:
    if not path.exists():
        return np.empty(0, dtype=np.int64)
    return read_ids(path, column)
