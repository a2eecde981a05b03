"""The command line of the control adapter."""

import sys
from collections.abc import Sequence

from ucfrec.commands.cli import Program, run

CONTROL = Program(
    "ucfrec-control",
    "Train and evaluate policies on D4RL and Minari datasets.",
    "ucfrec_control.commands",
    {
        "prepare": "convert a dataset to an episode store",
        "collect": "record a dataset of a saved agent",
        "convert": "convert D4RL HDF5 to Minari, or back",
        "distract": "add a distractor to the states of a store",
        "screen": "find state dimensions that have no effect",
        "train": "train a policy on a store; resumes",
        "evaluate": "measure returns and scores of trained policies",
        "ope": "estimate the return of a policy from trajectories",
        "export": "write a policy as an ONNX graph",
        "benchmark": "measure every method on the zoo files; resumes",
        "robustness": "measure scores lost to distractors; resumes",
        "reproduce": "reproduce a table or figure of the paper; resumes",
        "figures": "draw figures of runs and result rows",
    },
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status, as `ucfrec.commands.cli.main` does."""
    return run(CONTROL, arguments)


if __name__ == "__main__":
    sys.exit(main())
