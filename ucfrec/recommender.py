"""UCF in three lines of Python: fit, recommend, save and load."""

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import pandas as pd

from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.recommending.recommend import Histories, recommend
from ucfrec.runs.config import config_from_dict, resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy


class UCF:
    """Unified Causal Transformer: counterfactual copies and the hybrid policy (Algorithm 1).

    Example::

        policy = UCF(settings=["train.steps=2000"]).fit(EpisodeStore.open("store"))
        policy.recommend(histories, k=10)
    """

    def __init__(self, policy: str = "ucf", settings: Sequence[str] = (), seed: int = 0) -> None:
        """Args:
        policy: learner, "ucf" or a baseline (`ucfrec.policies.registry.POLICIES`).
        settings: `table.field=value`, as the command line's `--set`.
        seed: of everything random.

        Raises:
            InputError: a setting is unknown.
        """
        self.config = resolve_config(policy, None, settings, seed)
        self._scratch: tempfile.TemporaryDirectory[str] | None = None
        self._folder: Path | None = None

    def fit(self, store: EpisodeStore, out: Path | str | None = None) -> Self:
        """Train on the store's training episodes.

        Args:
            out: run folder, resumed from if training was interrupted; None for a temporary one.
        """
        if out is None:
            self._scratch = tempfile.TemporaryDirectory(prefix="ucfrec-")
            out = Path(self._scratch.name) / "run"
        self._folder = Path(out)
        train_run(store, self._folder, self.config)
        return self

    @property
    def run(self) -> Path:
        """The run folder.

        Raises:
            InputError: `fit` comes first.
        """
        if self._folder is None:
            raise InputError("this policy is not trained yet; call fit(store) or UCF.load(run)")
        return self._folder

    @property
    def trained(self) -> TrainedPolicy:
        """The policy with the best weights on validation."""
        return TrainedPolicy.load(self.run)

    def recommend(
        self,
        histories: pd.DataFrame,
        k: int = 10,
        *,
        target_return: float | None = None,
        filter_seen: bool = True,
    ) -> pd.DataFrame:
        """The `k` best next items of every user.

        Args:
            histories: `user_id`, `item_id`, `timestamp` and `reward`, one row an interaction.
            target_return: asked of what follows; None for the largest training return.
            filter_seen: leave out items of the user's own history.

        Returns:
            `user_id`, `rank` (from 1), `item_id`, `score` (log-probability), k rows a user.

        Raises:
            InputError: a column is missing, or an item is unknown to the policy.
        """
        trained = self.trained
        target = trained.target_return(1.0) if target_return is None else target_return
        batch = Histories.from_frame(histories)
        (frame,) = recommend(trained, [batch], k, target_return=target, filter_seen=filter_seen)
        return frame

    def save(self, folder: Path | str) -> None:
        """Copy the run to a new folder, which `load` and the command line read."""
        shutil.copytree(self.run, folder)

    @classmethod
    def load(cls, run: Path | str) -> Self:
        """A policy from a run folder.

        Raises:
            InputError: the folder holds no run.
        """
        record = TrainedPolicy.load(Path(run)).record
        policy = cls()
        policy.config = config_from_dict(record["config"])
        policy._folder = Path(run)
        return policy
