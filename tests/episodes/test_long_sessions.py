"""A bot's session changes neither the user model nor the decision rule."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.support.short_validation import short_validation
from tests.support.tagged import tagged_log, tagged_mapping
from ucfrec.episodes.long_sessions import of_people
from ucfrec.episodes.store import EpisodeStore
from ucfrec.files.atomic import read_json
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run

SETTINGS = [
    "train.steps=60",
    "train.learning_rate=3e-3",
    "policy.dim=16",
    "train.validate_every=20",
]
SETTINGS += ["policy.context=4", "augment.copies=0", "rule.least_items=2.0"]
SETTINGS += ["rule.temperatures=[1.0]", "rule.reward_weights=[0.0, 2.0]", "rule.lookaheads=[0.0]"]
SETTINGS += ["rule.tag_windows=[0]", "rule.tag_runs=[0]"]


def with_bot(log: pd.DataFrame, rows: int) -> pd.DataFrame:
    """The log with a user of one session, who clicks on everything, in its first part.

    Items are drawn as people see them: the policy learns of all rows, and should be the same.
    """
    rng, begin = np.random.default_rng(1), int(log.timestamp.min())
    bot = pd.DataFrame({"user_id": 101, "item_id": rng.choice(log.item_id, rows), "reward": 1.0})
    bot["timestamp"] = begin + np.sort(rng.choice(10**7, rows, replace=False))
    return pd.concat([log[log.user_id != 101], bot])


def trained(folder: Path, log: pd.DataFrame) -> tuple[EpisodeStore, dict[str, Any]]:
    folder.mkdir()
    log.to_parquet(folder / "log.parquet")
    bounds = tuple(float(log.timestamp[log.user_id != 101].quantile(q)) for q in (0.8, 0.9))
    options = PrepareOptions(session_by="gap", gap_minutes=30, embedding_size=6, split=bounds)
    prepare([folder / "log.parquet"], tagged_mapping(folder), folder / "store", options)
    store = EpisodeStore.open(folder / "store")
    with short_validation():
        train_run(store, folder / "run", resolve_config("popular", None, SETTINGS))
    candidates = read_json(folder / "run" / "candidates.json")
    return store, {**read_json(folder / "run" / "run.json"), "candidates": candidates}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*as bots have")
def test_a_user_of_4000_rows_in_a_session_changes_nothing_that_is_learned_of_people(
    tmp_path: Path,
) -> None:
    log = tagged_log(1500)
    _, people = trained(tmp_path / "people", log)
    store, bot = trained(tmp_path / "bot", with_bot(log, 4000))
    assert store.lengths.max() == 4000
    store = store.split("train")
    kept = of_people(store)
    assert kept.n_steps == store.n_steps - 4000
    assert of_people(kept) is kept
    ends = [each["rule"]["session_end"] for each in (people, bot)]
    assert ends[0]["kept"] == ends[1]["kept"]
    assert ends[1]["rows"] < ends[0]["rows"]
    assert ends[1]["loss"]["constant"] == pytest.approx(ends[0]["loss"]["constant"], rel=0.1)
    assert bot["reward_model"]["train_rows"] < people["reward_model"]["train_rows"]
    rules = [each["rule"]["rule"] for each in (people, bot)]
    for name in rules[0].keys() - {"target"}:
        assert rules[0][name] == rules[1][name], name
    longest = [max(each["length"] for each in e["candidates"]) for e in (people, bot)]
    assert longest[1] == pytest.approx(longest[0], rel=0.3)
    targets = [each["rule"]["target"] for each in bot["candidates"]]
    assert max(target for target in targets if target is not None) <= kept.returns.max()
