"""Runs: resumable at any moment, complete in themselves, honest about what they did."""

import re
import resource
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support import killed_run
from tests.support.episodes import random_episodes, some_states, write_store
from tests.support.killed_loop import kills
from tests.support.tensors import assert_same_tensors
from ucfrec.commands.cli import main
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import AugmentedEpisodes
from ucfrec.errors import InputError, InputNote
from ucfrec.files.atomic import read_json
from ucfrec.runs.config import resolve_config
from ucfrec.runs.record import RunRecord
from ucfrec.runs.run import share_stage, train_run
from ucfrec.runs.trained_policy import TrainedPolicy

SHORT = [*killed_run.SETTINGS, "train.steps=4", "crm.epochs=1"]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sessions whose reward is what the action and the state make of it, and some luck."""
    rng = np.random.default_rng(0)
    lengths = rng.integers(3, 12, size=150)
    n = int(lengths.sum())
    observation, action = rng.normal(size=(n, 4)), rng.uniform(-1, 1, size=(n, 2))
    reward = observation[:, 0] * action[:, 0] + 0.5 * rng.normal(size=n)
    split = np.repeat([0, 1], [120, 30]).astype(np.uint8)
    columns = {"observation": observation, "action": action, "reward": reward}
    path = tmp_path_factory.mktemp("store") / "store"
    return EpisodeStore.write(path, columns, lengths, {"split": split}).path


def vectors(path: Path, reward: float | None = None) -> EpisodeStore:
    """Sixty episodes without splits; rewards are random unless all are `reward`."""
    rng = np.random.default_rng(0)
    columns = {"observation": rng.normal(size=(300, 3)), "action": rng.uniform(size=(300, 2))}
    columns["reward"] = rng.random(300) if reward is None else np.full(300, reward)
    return EpisodeStore.write(path, columns, np.full(60, 5))


@pytest.fixture(scope="module")
def left_alone(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "run"
    killed_run.train(store, run)
    return run


@pytest.mark.slow
def test_a_run_killed_at_any_moment_ends_as_if_left_alone(store: Path, left_alone: Path) -> None:
    assert kills("run", store.parent) >= 3
    names = ("augmented", "policy/best", "policy/last")
    assert_same_tensors(store.parent / "killed", left_alone, *names)


def test_a_run_needs_nothing_but_its_folder(store: Path, left_alone: Path) -> None:
    trained = TrainedPolicy.load(left_alone)
    view = EpisodeStore.open(store).split("train")
    augmented = AugmentedEpisodes.load(left_alone / "augmented.safetensors")
    assert {*augmented.copy_source, *augmented.action_source} <= {*view.episode_ids}
    assert len(augmented.edit_step) > 0
    report = trained.record.augmentation
    assert report.bound == pytest.approx(report.delta + report.epsilon_r)
    assert 0 < report.acceptance <= 1
    mean, _ = view.state_statistics
    torch.testing.assert_close(trained.policy.state_mean, mean)
    returns_to_go = view.step_values("return_to_go", *view.all_steps())
    assert trained.policy.lowest_return_to_go == returns_to_go.min()
    assert trained.target_return(1.0) == pytest.approx(view.returns.max())
    assert trained.target_return(0.5) == pytest.approx(np.median(view.returns), rel=1e-5)


def test_a_moved_store_is_remembered(store: Path, left_alone: Path, tmp_path: Path) -> None:
    shutil.copytree(store, tmp_path / "moved")
    shutil.copytree(left_alone, tmp_path / "run")
    killed_run.train(tmp_path / "moved", tmp_path / "run")
    before, record = RunRecord.read(left_alone), RunRecord.read(tmp_path / "run")
    assert record.store == str((tmp_path / "moved").resolve())
    assert record.store_from_run == "../moved"
    assert record.policy == before.policy


@pytest.mark.parametrize("policy_name", ["ucf", "dt4rec", "cdt4rec"])
def test_other_items_with_every_addition(tmp_path: Path, policy_name: str) -> None:
    store = write_store(tmp_path / "store", random_episodes([6] * 90), some_states())
    settings = [
        *("train.steps=4", "train.batch_size=256", "policy.dim=8", "policy.context=4"),
        *("crm.epochs=20", "crm.hidden=16", "augment.actions=2", "augment.epsilon_r=10.0"),
        *("policy.exposure=true", "policy.return_to_go=horizon", "policy.horizon=2"),
        "rule.choose=false",
    ]
    record = train_run(store, tmp_path / "run", resolve_config(policy_name, None, settings))
    assert record.augmentation.actions.copies > 10
    assert np.isfinite(record.finished.best_validation)
    assert not (tmp_path / "run" / "csg").exists()


def test_a_store_without_validation_holds_some_training_episodes_out(tmp_path: Path) -> None:
    whole = vectors(tmp_path / "store")
    train_run(whole, tmp_path / "run", resolve_config("ucf", None, [*SHORT, "augment.copies=1"]))
    augmented = AugmentedEpisodes.load(tmp_path / "run" / "augmented.safetensors")
    assert not set(augmented.copy_source) & {1, 11, 21, 31, 41, 51}
    columns = {"observation": np.zeros((5, 1)), "action": np.zeros((5, 1)), "reward": np.zeros(5)}
    single = EpisodeStore.write(tmp_path / "single", columns, np.array([5]))
    with pytest.raises(InputError, match="has 1 training episode, at least 2 are needed"):
        train_run(single, tmp_path / "run-single", resolve_config("ucf"))
    assert not (tmp_path / "run-single").exists()


@pytest.mark.parametrize(
    ("policy", "wrong", "says"),
    [
        ("ucf", ["policy.heads=3"], r"=3, --set policy\.dim=16: policy\.heads is 3; it must"),
        ("item-knn", [], "item-knn recommends items; this store's actions are vectors"),
    ],
)
def test_a_start_that_fails_leaves_nothing_and_the_corrected_command_works_there(
    policy: str, wrong: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    vectors(tmp_path / "store")
    command = ["train", str(tmp_path / "store"), "--out", str(tmp_path / "run")]
    command += [word for setting in SHORT for word in ("--set", setting)]
    bad = [word for setting in wrong for word in ("--set", setting)]
    assert main([*command, "--policy", policy, *bad]) == 2
    printed = capsys.readouterr().err.strip()
    assert re.search(says, printed), printed
    assert "\n" not in printed
    assert [path.name for path in tmp_path.iterdir()] == ["store"]
    assert main(command) == 0
    assert TrainedPolicy.load(tmp_path / "run").name == "ucf"


def test_rewards_that_never_vary_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    flat = vectors(tmp_path / "store", reward=0.5)
    with pytest.raises(InputError, match=r"all 270 training rewards of .* equal 0\.5"):
        train_run(flat, tmp_path / "run", resolve_config("ucf-paper", None, SHORT))
    assert not (tmp_path / "run").exists()
    record = train_run(flat, tmp_path / "run", resolve_config("ucf", None, SHORT))
    assert record.augmentation is None
    assert not (tmp_path / "run" / "crm").exists()


def test_a_checkpoint_that_cannot_be_written_is_an_error(store: Path, tmp_path: Path) -> None:
    """No file may grow past 20 kB here, as on a disk that is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    config = resolve_config("dt", None, ["train.steps=10", "policy.dim=64"])
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(InputError, match=r"best\.safetensors cannot be written"):
            train_run(EpisodeStore.open(store), tmp_path / "run", config)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list((tmp_path / "run" / "policy").glob("*safetensors*"))
    train_run(EpisodeStore.open(store), tmp_path / "run", config)
    assert TrainedPolicy.load(tmp_path / "run").name == "dt"


def test_a_run_goes_on_with_the_same_item_states_and_not_with_fewer_steps(tmp_path: Path) -> None:
    """The fingerprint is of the steps; other features of the same log are other states."""

    def sealed_store(seed: int) -> EpisodeStore:
        episodes = random_episodes([6] * 60)
        store = write_store(tmp_path / f"store-{seed}", episodes, some_states(seed=seed))
        store.record.seal(store.path)
        return EpisodeStore.open(store.path)

    first, other = sealed_store(0), sealed_store(1)
    assert first.record.fingerprint == other.record.fingerprint

    def train(store: EpisodeStore, steps: int) -> RunRecord:
        settings = ["policy.dim=8", "train.batch_size=8", "rule.choose=false"]
        config = resolve_config("bc", None, [*settings, f"train.steps={steps}"])
        return train_run(store, tmp_path / "run", config)

    train(first, 4)
    with pytest.raises(InputError, match="or on other item states"):
        train(other, 8)
    with pytest.raises(InputError, match="steps is 4 in the run, 2 now"):
        train(first, 2)
    record = train(first, 8)
    assert record.finished.steps == 8
    record.copy_with(policy=None).seal(tmp_path / "run")
    with pytest.warns(InputNote, match="has not ended"):
        TrainedPolicy.load(tmp_path / "run")


SETTINGS = [
    *("train.steps=4", "train.validate_every=4", "policy.dim=8", "policy.context=3"),
    *("augment.copies=1", "crm.epochs=2", "rule.sessions=8"),
]


def trained(
    store: EpisodeStore, run: Path, shared: Path | None, *settings: str, policy: str = "ucf"
) -> Path:
    config = resolve_config(policy, None, [*SETTINGS, *settings], seed=1)
    train_run(store, run, config, shared=shared)
    return run


@pytest.fixture
def item_store(tmp_path: Path) -> EpisodeStore:
    return write_store(tmp_path / "store", random_episodes([6] * 120), some_states())


def test_runs_are_what_they_would_be_alone(item_store: EpisodeStore, tmp_path: Path) -> None:
    shared = tmp_path / "stages"
    first = trained(item_store, tmp_path / "first", shared)
    second = trained(item_store, tmp_path / "second", shared, "policy.lambda_mask=0.1")
    alone = trained(item_store, tmp_path / "alone", None, "policy.lambda_mask=0.1")
    assert len([*(tmp_path / "stages").iterdir()]) == 2  # copies, and the reward model of items
    names = ("augmented", "crm/cvae/last", "reward_model/item_reward", "policy/best")
    assert_same_tensors(second, alone, *names)
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
    item_store: EpisodeStore, tmp_path: Path, settings: tuple[str, ...], policy: str, more: int
) -> None:
    shared = tmp_path / "stages"
    trained(item_store, tmp_path / "first", shared)
    run = trained(item_store, tmp_path / "second", shared, *settings, policy=policy)
    assert len([*(tmp_path / "stages").iterdir()]) == 2 + more
    alone = trained(item_store, tmp_path / "alone", None, *settings, policy=policy)
    names = [n for n in ("augmented", "policy/best") if (alone / f"{n}.safetensors").exists()]
    assert_same_tensors(run, alone, *names)


def test_what_was_interrupted_is_not_shared_and_not_taken_for_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared, made = tmp_path / "stages", []
    first, second = tmp_path / "first", tmp_path / "second"

    def make(report: str) -> None:
        made.append(report)
        (first / "models").mkdir(parents=True, exist_ok=True)
        (first / "models" / "weights").write_text("weights")
        if not report:
            raise KeyboardInterrupt
        (first / "report").write_text(report)

    def provide(out: Path, report: str) -> None:
        names = ("models", "report")
        share_stage(shared, {"seed": 0}, __name__, out, names, lambda: make(report))

    def killed(source: Path, to: Path) -> None:
        Path(to).write_text("the wh")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        provide(first, "")
    for _ in range(2):
        provide(first, "the whole report")
    with monkeypatch.context() as patched:
        patched.setattr("ucfrec.runs.run.shutil.copyfile", killed)
        with pytest.raises(KeyboardInterrupt):
            provide(second, "")
    assert not (second / "report").exists()
    provide(second, "")
    assert (second / "report").read_text() == "the whole report"
    assert (second / "models" / "weights").read_text() == "weights"
    assert made == ["", "the whole report"]
