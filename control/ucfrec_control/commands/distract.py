"""`ucfrec-control distract`: a store with a distractor in its states."""

from pathlib import Path
from typing import Annotated

from ucfrec.commands.options import ARGUMENT, SEED, Table
from ucfrec.episodes.store import EpisodeStore
from ucfrec_control.data.distractor import add_distractor


class Distract(Table):
    """`ucfrec-control distract`."""

    store: Annotated[Path, ARGUMENT]
    """Episode store."""
    out: Annotated[Path, "STORE"]
    """Folder of the new store."""
    flip: float = 0.0
    """Probability that it is wrong."""
    early: bool = False
    """Indicate the next step's reward."""
    seed: Annotated[int, SEED] = 0
    """Of the distractor."""

    def execute(self) -> None:
        """Run `ucfrec-control distract`."""
        store = EpisodeStore.open(self.store)
        add_distractor(store, self.out, self.flip, self.seed, self.early)
        print(f"store: {self.out}; dimension {store.observation_size} is the distractor")
