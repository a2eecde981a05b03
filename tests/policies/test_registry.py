"""Policies by name: ucfrec's own, imported when needed, and those installed beside it."""

import shutil
import subprocess
import sys
from importlib import invalidate_caches
from pathlib import Path

import numpy as np
import pytest
import torch

from ucfrec.commands.cli import main
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError, InputNote
from ucfrec.fitting.loop import load_trained
from ucfrec.policies.registry import BUILT_IN, note_ignored, policy_class, policy_names
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy

MINE = '''
from dataclasses import dataclass
from typing import Annotated
from pydantic import Field
from torch import nn
from ucfrec.policies.base import PolicyConfig, SequencePolicy
from ucfrec.settings import settings_table

@settings_table("policy")
class MineConfig(PolicyConfig):
    depth: Annotated[int, Field(ge=1, le=4)] = 2
    """Layers."""

class Mine(SequencePolicy):
    Config = MineConfig
    def __init__(self, config, sizes):
        super().__init__(config, sizes)
        given = [sizes["state"]] + [config.dim] * config.depth
        self.net = nn.Sequential(*map(nn.Linear, given, given[1:]))
    def features(self, windows):
        return self.net(windows.states)

class Tied(Mine):
    def __init__(self, config, sizes):
        super().__init__(config, sizes)
        self.one, self.two = (nn.Linear(config.dim, config.dim) for _ in range(2))
        self.two.weight = self.one.weight
    def features(self, windows):
        return self.two(self.one(self.net(windows.states)))

class ReadsValue(Mine):
    def __init__(self, config, sizes):
        super().__init__(config, sizes)
        assert float(self.net[0].weight.abs().mean()) > 0

class Odd(SequencePolicy):
    Config = dict

@dataclass(frozen=True)
class UncheckedConfig(PolicyConfig):
    depth: int = 2

class Unchecked(SequencePolicy):
    Config = UncheckedConfig
'''
ENTRY_POINTS = """[ucfrec.policies]
mine = my_learner:Mine
dt = my_learner:Mine
tied = my_learner:Tied
reads-value = my_learner:ReadsValue
not-one = my_learner:MineConfig
odd = my_learner:Odd
unchecked = my_learner:Unchecked
gone = my_learner:Gone
raises = my_raising:Mine
nowhere = no_such_learner:Mine
"""


def distribution(site: Path, name: str, version: str, entry_points: str) -> Path:
    """The folder of a distribution as pip leaves it."""
    info = site / f"{name.replace('-', '_')}.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(entry_points)
    invalidate_caches()
    return info


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A distribution of plugins, on the path."""
    site = tmp_path / "site"
    info = distribution(site, "my-policy", "1.0", ENTRY_POINTS)
    (site / "my_learner.py").write_text(MINE)
    (site / "my_raising.py").write_text("raise ValueError('of my own')")
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.delitem(sys.modules, "my_learner", raising=False)
    return info


def small_store(path: Path) -> EpisodeStore:
    rng = np.random.default_rng(0)
    columns = {"observation": rng.normal(size=(60, 3)), "reward": rng.random(60)}
    columns["action"] = rng.uniform(-1, 1, size=(60, 2))
    return EpisodeStore.write(path, columns, np.full(12, 5))


def test_the_example_installs_and_trains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, site = tmp_path / "plugin", tmp_path / "site"
    shutil.copytree(Path(__file__).parents[2] / "examples" / "plugin", source)
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--no-index", "--target", str(site), str(source)], check=True)
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.delitem(sys.modules, "ucfrec_gru", raising=False)
    invalidate_caches()
    small_store(tmp_path / "store")
    command = ["train", str(tmp_path / "store"), "--out", str(tmp_path / "run"), "--policy", "gru"]
    command += ["--set", "train.steps=60", "--set", "policy.layers=2", "--set", "policy.dim=8"]
    assert main(command) == 0
    trained = TrainedPolicy.load(tmp_path / "run")
    assert (trained.name, type(trained.policy).__module__) == ("gru", "ucfrec_gru")


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("name", ["tied", "reads-value"])
@pytest.mark.parametrize("average", [0.0, 0.9])
def test_a_policy_is_read_back_as_it_was_trained(tmp_path: Path, name: str, average: float) -> None:
    store = small_store(tmp_path / "store")
    given = ["train.steps=30", "train.warmup_steps=0", "policy.dim=8", f"train.average={average}"]
    train_run(store, tmp_path / "run", resolve_config(name, None, given))
    windows = store.windows(np.arange(4), np.full(4, 3), 6)
    for each in ("best", "last"):
        policy = TrainedPolicy.load(tmp_path / "run", each).policy
        assert policy.act(windows).shape == (4, 2)
        if name == "tied":
            weights = load_trained(tmp_path / "run" / "policy" / f"{each}.safetensors")
            assert torch.equal(weights["one.weight"], weights["two.weight"])
            assert torch.equal(weights["one.weight"], policy.one.weight)


def test_a_run_knows_the_package_of_its_policy(
    tmp_path: Path, installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    config = resolve_config("mine", None, ["train.steps=2", "policy.dim=8"])
    record = train_run(small_store(tmp_path / "store"), run, config)
    assert (record.policy_package, record.versions["my-policy"]) == ("my-policy", "1.0")
    distribution(tmp_path / "site", "my-policy", "1.1", ENTRY_POINTS)
    with pytest.warns(InputNote, match="trained with my-policy 1.0, but my-policy 1.1 is instal"):
        TrainedPolicy.load(run)
    (tmp_path / "site" / "my_learner.py").unlink()
    monkeypatch.delitem(sys.modules, "my_learner")
    with pytest.raises(InputError, match=r"my_learner:Mine, which cannot be imported"):
        TrainedPolicy.load(run)
    shutil.rmtree(installed)
    missing = r"policy 'mine' \(of package my-policy 1.0\), which is not installed: install it$"
    with pytest.raises(InputError, match=missing):
        TrainedPolicy.load(run)


@pytest.mark.usefixtures("installed")
def test_a_built_in_policy_has_no_package_and_a_plugin_of_its_name_is_noted(tmp_path: Path) -> None:
    note_ignored.cache_clear()
    config = resolve_config("dt", None, ["train.steps=2", "policy.dim=8"])
    with pytest.warns(InputNote, match="'dt' of package my-policy is ignored"):
        record = train_run(small_store(tmp_path / "store"), tmp_path / "run", config)
    assert record.policy_package is None
    assert "my-policy" not in record.versions


@pytest.mark.usefixtures("installed")
def test_two_packages_may_not_have_one_name(tmp_path: Path) -> None:
    entry = "[ucfrec.policies]\nmine = my_learner:Tied\n"
    distribution(tmp_path / "site", "another-policy", "2.0", entry)
    with pytest.raises(InputError, match=r"packages another-policy and my-policy both .* 'mine'"):
        policy_class("mine")


@pytest.mark.usefixtures("installed")
def test_an_installed_learner_is_listed_with_its_settings(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert policy_names()[: len(BUILT_IN)] == tuple(BUILT_IN)
    assert "mine" in policy_names()
    assert main(["settings", "--policy", "mine"]) == 0
    assert "policy.depth" in capsys.readouterr().out
    assert resolve_config("mine", None, ["policy.depth=3"]).policy.depth == 3
    with pytest.raises(InputError, match=r"policy\.depth is 5; it must be a whole number from 1"):
        resolve_config("mine", None, ["policy.depth=5"])


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("not-one", "not a class derived from ucfrec.policies.base.SequencePolicy"),
        ("odd", "not derived from ucfrec.policies.base.PolicyConfig"),
        ("unchecked", "not derived from .* under @ucfrec.settings.settings_table"),
        ("gone", "my_learner:Gone, which cannot be imported"),
        ("raises", r"my_raising:Mine, which cannot be imported \(ValueError: of my own\)"),
        ("nowhere", "no_such_learner:Mine, which cannot be imported"),
        ("min", "choose from ucf, ucf-paper, dt, .*, mine"),
    ],
)
def test_what_is_no_learner_is_refused(name: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        policy_class(name)
