"""SQL that cuts clean log rows into episodes and numbers their users and items."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.logs.binding import glob_pattern, text
from ucfrec.logs.clean import CleanLog

ITEMS_FILE: Final = "items.parquet"
USERS_FILE: Final = "users.parquet"
EPISODE_USERS: Final = "episode_users.parquet"
ID_TABLES: Final = (
    (schema.USER_ID, "users", USERS_FILE),
    (schema.ITEM_ID, "items", ITEMS_FILE),
)
"""Id column, its DuckDB table of ids and numbers, and the file of that table in the store."""
SESSIONS: Final = (schema.SESSION_ID, "gap", "user")
"""Ways in which rows form sessions."""


@dataclass(frozen=True)
class Cut:
    """How rows form episodes."""

    session_by: str
    """One of `SESSIONS`."""
    gap_ms: int
    """With "gap": a longer pause (ms) ends the session."""
    min_steps: int
    """Episodes with fewer steps are dropped."""
    bounds: tuple[int, int]
    """Times (ms) at which the validation and the test split begin."""


def split_bounds(log: CleanLog, split: tuple[float, ...]) -> tuple[int, int]:
    """Times (ms) at which the validation and the test split begin.

    Args:
        log: clean log.
        split: three shares of the rows in order of time, or the two times (ms).
    """
    if len(split) == 2:
        return int(split[0]), int(split[1])
    (rows, last) = log.one(f"SELECT count(*), max({schema.TIMESTAMP}) FROM clean")
    positions = [round(rows * split[0]), round(rows * (split[0] + split[1]))]
    # An exact quantile in bounded memory: DuckDB's aggregate would keep every time in memory.
    begin, end = (
        last + 1
        if position >= rows
        else log.one(
            f"SELECT {schema.TIMESTAMP} FROM clean ORDER BY {schema.TIMESTAMP} "
            f"LIMIT 1 OFFSET {position}"
        )[0]
        for position in positions
    )
    return begin, end


def cut_episodes(log: CleanLog, cut: Cut) -> None:
    """Create the table `steps` of the rows in episodes of `cut.min_steps` or more.

    It has the columns of `clean` except `row`, and `split` (0 train, 1 validation, 2 test),
    `starts` (first step of a session), `first` (first step of an episode), `episode` (number within
    the user) and `terminated`, which is false for episodes cut at a split and for sessions that may
    have gone on after the log ended: a user's last one if sessions are users, or if it ended within
    the gap before the end of the log.

    Raises:
        InputError: no episode remains, or none in the training split.
    """
    time, user = schema.TIMESTAMP, schema.USER_ID
    if cut.session_by == schema.SESSION_ID:
        # Sessions of one user may overlap: each stays whole, ordered by its first row.
        source = (
            f"SELECT *, min({time}) OVER (PARTITION BY {user}, {schema.SESSION_ID}) AS began "
            "FROM clean"
        )
        order = f"began, {schema.SESSION_ID}, {time}, {log.key}"
        starts = f"{schema.SESSION_ID} IS DISTINCT FROM lag({schema.SESSION_ID}) OVER w"
    else:
        source, order = "SELECT *, 0 AS began FROM clean", f"{time}, {log.key}"
        starts = f"lag({time}) OVER w IS NULL"
        if cut.session_by == "gap":
            starts += f" OR {time} - lag({time}) OVER w > {cut.gap_ms}"
    log.connection.execute(f"""
        CREATE TABLE steps AS
        WITH marked AS (
            SELECT *, {starts} AS starts,
                CAST(({time} >= {cut.bounds[0]})::INT + ({time} >= {cut.bounds[1]})::INT
                    AS UTINYINT) AS split
            FROM ({source}) WINDOW w AS (PARTITION BY {user} ORDER BY {order})
        ), ended AS (
            SELECT *, starts OR split <> lag(split) OVER w AS first,
                coalesce(lead(starts) OVER w, {_last_row_ends(cut)}) AS ends
            FROM marked, (SELECT max({time}) AS log_end FROM clean)
            WINDOW w AS (PARTITION BY {user} ORDER BY {order})
        ), numbered AS (
            SELECT *, CAST(sum(first::INT) OVER w AS BIGINT) AS episode
            FROM ended WINDOW w AS (PARTITION BY {user} ORDER BY {order})
        ), measured AS (
            SELECT * EXCLUDE (ends, began, row, log_end),
                count(*) OVER e AS length, bool_or(ends) OVER e AS terminated
            FROM numbered WINDOW e AS (PARTITION BY {user}, episode)
        )
        SELECT * EXCLUDE (length) FROM measured WHERE length >= {cut.min_steps}
    """)
    kept, training = log.one("SELECT count(*), count_if(split = 0) FROM steps")
    if kept == 0:
        (rows,) = log.one("SELECT count(*) FROM clean")
        raise InputError(
            f"no session is left: none of the {rows} clean rows is in an episode of "
            f"{cut.min_steps} steps or more; lower min_steps or widen the sessions"
        )
    if training == 0:
        raise InputError(
            f"no row is in the training split (before {cut.bounds[0]} ms); choose a later split"
        )


def _last_row_ends(cut: Cut) -> str:
    """SQL that tells if a user's last row ends its session for certain."""
    if cut.session_by == schema.SESSION_ID:
        return "true"
    return "false" if cut.session_by == "user" else f"log_end - {schema.TIMESTAMP} > {cut.gap_ms}"


def number_ids(log: CleanLog, listed: dict[str, list[str]], like: Path | None) -> None:
    """Create the tables `users` and `items`: id, its `number` in sorted order, `train_count`.

    Args:
        log: log with the table `steps`.
        listed: log column to feature tables whose column `id` lists more users or items.
        like: a store whose numbers are reused instead (without `train_count`); None for none.
    """
    for name, table, file in ID_TABLES:
        if name not in log.columns:
            continue
        if like is not None:
            source = f"read_parquet({text(glob_pattern(like / file))}, file_row_number = true)"
            # Ids may be integers in the store and text in the log, or vice versa.
            known = f"TRY_CAST({name} AS {log.id_type(name)}) AS {name}"
            log.connection.execute(
                f"CREATE TABLE {table} AS SELECT {known}, file_row_number AS number FROM {source}"
            )
            continue
        ids = [f"SELECT DISTINCT {name} FROM steps"]
        ids += [f"SELECT id FROM {other}" for other in listed[name]]
        log.connection.execute(f"""
            CREATE TABLE {table} AS
            SELECT {name}, row_number() OVER (ORDER BY {name}) - 1 AS number,
                coalesce(train_count, 0) AS train_count
            FROM ({" UNION ".join(ids)}) LEFT JOIN (
                SELECT {name}, count(*) AS train_count FROM steps WHERE split = 0 GROUP BY {name}
            ) USING ({name})
        """)


def ordered_steps(log: CleanLog) -> str:
    """Query of the steps in the order of the store, with numbers in place of ids."""
    columns = ["coalesce(users.number, -1) AS user", "split", "terminated", "first"]
    joins = f"LEFT JOIN users USING ({schema.USER_ID})"
    if log.key == schema.ITEM_ID:
        columns.append(f"coalesce(items.number, -1) AS {schema.ITEM}")
        joins += f" LEFT JOIN items USING ({schema.ITEM_ID})"
    columns += [schema.TIMESTAMP, f"CAST({schema.REWARD} AS FLOAT) AS {schema.REWARD}"]
    columns += log.vector_size
    columns += [c for c in (schema.PROPENSITY, schema.IS_RANDOM) if c in log.columns]
    return (
        f"SELECT {', '.join(columns)} FROM steps {joins} "
        f"ORDER BY {schema.USER_ID}, episode, {schema.TIMESTAMP}, {log.key}"
    )


def episode_users() -> str:
    """Query of the user of every episode, in the order of the store."""
    return f"SELECT {schema.USER_ID} FROM steps WHERE first ORDER BY {schema.USER_ID}, episode"
