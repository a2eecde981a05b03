"""A trained policy on the workers of a cluster, which load it from its folder once each."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch

from ucfrec.errors import InputError
from ucfrec.runs.trained_policy import TrainedPolicy


@dataclass(frozen=True)
class RunOnWorkers:
    """Which policy the workers load; small, as it is sent to them with each task."""

    folder: Path
    """The run folder, which every worker sees."""
    checkpoint: str
    """`best` or `last` weights."""
    fingerprint: str

    @classmethod
    def of(cls, trained: TrainedPolicy, checkpoint: str) -> "RunOnWorkers":
        """The policy that was loaded with this checkpoint."""
        return cls(trained.folder.absolute(), checkpoint, trained.fingerprint)

    def load(self) -> TrainedPolicy:
        """The policy; kept for the next task of this worker.

        Raises:
            InputError: the folder is missing there, or holds another run.
        """
        return _loaded(self)


@lru_cache(maxsize=1)
def _loaded(run: RunOnWorkers) -> TrainedPolicy:
    # A worker has one core; the cluster runs as many workers as it has cores.
    torch.set_num_threads(1)
    trained = TrainedPolicy.load(run.folder, run.checkpoint)
    if trained.fingerprint != run.fingerprint:
        raise InputError(
            f"{run.folder} has changed since the command started, or is another folder on a "
            "worker; run it again once all workers see the same run"
        )
    return trained
