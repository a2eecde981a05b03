"""Episodes and order statistics are the same however many rows are in memory at a time."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ucfrec.logs.engine import engine
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.sessions import Cut, by_sessions, count_unsorted, episodes, ranked
from ucfrec.logs.sorted_rows import check_sorted, sorted_batches
from ucfrec.logs.spool import Spool
from ucfrec.logs.tables import open_tables
from ucfrec.logs.typed import typed_log

START = 1_700_000_000_000


@pytest.mark.parametrize("session_by", ["gap", "user", "session_id"])
@pytest.mark.parametrize("min_steps", [1, 3])
def test_blocks_of_any_size_give_the_same_episodes(
    tmp_path: Path, session_by: str, min_steps: int
) -> None:
    generator = np.random.default_rng(0)
    n, path = 300, tmp_path / "log.parquet"
    times = START + generator.permutation(5 * n)[:n]
    pd.DataFrame(
        {
            "user_id": generator.geometric(0.2, n),
            "item_id": generator.integers(9, size=n),
            "timestamp": times,
            "reward": generator.random(n),
            "session_id": generator.integers(3, size=n),
        }
    ).to_parquet(path)
    cut = Cut(session_by, 20, min_steps, (START + 900, START + 1200))
    results = []
    with engine([path], tmp_path) as connection:
        tables = tuple(open_tables(connection, [path]))
        log = typed_log(connection, tables, LogMapping(), "reward", session_by, tmp_path)
        rows = check_sorted(log, sorted_batches(log, None, tmp_path), "highest", tmp_path)
        for block in (1, 2, 7, 1000):
            spool = rows.clean
            if session_by == "session_id":
                spool = by_sessions(rows, tmp_path / f"sessions{block}", block)
            found = list(episodes(spool, cut, rows.last_ms, block))
            names = ("lengths", "users", "splits", "begins_session", "terminated")
            columns = [np.concatenate([getattr(each, name) for each in found]) for name in names]
            times = np.concatenate([each.column(spool, "timestamp") for each in found])
            results.append([*columns, times])
    for other in results[1:]:
        for ours, theirs in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(ours, theirs)
    lengths, times = results[0][0], results[0][-1]
    assert lengths.min() >= min_steps
    assert lengths.sum() == len(times)
    within = np.repeat(np.arange(len(lengths)), lengths)
    assert (np.diff(times)[np.diff(within) == 0] > 0).all()
    if session_by == "gap":
        assert np.diff(times)[np.diff(within) == 0].max() <= 20


def spooled(folder: Path, **columns: object) -> Spool:
    spool = Spool(folder)
    spool.append({name: np.asarray(values) for name, values in columns.items()})
    return spool


@pytest.mark.parametrize("seed", range(25))
def test_rows_after_a_later_row_of_their_user_are_counted(tmp_path: Path, seed: int) -> None:
    generator = np.random.default_rng(seed)
    n = int(generator.integers(1, 50))
    user, time = generator.integers(-1, 3, n), generator.integers(6, size=n)
    row = generator.permutation(n) + 1
    expected = sum(
        any((user[j] == user[i]) and time[j] > time[i] and row[j] < row[i] for j in range(n))
        for i in range(n)
    )
    order = np.lexsort((time, user))
    placed = spooled(tmp_path / "s", user=user[order], timestamp=time[order], row=row[order])
    for block in (1, 2, 3, 7, 100):
        assert count_unsorted(placed, block) == expected


@pytest.mark.parametrize("span", [1, 50, 10**7, 10**12])
def test_ranks_are_those_of_the_sorted_values(tmp_path: Path, span: int) -> None:
    generator = np.random.default_rng(0)
    values = 1_700_000_000_000 + generator.integers(span, size=200)
    spool = spooled(tmp_path / "s", t=values)
    positions = [0, 3, 160, 199]
    found = ranked(spool, "t", int(values.min()), int(values.max()), positions, block=17)
    assert found == np.sort(values)[positions].tolist()
