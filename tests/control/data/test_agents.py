"""Saved agents act as Stable-Baselines3 lets them act, and nothing in their files is executed."""

import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

pytest.importorskip("stable_baselines3", reason="the extra collect is not installed")
pytest.importorskip("mujoco", reason="the extra control is not installed")
import gymnasium
import stable_baselines3 as sb3
from torch import nn

from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec_control.cli import main
from ucfrec_control.data import agents
from ucfrec_control.data.agents import read_agent
from ucfrec_control.data.d4rl import read_d4rl

OBSERVATIONS = 4
SPACE = Box(np.float32([-1, -3]), np.float32([2, 3]))


class _Environment(gymnasium.Env[Any, Any]):
    observation_space = Box(-np.inf, np.inf, (OBSERVATIONS,), np.float32)
    action_space = SPACE


AGENTS = {
    "sac": (sb3.SAC, {}),
    "sac-sde": (sb3.SAC, {"use_sde": True}),
    "td3": (sb3.TD3, {"policy_kwargs": {"net_arch": [8, 6]}}),
    "ddpg": (sb3.DDPG, {"policy_kwargs": {"activation_fn": nn.ELU}}),
    "ppo": (sb3.PPO, {"policy_kwargs": {"activation_fn": nn.ReLU, "net_arch": [7]}}),
    "a2c": (sb3.A2C, {}),
}


def saved(folder: Path, name: str) -> tuple[Path, Any]:
    kind, settings = AGENTS[name]
    small = {"buffer_size": 10} if name in ("sac", "sac-sde", "td3", "ddpg") else {}
    model = kind("MlpPolicy", _Environment(), seed=0, device="cpu", **small, **settings)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter += 0.3 * torch.randn_like(parameter)
    model.save(folder / name)
    return folder / f"{name}.zip", model


@pytest.mark.parametrize("name", AGENTS)
def test_an_agent_acts_as_its_library_lets_it(name: str, tmp_path: Path) -> None:
    file, model = saved(tmp_path, name)
    seen = np.random.default_rng(0).normal(size=(50, OBSERVATIONS)).astype(np.float32)
    agent = read_agent(file, OBSERVATIONS, SPACE, 0.0, 0)
    found, propensities = agent.act(seen, np.ones(50, dtype=bool))
    expected, _ = model.predict(seen, deterministic=True)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert propensities is None
    noisy, _ = read_agent(file, OBSERVATIONS, SPACE, 0.2, 0).act(seen, np.ones(50, dtype=bool))
    again, _ = read_agent(file, OBSERVATIONS, SPACE, 0.2, 0).act(seen, np.ones(50, dtype=bool))
    np.testing.assert_array_equal(noisy, again)
    assert (noisy != found).any()
    assert (noisy >= SPACE.low).all()
    assert (noisy <= SPACE.high).all()


class _Trap:
    """Writes a file when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> Any:
        return Path.touch, (self.file,)


def rewritten(file: Path, out: Path, **parts: bytes | None) -> Path:
    """A copy of a zip file with some parts replaced, or excluded."""
    changed = {name.replace("_", "."): content for name, content in parts.items()}
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            content = changed.get(name, old.read(name))
            if content is not None:
                new.writestr(name, content)
    return out


def test_nothing_in_the_file_is_executed(tmp_path: Path) -> None:
    file, _ = saved(tmp_path, "sac")
    trap, sprung = _Trap(tmp_path / "sprung"), tmp_path / "sprung"
    weights = io.BytesIO()
    torch.save({"actor.mu.weight": trap}, weights)
    for tensors in (pickle.dumps(trap), weights.getvalue()):
        bad = rewritten(file, tmp_path / "bad.zip", policy_pth=tensors)
        with pytest.raises(InputError, match="cannot be read as data"):
            read_agent(bad, OBSERVATIONS, SPACE, 0.0, 0)
    with zipfile.ZipFile(file) as archive:
        data = json.loads(archive.read("data"))
    serialized = pickle.dumps(trap).hex()
    everything = {name: {":type:": "x", ":serialized:": serialized} for name in data}
    odd = rewritten(file, tmp_path / "odd.zip", data=json.dumps(everything).encode())
    read_agent(odd, OBSERVATIONS, SPACE, 0.0, 0)
    assert not sprung.exists()


def test_what_cannot_be_told_is_refused_with_the_reason(tmp_path: Path) -> None:
    file, _ = saved(tmp_path, "td3")
    with pytest.raises(InputError, match="observations of size 4 to actions of size 2"):
        read_agent(file, 5, SPACE, 0.0, 0)
    with pytest.raises(InputError, match="does not exist"):
        read_agent(tmp_path / "none.zip", OBSERVATIONS, SPACE, 0.0, 0)
    (tmp_path / "text.zip").write_text("no zip")
    none = rewritten(file, tmp_path / "none.zip", policy_pth=None)
    for bad in (tmp_path / "text.zip", none):
        with pytest.raises(InputError, match="cannot be read as data"):
            read_agent(bad, OBSERVATIONS, SPACE, 0.0, 0)
    with zipfile.ZipFile(file) as archive:
        tensors = torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=True)
        data = json.loads(archive.read("data"))
    for change, reason in (
        ({"actor.mu.1.running_mean": torch.zeros(8)}, "not a layer of a perceptron"),
        ({name: None for name in tensors if name.startswith("actor.mu")}, "not those of a"),
    ):
        kept = {k: v for k, v in {**tensors, **change}.items() if v is not None}
        torch.save(kept, weights := io.BytesIO())
        bad = rewritten(file, tmp_path / "bad.zip", policy_pth=weights.getvalue())
        with pytest.raises(InputError, match=reason):
            read_agent(bad, OBSERVATIONS, SPACE, 0.0, 0)
    data["policy_kwargs"] = {"activation_fn": "<class 'somebody.Else'>"}
    bad = rewritten(file, tmp_path / "bad.zip", data=json.dumps(data).encode())
    with pytest.raises(InputError, match="its activation is"):
        read_agent(bad, OBSERVATIONS, SPACE, 0.0, 0)


@pytest.mark.parametrize(
    ("name", "tensor", "reason"),
    [
        ("actor.latent_pi.2.weight", torch.zeros(1).expand(300_000, 300_000), "one by one"),
        ("actor.latent_pi.2.weight", torch.full((256, 256), torch.nan), "one by one"),
        ("actor.latent_pi.2.weight", torch.eye(256).to_sparse(), "one by one"),
        ("actor.latent_pi.2.bias", torch.zeros(256, dtype=torch.complex64), "one by one"),
        ("actor.latent_pi.2.weight", torch.zeros(256, 255), "256 outputs, .* 255 inputs"),
    ],
)
def test_tensors_that_are_no_network_are_refused(
    name: str, tensor: torch.Tensor, reason: str, tmp_path: Path
) -> None:
    file, _ = saved(tmp_path, "sac-sde")
    with zipfile.ZipFile(file) as archive:
        tensors = torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=True)
    if len(tensor) > 256:
        tensors["actor.latent_pi.2.bias"] = torch.zeros(1).expand(len(tensor))
    torch.save({**tensors, name: tensor}, weights := io.BytesIO())
    bad = rewritten(file, tmp_path / "bad.zip", policy_pth=weights.getvalue())
    with pytest.raises(InputError, match=reason):
        read_agent(bad, OBSERVATIONS, SPACE, 0.0, 0)


def test_a_network_that_inflates_without_end_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, _ = saved(tmp_path, "sac")
    monkeypatch.setitem(agents._MOST_BYTES, "policy.pth", 2**20)
    with zipfile.ZipFile(bomb := io.BytesIO(), "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data/0", bytes(2**20 + 1))
    bad = rewritten(file, tmp_path / "bad.zip", policy_pth=bomb.getvalue())
    with pytest.raises(InputError, match=r"policy.pth has .* bytes, more than"):
        read_agent(bad, OBSERVATIONS, SPACE, 0.0, 0)


@pytest.mark.parametrize("bound", ["x", 0.0, -1.0, None, float("nan")])
def test_a_bound_of_the_mean_that_is_none_is_refused(bound: object, tmp_path: Path) -> None:
    file, _ = saved(tmp_path, "sac-sde")
    data = {"policy_kwargs": {"clip_mean": bound}}
    bad = rewritten(file, tmp_path / "bad.zip", data=json.dumps(data).encode())
    with pytest.raises(InputError, match="clip_mean"):
        read_agent(bad, OBSERVATIONS, SPACE, 0.0, 0)


def test_an_agent_fills_a_dataset_that_prepare_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = sb3.SAC("MlpPolicy", "Hopper-v5", buffer_size=10, seed=0, device="cpu")
    model.save(tmp_path / "mine")
    arguments = ["collect", "--env", "Hopper-v5", "--agent", str(tmp_path / "mine.zip")]
    arguments += ["--noise", "0.1", "--size", "60", "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    file = tmp_path / "out" / "hopper_mine-noise0.1.hdf5"
    read = read_d4rl(file)
    assert len(read.rewards) >= 60
    assert read.source["env_id"] == "Hopper-v5"
    assert isinstance(read.write_store(tmp_path / "store"), EpisodeStore)
    assert "hopper_mine-noise0.1" in capsys.readouterr().out
    assert main(arguments) == 2
    assert "is complete already" in capsys.readouterr().err
