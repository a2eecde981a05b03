"""Recommendations: one answer from Python and from files, from what the policy would see."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from ucfrec import UCF, EpisodeStore
from ucfrec.errors import InputError
from ucfrec.logs import LogMapping, PrepareOptions, prepare
from ucfrec.recommending.histories import histories_of_files
from ucfrec.recommending.recommend import recommend
from ucfrec.runs.trained_policy import TrainedPolicy

SETTINGS = ["train.steps=30", "policy.dim=16", "policy.context=4", "augment.copies=0"]


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
def fitted(log: pd.DataFrame, tmp_path_factory: pytest.TempPathFactory) -> tuple[UCF, Path]:
    folder = tmp_path_factory.mktemp("recommend")
    log.to_parquet(folder / "log.parquet")
    options = PrepareOptions(reward="reward", session_by="gap", gap_minutes=20)
    prepare([folder / "log.parquet"], LogMapping(), folder / "store", options)
    store = EpisodeStore.open(folder / "store")
    return UCF(settings=SETTINGS).fit(store, folder / "run"), folder


def test_python_and_files_agree(fitted: tuple[UCF, Path], log: pd.DataFrame) -> None:
    policy, folder = fitted
    from_frame = policy.recommend(log, k=5)
    trained = TrainedPolicy.load(folder / "run")
    target = trained.target_return(1.0)
    batches = histories_of_files(trained, [folder / "log.parquet"], LogMapping())
    (from_files,) = recommend(trained, batches, 5, target_return=target)
    pd.testing.assert_frame_equal(from_frame, from_files, check_dtype=False)


def test_scores_are_the_policys_at_the_next_step(
    fitted: tuple[UCF, Path], log: pd.DataFrame
) -> None:
    """An independent route: the log with one row more, prepared as episodes."""
    policy, folder = fitted
    user = int(log.user_id.iloc[-1])
    dummy = log.iloc[[-1]].assign(timestamp=log.timestamp.iloc[-1] + 1000, item_id=0, reward=0.0)
    pd.concat([log, dummy]).to_parquet(folder / "longer.parquet")
    options = PrepareOptions(reward="reward", session_by="gap", gap_minutes=20)
    out = folder / "longer"
    prepare([folder / "longer.parquet"], LogMapping(), out, options, like=folder / "store")
    store = EpisodeStore.open(out)
    users = pd.read_parquet(folder / "store" / "users.parquet").user_id.to_numpy()
    episode = np.flatnonzero(users[store.episode_values("user")] == user)[-1:]
    trained = policy.trained
    end = store.lengths[episode] - 1
    windows = store.windows(episode, end, trained.policy.config.context)
    asked = (windows.returns_to_go + 7.0).masked_fill(~windows.mask, 0.0)
    with torch.no_grad():
        logits = trained.policy.act(replace(windows, returns_to_go=asked))
    expected = logits.log_softmax(-1)[0]
    top = policy.recommend(log, k=30, target_return=7.0, filter_seen=False)
    top = top[top.user_id == user].sort_values("item_id")
    np.testing.assert_allclose(top.score, expected.numpy(), rtol=1e-4, atol=1e-5)


def test_only_the_latest_session_makes_the_state_but_all_is_seen(
    fitted: tuple[UCF, Path], log: pd.DataFrame
) -> None:
    policy, _ = fitted
    user = log[log.user_id == 3]
    day = 86_400_000
    recent = user.tail(3)
    earlier = user.head(5).assign(timestamp=recent.timestamp.min() - day - np.arange(5)[::-1])
    alone = policy.recommend(recent, k=30, filter_seen=False)
    both = policy.recommend(pd.concat([earlier, recent]), k=30, filter_seen=False)
    pd.testing.assert_frame_equal(alone, both)
    filtered = policy.recommend(pd.concat([earlier, recent]), k=30)
    assert not set(filtered.item_id) & {*earlier.item_id, *recent.item_id}


def test_a_loaded_policy_is_the_one_saved(
    fitted: tuple[UCF, Path], log: pd.DataFrame, tmp_path: Path
) -> None:
    policy, _ = fitted
    policy.save(tmp_path / "copy")
    loaded = UCF.load(tmp_path / "copy")
    assert loaded.config == policy.config
    pd.testing.assert_frame_equal(loaded.recommend(log), policy.recommend(log))


def test_wrong_histories_are_refused(fitted: tuple[UCF, Path], log: pd.DataFrame) -> None:
    policy, _ = fitted
    with pytest.raises(
        InputError, match=r"no column 'reward' \(for the reward\); nearest: rewards"
    ):
        policy.recommend(log.rename(columns={"reward": "rewards"}))
    with pytest.raises(InputError, match=r"1 rows have an item_id .* \(1 items: 999\)"):
        policy.recommend(pd.concat([log, log.head(1).assign(item_id=999)]))
    with pytest.raises(InputError, match="not trained yet"):
        UCF().recommend(log)
