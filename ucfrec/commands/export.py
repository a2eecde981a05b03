"""`ucfrec export`: write a policy with its rule as an ONNX graph."""

import argparse
from pathlib import Path

from ucfrec.commands.options import rule_given, rule_options


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec export`."""
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder of `ucfrec train`")
    parser.add_argument(
        "--onnx", type=Path, required=True, metavar="OUT", help="folder to make, with the graph"
    )
    parser.add_argument(
        "--k", type=int, help="items that the graph chooses (default: 100, or all if fewer)"
    )
    rule_options(parser)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec export`: write the graph, compare it with torch, and describe it.

    Raises:
        InputError: the run cannot be used or exported.
    """
    from ucfrec.recommending.export import export
    from ucfrec.runs.trained_policy import TrainedPolicy

    trained = TrainedPolicy.load(options.run, options.checkpoint)
    written = export(trained, options.onnx, rule=rule_given(options, trained), k=options.k)
    print(
        f"{options.onnx}: {written.size / 1e6:,.1f} MB, scores equal torch's to "
        f"{written.difference:.1g}"
    )
