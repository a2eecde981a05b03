"""The command line of the control adapter."""

import sys
from collections.abc import Sequence

from ucfrec.commands.cli import Program, run

CONTROL = Program(
    "ucfrec-control",
    "Train and evaluate policies on D4RL and Minari datasets.",
    "ucfrec_control.commands",
    {
        "prepare": "a dataset to an episode store",
        "collect": "datasets from a SAC agent, or from a saved agent",
        "convert": "D4RL HDF5 to Minari, or back",
        "distract": "a store with a distractor in its states",
        "screen": "which state dimensions have an effect",
        "screen-all": "screening of every zoo file and distractor; resumes",
        "train": "train a policy on a store; resumes",
        "evaluate": "normalised scores of trained policies",
        "benchmark": "every method on the zoo files; resumes",
        "spread": "how much scores vary between trainings and checkpoints; resumes",
        "contexts": "contexts by score, with other episodes; resumes",
        "rates": "learning rates by validation loss; resumes",
        "robustness": "scores lost to distractors; resumes",
        "reproduce": "one table or figure of the paper; resumes",
        "figures": "figures of runs and result rows",
    },
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status, as `ucfrec.commands.cli.main` does."""
    return run(CONTROL, arguments)


if __name__ == "__main__":
    sys.exit(main())
