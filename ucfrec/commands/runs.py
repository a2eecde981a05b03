"""What is done with finished runs: `ucfrec report`, `promote` and `verify`; and every day: `join`
exposures with feedback, `update` the run, `compare` it."""

import re
from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

from ucfrec.commands.options import ARGUMENT, INPUT, OUTPUT, Table
from ucfrec.commands.shared_options import LogOptions, RunArgument
from ucfrec.errors import InputError, one_line
from ucfrec.files.remote import origin

_UNITS_MS = {"s": 1_000, "m": 60_000, "h": 3_600_000, "d": 86_400_000}


class Report(Table):
    """`ucfrec report`."""

    runs: Annotated[Sequence[Path], ARGUMENT, "RUN"]
    """Run folders of `ucfrec train`."""
    results: Annotated[Sequence[Path], "FILE"] = ()
    """Results to show: JSON that any command writes with --json, or result rows (.jsonl); those of
    ope come first; repeatable (default: none)"""
    items: Path | None = None
    """Item features to show with the sample recommendations: Parquet or CSV with a column item_id,
    or with the name that the log of the run has for it (default: none)"""
    out: Path = Path("report.html")
    """HTML file to write."""

    def execute(self) -> None:
        """Write one HTML page about training runs."""
        from ucfrec.reporting.page import write_report

        write_report(self.out, self.runs, self.results, self.items)
        print(f"report: {self.out}; open it in a browser")


class Promote(Table):
    """`ucfrec promote`."""

    run: Annotated[Path, ARGUMENT]
    """Run folder that becomes the current one of the folder that it lies in; with --back, that
    folder"""
    force: bool = False
    """Promote a run without a verdict against the current one, or a worse one (default: refuse)"""
    back: bool = False
    """Return to the run that was current before."""

    def execute(self) -> None:
        """Print which run `ucfrec serve` answers with from now on."""
        from ucfrec.files.record import RUN_RECORD
        from ucfrec.runs.promoted import POINTER, promote, promote_back

        if self.back:
            folder = self.run.parent if (self.run / RUN_RECORD).is_file() else self.run
            pointer = promote_back(folder)
        else:
            folder = self.run.resolve().parent
            pointer = promote(self.run, self.force)
        previous = f", before it {pointer.previous[-1]}" if pointer.previous else ""
        print(f"current run: {pointer.current}{previous} ({folder / POINTER})")
        if not self.back:
            print(f"next: ucfrec serve {quote(str(folder))}, which follows it; --back returns")


class Verify(Table):
    """`ucfrec verify`."""

    paths: Annotated[Sequence[Path], ARGUMENT, "PATH"]
    """Episode stores, run folders (all their files are read), or files of result rows (.jsonl)"""

    def execute(self) -> None:
        """Print one line per path, and one per file with a fault."""
        faults = sum(_verify(path) for path in self.paths)
        if faults:
            raise InputError(
                f"{faults} files do not have the content that was written; restore them, or make "
                "the store or run again"
            )


def _verify(path: Path) -> int:
    """Print the kind of `path` and its faults; returns the number of faults."""
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
    faults = dict(record.faults(path))
    added = f"is not listed in {record.FILE}: it was added later"
    notes = faults | {name: added for name in record.strangers(path) if name != record.FILE}
    for name, note in notes.items():
        print(one_line(f"{path / name} {note}"))
    whole = len(record.files) - len(faults)
    size = sum(size for size, _ in record.files.values())
    print(
        one_line(
            f"{path}: {whole} of {len(record.files)} files have the content that was written "
            f"({size / 1e6:,.1f} MB{unfinished})"
        )
    )
    refit = path / REFIT
    return len(faults) + (_verify(refit) if (refit / RunRecord.FILE).is_file() else 0)


class Exposures(Table):
    """What was shown, named before the feedback."""

    exposures: Annotated[str, ARGUMENT, INPUT]
    """File, folder or quoted glob that serve or recommend --exposures wrote."""


class Join(LogOptions, Exposures):
    """`ucfrec join`."""

    within: Annotated[str, "TIME"]
    """Longest time from exposure to feedback: 90s, 30m, 2h, 1d."""
    out: Annotated[Path, OUTPUT]
    """Parquet or CSV log to write."""

    def execute(self) -> None:
        """Print what was matched."""
        from ucfrec.logs.join import join_feedback

        within = read_duration("--within", self.within)
        files, mapping = self.find_logs(self.logs, outputs=[self.out])
        joined = join_feedback(
            [self.exposures], files, self.out, within, mapping, self.memory_limit
        )
        print(f"{joined}\n\n{origin(self.out)}")


class Update(LogOptions, RunArgument):
    """`ucfrec update`."""

    described_by = "ucfrec.python_api.recommender:Recommender.update"

    run: Annotated[Path, ARGUMENT]
    """Finished run on the older logs; or a folder of runs, for the one that was promoted."""
    out: Annotated[Path, "RUN2"]
    """Folder of the new run; an interrupted update in it is resumed."""
    store: Path | None = None
    """Folder of the store with the new rows (default: RUN2-store, beside RUN2)"""
    window: Annotated[str | None, "TIME"] = None
    """Exclude sessions that ended longer ago, before the end of the new logs, e.g. 60d or 12h
    (default: keep all)"""
    split: Annotated[str | None, "TRAIN,VALIDATION,TEST"] = None
    """Shares of the new rows in order of time (default: 0.6,0.2,0.2); older rows train"""
    no_refit: bool = False
    """Once the runs are compared, do not go on learning from the validation and test rows;
    (default: RUN2 acts by the weights that learned from all rows)"""
    allow_argmax: bool = False

    def execute(self) -> None:
        """Print what was read, the drift and the verdict."""
        from ucfrec.logs.append import SPLIT, AppendOptions
        from ucfrec.logs.prepare import parse_split
        from ucfrec.reporting.model_card import write_card
        from ucfrec.runs.promoted import promoted
        from ucfrec.runs.record import RUN
        from ucfrec.runs.trained_policy import TrainedPolicy
        from ucfrec.updating.update import UpdateOptions, update_run
        from ucfrec.updating.verdict import describe, describe_drift

        pointer = None if (self.run / RUN).is_file() else promoted(self.run)
        run = self.run if pointer is None else self.run / pointer.current
        old = TrainedPolicy.load(run)
        if pointer is not None:
            pointer.require_same(old)
        files, mapping = self.find_logs(self.logs, old, [self.out])
        append = AppendOptions(
            window_ms=read_duration("--window", self.window) if self.window else None,
            split=parse_split(self.split) if self.split else SPLIT,
            memory_limit=self.memory_limit,
        )
        options = UpdateOptions(append, refit=not self.no_refit, allow_argmax=self.allow_argmax)
        record = update_run(
            run, files, self.out, store=self.store, mapping=mapping, options=options
        )
        write_card(self.out)
        update = record.update
        assert update is not None
        assert update.drift is not None
        assert update.verdict is not None
        counts = update.appended
        print(
            f"new rows      {counts['steps']:,} of {counts['rows_read']:,} read ("
            f"{counts['not_newer']:,} not newer than the store); {counts['new_users']:,} new "
            f"users, {counts['new_items']:,} new items; {counts['expired_steps']:,} old rows "
            "excluded"
        )
        print(record.describe())
        if record.rule is not None and record.rule.rule != old.rule:
            print(f"rule changed  {old.rule} → {record.rule.rule}")
        print(f"{describe_drift(update.drift)}\n{describe(update.verdict)}")
        print(f"\nrun: {self.out}")
        if harms := update.verdict.harms:
            print(f"next: keep the old run, as the new one is worse: {harms}")
        else:
            print(f"next: ucfrec promote {quote(str(self.out))}, if `serve` follows its folder")


class Compare(Table):
    """`ucfrec compare`."""

    logs: Annotated[Sequence[str], ARGUMENT, INPUT]
    """Logs of `ucfrec join`, of `serve --split`."""
    column: str = "feedback"
    """Feedback that counts, a number of each shown item."""
    arms: Annotated[str | None, "A,B"] = None
    """Compare B with A (default: the two arms that there are)"""
    expected: Annotated[float | None, "DIFFERENCE"] = None
    """Difference for which the always-valid interval is shortest; fix it before the test (default:
    5% of the value of A)"""
    per: Literal["session", "item"] = "session"
    """Compare sums per session or means per item."""
    gap_minutes: float = 30.0
    """Pause that ends a session."""
    shares: Annotated[str | None, "A=SHARE,B=SHARE"] = None
    """Shares of the users that were intended for the arms, as of serve --split (default: equal)"""
    guardrail: Annotated[Sequence[str], "MEASURE"] = ()
    """Least (or largest) change of B in a measure, in percent, e.g. 'dwell_seconds >= -2%';
    repeatable"""
    by: Annotated[str | None, "COLUMN"] = None
    """Also compare by a column or expression."""
    json: Path | None = None
    """Also write the numbers as JSON."""
    memory_limit: str = "2GB"
    """Memory while the logs are read, from 800MB on."""

    def execute(self) -> None:
        """Print both arms and their difference."""
        from dataclasses import asdict

        from ucfrec.files.atomic import write_json
        from ucfrec.off_policy.ab_test import compare_arms
        from ucfrec.recommending.responder import parse_split

        arms = self.arms.split(",") if self.arms else None
        shares = parse_split(self.shares) if self.shares else None
        result = compare_arms(
            self.logs,
            self.column,
            arms,
            self.expected,
            shares,
            self.memory_limit,
            self.guardrail,
            self.by,
            self.per,
            self.gap_minutes,
        )
        print(result)
        if self.json:
            write_json(self.json, asdict(result))


def read_duration(option: str, text: str) -> int:
    """Milliseconds of a duration such as `90s`, `30m`, `12h` or `60d`."""
    match = re.fullmatch(r"(\d{1,9}(?:\.\d+)?)([smhd])", text.strip())
    milliseconds = 0 if match is None else round(float(match[1]) * _UNITS_MS[match[2]])
    if not milliseconds:
        raise InputError(f"{option} {text} is not a duration; write e.g. 90s, 30m, 12h or 60d")
    return milliseconds
