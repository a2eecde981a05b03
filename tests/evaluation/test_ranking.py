"""Next-period ranking: measures agree with a slow reader, baselines are fitted on training rows."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import roc_auc_score
from torch import Tensor

from tests.recommending.test_recommend import SETTINGS, random_log
from tests.support.logs import store_of
from tests.support.served import recommend
from ucfrec import Recommender, schema
from ucfrec.commands.cli import main
from ucfrec.episodes.states import TrainingCounts
from ucfrec.episodes.store import EpisodeStore, UserRows
from ucfrec.errors import InputError
from ucfrec.evaluation import ranking
from ucfrec.evaluation.ranking import (
    MEASURES,
    Later,
    LikedExpression,
    Period,
    Ranked,
    Steps,
    compare,
    measure,
    rank_steps,
)
from ucfrec.evaluation.ranking_table import PolicyRanker, baselines, neighbour_ranker
from ucfrec.files.atomic import write_json
from ucfrec.logs.expressions import Expression
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.off_policy.score import read_logged_sessions
from ucfrec.recommending.histories import histories_of_frame
from ucfrec.results.rows import read_results

Capsys = pytest.CaptureFixture[str]
N_ITEMS, K = 12, 3


def value(measured: dict[str, tuple[np.ndarray, np.ndarray]], name: str) -> float:  # type: ignore[type-arg]
    above, below = measured[name]
    return float(above.sum() / below.sum())


@given(seed=st.integers(0, 10_000), n=st.integers(2, 60), users=st.integers(1, 6))
def test_measures_are_those_of_a_slow_reader(seed: int, n: int, users: int) -> None:
    rng = np.random.default_rng(seed)
    owner = np.sort(rng.integers(users, size=n))
    items, liked = rng.integers(N_ITEMS, size=n), rng.random(n) < 0.5
    scores = rng.integers(4, size=(n, N_ITEMS)).astype(float)  # many ties
    own = scores[np.arange(n), items]
    top = np.argsort(-scores, axis=1, kind="stable")[:, :K]
    top[rng.random(top.shape) < 0.2] = -1  # items that are left out
    measured = measure(Period(owner, items, liked, N_ITEMS), Ranked(own, top))
    ranks = [[*row, item].index(item) + 1 for row, item in zip(top, items, strict=True)]
    hits = [rank <= K for rank in ranks]
    assert value(measured, "hit_rate_shown") == pytest.approx(np.mean(hits))
    gains = [hit / np.log2(1 + rank) for hit, rank in zip(hits, ranks, strict=True)]
    assert value(measured, "ndcg_shown") == pytest.approx(np.mean(gains))
    if liked.any():
        assert value(measured, "hit_rate_liked") == pytest.approx(np.mean(np.array(hits)[liked]))
        recalls = []
        for user in np.unique(owner):
            mine = np.flatnonzero(owner == user)
            wanted = {int(items[t]) for t in mine if liked[t]}
            if wanted:
                recalls.append(len(wanted & set(top[mine[0]].tolist())) / len(wanted))
        assert value(measured, "recall_liked") == pytest.approx(np.mean(recalls))
    aucs, weights = [], []
    for user in np.unique(owner):
        mine = owner == user
        if 0 < liked[mine].sum() < mine.sum():
            aucs.append(roc_auc_score(liked[mine], own[mine]))
            weights.append(mine.sum())
    if aucs:
        assert value(measured, "gauc") == pytest.approx(np.average(aucs, weights=weights))
    places = top[top >= 0]
    if places.size:
        assert value(measured, "known") == pytest.approx(np.isin(places, items).mean())
    rates = [liked[items == item].mean() for item in top.ravel().tolist() if (items == item).any()]
    if rates:
        assert value(measured, "item_rate") == pytest.approx(np.mean(rates))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> EpisodeStore:
    """Users who like the items of their own half of the catalogue, all of the time."""
    folder, rng = tmp_path_factory.mktemp("ranking"), np.random.default_rng(0)
    n = 6000
    log = pd.DataFrame({"user_id": rng.integers(60, size=n), "item_id": rng.integers(40, size=n)})
    log["is_click"] = (log.user_id % 2 == log.item_id % 2) & (rng.random(n) < 0.9)
    log["timestamp"] = 1_700_000_000_000 + 60_000 * np.arange(n)
    return store_of(log, folder, reward="is_click", session_by="user")


def alone(store: EpisodeStore) -> Later:
    return Later(store, UserRows.of(store, store.episode_values(schema.USER), None))


def score_halves(steps: Steps) -> Tensor:
    own = torch.from_numpy(steps.users % 2).unsqueeze(1)
    noise = torch.rand(len(steps.steps), 40, generator=torch.Generator().manual_seed(0))
    return (torch.arange(40) % 2 == own).float() + 0.1 * noise


def test_planted_taste_is_found_by_those_who_look_at_the_user(store: EpisodeStore) -> None:
    train, test = store.split("train"), store.split("test")
    rankers = baselines(TrainingCounts.of(train), train, seed=0) | {"oracle": score_halves}
    period = Period.of(test, test.episode_values(schema.USER))
    ranked = {name: rank_steps(ranker, alone(test), 10) for name, ranker in rankers.items()}
    found = compare(period, ranked, "oracle", seed=0)
    assert found["oracle"]["gauc"] > 0.9
    for name in ("random", "most shown", "most clicked", "item click rate"):
        assert found[name]["gauc"] == pytest.approx(0.5, abs=0.12), name
        gauc, low, high = found[name]["differences"]["gauc"]
        assert low <= gauc <= high < 0, name
    assert found["als"]["gauc"] > 0.9
    knn, random = found["item-knn"], found["random"]
    assert knn["hit_rate_liked"] > 1.5 * random["hit_rate_liked"]
    assert found["most shown"]["coverage"] == 10 / 40
    for row in found.values():
        assert set(row["intervals"]) == set(MEASURES)
        for name, (low, high) in row["intervals"].items():
            assert low - 1e-9 <= row[name] <= high + 1e-9


@pytest.mark.parametrize(("left", "filter_seen"), [(1, False), (2, True), (0, True)])
def test_the_size_of_the_last_batch_changes_nothing(
    store: EpisodeStore, monkeypatch: pytest.MonkeyPatch, left: int, filter_seen: bool
) -> None:
    train, test = store.split("train"), store.split("test")
    later = replace(alone(test), filter_seen=filter_seen)
    rankers = [*baselines(TrainingCounts.of(train), train, seed=0).values()][1:]  # `random` draws
    whole = [rank_steps(ranker, later, 10) for ranker in rankers]
    monkeypatch.setattr(ranking, "_STEPS_AT_ONCE", (test.n_steps - left) // 2 or 1)
    for ranker, expected in zip(rankers, whole, strict=True):
        found = rank_steps(ranker, later, 10)
        np.testing.assert_array_equal(found.top, expected.top)
        assert found.top.shape == (test.n_steps, 10)


def test_steps_that_the_filter_leaves_without_a_hit_are_counted(store: EpisodeStore) -> None:
    test = store.split("test")
    later = replace(alone(test), filter_seen=True)
    seen: set[tuple[int, int]] = set()
    repeats = []
    users = test.episode_values(schema.USER)[test.all_steps()[0]]
    for pair in zip(users.tolist(), test.column(schema.ITEM).tolist(), strict=True):
        repeats.append(pair in seen)
        seen.add(pair)
    assert 0 < np.mean(repeats) < 1
    assert later.share_out_of_reach() == pytest.approx(np.mean(repeats))
    assert alone(test).share_out_of_reach() == 0
    period = Period.of(test, users[np.cumsum(test.lengths) - test.lengths])
    hits = value(measure(period, rank_steps(score_halves, later, 39)), "hit_rate_shown")
    assert hits <= 1 - np.mean(repeats) + 1e-9


def test_nothing_of_the_ranked_step_reaches_a_ranker(store: EpisodeStore) -> None:
    """Other items and rewards at the last step of every session change no score there."""
    train, test = store.split("train"), store.split("test")
    steps = {name: store.step_values(name, *store.all_steps()) for name in (
        schema.ITEM, schema.REWARD, schema.TIMESTAMP)}  # fmt: skip
    last = np.cumsum(store.lengths) - 1
    changed = {name: values.copy() for name, values in steps.items()}
    changed[schema.ITEM][last] = (changed[schema.ITEM][last] + 7) % 40
    changed[schema.REWARD][last] = 1 - changed[schema.REWARD][last]
    at = np.cumsum(test.lengths) - 1
    episodes = {name: store.episode_values(name) for name in (schema.USER, schema.SPLIT)}
    other = EpisodeStore.from_arrays(
        changed, store.lengths, episodes=episodes, item_states=store.item_states
    ).split("test")
    for ranker in [*baselines(TrainingCounts.of(train), train, seed=0).values()][1:]:
        before = ranker(alone(test).steps(at, filter_seen=False))
        after = ranker(alone(other).steps(at, filter_seen=False))
        torch.testing.assert_close(before, after, rtol=0, atol=0)


def score_sated(steps: Steps) -> Tensor:
    """Lower after each liked step, whatever the item."""
    liked = torch.from_numpy(steps.store.rewards_before(steps.episodes, steps.steps))
    noise = torch.rand(len(steps.steps), 40, generator=torch.Generator().manual_seed(0))
    return noise - liked.float().unsqueeze(1)


def test_rewards_within_the_period_do_not_rank_the_items_shown_in_it(store: EpisodeStore) -> None:
    """Of two steps of which one is liked, the earlier one's score is higher where it was liked."""
    test = store.split("test")
    period = Period.of(test, test.episode_values(schema.USER))
    found = measure(period, rank_steps(score_sated, alone(test), 10))
    assert value(found, "gauc") == pytest.approx(0.5, abs=0.12)


@pytest.mark.parametrize("session_by", ["user", "gap"])
def test_a_later_log_is_ranked_as_recommend_would(tmp_path: Path, session_by: str) -> None:
    """At every step of the later log: the same ten items, from the same history."""
    log = random_log().sort_values("timestamp", ignore_index=True)
    log["item_id"] += 100
    before, after = log[:1200], log[1200:1320]
    before.to_parquet(tmp_path / "before.parquet")
    after.to_parquet(tmp_path / "after.parquet")
    options = PrepareOptions(reward="reward", session_by=session_by, gap_minutes=600)
    prepare([tmp_path / "before.parquet"], LogMapping(), tmp_path / "store", options)
    tiny = [*SETTINGS, "rule.choose=true"]
    policy = Recommender("ucf", settings=tiny).fit(
        EpisodeStore.open(tmp_path / "store"), tmp_path / "run"
    )
    trained = policy.trained
    rule = replace(trained.rule, temperature=0.0)  # does not draw
    ranker = PolicyRanker(trained, rule).scores
    with read_logged_sessions(trained, [tmp_path / "after.parquet"], LogMapping()) as logged:
        later = Later(logged.store, logged.rows, filter_seen=True)
        found = rank_steps(ranker, later, 10)
        assert (logged.store.lengths.sum() > logged.store.n_steps) is np.True_
        knn = neighbour_ranker(EpisodeStore.open(tmp_path / "store"), torch.ones(30))
        assert len(np.unique(rank_steps(knn, later, 3).top, axis=0)) > 10
        times = logged.store.column(schema.TIMESTAMP)
        _, places = logged.store.all_steps()
    # `recommend` takes the latest session to go on, which it does not at the first step of another.
    for number in np.flatnonzero(places > 0)[::5]:
        (row,) = after[after.timestamp == times[number]].itertuples()
        mine = log[(log.user_id == row.user_id) & (log.timestamp < row.timestamp)]
        (frame,) = recommend(
            trained, histories_of_frame(trained, mine, LogMapping()), 10, rule=rule
        )
        said = frame.item_id.tolist()
        assert trained.item_ids[found.top[number][found.top[number] >= 0]].tolist() == said
        assert not set(said) & set(mine.item_id)


def test_rank_without_the_store(store: EpisodeStore, tmp_path: Path, capsys: Capsys) -> None:
    copied, run = tmp_path / "store", str(tmp_path / "run")
    shutil.copytree(store.path, copied)
    log = pd.read_parquet(store.path.parent / "log.parquet").tail(400)
    later = str(tmp_path / "later.parquet")
    log.assign(timestamp=log.timestamp + 10**9).to_parquet(later)
    assert main(["train", str(copied), "--out", run, "--policy", "item-knn"]) == 0
    outputs = []
    for gone in (False, True):
        if gone:
            shutil.rmtree(copied)
        capsys.readouterr()
        assert main(["rank", run, later, "--k", "5"]) == 0
        outputs.append(capsys.readouterr().out)
        assert ("without what they were shown before" in outputs[-1]) == gone
    assert len({next(x for x in out.splitlines() if "item-knn" in x) for out in outputs}) == 2
    assert main(["rank", run, later, "--liked", "reward = reward"]) == 0
    assert "gauc" not in capsys.readouterr().out


SHORT = ["train.steps=20", "train.validate_every=10", "policy.dim=8", "policy.context=4"]
SHORT += ["rule.choose=false", "augment.copies=0"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of ratings from 0.5 to 5, a run on it, and later logs."""
    folder, rng, n = tmp_path_factory.mktemp("liked"), np.random.default_rng(0), 3000
    log = pd.DataFrame({"user_id": rng.integers(60, size=n), "item_id": rng.integers(20, size=n)})
    log["timestamp"] = 1_700_000_000_000 + 60_000 * np.arange(n)
    log["rating"] = rng.choice([0.5, 0.7, 2.0, 3.7, 5.0], size=n)
    log[:2500].to_parquet(folder / "log.parquet")
    log[2500:].to_parquet(folder / "later.parquet")
    store = ["prepare", str(folder / "log.parquet"), "--out", str(folder / "store")]
    assert main([*store, "--reward", "rating", "--session-by", "user"]) == 0
    sets = [word for setting in SHORT for word in ("--set", setting)]
    train = ["train", str(folder / "store"), "--out", str(folder / "run"), "--policy", "dt"]
    assert main([*train, *sets]) == 0
    return folder


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("reward >= 3.7", {3.7, 5.0}),
        ("rating >= 0.7", {0.7, 2.0, 3.7, 5.0}),
        ("REWARD = 0.7", {0.7}),
        ("Rating BETWEEN 1 AND 4 AND reward <> 2", {3.7}),
        ("nullif(reward, 5) > 2", {3.7}),
        ("CASE WHEN reward > 4 THEN true END", {5.0}),
    ],
)
def test_liked_expression(folder: Path, expression: str, expected: set[float]) -> None:
    store = EpisodeStore.open(folder / "store")
    rewards = store.column(schema.REWARD)
    liked = LikedExpression(Expression(expression, "--liked"), "rating")(store, rewards)
    rewards = rewards.astype(np.float64).round(3)
    assert set(rewards[liked].tolist()) == expected
    assert not expected & set(rewards[~liked].tolist())


@pytest.mark.parametrize(
    ("expression", "says"),
    [
        ("reward", "is DOUBLE, not true or false"),
        ("item_id = 3", "item_id"),
        ("reward >= (SELECT 1)", "a subquery"),
        ("read_text('x') = 'y'", "it calls 'read_text'"),
        ("reward >", "not a scalar SQL expression"),
    ],
)
def test_what_is_no_truth_value_over_the_reward_is_refused(expression: str, says: str) -> None:
    with pytest.raises(InputError, match="--liked") as caught:
        LikedExpression(Expression(expression, "--liked"))
    assert says in str(caught.value)


def ranked(folder: Path, out: Path, *arguments: str) -> pd.DataFrame:
    """Rows of `rank --json`, which every JSON reader takes; what is undefined is not in them."""
    assert main(["rank", str(folder / "run"), *arguments, "--k", "5", "--json", str(out)]) == 0
    json.loads(out.read_text(), parse_constant=pytest.fail)
    return pd.DataFrame([dict.fromkeys(MEASURES) | row.as_line() for row in read_results(out)])


def test_liked_is_stated_or_given(folder: Path, tmp_path: Path, capsys: Capsys) -> None:
    later, out = str(folder / "later.parquet"), tmp_path / "rows.json"
    rating = pd.read_parquet(later).rating
    rows = ranked(folder, out, later)
    printed = capsys.readouterr().out
    assert "liked           reward >= 3.2 (60% of the way" in printed
    assert rows.liked_share[0] == pytest.approx((rating >= 3.2).mean())
    other = ranked(folder, out, later, "--liked", "rating <= 0.6")
    assert "liked           rating <= 0.6" in capsys.readouterr().out
    assert other.liked_share[0] == pytest.approx((rating <= 0.6).mean())
    assert rows.ndcg_shown[0] == other.ndcg_shown[0]  # the policy is the same
    clicked = rows.policy == "most clicked"
    assert (rows[clicked].ndcg_shown != other[clicked].ndcg_shown).all()  # its counts are not


def test_nothing_liked_is_null(folder: Path, tmp_path: Path) -> None:
    later = str(folder / "later.parquet")
    rows = ranked(folder, tmp_path / "rows.json", later, "--liked", "reward > 9")
    assert rows[["hit_rate_liked", "recall_liked", "gauc"]].isna().all(axis=None)
    assert rows.hit_rate_shown.notna().all()


def test_without_logs_the_test_split_is_used(folder: Path, tmp_path: Path, capsys: Capsys) -> None:
    out, test = tmp_path / "ope.json", EpisodeStore.open(folder / "store").split("test")
    given = ["--temperature", "1", "--estimate-propensities", "--details", "--json", str(out)]
    assert main(["ope", str(folder / "run"), *given]) == 0
    printed = capsys.readouterr().out
    assert f"{test.n_episodes:,} sessions, {test.n_steps:,} steps" in printed
    assert "seen in training" not in printed
    rows = {row.method: row for row in read_results(out) if row.metric == "R_cum"}
    assert rows["logged"].metrics["R_cum"] == pytest.approx(float(test.returns.mean()))
    found = ranked(folder, tmp_path / "rank.json")
    assert (found.steps == test.n_steps).all()
    assert {"dt", "random", "item-knn", "als", "bpr"} <= {*found.policy}
    assert "on the test split" in (folder / "run" / "MODEL_CARD.md").read_text()


def test_ope_without_a_store_says_why(folder: Path, tmp_path: Path, capsys: Capsys) -> None:
    refit, run, moved = str(tmp_path / "refit"), str(folder / "run"), tmp_path / "moved"
    assert main(["train", str(folder / "store"), "--out", refit, "--refit", run]) == 0
    shutil.copytree(folder / "run", moved)
    record = json.loads((moved / "run.json").read_text())
    record |= {"store": str(tmp_path / "gone"), "store_from_run": None}
    write_json(moved / "run.json", {k: v for k, v in record.items() if k != "checksum"}, seal=True)
    for run, says in ((refit, "is a refit"), (str(moved), "is gone or has changed")):
        for command in ("ope", "rank"):
            assert main([command, run]) == 2
            assert says in capsys.readouterr().err
