"""Item embeddings: what they see, what they say, and of whom; and the decomposition behind them."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import sparse
from sklearn.utils.extmath import randomized_svd

from tests.support.logs import START
from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs.append import append_logs
from ucfrec.logs.items import Exposure, SparseRows, item_embeddings, right_singular_vectors
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare

ROWS = 4000
SPLIT = PrepareOptions(split=(START + 3000, START + 3500), embedding_size=8)


def make_log(seed: int = 0) -> pd.DataFrame:
    """One row a millisecond; user u likes items of group u % 3, items 27 to 29 come late."""
    generator = np.random.default_rng(seed)
    user, item = generator.integers(90, size=ROWS), generator.integers(27, size=ROWS)
    item = np.where((np.arange(ROWS) > 3100) & (item < 9), 27 + item % 3, item)
    likes = generator.random(ROWS) < np.where(user % 3 == item % 3, 0.9, 0.1)
    columns = {"user_id": user, "item_id": item, "timestamp": START + np.arange(ROWS)}
    return pd.DataFrame({**columns, "reward": likes.astype(float)})


def catalogue() -> pd.DataFrame:
    return pd.DataFrame(
        {
            "item_id": np.arange(32),
            "group": [f"g{i % 3}" for i in range(32)],
            "tags": [f"t{i % 3}|t{i % 5}" if i else None for i in range(32)],
            "price": np.where(np.arange(32) == 4, np.nan, np.arange(32.0)),
            "same": 1.0,
            "day": pd.date_range("2024-01-01", periods=32),
        }
    )


COLUMNS = ("group", "string_split(tags, '|')", "price", "same", "day")


def learn(
    folder: Path, log: pd.DataFrame, features: bool = True, items: pd.DataFrame | None = None
) -> EpisodeStore:
    folder.mkdir()
    log.to_parquet(folder / "log.parquet", index=False)
    (catalogue() if items is None else items).to_parquet(folder / "items.parquet", index=False)
    people = {"user_id": np.arange(95), "age": np.arange(95.0), "sex": np.arange(95) % 2 == 0}
    pd.DataFrame(people).to_csv(folder / "users.csv", index=False)
    mapping = LogMapping(
        item_features=(FeatureTable((folder / "items.parquet",), "item_id", COLUMNS),),
        user_features=(FeatureTable((folder / "users.csv",), "user_id"),),
    )
    prepare([folder / "log.parquet"], mapping if features else LogMapping(), folder / "s", SPLIT)
    return EpisodeStore.open(folder / "s")


def similarity(embeddings: torch.Tensor) -> np.ndarray:
    unit = torch.nn.functional.normalize(embeddings, dim=1)
    return (unit @ unit.T).numpy()


@pytest.mark.parametrize("features", [False, True])
def test_embeddings_see_the_training_window_only(tmp_path: Path, features: bool) -> None:
    log = make_log()
    later = log.copy()
    rest = log["timestamp"] >= START + 3000
    later.loc[rest, "reward"] = 1 - later.loc[rest, "reward"]
    later.loc[rest, "user_id"] = later.loc[rest, "user_id"].to_numpy()[::-1]
    # Other late items: they may be listed or not, and show up or not.
    later.loc[rest & (later["item_id"] == 29), "item_id"] = 28
    states = [
        learn(tmp_path / "a", log, features).item_states,
        learn(tmp_path / "b", later, features, catalogue()[:31]).item_states,
    ]
    assert states[0].embeddings[:29].equal(states[1].embeddings[:29])
    assert states[0].user_features.equal(states[1].user_features)
    assert states[0].reward_high == states[1].reward_high
    log.loc[0, "reward"] = 1 - log.loc[0, "reward"]
    changed = learn(tmp_path / "c", log, features).item_states
    assert not states[0].embeddings[:29].equal(changed.embeddings[:29])


@pytest.mark.parametrize("features", [False, True])
def test_items_liked_by_the_same_users_are_near(tmp_path: Path, features: bool) -> None:
    embeddings = learn(tmp_path / "a", make_log(), features).item_states.embeddings
    assert embeddings.shape == (32 if features else 30, 8)
    assert embeddings.norm(dim=1).max() <= 1 + 1e-6
    near, group = similarity(embeddings[:27]), np.arange(27) % 3
    same, off = group[:, None] == group, ~np.eye(27, dtype=bool)
    assert near[same & off].mean() > near[~same].mean() + 0.4


def test_cold_items_are_placed_by_their_features_or_not_at_all(tmp_path: Path) -> None:
    warm = learn(tmp_path / "a", make_log()).item_states.embeddings
    near = similarity(warm)[:, :27]
    for cold in (27, 28, 29, 31):
        of_group = near[cold, np.arange(27) % 3 == cold % 3].mean()
        assert of_group > near[cold, np.arange(27) % 3 != cold % 3].mean() + 0.3
    without = learn(tmp_path / "b", make_log(), features=False).item_states.embeddings
    assert without[27:].abs().max() == 0


def test_user_features_and_rewards_are_scaled_by_the_training_window(tmp_path: Path) -> None:
    log = make_log()
    log.loc[5, "reward"] = 50.0
    log.loc[3500, "reward"] = -7.0
    states = learn(tmp_path / "a", log).item_states
    assert states.user_features.shape == (95, 3)
    known = states.user_features[:90]
    torch.testing.assert_close(known.std(dim=0, correction=0), torch.ones(3))
    assert known.mean(dim=0).abs().max() < 1e-6
    train = log["reward"][:3000]
    assert states.reward_low == 0.0
    assert states.reward_high == pytest.approx(train.mean() + 2 * train.std(ddof=0))


def test_few_users_or_items_give_few_dimensions(tmp_path: Path) -> None:
    zero = np.zeros(4, dtype=np.int64)
    one_user = Exposure(tmp_path / "one_user", np.array([2, 2, 0]))
    one_user.add(zero, np.array([0, 1, 0, 1]), np.ones(4))
    assert item_embeddings(one_user).shape == (3, 1)
    one_item = Exposure(tmp_path / "one_item", np.array([4]))
    one_item.add(np.arange(4), zero, np.ones(4))
    assert item_embeddings(one_item).shape == (1, 1)


def on_disk(path: Path, matrix: sparse.csr_matrix) -> SparseRows:
    rows = SparseRows(path, matrix.shape[1])
    for begin in range(0, matrix.shape[0], 37):
        rows.append(matrix[begin : begin + 37])
    return rows


@pytest.mark.parametrize("shape", [(400, 90), (90, 400), (60, 60)])
def test_it_is_that_of_scikit_learn(tmp_path: Path, shape: tuple[int, int]) -> None:
    generator = np.random.default_rng(0)
    strong = generator.normal(size=(shape[0], 4)) @ generator.normal(size=(4, shape[1]))
    dense = np.where(generator.random(shape) < 0.3, 3 + strong + generator.normal(size=shape), 0)
    matrix = sparse.csr_matrix(dense.astype(np.float32))
    by_column = 1 + generator.random(shape[1])
    found, vectors = right_singular_vectors(on_disk(tmp_path / "m", matrix), by_column, 12)
    divided = matrix.astype(np.float64) @ sparse.diags(1 / by_column)
    _, values, expected = randomized_svd(divided, 12, random_state=0)
    np.testing.assert_allclose(found, values, rtol=1e-5)
    signs = np.sign((vectors * expected).sum(axis=1))
    np.testing.assert_allclose(vectors * signs[:, None], expected, atol=1e-4)
    assert (vectors[np.arange(12), np.abs(vectors).argmax(axis=1)] > 0).all()


def test_directions_beyond_the_rank_are_zero(tmp_path: Path) -> None:
    matrix = sparse.csr_matrix(np.outer(np.arange(1, 6), [1.0, 0, 2, 0]).astype(np.float32))
    values, vectors = right_singular_vectors(on_disk(tmp_path / "m", matrix), np.ones(4), 3)
    np.testing.assert_allclose(values, [np.sqrt(55 * 5), 0, 0], rtol=1e-6)
    np.testing.assert_allclose(vectors[0], np.array([1, 0, 2, 0]) / np.sqrt(5), atol=1e-6)
    assert not vectors[1:].any()


def of_two_kinds(users: int, items: list[int], start: int, seed: int) -> pd.DataFrame:
    """Users of one kind are shown, and like, even items; those of the other odd ones."""
    rng = np.random.default_rng(seed)
    rows = [
        (user, item, start + 1000 * user + step, int(rng.random() < 0.8))
        for user in range(users)
        for step, item in enumerate(rng.permutation([i for i in items if i % 2 == user % 2]))
    ]
    return pd.DataFrame(rows, columns=["user_id", "item_id", "timestamp", "reward"])


def test_a_new_item_lies_with_what_its_users_were_shown(tmp_path: Path) -> None:
    day = 86_400_000
    of_two_kinds(80, [*range(12)], START, 0).to_parquet(tmp_path / "old.parquet")
    of_two_kinds(80, [*range(14)], START + day, 1).to_parquet(tmp_path / "new.parquet")
    options = PrepareOptions(embedding_size=4)
    prepare([tmp_path / "old.parquet"], LogMapping(), tmp_path / "store", options)
    append_logs(tmp_path / "store", [tmp_path / "new.parquet"], tmp_path / "grown")
    stores = (EpisodeStore.open(tmp_path / name) for name in ("store", "grown"))
    old, new = (store.item_states.embeddings.numpy() for store in stores)
    # Old vectors moved a little; new ones lie on the side of their kind.
    assert np.abs(new[:12] - old).max() < 0.5
    for item in (12, 13):
        near = new[:12] @ new[item]
        assert near[item % 2 :: 2].mean() > near[1 - item % 2 :: 2].mean() + 0.3
