"""Shared stages: runs with them are the runs that they would be alone, and pay once."""

from pathlib import Path

import pytest
import torch

from tests.support.episodes import random_episodes, some_states, write_store
from ucfrec.episodes.store import EpisodeStore
from ucfrec.files.atomic import read_json
from ucfrec.fitting.checkpoint import load_tensors
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.shared_stages import OWN, SharedStages

SETTINGS = (
    "train.steps=4",
    "train.validate_every=4",
    "policy.dim=8",
    "policy.context=3",
    "augment.copies=1",
    "crm.epochs=2",
    "rule.sessions=8",
)


def trained(
    store: EpisodeStore, run: Path, shared: SharedStages, *settings: str, policy: str = "ucf"
) -> Path:
    config = resolve_config(policy, None, [*SETTINGS, *settings], seed=1)
    train_run(store, run, config, shared=shared)
    return run


@pytest.fixture
def store(tmp_path: Path) -> EpisodeStore:
    return write_store(tmp_path / "store", random_episodes([6] * 120), some_states())


def test_runs_are_what_they_would_be_alone(store: EpisodeStore, tmp_path: Path) -> None:
    shared = SharedStages(tmp_path / "stages")
    first = trained(store, tmp_path / "first", shared)
    second = trained(store, tmp_path / "second", shared, "policy.lambda_mask=0.1")
    alone = trained(store, tmp_path / "alone", OWN, "policy.lambda_mask=0.1")
    assert len([*(tmp_path / "stages").iterdir()]) == 2  # copies, and the reward model of items
    for name in ("augmented", "crm/cvae/last", "reward_model/item_reward", "policy/best"):
        own, _ = load_tensors(alone / f"{name}.safetensors")
        given, _ = load_tensors(second / f"{name}.safetensors")
        assert own.keys() == given.keys()
        assert all(torch.equal(own[key], given[key]) for key in own), name
    once = (run / "crm" / "cvae" / "last.safetensors" for run in (first, second))
    assert len({path.read_bytes() for path in once}) == 1
    reports = [read_json(run / "run.json") for run in (second, alone)]
    assert reports[0]["augmentation"] == reports[1]["augmentation"]
    assert reports[0]["rule"] == reports[1]["rule"]
    files = [{name for name in r["files"] if "events" not in name} for r in reports]
    assert files[0] == files[1]


@pytest.mark.parametrize(
    ("settings", "policy", "more"),
    [
        (("augment.epsilon_r=0.5",), "ucf", 1),
        # Copies of a share of the episodes are not the copies of all.
        (("policy.best_share=0.5", "augment.copies=1"), "dt", 0),
    ],
)
def test_what_differs_is_made_anew(
    store: EpisodeStore, tmp_path: Path, settings: tuple[str, ...], policy: str, more: int
) -> None:
    shared = SharedStages(tmp_path / "stages")
    trained(store, tmp_path / "first", shared)
    run = trained(store, tmp_path / "second", shared, *settings, policy=policy)
    assert len([*(tmp_path / "stages").iterdir()]) == 2 + more
    alone = trained(store, tmp_path / "alone", OWN, *settings, policy=policy)
    for name in ("augmented", "policy/best"):
        if (alone / f"{name}.safetensors").exists():
            own, _ = load_tensors(alone / f"{name}.safetensors")
            given, _ = load_tensors(run / f"{name}.safetensors")
            assert all(torch.equal(own[key], given[key]) for key in own), name


def test_an_interrupted_stage_is_not_shared(tmp_path: Path) -> None:
    shared = SharedStages(tmp_path / "stages")

    def stop() -> None:
        (tmp_path / "out" / "half").write_text("half")
        raise KeyboardInterrupt

    (tmp_path / "out").mkdir()
    with pytest.raises(KeyboardInterrupt):
        shared.provide({"seed": 0}, __name__, tmp_path / "out", ("half", "whole"), stop)
    made = []

    def make() -> None:
        made.append(True)
        (tmp_path / "out" / "whole").write_text("whole")

    for _ in range(2):
        shared.provide({"seed": 0}, __name__, tmp_path / "out", ("half", "whole"), make)
    assert made == [True]
    assert (tmp_path / "out" / "whole").read_text() == "whole"


def test_a_file_that_was_being_copied_is_not_taken_for_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared = SharedStages(tmp_path / "stages")
    first, second = tmp_path / "first", tmp_path / "second"
    for out in (first, second):
        out.mkdir()

    def make() -> None:
        (first / "models").mkdir()
        (first / "models" / "weights").write_text("weights")
        (first / "report").write_text("the whole report")

    shared.provide({"seed": 0}, __name__, first, ("models", "report"), make)

    def killed(source: Path, to: Path) -> None:
        Path(to).write_text("the wh")
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("ucfrec.runs.shared_stages.shutil.copyfile", killed)
        with pytest.raises(KeyboardInterrupt):
            shared.provide({"seed": 0}, __name__, second, ("report",), make)
    assert not (second / "report").exists()
    shared.provide({"seed": 0}, __name__, second, ("models", "report"), make)
    assert (second / "report").read_text() == "the whole report"
    assert (second / "models" / "weights").read_text() == "weights"
