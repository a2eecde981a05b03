"""Control: trajectories in D4RL's file layout, a policy that is asked for a return, and its score.

Run it with `python examples/control_policy.py [FOLDER]`; it takes under a minute on two cores. It
needs the extra `control` (`pip install ".[control]"`) and says so where that is missing.

Real D4RL files (`hopper_medium-v2.hdf5`, …) go through the same three steps: prepare, train,
evaluate. Here two simple behaviours make a small file in a few seconds, so the scores are low: what
to look at is whether the policy earns more when it is asked for more.
"""

import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ucfrec.arrays import Float32Array

if TYPE_CHECKING:
    from ucfrec.results.row import ResultRow

ENV, EPISODES = "Hopper-v5", 150
TARGETS = (50.0, 150.0, 250.0)
SETTINGS = ["train.steps=400", "train.learning_rate=3e-3", "train.warmup_steps=50"]
SETTINGS += ["train.cosine=true", "policy.dim=32", "policy.context=5", "crm.epochs=2"]


# Part 1: trajectories.
#
# One behaviour draws random actions and falls at once. The other holds nearly still and stays up a
# while longer. D4RL's layout is one array a column, all trajectories one after the other;
# `terminals` marks a fall, `timeouts` the step limit.


def collect(path: Path) -> Path:
    """Write EPISODES trajectories to an HDF5 file."""
    import gymnasium
    import h5py

    rng = np.random.default_rng(0)
    env = gymnasium.make(ENV)
    columns: dict[str, list[Any]] = {
        name: [] for name in ("observations", "actions", "rewards", "terminals", "timeouts")
    }
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=episode)
        spread, done = (1.0, 0.1)[episode % 2], False
        while not done:
            action = np.clip(rng.normal(0, spread, size=3), -1, 1).astype(np.float32)
            following, reward, terminated, truncated, _ = env.step(action)
            step = (observation, action, reward, terminated, truncated)
            for name, value in zip(columns, step, strict=True):
                columns[name].append(value)
            observation, done = following, terminated or truncated
    env.close()
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            flags = name in ("terminals", "timeouts")
            file[name] = np.asarray(values, dtype=bool if flags else np.float32)
        file.attrs["env_id"] = ENV
    return path


# Part 2: prepare and train.
#
# On the command line: `ucfrec-control prepare FILE --out STORE`, then `ucfrec-control train STORE
# --out RUN --set …`. Settings start from the authors' own for the task and learner; those below
# make it small.


def train(file: Path, folder: Path) -> Path:
    """Write the store of `file` and train UCF on it; returns the run folder."""
    from ucfrec.runs.config import resolve_config
    from ucfrec_control.data.d4rl import read_d4rl
    from ucfrec_control.training.train import dataset_of, preset_of, train_control

    store = read_d4rl(file).write_store(folder / "store")
    returns: Float32Array = store.returns
    print(f"{store.n_episodes} trajectories, returns {returns.min():.0f} to {returns.max():.0f}")
    preset = preset_of(dataset_of(store), "ucf")
    config = resolve_config("ucf", None, SETTINGS, presets=preset.tables)
    train_control(store, folder / "run", config)
    return folder / "run"


# Part 3: evaluate.
#
# The score is 0 for D4RL's random policy and 100 for its expert. The same starts are played for
# each target return.


def evaluate(run: Path) -> "list[ResultRow]":
    """One result row a target return."""
    from ucfrec_control.training.evaluate import evaluate_run

    return evaluate_run(run, episodes=20, seed=100, targets=TARGETS, checkpoints=("best",))


def main(folder: Path) -> "list[ResultRow]":
    """Run all parts; returns the result rows, none without the extra."""
    missing = [name for name in ("h5py", "mujoco") if find_spec(name) is None]
    if missing:
        print(f"skipped: {' and '.join(missing)} not installed; pip install '.[control]'")
        return []
    rows = evaluate(train(collect(folder / "hopper_two-behaviours.hdf5"), folder))
    for row in rows:
        print(
            f"asked for {row['target_return']:.0f}: return {row['return']:.0f}, score "
            f"{row['score']:.1f} [{row['score_low']:.1f}, {row['score_high']:.1f}]"
        )
    return rows


if __name__ == "__main__":
    if len(sys.argv) > 1:
        chosen = Path(sys.argv[1])
        chosen.mkdir(parents=True)
        main(chosen)
    else:
        with tempfile.TemporaryDirectory() as scratch:
            main(Path(scratch))
