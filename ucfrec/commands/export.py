"""`ucfrec export`: write a policy with its rule as an ONNX graph."""

import argparse
from pathlib import Path

from ucfrec.commands.options import option, rule_given, rule_options, run_option


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec export`."""
    run_option(parser)
    option(parser, "--onnx", Path, "folder to make, with the graph", "OUT", required=True)
    option(parser, "--k", int, "items that the graph chooses (default: 100, or all if fewer)")
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
