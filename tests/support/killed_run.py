"""A whole run (reward model, edits, policy) killed at random moments until it gets to its end.

    python killed_run.py STORE RUN

Prints how often it was killed.
"""

import random
import sys
from pathlib import Path

import torch

from tests.support.killed_training import life, optimizer_imported
from tests.support.short_validation import short_validation
from ucfrec.episodes.store import EpisodeStore
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run

SETTINGS = (
    "train.steps=60",
    "train.validate_every=5",
    "policy.dim=16",
    "policy.context=5",
    "crm.epochs=3",
)


def train(store: Path, run: Path) -> None:
    # A reward model that is fitted too little does not know the rewards of other actions.
    copies = ("augment.copies=1", "augment.actions=1", "crm.epochs=10")
    config = resolve_config("ucf", None, [*SETTINGS, *copies], seed=3)
    with short_validation():
        train_run(EpisodeStore.open(store), run, config)


def main() -> None:
    torch.set_num_threads(1)
    optimizer_imported()
    store, run = map(Path, sys.argv[1:])
    moments, killed = random.Random(0), 0
    while not life(
        lambda folder: train(store, folder), run, moments.uniform(0.1, 1.0) * 1.5**killed
    ):
        killed += 1
    print(killed)


if __name__ == "__main__":
    main()
