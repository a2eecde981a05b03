"""VirtualTaobao against the published dynamics, transcribed here one session at a time."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from tests.support.real_data import data_folder
from ucfrec.acting.rollout import Episodes, rollout
from ucfrec.errors import InputError
from ucfrec_simulators.taobao import environment
from ucfrec_simulators.taobao.virtual import SIMULATOR, VirtualTaobao

pytestmark = pytest.mark.realdata
GROUPS = [(0, 8), (8, 16), (16, 27), (27, 38), (38, 49), (49, 60)]
GROUPS += [(60, 62), (62, 64), (64, 67), (67, 85), (85, 88)]


@pytest.fixture(scope="module")
def folder() -> Path:
    torch.set_num_threads(1)
    return data_folder("virtualtaobao")


def forward(weights: dict[str, torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    layers = sorted({int(key.split(".")[0]) for key in weights})
    for position, layer in enumerate(layers):
        x = weights[f"{layer}.weight"] @ x + weights[f"{layer}.bias"]
        if position < len(layers) - 1:
            x = F.leaky_relu(x)
    return x


def pick(logits: torch.Tensor, uniform: float) -> int:
    cumulative = np.cumsum(F.softmax(logits, dim=0).numpy().astype(np.float64))
    return int(np.searchsorted(cumulative / cumulative[-1], uniform, side="right"))


class Original:
    """One session of VirtualTB-v0, fed with uniforms instead of torch.multinomial."""

    def __init__(self, folder: Path) -> None:
        self.networks = {
            name: torch.load(folder / f"{name}_model.pt", weights_only=True)
            for name in ("generator", "leave", "action")
        }

    def reset(self, noise: np.ndarray, attributes: np.ndarray, stay: float) -> np.ndarray:
        logits = forward(self.networks["generator"], torch.from_numpy(noise))
        self.user = np.zeros(88, dtype=np.float32)
        for (first, last), uniform in zip(GROUPS, attributes, strict=True):
            self.user[first + pick(logits[first:last], uniform)] = 1
        self.leave = pick(forward(self.networks["leave"], torch.from_numpy(self.user)), stay)
        self.last, self.page = [0, 0], 0
        return self.state()

    def state(self) -> np.ndarray:
        return np.concatenate([self.user, self.last, [self.page]])

    def step(self, action: np.ndarray, uniforms: np.ndarray) -> tuple[np.ndarray, int, bool]:
        x = np.concatenate([self.user, [self.page], action]).astype(np.float32)
        logits = forward(self.networks["action"], torch.from_numpy(x))
        self.last = [pick(logits[:11], uniforms[0]), pick(logits[11:], uniforms[1])]
        self.page += 1
        return self.state(), self.last[0], self.page >= self.leave


def test_every_step_agrees_with_the_original(folder: Path) -> None:
    n, steps = 5, 60
    env = VirtualTaobao(folder, num_envs=n)
    originals = [Original(folder) for _ in range(n)]
    draws = np.random.default_rng(7)

    def restart(rows: list[int]) -> list[np.ndarray]:
        noise = draws.random((len(rows), 128), dtype=np.float32)
        starts = zip(noise, draws.random((len(rows), 11)), draws.random(len(rows)), strict=True)
        return [originals[row].reset(*start) for row, start in zip(rows, starts, strict=True)]

    observations, _ = env.reset(seed=7)
    np.testing.assert_array_equal(observations, restart(list(range(n))))
    actor = np.random.default_rng(1)
    ends = 0
    for _ in range(steps):
        # Small actions get clicks now and then, so that more than zeros are compared.
        actions = actor.normal(0, 0.1, (n, 27)).astype(np.float32)
        observations, rewards, terminated, truncated, info = env.step(actions)
        uniforms = draws.random((n, 2))
        expected = [originals[i].step(actions[i], uniforms[i]) for i in range(n)]
        assert rewards.tolist() == [clicks for _, clicks, _ in expected]
        assert terminated.tolist() == [done for *_, done in expected]
        assert not truncated.any()
        ended = np.flatnonzero(terminated).tolist()
        ends += len(ended)
        after = [state for state, *_ in expected]
        for row in ended:
            np.testing.assert_array_equal(info["final_obs"][row], after[row])
        for row, state in zip(ended, restart(ended) if ended else [], strict=True):
            after[row] = state
        np.testing.assert_array_equal(observations, after)
    assert ends > 20


def test_expected_clicks_are_those_of_the_published_network(folder: Path) -> None:
    env = VirtualTaobao(folder)
    generator = np.random.default_rng(3)
    users, lengths = env.sample_users(50, generator)
    pages = np.minimum(lengths - 1, 9)
    actions = generator.uniform(-0.3, 0.3, (50, 27)).astype(np.float32)
    weights = torch.load(folder / "action_model.pt", weights_only=True)
    inputs = np.concatenate([users, pages[:, None], actions], axis=1).astype(np.float32)
    expected = [
        float(F.softmax(forward(weights, torch.from_numpy(x))[:11], dim=0) @ torch.arange(11.0))
        for x in inputs
    ]
    # Logits reach the hundreds, so float32 summed in another order moves the fourth digit.
    clicks = env.expected_clicks(users, pages, actions)
    np.testing.assert_allclose(clicks, expected, rtol=1e-3, atol=1e-3)
    assert max(expected) > 1


def played(folder: Path, behavior: str, episodes: int, seed: int = 0) -> Episodes:
    env = SIMULATOR.make(256, folder)
    return rollout(env, SIMULATOR.behaviors[behavior](env, seed), episodes, seed)


@pytest.mark.parametrize(
    ("behavior", "low", "high"), [("zero", 0.56, 0.59), ("random", 0.18, 0.195)]
)
def test_known_clicks_per_page(folder: Path, behavior: str, low: float, high: float) -> None:
    episodes = played(folder, behavior, 10_000)
    ratio = episodes.returns.sum() / episodes.lengths.sum()
    # The 95% interval of a ratio of sums over independent sessions.
    spread = np.std(episodes.returns - ratio * episodes.lengths) / episodes.lengths.mean()
    half = 1.96 * spread / np.sqrt(len(episodes.returns))
    assert half < 0.025
    assert low - half < ratio < high + half


@pytest.mark.slow
def test_the_best_constant_is_near_the_ceiling_and_the_mixture_varied(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = environment.best_constant(VirtualTaobao(folder), 0)
    monkeypatch.setattr(environment, "best_constant", lambda env, seed: found)
    best, mixed = (played(folder, behavior, 4000) for behavior in ("best-constant", "mixture"))
    assert np.median(best.lengths) == 4
    assert abs(best.lengths.mean() - 7.7) < 0.6
    assert best.returns.sum() / best.lengths.sum() > 9.9
    rates = mixed.returns / mixed.lengths
    assert 0.6 < mixed.returns.sum() / mixed.lengths.sum() < 2.5
    assert np.quantile(rates, 0.25) < 0.5
    assert np.quantile(rates, 0.95) > 2.5


def test_missing_or_broken_networks_are_named(folder: Path, tmp_path: Path) -> None:
    for name in ("generator_model.pt", "leave_model.pt", "action_model.pt"):
        shutil.copyfile(folder / name, tmp_path / name)
    action = tmp_path / "action_model.pt"
    whole, leave = action.read_bytes(), (tmp_path / "leave_model.pt").read_bytes()
    for contents in (whole[: len(whole) // 2], b"", b"not a network", leave):
        action.write_bytes(contents)
        with pytest.raises(InputError, match=r"action_model\.pt is not the published network"):
            VirtualTaobao(tmp_path)
    action.unlink()
    with pytest.raises(InputError, match=r"action_model\.pt is missing; put the file"):
        VirtualTaobao(tmp_path)
