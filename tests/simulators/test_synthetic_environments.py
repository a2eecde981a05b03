"""The environments whose best policy is known: that it is, and that it is the best."""

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import pytest

from tests.support.played import play
from tests.support.single_session import check_environment
from ucfrec.acting.rollout import Episodes, rollout
from ucfrec.errors import InputError
from ucfrec.evaluation.simulator import Simulator
from ucfrec_simulators import synthetic_catalog
from ucfrec_simulators.session_env import SessionsEnv
from ucfrec_simulators.synthetic_catalog import SoftmaxGuess, SyntheticCatalog, mixture
from ucfrec_simulators.taobao import synthetic as synthetic_taobao
from ucfrec_simulators.taobao.environment import split_observations
from ucfrec_simulators.taobao.synthetic import SyntheticTaobao

TAOBAO, CATALOG = synthetic_taobao.SIMULATOR, synthetic_catalog.SIMULATOR


def played(simulator: Simulator, behavior: str, episodes: int, seed: int = 0) -> Episodes:
    env = simulator.make(256, None)
    return rollout(env, simulator.behaviors[behavior](env, seed), episodes, seed)


@pytest.mark.parametrize("simulator", [TAOBAO, CATALOG])
def test_gymnasium_accepts_it_and_seeds_decide_it(simulator: Simulator) -> None:
    check_environment(simulator.make(1, None))
    first, again, other = (played(simulator, "mixture", 400, seed) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.returns, again.returns)
    assert not np.array_equal(first.returns, other.returns)


@pytest.mark.parametrize("environment", [SyntheticTaobao(8), SyntheticCatalog(8)])
def test_an_ended_session_is_replaced_within_the_step(environment: SessionsEnv) -> None:
    before, _ = environment.reset(seed=0)
    environment.action_space.seed(0)
    ends = 0
    for _ in range(40):
        after, _, terminated, truncated, info = environment.step(environment.action_space.sample())
        ended = terminated | truncated
        ends += ended.sum()
        final = info.get("final_obs", np.full(8, None))
        assert [row is not None for row in final] == ended.tolist()
        for row in np.flatnonzero(ended):
            # A session's user never changes; its successor is another user.
            np.testing.assert_array_equal(final[row][:12], before[row][:12])
            assert not np.array_equal(final[row], after[row])
        before = after
    assert ends > 10


def test_no_action_beats_the_optimal_one_which_depends_on_user_and_page() -> None:
    env = SyntheticTaobao()
    users, lengths = env.sample_users(300, np.random.default_rng(8))
    pages = np.random.default_rng(9).integers(0, lengths)
    best = env.best_actions(users, pages)
    assert np.abs(best - env.best_actions(np.roll(users, 1, axis=0), pages)).mean() > 0.1
    assert np.abs(best - env.best_actions(users, pages + 10)).mean() > 0.03
    top = env.expected_clicks(users, pages, best)
    np.testing.assert_allclose(top, 9.0)
    assert np.abs(best).max() < 1
    generator = np.random.default_rng(10)
    for size in (1e-3, 0.1, 1.0):
        moved = best + size * generator.standard_normal(best.shape).astype(np.float32)
        assert (env.expected_clicks(users, pages, np.clip(moved, -1, 1)) < top).all()
    observations = np.column_stack([users, np.zeros((300, 2)), pages]).astype(np.float32)
    np.testing.assert_array_equal(env.optimal_actions(observations), best)
    np.testing.assert_array_equal(split_observations(observations)[1], pages)


def test_taobao_behaviors_are_ordered_and_expectations_are_those_played() -> None:
    rates = {}
    for behavior in ("random", "zero", "best-constant", "mixture", "optimal"):
        episodes = played(TAOBAO, behavior, 1000)
        rates[behavior] = episodes.returns.sum() / episodes.lengths.sum()
    assert rates["random"] * 3 < rates["zero"] < rates["best-constant"]
    assert rates["random"] * 3 < rates["mixture"] < rates["best-constant"] / 2
    assert rates["best-constant"] < rates["optimal"] / 2
    assert abs(rates["optimal"] - 9.0) < 0.05


def optimal_returns(env: SyntheticCatalog) -> np.ndarray:
    """(n_users,) expected return of `Rotation` for each user."""
    chances = env.click_probabilities
    best = np.take_along_axis(chances, env.favourites(chances), axis=1)
    ranks = np.arange(env.max_turn - 1) % env.boredom_window
    return best[:, ranks].sum(axis=1) + best[:, 0]


@pytest.mark.parametrize("max_turn", [1, 2, 5])
def test_rotation_is_optimal_by_brute_force(max_turn: int) -> None:
    env = SyntheticCatalog(
        1, n_items=6, n_tags=4, n_users=3, boredom_window=3, max_turn=max_turn, environment_seed=5
    )
    best = np.zeros(3)
    for items in product(range(6), repeat=max_turn):
        shown = 0
        for shown in range(1, max_turn + 1):
            recent = [env.tags[item] for item in items[max(0, shown - 3) : shown - 1]]
            if env.tags[items[shown - 1]] in recent:
                break
        best = np.maximum(best, env.click_probabilities[:, items[:shown]].sum(axis=1))
    np.testing.assert_allclose(optimal_returns(env), best)


def test_rotation_earns_its_expected_return() -> None:
    env = SyntheticCatalog(200)
    actor = CATALOG.behaviors["optimal"](env, 0)
    episodes, steps = play(env, actor, 1000, 3)
    assert (episodes.lengths == env.max_turn).all()
    served = steps["user_ids"][np.unique(steps["episodes"], return_index=True)[1]]
    luck = episodes.returns.sum() - optimal_returns(env)[served].sum()
    assert abs(luck) < 4 * np.sqrt(0.25 * episodes.lengths.sum())


def test_boredom_against_a_plain_reading_of_the_rule() -> None:
    env = SyntheticCatalog(16, n_tags=5, boredom_window=4, max_turn=7)
    env.reset(seed=2)
    generator = np.random.default_rng(0)
    shown: list[list[int]] = [[] for _ in range(16)]
    bored_ends = capped_ends = 0
    for _ in range(400):
        actions = generator.integers(200, size=16)
        users = env.users.copy()
        _, _, terminated, truncated, info = env.step(actions)
        for row, history in enumerate(shown):
            tag = int(env.tags[actions[row]])
            bored = tag in history[-3:]
            history.append(tag)
            assert terminated[row] == bored
            assert truncated[row] == (len(history) == 7 and not bored)
            ended = terminated[row] or truncated[row]
            assert (info["final_info"] if ended else info)["user_id"][row] == users[row]
            if ended:
                history.clear()
        bored_ends += terminated.sum()
        capped_ends += truncated.sum()
    assert min(bored_ends, capped_ends) > 20


def test_clicks_have_the_stated_probability() -> None:
    env = SyntheticCatalog(6000, n_users=3)
    env.reset(seed=0)
    users = env.users.copy()
    _, clicks, *_ = env.step(np.full(6000, 17))
    for user in range(3):
        chance = 1 / (1 + np.exp(-env.logits[user, 17]))
        group = clicks[users == user]
        assert abs(group.mean() - chance) < 4 * np.sqrt(chance * (1 - chance) / len(group))


def test_propensities_are_exact() -> None:
    env = SyntheticCatalog(20_000, n_items=24, n_users=1)
    env.reset(seed=0)
    guess = SoftmaxGuess(env, 0, error=1.0, temperature=0.7, epsilon=0.2, variety=2.0)
    probabilities = guess.probabilities()
    np.testing.assert_allclose(probabilities.sum(axis=1), 1.0)
    chosen, propensity = guess.act(np.zeros((20_000, 0)), np.ones(20_000, dtype=bool))
    np.testing.assert_allclose(propensity, probabilities[0, chosen], rtol=1e-6)
    shares = np.bincount(chosen, minlength=24) / 20_000
    sigma = np.sqrt(probabilities[0] * (1 - probabilities[0]) / 20_000)
    assert (np.abs(shares - probabilities[0]) < 4.5 * sigma).all()


def test_the_mixture_reports_the_propensity_of_the_actor_in_charge() -> None:
    env = SyntheticCatalog(500)
    observations, _ = env.reset(seed=0)
    actor = mixture(env, 0)
    actor.begin(np.arange(500))
    _, propensity = actor.act(observations, np.ones(500, dtype=bool))
    uniform = actor.component == 0
    np.testing.assert_allclose(propensity[uniform], 1 / 200)
    assert propensity[~uniform].mean() > 3 / 200
    assert np.bincount(actor.component).min() > 50


def test_catalog_behaviors_are_ordered_and_items_described() -> None:
    means = {name: played(CATALOG, name, 3000).returns.mean() for name in CATALOG.behaviors}
    assert means["random"] * 2 < means["mixture"] < means["popular"] < means["optimal"] - 2
    env = SyntheticCatalog(1)
    tags = env.item_features().to_pandas().filter(like="tag_").to_numpy()
    np.testing.assert_array_equal(tags.argmax(axis=1), env.tags)


@pytest.mark.parametrize(
    ("use", "says"),
    [
        (lambda: SyntheticCatalog(1, n_tags=3), "boredom_window"),
        (lambda: CATALOG.behaviors["optimal"](SyntheticTaobao(1), 0), "not SyntheticTaobao"),
        (lambda: stepped(SyntheticCatalog(2), [0, 200]), "from 0 to 199"),
        (lambda: stepped(SyntheticCatalog(2), [-1, 0]), "from 0 to 199"),
        (lambda: stepped(SyntheticCatalog(2), [0.5, 1.0]), "from 0 to 199"),
        (lambda: stepped(SyntheticTaobao(2), np.zeros((2, 26), np.float32)), "shape"),
        (lambda: stepped(SyntheticTaobao(2), np.full((2, 27), np.nan, np.float32)), "finite"),
    ],
)
def test_bad_input_is_refused(use: Callable[[], object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        use()


def stepped(env: SessionsEnv, actions: Any) -> object:
    env.reset(seed=0)
    return env.step(np.asarray(actions))
