"""Saved agents act as Stable-Baselines3 lets them act, and nothing in their files is executed."""

import io
import json
import pickle
import zipfile
from math import nan
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

from tests.support.control_files import control, refused
from ucfrec.errors import InputError
from ucfrec_control.data import agents
from ucfrec_control.data.agents import read_agent
from ucfrec_control.data.d4rl import read_d4rl

OBSERVATIONS = 4
SPACE = Box(np.float32([-1, -3]), np.float32([2, 3]))


class _Environment(gymnasium.Env[Any, Any]):
    observation_space = Box(-np.inf, np.inf, (OBSERVATIONS,), np.float32)
    action_space = SPACE


FEW, PERCEPTRON = {"buffer_size": 10}, "policy_kwargs"
AGENTS = {
    "sac": (sb3.SAC, FEW),
    "sac-sde": (sb3.SAC, FEW | {"use_sde": True}),
    "td3": (sb3.TD3, FEW | {PERCEPTRON: {"net_arch": [8, 6]}}),
    "ddpg": (sb3.DDPG, FEW | {PERCEPTRON: {"activation_fn": nn.ELU}}),
    "ppo": (sb3.PPO, {PERCEPTRON: {"activation_fn": nn.ReLU, "net_arch": [7]}}),
    "a2c": (sb3.A2C, {}),
}


def saved(folder: Path, name: str) -> tuple[Path, Any]:
    kind, settings = AGENTS[name]
    model = kind("MlpPolicy", _Environment(), seed=0, device="cpu", **settings)
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
    assert (noisy != found).any()
    assert all(action in SPACE for action in noisy)


class _Trap:
    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> Any:
        return Path.touch, (self.file,)


def rewritten(file: Path, out: Path, **parts: bytes | None) -> Path:
    """A copy of a zip file with some parts replaced, or excluded."""
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(out, "w") as new:
        contents = {name: old.read(name) for name in old.namelist()}
        contents |= {name.replace("_", "."): content for name, content in parts.items()}
        for name in (name for name in contents if contents[name] is not None):
            new.writestr(name, contents[name])
    return out


def assert_refused(file: Path, reason: str, observations: int = OBSERVATIONS) -> None:
    with pytest.raises(InputError, match=reason):
        read_agent(file, observations, SPACE, 0.0, 0)


def test_nothing_in_the_file_is_executed(tmp_path: Path) -> None:
    file, _ = saved(tmp_path, "sac")
    trap, sprung = _Trap(tmp_path / "sprung"), tmp_path / "sprung"
    torch.save({"actor.mu.weight": trap}, weights := io.BytesIO())
    for tensors in (pickle.dumps(trap), weights.getvalue()):
        bad = rewritten(file, tmp_path / "bad.zip", policy_pth=tensors)
        assert_refused(bad, "cannot be read as data")
    with zipfile.ZipFile(file) as archive:
        names = json.loads(archive.read("data"))
    everything = {name: {":type:": "x", ":serialized:": pickle.dumps(trap).hex()} for name in names}
    odd = rewritten(file, tmp_path / "odd.zip", data=json.dumps(everything).encode())
    read_agent(odd, OBSERVATIONS, SPACE, 0.0, 0)
    assert not sprung.exists()


def test_files_of_no_agent_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, _ = saved(tmp_path, "td3")
    assert_refused(file, "observations of size 4 to actions of size 2", observations=5)
    assert_refused(tmp_path / "none.zip", "does not exist")
    (tmp_path / "text.zip").write_text("no zip")
    assert_refused(tmp_path / "text.zip", "cannot be read as data")
    assert_refused(rewritten(file, tmp_path / "a.zip", policy_pth=None), "cannot be read as data")
    monkeypatch.setitem(agents._MOST_BYTES, "policy.pth", 2**20)
    with zipfile.ZipFile(bomb := io.BytesIO(), "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data/0", bytes(2**20 + 1))
    endless = rewritten(file, tmp_path / "b.zip", policy_pth=bomb.getvalue())
    assert_refused(endless, r"policy.pth has .* bytes, more than")


HIDDEN = "actor.latent_pi.2"


def weights(tensor: torch.Tensor) -> dict[str, torch.Tensor]:
    biases = {f"{HIDDEN}.bias": torch.zeros(1).expand(300_000)} if len(tensor) > 256 else {}
    return {f"{HIDDEN}.weight": tensor, **biases}


@pytest.mark.parametrize(
    ("agent", "tensors", "settings", "reason"),
    [
        ("td3", {"actor.mu.1.running_mean": torch.zeros(8)}, {}, "not a layer of a perceptron"),
        ("td3", {"actor.mu": None}, {}, "not those of a"),
        ("td3", {}, {"activation_fn": "<class 'somebody.Else'>"}, "its activation is"),
        ("sac-sde", weights(torch.zeros(1).expand(300_000, 300_000)), {}, "one by one"),
        ("sac-sde", weights(torch.full((256, 256), torch.nan)), {}, "one by one"),
        ("sac-sde", {f"{HIDDEN}.bias": torch.zeros(256, dtype=torch.cfloat)}, {}, "one by one"),
        ("sac-sde", weights(torch.zeros(256, 255)), {}, "256 outputs, .* 255 inputs"),
        *(("sac-sde", {}, {"clip_mean": x}, "clip_mean") for x in ("x", 0.0, nan)),
    ],
)
def test_strange_networks_are_refused(
    agent: str, tensors: dict[str, Any], settings: dict[str, Any], reason: str, tmp_path: Path
) -> None:
    file, _ = saved(tmp_path, agent)
    with zipfile.ZipFile(file) as archive:
        own = torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=True)
        data = json.loads(archive.read("data"))
    removed = tuple(name for name, tensor in tensors.items() if tensor is None)
    changed = {name: own[name] for name in own if not name.startswith(removed)} | tensors
    kept = {name: tensor for name, tensor in changed.items() if tensor is not None}
    torch.save(kept, saved_tensors := io.BytesIO())
    text = json.dumps(data | {"policy_kwargs": settings})
    parts = {"policy_pth": saved_tensors.getvalue(), "data": text.encode()}
    assert_refused(rewritten(file, tmp_path / "bad.zip", **parts), reason)


def test_an_agent_fills_a_dataset_that_prepare_reads(tmp_path: Path) -> None:
    model = sb3.SAC("MlpPolicy", "Hopper-v5", buffer_size=10, seed=0, device="cpu")
    model.save(tmp_path / "mine")
    command = ("collect", "--env", "Hopper-v5", "--agent", tmp_path / "mine.zip")
    command += ("--noise", 0.1, "--size", 60, "--out", tmp_path / "out")
    assert "hopper_mine-noise0.1" in control(*command)[0]
    read = read_d4rl(tmp_path / "out" / "hopper_mine-noise0.1.hdf5")
    assert len(read.rewards) >= 60
    assert read.source["env_id"] == "Hopper-v5"
    read.write_store(tmp_path / "store")
    assert "is complete already" in refused(*command)
