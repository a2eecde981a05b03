"""CPU time of a warm request: a line of `ucfrec recommend RUN --stream`, and its answer.

    python benchmarks/acting_time.py RUN
    python benchmarks/acting_time.py RUN --against CHECKOUT     # the same by another checkout
    python benchmarks/acting_time.py RUN -- --k 20 --reward-weight 2    # options of `recommend`

Every request is of a new user with 20 rows of history. Two checkouts answer in turn, each in a
process of one thread, so that a slower machine slows both. Appends a row for each checkout to
runs/acting_time/results.jsonl, or to --results, and prints a table.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from measured_rows import append_row, make_parser

from ucfrec.reporting.tables import markdown_table

HERE = Path(__file__).resolve().parents[1]
SUITE = "acting-time"
HISTORY, WARM_UP, BEGIN = 20, 20, 1_700_000_000_000


class Stream:
    """`ucfrec recommend RUN --stream` of a checkout, in a process of its own."""

    def __init__(self, checkout: Path, run: Path, options: Sequence[str]) -> None:
        folders = [checkout, *(checkout / name for name in ("datasets", "simulators", "control"))]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(map(str, folders)),
            "OMP_NUM_THREADS": "1",
        }
        command = [sys.executable, "-m", "ucfrec", "recommend", str(run), "--stream", *options]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
        )

    def answer(self, line: bytes) -> tuple[float, float]:
        """CPU and wall milliseconds of one request."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        cpu, wall = self._cpu_ms(), time.perf_counter()
        self._process.stdin.write(line)
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        if "error" in answer:
            raise SystemExit(f"a request was refused: {answer['error']}")
        return self._cpu_ms() - cpu, 1e3 * (time.perf_counter() - wall)

    def _cpu_ms(self) -> float:
        tasks = Path(f"/proc/{self._process.pid}/task").glob("*/schedstat")
        return sum(int(task.read_text().split()[0]) for task in tasks) / 1e6

    def close(self) -> None:
        self._process.communicate()


def make_line(run: Path, rng: np.random.Generator, user: int) -> bytes:
    """A request of a user with some of the run's items."""
    items = pd.read_parquet(run / "items.parquet")["item_id"].to_numpy()
    history = [
        {"item_id": item, "timestamp": BEGIN + 1000 * n, "reward": n % 2, "session_id": 1}
        for n, item in enumerate(rng.choice(items, size=HISTORY).tolist())
    ]
    return json.dumps({"user_id": f"user {user}", "history": history}).encode() + b"\n"


def main() -> None:
    parser = make_parser(__doc__, SUITE)
    parser.add_argument("run", type=Path, help="run folder of a policy of items")
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="another checkout")
    parser.add_argument("--rounds", type=int, default=300, help="timed requests (300)")
    parser.add_argument("options", nargs="*", help="options of `ucfrec recommend`, after --")
    options = parser.parse_args()
    checkouts = [HERE, *([options.against.resolve()] if options.against else [])]
    rng = np.random.default_rng(0)
    lines = [make_line(options.run, rng, user) for user in range(options.rounds + WARM_UP)]
    streams = [Stream(checkout, options.run, options.options) for checkout in checkouts]
    times = np.array([[stream.answer(line) for stream in streams] for line in lines])[WARM_UP:]
    for stream in streams:
        stream.close()
    table = []
    for checkout, (cpu, wall) in zip(checkouts, times.transpose(1, 2, 0), strict=True):
        metrics = {
            "ratio": float(np.median(times[:, 0, 0] / cpu)),
            "median_ms": float(np.median(cpu)),
            "p99_ms": float(np.quantile(cpu, 0.99)),
            "p99_wall_ms": float(np.quantile(wall, 0.99)),
        }
        conditions = {"rounds": options.rounds, "options": " ".join(options.options)}
        about = {"conditions": conditions, "wall_time_s": float(wall.sum() / 1e3)}
        append_row(
            options.results, SUITE, "one user", checkout.name, metrics, policy="ucf", **about
        )
        table.append((checkout.name, *(f"{value:.3g}" for value in metrics.values())))
    head = ("checkout", "this one's CPU time / its", "median, ms", "99%, ms", "99%, clock, ms")
    print(markdown_table(head, table))


if __name__ == "__main__":
    main()
