"""The command `ucfrec`, also as `python -m ucfrec`."""

import sys

from ucfrec.processes import run_program


def main() -> int:
    """Run one command; returns its exit status, as `ucfrec.commands.cli.main` does."""
    return run_program("ucfrec.commands.cli")


if __name__ == "__main__":
    sys.exit(main())
