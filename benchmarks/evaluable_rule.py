"""Can the log evaluate the decision rule that `train` chooses by default?

    python benchmarks/evaluable_rule.py --out FOLDER [--replications 30]

Each replication collects a log of the catalogue by a softmax policy, with exact propensities,
trains on it, lets `ope` estimate the chosen rule on the test split, and evaluates the rule in the
environment. Wanted: a verdict other than "do not rely" in at least 90% of the replications, and the
true value inside the 95% interval in 90% to 98%.
"""

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.environment import Environment
from ucfrec.evaluation.evaluate import evaluate_policy
from ucfrec.evaluation.simulated_store import simulated_store
from ucfrec.off_policy.evaluate import evaluate_off_policy
from ucfrec.off_policy.score import held_out_sessions
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy

SMALL = ("policy.dim=32", "train.steps=100", "train.learning_rate=1e-3", "train.warmup_steps=15")
SETTINGS = (*SMALL, "train.validate_every=50", "augment.copies=0", "rule.sessions=50")
CATALOG = Environment("synthetic-catalog")


def replicate(folder: Path, seed: int, sessions: int, episodes: int) -> dict[str, Any]:
    """One log, one run, its verdict and its true value."""
    store = EpisodeStore.open(simulated_store(CATALOG, folder, sessions, seed, "softmax"))
    run = folder / "run"
    record = train_run(store, run, resolve_config("ucf", None, SETTINGS, seed))
    assert record.rule is not None
    trained = TrainedPolicy.load(run)
    found = evaluate_off_policy(trained, held_out_sessions([trained]), seed=seed)
    true = evaluate_policy(CATALOG, trained, "ucf", episodes, 1_000_000 + seed)
    rows = {row.method: row for row in found.rows}
    row = rows[found.verdict.estimator or "logged"]
    low, high = row.interval or (float("nan"), float("nan"))
    chosen = next(each for each in record.rule.candidates if each.rule == trained.rule)
    return {
        "seed": seed,
        "rule": str(trained.rule),
        "reliable": found.verdict.reliable,
        "reasons": found.verdict.reasons,
        "estimator": found.verdict.estimator,
        "logged": rows["logged"].value,
        "estimate": row.value,
        "low": low,
        "high": high,
        "true": true.value,
        "inside": low <= true.value <= high,
        "simulated": record.rule.simulated,
        "evidence": chosen.model_dump()["evidence"],
    }


def main() -> None:
    """Replicate and print the shares."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--replications", type=int, default=30)
    parser.add_argument("--sessions", type=int, default=10_000)
    parser.add_argument("--episodes", type=int, default=20_000)
    options = parser.parse_args()
    found = list[dict[str, Any]]()
    for seed in range(options.replications):
        folder = options.out / f"replication-{seed}"
        found.append(replicate(folder, seed, options.sessions, options.episodes))
        print(json.dumps(found[-1]), flush=True)
        shutil.rmtree(folder)
        reliable = [each for each in found if each["reliable"]]
        inside = sum(each["inside"] for each in reliable)
        print(f"reliable {len(reliable)} of {len(found)}, inside {inside} of {len(reliable)}")


if __name__ == "__main__":
    main()
