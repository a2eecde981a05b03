"""Fit, recommend, save and load from Python."""

import os
import pickle
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone

import ucfrec
from tests.recommending.test_recommend import SMALL, random_log
from ucfrec import UCF, EpisodeStore, Recommender
from ucfrec.errors import InputError, InputNote
from ucfrec.fitting.checkpoint import read_metrics
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.off_policy.selection import choose


@pytest.fixture(scope="module")
def log() -> pd.DataFrame:
    return random_log()


@pytest.fixture(scope="module")
def folder(log: pd.DataFrame, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log in two files, and the store of both."""
    path = tmp_path_factory.mktemp("recommender")
    log.head(700).to_parquet(path / "log-1.parquet")
    log.tail(len(log) - 700).to_parquet(path / "log-2.parquet")
    options = PrepareOptions(reward="reward", session_by="gap", gap_minutes=20)
    prepare([path / "log-*.parquet"], LogMapping(), path / "store", options)
    return path


@pytest.fixture(scope="module")
def fitted(folder: Path) -> Recommender:
    return Recommender("dt", settings=SMALL, seed=3).fit(EpisodeStore.open(folder / "store"))


def test_the_names_of_the_package() -> None:
    assert dir(ucfrec) == sorted(ucfrec.__all__)
    assert {"UCF", "EpisodeStore", "Recommender", "prepare"} <= set(ucfrec.__all__)
    assert all(getattr(ucfrec, name) is not None for name in ucfrec.__all__)
    assert UCF is Recommender
    with pytest.raises(AttributeError, match="no attribute 'Recommendation'"):
        ucfrec.Recommendation  # noqa: B018


@pytest.mark.parametrize("kind", ["folder of the store", "glob", "frame"])
def test_a_store_its_logs_and_a_frame_of_them_train_the_same_policy(
    fitted: Recommender, folder: Path, log: pd.DataFrame, kind: str, tmp_path: Path
) -> None:
    policy = Recommender("dt", settings=SMALL, seed=3)
    rules = {"reward": "reward", "session_by": "gap", "gap_minutes": 20.0}
    if kind == "folder of the store":
        policy.fit(str(folder / "store"), tmp_path / "run")
    elif kind == "glob":
        policy.fit(folder / "log-*.parquet", tmp_path / "run", **rules)  # type: ignore[arg-type]
    else:
        policy.fit(log, tmp_path / "run", **rules)  # type: ignore[arg-type]
    assert policy.run == tmp_path / "run"
    assert policy.trained.record.fingerprint == fitted.trained.record.fingerprint
    pd.testing.assert_frame_equal(policy.recommend(log), fitted.recommend(log))


def test_only_runs_stay(log: pd.DataFrame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scratch, work = tmp_path / "scratch", tmp_path / "work"
    scratch.mkdir()
    work.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    monkeypatch.chdir(work)
    policy = Recommender("dt", settings=SMALL).fit(log, tmp_path / "run")
    assert not [*work.iterdir()]
    folders = (scratch, work, tmp_path, tmp_path / "run", tmp_path / "run" / "policy")
    before = [folder.stat().st_mtime_ns for folder in folders]
    policy.recommend(log)
    assert [folder.stat().st_mtime_ns for folder in folders] == before  # nothing came and went
    kept = Recommender("dt", settings=SMALL).fit(log)
    assert {path.name for path in kept.run.parent.iterdir()} == {"run", "store"}
    assert kept.run.is_relative_to(scratch)
    of_store = Recommender("dt", settings=SMALL).fit(kept.run.parent / "store", tmp_path / "other")
    # What torch keeps in the scratch folder is not ours.
    assert len([*scratch.glob(".run-*.ucfrec-partial")]) == 1
    del policy, kept
    assert not [*scratch.glob(".run-*")]
    assert of_store.run.is_dir()


def test_the_store_of_a_named_run_is_kept_beside_it(log: pd.DataFrame, tmp_path: Path) -> None:
    run = tmp_path / "new" / "run"
    first = Recommender("item-rate").fit(log, run)
    assert {path.name for path in run.parent.iterdir() if path.is_dir()} == {"run", "run-store"}
    ranked = first.rank().to_frame()
    del first
    for policy in (Recommender.load(run), Recommender("item-rate").fit(log, run)):
        pd.testing.assert_frame_equal(policy.rank().to_frame(), ranked)
        assert len(policy.recommend(k=1)) == log.user_id.nunique()
    with pytest.raises(InputError, match=r"run-store is a store of other logs .*another folder"):
        Recommender("item-rate").fit(log[:-50], run)


def test_folders_are_found_from_any_folder(
    folder: Path, log: pd.DataFrame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    policy = Recommender("item-rate").fit(os.path.relpath(folder / "store"), "run")
    loaded = Recommender.load("run")
    (tmp_path / "other").mkdir()
    monkeypatch.chdir("other")
    for each in (policy, loaded):
        assert each.run == each.trained.folder == tmp_path / "run"
        assert len(each.score(log)) == len(log)
        assert set(each.recommend(users=[5], k=1).user_id) == {5}
    policy.save("copy")
    assert (tmp_path / "other" / "copy" / "run.json").is_file()


def test_copies_and_pickle(
    log: pd.DataFrame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    policy = Recommender("item-rate").fit(log)
    twin, pickled, run = deepcopy(policy), pickle.dumps(policy), policy.run
    del policy
    assert twin.run == run
    twin.save(tmp_path / "copy")
    del twin
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]
    again = pickle.loads(pickled)
    assert set(again.recommend(log, k=1).user_id) == {*log.user_id}
    for use in (lambda: again.save(tmp_path / "x"), again.rank, lambda: again.score(log)):
        with pytest.raises(InputError, match=r"is gone, .*call save\(folder\) before"):
            use()


KILLED = """
import os, signal, sys
from ucfrec import Recommender
settings = {"policy.dim": 8, "policy.context": 2, "train.steps": 2, "augment.copies": 0}
policy = Recommender("bc", settings=settings | {"rule.choose": False}).fit(sys.argv[1])
print(policy.run, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_killed_runs_are_removed(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", KILLED, folder / "store"],
        env={**os.environ, "TMPDIR": str(tmp_path), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == -signal.SIGKILL
    left = Path(ended.stdout.strip())
    assert (left / "run.json").exists()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    policy = Recommender("bc", settings=[*SMALL, "rule.choose=false"])
    policy.fit(EpisodeStore.open(folder / "store"))
    assert not left.exists()
    assert policy.run.is_relative_to(tmp_path)
    again = policy.fit(EpisodeStore.open(folder / "store")).run
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} == {again.parent.name}
    del policy
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("spoil", "options", "says"),
    [
        (lambda log: pd.concat([log, log]), {}, r"3,000 rows \(50%\) are dropped: repeats user"),
        (
            lambda log: log,
            {"mapping": LogMapping(where="item_id <> 3")},
            r"1,500 rows were excluded \(\d+: does not fulfil LogMapping.where\)",
        ),
        (
            lambda log: log.assign(reward=log.reward.mask(log.index < 5)),
            {},
            r"5 of 1,500 rows were excluded \(5: reward is missing",
        ),
    ],
)
def test_rows_are_warned_of_once_at_the_users_line(
    log: pd.DataFrame, spoil: Callable[..., pd.DataFrame], options: dict[str, Any], says: str
) -> None:
    data = spoil(log)
    with pytest.warns(InputNote, match=says) as noted:
        policy = Recommender("item-rate").fit(data, **options)
    files = [each.filename for each in noted if issubclass(each.category, InputNote)]
    assert files == [__file__] * (2 if options else 1)  # --where cuts sessions
    if not options:
        with pytest.warns(InputNote, match=says) as noted:
            policy.score(data)
        assert len([each for each in noted if issubclass(each.category, InputNote)]) == 1


def test_data_that_cannot_be_used(folder: Path, log: pd.DataFrame) -> None:
    policy = Recommender("dt", settings=SMALL)
    store = folder / "store"
    for data, options, message in (
        (store, {"reward": "reward"}, "is prepared already"),
        (folder / "nothing", {}, "nothing does not exist"),
        ([1, 2], {}, r"data is \[1, 2\]; give a pandas DataFrame"),
        (log.head(0), {}, "data: the frame has no rows"),
        (log.drop(columns="item_id"), {}, "no column 'item_id'"),
        (log, {"session_by": "day"}, "session_by is 'day'"),
        (log, {"session_by": "user", "gap_minutes": 3}, "gap_minutes is 3, but sessions are those"),
        (log.assign(session_id=1), {"gap_minutes": 3}, "session_by='session_id'; leave it out"),
        (log, {"dataset": "movielens"}, "dataset is 'movielens', but only files have one"),
    ):
        with pytest.raises(InputError, match=message):
            policy.fit(data, **options)  # type: ignore[arg-type]
        assert repr(policy) == "Recommender('dt', not trained)"
    for use in (lambda: policy.run, lambda: policy.recommend(log), lambda: policy.trained):
        with pytest.raises(InputError, match="not trained yet"):
            use()


def test_equal_rewards_are_learned_as_a_ranking(log: pd.DataFrame, tmp_path: Path) -> None:
    policy = Recommender("sasrec", settings=SMALL)
    with pytest.warns(InputNote, match="all .* rewards equal 1: policies learn what users choose"):
        policy.fit(log.assign(reward=1.0), tmp_path / "run", refit=False)
    record = policy.trained.record
    assert record.rule is None
    assert record.ranking is not None
    assert 0 < record.ranking.ndcg < record.ranking.hits < 1
    assert "NDCG@10" in record.describe()
    card = (tmp_path / "run" / "MODEL_CARD.md").read_text(encoding="utf-8")
    assert "NDCG@10 on validation rows" in card
    assert policy.recommend(log.assign(reward=1.0), k=2).groupby("user_id").size().eq(2).all()


def test_a_policy_saved_and_loaded(fitted: Recommender, log: pd.DataFrame, tmp_path: Path) -> None:
    fitted.save(tmp_path / "copy")
    loaded = UCF.load(tmp_path / "copy")
    assert loaded.trained.record.refit_of is None, "fit keeps the weights of the training rows"
    assert loaded.config == fitted.config
    assert repr(loaded) == repr(fitted)
    pd.testing.assert_frame_equal(loaded.recommend(log), fitted.recommend(log))
    assert loaded.trained is loaded.trained
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InputError, match="copy exists already"):
        fitted.save(tmp_path / "copy")
    assert sorted(tmp_path.iterdir()) == before
    with pytest.raises(InputError, match="is not a run folder"):
        Recommender.load(tmp_path)


def test_six_rows_with_new_users_in_validation_are_enough_for_a_policy(tmp_path: Path) -> None:
    rows = {"user_id": [2, 1, 1, 0, 0, 0], "item_id": [0, 0, 0, 1, 1, 1], "reward": [0, 1] * 3}
    tiny = pd.DataFrame(rows).assign(timestamp=1_700_000_000_000 + 10**7 * np.arange(6))
    policy = Recommender("bc", settings=SMALL).fit(tiny, tmp_path / "run")
    assert len(policy.recommend(tiny, k=1, filter_seen=False)) == 3


@pytest.fixture(scope="module")
def shown(log: pd.DataFrame) -> pd.DataFrame:
    """The log with the probabilities of a logging policy that drew uniformly."""
    return log.assign(propensity=1 / 30)


@pytest.fixture(scope="module")
def clicked(shown: pd.DataFrame, tmp_path_factory: pytest.TempPathFactory) -> Recommender:
    settings = {"train.steps": 60, "train.validate_every": 30, "policy.dim": 16, "rule.sessions": 5}
    return Recommender("dt", settings=settings).fit(
        shown, tmp_path_factory.mktemp("clicked") / "run", reward="reward", session_by="user"
    )


def test_the_whole_job_in_python(clicked: Recommender, shown: pd.DataFrame, tmp_path: Path) -> None:
    """Train, rank, estimate, decide, recommend, score, export, report: as the commands do it."""
    later = shown.assign(timestamp=shown.timestamp + 10**9)
    ranking = clicked.rank(later, k=5, liked="reward > 0.5")
    frame = ranking.to_frame().set_index("method")
    assert {"dt", "random", "most shown"} <= set(frame.index)
    assert frame.loc["dt", "hit_rate_liked_low"] <= frame.loc["dt", "hit_rate_liked"]
    report = clicked.ope(later)
    estimates = report.to_frame().set_index("method")
    assert estimates.loc["logged", "R_cum"] == pytest.approx(
        shown.groupby("user_id").reward.sum().mean()
    )
    assert report.verdict.headline in report._repr_html_()
    assert repr(report).startswith(f"{report.verdict.headline}\n")
    assert len(repr(report).splitlines()) <= 15
    rule = ucfrec.DecisionRule(1.0, temperature=1.0)
    other = clicked.ope(later, rule=rule)
    choice = choose({"own": report, "drawn": other}, 0)
    assert choice.excluded.keys() <= {"own", "drawn"}  # 40 users are few
    chosen = clicked.recommend(later, k=3, rule=rule, users=[3, 7])
    assert chosen.groupby("user_id").size().to_dict() == {3: 3, 7: 3}
    scored = clicked.score(later, rule=rule)
    assert len(scored) == len(later)
    assert scored.probability.between(0, 1).all()
    clicked.report(tmp_path / "report.html", [report])
    report.save(tmp_path / "ope.json")
    for given in (report, str(tmp_path / "ope.json")):
        assert clicked.report(tmp_path / "again.html", given).is_file()
    page = clicked.report(tmp_path / "ranked.html", ranking).read_text(encoding="utf-8")
    assert f"has the highest {ranking.rows[0].metric}" in page
    with pytest.raises(InputError, match="has 3; give what evaluate, ope or rank returned"):
        clicked.report(tmp_path / "no.html", [3])  # type: ignore[list-item]
    with pytest.raises(InputError, match="is a folder, a file is needed"):
        clicked.report(tmp_path)
    card = (clicked.run / "MODEL_CARD.md").read_text(encoding="utf-8")
    assert "ucfrec rank" in card
    assert "ucfrec ope" in card


def test_later_logs_may_be_files(fitted: Recommender, folder: Path, log: pd.DataFrame) -> None:
    from_files = fitted.rank(folder / "log-*.parquet", k=3).to_frame()
    from_frame = fitted.rank(log, k=3).to_frame()
    numbers = [name for name in from_frame.select_dtypes("number") if name != "wall_time_s"]
    pd.testing.assert_frame_equal(from_files[numbers], from_frame[numbers])
    held_out = fitted.rank(k=3, others=[fitted])
    assert [row.method for row in held_out][:2] == ["dt", "dt-2"]
    assert "training" in " ".join(fitted.rank(log).warnings)


def test_users_of_the_store_need_no_frame(fitted: Recommender, log: pd.DataFrame) -> None:
    expected = fitted.recommend(log, k=4, users=[5, "11"])
    pd.testing.assert_frame_equal(fitted.recommend(users=[11, 5], k=4), expected)
    assert set(expected.user_id) == {5, 11}
    assert fitted.recommend(k=1).user_id.nunique() == log.user_id.nunique()
    for users, message in (
        ([5, 999], "1 of 2 users have no rows in the histories, such as 999"),
        ("5", "give a list of user_ids"),
        ([], "give a list of user_ids"),
    ):
        with pytest.raises(InputError, match=message):
            fitted.recommend(log, users=users)
    with pytest.raises(InputError, match="none of the 1 users is in the store"):
        fitted.recommend(users=[999])


def test_callbacks_see_every_step_and_what_is_logged(folder: Path, tmp_path: Path) -> None:
    steps: list[int] = []
    validations: dict[int, Mapping[str, float]] = {}
    settings = {"train.steps": 5, "train.validate_every": 2, "policy.dim": 8, "rule.choose": False}
    policy = Recommender("dt", settings=settings).fit(
        folder / "store",
        tmp_path / "run",
        on_step=lambda step, _: steps.append(step),
        on_validation=lambda step, logged: validations.update({step: logged}),
    )
    assert steps == [1, 2, 3, 4, 5]
    logged = read_metrics(policy.run / "policy")["validation_loss"]
    assert logged == {step: found["validation_loss"] for step, found in validations.items()}

    def stop(step: int, _: Mapping[str, float]) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Recommender("dt", settings=settings).fit(
            folder / "store", tmp_path / "stopped", on_step=stop
        )
    counted: list[int] = []
    Recommender("item-rate").fit(
        folder / "store", tmp_path / "rate", on_validation=lambda step, _: counted.append(step)
    )
    assert counted == [1]


def test_it_follows_scikit_learns_conventions(fitted: Recommender) -> None:
    policy = Recommender("dt", settings=["train.steps=7"], seed=2)
    twin = clone(policy)
    assert twin.get_params() == policy.get_params()
    assert twin.config == policy.config
    policy.set_params(train__steps=9, policy__dim=8, seed=4)
    assert (policy.config.train.steps, policy.config.policy.dim, policy.config.seed) == (9, 8, 4)
    assert policy.get_params()["train__steps"] == 9
    assert policy.get_params(deep=False).keys() == {"policy", "settings", "seed"}
    with pytest.raises(InputError, match="train has no field 'step'"):
        policy.set_params(train__step=1)
    assert policy.config.train.steps == 9
    loaded = Recommender.load(fitted.run)
    assert clone(loaded).config == fitted.config
    loaded.set_params(policy="bc")  # keeps the settings that it has
    assert loaded.config.train == fitted.config.train
    with pytest.raises(InputError, match="policy has no field 'layers'"):
        Recommender("dt").set_params(policy="bc", policy__layers=2)
    assert policy.set_params(policy="bc", settings={}).config.policy_name == "bc"


def test_new_logs_bring_it_up_to_date(log: pd.DataFrame, tmp_path: Path) -> None:
    policy = Recommender("dt", settings=[*SMALL, "rule.sessions=3"]).fit(log[:1000])
    new = policy.update(log[1000:], tmp_path / "new")
    update = new.trained.record.update
    assert update.appended["steps"] == 500
    assert update.verdict is not None
    assert new.run == tmp_path / "new"
    assert new.recommend(log, k=2).groupby("user_id").size().max() == 2
    with pytest.raises(InputError, match=r"gone|are not newer than"):
        Recommender.load(tmp_path / "new").update(log[:10], tmp_path / "third")


@pytest.fixture(scope="module")
def rated(shown: pd.DataFrame) -> Recommender:
    """A policy that is trained at once, on logs with propensities."""
    return Recommender("item-rate").fit(shown, reward="reward", session_by="user")


RULE = ucfrec.DecisionRule(1.0, temperature=1.0)
SEED = "give a whole number from 0 to 4,294,967,295"
FRAME = "give a pandas DataFrame"
SIM = "synthetic-catalog"
WRONG: dict[str, Callable[[Recommender, pd.DataFrame], object]] = {
    f"seed is -1; {SEED}": lambda *_: Recommender(seed=-1),
    f"seed is 1.5; {SEED}": lambda p, log: p.recommend(log, seed=1.5),
    "k is 0; give a whole number, 1 or more": lambda p, log: p.rank(log, k=0),
    "^k is 99; the run has 30 items": lambda p, _: p.export("no", k=99),
    "users is 7; give a list of user_ids": lambda p, _: p.recommend(users=7),
    "items is 5; give a list of item_ids": lambda p, _: p.recommend_to_items(5),
    "settings is None; give a list of texts": lambda *_: Recommender(settings=None),
    r"no policy is called \['dt'\]; choose from": lambda *_: Recommender(["dt"]),
    "gap_minutes is '30'; give a fin": lambda p, log: p.fit(log, gap_minutes="30"),
    "split is 0.8; give three shares, two": lambda p, log: p.fit(log, split=0.8),
    "split '1,x': write shares as .* ISO": lambda p, log: p.fit(log, split=(1, "x")),
    "reward is 1; give text": lambda p, log: p.fit(log, reward=1),
    "name it with reward, or give reward='1' if": lambda p, log: p.fit(log.iloc[:, :3]),
    "on_step is 3; give a function": lambda p, log: p.fit(log, on_step=3),
    "out is 3; give a path": lambda p, log: p.fit(log, 3),
    "{'user_id': 3}; give a LogMapping, a": lambda p, log: p.fit(log, mapping={"user_id": 3}),
    "takes a list of FeatureTable": lambda _, log: LogMapping(item_features=[log]),
    "here, and frames to Recommender.fit": lambda _, log: prepare(log, LogMapping(), "store"),
    "run is None; give a path": lambda *_: Recommender.load(None),
    "environment is None; give the name of a": lambda p, _: p.evaluate(None),
    "episodes is '50'; give a whole number, 1 or more": lambda p, _: p.evaluate(SIM, "50"),
    "behaviors has 3; give the name of a": lambda p, _: p.evaluate(SIM, 5, behaviors=3),
    "window_days is '3'; give a finite": lambda p, log: p.update(log, "no", window_days="3"),
    f"logs is None; {FRAME}": lambda p, _: p.score(None),
    "rule is 'greedy'; give a De": lambda p, log: p.recommend(log, rule="greedy"),
    "; give EstimateOptions": lambda p, log: p.ope(log, options={"discount": 0.9}),
    "^data: the logs are of one user": lambda p, log: p.ope(log[log.user_id == 7]),
    "others has 'run'; give a Rec": lambda p, log: p.rank(log, others=["run"]),
    "candidates is empty or nested": lambda p, log: p.recommend(log, candidates=[[1], [2, 3]]),
}
"""What is said of a call."""


@pytest.mark.parametrize("message", WRONG)
def test_wrong_arguments_are_named(rated: Recommender, shown: pd.DataFrame, message: str) -> None:
    with pytest.raises(InputError, match=message):
        WRONG[message](rated, shown)


def test_numpys_integers_and_any_list_of_ids(rated: Recommender, shown: pd.DataFrame) -> None:
    one = np.int64(1)
    drawn = rated.recommend(shown, k=np.int64(2), rule=RULE, seed=one)
    pd.testing.assert_frame_equal(drawn, rated.recommend(shown, k=2, rule=RULE, seed=1))
    assert rated.rank(shown, k=one, seed=one).rows[0].conditions["k"] == 1
    assert len(rated.recommend_to_items({5}, k=one)) == 1
    for users in ({7, 8}, iter([7, 8]), pd.Series([7, 8]), np.array([7, 8])):
        assert set(rated.recommend(users=users, k=1).user_id) == {7, 8}


def test_names_of_columns_suffice(rated: Recommender, shown: pd.DataFrame, tmp_path: Path) -> None:
    renamed, names = shown.rename(columns={"user_id": "uid"}), {"user_id": "uid"}
    again = Recommender("item-rate").fit(renamed, reward="reward", session_by="user", mapping=names)
    (tmp_path / "log.toml").write_text('[columns]\nuser_id = "uid"\n')
    for file in (tmp_path / "log.toml", str(tmp_path / "log.toml")):
        assert len(rated.score(renamed, mapping=file)) == len(shown)
    assert again.trained.record.fingerprint == rated.trained.record.fingerprint
    pd.testing.assert_frame_equal(
        rated.recommend(renamed, mapping=names), rated.recommend(shown, k=10)
    )
    assert len(rated.score(renamed, mapping=names)) == len(shown)
    assert [row.method for row in rated.rank(shown, others=again)][1] == "item-rate-2"
    measured = rated.evaluate("synthetic-catalog", 4, behaviors="random")
    assert [row.method for row in measured] == ["item-rate", "random"]


@pytest.mark.parametrize("kind", [str, pd.Timestamp, np.datetime64, float])
def test_a_split_may_be_two_times(shown: pd.DataFrame, kind: Callable[[object], object]) -> None:
    times = shown.timestamp.quantile([0.5, 0.75])
    split = [kind(ms if kind is float else pd.Timestamp(ms, unit="ms")) for ms in times]
    policy = Recommender("item-rate").fit(shown, session_by="user", split=split)
    assert policy.trained.record.train_steps == len(shown) // 2
