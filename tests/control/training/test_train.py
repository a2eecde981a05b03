"""Control runs end to end: presets, training, normalised scores, distractors, refusals."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support.control_files import hopper_like, write_hdf5
from tests.support.real_data import data_folder
from ucfrec import schema
from ucfrec.acting.rollout import rollout
from ucfrec.benchmark.cells import Budget, Evaluation
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json
from ucfrec.fitting.metrics_log import read_metrics
from ucfrec.policies.registry import BUILT_IN
from ucfrec.results.rows import read_results
from ucfrec.runs.config import resolve_config
from ucfrec_control.benchmark.budgets import BUDGETS, ZOO
from ucfrec_control.benchmark.methods import METHODS, TABLES
from ucfrec_control.cli import main
from ucfrec_control.data.d4rl import read_d4rl
from ucfrec_control.data.distractor import add_distractor
from ucfrec_control.environments.environments import make_env, mismatches
from ucfrec_control.environments.scores import TASKS
from ucfrec_control.training.evaluate import evaluate_run
from ucfrec_control.training.train import find_preset, train_control

TINY = ["train.steps=4", "train.validate_every=2", "policy.dim=16", "policy.context=5"]
SETTINGS = [argument for setting in TINY for argument in ("--set", setting)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small store of a made-up Hopper dataset, one with a distractor, and a run on each."""
    folder = tmp_path_factory.mktemp("control")
    file = write_hdf5(folder / "hopper_medium-made.hdf5", hopper_like((30, 8, 25) * 8))
    assert main(["prepare", str(file), "--out", str(folder / "store")]) == 0
    store, distracted = str(folder / "store"), str(folder / "distracted")
    assert main(["distract", store, "--out", distracted, "--flip", "0.15"]) == 0
    for data, policy in ((store, "dt"), (distracted, "dc")):
        run = ["--out", f"{data}-run", "--policy", policy]
        assert main(["train", data, *run, *SETTINGS, "--seed", "3"]) == 0
    return folder


def test_every_twentieth_trajectory_is_for_validation(folder: Path) -> None:
    splits = EpisodeStore.open(folder / "store").episode_values(schema.SPLIT)
    assert np.flatnonzero(splits).tolist() == [10]


def test_evaluate_writes_last_and_best_apart(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "rows.json"
    arguments = ["evaluate", str(folder / "store-run"), "--episodes", "3", "--json", str(out)]
    assert main(arguments) == 0
    rows = read_results(out)
    assert [(r.checkpoint, r.target_return) for r in rows] == [
        (checkpoint, target) for checkpoint in ("last", "best") for target in (3600, 1800)
    ]
    for row in rows:
        assert (row.task, row.method, row.training_seed) == ("hopper_medium-made", "dt", 3)
        assert (row["episodes"], row.environment) == (3, "Hopper-v5")
        scored = 100 * (row["return"] + 20.272305) / (3234.3 + 20.272305)
        assert row["score"] == pytest.approx(scored)
        assert row["score_low"] <= row["score"] <= row["score_high"]
        assert {"mujoco", "gymnasium", "torch"} <= row.versions.keys()
        trained = read_json(folder / "store-run" / "run.json")["policy"]
        assert row["validation_loss"] == trained["best_validation"] > 0
        assert min(row["wall_time_s"], row["train_wall_time_s"]) > 0
        assert row.policy == "dt"
    printed = capsys.readouterr()
    assert "hopper_medium-made" in printed.out
    assert "warning" not in printed.err


def test_the_best_checkpoint_is_played_whichever_step_it_is_of(folder: Path) -> None:
    """Asked for together with the last, it may be the same; it has the return that it has alone."""
    run = folder / "store-run"
    both = evaluate_run(run, episodes=2, seed=0, targets=(3600.0,))
    (best,) = evaluate_run(run, episodes=2, seed=0, targets=(3600.0,), checkpoints=("best",))
    assert [row["checkpoint"] for row in both] == ["last", "best"]
    assert both[1]["return"] == best["return"]


def test_another_environment_version_warns(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = ["evaluate", str(folder / "store-run"), "--checkpoint", "last", "--episodes", "1"]
    assert main([*run, "--target", "100", "--env", "Hopper-v4"]) == 0
    said = capsys.readouterr().err
    assert "warning: the data is of Hopper-v5, the evaluation is in Hopper-v4" in said
    made = {"env_id": "Hopper-v5", "versions": {"mujoco": "2.1.0"}}
    (told,) = mismatches(made, "Hopper-v5")
    assert told.startswith("the data was made with mujoco 2.1.0, ")


def test_a_target_return_that_no_run_takes_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloned = str(tmp_path / "run")
    assert main(["train", str(folder / "store"), "--out", cloned, "--policy", "bc", *SETTINGS]) == 0
    asked = ["--checkpoint", "last", "--episodes", "1", "--target", "100"]
    assert main(["evaluate", cloned, *asked]) == 2
    assert f"no target return is taken by {cloned} (bc)" in capsys.readouterr().err
    assert main(["evaluate", cloned, str(folder / "store-run"), *asked]) == 0
    assert f"note: --target does nothing for {cloned} (bc)" in capsys.readouterr().err


def test_data_does_not_choose_what_is_imported(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "theirs.py").write_text("raise SystemExit('their code ran')")
    monkeypatch.syspath_prepend(tmp_path)
    run = shutil.copytree(folder / "store-run", tmp_path / "run")
    record = read_json(run / "run.json")
    record["data"]["env_id"] = "theirs:Hopper-v5"
    (run / "run.json").write_text(json.dumps(record))
    assert main(["evaluate", str(run), "--episodes", "1"]) == 2
    said = capsys.readouterr().err
    assert "the Python module theirs would be run" in said
    assert main(["evaluate", str(run), "--episodes", "1", "--env", "Hopper-v5"]) == 0


def test_a_distractor_is_the_reward_bit_and_nothing_else_changes(
    folder: Path, tmp_path: Path
) -> None:
    store = EpisodeStore.open(folder / "store")
    episodes, steps = store.all_steps()
    rewards = store.step_values(schema.REWARD, episodes, steps)
    bit = (rewards > np.median(rewards)).astype(np.float32)
    for flip, agreement in ((0.0, 1.0), (0.15, 0.85)):
        other = add_distractor(store, tmp_path / str(flip), flip, seed=1)
        seen = other.step_values(schema.OBSERVATION, episodes, steps)
        before = store.step_values(schema.OBSERVATION, episodes, steps)
        np.testing.assert_array_equal(seen[:, :-1], before)
        assert (seen[:, -1] == bit).mean() == pytest.approx(agreement, abs=0.05)
        for name in (schema.SPLIT, schema.TERMINATED):
            np.testing.assert_array_equal(other.episode_values(name), store.episode_values(name))
        np.testing.assert_array_equal(other.returns, store.returns)
        again = add_distractor(store, tmp_path / f"{flip}-again", flip, seed=1)
        assert again.record.fingerprint == other.record.fingerprint
    with pytest.raises(InputError, match=r"must be in \[0, 1\]"):
        add_distractor(store, tmp_path / "x", flip=1.5)


def test_a_policy_with_a_distractor_is_judged_at_zero(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "rows.json"
    run = str(folder / "distracted-run")
    arguments = ["evaluate", run, "--checkpoint", "last", "--episodes", "2", "--target", "900"]
    assert main([*arguments, "--json", str(out)]) == 0
    (row,) = read_results(out)
    assert row.details["distractors"] == [
        {"dimension": 11, "flip": 0.15, "seed": 0, "early": False}
    ]
    env = make_env("Hopper-v5", 2, [0.0])
    seen = []

    class Still:
        def begin(self, rows: object) -> None:
            pass

        def act(self, observations: object, live: object) -> tuple[object, None]:
            seen.append(np.array(observations))
            return np.zeros((2, 3), dtype=np.float32), None

        def observe(self, actions: object, rewards: object) -> None:
            pass

    rollout(env, Still(), 4, seed=0)  # type: ignore[arg-type]
    assert {observation.shape for observation in seen} == {(2, 12)}
    assert all((observation[:, 11] == 0).all() for observation in seen)


def test_policies_that_know_their_largest_return_are_asked_for_it(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every sequence policy takes the settings that pursue reward, with vector actions."""
    pursue = ["policy.advantage_weights=true", "policy.max_return=true", "policy.best_share=0.5"]
    own = {"lsdt": ["policy.kernel_groups=4"], "ucf": ["crm.epochs=1", "csg.epochs=1"]}
    store = EpisodeStore.open(folder / "store")
    for policy_name in ("dt", "dc", "lsdt", "ucf"):
        settings = [*TINY, *pursue, "policy.max_timestep=1", *own.get(policy_name, [])]
        run = tmp_path / policy_name
        record = train_control(store, run, resolve_config(policy_name, None, settings))
        losses = read_metrics(run / "policy")
        assert losses["value_loss"]
        assert record.finished.steps == 4
        (row,) = evaluate_run(run, episodes=1, seed=0, checkpoints=("last",))
        assert row["target_return"] is None
        assert "largest return expected" in row["rule"]
        (given,) = evaluate_run(run, episodes=1, seed=0, targets=(5.0,), checkpoints=("last",))
        assert given["target_return"] == 5.0
    assert main(["evaluate", str(run), "--episodes", "1", "--checkpoint", "last"]) == 0
    assert " max " in capsys.readouterr().out
    arguments = ["evaluate", str(folder / "store-run"), "--episodes", "1", "--target", "max"]
    assert main(arguments) == 2
    assert "policy.max_return=true" in capsys.readouterr().err


def test_behaviour_cloning_has_no_target(folder: Path, tmp_path: Path) -> None:
    store = EpisodeStore.open(folder / "store")
    train_control(store, tmp_path / "bc", resolve_config("bc", None, TINY))
    (row,) = evaluate_run(tmp_path / "bc", episodes=1, seed=0, checkpoints=("last",))
    assert (row["target_return"], row["rule"]) == (None, "no target return")


def test_presets_have_the_widths_of_the_paper() -> None:
    widths = {
        (task, kind): find_preset(task, kind, policy).tables["policy"].get("dim", 128)
        for policy in ("ucf", "ucf-paper")
        for task in ("halfcheetah", "hopper", "walker2d")
        for kind in ("medium", "medium-replay", "mixed", "medium-expert")
    }
    wide = {("hopper", kind) for kind in ("medium", "medium-replay", "mixed")}
    assert widths == {key: 256 if key in wide else 128 for key in widths}
    paper = find_preset("antmaze", "diverse", "ucf-paper").tables
    assert (paper["policy"]["context"], paper["crm"]["latent_dim"]) == (50, 32)
    # Copies are the same whichever policy learns from them.
    assert find_preset("antmaze", "diverse", "dt").tables["crm"] == paper["crm"]
    scales = {
        name: find_preset("antmaze", "", name).tables["policy"]["return_scale"]
        for name in ("ucf", "dt", "dc", "lsdt")
    }
    assert scales == {"ucf": 1.0, "dt": 1.0, "dc": 1.0, "lsdt": 1000.0}
    assert "max_timestep" not in paper["policy"]


def test_presets_are_configurations_with_targets() -> None:
    kinds = ("medium", "medium-replay", "medium-expert", "mixed", "diverse", "")
    for policy in BUILT_IN:
        for task in TASKS:
            for kind in kinds:
                preset = find_preset(task.name, kind, policy)
                resolve_config(policy, presets=preset.tables)
                assert preset.targets
    dc = resolve_config("dc", presets=find_preset("hopper", "medium", "dc").tables)
    assert (dc.policy.context, dc.policy.dim, dc.train.learning_rate) == (8, 256, 1e-4)
    dc = resolve_config("dc", presets=find_preset("walker2d", "medium", "dc").tables)
    assert (dc.policy.context, dc.policy.dim, dc.train.learning_rate) == (20, 128, 1e-3)
    assert dc.policy.return_scale == 1000
    assert find_preset("halfcheetah", "medium", "dt").targets == (12000, 6000)
    assert find_preset("walker2d", "mixed", "lsdt").targets == (10000,)


def test_settings_win_over_presets(tmp_path: Path) -> None:
    file = tmp_path / "x.toml"
    file.write_text("[train]\nsteps = 7\nwarmup_steps = 3\n")
    presets = {"train": {"steps": 5, "warmup_steps": 5, "learning_rate": 0.5}}
    config = resolve_config("dt", file, ["train.warmup_steps=2"], presets=presets)
    assert (config.train.steps, config.train.warmup_steps) == (7, 2)
    assert config.train.learning_rate == 0.5


def test_a_run_records_where_its_data_is_from(folder: Path) -> None:
    record = read_json(folder / "store-run" / "run.json")
    assert record["data"]["env_id"] == "Hopper-v5"
    assert record["config"]["train"]["warmup_steps"] == 10_000
    assert "mujoco" in record["versions"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["prepare", "nowhere.hdf5", "--out", "s"], "nowhere.hdf5 does not exist"),
        (["prepare", "mujoco/hopper/expert-v9", "--out", "s"], "--download"),
        (["train", "nowhere", "--out", "run"], "nowhere is not an episode store"),
        (["evaluate", "nowhere"], "nowhere is not a run folder"),
        (["evaluate", "{run}", "--env", "Nope-v1"], "Nope-v1 cannot be made"),
        (["evaluate", "{run}", "--env", "Walker2d-v5"], "sizes (17, 6)"),
        (["evaluate", "{run}", "--episodes", "0"], "at least one"),
        (
            ["train", "{store}", "--out", "{run}", "--policy", "dt", "--screen", "drop"],
            "without --screen",
        ),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(
    folder: Path,
    arguments: list[str],
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    paths = {"{run}": str(folder / "store-run"), "{store}": str(folder / "store")}
    assert main([paths.get(argument, argument) for argument in arguments]) == 2
    printed = capsys.readouterr().err.strip().splitlines()
    assert says in printed[-1]
    assert len(printed) == 1


def test_help_needs_none_of_the_extras() -> None:
    code = (
        "import sys; from ucfrec.commands.cli import build_parser;"
        "from ucfrec_control.cli import CONTROL; build_parser(CONTROL, []);"
        "assert not {'torch', 'mujoco', 'minari', 'h5py'} & sys.modules.keys()"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.realdata
def test_a_clone_of_a_zoo_file_hops(tmp_path: Path) -> None:
    """Behaviour cloning, minutes less than a real run, is well above what falls at once."""
    file = data_folder("control") / "hopper_medium-zoo.hdf5"
    read_d4rl(file).write_store(tmp_path / "store")
    settings = ["train.steps=300", "train.warmup_steps=20", "train.learning_rate=2e-3"]
    settings += ["train.batch_size=256", "train.validate_every=300"]
    options = [argument for setting in settings for argument in ("--set", setting)]
    run = str(tmp_path / "run")
    assert main(["train", str(tmp_path / "store"), "--out", run, "--policy", "bc", *options]) == 0
    out = tmp_path / "rows.json"
    assert main(["evaluate", run, "--checkpoint", "last", "--json", str(out)]) == 0
    (row,) = read_results(out)
    assert row["episodes"] == 20
    assert row["score"] > 15


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.parametrize("file", ZOO[::4])  # every environment, and every kind of data
def test_each_zoo_file_trains_ucf_that_its_environment_judges(tmp_path: Path, file: str) -> None:
    data, store, run = data_folder("control") / f"{file}.hdf5", tmp_path / "store", tmp_path / "run"
    assert main(["prepare", str(data), "--out", str(store)]) == 0
    few = ("crm.max_transitions", "csg.max_transitions", "augment.max_steps")
    quick = [*SETTINGS, "--set", "augment.copies=1", "--set", "crm.epochs=1"]
    quick += [part for name in few for part in ("--set", f"{name}=20000")]
    assert main(["train", str(store), "--out", str(run), "--policy", "ucf", *quick]) == 0
    assert read_json(run / "run.json")["augmentation"]["acceptance"] > 0.5
    out = tmp_path / "rows.json"
    asked = ["--episodes", "2", "--checkpoint", "last", "--json", str(out)]
    assert main(["evaluate", str(run), *asked]) == 0
    rows = read_results(out)
    assert len(rows) == 2  # one for each of the preset's targets
    for row in rows:
        assert row.task == file
        assert "warnings" not in row.details
        assert row["score_low"] <= row["score"] <= row["score_high"] < 20  # it has learned nothing


def test_a_benchmark_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_hdf5(tmp_path / "hopper_medium-made.hdf5", hopper_like((30, 8, 25) * 8))
    settings = (*TINY, "policy.dim=32", "crm.epochs=1", "csg.epochs=1")
    monkeypatch.setitem(
        BUDGETS, "small", Budget("small", ("hopper_medium-made",), 1, Evaluation(2, 1000), settings)
    )
    monkeypatch.setitem(TABLES, "main", {m: METHODS[m] for m in ("lsdt", "ucf")})
    results = tmp_path / "control.jsonl"
    arguments = ["benchmark", "--data", str(tmp_path), "--out", str(tmp_path / "runs")]
    arguments += ["--results", str(results)]
    assert main(arguments) == 0
    rows = [json.loads(line) for line in results.read_text().splitlines()]
    assert sorted((r["method"], r["checkpoint"]) for r in rows) == [
        (method, checkpoint) for method in ("lsdt", "ucf") for checkpoint in ("best", "last")
    ]
    for row in rows:
        assert (row["suite"], row["table"], row["task"]) == (
            "control",
            "main",
            "hopper_medium-made",
        )
        assert row["conditions"].items() >= {"budget": "small", "episodes": 2}.items()
        assert row["metrics"].keys() >= {"score", "return", "length", "validation_loss"}
        assert (row["training_seed"], row["evaluation_seed"]) == (0, 1000)
        assert {"environment", "versions", "commit", "command"} <= row.keys()
    assert str(tmp_path) not in results.read_text()
    before = results.read_text()
    assert main(arguments) == 0
    assert results.read_text() == before
    results.write_text("".join(f"{json.dumps(r)}\n" for r in rows if r["method"] == "ucf"))
    assert main(arguments) == 0
    again = [json.loads(line) for line in results.read_text().splitlines()]
    assert {r["method"] for r in again} == {"lsdt", "ucf"}
    earned = {r["checkpoint"]: r["metrics"]["return"] for r in rows if r["method"] == "lsdt"}
    assert {r["checkpoint"]: r["metrics"]["return"] for r in again[2:]} == earned
    capsys.readouterr()
    assert main([*arguments[:1], "--show-only", *arguments[3:]]) == 0
    assert f"{earned['last']:.3f}" in capsys.readouterr().out
    (tmp_path / "hopper_medium-made.hdf5").rename(tmp_path / "hopper_medium-own.hdf5")
    own = ["--file", "hopper_medium-own", "--method", "lsdt", "--seeds", "2"]
    assert main([*arguments, *own]) == 0
    more = [json.loads(line) for line in results.read_text().splitlines()][len(again) :]
    assert sorted((r["task"], r["method"], r["training_seed"]) for r in more) == [
        ("hopper_medium-own", "lsdt", seed) for seed in (0, 0, 1, 1)
    ]
    assert {r["evaluation_seed"] for r in more} == {1000}


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--method", "nope"], "no method is called nope; there are bc, bc-10"),
        (["--seeds", "0"], "0 training seeds are requested"),
        (["--file", "nowhere"], "nowhere.hdf5 does not exist"),
        (["--results", "{rows}"], "rows.jsonl, line 1 is not a result row"),
    ],
)
def test_what_no_benchmark_can_be_of_is_refused(
    tmp_path: Path, options: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_hdf5(tmp_path / "hopper_medium-zoo.hdf5", hopper_like((30, 8, 25)))
    rows = tmp_path / "rows.jsonl"
    rows.write_text("no row\n")
    given = ["benchmark", "--data", str(tmp_path), "--out", str(tmp_path / "runs")]
    given += ["--file", "hopper_medium-zoo"] if "--file" not in options else []
    assert main([*given, *(str(rows) if o == "{rows}" else o for o in options)]) == 2
    printed = capsys.readouterr().err.strip().splitlines()
    assert says in printed[-1]


def changed(run: Path, to: Path, entry: tuple[str, ...], value: object) -> Path:
    """A copy of a run with another value of an entry of its record; None takes it out."""
    shutil.copytree(run, to)
    record = read_json(run / "run.json")
    inner = record
    for name in entry[:-1]:
        inner = inner[name]
    inner[entry[-1]] = value
    if value is None:
        del inner[entry[-1]]
    (to / "run.json").write_text(json.dumps(record))
    return to


def test_a_run_that_has_not_ended_is_not_evaluated(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = changed(folder / "store-run", tmp_path / "run", ("policy",), None)
    assert main(["evaluate", str(run), "--episodes", "1"]) == 2
    assert f"the training in {run} has not ended" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        (("config",), "text"),
        (("config",), None),
        (("data",), "text"),
        (("data",), {}),
        (("data", "dataset"), 5),
        (("data", "env_id"), 5),
        (("data", "versions"), "text"),
        (("data", "versions"), {"mujoco": 3}),
        (("data", "distractors"), 5),
        (("data", "distractors"), [1]),
        (("data", "env_settings"), [1]),
        (("data", "env_settings"), {"xml_file": "/etc/passwd"}),
        (("data", "env_settings"), {"frame_skip": 10**9}),
        (("data", "env_settings"), {"frame_skip": 0}),
        (("policy",), {}),
    ],
)
def test_a_strangers_run_is_refused_on_one_line(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    entry: tuple[str, ...],
    value: object,
) -> None:
    run = changed(folder / "store-run", tmp_path / "run", entry, value)
    assert main(["evaluate", str(run), "--episodes", "1"]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("ucfrec-control evaluate: ")
    # A run that says nothing of its data is not one of control, and has no figure.
    of_evaluation = value == {} or any(w in str(value) for w in ("xml_file", "frame_skip"))
    if not of_evaluation:
        assert main(["figures", "--runs", str(run), "--out", str(tmp_path / "figures")]) == 2
