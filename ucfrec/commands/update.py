"""Every day: `ucfrec join` exposures with feedback, `update` the run, `compare` it."""

from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import Annotated

from ucfrec.commands.options import ARGUMENT, INPUT, OUTPUT, POSITIVE, Table
from ucfrec.commands.shared_options import LogOptions, RunArgument, read_duration
from ucfrec.errors import InputError
from ucfrec.files.remote import origin


class Exposures(Table):
    """What was shown, named before the feedback."""

    exposures: Annotated[str, ARGUMENT, INPUT, "EXPOSURES"]
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

    run: Annotated[Path, ARGUMENT, "RUN"]
    """Finished run on the older logs; or a folder of runs, for the one that was promoted."""
    out: Annotated[Path, "RUN2"]
    """Folder of the new run; an interrupted update in it is resumed."""
    store: Annotated[Path | None, "STORE"] = None
    """Folder of the store with the new rows (default: RUN2-store, beside RUN2)"""
    window: Annotated[str | None, "TIME"] = None
    """Exclude sessions that ended longer ago, before the end of the new logs, e.g. 60d or 12h
    (default: keep all)"""
    split: Annotated[str | None, "TRAIN,VALIDATION,TEST"] = None
    """Shares of the new rows in order of time (default: 0.6,0.2,0.2); older rows train"""
    no_refit: bool = False
    """Once the runs are compared, do not go on learning from the validation and test rows;
    (default: RUN2 acts by the weights that learned from all rows)"""
    filter_seen: bool = False
    allow_argmax: bool = False
    seed: int | None = None
    """Of everything random (default: that of RUN)"""
    threads: Annotated[int | None, POSITIVE] = None
    """CPU threads (default: all cores)"""

    def execute(self) -> None:
        """Print what was read, the drift and the verdict."""
        import torch

        from ucfrec.logs.append import SPLIT, AppendOptions
        from ucfrec.logs.prepare import parse_split
        from ucfrec.reporting.model_card import write_card
        from ucfrec.runs.promoted import promoted
        from ucfrec.runs.record import RUN
        from ucfrec.runs.trained_policy import TrainedPolicy
        from ucfrec.updating.update import UpdateOptions, update_run
        from ucfrec.updating.verdict import describe, describe_drift

        if self.threads is not None:
            torch.set_num_threads(self.threads)
        pointer = None if (self.run / RUN).is_file() else promoted(self.run)
        run = self.run if pointer is None else pointer.run(self.run)
        old = TrainedPolicy.load(run)
        if pointer is not None:
            pointer.require_same(old)
        files, mapping = self.find_logs(self.logs, old, [self.out])
        append = AppendOptions(
            window_ms=None if self.window is None else read_duration("--window", self.window),
            split=SPLIT if self.split is None else parse_split(self.split),
            memory_limit=self.memory_limit,
        )
        options = UpdateOptions(
            append,
            seed=self.seed,
            refit=not self.no_refit,
            filter_seen=self.filter_seen,
            allow_argmax=self.allow_argmax,
        )
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

    logs: Annotated[Sequence[str], ARGUMENT, INPUT, "LOGS"]
    """Logs of `ucfrec join`, whose exposures `serve --split` wrote."""
    column: str = "feedback"
    """Feedback that counts, a number of each shown item."""
    arms: Annotated[str | None, "A,B"] = None
    """Compare B with A (default: the two arms that there are)"""
    expected: Annotated[float | None, "DIFFERENCE"] = None
    """Difference per shown item for which the always-valid interval is shortest; fix it before the
    test (default: 5% of the value of A)"""
    shares: Annotated[str | None, "A=SHARE,B=SHARE"] = None
    """Shares of the users that were intended for the arms, as of serve --split (default: equal)"""
    guardrail: Annotated[Sequence[str], "MEASURE"] = ()
    """Least (or largest) change of B in a measure, in percent, e.g. 'dwell_seconds >= -2%';
    repeatable"""
    by: Annotated[str | None, "COLUMN"] = None
    """Also compare within groups of the rows, by a column or expression."""
    json: Annotated[Path | None, "FILE"] = None
    """Also write the numbers as JSON."""
    memory_limit: Annotated[str, "SIZE"] = "2GB"
    """Memory of the process while it reads the logs, from 800MB on."""

    def execute(self) -> None:
        """Print both arms and their difference."""
        from dataclasses import asdict

        from ucfrec.files.atomic import write_json
        from ucfrec.off_policy.ab_test import compare_arms
        from ucfrec.recommending.responder import parse_split

        arms = None if self.arms is None else [arm.strip() for arm in self.arms.split(",")]
        if self.expected is not None and not self.expected > 0:
            raise InputError(f"--expected is {self.expected}; give a difference above 0")
        shares = None if self.shares is None else parse_split(self.shares)
        result = compare_arms(
            self.logs,
            self.column,
            arms,
            self.expected,
            shares,
            self.memory_limit,
            self.guardrail,
            self.by,
        )
        print(result)
        if self.json is not None:
            write_json(self.json, asdict(result))
