"""Episodes of sorted rows: where sessions begin, how a split cuts them, and how a store gets them.

Users and items get their numbers here, and every episode is counted before any is written.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float64Array, IntArray
from ucfrec.episodes.item_table import OFFERS
from ucfrec.episodes.writer import StoreWriter
from ucfrec.errors import InputError, warn_user
from ucfrec.logs.engine import BATCH_ROWS, to_arrow, to_numpy
from ucfrec.logs.rows import (
    CANDIDATE_SET,
    CODES,
    DAY_MS,
    ITEM,
    SESSION,
    USER,
    SortedRows,
    take_rows,
)
from ucfrec.logs.tables import cast_integer, glob_pattern, quote
from ucfrec.logs.typed import TypedLog
from ucfrec.processes import Progress

if TYPE_CHECKING:
    from ucfrec.episodes.offers import Offers

EPISODES = "episodes"
"""Table of the episodes: `episode` (number, from 0), `user_code`, `split`, `steps`,
`begins_session` and `terminated`."""
USED_USERS, USED_ITEMS = "used_users", "used_items"
"""Tables of the users and items in the steps: id, `code`, `steps` and `train_count` (in training);
of users `longest`, the steps of the longest episode, and `ended`, if the last is terminated."""
ITEMS_FILE = "items.parquet"
USERS_FILE = "users.parquet"
EPISODE_USERS = "episode_users.parquet"
ID_TABLES = ((schema.USER_ID, "users", USERS_FILE), (schema.ITEM_ID, "items", ITEMS_FILE))
"""Id column, its DuckDB table of ids and numbers, and the file of that table in the store."""
_BINS = 2**16


@dataclass(frozen=True)
class Cut:
    """How rows form episodes."""

    session_by: str
    """One of `ucfrec.schema.SessionBy`."""
    gap_ms: int
    """With "gap": a longer pause (ms) ends the session."""
    min_steps: int
    """Episodes with fewer steps are dropped."""
    bounds: tuple[int, int]
    """Times (ms) at which the validation and the test split begin."""
    max_steps: int | None = None
    """Episodes with more steps are dropped; None for none."""
    leave_last: int = 0
    """Last rows that test, and as many that validate, of users with more; 0: a split by time."""


@dataclass(frozen=True)
class Episodes:
    """The E episodes of some users that are neither too short nor too long, with M rows."""

    rows: dict[str, Array]
    """(M,) or (M, size) columns of `SortedRows.file`."""
    lengths: IntArray
    users: IntArray
    """(E,) `USER`."""
    splits: IntArray
    """(E,) 0 train, 1 validation, 2 test."""
    begins_session: BoolArray
    """(E,) false for the later pieces of a session that a split cuts."""
    terminated: BoolArray
    """(E,) false for episodes cut at a split and sessions that may have gone on after the log: a
    user's last one if sessions are users, or if it ended within the gap before the log's end."""
    long_rows: int
    """Rows of episodes that are dropped as too long."""


def split_bounds(rows: SortedRows, split: tuple[float, ...]) -> tuple[int, int]:
    """Times (ms) at which validation and test begin; beyond the last row if users are split."""
    if len(split) < 3:
        times = split if len(split) == 2 else (rows.last_ms + 1,) * 2
        return int(times[0]), int(times[1])
    begin, end = (_find_time(rows, round(rows.count * share)) for share in np.cumsum(split)[:2])
    return begin, end


def _find_time(rows: SortedRows, place: int) -> int:
    """The time at a place of the sorted times; past the end, the time after the last."""
    low, high = rows.first_ms, rows.last_ms + 1
    # Each round counts times in bins, and goes on within the bin that has the place.
    while high - low > 1 and place < rows.count:
        width, counts = (high - low - 1) // _BINS + 1, np.zeros(_BINS, dtype=np.int64)
        for batch in rows.file.read(schema.TIMESTAMP):
            times = batch[schema.TIMESTAMP]
            inside = times[(times >= low) & (times < high)]
            counts += np.bincount((inside - low) // width, minlength=_BINS)
        below = np.cumsum(counts)
        chosen = int(np.searchsorted(below, place, side="right"))
        place -= int(below[chosen - 1]) if chosen else 0
        low, high = low + chosen * width, min(low + (chosen + 1) * width, high)
    return low if place < rows.count else rows.last_ms + 1


def read_episodes(rows: SortedRows, cut: Cut) -> Iterator[Episodes]:
    """Cut the rows into episodes, some thousand rows at a time."""
    for batch in rows.file.read():
        users, times = batch[USER], batch[schema.TIMESTAMP]
        latest = times[:-1]
        if rows.has_lists:
            # The time of a decision is that of its first row.
            firsts = np.flatnonzero(batch[schema.PLACE] == 0)
            sizes = np.diff(firsts, append=len(times))
            times = batch[schema.TIMESTAMP] = np.repeat(np.minimum.reduceat(times, firsts), sizes)
        user_ends = np.append(users[1:] != users[:-1], True)
        ends, last_ends = user_ends, np.full(len(users), cut.session_by == schema.SESSION_ID)
        if cut.session_by == "gap":
            pause = times[1:] - latest > cut.gap_ms
            if schema.SESSION_BEGAN in batch:
                previous, began = (batch[schema.SESSION_BEGAN][n:][: len(pause)] for n in (0, 1))
                moved = np.abs(began - previous) > schema.CLOCKS_DIFFER_MS
                # A client that sends its latest rows alone moves the begin, but not past a row.
                passed = began - latest
                moved &= (passed > schema.CLOCKS_DIFFER_MS) | pause
                is_other = np.where(previous < 0, passed > 0, moved)
                pause = np.where(began < 0, pause, is_other | (began == times[1:]))
            ends = user_ends | np.append(pause & (batch[schema.PLACE][1:] == 0), True)
            last_ends = rows.last_ms - times > cut.gap_ms
        elif cut.session_by == schema.SESSION_ID:
            ends = user_ends | np.append(batch[SESSION][1:] != batch[SESSION][:-1], True)
        splits = (times >= cut.bounds[0]).astype(np.int64) + (times >= cut.bounds[1])
        if cut.leave_last:
            lengths = np.diff(np.flatnonzero(user_ends), prepend=-1)
            ahead = np.repeat(np.cumsum(lengths), lengths) - np.arange(len(times))
            # Sessions of one user may overlap.
            ahead[np.lexsort((times, users))] = ahead.copy()
            splits = (ahead <= cut.leave_last).astype(np.int64) + (ahead <= 2 * cut.leave_last)
            splits *= np.repeat(lengths > 2 * cut.leave_last, lengths)
            # A decision with several rows is not cut.
            splits = splits[np.arange(len(times)) - batch[schema.PLACE]]
        last = np.flatnonzero(ends | np.append(splits[1:] != splits[:-1], True))
        lengths = np.diff(last, prepend=-1)
        begins_session = np.append(True, ends[last[:-1]])
        terminated = np.where(user_ends, last_ends, ends)[last]
        too_long = lengths > (lengths.max() if cut.max_steps is None else cut.max_steps)
        fits = (lengths >= cut.min_steps) & ~too_long
        if not fits.all():
            batch = take_rows(batch, np.repeat(fits, lengths))
        yield Episodes(
            batch,
            lengths[fits],
            users[last][fits],
            splits[last][fits],
            begins_session[fits],
            terminated[fits],
            int(lengths[too_long].sum()),
        )


class Moments:
    """Number, extremes, mean and squared deviations of vectors of one size, in batches, by the
    formula of Chan, Golub and LeVeque (1983), whose rounding errors do not grow with the mean."""

    def __init__(self, size: int) -> None:
        self.count = 0
        self.mean = np.zeros(size)
        self.lowest, self.highest = np.full(size, np.inf), np.full(size, -np.inf)
        self._deviations = np.zeros((size, size))

    def add(self, *entries: Array) -> None:
        """Add M vectors, given as (M,) numbers of each of their entries."""
        batch = np.array(entries, dtype=np.float64)
        if not batch.shape[1]:
            return
        self.lowest = np.minimum(self.lowest, batch.min(axis=1))
        self.highest = np.maximum(self.highest, batch.max(axis=1))
        mean = batch.mean(axis=1)
        centred = batch - mean[:, None]
        apart = mean - self.mean
        total = self.count + batch.shape[1]
        self._deviations += centred @ centred.T
        self._deviations += np.outer(apart, apart) * (self.count * batch.shape[1] / total)
        self.mean += apart * (batch.shape[1] / total)
        self.count = total

    @property
    def covariance(self) -> Float64Array:
        """(size, size) covariance of all vectors so far, not corrected for their number."""
        return self._deviations / max(self.count, 1)


@dataclass
class StepCounts:
    """Counts and statistics of the steps in episodes."""

    item_steps: IntArray
    item_train_steps: IntArray
    """(items,) number of steps, and of training steps, that show each item, by code."""
    steps: int = 0
    decisions: int = 0
    first_ms: int = np.iinfo(np.int64).max
    last_ms: int = 0
    rewards: Moments = field(default_factory=lambda: Moments(1))
    returns: Moments = field(default_factory=lambda: Moments(2))
    """Of training steps: rewards and number of steps from there to the end of the episode."""
    long_rows: int = 0
    """Rows of episodes that are dropped as too long."""
    beyond_a_day: int = 0
    """Number of episodes that last longer than a day."""
    unknown_propensities: int = 0
    not_above_0: int = 0
    above_1: int = 0
    """Numbers of propensities."""
    lowest_propensity: float = 0.0
    highest_propensity: float = 0.0

    def add(self, episodes: Episodes) -> None:
        """Count the steps of episodes."""
        self.long_rows += episodes.long_rows
        times, rewards = (episodes.rows[name] for name in (schema.TIMESTAMP, schema.REWARD))
        if not len(times):
            return
        self.steps += len(times)
        self.decisions += int(np.count_nonzero(episodes.rows[schema.PLACE] == 0))
        self.first_ms = min(self.first_ms, int(times.min()))
        self.last_ms = max(self.last_ms, int(times.max()))
        self.rewards.add(rewards)
        training = np.repeat(episodes.splits == 0, episodes.lengths)
        ends = np.cumsum(episodes.lengths)
        spans = times[ends - 1] - times[ends - episodes.lengths]
        self.beyond_a_day += int(np.count_nonzero(spans > DAY_MS))
        ahead = np.repeat(ends, episodes.lengths) - np.arange(len(rewards))
        earned = np.append(0.0, np.cumsum(rewards))
        return_to_go = np.repeat(earned[ends], episodes.lengths) - earned[:-1]
        self.returns.add(return_to_go[training], ahead[training])
        if ITEM in episodes.rows:
            items, size = episodes.rows[ITEM], len(self.item_steps)
            self.item_steps += np.bincount(items, minlength=size)
            self.item_train_steps += np.bincount(items[training], minlength=size)
        if schema.PROPENSITY in episodes.rows:
            propensities = episodes.rows[schema.PROPENSITY]
            self.unknown_propensities += int(np.count_nonzero(np.isnan(propensities)))
            self.not_above_0 += int(np.count_nonzero(propensities <= 0))
            self.above_1 += int(np.count_nonzero(propensities > 1))
            lowest, highest = self.lowest_propensity, self.highest_propensity
            self.lowest_propensity = float(np.fmin.reduce(propensities, initial=lowest))
            self.highest_propensity = float(np.fmax.reduce(propensities, initial=highest))


def count_steps(rows: SortedRows, cut: Cut) -> StepCounts:
    """Go through all episodes once, and create `EPISODES`, `USED_USERS` and `USED_ITEMS`. Raises
    InputError if no episode is left, none is in the training split, or a propensity is none."""
    log, connection = rows.log, rows.log.connection
    has_items = log.key == schema.ITEM_ID
    n_items = log.one("SELECT count(*) FROM item_codes")[0] if has_items else 0
    counts = StepCounts(np.zeros(n_items, dtype=np.int64), np.zeros(n_items, dtype=np.int64))
    fields = ("users", "splits", "lengths", "begins_session", "terminated")
    whole_numbers = pa.schema([(name, pa.int64()) for name in fields])

    def count() -> Iterator[pa.RecordBatch]:
        for episodes in read_episodes(rows, cut):
            counts.add(episodes)
            columns = [to_arrow(getattr(episodes, name)) for name in fields]
            yield pa.record_batch(columns, schema=whole_numbers)

    connection.register("counted", pa.RecordBatchReader.from_batches(whole_numbers, count()))
    connection.execute(
        f"CREATE TEMP TABLE {EPISODES} AS SELECT row_number() OVER () - 1 AS episode, "
        "users AS user_code, splits AS split, lengths AS steps, "
        "begins_session = 1 AS begins_session, terminated = 1 AS terminated FROM counted"
    )
    connection.execute(
        f"""
        CREATE TEMP TABLE {USED_USERS} AS
        SELECT {schema.USER_ID}, code, steps, train_count, longest, ended FROM user_codes JOIN (
            SELECT user_code AS code, CAST(sum(steps) AS BIGINT) AS steps, max(steps) AS longest,
                arg_max(terminated, episode) AS ended,
                CAST(coalesce(sum(steps) FILTER (split = 0), 0) AS BIGINT) AS train_count
            FROM {EPISODES} GROUP BY user_code
        ) USING (code)
        """
    )
    if has_items:
        codes = np.flatnonzero(counts.item_steps)
        columns = (codes, counts.item_steps[codes], counts.item_train_steps[codes])
        used_codes = pa.record_batch(list(map(to_arrow, columns)), ["code", "steps", "train_count"])
        connection.register("used", used_codes)
        connection.execute(
            f"CREATE TABLE {USED_ITEMS} AS SELECT {schema.ITEM_ID}, code, steps, train_count "
            "FROM item_codes JOIN used USING (code)"
        )
    _require_usable(rows, cut, counts)
    return counts


def _require_usable(rows: SortedRows, cut: Cut, counts: StepCounts) -> None:
    if not counts.steps:
        raise InputError(
            f"no session is left: none of the {rows.count} clean rows is in an episode of "
            f"{cut.min_steps} steps or more; lower min_steps or widen the sessions"
        )
    if not rows.log.one(f"SELECT count(*) FROM {EPISODES} WHERE split = 0")[0]:
        ends = datetime.fromtimestamp(cut.bounds[0] / 1000, UTC)
        raise InputError(
            f"no row is in the training split, before {ends:%Y-%m-%d %H:%M:%S} UTC: all are of "
            "that time or later; log finer times, or choose a later split"
        )
    log, name = rows.log, schema.PROPENSITY
    if counts.not_above_0:
        lowest = f"{counts.lowest_propensity:.6g}"
        raise InputError(
            f"{log.name}: {name} is not above 0, down to {lowest}, in {counts.not_above_0:,} of "
            f"{counts.steps:,} rows; of a logarithm give --column propensity='exp(propensity)'; "
            f"if {lowest} means unknown, --column propensity='nullif(propensity, {lowest})'"
        )
    if counts.above_1 and log.key == schema.ITEM_ID:
        raise InputError(
            f"{log.name}: {name} is above 1, up to {counts.highest_propensity:.6g}, in "
            f"{counts.above_1:,} of {counts.steps:,} rows; give the probability that the item was "
            "shown: of a percentage with --column propensity='propensity / 100', or ignore the "
            "column with --column propensity="
        )


def number_ids(
    log: TypedLog,
    features: Mapping[str, Sequence[str]],
    store: Path | None,
    grows: bool,
) -> None:
    """Create the tables `users` and `items`: id, its `number` in sorted order, `train_count`; after
    `count_steps`. Ids are those of the steps and of feature tables (by id column). Those of a
    `store` have its numbers, and others none; if it `grows`, they follow and counts are added up.
    """
    for name, table, file in ID_TABLES:
        if name not in log.columns:
            continue
        kind = log.find_type(name)
        old = f"SELECT NULL::{kind} AS {name}, 0 AS number, 0 AS train_count WHERE false"
        if store is not None:
            # Ids may be integers in the store and text in the log, or vice versa.
            value = cast_integer(name) if kind == "BIGINT" else f"CAST({name} AS VARCHAR)"
            options = "file_row_number = true, hive_partitioning = false"
            source = f"read_parquet({quote(glob_pattern(store / file))}, {options})"
            old = (
                f"SELECT {value} AS {name}, file_row_number AS number, "
                f"{'' if grows else '0 AS '}train_count FROM {source}"
            )
            if not grows:
                log.connection.execute(f"CREATE TABLE {table} AS {old}")
                continue
        ids = [f"SELECT {name} FROM used_{table}"]
        ids += [f"SELECT id FROM {feature_table}" for feature_table in features[name]]
        log.connection.execute(f"""
            CREATE TABLE {table} AS
            WITH old AS ({old}),
            new AS (({" UNION ".join(ids)}) EXCEPT SELECT {name} FROM old),
            every AS (
                SELECT {name}, number, train_count FROM old UNION ALL
                SELECT {name}, (SELECT count(*) FROM old) + row_number() OVER (ORDER BY {name}) - 1,
                    0 FROM new
            )
            SELECT {name}, number, a.train_count + coalesce(b.train_count, 0) AS train_count
            FROM every AS a LEFT JOIN used_{table} AS b USING ({name})
        """)


def list_text_ids(store: Path | None) -> tuple[str, ...]:
    """Id columns that are text in a store; none without one."""
    return tuple(
        name
        for name, _, file in ID_TABLES
        if store is not None and (store / file).is_file()
        if not pa.types.is_integer(pq.read_schema(store / file).field(name).type)
    )


def write_ids(log: TypedLog, folder: Path, offers: "Offers | None") -> dict[str, list[Any]]:
    """Write the files of users, items and offers; returns digests for the fingerprint."""
    digests: dict[str, list[Any]] = {}
    for name, table, file in ID_TABLES:
        if name not in log.columns:
            continue
        rows = log.connection.sql(f"SELECT * EXCLUDE number FROM {table} ORDER BY number")
        batches, digest = rows.to_arrow_reader(BATCH_ROWS), hashlib.sha256()
        with pq.ParquetWriter(folder / file, batches.schema) as writer:
            for batch in batches:
                writer.write_batch(batch)
                digest.update("\n".join(map(str, batch.column(0).to_pylist())).encode())
        digests[name] = [digest.hexdigest()]
    if offers is not None:
        offers.save(folder / OFFERS)
        digests["offers"] = [offers.digest()]
    return digests


def write_batches(file: Path, batches: pa.RecordBatchReader) -> None:
    """Write rows to a Parquet file, as DuckDB's COPY may only do in the scratch folder."""
    with pq.ParquetWriter(file, batches.schema) as writer:
        for batch in batches:
            writer.write_batch(batch)


def write_steps(
    rows: SortedRows,
    cut: Cut,
    folder: Path,
    display: Progress,
    offers: "Offers | None",
    sets: IntArray | None,
    first_shard: int = 0,
    fill: Mapping[str, float] | None = None,
) -> StoreWriter:
    """Write all steps to the store at `folder`, after `number_ids`; unknown users and items are −1.

    `fill` has the step columns of the store, with what steps without a value have; others are left
    out. None for those of the log. `sets` has the set of candidates of each code, as of
    `number_sets`. Warns of steps whose item is not on offer, and of lists with several sets.
    """
    unavailable = total = mixed = 0
    log, writer = rows.log, StoreWriter(folder, first_shard=first_shard)
    users = _read_numbers(log, "users", schema.USER_ID)
    items = _read_numbers(log, "items", schema.ITEM_ID) if log.key == schema.ITEM_ID else users
    for episodes in read_episodes(rows, cut):
        columns, lengths = episodes.rows, episodes.lengths
        count = int(lengths.sum())
        if ITEM in columns:
            columns[schema.ITEM] = items[columns[ITEM]]
        if sets is not None:
            columns[schema.CANDIDATES] = sets[columns[CANDIDATE_SET]]
            differs = np.diff(columns[schema.CANDIDATES], prepend=-1) != 0
            mixed += int((differs & (columns[schema.PLACE] > 0)).sum())
        if offers is not None and count:
            chosen = columns.get(schema.CANDIDATES, np.full(count, -1))
            unavailable += offers.count_unavailable(
                columns[schema.ITEM], columns[schema.TIMESTAMP], chosen
            )
            total += count
        if rows.observations is not None:
            columns[schema.OBSERVATION] = rows.observations.read(columns["row"])
        if not rows.has_lists:
            del columns[schema.PLACE]
        steps = {
            n: columns[n] for n in schema.STEP_DTYPES if n in columns and n in (fill or columns)
        }
        steps |= {n: np.full(count, v) for n, v in (fill or {}).items() if n not in steps}
        first = np.zeros(count, dtype=bool)
        first[np.cumsum(lengths) - lengths] = True
        values = {
            schema.USER: users[episodes.users],
            schema.SPLIT: episodes.splits,
            schema.TERMINATED: episodes.terminated,
        }
        writer.append(steps, first, {n: np.repeat(v, lengths) for n, v in values.items()})
        display.update(count)
    if mixed:
        warn_user(
            f"{log.name}: {mixed:,} rows have other {schema.CANDIDATES} than the row above in "
            "their list; give all rows of a list those that it was chosen from"
        )
    if unavailable:
        warn_user(
            f"{log.name}: {unavailable:,} of {total:,} rows show an item at a time at which the "
            "table of items says it is not available (check the time zones of both), or one that "
            "is not among the row's candidates"
        )
    return writer


def _read_numbers(log: TypedLog, table: str, name: str) -> IntArray:
    """Number in a table of each id by code; −1 for others, and for ids in no step."""
    (size,) = log.one(f"SELECT count(*) FROM {CODES[name][0]}")
    numbers = np.full(size, -1, dtype=np.int32)
    query = f"SELECT code, CAST(number AS INTEGER) FROM used_{table} JOIN {table} USING ({name})"
    for batch in log.connection.sql(query).to_arrow_reader(BATCH_ROWS):
        numbers[to_numpy(batch.column(0))] = to_numpy(batch.column(1))
    return numbers
