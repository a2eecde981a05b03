import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.support.logs import START, random_log, store_of, write
from ucfrec import EpisodeStore, Recommender
from ucfrec.acting.decision import DecisionRule
from ucfrec.episodes.offers import Offers
from ucfrec.errors import InputError, InputNote
from ucfrec.fitting.checkpoint import load_tensors, save_tensors
from ucfrec.logs.append import append_logs
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare

ITEMS, TIMES = st.integers(0, 5), st.integers(0, 12)
INTERVALS = st.lists(st.tuples(ITEMS, TIMES, TIMES).filter(lambda row: row[1] < row[2]), max_size=9)
SETS = st.lists(st.sets(ITEMS, min_size=1), min_size=1, max_size=4)
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
    for item in range(6):
        column = [row[item] for row in expected]
        assert offer.has(torch.full_like(times, item)).tolist() == column
    some = torch.tensor(sorted(chosen))
    assert torch.equal(offer.mask(some), offer.mask()[:, some])


def test_a_file_is_read_as_written_and_refused_when_it_is_of_another_catalogue(tmp_path: Path):
    file, intervals = tmp_path / "offers", [(1, 2, 9), (1, 10, 11), (4, 0, 3)]
    offers = make_offers(intervals, [{0, 1}, {3}])
    offers.save(file)
    loaded = Offers.load(file, 6)
    for name in ("begin", "end", "later", "sets"):
        assert torch.equal(getattr(loaded, name), getattr(offers, name))
    assert loaded.intervals.T.tolist() == [[1, 2, 9], [4, 0, 3], [1, 10, 11]]
    with pytest.raises(InputError, match="not of 7 items"):
        Offers.load(file, 7)
    tensors, _ = load_tensors(file)
    for name, first, item in (("later", 0, 6), ("later", 0, -1), ("sets", 1, 9), ("sets", 1, 1)):
        damaged = tensors[name].clone()
        damaged[first, 0] = item
        save_tensors(file, {**tensors, name: damaged}, {})
        with pytest.raises(InputError, match="damaged"):
            Offers.load(file, 6)


HOUR, LIFE, DAYS = 3_600_000, 30, 10
"""Items 0 to 39 are new every six hours and live for so many hours; item 40 has no times, and item
41 is available on the first and on the last day."""


def write_items(folder: Path) -> LogMapping:
    begins = [START + 6 * HOUR * number - 12 * HOUR for number in range(40)]
    rows = [(number, begin, begin + LIFE * HOUR) for number, begin in enumerate(begins)]
    rows += [(40, None, None), (40, START, None), (41, None, START + 24 * HOUR)]
    rows += [(41, START + 216 * HOUR, None)]
    items = pd.DataFrame(rows, columns=["item_id", "born", "available_until"]).astype("Int64")
    items["kind"] = (items.item_id % 3).astype(str)
    file = write(items, folder / "items.parquet")
    return LogMapping(item_features=(FeatureTable((file,), "item_id", available_from="born"),))


def is_available(item: int, time: int) -> bool:
    hour = (time - START) / HOUR
    if item >= 40:
        return item == 40 or hour < 24 or hour >= 216
    return 6 * item - 12 <= hour < 6 * item - 12 + LIFE


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> EpisodeStore:
    folder, rng = tmp_path_factory.mktemp("offers"), np.random.default_rng(0)
    log = random_log(rows=3000, users=60, step=DAYS * 24 * HOUR // 3000)
    log["item_id"] = [
        rng.choice([item for item in range(42) if is_available(item, time)])
        for time in log.timestamp
    ]
    return store_of(log, folder, write_items(folder), gap_minutes=60 * 24)


@pytest.fixture(scope="module")
def policy(store: EpisodeStore, tmp_path_factory: pytest.TempPathFactory) -> Recommender:
    settings = ["train.steps=5", "policy.dim=8", "policy.context=4", "rule.sessions=40"]
    recommender = Recommender("dc", settings=[*settings, "augment.copies=0"])
    return recommender.fit(store, tmp_path_factory.mktemp("run") / "run", refit=True)


def test_a_store_knows_what_was_available_at_every_step(store: EpisodeStore):
    episodes, steps = store.all_steps()
    offer, times = store.offer(episodes, steps), store.column("timestamp")
    expected = [[is_available(item, time) for item in range(42)] for time in times.tolist()]
    assert offer is not None
    assert offer.mask().tolist() == expected
    # A column of times is no feature, and rows that differ in times alone are of one item.
    assert store.item_states.embeddings.shape[0] == 42
    windows = store.windows(episodes[:50], steps[:50], 3)
    assert torch.equal(windows.offer.times[:, -1], torch.from_numpy(times[:50]))


def test_everything_that_decides_asks_what_is_available(store: EpisodeStore, policy: Recommender):
    trained, validation = policy.trained, store.split("validation")
    episodes, steps = validation.all_steps()
    windows = validation.windows(episodes, steps, 4)
    offered = validation.offer(episodes, steps).mask()
    exposed = trained.policy.exposed(trained.policy.normalize(windows), last=True)
    features = trained.policy.features(trained.policy.normalize(windows))[:, -1]
    logits = trained.policy.head.predict(features, exposed)
    assert torch.equal(logits > -torch.inf, offered)
    assert trained.policy.action_loss(windows) < np.log(12)  # of 42 items, at most 9 are available
    scored = policy.score(store.path.parent / "log.parquet", rule=DecisionRule(1.0, temperature=1))
    assert (scored.probability[scored.item_id != 40] > 1 / 42).mean() > 0.9
    assert trained.record.reference_losses["uniform"] < np.log(12)
    for day in (2, 5):
        time = START + day * 24 * HOUR
        items = policy.recommend(k=42, filter_seen=False, at=time).item_id.unique()
        assert sorted(items) == [item for item in range(42) if is_available(item, time)]
    # Of all 42 items, five drawn evenly would hold every eighth one shown.
    ranks = policy.rank(store.path.parent / "log.parquet", k=5).to_frame()
    assert (ranks.hit_rate_shown > 0.3).all()


def test_times_that_cannot_be_are_refused_or_noted(
    store: EpisodeStore, policy: Recommender, tmp_path: Path
):
    with pytest.raises(InputError, match=r"none of 40 cand.* at 1990-01-01 00:00 UTC.*--at"):
        Recommender.load(policy.run).recommend(at="1990-01-01", candidates=range(40))
    for time in ("noon", float("inf"), 1e300, "9" * 20, True, [1]):
        with pytest.raises(InputError, match="; give milliseconds, or an ISO 8601 time"):
            policy.recommend(at=time)  # type: ignore[arg-type]
    log, mapping = store.path.parent / "log.parquet", write_items(tmp_path)
    frame = pd.read_parquet(tmp_path / "items.parquet")
    write(frame.assign(born=frame.born + HOUR), tmp_path / "items.parquet")
    with pytest.warns(InputNote, match="rows show an item at a time at which"):
        prepare([log], mapping, tmp_path / "store", PrepareOptions())
    late = frame.available_until.astype("string").where(frame.item_id != 3, "31 Jan 2023")
    for times, count in (late, 1), (frame.available_until // 1000, 41):  # seconds
        write(frame.assign(available_until=times), tmp_path / "items.parquet")
        with pytest.raises(InputError, match=rf"items.parquet: .* no time in {count} rows"):
            prepare([log], mapping, tmp_path / "unread", PrepareOptions())
    write(frame.assign(born=frame.available_until), tmp_path / "items.parquet")
    with pytest.raises(InputError, match=r"items.parquet: 41 of 44 rows .* not after"):
        prepare([log], mapping, tmp_path / "other", PrepareOptions())


def test_a_later_table_of_items_replaces_times_of_its_items(store: EpisodeStore, tmp_path: Path):
    log = random_log(rows=50, users=60, items=40, step=HOUR)
    log["timestamp"] += DAYS * 24 * HOUR
    later = pd.DataFrame({"item_id": [39, 42], "kind": "1", "born": log.timestamp.min() + HOUR})
    file = write(later.assign(available_until=log.timestamp.max()), tmp_path / "later.parquet")
    table = FeatureTable((file,), "item_id", available_from="born")
    mapping = LogMapping(item_features=(table,))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputNote)
        logs = [write(log, tmp_path / "log.parquet")]
        append_logs(store.path, logs, tmp_path / "grown", mapping)
    offers = EpisodeStore.open(tmp_path / "grown").offer(np.zeros(1, int), np.zeros(1, int)).offers
    times = torch.tensor([START + 225 * HOUR, START + 239 * HOUR, later.born[0]])
    mask = offers.at(times).mask()
    assert mask[:, 35].tolist() == [True, False, False]
    assert mask[:, 39].tolist() == mask[:, 42].tolist() == [False, False, True]
    assert mask[:, 40:42].all()
