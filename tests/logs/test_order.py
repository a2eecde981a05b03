"""Order statistics of rows on disk: the same in blocks of any size, and as counted naively."""

from pathlib import Path

import numpy as np
import pytest

from ucfrec.logs.order import count_unsorted, ranked
from ucfrec.logs.spool import Spool


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
