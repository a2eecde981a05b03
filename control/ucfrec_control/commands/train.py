"""`ucfrec-control train`: train a policy on a store; resumes."""

from typing import Annotated, Literal

import torch

from ucfrec.commands.options import POSITIVE, Names
from ucfrec.commands.train import TrainingOptions
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError, warn_user
from ucfrec.fitting.loop import SILENT
from ucfrec.runs.config import resolve_config
from ucfrec_control.environments.environments import environment_of_data, make_env
from ucfrec_control.training.screening import read_screening
from ucfrec_control.training.selection import select_by_return
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
    screen: Literal["drop", "copies"] | None = None
    """What to do with state dimensions without effect; train without them, or add copies of the
    trajectories that intervene on them (default: not screened)"""
    select_by_return: Annotated[int | None, POSITIVE, "EPISODES"] = None
    """Also keep the weights with the highest return in so many episodes at every validation, as
    checkpoint return (paper, Appendix G.3)"""
    env: str | None = None
    """Environment of --select-by-return (default: that of the data)"""

    def execute(self) -> None:
        """Run `ucfrec-control train`. InputError if --env is given alone, or cannot be made."""
        if self.env is not None and self.select_by_return is None:
            raise InputError("--env is for --select-by-return; leave it out, or give both")
        if self.threads is not None:
            torch.set_num_threads(self.threads)
        store = EpisodeStore.open(self.store)
        preset = preset_of(dataset_of(store), self.policy)
        config = resolve_config(self.policy, self.config, self.set, self.seed, preset.tables)
        steps, warmup = config.train.steps, config.train.warmup
        if warmup >= steps:
            note = f"the learning rate rises to the end: train.warmup_steps is {warmup}, of {steps}"
            warn_user(f"{note} train.steps; set fewer, such as {steps // 20}")
        callbacks = SILENT
        if self.select_by_return is not None:
            env_id = self.env or environment_of_data(dataset_of(store))
            make_env(env_id, 1).close()  # before the training, not at its first validation
            callbacks = select_by_return(self.out, env_id, self.select_by_return)
        record = train_control(store, self.out, config, screening=self.screen, callbacks=callbacks)
        print(record.describe())
        if (screening := read_screening(record)) is not None:
            flagged = ", ".join(map(str, screening.flagged)) or "none"
            print(f"screening     observation columns without effect: {flagged}")
        print(describe_returns(store))
        print(f"\nrun: {self.out}; TensorBoard can open it")
