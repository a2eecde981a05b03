"""Sets of candidates in logs: a store has each once, however a log writes them."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.support.logs import random_log, write
from ucfrec import EpisodeStore
from ucfrec.errors import InputError, InputNote
from ucfrec.logs.append import append_logs
from ucfrec.logs.mapping import LogMapping, read_mapping
from ucfrec.logs.prepare import PrepareOptions, prepare

SETS = [[0, 1, 2, 3], [3, 2, 1, 0, 999], [4, 5], [999], None]
"""Candidates; the second are those of the first, as far as they are known."""
KNOWN = [[0, 1, 2, 3], [0, 1, 2, 3], [4, 5], [*range(20)], [*range(20)]]


def make_log(rows: int, seed: int) -> pd.DataFrame:
    """A log whose items are candidates, with the place of each row's set in `SETS`."""
    rng, log = np.random.default_rng(seed), random_log(rows, items=20)
    log["place"] = rng.integers(0, 5, rows)
    log["item_id"] = [rng.choice(KNOWN[n]) for n in log.place]
    log["timestamp"] += seed * 10**9
    return log.assign(candidates=[SETS[n] for n in log.place])


def list_offered(store: EpisodeStore) -> dict[int, list[int]]:
    """What was on offer at every time."""
    offer = store.offer(*store.all_steps())
    assert offer is not None
    rows = [torch.nonzero(row)[:, 0].tolist() for row in offer.mask()]
    return dict(zip(store.column("timestamp").tolist(), rows, strict=True))


def expect(log: pd.DataFrame) -> dict[int, list[int]]:
    return {time: KNOWN[n] for time, n in zip(log.timestamp, log.place, strict=True)}


def prepared(log: Path, folder: Path, mapping: LogMapping | None = None) -> EpisodeStore:
    prepare([log], mapping or LogMapping(), folder, PrepareOptions())
    return EpisodeStore.open(folder)


def test_lists_and_names_of_sets_are_one_store(tmp_path: Path) -> None:
    log = make_log(300, 0)
    by_list = prepared(write(log, tmp_path / "lists.parquet"), tmp_path / "a")
    assert list_offered(by_list) == expect(log)
    assert not by_list.has_offers  # no item comes or goes
    sets = by_list.offer(*by_list.all_steps()).offers.sets
    assert sets.tolist() == [[0, 0, 0, 0, 1, 1], [0, 1, 2, 3, 4, 5]]
    named = log.assign(candidates=[f"0{n}" if n < 4 else "" for n in log.place])
    names = pd.DataFrame({"candidates": [f"0{n}" for n in range(4)], "items": SETS[:4]})
    again = names.assign(items=[items + items[:1] for items in SETS[:4]])  # the same sets
    write(pd.concat([names, again]), tmp_path / "sets" / "table.parquet")
    (tmp_path / "map.toml").write_text("candidate_sets = ['sets/*.parquet']")
    shuffled = write(named.sample(frac=1, random_state=0), tmp_path / "named.csv")
    stores = [prepared(shuffled, tmp_path / "b", read_mapping(tmp_path / "map.toml"))]
    with pytest.raises(InputError, match=r"4 sets that candidates names \(such as '00'\) are in"):
        prepared(shuffled, tmp_path / "unnamed")
    write(names, tmp_path / "day" / "log.candidates.parquet")
    write(named, tmp_path / "day" / "log.parquet")
    stores.append(prepared(tmp_path / "day", tmp_path / "c"))
    for store in stores:
        assert store.record.fingerprint == by_list.record.fingerprint
        assert list_offered(store) == expect(log)


def test_an_updated_store_has_the_sets_of_all_logs(tmp_path: Path) -> None:
    logs = [make_log(300, 0), make_log(100, 1), make_log(100, 2)]
    logs[0] = logs[0][logs[0].place != 0]
    files = [write(log, tmp_path / f"{n}.parquet") for n, log in enumerate(logs)]
    prepared(files[0], tmp_path / "store0")
    plain = write(logs[0].drop(columns="candidates"), tmp_path / "plain.parquet")
    prepared(plain, tmp_path / "plain0")
    everything = dict.fromkeys(logs[0].timestamp, KNOWN[3])
    for name, expected in ("store", expect(logs[0])), ("plain", everything):
        for n in (1, 2):
            append_logs(tmp_path / f"{name}{n - 1}", [files[n]], tmp_path / f"{name}{n}")
            expected |= expect(logs[n])
        grown = EpisodeStore.open(tmp_path / f"{name}2")
        assert list_offered(grown) == expected
        assert grown.offer(*grown.all_steps()).offers.sets.shape == (2, 6)


def test_rows_beside_their_candidates_are_noted_and_bad_columns_refused(tmp_path: Path) -> None:
    log = random_log()
    outside = write(log.assign(candidates=[[3, 4]] * len(log)), tmp_path / "log.parquet")
    count = (~log.item_id.isin([3, 4])).sum()
    with pytest.warns(InputNote, match=rf"{count} of 400 rows show .* not among the row's"):
        prepared(outside, tmp_path / "store")
    strange = log.assign(candidates=[["0" * (item % 2) + str(item)] for item in log.item_id])
    with pytest.warns(InputNote, match="10 of 20 sets of candidates have no item of the store"):
        prepared(write(strange, tmp_path / "strange.parquet"), tmp_path / "strange")
    first, later = log.assign(candidates=[[*range(20)]] * 400), log.assign(item_id=log.item_id ^ 1)
    with pytest.warns(InputNote, match="400 rows have other candidates than the row above in"):
        prepared(write(pd.concat([first, later]), tmp_path / "pages.parquet"), tmp_path / "pages")
    with pytest.raises(InputError, match=r"candidates .*use a list of item_ids"):
        prepared(write(log.assign(candidates=0.5), tmp_path / "bad.parquet"), tmp_path / "bad")
    named = write(log.assign(candidates="a"), tmp_path / "named.parquet")
    several, no_list = "named.cand.*'a'. have several sets", r"(DOUBLE..|BIGINT); use a list of"
    for items, says in (([[3, 4], [3]], several), ([[3.0]], no_list), ([3], no_list)):
        names = pd.DataFrame({"candidates": "a", "items": items})
        write(names, tmp_path / "named.candidates.parquet")
        with pytest.raises(InputError, match=says):
            prepared(named, tmp_path / "named")
    empty = write(log.assign(candidates=[[]] * len(log)), tmp_path / "empty.parquet")
    every = prepared(empty, tmp_path / "every").record.fingerprint
    assert every != EpisodeStore.open(tmp_path / "store").record.fingerprint
