"""The reward weight chosen by ranking is judged by what each rule would have shown."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.tagged import tagged_log, tagged_mapping
from ucfrec.acting.scorer import logged_scores
from ucfrec.choosing.by_ranking import SHOWN
from ucfrec.episodes.item_counts import liked_steps
from ucfrec.episodes.store import EpisodeStore
from ucfrec.files.atomic import read_json
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run, training_views
from ucfrec.runs.trained_policy import TrainedPolicy

SETTINGS = ["train.steps=5", "policy.dim=16", "policy.context=4", "augment.copies=0"]


def test_all_reward_weights_at_once_are_judged_as_each_rule_alone(tmp_path: Path) -> None:
    tagged_log().to_parquet(tmp_path / "log.parquet")
    options = PrepareOptions(reward="reward", session_by="user", embedding_size=6)
    prepare([tmp_path / "log.parquet"], tagged_mapping(tmp_path), tmp_path / "store", options)
    store = EpisodeStore.open(tmp_path / "store")
    train_run(store, tmp_path / "run", resolve_config("ucf", None, SETTINGS))
    trained = TrainedPolicy.load(tmp_path / "run")
    _, validation = training_views(store)
    episodes, steps = validation.all_steps()
    liked = liked_steps(validation, episodes, steps)
    items = validation.step_values("item", episodes, steps)
    candidates = read_json(tmp_path / "run" / "run.json")["rule"]["candidates"]
    assert len({each["rule"]["reward_weight"] for each in candidates}) == len(candidates) > 2
    for each in candidates:
        scorer = trained.scorer(replace(trained.rule, reward_weight=each["rule"]["reward_weight"]))
        scores = logged_scores(scorer, validation, episodes, steps)
        top = scores.topk(SHOWN).indices.numpy()
        hits = (top == items[:, None]).any(1)[liked].mean()
        assert each["hits"] == pytest.approx(float(np.asarray(hits)), abs=1e-9)
