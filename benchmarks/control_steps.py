"""What control's sequence policies earn after 1,000, 2,000 and 4,000 steps: how long to train.

    python benchmarks/control_steps.py --data $UCFREC_DATA/control --out runs/steps --workers 2

First every method of the main table on all files with 1,000 steps, at learning rates that were
chosen for so many (results/control_rates_1000_steps.jsonl); then UCF without copies, DC and DT, all
without embeddings of time steps, on two files with 2,000 and 4,000 steps at two rates. One training
seed. About 70 minutes on two cores. What has rows in --results is not measured again; --show-only
prints the tables from rows and measures nothing.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import benchmarking, read_configurations, read_rows
from ucfrec.reporting.statistics import grouped
from ucfrec.reporting.tables import markdown_table
from ucfrec_control.benchmark.budgets import BUDGETS, Budget
from ucfrec_control.benchmark.methods import METHODS
from ucfrec_control.benchmark.plan import benchmark
from ucfrec_control.benchmark.rates import best_rates
from ucfrec_control.benchmark.tables import score_table
from ucfrec_control.learners.rl_baselines import ALGORITHMS

RESULTS = Path(__file__).parent / "results"
FILES = ("halfcheetah_medium-expert-zoo", "walker2d_medium-expert-zoo")
FEW = ("ucf-wo-count", "dc-wo-time", "dt-wo-time")
ALL = tuple(name for name, (learner, _) in METHODS.items() if learner not in ALGORITHMS)
CHOOSING_SEED = 5000
"""Evaluation seed of the two files: not that of the reported tables."""


def budgets() -> Iterator[tuple[str, Budget, tuple[str, ...]]]:
    """A name, the size and the methods of each part."""
    small = replace(BUDGETS["small"], seeds=1)

    def of_steps(budget: Budget, steps: int, *settings: str) -> Budget:
        steps_of = (f"train.steps={steps}", f"train.validate_every={steps // 2}")
        return replace(budget, settings=(*budget.settings, *steps_of, *settings))

    rates = best_rates(read_rows(RESULTS / "control_rates_1000_steps.jsonl"))
    yield "1000", of_steps(replace(small, rates=rates), 1000), ALL
    two = replace(small, files=FILES, rates={}, evaluation_seed=CHOOSING_SEED)
    for steps in (2000, 4000):
        for rate in (3e-3, 1e-2):
            yield f"{steps}-{rate:g}", of_steps(two, steps, f"train.learning_rate={rate:g}"), FEW


def tables(rows: list[ResultRow], configurations: Path) -> str:
    """A table of scores for each part, named by its steps, and by its rate where it has one."""
    configs, parts = read_configurations(configurations), []

    def part(row: ResultRow) -> tuple[float, str]:
        rate = configs[str(row.config_hash)]["train"]["learning_rate"]
        chosen = row.evaluation_seed != CHOOSING_SEED
        return row.metrics["steps"], "chosen rates" if chosen else f"rate {rate:g}"

    last = [row for row in rows if row.checkpoint == "last"]
    for (steps, rate), own in grouped(last, part).items():
        lines = score_table(own, "last")
        table = markdown_table(list(lines[0]), [list(line.values()) for line in lines])
        parts.append(f"{steps:,.0f} steps, {rate}:\n\n{table}")
    return "\n\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="folder of the HDF5 files")
    parser.add_argument("--out", type=Path, help="folder for stores and runs; resumed")
    parser.add_argument("--results", type=Path, default=RESULTS / "control_steps.jsonl")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--show-only", action="store_true")
    options = parser.parse_args()
    if not options.show_only:
        if options.data is None or options.out is None:
            parser.error("--data and --out are needed, or --show-only")
        with benchmarking(options.results):
            for name, budget, methods in budgets():
                benchmark(
                    options.data,
                    options.out / name,
                    options.results,
                    budget,
                    "small",
                    options.workers,
                    methods=methods,
                )
    print(tables(read_rows(options.results), options.results.parent))


if __name__ == "__main__":
    main()
