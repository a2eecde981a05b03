from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ucfrec.episodes.offers import Offers
from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import load_tensors, save_tensors

ITEMS, TIMES = st.integers(0, 5), st.integers(0, 12)
INTERVALS = st.lists(st.tuples(ITEMS, TIMES, TIMES).filter(lambda row: row[1] < row[2]), max_size=9)
SETS = st.lists(st.sets(ITEMS), max_size=4)
DECISIONS = st.lists(st.tuples(TIMES, st.integers(-1, 3)), min_size=1, max_size=6)


def make_offers(intervals: list[tuple[int, int, int]], sets: list[set[int]]) -> Offers:
    members = [(number, item) for number, items in enumerate(sets) for item in sorted(items)]
    rows = np.array(intervals, dtype=np.int64).reshape(-1, 3).T
    return Offers.of(6, rows, np.array(members, dtype=np.int64).reshape(-1, 2).T.copy())


@given(intervals=INTERVALS, sets=SETS, decisions=DECISIONS, chosen=st.sets(ITEMS, min_size=1))
def test_an_item_is_offered_in_any_of_its_intervals_and_if_it_is_a_candidate(
    intervals, sets, decisions, chosen
):
    offers = make_offers(intervals, sets)
    decisions = [(time, number if number < len(sets) else -1) for time, number in decisions]
    times, numbers = torch.tensor(decisions).T
    expected = [
        [
            (
                any(begin <= time < end for i, begin, end in intervals if i == item)
                or all(i != item for i, _, _ in intervals)
            )
            and (number < 0 or item in sets[number])
            for item in range(6)
        ]
        for time, number in decisions
    ]
    offer = offers.at(times, numbers)
    assert offer.mask().tolist() == expected
    some = torch.tensor(sorted(chosen))
    assert torch.equal(offer.mask(some), offer.mask()[:, some])


def test_a_file_is_read_as_written_and_refused_when_it_is_of_another_catalogue(tmp_path: Path):
    file, offers = tmp_path / "offers", make_offers([(1, 2, 9), (1, 10, 11)], [{0, 1}, {3}])
    offers.save(file)
    loaded = Offers.load(file, 6)
    assert all(
        torch.equal(a, b) for a, b in zip(vars(loaded).values(), vars(offers).values(), strict=True)
    )
    with pytest.raises(InputError, match="not of 7 items"):
        Offers.load(file, 7)
    tensors, _ = load_tensors(file)
    for name, value in (("later", 6), ("sets", -1), ("sets", 9)):
        damaged = {**tensors, name: tensors[name].clone()}
        damaged[name][0 if name == "later" else 1, 0] = value
        save_tensors(file, damaged, {})
        with pytest.raises(InputError, match="damaged"):
            Offers.load(file, 6)
