"""Every goal of docs/scale.md, each with its peer beside it: `make bench`.

    python benchmarks/bench.py --reference CLONE --previous CLONE

Makes a log of the synthetic catalogue, a store and a small run of it in --out, then runs the other
benchmarks of this folder one after the other (hours), and prints a table from their rows: the
median at every size, the goal, and how the cost grows from one size to the next. What has rows in
--out is not measured again; remove its file of rows to measure anew. --show-only prints the table
from a folder of rows, such as benchmarks/results. Without --reference (Decision ConvFormer's
repository) or --previous (an earlier version of this one), what compares with them is left out.
"""

import argparse
import math
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import read_rows
from ucfrec.reporting.tables import NONE, markdown_table

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Goal:
    """A line of the table."""

    what: str
    file: str
    """Of the rows, without its ending."""
    metric: str
    size: str
    """The condition that says how large it was."""
    limit: float
    """Median to reach: at most so much, or at least if `more`."""
    of: Mapping[str, str]
    """Entries that a row must have."""
    more: bool = False
    inverse: bool = False
    """Whether rows have the ratio the other way round."""


GOALS = (
    Goal(
        "UCF's training step / the authors' DC's, by width",
        *("step_time", "ratio_to_reference_dc", "dim", 0.33),
        {"method": "ucf"},
    ),
    Goal(
        "prepare / vectorised pandas, times faster, by rows",
        *("prepare_time", "ratio", "rows", 3.0),
        {"method": "pandas"},
        more=True,
    ),
    Goal(
        "prepare / bare DuckDB, by rows",
        *("prepare_time", "ratio", "rows", 1.5),
        {"method": "duckdb"},
        inverse=True,
    ),
    Goal(
        "prepare, CPU µs a row, by rows",
        *("prepare_time", "us_per_row", "rows", math.inf),
        {"method": "prepare"},
    ),
    Goal(
        "prepare, peak MiB, by rows",
        *("prepare_time", "peak_mib", "rows", 2048),
        {"method": "prepare"},
    ),
    Goal("edits / bare passes, by size of the state", "augmentation_time", "ratio", "state", 5, {}),
    Goal(
        "causal reward model, CPU s, by fits",
        *("reward_model_time", "seconds", "seeds", 20),
        {"method": "now"},
    ),
    Goal(
        "step on sampled items / at 7,583, by items",
        *("catalogue_step_time", "ratio", "items", 1.3),
        {"method": "ucf, softmax of sampled"},
    ),
    Goal(
        "one user by onnxruntime, 99%, CPU ms",
        *("acting_time", "p99_ms", "items", 2),
        {"task": "one user"},
    ),
    Goal(
        "one user of a large catalogue, the same",
        *("acting_time", "p99_ms", "items", 20),
        {"task": "one user, large catalogue"},
    ),
    Goal(
        "all users, CPU ms each",
        *("acting_time", "median_ms", "items", 0.4),
        {"task": "all users"},
    ),
    Goal(
        "VirtualTaobao / the authors', times faster",
        *("acting_time", "ratio", "items", 150),
        {"task": "VirtualTaobao"},
        more=True,
        inverse=True,
    ),
    Goal(
        "two processes / one, windows a second, by batch",
        *("processes_time", "ratio", "batch", 1.6),
        {},
        more=True,
    ),
)


def measure(options: argparse.Namespace) -> None:
    """Run what has no rows yet."""
    store, run = data(options.out)
    taobao = ["--original", str(options.taobao)] if options.taobao else []
    reference = ["--reference", str(options.reference)] if options.reference else []
    acting = ["acting_time.py", str(run), str(store), "--engine", "onnxruntime"]
    commands = {
        "step_time": [
            ["step_time.py", "--dim", width, "--learner", "ucf", *reference]
            for width in ("64", "128", "256")
        ],
        "seeds_time": [["seeds_time.py"]],
        "catalogue_step_time": [["catalogue_step_time.py"]],
        "augmentation_time": [["augmentation_time.py"]],
        "processes_time": [["processes_time.py", str(store)]],
        "acting_time": [[*acting, "--items", "1000000", *taobao]],
        "prepare_time": [["prepare_time.py", "--folder", str(options.out)]],
    }
    if options.previous:
        fits = ["reward_model_time.py", str(store), "--previous", str(options.previous)]
        commands["reward_model_time"] = [fits]
    for number, (name, several) in enumerate(commands.items()):
        rows = options.out / f"{name}.jsonl"
        if rows.exists():
            continue
        print(f"{number + 1} of {len(commands)}: {name}", flush=True)
        unfinished = rows.with_suffix(".part")
        unfinished.unlink(missing_ok=True)
        for command in several:
            python(str(HERE / command[0]), *command[1:], "--results", str(unfinished))
        unfinished.rename(rows)


def data(out: Path) -> tuple[Path, Path]:
    """A store of the synthetic catalogue and a run on it, made once."""
    logs, store, run = out / "logs", out / "store", out / "run"
    ucfrec = ("-m", "ucfrec")
    if not logs.exists():
        environment = ("--env", "synthetic-catalog", "--sessions", "4000")
        python(*ucfrec, "collect", *environment, "--out", str(logs))
    if not store.exists():
        log = str(logs / "sessions.parquet")
        python(*ucfrec, "prepare", log, "--out", str(store), "--reward", "is_click")
    settings = ("train.steps=300", "train.validate_every=100", "policy.dim=128", "augment.copies=0")
    chosen = (part for each in settings for part in ("--set", each))
    python(*ucfrec, "train", str(store), "--out", str(run), *chosen)
    return store, run


def python(*arguments: str) -> None:
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, *arguments], env=environment, check=True)


def table(folder: Path) -> str:
    """The goals beside the latest rows of each size."""
    lines = []
    for goal in GOALS:
        path = folder / f"{goal.file}.jsonl"
        found = sizes(read_rows(path), goal) if path.exists() else {}
        lines.append((goal.what, *judged(goal, found), growth(found)))
    return markdown_table(("what", "median", "goal", "reached", "grows by"), lines)


def sizes(rows: list[ResultRow], goal: Goal) -> dict[float, float]:
    """Medians by size, in order."""
    found = {}
    for row in rows:
        if all(getattr(row, key) == value for key, value in goal.of.items()):
            value = row.metrics.get(goal.metric)
            if value is not None and goal.size in row.conditions:
                size = float(row.conditions[goal.size])
                found[size] = 1 / value if goal.inverse else value
    return dict(sorted(found.items()))


def judged(goal: Goal, found: Mapping[float, float]) -> tuple[str, str, str]:
    """Medians by size, the goal, and at which sizes it is reached."""
    if not found:
        return NONE, limit_of(goal), NONE
    medians = ", ".join(f"{size:,.0f}: {value:.3g}" for size, value in found.items())
    held = [value >= goal.limit if goal.more else value <= goal.limit for value in found.values()]
    reached = "yes" if all(held) else f"{sum(held)} of {len(held)}"
    return medians, limit_of(goal), NONE if math.isinf(goal.limit) else reached


def limit_of(goal: Goal) -> str:
    return NONE if math.isinf(goal.limit) else f"{'≥' if goal.more else '≤'} {goal.limit:g}"


def growth(found: Mapping[float, float]) -> str:
    """The factor from each size to the next."""
    values = list(found.values())
    factors = [f"{after / before:.2f}" for before, after in pairwise(values)]
    return ", ".join(factors) or NONE


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("runs/bench"), help="(runs/bench)")
    parser.add_argument("--reference", type=Path, metavar="CLONE", help="Decision ConvFormer")
    parser.add_argument("--previous", type=Path, metavar="CLONE", help="an earlier ucfrec")
    parser.add_argument("--taobao", type=Path, metavar="CLONE", help="the authors' VirtualTaobao")
    parser.add_argument("--show-only", action="store_true", help="measure nothing")
    options = parser.parse_args()
    if not options.show_only:
        options.out.mkdir(parents=True, exist_ok=True)
        measure(options)
    print(table(options.out))


if __name__ == "__main__":
    main()
