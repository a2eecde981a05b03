"""Column mappings of logs, written as data, and the datasets and releases that supply them."""

import glob
import hashlib
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any, get_args

from ucfrec import schema
from ucfrec.episodes.record import Source
from ucfrec.errors import InputError, warn_user
from ucfrec.files.atomic import atomic_folder, read_toml
from ucfrec.files.remote import RECORDS
from ucfrec.logs.expressions import Expression
from ucfrec.settings import nearest

SUFFIXES = (".parquet", ".csv", ".csv.gz")
_OTHER_TABLES = (
    *(".tsv", ".pq", ".jsonl", ".ndjson", ".orc", ".avro", ".feather", ".arrow", ".xlsx"),
    *(".csv.bz2", ".csv.zip", ".csv.zst", ".csv.xz", ".tar.gz", ".zip"),
)
"""Endings of files beside logs that may be meant to be read."""
_CONVERT = "convert it to Parquet or CSV, or give it one of the endings that are read"
KEY_COLUMNS = (schema.USER_ID, schema.ITEM_ID, schema.ACTION, schema.TIMESTAMP)
OPTIONAL_COLUMNS = (
    schema.OBSERVATION,
    schema.PROPENSITY,
    schema.SESSION_ID,
    schema.IS_RANDOM,
    schema.REQUEST_ID,
    schema.POSITION,
    schema.SESSION_BEGAN,
    schema.EXCLUDES_SEEN,
    schema.CANDIDATES,
)
SETS_SUFFIX = ".candidates.parquet"
"""Ending of the file of sets of candidates that lies beside exposures and logs of `join`."""
EARLIEST_MS = 946_684_800_000
"""2000-01-01 UTC in ms; rows with an earlier time are dropped as clock errors."""
SESSIONS = get_args(schema.SessionBy)


@dataclass(frozen=True)
class FeatureTable:
    """Features of items or users, one row per item or user (but see `first_by`).

    The type of a column decides how it is encoded: numbers are standardised, dates count as days,
    text and booleans are categories, lists of text or integers are tags, lists of floats are
    vectors. A cast turns a number into a category: `music_type::VARCHAR`.
    """

    files: tuple[str | Path, ...]
    key: str
    """Column or SQL expression whose values are the item_id or user_id of the log."""
    columns: tuple[str, ...] = ()
    """Columns or SQL expressions; empty for all columns except the key."""
    first_by: str = ""
    """Of rows with the same key, keep the one with the lowest value of this column or expression,
    e.g. the first day of daily features. Empty: a repeated key is an error."""
    available_from: str = ""
    """Of items: column or expression of the time from which the item may be shown; empty for the
    column of this name, if there is one. Missing values have no bound. Rows that differ in times
    alone are several intervals of one item."""
    available_until: str = ""
    """The time from which it may no longer be shown."""

    def __post_init__(self) -> None:
        for name, value in (("files", self.files), ("columns", self.columns)):
            if isinstance(value, str | Path):
                raise InputError(f"{name} of features is {value!s}; write a list: ['{value!s}']")


@dataclass(frozen=True)
class LogMapping:
    """Which columns of the files are the log columns, the reward and the features.

    Example: `LogMapping({"item_id": "video_id", "timestamp": "time_s * 1000"}, reward="is_click")`.
    Raises InputError if a value is none.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    """Log column of `ucfrec.schema` to a column of the file or a SQL expression over its columns.
    A log column that is not named here has the same name in the file; "" means that the log does
    not have it. Times are milliseconds, or dates and timestamps (UTC)."""
    reward: str | None = None
    """SQL expression of the reward; `PrepareOptions.reward` overrides it."""
    session_by: str | None = None
    """What forms sessions: "session_id", "gap", "user"; `PrepareOptions.session_by` overrides."""
    item_features: tuple[FeatureTable, ...] = ()
    user_features: tuple[FeatureTable, ...] = ()
    time_format: str | None = None
    """The `strptime` format of times that are text, e.g. "%d/%m/%Y %H:%M"; None for ISO 8601."""
    earliest: str | None = None
    """ISO time (UTC) before which times are clock errors; None for 2000."""
    before_ms: int | None = None
    """Time of requests, ms: later rows are no history; None for any. No mapping file has it."""
    where: str | None = None
    """SQL condition over the files' columns; rows that do not fulfil it are excluded."""
    partitions: bool = False
    """Whether names of folders such as `country=DE` are columns."""
    candidate_sets: tuple[str | Path, ...] = ()
    """Tables of the sets that the log column `candidates` names: `candidates`, and `items`, a list
    of item_ids. Of exposures and logs of `join` they are found without it."""
    remembered: "LogMapping | None" = None
    """Mapping of the log that a run was trained on. Its columns, time format and condition count
    where nothing else is given and the files have the columns they need."""

    def __post_init__(self) -> None:
        names = (*KEY_COLUMNS, *OPTIONAL_COLUMNS)
        for name in self.columns:
            if name not in names:
                hint = "; write reward = ... above [columns]" if name == "reward" else ""
                columns = ", ".join(names)
                raise InputError(f"{name!r} is not a log column; use one of {columns}{hint}")
        if self.session_by not in (None, *SESSIONS):
            raise InputError(
                f"session_by is {self.session_by!r}; use {', '.join(SESSIONS)}, and map a column "
                f"of sessions as {schema.SESSION_ID}"
            )
        for name in ("item_features", "user_features"):
            tables = getattr(self, name)
            if not isinstance(tables, (tuple, list)) or {type(t) for t in tables} - {FeatureTable}:
                raise InputError(
                    f"{name} takes a list of FeatureTable, such as FeatureTable(['items.parquet'], "
                    "key='item_id'); write a frame to a file first"
                )
        self.earliest_ms  # noqa: B018

    @property
    def earliest_ms(self) -> int:
        """Milliseconds of `earliest`, or InputError if it is not a time."""
        if self.earliest is None:
            return EARLIEST_MS
        try:
            time = datetime.fromisoformat(str(self.earliest))
        except ValueError:
            raise InputError(
                f"earliest is {self.earliest!r}; write a date, e.g. 1990-01-01"
            ) from None
        return round(time.replace(tzinfo=time.tzinfo or UTC).timestamp() * 1000)

    def over(self, defaults: "LogMapping") -> "LogMapping":
        """This mapping, with its empty fields filled from `defaults`."""
        remembered = self.remembered or defaults.remembered
        if self.remembered and defaults.remembered:
            remembered = self.remembered.over(defaults.remembered)
        values = {f.name: getattr(self, f.name) or getattr(defaults, f.name) for f in fields(self)}
        columns = {**defaults.columns, **self.columns}
        return LogMapping(**values | {"columns": columns, "remembered": remembered})

    def remember(self) -> dict[str, object]:
        """What a store's record keeps of it, for `of_source`."""
        values = {name: getattr(self, name) for name in ("time_format", "earliest", "where")}
        return {
            "mapping": {name: str(text) for name, text in self.columns.items()},
            **{name: str(value) for name, value in values.items() if value is not None},
            **({"partitions": True} if self.partitions else {}),
        }

    @classmethod
    def of_source(cls, source: Source, origin: str) -> "LogMapping":
        """What the record of a store or run remembers of its log, for later logs."""
        columns = {name: Expression(text, origin) for name, text in source.mapping.items()}
        where = source.where and Expression(source.where, origin)
        return cls(
            earliest=source.earliest,
            partitions=source.partitions,
            remembered=cls(columns, time_format=source.time_format, where=where),
        )


@dataclass(frozen=True)
class LogFiles:
    """Log files with what their columns mean, as `ucfrec_datasets.load` returns them."""

    files: tuple[Path, ...]
    mapping: LogMapping
    dataset: str = "generic"
    """Name of the dataset adapter, which is recorded with what is made from the files."""


@dataclass(frozen=True)
class Release:
    """A public data set as its authors publish it: one archive, zip or tar."""

    url: str
    homepage: str
    licence: str
    checksum: str
    """`md5:…` or `sha256:…` of the archive."""
    size: int
    """Bytes of the archive."""
    parts: Mapping[str, str]
    """Name of what can be read at once to its path in the archive; the first is the default."""
    convert: Callable[[Path], None] | None = None
    """Makes the files that the adapter reads in the folder of the unpacked archive."""


@dataclass(frozen=True)
class Dataset:
    """A kind of log that a package announces under the entry-point group `ucfrec.datasets`."""

    summary: str
    """One line for `--help`."""
    resolve: Callable[[Sequence[str | Path], LogMapping], tuple[tuple[Path, ...], LogMapping]]
    """Maps (files, folders and globs; the user's mapping) to (log files; full mapping)."""
    releases: Mapping[str, Release] = field(default_factory=dict)
    """Public data sets of this kind, by name."""


def read_columns(assignments: Sequence[str]) -> dict[str, str]:
    """Read `--column` arguments, `NAME=COLUMN`: "user_id=uid" is {"user_id": "uid"}."""
    pairs: dict[str, str] = {}
    for assignment in assignments:
        name, equals, value = assignment.partition("=")
        if not equals:
            raise InputError(f"--column {assignment}: write NAME=COLUMN, e.g. user_id=uid")
        pairs[name.strip()] = Expression(value.strip(), "--column")
    return pairs


def read_mapping(path: Path) -> LogMapping:
    """Read a TOML file with the fields of `LogMapping`.

    Paths of feature files are relative to its folder::

        reward = "is_click"
        columns = { user_id = "uid", timestamp = "seconds * 1000" }
        [[item_features]]
        files = ["items.csv"]
        key = "iid"
        columns = ["ln(1 + price)", "string_split(tags, '|')"]

    Raises InputError if the file is missing, is not TOML, or has an unknown field.
    """
    values, origin = read_toml(path), str(path)
    _require_keys(origin, values, LogMapping)
    try:
        columns = values.get("columns", {})
        values["columns"] = {name: Expression(text, origin) for name, text in columns.items()}
        for name in {"reward", "where"} & values.keys():
            values[name] = Expression(values[name], origin)
        if sets := values.get("candidate_sets"):
            sets = [sets] if isinstance(sets, str) else sets
            values["candidate_sets"] = tuple(_beside(path, file) for file in sets)
        texts = ("key", "first_by", "available_from", "available_until")
        for kind in {"item_features", "user_features"} & values.keys():
            for table in values[kind]:
                _require_keys(f"[[{kind}]]", table, FeatureTable)
            values[kind] = tuple(
                replace(
                    features,
                    files=tuple(_beside(path, file) for file in features.files),
                    columns=tuple(Expression(column, origin) for column in features.columns),
                    **{name: Expression(getattr(features, name), origin) for name in texts},
                )
                for features in (FeatureTable(**table) for table in values[kind])
            )
        return LogMapping(**values)
    except (AttributeError, TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: {error}") from None


def _require_keys(where: str, table: object, kind: type) -> None:
    """Check that a table of a mapping file has the keys of a class, and no others."""
    if not isinstance(table, dict):
        raise InputError(f"{where}: write it in double brackets, with its keys in lines below")
    names = [part.name for part in fields(kind) if part.name not in ("remembered", "before_ms")]
    for key in table.keys() - set(names):
        raise InputError(f"{where}: there is no key {key!r}; {nearest(key, names)}")
    for part in fields(kind):
        if part.name not in table and part.default is part.default_factory is MISSING:
            raise InputError(f"{where}: it has no key {part.name!r}; add it")


def _beside(mapping: Path, file: str | Path) -> Path:
    """A file or glob that a mapping file names, relative to its folder."""
    path = mapping.parent / file
    if path.exists() or not glob.has_magic(str(file)):
        return path
    # The folder is not a pattern, even if it is called "logs [1]".
    return Path(glob.escape(str(mapping.parent))) / file


def log_files(paths: Sequence[str | Path]) -> tuple[Path, ...]:
    """List the log files among files, folders and globs (or a single one), each once.

    A folder stands for all log files in it and its sub-folders, by name, but for stores, runs, and
    those whose names begin with a dot or an underscore. Beside logs, sets of candidates are not
    listed. InputError if a path is missing, matches no log file, or is a file of another kind.
    """
    files: dict[Path, None] = {}
    # A text is a sequence of texts, too: its characters.
    for path in [paths] if isinstance(paths, str) else paths:
        file = Path(path)
        if file.is_file() and not is_table(file):
            raise InputError(f"{path} is not a {' or '.join(SUFFIXES)} file; {_CONVERT}")
        if file.exists():
            matches = _tables(file)
        elif glob.has_magic(str(path)):
            globbed = sorted(Path(name) for name in glob.glob(str(path), recursive=True))
            matches = [table for m in globbed if m.name[:1] != "." for table in _tables(m)]
        else:
            raise InputError(f"{path} does not exist; check the path")
        if not matches:
            raise InputError(f"{path} matches no {' or '.join(SUFFIXES)} file; check the path")
        files |= dict.fromkeys(matches)
    if not files:
        raise InputError("no log was named; give Parquet or CSV files, folders or globs")
    logs = tuple(file for file in files if not file.name.endswith(SETS_SUFFIX))
    return logs or tuple(files)


def sets_beside(file: Path) -> Path:
    """Where the sets of candidates are that a file of exposures, or a log of `join`, names."""
    return file.with_suffix(SETS_SUFFIX)


def table_name(file: Path) -> str:
    """Name of the table that a file is, or is a part of: a folder `items.parquet/` is a table."""
    return next((p.name for p in file.parents if p.name.endswith(SUFFIXES)), file.name)


def _tables(path: Path, parents: tuple[Path, ...] = ()) -> list[Path]:
    """The tables at a path, those of a folder and its sub-folders by name; `parents` are the
    folders that it lies in, without links, for a link may lead back to one of them."""
    if path.is_symlink() and not path.exists():
        raise InputError(
            f"{path} is a link to a file that does not exist; fetch that file, e.g. with git annex "
            "get or dvc pull, or remove the link"
        )
    if not path.is_dir():
        if path.name.lower().endswith(_OTHER_TABLES):
            warn_user(f"{path} is not read; {_CONVERT}")
        return [path] if is_table(path) else []
    real = path.resolve()
    if real in parents or (parents and any((path / name).is_file() for name in RECORDS)):
        return []
    entries = sorted(
        entry
        for entry in path.iterdir()
        if entry.name[0] != "." and not (entry.name[0] == "_" and entry.is_dir())
    )
    return [table for entry in entries for table in _tables(entry, (*parents, real))]


def is_table(path: Path) -> bool:
    """Whether `path` is a file with a suffix that `prepare` reads."""
    return path.is_file() and path.name.lower().endswith(SUFFIXES)


def load_release(
    adapter: str,
    dataset: Dataset,
    name: str,
    folder: Path,
    part: str | None = None,
) -> LogFiles:
    """The logs of a release with their columns mapped, downloaded to `folder` if not there yet.

    `part` is a key of `Release.parts`; None for the first. Raises InputError if there is no such
    part, or the archive cannot be downloaded, has another checksum, or lacks the part.
    """
    release = dataset.releases[name]
    part = next(iter(release.parts)) if part is None else part
    if part not in release.parts:
        raise InputError(f"{name} has no part {part!r}; it has {', '.join(release.parts)}")
    path = _unpack(name, release, folder) / release.parts[part]
    if not path.exists():
        raise InputError(f"{path} is missing; delete {folder / name} and load it again")
    files, mapping = dataset.resolve([path], LogMapping())
    return LogFiles(files, mapping, adapter)


def find_release(datasets: Mapping[str, Dataset], name: str) -> str:
    """Name of the adapter that has a release, or InputError."""
    adapters = {release: key for key, dataset in datasets.items() for release in dataset.releases}
    if name not in adapters:
        raise InputError(f"no data set is called {name!r}; there are {', '.join(sorted(adapters))}")
    return adapters[name]


def _unpack(name: str, release: Release, folder: Path) -> Path:
    """The folder with the files of a release."""
    import zipfile  # only for this

    target = folder / name
    if target.is_dir():
        return target
    archive = folder / PurePosixPath(release.url).name
    if not archive.is_file():
        _download(name, release, archive)
    kind, _, stated = release.checksum.partition(":")
    with archive.open("rb") as file:
        checksum = hashlib.file_digest(file, kind).hexdigest()
    if checksum != stated:
        raise InputError(
            f"{archive} has {kind} {checksum}, the release {stated}; it is damaged or another "
            "version: delete it and load it again"
        )
    with atomic_folder(target) as scratch:
        # Of a tar, names that lead elsewhere, links out of the folder and devices are refused.
        how: dict[str, Any] = {} if zipfile.is_zipfile(archive) else {"filter": "data"}
        shutil.unpack_archive(archive, scratch, **how)
        if release.convert is not None:
            release.convert(scratch)
    return target


def _download(name: str, release: Release, archive: Path) -> None:
    by_hand = (
        f"download {release.url} ({release.size / 1e6:,.0f} MB, see {release.homepage}) to "
        f"{archive}, then repeat this"
    )
    try:
        import pooch
    except ModuleNotFoundError:
        raise InputError(
            f"downloading {name} needs pooch; install ucfrec[datasets], or {by_hand}"
        ) from None
    pooch.get_logger().setLevel("WARNING")
    try:
        pooch.retrieve(release.url, release.checksum, archive.name, archive.parent)
    except Exception as error:  # of several libraries, for names, connections, certificates, status
        if "does not match the known hash" in str(error):
            raise InputError(f"{release.url} has changed: {error}; {by_hand}") from None
        reason = str(error) or type(error).__name__
        raise InputError(f"{name} cannot be downloaded ({reason}); {by_hand}") from None
