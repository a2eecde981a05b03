"""`ucfrec-control screen`: which state dimensions have an effect."""

import dataclasses
from pathlib import Path
from typing import Annotated

from ucfrec.commands.options import ARGUMENT, SEED, Table
from ucfrec.episodes.store import EpisodeStore
from ucfrec.files.atomic import write_json
from ucfrec.provenance import provenance
from ucfrec_control.data.trajectories import PACKAGES
from ucfrec_control.training.screening import screen_store


class Screen(Table):
    """`ucfrec-control screen`."""

    store: Annotated[Path, ARGUMENT]
    """Episode store to screen."""
    seed: Annotated[int, SEED] = 0
    """Of the predictors."""
    json: Path | None = None
    """Write the report here."""

    def execute(self) -> None:
        """Run `ucfrec-control screen`."""
        report = screen_store(EpisodeStore.open(self.store), self.seed)
        print(report.describe())
        if self.json is not None:
            write_json(self.json, dataclasses.asdict(report) | provenance(PACKAGES))
