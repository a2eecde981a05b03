"""Datasets from a saved agent that acts in its environment."""

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from ucfrec.errors import InputError
from ucfrec.files.atomic import write_json
from ucfrec.files.locks import claimed, remove_leftovers_within
from ucfrec.provenance import provenance
from ucfrec_control.data.agents import read_agent
from ucfrec_control.data.collect import roll_out
from ucfrec_control.data.d4rl import write_d4rl
from ucfrec_control.data.sac import seed_all
from ucfrec_control.data.trajectories import PACKAGES
from ucfrec_control.environments.environments import make_env


def collect_agent(
    agent: Path, env_id: str, out: Path, *, noise: float, size: int, seed: int
) -> dict[str, Any]:
    """Let a saved agent act and write a dataset in D4RL's layout.

    Args:
        agent: file that Stable-Baselines3 or its contrib package saved.
        env_id: Gymnasium environment with vector observations and actions.
        out: output folder; gets `TASK_AGENT.hdf5` and `MANIFEST.json`.
        noise: standard deviation of Gaussian noise on the agent's deterministic actions, in halves
            of the action space's range.
        size: steps, rounded up to whole episodes.
        seed: of environments and noise.

    Returns:
        One row: `file`, `dataset`, numbers of `trajectories` and `steps`, `mean_return`.

    Raises:
        InputError: the agent cannot be read as data or does not fit the environment, which cannot
            be made; `noise` is negative or not finite, or `size` below 1; or `out` is complete
            already.
    """
    if not 0 <= noise < np.inf or size < 1:
        raise InputError(f"--noise {noise:g} and --size {size}: give at least 0, and at least 1")
    with claimed(out, "filled"):
        remove_leftovers_within(out)
        if (out / "MANIFEST.json").exists():
            raise InputError(f"{out} is complete already; remove it or name another output folder")
        env = make_env(env_id, 1)
        shown, space = env.single_observation_space.shape or (), env.single_action_space
        env.close()
        if len(shown) != 1 or not isinstance(space, Box) or len(space.shape) != 1:
            raise InputError(f"{env_id} has no vector observations and actions")
        actor = read_agent(agent, shown[0], space, noise, seed_all(seed, 5))
        trajectories = roll_out(actor, env_id, size, (seed, 6), f"roll out {agent.stem}")
        task = env_id.split("/")[-1].rsplit("-v", 1)[0].lower()
        name = f"{task}_{agent.stem}" + (f"-noise{noise:g}" if noise else "")
        row: dict[str, Any] = {
            "file": f"{name}.hdf5",
            "dataset": name,
            "trajectories": len(trajectories.lengths),
            "steps": len(trajectories.rewards),
            "mean_return": float(trajectories.returns.mean()),
        }
        recorded: dict[str, Any] = {
            "env_id": env_id,
            "agent": agent.name,
            "noise": noise,
            "seed": seed,
        }
        write_d4rl(trajectories, out / f"{name}.hdf5", {**recorded, **row})
        write_json(out / "MANIFEST.json", {**provenance(PACKAGES), **recorded, "files": [row]})
        return row
