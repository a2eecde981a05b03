"""What is done with finished runs: `ucfrec report`, `promote` and `verify`."""

from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import Annotated

from ucfrec.commands.options import ARGUMENT, EXCLUSIVE, Table
from ucfrec.errors import InputError, one_line


class Report(Table):
    """`ucfrec report`."""

    usage = "%(prog)s RUN... [options]"

    runs: Annotated[Sequence[Path], ARGUMENT, "RUN"] = ()
    """Run folders of `ucfrec train`."""
    results: Annotated[Sequence[Path], "FILE…"] = ()
    """Results to show: JSON that any command writes with --json, or result rows (.jsonl); those of
    ope come first (default: none)"""
    items: Annotated[Path | None, "FILE"] = None
    """Item features to show with the sample recommendations: Parquet or CSV with a column item_id,
    or with the name that the log of the run has for it (default: none)"""
    out: Annotated[Path, "FILE"] = Path("report.html")
    """HTML file to write."""

    def execute(self) -> None:
        """Write one HTML page about training runs."""
        from ucfrec.reporting.page import write_report
        from ucfrec.runs.record import RUN

        # A run that follows `--results FILE` is still a run.
        runs = [*self.runs, *(path for path in self.results if (path / RUN).is_file())]
        if not runs:
            raise InputError("name a run folder of `ucfrec train`")
        results = [path for path in self.results if path not in runs]
        write_report(self.out, runs, results, self.items)
        print(f"report: {self.out}; open it in a browser")


class Promote(Table):
    """`ucfrec promote`."""

    run: Annotated[Path, ARGUMENT, "RUN"]
    """Run folder that becomes the current one of the folder that it lies in; with --back, that
    folder"""
    force: Annotated[bool, EXCLUSIVE] = False
    """Promote a run without a verdict against the current one, or a worse one (default: refuse)"""
    back: Annotated[bool, EXCLUSIVE] = False
    """Return to the run that was current before."""

    def execute(self) -> None:
        """Print which run `ucfrec serve` answers with from now on."""
        from ucfrec.files.record import RUN_RECORD
        from ucfrec.runs.promoted import POINTER, promote, promote_back

        if self.back:
            folder = self.run.parent if (self.run / RUN_RECORD).is_file() else self.run
            pointer = promote_back(folder)
        else:
            folder, pointer = self.run.resolve().parent, promote(self.run, self.force)
        previous = f", before it {pointer.previous[-1]}" if pointer.previous else ""
        print(f"current run: {pointer.current}{previous} ({folder / POINTER})")
        if not self.back:
            print(f"next: ucfrec serve {quote(str(folder))}, which follows it; --back returns")


class Verify(Table):
    """`ucfrec verify`."""

    paths: Annotated[Sequence[Path], ARGUMENT, "PATH"]
    """Episode stores and run folders (each file of theirs is read), or files of result rows
    (.jsonl)"""

    def execute(self) -> None:
        """Print one line per path, and one per file with a fault."""
        faults = sum(_verify(path) for path in self.paths)
        if faults:
            raise InputError(
                f"{faults} files do not have the content that was written; restore them, or make "
                "the store or run again"
            )


def _verify(path: Path) -> int:
    """Print what `path` is and its faults; returns their number."""
    from ucfrec.episodes.record import StoreRecord
    from ucfrec.results.rows import read_rows
    from ucfrec.runs.record import REFIT, RunRecord, TrainingRecord

    if path.is_file():
        print(one_line(f"{path}: {len(read_rows(path))} result rows, all readable"))
        return 0
    record: StoreRecord | TrainingRecord
    if (path / StoreRecord.FILE).is_file():
        record, unfinished = StoreRecord.read(path), ""
    elif (path / RunRecord.FILE).is_file():
        record = TrainingRecord.read(path)
        record = RunRecord.read(path) if record.library == "ucfrec" else record
        unfinished = "" if record.policy is not None else ", training has not ended"
    else:
        raise InputError(
            f"{path} is neither an episode store (meta.json) nor a run (run.json); check the path"
        )
    faults = list(record.faults(path))
    lines = [f"{path / name} {fault}" for name, fault in faults]
    added = f"is not listed in {record.FILE}: it was added later"
    lines += [f"{path / name} {added}" for name in record.strangers(path) if name != record.FILE]
    size = sum(size for size, _ in record.files.values()) / 1e6
    lines.append(
        f"{path}: {len(record.files) - len(faults)} of {len(record.files)} files have the content "
        f"that was written ({size:,.1f} MB{unfinished})"
    )
    print("\n".join(map(one_line, lines)))
    refit = path / REFIT
    return len(faults) + (_verify(refit) if (refit / RunRecord.FILE).is_file() else 0)
