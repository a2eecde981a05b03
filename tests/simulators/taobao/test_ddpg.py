"""Logs of a DDPG agent: exact densities, what it learned from is what is logged, it learns."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from tests.support.played import play
from ucfrec.acting.rollout import Step, rollout
from ucfrec.arrays import Float32Array
from ucfrec.errors import InputError
from ucfrec.evaluation.collect import collect
from ucfrec_simulators.behaviors import truncated_normal
from ucfrec_simulators.synthetic_catalog import SyntheticCatalog
from ucfrec_simulators.taobao import ddpg
from ucfrec_simulators.taobao import synthetic as synthetic_taobao
from ucfrec_simulators.taobao.ddpg import DdpgConfig
from ucfrec_simulators.taobao.synthetic import SyntheticTaobao

QUICK = {"updates": 0.1, "batch_size": 64, "buffer_size": 20_000, "hidden": 32}
SMALL = DdpgConfig(sessions=300, snapshots=3, warm_up=160, **QUICK)
needs_sb3 = pytest.mark.skipif(
    find_spec("stable_baselines3") is None, reason="the extra collect is not installed"
)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("UCFREC_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def reference_density(actions: Float32Array, mean: Float32Array, scale: float) -> np.ndarray:
    low, high = (-1 - mean) / scale, (1 - mean) / scale
    return stats.truncnorm.pdf(actions, low, high, loc=mean, scale=scale).prod(axis=-1)


@settings(max_examples=40, deadline=None)
@given(
    mean=st.lists(st.floats(-1, 1, width=32), min_size=1, max_size=5),
    scale=st.floats(0.05, 2),
    seed=st.integers(0, 99),
)
def test_the_density_is_of_a_truncated_normal(mean: list[float], scale: float, seed: int) -> None:
    means = np.tile(np.array(mean, dtype=np.float32), (20, 1))
    actions, density = truncated_normal(means, scale, np.random.default_rng(seed))
    assert np.abs(actions).max() <= 1
    expected = reference_density(actions, means.astype(np.float64), scale)
    np.testing.assert_allclose(density, expected, rtol=1e-5)


@pytest.mark.parametrize("mean", [0.0, 0.9, -1.0])
def test_draws_follow_the_density(mean: float) -> None:
    means = np.full((20_000, 1), mean, dtype=np.float32)
    actions, _ = truncated_normal(means, 0.3, np.random.default_rng(0))
    law = stats.truncnorm((-1 - mean) / 0.3, (1 - mean) / 0.3, loc=mean, scale=0.3)
    assert stats.kstest(actions[:, 0], law.cdf).pvalue > 1e-3


@needs_sb3
def test_what_it_learns_from_is_what_is_logged() -> None:
    env = SyntheticTaobao(16)
    agent = ddpg.Training(env, 0, SMALL)
    steps: list[Step] = []
    rollout(env, agent, 200, 0, steps.append)
    buffer, high = agent._model.replay_buffer, env.single_observation_space.high
    # All but the very last step, whose outcome no one waited for.
    logged = {
        name: np.concatenate([getattr(step, name) for step in steps[:-1]])
        for name in ("observations", "actions", "rewards", "terminated", "next_observations")
    }
    learned = len(logged["rewards"])
    assert buffer.pos == learned > 1000
    held = {name: getattr(buffer, name)[:learned, 0] for name in ("observations", "actions")}
    np.testing.assert_allclose(held["observations"] * high, logged["observations"], atol=1e-5)
    np.testing.assert_array_equal(held["actions"], logged["actions"])
    np.testing.assert_allclose(buffer.rewards[:learned, 0] * 10, logged["rewards"], atol=1e-5)
    np.testing.assert_array_equal(buffer.dones[:learned, 0] > 0, logged["terminated"])
    after, goes_on = buffer.next_observations[:learned, 0] * high, ~logged["terminated"]
    np.testing.assert_allclose(after[goes_on], logged["next_observations"][goes_on], atol=1e-5)


class Slope(SyntheticTaobao):
    """Clicks rise linearly towards one corner of the box: 0.5 to 9.5 per page, 5 at random."""

    corner = np.where(np.arange(27) % 3 == 0, -1.0, 1.0)

    def _click_probability(self, users: Any, pages: Any, actions: Any) -> Any:
        return 0.5 + 0.45 * (actions * self.corner).mean(axis=1)


@needs_sb3
@pytest.mark.slow
def test_it_learns() -> None:
    config = DdpgConfig(warm_up=3000, updates=1 / 16, batch_size=128, hidden=64)
    env = Slope(128)
    clicks = play(env, ddpg.Training(env, 0, config), 1500, 0)[1]["rewards"]
    assert clicks[:3000].mean() == pytest.approx(5, abs=0.2)
    assert clicks[-2000:].mean() > 7


@needs_sb3
def test_a_log_of_the_training_holds_its_densities(tmp_path: Path) -> None:
    env = SyntheticTaobao(16)
    actor = ddpg.Training(env, 0, SMALL)
    simulator = synthetic_taobao.SIMULATOR
    collect(simulator, env, actor, 200, 0, tmp_path / "logs", env_name="e", behavior="b")
    log = pq.read_table(tmp_path / "logs" / "sessions.parquet").to_pandas()
    density = log["propensity"].to_numpy()
    warm = SMALL.warm_up
    np.testing.assert_allclose(density[:warm], 0.5**27)
    assert (density[warm:] != np.float32(0.5**27)).all()


@needs_sb3
@pytest.mark.slow
def test_each_session_is_served_by_one_snapshot() -> None:
    env = SyntheticTaobao(16)
    networks = ddpg.snapshots(env, 0, SMALL)
    _, steps = play(env, ddpg.snapshot_mixture(env, 0, SMALL), 150, 0)
    scaled = steps["observations"] / env.single_observation_space.high
    means = [ddpg._forward(network, scaled) for network in networks]
    densities = [reference_density(steps["actions"], mean, SMALL.noise) for mean in means]
    explains = np.isclose(densities, steps["propensities"], rtol=1e-3)
    of = [steps["episodes"] == e for e in range(150)]
    servers = [np.flatnonzero(explains[:, own].all(axis=1)) for own in of]
    assert all(len(server) == 1 for server in servers)
    counts = np.bincount(np.concatenate(servers), minlength=3)
    assert (np.abs(counts - 50) < 4 * np.sqrt(150 * 2 / 9)).all()


@needs_sb3
@pytest.mark.slow
def test_a_training_is_kept_and_its_seed_and_environment_decide_it(cache: Path) -> None:
    def weights(environment: int, seed: int) -> np.ndarray:
        env = SyntheticTaobao(16, environment_seed=environment)
        networks = ddpg.snapshots(env, seed, SMALL)
        return np.stack([network[4].weight.detach().numpy().copy() for network in networks])

    first = weights(0, 0)
    (file,) = cache.iterdir()
    written = file.stat().st_mtime_ns
    np.testing.assert_array_equal(first, weights(0, 0))
    assert file.stat().st_mtime_ns == written
    file.unlink()
    np.testing.assert_array_equal(first, weights(0, 0))
    for environment, seed in ((0, 1), (1, 0)):
        assert not np.array_equal(first, weights(environment, seed))
    assert len(list(cache.iterdir())) == 3


def test_other_environments_are_refused() -> None:
    for make in ddpg.BEHAVIORS.values():
        with pytest.raises(InputError, match="serves Taobao environments"):
            make(SyntheticCatalog(2), 0)
