"""The command `ucfrec-control`, also as `python -m ucfrec_control`."""

import sys

from ucfrec.processes import end_at_once_when_interrupted, ignore_interruptions, print_anywhere


def main() -> int:
    """Run one command; returns its exit status, as `ucfrec.commands.cli.main` does."""
    end_at_once_when_interrupted()
    print_anywhere()
    from ucfrec_control.cli import main as run

    try:
        return run()
    finally:
        ignore_interruptions()


if __name__ == "__main__":
    sys.exit(main())
