"""Datasets of a saved agent, recorded in its environment."""

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium.spaces import Box

from ucfrec.acting.rollout import Actor, Step, rollout
from ucfrec.arrays import IntArray
from ucfrec.errors import InputError
from ucfrec.files.atomic import lock_path, remove_leftovers, write_json
from ucfrec.processes import progress
from ucfrec.provenance import provenance
from ucfrec_control.data.agents import read_agent
from ucfrec_control.data.d4rl import write_d4rl
from ucfrec_control.data.trajectories import PACKAGES, Trajectories
from ucfrec_control.environments.environments import SIDE_BY_SIDE, make_env

SHOWN: Final = ("dataset", "trajectories", "steps", "mean_return")
_COLUMNS: Final = (
    *("episodes", "observations", "actions", "rewards", "next_observations"),
    *("terminated", "truncated"),
)


def collect_agent(
    agent: Path, env_id: str, out: Path, *, noise: float, size: int, seed: int
) -> dict[str, Any]:
    """Let a saved agent act and write a dataset in D4RL's layout. InputError if the agent cannot be
    read as data or does not fit the environment, the environment cannot be made, `noise` is
    negative or not finite, `size` is below 1, or `out` is complete already.

    Args:
        agent: file that Stable-Baselines3 or its contrib package saved.
        out: gets `TASK_AGENT.hdf5` and `MANIFEST.json`.
        noise: standard deviation of Gaussian noise on the agent's deterministic actions, in halves
            of the action space's range.
        size: steps, rounded up to whole episodes.

    Returns:
        `file`, `dataset`, numbers of `trajectories` and `steps`, and undiscounted `mean_return`.
    """
    if not 0 <= noise < np.inf or size < 1:
        raise InputError(f"--noise {noise:g} and --size {size}: give at least 0, and at least 1")
    with lock_path(out, "filled"):
        remove_leftovers(out, within=True)
        if (out / "MANIFEST.json").exists():
            raise InputError(f"{out} is complete already; remove it or name another output folder")
        env = make_env(env_id, 1)
        shape, space = env.single_observation_space.shape or (), env.single_action_space
        env.close()
        if len(shape) != 1 or not isinstance(space, Box) or len(space.shape) != 1:
            raise InputError(f"{env_id} has no vector observations and actions")
        actor = read_agent(agent, shape[0], space, noise, _derive_seed(seed, 5))
        trajectories = roll_out(actor, env_id, size, seed, f"roll out {agent.stem}")
        task = env_id.split("/")[-1].rsplit("-v", 1)[0].lower()
        name = f"{task}_{agent.stem}" + (f"-noise{noise:g}" if noise else "")
        recorded = {"env_id": env_id, "agent": agent.name, "noise": noise, "seed": seed}
        made_by = provenance(PACKAGES)
        row: dict[str, Any] = {
            "file": f"{name}.hdf5",
            "dataset": name,
            "trajectories": len(trajectories.lengths),
            "steps": len(trajectories.rewards),
            "mean_return": float(trajectories.returns.mean()),
        }
        metadata = {**recorded, **row, "versions": json.dumps(made_by["versions"])}
        write_d4rl(trajectories, out / row["file"], metadata)
        write_json(out / "MANIFEST.json", {**made_by, **recorded, "files": [row]})
        return row


def _derive_seed(*key: int) -> int:
    return int(np.random.SeedSequence(key).generate_state(1)[0])


def roll_out(actor: Actor, env_id: str, size: int, seed: int, describe: str) -> Trajectories:
    """Roll out whole episodes, with at least `size` steps in total.

    Every round has a fixed number of episodes, so that short episodes are not overrepresented.
    InputError if the environment cannot be made.
    """
    # A small `size` needs few parallel episodes: the usual step limit of these tasks is 1000.
    env = make_env(env_id, min(SIDE_BY_SIDE, max(1, size // 1000)))
    steps: list[Step] = []
    rounds: list[IntArray] = []
    with progress(size, describe, "steps") as bar:
        while (done := sum(len(step.rewards) for step in steps)) < size:
            bar.update(done - bar.n)
            earlier, number = len(steps), len(rounds)
            episode_seed = _derive_seed(seed, 6, number)
            rollout(env, actor, env.num_envs, episode_seed, steps.append, describe="episodes")
            rounds.append(np.repeat(number, sum(len(step.rewards) for step in steps[earlier:])))
    env.close()
    columns = {name: np.concatenate([getattr(step, name) for step in steps]) for name in _COLUMNS}
    # The episodes of a round ran in parallel; each becomes contiguous.
    order = np.lexsort((columns["episodes"], np.concatenate(rounds)))
    columns = {name: values[order] for name, values in columns.items()}
    ends = np.flatnonzero(columns["terminated"] | columns["truncated"])
    return Trajectories(
        **{name: columns[name].astype(np.float32) for name in _COLUMNS[1:4]},
        lengths=np.diff(ends, prepend=-1),
        terminated=columns["terminated"][ends],
        final_observations=columns["next_observations"][ends].astype(np.float32),
        source={"where": f"episodes of {env_id}", "env_id": env_id},
    )
