"""`ucfrec prepare`: turn logs into an episode store; `datasets`: find public ones."""

from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

from ucfrec.commands.options import ARGUMENT, OUTPUT, Group, Table, settings_given
from ucfrec.commands.shared_options import LogOptions, SparkOption
from ucfrec.errors import InputError, warn_user
from ucfrec.files.remote import origin


class Prepare(LogOptions, SparkOption):
    """`ucfrec prepare`."""

    described_by = "ucfrec.logs.prepare:PrepareOptions"

    out: Annotated[Path | None, OUTPUT, "STORE"] = None
    """New folder for the store; also at s3://, gs://, hdfs://, …"""
    reward: Annotated[str | None, "SQL"] = None
    """Scalar SQL expression over the log's columns, e.g. is_click (default: of the dataset or
    --mapping, else the column reward)"""
    session_by: Literal["gap", "user", "session_id"] | None = None
    gap_minutes: float | None = None
    split: Annotated[str | None, "TRAIN,VALIDATION,TEST"] = None
    """Shares of the rows in order of time; or two ISO times (UTC) at which validation and test
    begin (default: 0.8,0.1,0.1)"""
    validate: bool = False
    """Check the logs without writing a store."""
    duplicates: Annotated[
        Literal["highest", "lowest", "first", "last"] | None, Group("reading logs")
    ] = None
    max_session: Annotated[int | None, Group("reading logs")] = None
    engine: Annotated[Literal["duckdb", "spark"], Group("engine")] = "duckdb"

    def execute(self) -> None:
        """Print what was read, dropped and kept."""
        from ucfrec.logs.expressions import Expression
        from ucfrec.logs.prepare import PrepareOptions, parse_split, prepare, validate
        from ucfrec.logs.summary import format_report

        files, mapping = self.find_logs(self.logs, outputs=[self.out])
        by = self.session_by or mapping.session_by or "gap"
        if self.gap_minutes is not None and by != "gap":
            raise InputError(
                f"--gap-minutes needs --session-by gap, not {by}; leave one of them out"
            )
        options = {"dataset": "generic", **settings_given(self, PrepareOptions)}
        if self.reward is not None:
            options["reward"] = Expression(self.reward, "--reward")
        if self.split:
            options["split"] = parse_split(self.split)
        self.find_spark()  # refuses a master of another engine
        how = PrepareOptions(**options)
        if self.validate:
            print(format_report(validate(files, mapping, how)))
            print("\nnothing was written; next: the same command with --out STORE, not --validate")
            return
        if not self.out:
            raise InputError(
                "no store is named; add --out STORE, or --validate to only check the logs"
            )
        print(format_report(prepare(files, mapping, self.out, how)))
        store = origin(self.out)
        print(
            f"\nstore: {store}; policies learn from its train split, later rows validate and test "
            f"them\nnext: ucfrec train {quote(store)} --out RUN"
        )


class Datasets(Table):
    """`ucfrec datasets`."""

    epilog = "Downloads need ucfrec[datasets] (pooch). Mind the licence of each data set."

    name: Annotated[str | None, ARGUMENT] = None
    """Data set to load (default: list them)"""
    folder: Path | None = None
    """Where its archive lies or is downloaded to, and is unpacked."""
    part: str | None = None
    """Of open-bandit: logging policy and campaign (default: random/all)"""

    def execute(self) -> None:
        """Print the list, or how the loaded logs are prepared."""
        from ucfrec.logs.mapping import find_release, load_release
        from ucfrec.plugins import load_plugin, plugin_names
        from ucfrec.reporting.tables import text_table

        datasets = {}
        for name in plugin_names("datasets"):
            try:
                datasets[name] = load_plugin("datasets", name)
            except InputError as error:
                warn_user(str(error))
        if not self.name:
            lines = [
                (name, adapter, f"{release.size / 1e6:,.0f} MB", release.licence, release.homepage)
                for adapter, dataset in datasets.items()
                for name, release in dataset.releases.items()
            ]
            print(text_table(("name", "--dataset", "archive", "licence", "from"), lines))
            print("\nnext: ucfrec datasets NAME --folder DIR")
            return
        adapter = find_release(datasets, self.name)
        if not self.folder:
            raise InputError(f"no folder is named; add --folder DIR for the files of {self.name}")
        logs = load_release(adapter, datasets[adapter], self.name, self.folder, self.part)
        release = datasets[adapter].releases[self.name]
        part = release.parts[self.part or next(iter(release.parts))]
        place = quote(str(self.folder / self.name / part))
        print(
            f"{self.name}: {len(logs.files)} log files; {release.licence}, {release.homepage}\n"
            f"next: ucfrec prepare {place} --dataset {adapter} --out store"
        )
