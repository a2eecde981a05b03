"""`ucfrec screen`: which logged observation columns have no effect."""

import argparse
from pathlib import Path

from ucfrec.files.remote import Input, uri_or_path


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec screen`."""
    parser.add_argument(
        "store", type=uri_or_path(Input, Path), metavar="STORE", help="episode store to screen"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the predictors (default: 0)")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write the report here (default: none)"
    )


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec screen`.

    Raises:
        InputError: the store has no logged observations, or too few episodes.
    """
    from dataclasses import asdict

    from ucfrec.counterfactual.screening import describe_screening
    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.files.atomic import write_json
    from ucfrec.provenance import provenance
    from ucfrec.runs.screened import screen_store

    report = screen_store(EpisodeStore.open(options.store), options.seed)
    print(describe_screening(report))
    if options.json is not None:
        write_json(options.json, asdict(report) | provenance())
