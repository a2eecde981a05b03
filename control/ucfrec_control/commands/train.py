"""`ucfrec-control train`: train a policy on a store; resumes."""

from typing import Annotated

import torch

from ucfrec.commands.options import Names
from ucfrec.commands.train import TrainingOptions
from ucfrec.episodes.store import EpisodeStore
from ucfrec.runs.config import resolve_config
from ucfrec_control.training.train import (
    control_policies,
    dataset_of,
    describe_returns,
    preset_of,
    train_control,
)


class Train(TrainingOptions):
    """`ucfrec-control train`."""

    policy: Annotated[str, "NAME", Names(control_policies, closed=True)] = "ucf"
    """Policy."""

    def execute(self) -> None:
        """Run `ucfrec-control train`."""
        if self.threads is not None:
            torch.set_num_threads(self.threads)
        store = EpisodeStore.open(self.store)
        preset = preset_of(dataset_of(store), self.policy)
        config = resolve_config(self.policy, self.config, self.set, self.seed, preset.tables)
        record = train_control(store, self.out, config, screening=self.screen)
        print(record.describe())
        print(describe_returns(store))
        print(f"\nrun: {self.out}; TensorBoard can open it")
