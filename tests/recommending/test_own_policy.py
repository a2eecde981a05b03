"""A policy evaluated on a log of its own decisions: every weight is 1."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.support.served import trained_run
from tests.support.tagged import tagged_log
from ucfrec import Recommender
from ucfrec.acting.decision import DecisionRule
from ucfrec.logs.join import join_feedback
from ucfrec.logs.mapping import LogMapping
from ucfrec.off_policy.evaluate import evaluate_off_policy
from ucfrec.off_policy.score import read_logged_sessions, score

PAUSES = {"a session goes on": 60_000, "a session begins": 7_200_000}


@pytest.mark.parametrize("k", [1, 10])
@pytest.mark.parametrize("filter_seen", [False, True])
@pytest.mark.parametrize("pause", PAUSES.values(), ids=PAUSES)
@pytest.mark.parametrize("among", [None, range(0, 24, 2)], ids=["all", "candidates"])
@pytest.mark.parametrize("in_turn", [False, True])
def test_weights_are_one(
    tmp_path: Path, k: int, filter_seen: bool, pause: int, among: range | None, in_turn: bool
) -> None:
    trained, log = trained_run(tmp_path), tagged_log()
    policy, rng = Recommender.load(tmp_path / "run"), np.random.default_rng(0)
    rule = DecisionRule(trained.rule.target, reward_weight=0.5, temperature=1.0)
    if in_turn:
        rule = replace(rule, explore=0.2, by_marginal_gain=True)
        for model in (trained.reward_model, policy.trained.reward_model):
            assert model is not None
            model.above.fill_(-2.0)
    days = range(1 if among and filter_seen else 2)  # then all candidates are seen
    for day in days:
        shown, feedback = tmp_path / f"{day}.parquet", tmp_path / f"f{day}.parquet"
        at = int(log.timestamp.max()) + pause
        how = {"filter_seen": filter_seen, "candidates": among, "rule": rule, "at": at}
        policy.recommend(log, k, **how, exposures=shown)
        rows = pd.read_parquet(shown)[["user_id", "item_id", "timestamp"]]
        likes = rows[rng.random(len(rows)) < 0.4].assign(reward=1.0)
        likes.assign(timestamp=likes.timestamp + 500).to_parquet(feedback)
        join_feedback([shown], [feedback], tmp_path / f"log{day}.parquet", 60_000)
        joined = pd.read_parquet(tmp_path / f"log{day}.parquet")
        joined["user_id"] = joined.user_id.astype(log.user_id.dtype)
        log = pd.concat([log, joined[["user_id", "item_id", "timestamp", "reward", "position"]]])
    logs = [tmp_path / f"log{day}.parquet" for day in days]
    with read_logged_sessions(trained, logs, LogMapping(), keep_unknown=True) as logged:
        scored = pd.concat(score(trained, logged, rule))
        np.testing.assert_allclose(scored.probability, scored.propensity, rtol=1e-4)
        best = pd.concat(score(trained, logged, replace(rule, temperature=0.0, explore=0.0)))
        assert ((best.probability == 1) == (best.item_id == best.greedy_item_id)).all()
        report = evaluate_off_policy(trained, logged, rule=rule, seed=0)
    weights = {row.method: row.metrics["effective_sessions"] for row in report.rows}
    assert weights["PDIS"] == pytest.approx(weights["logged"], rel=1e-3)
