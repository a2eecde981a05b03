"""`ucfrec prepare`: logs to an episode store."""

import argparse
from pathlib import Path

from ucfrec.commands.options import log_options, logs_given
from ucfrec.errors import InputError


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `prepare` takes."""
    log_options(parser)
    parser.add_argument("--out", type=Path, metavar="STORE", help="new folder for the store")
    parser.add_argument("--reward", help="SQL over feedback columns, e.g. is_click")
    parser.add_argument(
        "--session-by", choices=["gap", "user", "session_id"], help="how rows make sessions"
    )
    parser.add_argument("--gap-minutes", type=float, help="pause that ends a session (30)")
    parser.add_argument(
        "--split", metavar="TRAIN,VALIDATION,TEST", help="shares in order of time (0.8,0.1,0.1)"
    )
    parser.add_argument("--validate", action="store_true", help="only check, write nothing")


def run(options: argparse.Namespace) -> None:
    """`ucfrec prepare`."""
    from ucfrec.logs.prepare import PrepareOptions, parse_split, prepare, validate
    from ucfrec.logs.summary import format_report

    files, mapping = logs_given(options)
    given = {
        "reward": options.reward,
        "session_by": options.session_by,
        "gap_minutes": options.gap_minutes,
        "split": options.split and parse_split(options.split),
    }
    prepared = PrepareOptions(**{name: value for name, value in given.items() if value is not None})
    if options.validate:
        print(format_report(validate(files, mapping, prepared)))
        return
    if options.out is None:
        raise InputError("name the store with --out, or only check with --validate")
    print(format_report(prepare(files, mapping, options.out, prepared)))
    print(f"\nstore: {options.out}")
