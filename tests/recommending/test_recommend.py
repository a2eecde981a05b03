"""Recommendations: one answer from Python and from files, from what the policy would see."""

import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from torch import Tensor

from tests.support.logs import store_of, write
from tests.support.served import FULL, learn_tastes, trained_run
from tests.support.served import histories as tagged_histories
from ucfrec import EpisodeStore, Recommender
from ucfrec.acting.decision import DecisionRule
from ucfrec.commands.cli import main
from ucfrec.episodes.windows import Sessions
from ucfrec.errors import InputError, InputNote
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.recommending import histories
from ucfrec.recommending import recommend as module
from ucfrec.recommending.histories import histories_of_files
from ucfrec.recommending.recommend import ItemIndex, uniforms
from ucfrec.runs.trained_policy import TrainedPolicy

SETTINGS = ["train.steps=30", "policy.dim=16", "policy.context=4", "augment.copies=0"]
SMALL = ["train.steps=3", "policy.dim=8", "policy.context=4"]
FAST = [*SMALL, "rule.choose=false"]


def random_log(users: int = 40, items: int = 30, rows: int = 1500) -> pd.DataFrame:
    rng = np.random.default_rng(0)
    log = pd.DataFrame(
        {"user_id": rng.integers(users, size=rows), "item_id": rng.integers(items, size=rows)}
    )
    log["timestamp"] = 1_700_000_000_000 + np.cumsum(rng.integers(1, 120_000, size=rows))
    log["reward"] = (rng.random(rows) < 0.2 + 0.5 * (log.item_id % 3 == 0)).astype(float)
    return log


@pytest.fixture(scope="module")
def log() -> pd.DataFrame:
    return random_log()


@pytest.fixture(scope="module")
def policy(log: pd.DataFrame, tmp_path_factory: pytest.TempPathFactory) -> Recommender:
    folder = tmp_path_factory.mktemp("recommend")
    store = store_of(log, folder, reward="reward", session_by="gap", gap_minutes=20)
    settings = [*SETTINGS, "rule.choose=false"]
    return Recommender("ucf", settings=settings).fit(store, folder / "run")


@pytest.mark.parametrize(
    "change",
    [
        lambda log: log.assign(other=1),
        lambda log: log.astype({"timestamp": float}),
        lambda log: log.assign(timestamp=pd.to_datetime(log.timestamp, unit="ms")),
        lambda log: pd.concat([log.assign(reward=-9.0), log]),
    ],
)
@pytest.mark.parametrize("rows", [1, 2000])
def test_frames_that_say_the_same_are_read_alike(
    policy: Recommender,
    rows: int,
    change: Callable[[pd.DataFrame], pd.DataFrame],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Many equal times; more rows of a user than are read.
    log = random_log(users=3, rows=rows).sample(frac=1, random_state=1)
    log["timestamp"] = log["timestamp"] // 200_000 * 200_000
    monkeypatch.setattr(histories, "LONGEST_HISTORY", 50)
    (plain,) = histories.histories_of_frame(policy.trained, log, LogMapping())
    (other,) = histories.histories_of_frame(policy.trained, change(log), LogMapping())
    assert len(plain.owner) == sum(
        min(len(each.drop_duplicates(["item_id", "timestamp"])), 50)
        for _, each in log.groupby("user_id")
    )
    for name, values in vars(other).items():
        np.testing.assert_array_equal(getattr(plain, name), values, err_msg=name)


@pytest.mark.parametrize(
    ("session_by", "observed"), [("gap", True), ("session_id", False), ("user", True)]
)
def test_scores_are_the_policys_at_the_next_step(
    log: pd.DataFrame, tmp_path: Path, session_by: str, observed: bool
) -> None:
    """An independent route: the log with one row more a user, prepared as episodes on disk."""
    rng = np.random.default_rng(1)
    # Sessions that overlap in time, so that the latest is not what comes after a pause.
    log = log.assign(session_id=log.user_id * 10 + rng.integers(3, size=len(log)))
    if observed:
        log["observation"] = list(rng.normal(size=(len(log), 2)).astype(np.float32))
    log.to_parquet(tmp_path / "log.parquet")
    given = {"reward": "reward", "session_by": session_by}
    given |= {"gap_minutes": 20} if session_by == "gap" else {}
    policy = Recommender("dt", settings=FAST)
    policy.fit(tmp_path / "log.parquet", tmp_path / "run", **given)
    given = log[log.user_id < 12].sample(frac=1, random_state=2)
    latest = given.sort_values("timestamp").groupby("user_id").tail(1)
    next_rows = latest.assign(timestamp=latest.timestamp + 1000, item_id=0, reward=0.0)
    pd.concat([given, next_rows]).to_parquet(tmp_path / "longer.parquet")
    options = PrepareOptions(reward="reward", session_by=session_by, gap_minutes=20)
    logs, longer = [tmp_path / "longer.parquet"], tmp_path / "longer"
    prepare(logs, LogMapping(), longer, options, like=tmp_path / "run")
    store = EpisodeStore.open(longer)
    ends = store.lengths - 1
    times = store.step_values("timestamp", np.arange(len(store)), ends)
    at = np.flatnonzero(np.isin(times, next_rows.timestamp))
    assert len(at) == len(next_rows)
    trained = policy.trained
    users = trained.user_ids[store.episode_values("user")[at]]
    assert users.tolist() == sorted(set(given.user_id))
    windows = store.windows(at, ends[at], trained.policy.config.context)
    # The rewards of the session so far lowers what is requested.
    more = torch.from_numpy(7.0 - store.returns[at])
    assert len(set(more.tolist())) > 1
    asked = (windows.returns_to_go + more.unsqueeze(1)).masked_fill(~windows.mask, 0.0).float()
    with torch.no_grad():
        expected = trained.policy.act(replace(windows, returns_to_go=asked)).log_softmax(-1)
    found = policy.recommend(given, k=30, rule=DecisionRule(7.0), filter_seen=False)
    scores = found.pivot_table(index="user_id", columns="item_id", values="score")
    assert scores.index.tolist() == users.tolist()
    np.testing.assert_allclose(scores.to_numpy(), expected.numpy(), rtol=5e-4, atol=1e-5)


def test_sessions_make_the_state_but_all_is_seen(policy: Recommender, log: pd.DataFrame) -> None:
    user = log[log.user_id == 3]
    day = 86_400_000
    recent = user.tail(3)
    earlier = user.head(5).assign(timestamp=recent.timestamp.min() - day - np.arange(5)[::-1])
    alone = policy.recommend(recent, k=30, filter_seen=False)
    both = policy.recommend(pd.concat([earlier, recent]), k=30, filter_seen=False)
    pd.testing.assert_frame_equal(alone, both)
    filtered = policy.recommend(pd.concat([earlier, recent]), k=30)
    assert not set(filtered.item_id) & {*earlier.item_id, *recent.item_id}


def test_only_candidates_are_recommended(policy: Recommender, log: pd.DataFrame) -> None:
    chosen = [4, 8, 15, 16, 23]
    everything = policy.recommend(log, k=30, filter_seen=False)
    expected = everything[everything.item_id.isin(chosen)].reset_index(drop=True)
    expected["rank"] = expected.groupby("user_id").cumcount() + 1
    # Among fewer items, each is likelier.
    chances = np.exp(expected.score)
    expected["score"] -= np.log(chances.groupby(expected.user_id).transform("sum"))
    for given in (chosen, np.array(chosen), set(chosen), list(map(str, chosen))):
        found = policy.recommend(log, k=30, filter_seen=False, candidates=given)
        # The propensity of a draw among fewer items is another, and so is the request.
        other = ["propensity", "request_id"]
        same = found.drop(columns=other), expected.drop(columns=other)
        pd.testing.assert_frame_equal(*same, atol=1e-4)
    unseen = policy.recommend(log, k=30, candidates=chosen)
    assert set(zip(unseen.user_id, unseen.item_id, strict=True)) == {
        (user, item)
        for user in set(log.user_id)
        for item in set(chosen) - set(log[log.user_id == user].item_id)
    }
    for wrong, message in (
        ([4, 999, 1000], r"2 of 3 named items .* \(999, 1000\)"),
        ([], "candidates is empty"),
        ("48", "candidates is '48'; give a list"),
    ):
        with pytest.raises(InputError, match=message):
            policy.recommend(log, candidates=wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["items.csv", "items.parquet"])
def test_the_command_recommends_candidates_only(
    policy: Recommender, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    run = policy.trained.folder
    write(pd.DataFrame({"item_id": [4, 8, 999]}), tmp_path / name)
    command = ["recommend", str(run), str(run.parent / "log.parquet"), "--keep-seen"]
    command += ["--out", str(tmp_path / "out.parquet"), "--candidates", str(tmp_path / name)]
    assert main(command) == 2
    assert "1 of 3 named items" in capsys.readouterr().err
    assert main([*command, "--skip-unknown"]) == 0
    found = pd.read_parquet(tmp_path / "out.parquet")
    log = pd.read_parquet(run.parent / "log.parquet")
    expected = policy.recommend(log, k=10, candidates=[4, 8], filter_seen=False)
    pd.testing.assert_frame_equal(found, expected, check_dtype=False)
    write(pd.DataFrame({"item_id": [998, 999]}), tmp_path / name)
    assert main(command) == 2
    assert "2 of 2 named items are not known to the policy" in capsys.readouterr().err
    assert main([*command, "--engine", "spark"]) == 2
    assert "leave --candidates out" in capsys.readouterr().err
    assert main([*command[:2], "--stream", *command[-2:]]) == 2
    assert "leave --candidates out" in capsys.readouterr().err


def test_files_of_items_may_have_the_column_of_the_log(log: pd.DataFrame, tmp_path: Path) -> None:
    file, run, out = (str(tmp_path / name) for name in ("log.parquet", "run", "out"))
    log.rename(columns={"item_id": "video id"}).to_parquet(file)
    Recommender("popular").fit(file, run, mapping={"item_id": '"video id"'}, reward="reward")
    items = str(
        write(pd.DataFrame({"video id": [4, 8], "name": ["four", "eight"]}), tmp_path / "a.csv")
    )
    assert main(["recommend", run, file, "--out", out, "--candidates", items, "--keep-seen"]) == 0
    assert {*pd.read_parquet(out).item_id} == {4, 8}
    assert main(["report", run, "--out", out, "--items", items]) == 0
    assert "name four" in Path(out).read_text()


def test_unknown_items_are_refused_or_skipped(policy: Recommender, log: pd.DataFrame) -> None:
    strange = pd.concat([log, log.tail(9).assign(item_id=999, timestamp=log.timestamp.max() + 1)])
    with pytest.raises(InputError, match=r"\d rows have an item_id .* \(1 items: 999\)"):
        policy.recommend(strange)
    best = replace(policy.trained.rule, temperature=0.0)
    pd.testing.assert_frame_equal(
        policy.recommend(strange, skip_unknown=True, rule=best).drop(columns="request_id"),
        policy.recommend(log, rule=best).drop(columns="request_id"),
    )
    newcomer = log.tail(1).assign(user_id=777, item_id=999)
    assert len(policy.recommend(newcomer, k=4, skip_unknown=True)) == 4
    with pytest.warns(InputNote, match="40 of 40 users are not among those the run was trained on"):
        policy.recommend(log.assign(user_id=log.user_id + 1000))


def test_the_reward_is_the_runs_expression_or_a_column(log: pd.DataFrame) -> None:
    feedback = log.rename(columns={"reward": "is_click"}).assign(seconds=range(len(log)))
    policy = Recommender("dt", settings=FAST).fit(feedback, reward="1 - 2 * is_click")
    evaluated = policy.recommend(feedback)
    given = log.assign(reward=1 - 2 * log.reward)
    pd.testing.assert_frame_equal(evaluated, policy.recommend(given))
    both = feedback.assign(reward=given.reward, is_click=0)
    pd.testing.assert_frame_equal(evaluated, policy.recommend(both))
    with pytest.raises(InputError, match="no column 'is_click'"):
        policy.recommend(feedback.drop(columns="is_click"))


def utc(ms: pd.Series, unit: str = "ns") -> pd.Series:
    return pd.to_datetime(ms, unit="ms").astype(f"datetime64[{unit}]")


TIMES: dict[str, Callable[[pd.Series], object]] = {
    "float": lambda ms: ms.astype(float),
    "Int64": lambda ms: ms.astype("Int64"),
    "seconds": lambda ms: utc(ms, "s"),
    "microseconds": lambda ms: utc(ms, "us"),
    "nanoseconds": utc,
    "with a zone": lambda ms: utc(ms).dt.tz_localize("UTC").dt.tz_convert("Asia/Tokyo"),
    "objects": lambda ms: utc(ms).astype(object),
}


@pytest.mark.parametrize("kind", TIMES)
def test_times_mean_the_same_here_and_in_prepare(
    policy: Recommender,
    log: pd.DataFrame,
    tmp_path: Path,
    kind: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = log.assign(timestamp=log.timestamp // 1000 * 1000)
    typed = whole.assign(timestamp=TIMES[kind](whole.timestamp))
    monkeypatch.setenv("TZ", "America/New_York")
    time.tzset()
    try:
        pd.testing.assert_frame_equal(policy.recommend(typed), policy.recommend(whole))
        read = []
        for name, frame in (("typed", typed), ("whole", whole)):
            frame.to_parquet(tmp_path / f"{name}.parquet")
            options = PrepareOptions(reward="reward", session_by="gap", gap_minutes=20)
            prepare([tmp_path / f"{name}.parquet"], LogMapping(), tmp_path / name, options)
            store = EpisodeStore.open(tmp_path / name)
            read.append((store.lengths, store.step_values("timestamp", *store.all_steps())))
    finally:
        monkeypatch.undo()
        time.tzset()
    for a, b in zip(*read, strict=True):
        np.testing.assert_array_equal(a, b)
    assert set(read[0][1]) == set(whole.timestamp)


WRONG: dict[str, tuple[Callable[[pd.DataFrame], object], str]] = {
    "a list": (lambda log: [1, 2], r"histories is \[1, 2\]; give a pandas DataFrame"),
    "no rows": (lambda log: log.head(0), "the frame has no rows"),
    "misspelt": (
        lambda log: log.rename(columns={"reward": "rewards"}),
        r"no column 'reward' \(for the reward; name it .*\); did you mean 'rewards'",
    ),
    "values of several types": (
        lambda log: log.assign(user_id=[1, "b", *log.user_id[2:]]),
        "user_id holds values of several types",
    ),
    "durations for times": (
        lambda log: log.assign(timestamp=pd.to_timedelta(log.timestamp, unit="ms")),
        r"timestamp holds durations; convert them with .dt.total_seconds\(\)",
    ),
    "two columns of a name": (
        lambda log: pd.concat([log, log.item_id], axis=1),
        "two columns are called item_id",
    ),
}


def test_rows_of_no_use_are_left_out_with_a_warning(
    policy: Recommender, log: pd.DataFrame, tmp_path: Path
) -> None:
    changed = log.assign(timestamp=log.timestamp.mask(log.index < 4, 1))
    message = r"4 of 1,500 rows were excluded \(4: time before 2000.*is the time in milliseconds"
    with pytest.warns(InputNote, match=message):
        found = policy.recommend(changed)
    pd.testing.assert_frame_equal(found, policy.recommend(log.iloc[4:]), check_dtype=False)
    changed.to_parquet(tmp_path / "log.parquet")
    with pytest.warns(InputNote, match=rf"log\.parquet: {message}"):
        list(histories_of_files(policy.trained, [tmp_path / "log.parquet"], LogMapping()))


@pytest.mark.parametrize("case", WRONG)
def test_wrong_histories_are_refused(policy: Recommender, log: pd.DataFrame, case: str) -> None:
    change, message = WRONG[case]
    with pytest.raises(InputError, match=message) as caught:
        policy.recommend(change(log))  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_draws_depend_on_user_request_item_and_seed_alone() -> None:
    users, requests = np.array([3, 5, 8]), np.array(["a", "b", "c"])
    items = np.arange(2000)[None]
    drawn = uniforms(users, requests, items, 0)
    assert torch.equal(uniforms(users[1:2], requests[1:2], items[:, 9:], 0)[0], drawn[1, 9:])
    assert not torch.equal(uniforms(users, requests, items, 1), drawn)
    same_user = uniforms(users[[0, 0, 0]], requests, items, 0)
    for several in (drawn, same_user):
        assert ((several >= 0) & (several < 1)).all()
        np.testing.assert_allclose(several.mean(1), 0.5, atol=0.03)
        assert np.abs(np.corrcoef(several)[np.triu_indices(3, 1)]).max() < 0.08


def test_later_rows_draw_again_and_a_replay_is_exact(log: pd.DataFrame) -> None:
    policy = Recommender("dt", settings=FAST).fit(log)
    rule = replace(policy.trained.rule, temperature=5.0)
    first, again, other = (policy.recommend(log, k=4, rule=rule, seed=seed) for seed in (0, 0, 1))
    pd.testing.assert_frame_equal(first, again)
    assert not first.item_id.equals(other.item_id)
    assert (first.groupby("user_id").request_id.nunique() == 1).all()
    # The same histories a minute later, with nothing else changed.
    later = policy.recommend(log.assign(timestamp=log.timestamp + 60_000), k=4, rule=rule)
    assert not (first.item_id == later.item_id).groupby(first.user_id).all().all()
    assert ((first.propensity > 0) & (first.propensity <= 1)).all()
    assert (first[first["rank"] == 1].propensity < 1).all()
    assert (policy.recommend(log, k=4, rule=replace(rule, temperature=0.0)).propensity == 1).all()


@pytest.mark.parametrize("session_by", ["session_id", "user"])
def test_frames_files_and_the_store_have_the_same_histories(
    log: pd.DataFrame, tmp_path: Path, session_by: str
) -> None:
    """The reward is computed from a column `reward`, and split boundaries cut sessions."""
    place = log.groupby("user_id").cumcount()
    log = log.assign(reward=5.0 * log.reward, session_id=100 * log.user_id + place // 7)
    log.to_parquet(tmp_path / "log.parquet")
    policy = Recommender("dt", settings=FAST).fit(
        tmp_path / "log.parquet", tmp_path / "run", reward="1 - reward / 5", session_by=session_by
    )
    command = ["recommend", *map(str, (tmp_path / "run", tmp_path / "log.parquet")), "--keep-seen"]
    assert main([*command, "--k", "3", "--out", str(tmp_path / "found.parquet")]) == 0
    found = pd.read_parquet(tmp_path / "found.parquet")
    for given in (log, None):
        same = policy.recommend(given, k=3, filter_seen=False)
        pd.testing.assert_frame_equal(same[[*found]], found, check_dtype=False)


def test_what_is_read_is_not_written_over(
    policy: Recommender,
    log: pd.DataFrame,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    log.to_parquet("log.parquet")
    policy.save("run")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for command, written in (("recommend", "run/items.parquet"), ("score", "log.parquet")):
        assert main([command, "run", "log.parquet", "--out", written]) == 2
        assert f"{written} would be written over what is read" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


# Similar items.


@pytest.mark.parametrize("kind", ["dt", "item-knn"])
def test_similar_items_are_other_items_by_cosine(kind: str, tmp_path: Path) -> None:
    settings = [*SMALL, "rule.choose=false"] if kind == "dt" else []
    policy = Recommender(kind, settings=settings).fit(random_log(), tmp_path / "run")
    found = policy.recommend_to_items(k=4)
    trained = policy.trained
    vectors = trained.item_states.embeddings.numpy()  # type: ignore[union-attr]
    if kind == "dt":
        vectors = trained.scorer().vectors()[:, :-1]
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    cosines = unit @ unit.T
    np.fill_diagonal(cosines, -np.inf)
    for row, (item, group) in enumerate(found.groupby("item_id", sort=True)):
        assert item == trained.item_ids[row]
        assert group["rank"].tolist() == [1, 2, 3, 4]
        best = np.sort(cosines[row])[::-1][:4]
        np.testing.assert_allclose(group.score, best, rtol=1e-4)
        assert item not in group.similar_item_id.to_numpy()
    some = policy.recommend_to_items(["7", "3"], k=100)
    assert some.groupby("item_id", sort=False).size().to_dict() == {7: 29, 3: 29}
    with pytest.raises(InputError, match="1 of 2 named items are not known to the policy"):
        policy.recommend_to_items([1, 99])


# The approximate search scores exactly what it finds, and reports how much that is.

needs_faiss = pytest.mark.skipif(find_spec("faiss") is None, reason="needs faiss")
RULES = [DecisionRule(2.0), FULL, DecisionRule(1.0, reward_weight=3.0, tag_run=1)]


@pytest.fixture(scope="module")
def opinionated(tmp_path_factory: pytest.TempPathFactory) -> TrainedPolicy:
    trained = trained_run(tmp_path_factory.mktemp("index"))
    with torch.no_grad():  # a policy of 20 steps has hardly any opinion
        for parameter in trained.policy.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape))
    learn_tastes(trained)
    return trained


def random_sessions(trained: TrainedPolicy, rule: DecisionRule, count: int = 40) -> Sessions:
    generator, length = torch.Generator().manual_seed(1), trained.scorer(rule).length
    items = torch.randint(24, (count, length), generator=generator)
    rewards = torch.randint(2, (count, length), generator=generator).float()
    steps, users = torch.full((count,), length), torch.arange(count) % 30 - 1
    collected = rewards.sum(1, dtype=torch.float64)
    return Sessions(items, rewards, steps, collected, users, torch.zeros_like(steps))


def some_left_out(sessions: Sessions) -> tuple[Tensor, Tensor]:
    rows = torch.arange(len(sessions.users)).repeat_interleave(3)
    return rows, sessions.actions[:, -3:].flatten()


@needs_faiss
@pytest.mark.parametrize("rule", RULES, ids=["plain", "full", "run"])
def test_a_search_of_all_lists_is_exact(opinionated: TrainedPolicy, rule: DecisionRule) -> None:
    asked, scorer = random_sessions(opinionated, rule), opinionated.scorer(rule)
    left_out, index = some_left_out(asked), ItemIndex(scorer, "ucf")
    items, values = index.best(asked, left_out, 6)
    exact = scorer.scores(asked, left_out, empty=True)
    expected = exact.topk(6)
    torch.testing.assert_close(exact.gather(1, items), expected.values, rtol=1e-5, atol=1e-5)
    relative = expected.values - expected.values[:, :1]
    torch.testing.assert_close(values, relative, rtol=1e-4, atol=1e-4)
    assert index.found == index.wanted > 0


@needs_faiss
def test_what_is_found_has_its_score_and_the_recall_is_told(
    opinionated: TrainedPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"_FEWEST": 1, "_AT_LEAST": 1, "_SAMPLE": 1}.items():
        monkeypatch.setattr(module, name, value)
    rule = DecisionRule(1.0, reward_weight=3.0)
    asked, scorer = random_sessions(opinionated, rule), opinionated.scorer(rule)
    nothing = (torch.empty(0, dtype=torch.int64),) * 2
    index = ItemIndex(scorer, "ucf")
    items, values = index.best(asked, nothing, 2)
    exact = scorer.scores(asked)
    theirs = exact.gather(1, items)
    torch.testing.assert_close(values, theirs - theirs[:, :1], rtol=1e-4, atol=1e-4)
    best = exact.topk(2).indices
    found = sum(len(set(a) & set(b)) for a, b in zip(items.tolist(), best.tolist(), strict=True))
    assert (index.sampled, index.wanted) == (40, 80)
    assert index.found == found < 80


@needs_faiss
def test_the_command_tells_the_recall(
    opinionated: TrainedPolicy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tagged_histories(users=5).to_parquet(tmp_path / "log.parquet")
    out = tmp_path / "out.parquet"
    asked = [str(opinionated.folder), str(tmp_path / "log.parquet"), "--out", str(out), "--k", "4"]
    assert main(["recommend", *asked, "--approximate", "--temperature", "0"]) == 0
    assert "recall@4 against the exact search: 1.000 (1 users)" in capsys.readouterr().out
    assert len(pd.read_parquet(out)) == 20


@needs_faiss
def test_what_needs_all_scores_is_refused(opinionated: TrainedPolicy, tmp_path: Path) -> None:
    drawn = DecisionRule(1.0, temperature=0.5)
    with pytest.raises(InputError, match=r"leave --approximate out, or give --temperature 0"):
        ItemIndex(opinionated.scorer(drawn), "ucf")
    other = trained_run(tmp_path, "item-knn")
    with pytest.raises(InputError, match="leave --approximate out"):
        ItemIndex(other.scorer(), other.name)
