"""Time per user-step: 4,096 users in one `kuairand` environment against one user in a Python loop.

    python -m benchmarks.kuai_speed --environment FOLDER

Both use the same rewards, tags and exit rule. The single user runs under Gymnasium's
`SyncVectorEnv`, so that both are vector environments. They are timed in turn. FOLDER is the
`environment` that `ucfrec benchmark recommendation` makes in its task folder. Appends a row to
runs/kuai_speed/results.jsonl, or to --results.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from tests.support.kuai_reference import OneUser
from ucfrec.code_version import code_version
from ucfrec.provenance import provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows
from ucfrec_simulators.kuai.kuairand import kuairand

RESULTS = Path("runs/kuai_speed/results.jsonl")
USERS = 4096


def seconds_a_step(env: Any, steps: int, generator: np.random.Generator, n_items: int) -> float:
    """CPU seconds per step and user, over `steps` steps with random items."""
    env.reset(seed=0)
    actions = generator.integers(n_items, size=(steps, env.num_envs))
    began = time.process_time()
    for action in actions:
        env.step(action)
    return (time.process_time() - began) / actions.size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--environment", type=Path, required=True, help="folder of the kuairand environment"
    )
    parser.add_argument("--rounds", type=int, default=9, help="timed rounds (default: 9)")
    parser.add_argument(
        "--results", type=Path, default=RESULTS, help=f"file of result rows (default: {RESULTS})"
    )
    options = parser.parse_args()
    many = kuairand(USERS, options.environment)
    one = SyncVectorEnv(
        [lambda: OneUser(many.rewards, many.tags, many.exit_rule)],
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    generator, n_items = np.random.default_rng(0), len(many.item_ids)
    ratios, fast, slow = [], [], []
    for turn in range(options.rounds + 1):
        fast.append(seconds_a_step(many, 20, generator, n_items))
        slow.append(seconds_a_step(one, 1000, generator, n_items))
        if turn:  # the first turn warms up
            ratios.append(slow[-1] / fast[-1])
    low, middle, high = np.quantile(ratios, [0.1, 0.5, 0.9])
    print(
        f"{USERS} users in one environment: 1/{middle:.0f} [1/{low:.0f}, 1/{high:.0f}] per "
        "user-step"
    )
    row = ResultRow(
        suite="kuai-speed",
        table="kuai-speed",
        task="kuairand",
        method="many users",
        policy="random",
        conditions={"users": USERS, "rounds": options.rounds},
        code_version=code_version(Path(__file__), kuairand.__module__),
        metric="ratio",
        metrics={"ratio": middle, "ratio_10": low, "ratio_90": high},
        **provenance(),
    )
    append_rows(options.results, [row])


if __name__ == "__main__":
    main()
