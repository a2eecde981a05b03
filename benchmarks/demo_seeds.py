"""Run the demo with several seeds: mean and standard deviation of every policy.

    python benchmarks/demo_seeds.py --out runs/demos --seeds 0 1 2

Appends the rows to results.jsonl in --out, or to --results, and prints a table. Each seed has its
own logs, trainings and episodes.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ucfrec.acting.decision import DecisionRule
from ucfrec.code_version import code_version, plugin_module
from ucfrec.commands.demo import BEHAVIORS, ENVIRONMENTS, LEARNERS, DemoConfig, demo
from ucfrec.policies.registry import policy_class
from ucfrec.reporting.evaluation_rows import evaluation_row
from ucfrec.reporting.result_row import ResultRow, RowKey
from ucfrec.reporting.rows_file import append_rows, read_rows
from ucfrec.reporting.tables import markdown_table, mean_and_sd
from ucfrec.runs.record import read_record


def row_of(evaluation: Mapping[str, Any], seed: int, code: str) -> ResultRow:
    """The result row of an evaluation of the demo with `seed`, run by code version `code`."""
    name = evaluation["policy"]
    trained = name in LEARNERS
    key = RowKey(
        suite="demo",
        table="demo",
        task=evaluation["environment"],
        method=name,
        policy=LEARNERS[name][0] if trained else BEHAVIORS[name],
        training_seed=seed if trained else None,
        log_seed=seed,
        evaluation_seed=evaluation["seed"],
        config_hash=evaluation["config"],
        code_version=code,
        data_fingerprint=evaluation["fingerprint"],
    )
    if not trained:
        return evaluation_row(evaluation, key)
    rule = DecisionRule.from_dict(evaluation["decision_rule"], f"the evaluation of {name}")
    return evaluation_row(evaluation, key, rule=f"{rule} ({rule.hash})")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for the runs; resumed")
    parser.add_argument(
        "--results", type=Path, help="file of result rows (default: results.jsonl in --out)"
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0, 1, 2], help="demo seeds (default: 0 1 2)"
    )
    options = parser.parse_args()
    results = options.results or options.out / "results.jsonl"
    learners = {policy_class(learner).__module__ for learner, *_ in LEARNERS.values()}
    simulators = [plugin_module("simulators", environment) for environment in ENVIRONMENTS]
    code = code_version("ucfrec.commands.demo", *sorted(learners), *simulators)
    rows = []
    for seed in options.seeds:
        # The code version is in the name, so that runs of other code are not resumed.
        folder = options.out / f"seed-{seed}-{code}"
        for evaluation in demo(folder, seed, DemoConfig()):
            row = row_of(evaluation, seed, code)
            rows.append(row)
            if not any(row.covers(known) for known in read_rows(results)):
                run = folder / row.task / row.method
                config = read_record(run).settings if row.config_hash else None
                append_rows(results, [row], config)
    lines = []
    for environment in ENVIRONMENTS:
        for policy in ("random", "logging", *LEARNERS, "optimal"):
            returns = [row.value for row in rows if (row.task, row.method) == (environment, policy)]
            values = ", ".join(f"{value:.2f}" for value in returns)
            lines.append((environment, policy, mean_and_sd(returns), values))
    print(
        markdown_table(("environment", "policy", "R_cum, mean ± sd over seeds", "each seed"), lines)
    )


if __name__ == "__main__":
    main()
