"""The command `ucfrec-control`, also as `python -m ucfrec_control`."""

import sys

from ucfrec.processes import run_program


def main() -> int:
    """Run one command; returns its exit status, as `ucfrec.commands.cli.main` does."""
    return run_program("ucfrec_control.cli")


if __name__ == "__main__":
    sys.exit(main())
