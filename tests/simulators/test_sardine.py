"""SARDINE's environments: their oracle is SARDINE's, their logs say how probable each item was."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.support.played import play
from ucfrec.acting.rollout import rollout
from ucfrec.errors import InputError
from ucfrec.evaluation.collect import collect
from ucfrec.evaluation.simulator import Environment
from ucfrec_simulators import sardine
from ucfrec_simulators.sardine import BORED_INF, EPSILONS, GreedyOracle, SardineEnvironment
from ucfrec_simulators.synthetic_catalog import SyntheticCatalog

pytest.importorskip("sardine", reason="needs the extra sardine")
LIVE = np.ones(8, dtype=np.bool_)


def test_the_oracle_shows_what_sardine_s_own_would_show() -> None:
    env = SardineEnvironment("BoredInf", 8)
    actor = GreedyOracle(env, 0)
    observations, _ = env.reset(seed=0)
    actor.begin(np.arange(8))
    liked = 0
    for _ in range(12):
        own = [each.unwrapped for each in env.envs]
        chosen, propensities = actor.act(observations, LIVE)
        assert (propensities == 1).all()
        for environment, item in zip(own, chosen, strict=True):
            relevances = relevance(environment)
            best = environment.get_st_oracle_slate(np.array([-1]), relevances)
            assert relevances[item] == pytest.approx(relevances[best[0]])
            liked += relevances[item] > 0.5
        observations, *_ = env.step(chosen)
    assert liked > 40, "users are not always bored"


def relevance(environment: Any) -> np.ndarray:
    """Probability of a click on each item, by SARDINE's formula."""
    score = environment.item_embedd @ environment.cur_user_embedd / environment.max_score
    return np.asarray(1 / (1 + np.exp(-(score - environment.offset) * environment.slope)))


def test_propensities_are_those_of_the_session_s_policy() -> None:
    env = SardineEnvironment("Static", 8)
    actor = GreedyOracle(env, 3, EPSILONS)
    observations, _ = env.reset(seed=3)
    actor.begin(np.arange(8))
    before = actor._epsilon.copy()
    greedy = env.favourites()
    drawn = [actor.act(observations, LIVE) for _ in range(2000)]
    items, propensities = (np.stack(each) for each in zip(*drawn, strict=True))
    for row, epsilon in enumerate(before):
        other = epsilon / 1000
        expected = np.where(items[:, row] == greedy[row], 1 - epsilon + other, other)
        np.testing.assert_allclose(propensities[:, row], expected, rtol=1e-5)
        share = (items[:, row] == greedy[row]).mean()
        assert share == pytest.approx(1 - epsilon + other, abs=0.05)
    assert set(before) <= set(EPSILONS)
    shown = []
    for seed in (2, 2, 3):
        env = SardineEnvironment("Static", 5)
        shown.append(play(env, GreedyOracle(env, seed, EPSILONS), 5, seed)[1]["actions"].tolist())
    assert shown[0] == shown[1] != shown[2]
    # One ε for the whole session; another may be drawn for the next.
    actor.begin(np.array([0]))
    np.testing.assert_array_equal(actor._epsilon[1:], before[1:])


def test_sessions_have_100_steps_and_earn_what_is_known() -> None:
    env = SardineEnvironment("BoredInf", 48)
    # Measured over 512 sessions, with standard deviations 3.3 and 1.4.
    for name, earned, off in (("random", 8.8, 2), ("oracle", 50.7, 1)):
        played = rollout(env, BORED_INF.behaviors[name](env, 0), 48, 0)
        assert (played.lengths == 100).all()
        assert played.returns.mean() == pytest.approx(earned, abs=off)


def test_logs_hold_propensities_and_tags(tmp_path: Path) -> None:
    env = BORED_INF.make(4, None)
    actor = BORED_INF.behaviors["mixture"](env, 1)
    named = {"env_name": "sardine-boredinf", "behavior": "mixture"}
    collect(BORED_INF, env, actor, 6, 1, tmp_path / "logs", **named)
    log = pq.read_table(tmp_path / "logs" / "sessions.parquet").to_pandas()
    assert len(log) == 600
    assert "observation" not in log
    assert log["propensity"].between(0, 1, inclusive="right").all()
    items = pq.read_table(tmp_path / "logs" / "items.parquet").to_pandas()
    assert items["tags"].map(len).between(2, 3).all()
    for topics, tags in zip(items["topics"], items["tags"], strict=True):
        assert np.flatnonzero(topics).tolist() == tags.tolist()


def test_other_environments_and_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="serves SARDINE, not SyntheticCatalog"):
        GreedyOracle(SyntheticCatalog(2), 0)
    monkeypatch.setattr(sardine, "PACKAGE", "sardine_that_is_not_installed")
    with pytest.raises(InputError, match=r"pip install 'ucfrec\[sardine\]'"):
        Environment("sardine-static").simulator().make(1, None)
