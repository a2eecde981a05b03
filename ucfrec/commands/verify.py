"""`ucfrec verify`: compare every file of stores and runs with its checksum."""

import argparse
from pathlib import Path

from ucfrec.commands.options import option
from ucfrec.errors import InputError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec verify`."""
    option(
        parser,
        "paths",
        Path,
        "episode stores and run folders (each file of theirs is read), or files of result "
        "rows (.jsonl)",
        "PATH",
        nargs="+",
    )


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec verify`: print one line per path, and one per file with a fault.

    Raises:
        InputError: a file is missing, has another content than was written, or cannot be verified.
    """
    faults = sum(_verify(path) for path in options.paths)
    if faults:
        raise InputError(
            f"{faults} files do not have the content that was written; restore them, or make the "
            "store or run again"
        )


def _verify(path: Path) -> int:
    """Print what `path` is and its faults; returns their number."""
    from ucfrec.episodes.record import StoreRecord
    from ucfrec.errors import one_line
    from ucfrec.runs.record import REFIT, RunRecord, TrainingRecord, read_training

    if path.is_file():
        from ucfrec.results.rows import read_rows

        print(one_line(f"{path}: {len(read_rows(path))} result rows, all readable"))
        return 0
    record: StoreRecord | TrainingRecord
    if (path / StoreRecord.FILE).is_file():
        record, unfinished = StoreRecord.read(path), ""
    elif (path / RunRecord.FILE).is_file():
        record = read_training(path)
        unfinished = "" if record.policy is not None else ", training has not ended"
    else:
        raise InputError(
            f"{path} is neither an episode store (meta.json) nor a run (run.json); check the path"
        )
    sealed = record.checksums(path)
    faults = list(sealed.faults())
    for name, fault in faults:
        print(one_line(f"{path / name} {fault}"))
    for name in sealed.strangers():
        if name != record.FILE:
            print(one_line(f"{path / name} is not listed in {record.FILE}: it was added later"))
    refit = path / REFIT
    more = _verify(refit) if (refit / RunRecord.FILE).is_file() else 0
    size = sum(size for size, _ in sealed.files.values())
    print(
        one_line(
            f"{path}: {len(sealed.files) - len(faults)} of {len(sealed.files)} files have the "
            f"content that was written ({size / 1e6:,.1f} MB{unfinished})"
        )
    )
    return len(faults) + more
