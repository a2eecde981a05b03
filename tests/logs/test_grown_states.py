"""Vectors of new items without features come from the sessions that show them."""

from pathlib import Path

import numpy as np
import pandas as pd

from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs.append import append_logs
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare


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
    start = 1_700_000_000_000
    of_two_kinds(80, [*range(12)], start, 0).to_parquet(tmp_path / "old.parquet")
    of_two_kinds(80, [*range(14)], start + day, 1).to_parquet(tmp_path / "new.parquet")
    options = PrepareOptions(embedding_size=4)
    prepare([tmp_path / "old.parquet"], LogMapping(), tmp_path / "store", options)
    append_logs(tmp_path / "store", [tmp_path / "new.parquet"], tmp_path / "grown")
    old, new = (
        EpisodeStore.open(tmp_path / name).item_states.embeddings.numpy()
        for name in ("store", "grown")
    )
    # Old vectors moved a little; new ones lie on the side of their kind.
    assert np.abs(new[:12] - old).max() < 0.5
    for item in (12, 13):
        near = new[:12] @ new[item]
        assert near[item % 2 :: 2].mean() > near[1 - item % 2 :: 2].mean() + 0.3
