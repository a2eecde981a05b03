"""`ucfrec explore`: try out one or two policies in the browser."""

import argparse
import sys
from pathlib import Path

from ucfrec.commands.options import option
from ucfrec.processes import Interrupted

_OWN_NAMES = ("localhost", "127.0.0.1", "[::1]")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec explore`."""
    text = "run folder of `ucfrec train`; two are shown side by side"
    option(parser, "runs", Path, text, "RUN", nargs="+")
    option(
        parser,
        "--items",
        Path,
        "item features to show: Parquet or CSV with a column item_id; title (or name) and "
        "image_url (or image) are shown as such (default: none)",
        "FILE",
    )
    option(
        parser,
        "--results",
        Path,
        "results of `ucfrec ope --json` and `ucfrec evaluate --json`, for the verdict "
        "(default: none)",
        "FILE",
        nargs="+",
        action="extend",
        default=[],
    )
    option(parser, "--port", 8081, "0 for a free one")
    parser.epilog = "Answers this machine only. Needs ucfrec[serve]."


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec explore` until Ctrl-C or TERM.

    Raises:
        InputError: a run or file cannot be used, the extra `serve` is not installed, or the port
            cannot be listened on.
    """
    from ucfrec.exploring.page import Explorer
    from ucfrec.exploring.web import application
    from ucfrec.recommending.server import PrintingServer, listening_socket, server_config
    from ucfrec.reporting.training import read_features
    from ucfrec.runs.trained_policy import TrainedPolicy

    features = None if options.items is None else read_features(options.items)
    runs = [TrainedPolicy.load(run) for run in options.runs]
    explorer = Explorer(runs, features, options.results)
    config = server_config(application(explorer, _OWN_NAMES))
    with listening_socket("127.0.0.1", options.port) as listening:
        try:
            PrintingServer(config, "ucfrec explore", page="/").run([listening])
        except Interrupted:
            print("ucfrec explore: stopped", file=sys.stderr)
