"""`ucfrec-control train`: train a policy on a store; resumes."""

import argparse

import torch

from ucfrec.commands.train import training_options
from ucfrec.episodes.store import EpisodeStore
from ucfrec.runs.config import resolve_config
from ucfrec_control.training.train import control_policies, dataset_of, preset_of, train_control


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `train`."""
    training_options(parser, control_policies())


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control train`."""
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    store = EpisodeStore.open(options.store)
    preset = preset_of(dataset_of(store), options.policy)
    config = resolve_config(
        options.policy, options.config, options.set, options.seed, preset.tables
    )
    record = train_control(store, options.out, config, screening=options.screen)
    print(record.describe())
    print(f"\nrun: {options.out}; TensorBoard can open it")
