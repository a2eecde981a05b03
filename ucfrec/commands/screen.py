"""`ucfrec screen`: which logged observation columns have no effect."""

import argparse
from pathlib import Path

from ucfrec.commands.options import INPUT_FOLDER, option


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec screen`."""
    option(parser, "store", INPUT_FOLDER, "episode store to screen", "STORE")
    option(parser, "--seed", 0, "seed of the predictors")
    option(parser, "--json", Path, "write the report here (default: none)", "FILE")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec screen`.

    Raises:
        InputError: the store has no logged observations, or too few episodes.
    """
    from dataclasses import asdict

    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.files.atomic import write_json
    from ucfrec.provenance import provenance
    from ucfrec.runs.screened import screen_store

    report = screen_store(EpisodeStore.open(options.store), options.seed)
    print(report.describe())
    if options.json is not None:
        write_json(options.json, asdict(report) | provenance())
