"""What counts as liked: stated by default, set by an expression."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ucfrec import schema
from ucfrec.commands.cli import main
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.evaluation.liked import LikedByRange, LikedExpression
from ucfrec.evaluation.ranking import MEASURES
from ucfrec.files.atomic import write_sealed_json
from ucfrec.logs.expressions import Expression
from ucfrec.results.rows import read_results

SETTINGS = ["train.steps=20", "train.validate_every=10", "policy.dim=8", "policy.context=4"]
SETTINGS += ["rule.choose=false", "augment.copies=0"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of ratings from 0.5 to 5, a run on it, and later logs."""
    folder, rng, n = tmp_path_factory.mktemp("liked"), np.random.default_rng(0), 3000
    log = pd.DataFrame({"user_id": rng.integers(60, size=n), "item_id": rng.integers(20, size=n)})
    log["timestamp"] = 1_700_000_000_000 + 60_000 * np.arange(n)
    log["rating"] = rng.choice([0.5, 0.7, 2.0, 3.7, 5.0], size=n)
    log[:2500].to_parquet(folder / "log.parquet")
    log[2500:].to_parquet(folder / "later.parquet")
    log[2500:].assign(rating=0.5).to_parquet(folder / "disliked.parquet")
    store = ["prepare", str(folder / "log.parquet"), "--out", str(folder / "store")]
    assert main([*store, "--reward", "rating", "--session-by", "user"]) == 0
    sets = [word for setting in SETTINGS for word in ("--set", setting)]
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
def test_an_expression_says_what_is_liked(
    folder: Path, expression: str, expected: set[float]
) -> None:
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
        ("reward = random()", "it calls 'random'"),
    ],
)
def test_what_is_no_truth_value_over_the_reward_is_refused(expression: str, says: str) -> None:
    with pytest.raises(InputError, match="--liked") as caught:
        LikedExpression(Expression(expression, "--liked"))
    assert says in str(caught.value)


def test_the_default_states_its_threshold(folder: Path) -> None:
    said = str(LikedByRange(EpisodeStore.open(folder / "store").item_states))
    assert said.startswith(
        "reward >= 3.2 (60% of the way from 0.5, the lowest training reward, to 5,"
    )


def ranked(folder: Path, out: Path, *arguments: str) -> pd.DataFrame:
    """Rows of `rank --json`, which every JSON reader takes; what is undefined is not in them."""
    assert main(["rank", str(folder / "run"), *arguments, "--k", "5", "--json", str(out)]) == 0
    json.loads(out.read_text(), parse_constant=pytest.fail)
    return pd.DataFrame([dict.fromkeys(MEASURES) | row.as_line() for row in read_results(out)])


def test_rank_states_what_is_liked_and_takes_another(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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


@pytest.mark.parametrize("nothing", ["disliked.parquet", "--liked"])
def test_nothing_liked_is_null(folder: Path, tmp_path: Path, nothing: str) -> None:
    later = folder / ("later.parquet" if nothing == "--liked" else nothing)
    more = ["--liked", "reward > 9"] if nothing == "--liked" else []
    rows = ranked(folder, tmp_path / "rows.json", str(later), *more)
    assert rows[["hit_rate_liked", "recall_liked", "gauc"]].isna().all(axis=None)
    assert rows.hit_rate_shown.notna().all()


def test_ope_and_rank_without_logs_use_the_test_split(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, test = tmp_path / "ope.json", EpisodeStore.open(folder / "store").split("test")
    given = ["--temperature", "1", "--estimate-propensities", "--json", str(out)]
    assert main(["ope", str(folder / "run"), *given]) == 0
    printed = capsys.readouterr().out
    assert f"{test.n_episodes:,} sessions, {test.n_steps:,} steps" in printed
    assert "seen in training" not in printed
    rows = {row.method: row for row in read_results(out)}
    assert rows["logged"].metrics["R_cum"] == pytest.approx(float(test.returns.mean()))
    assert (ranked(folder, tmp_path / "rank.json").steps == test.n_steps).all()
    assert "on the test split" in (folder / "run" / "MODEL_CARD.md").read_text()


def test_ope_without_logs_says_why_it_cannot(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    refit = str(tmp_path / "refit")
    assert (
        main(["train", str(folder / "store"), "--out", refit, "--refit", str(folder / "run")]) == 0
    )
    moved = tmp_path / "moved"
    shutil.copytree(folder / "run", moved)
    record = json.loads((moved / "run.json").read_text())
    record |= {"store": str(tmp_path / "gone"), "store_from_run": None}
    write_sealed_json(moved / "run.json", {k: v for k, v in record.items() if k != "checksum"})
    for run, says in ((refit, "is a refit"), (str(moved), "is gone or has changed")):
        for command in ("ope", "rank"):
            assert main([command, run]) == 2
            assert says in capsys.readouterr().err
