"""The Kuaishou environments against a plain reading of their rules, one user at a time."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.played import play
from tests.support.single_session import check_environment
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.policy_actor import PolicyActor
from ucfrec.acting.rollout import Uniform, rollout
from ucfrec.acting.scorer import Scorer
from ucfrec.episodes.states import ItemStates
from ucfrec.errors import InputError
from ucfrec.evaluation.collect import collect
from ucfrec.evaluation.evaluate import _item_numbers
from ucfrec.evaluation.simulator import Environment, Simulator
from ucfrec.policies.dt import DTConfig, DTPolicy
from ucfrec_simulators.behaviors import repeat_action
from ucfrec_simulators.kuai.behaviors import MASK, Oracle, RandomMask
from ucfrec_simulators.kuai.environment import EXITS, REGIMES, ExitRule, KuaiEnv
from ucfrec_simulators.kuai.logs import sessions_by_exit

# Some published rules are equal.
RULES = [replace(rule, sliced=s) for rule in dict.fromkeys(EXITS.values()) for s in (False, True)]


class Plain:
    """One session as the published code simulates it, its slices included."""

    def __init__(self, tags: list[tuple[int, ...]], rule: ExitRule) -> None:
        self.tags, self.rule, self.shown = tags, rule, list[int]()

    def step(self, item: int) -> tuple[bool, bool]:
        """Whether the user leaves by the rule, and whether the session is over."""
        t, rule = len(self.shown), self.rule
        first = t - rule.window if rule.sliced else max(0, t - rule.window)
        pooled = Counter(tag for shown in self.shown[first:t] for tag in self._of(shown))
        self.shown.append(item)
        bored = t > 0 and any(pooled[tag] > rule.threshold for tag in self._of(item))
        return bored, bored or t >= rule.max_turn - 1

    def _of(self, item: int) -> tuple[int, ...]:
        return self.tags[item] or (-1,)


@st.composite
def environments(draw: st.DrawFn) -> tuple[np.ndarray, list[tuple[int, ...]]]:
    n_items, n_tags = draw(st.integers(2, 40)), draw(st.integers(1, 30))
    rng = np.random.default_rng(draw(st.integers(0, 999)))
    sizes = rng.integers(0, min(4, n_tags) + 1, size=n_items)
    tags = [tuple(rng.choice(n_tags, size=size, replace=False).tolist()) for size in sizes]
    return rng.random((draw(st.integers(1, 5)), n_items)).astype(np.float32), tags


@pytest.mark.parametrize("rule", RULES, ids=str)
@settings(max_examples=12)
@given(environment=environments(), seed=st.integers(0, 999))
def test_every_exit_agrees_with_a_plain_reading(
    rule: ExitRule, environment: tuple[np.ndarray, list[tuple[int, ...]]], seed: int
) -> None:
    rewards, tags = environment
    env = KuaiEnv(4, rewards, tags, rule)
    env.reset(seed=seed)
    sessions = [Plain(tags, rule) for _ in range(4)]
    actor = np.random.default_rng(seed)
    # From few items to all of them: long sessions as well as short ones.
    few = actor.integers(len(tags), size=actor.integers(1, len(tags) + 1))
    for _ in range(rule.max_turn + 5):
        actions, users = actor.choice(few, size=4), env.users.copy()
        boring = env.boring()[np.arange(4), actions]
        _, paid, terminated, truncated, _ = env.step(actions)
        expected = [session.step(item) for session, item in zip(sessions, actions, strict=True)]
        np.testing.assert_array_equal(paid, rewards[users, actions])
        assert list(zip(terminated, terminated | truncated, strict=True)) == expected
        np.testing.assert_array_equal(boring, terminated)
        ends = [over for _, over in expected]
        sessions = [Plain(tags, rule) if e else s for s, e in zip(sessions, ends, strict=True)]


def small(num_envs: int = 6, items: int = 40, rule: str = "dorl", regime: str = "FB") -> KuaiEnv:
    rng = np.random.default_rng(3)
    tags = [(int(t),) if t else () for t in rng.integers(0, 6, size=items)]
    rewards = rng.random((7, items)).astype(np.float32)
    ids = np.arange(7) * 10 + 5, np.arange(items)[::-1] * 3 + 100
    return KuaiEnv(num_envs, rewards, tags, EXITS[rule], REGIMES[regime], *ids)


def test_gymnasium_accepts_it() -> None:
    check_environment(small(1))
    check_environment(small(1, 5000, regime="NX_0"))


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("choose", [Uniform, Oracle, RandomMask])
def test_regimes_mask_and_end_as_stated(regime: str, choose: Any) -> None:
    env = small(regime=regime)
    played, steps = play(env, choose(env, 0), 60, seed=1)
    shown = [steps["actions"][steps["episodes"] == e] for e in range(60)]
    repeats = any(len(set(s.tolist())) < len(s) for s in shown)
    assert (played.lengths == 10).all() if regime == "NX_10" else played.lengths.max() <= 30
    # Seven tags and a memory of ten: everybody is bored by the eighth item.
    assert repeats or regime != "FB" or choose is not Uniform
    assert not repeats or regime == "FB"
    assert set(steps["user_ids"]) <= set((np.arange(7) * 10 + 5).tolist())


def test_random_items_have_no_tag_of_the_last_ten_and_are_otherwise_uniform() -> None:
    tags_of = [(n % 20,) for n in range(40)]
    env = KuaiEnv(4000, np.ones((1, 40), np.float32), tags_of, EXITS["dorl-main"], REGIMES["FB"])
    env.reset(seed=0)
    actor, tags = RandomMask(env, 3), []
    for _ in range(12):
        items, _ = actor.act(np.zeros((4000, 2)), np.ones(4000, dtype=np.bool_))
        tags.append(items % 20)
        env.step(items)
    assert all(len(set(session)) == 11 for session in np.stack(tags[:11]).T)
    left = np.array([len(set(session)) for session in np.stack(tags).T])
    assert (left == 11).any(), "the eleventh tag before may come again"
    counts = np.bincount(np.concatenate(tags), minlength=20) / (12 * 4000)
    assert counts == pytest.approx(0.05, abs=0.005)
    assert not env.boring(MASK).all(axis=1).any()


def test_what_does_not_fit_a_masked_item_and_a_deaf_actor_are_refused() -> None:
    with pytest.raises(InputError, match="5 items are too few for a session of 10"):
        small(1, items=5, regime="NX_10")
    env = small(2, regime="NX_10")
    env.reset(seed=0)
    env.step(np.array([3, 4]))
    with pytest.raises(InputError, match=r"1 of 2 sessions repeat an item \(such as 4\)"):
        env.step(np.array([5, 4]))
    with pytest.raises(InputError, match="which Rule ignores"):
        rollout(env, repeat_action(np.zeros(1, np.float32)), 2, 0)


@pytest.mark.parametrize("regime", REGIMES)
def test_a_policy_plays_what_is_there_and_allowed(regime: str) -> None:
    env = small(4, regime=regime)
    numbers = np.concatenate([np.arange(39, 4, -1), [-1] * 6])
    embeddings = torch.randn(len(numbers), 3, generator=torch.Generator().manual_seed(0))
    user_ids = np.array([5, 25, 1000])
    states = ItemStates(embeddings, torch.eye(3), 0.0, 1.0)
    torch.manual_seed(0)
    sizes = {"state": states.size, "action": 3, "items": len(numbers)}
    policy = DTPolicy(DTConfig(context=3, dim=8), sizes).eval()
    with torch.no_grad():
        policy.head.bias[-6:] = 100.0  # what it would most like to play is not there
    actor = PolicyActor(Scorer(policy, DecisionRule(5.0), states), 4, 0, states, numbers, user_ids)
    played = rollout(env, actor, 9, seed=0)
    assert len(played.lengths) == 9
    assert (played.lengths == 10).all() == (regime == "NX_10")
    actor.inform({"user_id": np.array([25, 5, 7, 1000])})
    assert actor._sessions.users.tolist() == [1, 0, -1, 2]


@pytest.mark.parametrize("rule", RULES, ids=str)
def test_logs_are_cut_where_their_users_would_have_left(rule: ExitRule) -> None:
    rng = np.random.default_rng(5)
    sizes = rng.integers(0, 3, size=30)
    tags = [tuple(rng.choice(9, size=size, replace=False).tolist()) for size in sizes]
    users = np.repeat(rng.permutation(12), rng.integers(1, 80, size=12))
    items = rng.integers(30, size=len(users))
    expected, number = [], -1
    session, owner, over = Plain(tags, rule), -1, True
    for user, item in zip(users, items, strict=True):
        if over or user != owner:
            session, owner, number = Plain(tags, rule), user, number + 1
        _, over = session.step(item)
        expected.append(number)
    np.testing.assert_array_equal(sessions_by_exit(users, items, tags, rule), expected)


def known_items(ids: list[Any]) -> Any:
    record = SimpleNamespace(sizes={"items": len(ids), "action": 3}, observation_size=0)
    return SimpleNamespace(record=record, item_ids=np.array(ids), logged_observation_size=0)


def test_items_are_found_by_what_the_logs_call_them(tmp_path: Path) -> None:
    env = small()  # item 0 is called 217, item 39 is called 100
    numbers = _item_numbers(Environment("kuai"), env, known_items([1, 100, 103, 104, 217]))
    assert numbers.tolist() == [-1, 39, 38, -1, 0]
    for wrong in ([1, 2], ["100"]):
        with pytest.raises(InputError, match="which the policy was not trained on"):
            _item_numbers(Environment("kuai"), env, known_items(wrong))
    simulator = Simulator("", lambda n, folder: env, {}, "pay")
    collect(simulator, env, Uniform(env, 0), 20, 0, tmp_path / "logs", env_name="", behavior="")
    log = pd.read_parquet(tmp_path / "logs" / "sessions.parquet")
    users, items = np.searchsorted(env.user_ids, log["user_id"]), (217 - log["item_id"]) // 3
    paid = env.rewards[users, items.to_numpy()]
    np.testing.assert_array_equal(paid, log["pay"])
