"""A whole run (reward model, edits, policy) that `tests.support.killed_loop` kills."""

from pathlib import Path

from tests.support.short_validation import short_validation
from ucfrec.episodes.store import EpisodeStore
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run

SETTINGS = ("train.steps=60", "train.validate_every=5", "policy.dim=16", "policy.context=5")
SETTINGS += ("crm.epochs=3",)


def train(store: Path, run: Path) -> None:
    # A reward model that is fitted too little does not know the rewards of other actions.
    copies = ("augment.copies=1", "augment.actions=1", "crm.epochs=10")
    config = resolve_config("ucf", None, [*SETTINGS, *copies], seed=3)
    with short_validation():
        train_run(EpisodeStore.open(store), run, config)
