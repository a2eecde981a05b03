"""Open Bandit Dataset: official files, and two real policies evaluated on each other's logs."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.support.real_data import data_folder
from ucfrec import schema
from ucfrec.arrays import Float64Array
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import prepare
from ucfrec.off_policy import conclude, diagnose
from ucfrec.off_policy.estimators import estimate
from ucfrec.off_policy.logged_steps import LoggedSteps
from ucfrec_datasets.obd import DATASET

ITEMS, POSITIONS, ROWS = 6, 3, 400
MIDNIGHT = 1_574_553_600_000
"""2019-11-24 UTC, in milliseconds."""
KINDS = ["81ce123cbb5bd8ce818f60fb3586bba5", "cef3390ed299c09874189c387777674a"]


def official(folder: Path, campaign: str = "all") -> pd.DataFrame:
    """A small campaign as the release has it: `all.csv` and `item_context.csv`."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    times = MIDNIGHT + np.sort(rng.integers(10**8, size=ROWS))
    log = pd.DataFrame({"timestamp": pd.to_datetime(times, unit="ms", utc=True).astype(str)})
    log["item_id"] = rng.integers(ITEMS, size=ROWS)
    log["position"] = 1 + rng.integers(POSITIONS, size=ROWS)
    log["click"] = rng.integers(2, size=ROWS)
    log["propensity_score"] = 1 / ITEMS
    for n in range(4):
        log[f"user_feature_{n}"] = rng.choice(KINDS, size=ROWS)
    log[[f"user-item_affinity_{item}" for item in range(ITEMS)]] = 0.0
    context = pd.DataFrame({"item_id": np.arange(ITEMS), "item_feature_0": rng.normal(size=ITEMS)})
    for n in (1, 2, 3):
        context[f"item_feature_{n}"] = rng.choice(KINDS, size=ITEMS)
    log.to_csv(folder / f"{campaign}.csv")
    context.to_csv(folder / "item_context.csv")
    return log


@pytest.mark.parametrize("name", ["", "all.csv"])
def test_official_files(tmp_path: Path, name: str) -> None:
    source = tmp_path / "all"
    log = official(source)
    files, mapping = DATASET.resolve([source / name], LogMapping())
    assert files == (source / "all.csv",)
    report = prepare(files, mapping, tmp_path / "store")
    assert report["episodes"] == report["steps"] == ROWS
    assert report["users"] == len(log.filter(like="user_feature").drop_duplicates())
    store = EpisodeStore.open(tmp_path / "store")
    assert store.item_states.user_features.shape[1] > 0
    steps = store.all_steps()
    np.testing.assert_allclose(store.step_values(schema.PROPENSITY, *steps), 1 / ITEMS)
    times = np.sort(store.step_values(schema.TIMESTAMP, *steps))
    shown = pd.to_datetime(times, unit="ms", utc=True)
    assert shown.tolist() == pd.to_datetime(log.timestamp).tolist()
    shown_at = store.step_values(schema.OBSERVATION, *steps)
    np.testing.assert_array_equal(shown_at.sum(0), np.bincount(log.position)[1:])
    assert (shown_at.sum(1) == 1).all()


def test_a_run_of_one_campaign_reads_no_other(tmp_path: Path) -> None:
    for campaign in ("men", "women"):
        official(tmp_path / "random" / campaign, campaign)
    men, women = (tmp_path / "random" / name for name in ("men", "women"))
    files, mapping = DATASET.resolve([men], LogMapping())
    prepare(files, mapping, tmp_path / "store")
    with pytest.raises(InputError, match="has features, not impressions"):
        DATASET.resolve([men / "item_context.csv"], LogMapping())
    with pytest.raises(InputError, match=r"men.* share no item; prepare one campaign at a time"):
        DATASET.resolve([men, women], LogMapping())
    names = pd.read_parquet(tmp_path / "store" / "items.parquet").item_id
    assert list(names) == [f"men/{n}" for n in range(ITEMS)]
    assert EpisodeStore.open(tmp_path / "store").item_states.embeddings.abs().sum() > 0
    files, mapping = DATASET.resolve([women], LogMapping())
    with pytest.raises(InputError, match="item is not in the store"):
        prepare(files, mapping, tmp_path / "evaluated", like=tmp_path / "store")
    assert not (tmp_path / "evaluated").exists()


def test_the_campaign_is_in_the_name_of_the_file_or_its_folder(tmp_path: Path) -> None:
    official(tmp_path / "men", "log")
    (tmp_path / "elsewhere").mkdir()
    for name in ("random_women.csv", "mine.csv"):
        shutil.copy(tmp_path / "men" / "log.csv", tmp_path / "elsewhere" / name)
    for path, campaign in (("men/log.csv", "men"), ("elsewhere/random_women.csv", "women")):
        _, mapping = DATASET.resolve([tmp_path / path], LogMapping())
        assert mapping.columns["item_id"] == f"concat('{campaign}/', item_id)"
    strange = tmp_path / "elsewhere" / "mine.csv"
    with pytest.raises(InputError, match="neither the file nor its folder is named after"):
        DATASET.resolve([strange], LogMapping())
    _, mapping = DATASET.resolve([strange], LogMapping({"item_id": "item_id + 100"}))
    assert mapping.columns["item_id"] == "item_id + 100"


def test_item_features_are_those_of_the_campaign(tmp_path: Path) -> None:
    for name in ("random_men.csv", "item_context_women.csv", "item_context_men.csv"):
        (tmp_path / name).write_text("item_id\n0\n")
    _, mapping = DATASET.resolve([tmp_path / "random_men.csv"], LogMapping())
    assert mapping.item_features[0].files == (tmp_path / "item_context_men.csv",)


def real(policy: str) -> tuple[Path, pd.DataFrame]:
    path = data_folder("obd") / f"{policy}_all.parquet"
    return path, pd.read_parquet(path)


def shares(log: pd.DataFrame) -> Float64Array:
    """(position, item) how often each item was shown there."""
    counts = np.zeros((POSITIONS, 80))
    np.add.at(counts, (log.position - 1, log.item_id), 1)
    return np.asarray(counts / counts.sum(1, keepdims=True))


@pytest.mark.realdata
def test_every_real_impression_is_a_session_with_its_propensity(tmp_path: Path) -> None:
    path, log = real("random")
    files, mapping = DATASET.resolve([path], LogMapping())
    assert len(mapping.item_features) == 1
    report = prepare(files, mapping, tmp_path / "store")
    assert report["steps"] == report["episodes"] == len(log) == 10_000
    assert (report["items"], report["users"], report["unknown_propensities"]) == (80, 240, 0)
    assert report["reward_statistics"]["mean"] == pytest.approx(log.click.mean())
    store = EpisodeStore.open(tmp_path / "store")
    np.testing.assert_allclose(store.step_values(schema.PROPENSITY, *store.all_steps()), 1 / 80)


@pytest.mark.realdata
def test_random_logs_tell_what_thompson_sampling_earns() -> None:
    """The policy of the bts logs, taken as its shares of items by position, evaluated on the random
    logs; the truth is the click rate of the bts logs, 42 clicks in 10,000, itself uncertain."""
    _, random = real("random")
    _, bts = real("bts")
    steps = LoggedSteps(
        session=np.arange(len(random)),
        reward=random.click.to_numpy(dtype=np.float64),
        propensity=random.propensity_score.to_numpy(),
        target=shares(bts)[random.position - 1, random.item_id],
    )
    found = estimate(steps, seed=0)
    earned = bts.click.to_numpy(dtype=np.float64)
    for name in ("IPS", "SNIPS"):
        assert found[name].low < earned.mean() < found[name].high
    assert found["PDIS"].value == found["IPS"].value  # one step a session
    assert 1000 < found["IPS"].effective_sessions < 5000
    assert diagnose(steps).overlap == pytest.approx(1, abs=0.05)
    verdict = conclude(steps, seed=0)
    assert verdict.lift.is_reliable
    assert verdict.lift.low < earned.mean() - random.click.mean() < verdict.lift.high
