"""BPR: liked items, of the session's own kind, come first."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.support.logs import store_of
from ucfrec.commands.cli import main
from ucfrec.episodes.store import EpisodeStore
from ucfrec.results.rows import read_results

PEERS = ("bpr", "gsasrec", "boosted")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> EpisodeStore:
    """Users who like the items of one of four kinds; a policy of no user has a GAUC of .5."""
    folder, rng, n = tmp_path_factory.mktemp("peers"), np.random.default_rng(0), 12_000
    log = pd.DataFrame({"user_id": rng.integers(120, size=n), "item_id": rng.integers(40, size=n)})
    own = log.user_id % 4 == log.item_id % 4
    log["reward"] = (rng.random(n) < np.where(own, 0.8, 0.05)).astype(float)
    log["timestamp"] = 1_700_000_000_000 + 60_000 * np.arange(n)
    # Most of what is shown was liked: gSASRec sees which items were shown, and no rewards.
    log = log[(log.reward > 0) | (rng.random(n) < 0.05)]
    return store_of(log, folder, reward="reward", session_by="user")


@pytest.mark.parametrize("name", PEERS)
def test_peers_beat_popularity_where_users_differ(
    store: EpisodeStore, tmp_path: Path, name: str
) -> None:
    run, out = str(tmp_path / name), tmp_path / "rows.json"
    settings = ["train.steps=300", "train.learning_rate=0.01", "train.validate_every=100"]
    settings += ["policy.dim=16", "policy.context=10", "rule.choose=false", "train.warmup_steps=0"]
    words = [word for each in settings for word in ("--set", each)]
    command = ["train", str(store.path), "--out", run, "--policy", name, *words, "--no-refit"]
    assert main(command) == 0
    assert main(["rank", run, "--keep-seen", "--json", str(out)]) == 0
    rows = {row.method: row.metrics for row in read_results(out)}
    best = max(rows[other]["hit_rate_liked"] for other in ("most clicked", "item click rate"))
    assert rows[name]["hit_rate_liked"] > best + 0.15
    assert rows[name]["gauc"] > 0.7
