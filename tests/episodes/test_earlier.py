"""Earlier rows of the users of a later log agree with a slow reader."""

from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ucfrec import schema
from ucfrec.episodes import view as view_module
from ucfrec.episodes.earlier import UserRows
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore

GAP = 10


def store_of(log: pd.DataFrame, gap: int | None) -> EpisodeStore:
    """A store of rows by user and time, whose sessions end with a pause of more than `gap`."""
    first = (log.user.diff() != 0) | (log.timestamp.diff() > (np.inf if gap is None else gap))
    session = first.cumsum() - 1
    items = 12
    return EpisodeStore.from_arrays(
        {name: log[name].to_numpy() for name in (schema.ITEM, schema.REWARD, schema.TIMESTAMP)},
        np.bincount(session),
        {schema.USER: log.user[first].to_numpy()},
        ItemStates(torch.randn(items, 3), torch.zeros(0, 0), 0.0, 1.0),
    )


@given(seed=st.integers(0, 10_000), gap=st.sampled_from([None, GAP]), share=st.floats(0.1, 0.9))
def test_the_rows_before_a_step_are_those_of_the_user(
    seed: int, gap: int | None, share: float
) -> None:
    rng = np.random.default_rng(seed)
    n = 40
    log = pd.DataFrame({"user": rng.integers(5, size=n), "item": rng.integers(12, size=n)})
    log["reward"] = rng.integers(2, size=n).astype(float)
    log["timestamp"] = np.cumsum(rng.integers(1, 8, size=n))
    early = log.timestamp <= log.timestamp.quantile(share)
    parts = [log[rows].sort_values(["user", "timestamp"]) for rows in (early, ~early)]
    earlier, later = (store_of(part, gap) for part in parts)
    rows = UserRows.of(later, later.episode_values(schema.USER), earlier)
    view = rows.continued(gap)

    assert view.n_steps == later.n_steps
    for long_enough in (1, 1000):
        with patch.object(view_module, "_LONG_ENOUGH", long_enough):
            assert view.column(schema.ITEM).tolist() == parts[1]["item"].tolist()
    episodes, steps = view.all_steps()
    recent = rows.recent(np.arange(view.n_steps), 4)
    owner, seen = rows.seen(np.arange(view.n_steps))
    for number, row in enumerate(parts[1].itertuples()):
        before = log[(log.user == row.user) & (log.timestamp < row.timestamp)]
        newest = before.iloc[::-1][:4]
        count = len(newest)
        assert recent[0][number].tolist() == [*newest["item"], *[-1] * (4 - count)]
        assert recent[1][number].tolist() == [*newest["reward"], *[0.0] * (4 - count)]
        assert sorted(seen[owner == number]) == sorted(before["item"])
        pauses = np.diff([*before.timestamp, row.timestamp])
        ended = np.flatnonzero(pauses > (np.inf if gap is None else gap))
        session = before.iloc[ended[-1] + 1 if len(ended) else 0 :]
        at = np.array([episodes[number]]), np.array([steps[number]])
        assert steps[number] == len(session)
        assert view.items_before(*at)[1].tolist() == session["item"].tolist()
        assert view.rewards_before(*at)[0] == session["reward"].sum()
        assert view.step_values(schema.ITEM, *at)[0] == row.item
        window = view.windows(*at, 6)
        assert int(window.mask.sum()) == min(6, len(session) + 1)
        assert window.returns_to_go[0, -1] == _rest(parts[1], row, gap)


def _rest(part: pd.DataFrame, row, gap: int | None) -> float:  # type: ignore[no-untyped-def]
    after = part[(part.user == row.user) & (part.timestamp >= row.timestamp)]
    ended = np.flatnonzero(np.diff(after.timestamp) > (np.inf if gap is None else gap))
    return float(after.reward.iloc[: ended[0] + 1 if len(ended) else None].sum())


def test_rows_that_are_in_both_logs_count_once() -> None:
    log = pd.DataFrame({"user": 0, "item": range(8), "reward": 1.0, "timestamp": range(8)})
    rows = UserRows.of(store_of(log[4:], None), np.array([0]), store_of(log, None))
    assert rows.recent(np.array([3]), 8)[0].tolist() == [[6, 5, 4, 3, 2, 1, 0, -1]]


def test_users_that_are_not_known_have_no_earlier_rows() -> None:
    log = pd.DataFrame({"user": 0, "item": range(8), "reward": 1.0, "timestamp": range(8)})
    unknown = store_of(log[4:].assign(user=-1), None)
    rows = UserRows.of(unknown, np.array([7]), store_of(log, None))
    assert rows.continued(None) is unknown
    with pytest.raises(IndexError):
        rows.recent(np.array([4]), 1)
