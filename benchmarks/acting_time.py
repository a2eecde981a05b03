"""CPU time of a warm request: a line of `ucfrec recommend RUN --stream`, and its answer.

    python benchmarks/acting_time.py RUN
    python benchmarks/acting_time.py RUN --against CHECKOUT     # the same by another checkout
    python benchmarks/acting_time.py --candidates 1000 RUN      # also with so many candidates
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
from typing import Any

import numpy as np
import pandas as pd
from measured_rows import append_row, make_parser

from ucfrec.arrays import Array
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


def make_request(items: Array, rng: np.random.Generator, user: int) -> dict[str, Any]:
    """A request of a user with some of the items."""
    history = [
        {"item_id": item, "timestamp": BEGIN + 1000 * n, "reward": n % 2, "session_id": 1}
        for n, item in enumerate(rng.choice(items, size=HISTORY).tolist())
    ]
    return {"user_id": f"user {user}", "history": history, "new_session": False}


def draw_candidates(items: Array, rng: np.random.Generator, number: int) -> dict[str, Any]:
    """The part of a request that names so many candidates; nothing for 0."""
    some = rng.choice(items, min(number, len(items)), replace=False).tolist()
    return {"candidates": some} if number else {}


def main() -> None:
    parser = make_parser(__doc__, SUITE)
    parser.add_argument("run", type=Path, help="run folder of a policy of items")
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="another checkout")
    parser.add_argument("--candidates", type=int, help="also time requests with so many candidates")
    parser.add_argument("--rounds", type=int, default=300, help="timed requests (300)")
    parser.add_argument("options", nargs="*", help="options of `ucfrec recommend`, after --")
    options = parser.parse_args()
    items = pd.read_parquet(options.run / "items.parquet")["item_id"].to_numpy()
    rng = np.random.default_rng(0)
    requests = [make_request(items, rng, user) for user in range(options.rounds + WARM_UP)]
    checkouts = [HERE, *([options.against.resolve()] if options.against else [])]
    streams = [Stream(checkout, options.run, options.options) for checkout in checkouts]
    arms = [(checkout.name, stream, 0) for checkout, stream in zip(checkouts, streams, strict=True)]
    if options.candidates:
        name = f"{HERE.name}, {options.candidates} candidates"
        arms.append((name, streams[0], options.candidates))
    taken = []
    for request in requests:
        lines = [request | draw_candidates(items, rng, number) for _, _, number in arms]
        taken.append(
            [
                stream.answer(json.dumps(line).encode() + b"\n")
                for (_, stream, _), line in zip(arms, lines, strict=True)
            ]
        )
    times = np.array(taken)[WARM_UP:]
    for stream in streams:
        stream.close()
    table = []
    for (name, _, _), (cpu, wall) in zip(arms, times.transpose(1, 2, 0), strict=True):
        metrics = {
            "ratio": float(np.median(times[:, 0, 0] / cpu)),
            "median_ms": float(np.median(cpu)),
            "p99_ms": float(np.quantile(cpu, 0.99)),
            "p99_wall_ms": float(np.quantile(wall, 0.99)),
        }
        conditions = {"rounds": options.rounds, "options": " ".join(options.options)}
        about = {"conditions": conditions, "wall_time_s": float(wall.sum() / 1e3)}
        append_row(options.results, SUITE, "one user", name, metrics, policy="ucf", **about)
        table.append((name, *(f"{value:.3g}" for value in metrics.values())))
    head = ("checkout", "this one's CPU time / its", "median, ms", "99%, ms", "99%, clock, ms")
    print(markdown_table(head, table))


if __name__ == "__main__":
    main()
