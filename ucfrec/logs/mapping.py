"""What the columns of a log mean: mappings written as data, and the datasets that bring them."""

import glob
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from ucfrec import schema
from ucfrec.errors import InputError

SUFFIXES: Final = (".parquet", ".csv", ".csv.gz")
KEY_COLUMNS: Final = (schema.USER_ID, schema.ITEM_ID, schema.ACTION, schema.TIMESTAMP)
OPTIONAL_COLUMNS: Final = (
    schema.OBSERVATION,
    schema.PROPENSITY,
    schema.SESSION_ID,
    schema.IS_RANDOM,
)


@dataclass(frozen=True)
class FeatureTable:
    """Features of items or of users, one row each (but see `first_by`).

    The type of a column says what it is: numbers are standardised, dates count as days, text and
    booleans are categories, lists of text or integers are tags, lists of floats are vectors. A
    cast makes a category of a number: `music_type::VARCHAR`.
    """

    files: tuple[str | Path, ...]
    key: str
    """Column (or SQL expression) equal to the log's item_id or user_id."""
    columns: tuple[str, ...] = ()
    """Columns or SQL expressions; none means all but the key."""
    first_by: str = ""
    """Of rows that repeat a key, the one with the lowest value of this column or expression counts,
    such as the first day of daily features; without it, keys may not repeat."""


@dataclass(frozen=True)
class LogMapping:
    """What the columns of a log mean.

    Example: `LogMapping({"item_id": "video_id", "timestamp": "time_s * 1000"}, reward="is_click")`.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    """Log column of `ucfrec.schema` to a file's column or a SQL expression over its columns. What
    is not named here has its own name in the file; "" says that the log has no such column. Times
    are milliseconds, or dates and timestamps (UTC)."""
    reward: str | None = None
    """Reward unless `PrepareOptions` names another."""
    session_by: str | None = None
    """How rows make sessions, unless `PrepareOptions` says: "session_id", "gap" or "user"."""
    item_features: tuple[FeatureTable, ...] = ()
    user_features: tuple[FeatureTable, ...] = ()

    def __post_init__(self) -> None:
        known = (*KEY_COLUMNS, *OPTIONAL_COLUMNS)
        for name in self.columns:
            if name not in known:
                raise InputError(f"{name!r} is no log column; those are {', '.join(known)}")

    def over(self, defaults: "LogMapping") -> "LogMapping":
        """This mapping, with the fields of `defaults` where it leaves them empty."""
        return LogMapping(
            {**defaults.columns, **self.columns},
            self.reward or defaults.reward,
            self.session_by or defaults.session_by,
            self.item_features or defaults.item_features,
            self.user_features or defaults.user_features,
        )


@dataclass(frozen=True)
class Dataset:
    """A kind of log that a package announces under the entry-point group `ucfrec.datasets`."""

    summary: str
    """One line for `--help`."""
    resolve: Callable[[Sequence[str | Path], LogMapping], tuple[tuple[Path, ...], LogMapping]]
    """(files, folders and globs, the user's own mapping) to (log files, full mapping)."""


def columns_given(assignments: Sequence[str]) -> dict[str, str]:
    """Read `--column` arguments: "user_id=uid" is {"user_id": "uid"}.

    Raises:
        InputError: one of them has no "=".
    """
    pairs = {}
    for assignment in assignments:
        name, equals, value = assignment.partition("=")
        if not equals:
            raise InputError(f"--column {assignment}: write NAME=COLUMN, e.g. user_id=uid")
        pairs[name.strip()] = value.strip()
    return pairs


def read_mapping(path: Path) -> LogMapping:
    """Read a mapping written in TOML.

    It has the fields of `LogMapping`; files of features are relative to its folder::

        reward = "is_click"
        session_by = "gap"

        [columns]
        user_id = "uid"
        timestamp = "seconds * 1000"

        [[item_features]]
        files = ["items.csv"]
        key = "iid"
        columns = ["ln(1 + price)", "string_split(tags, '|')"]

    Raises:
        InputError: the file is missing, is not TOML, or has an unknown field.
    """
    try:
        given: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; name a TOML file with a mapping") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not TOML: {error}") from None
    try:
        for kind in ("item_features", "user_features"):
            tables = (FeatureTable(**table) for table in given.get(kind, []))
            given[kind] = tuple(
                replace(
                    table,
                    files=tuple(path.parent / file for file in table.files),
                    columns=tuple(table.columns),
                )
                for table in tables
            )
        return LogMapping(**given)
    except (TypeError, InputError) as error:
        raise InputError(f"{path}: {error}") from None


def log_files(paths: Sequence[str | Path]) -> tuple[Path, ...]:
    """Files that `paths` (files, folders, globs) stand for, each once, by name within a path.

    Raises:
        InputError: one of them is missing, matches nothing, or is of an unknown kind.
    """
    found: dict[Path, None] = {}
    for path in paths:
        matches = _matches(Path(path))
        if not matches:
            raise InputError(f"{path} matches no {' or '.join(SUFFIXES)} file; check the path")
        found |= dict.fromkeys(matches)
    if not found:
        raise InputError("no log was named; give Parquet or CSV files, folders or globs")
    return tuple(found)


def _matches(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(p for p in path.iterdir() if is_table(p) and not p.name.startswith("."))
    if path.is_file():
        if not is_table(path):
            raise InputError(f"{path} is not a {' or '.join(SUFFIXES)} file; convert it first")
        return [path]
    if not glob.has_magic(str(path)):
        raise InputError(f"{path} does not exist; check the path")
    return sorted(p for p in map(Path, glob.glob(str(path), recursive=True)) if is_table(p))


def is_table(path: Path) -> bool:
    """Whether the name is that of a file `prepare` reads."""
    return path.is_file() and path.name.endswith(SUFFIXES)
