"""The command `ucfrec`, also as `python -m ucfrec`."""

import sys

from ucfrec.processes import end_at_once_when_interrupted, ignore_interruptions, print_anywhere


def main() -> int:
    """Run one `ucfrec` command; returns its exit status, as `ucfrec.commands.cli.main` does."""
    end_at_once_when_interrupted()
    print_anywhere()
    from ucfrec.commands.cli import main as run

    try:
        return run()
    finally:
        ignore_interruptions()


if __name__ == "__main__":
    sys.exit(main())
