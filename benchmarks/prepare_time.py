"""Cost of `prepare`: CPU time and peak memory beside vectorised pandas and bare DuckDB.

    python benchmarks/prepare_time.py --rows 200000 1000000 5000000 --rounds 5

Makes random logs in a scratch folder, which is removed at the end; what makes them and what reads
them keep a batch of rows in memory, so 100 million rows (14 GB of disk) are no trouble either:

    python benchmarks/prepare_time.py --rows 1000000 100000000 --methods prepare --rounds 1

Every measurement is a process
of its own, so that its start counts and its memory is its own; the methods take turns. pandas reads
the log into memory and does what `prepare` does, the item vectors with scikit-learn's randomised
SVD; DuckDB sorts, sessionises and writes one Parquet file, and no more. Appends the rows to
runs/prepare_time/results.jsonl, or to --results, and prints a table.
"""

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

SUITE = "prepare-time"
METHODS = ("prepare", "pandas", "duckdb")
START_MS = 1_700_000_000_000
GAP_MS = 1_800_000
DAYS = 30
VISITS = 7
"""Visits of a user; each is of twenty minutes at most."""
ROWS_PER_USER = 50
MOST_ITEMS = 20_000
BATCH = 2**20
FILE_ROWS = 10 * BATCH
"""Most rows of a Parquet file."""


def make_log(folder: Path, rows: int, seed: int) -> None:
    """Write a log in no order: popular items, visits of users, one row in a hundred twice."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    folder.mkdir()
    generator = np.random.default_rng(seed)
    users, items = max(rows // ROWS_PER_USER, 10), max(100, min(MOST_ITEMS, rows // ROWS_PER_USER))
    writer: pq.ParquetWriter | None = None
    for begin in range(0, rows, BATCH):
        n = min(BATCH, rows - begin)
        user = generator.integers(users, size=n)
        item = np.minimum(generator.pareto(1.0, n) * items / 50, items - 1).astype(np.int64)
        visit = user * 7919 + generator.integers(VISITS, size=n) * 104_729
        seconds = visit * 2_654_435_761 % (DAYS * 86_400) + generator.integers(1200, size=n)
        times = START_MS + seconds * 1000
        click = (generator.random(n) < np.where(item % 7 == user % 7, 0.4, 0.1)).astype(np.int8)
        propensity = generator.uniform(0.01, 1, n).astype(np.float32)
        twice = generator.integers(n, size=n // 100)
        for column in (user, item, times):
            column[: len(twice)] = column[twice]
        columns = {"user_id": user, "item_id": item, "timestamp": times, "is_click": click}
        table = pa.table({**columns, "propensity": propensity})
        if begin % FILE_ROWS == 0:
            if writer is not None:
                writer.close()
            path = folder / f"log-{begin // FILE_ROWS:03d}.parquet"
            writer = pq.ParquetWriter(path, table.schema)
        assert writer is not None
        writer.write_table(table)
    assert writer is not None
    writer.close()


def run_prepare(log: Path, out: Path, memory_limit: str) -> None:
    from ucfrec.logs.mapping import LogMapping
    from ucfrec.logs.prepare import PrepareOptions, prepare

    options = PrepareOptions(memory_limit=memory_limit)
    prepare([log], LogMapping(reward="is_click"), out, options)


def run_duckdb(log: Path, out: Path, memory_limit: str) -> None:
    import duckdb

    out.mkdir()
    connection = duckdb.connect(str(out / "work.duckdb"))
    connection.execute("SET enable_progress_bar = false")
    connection.execute("SET memory_limit = ?", [memory_limit])
    window = "WINDOW w AS (PARTITION BY user_id ORDER BY timestamp, item_id)"
    connection.execute(f"""
        COPY (
            SELECT user_id, item_id, timestamp, is_click, propensity,
                sum(first::INT) OVER w AS session
            FROM (
                SELECT *, coalesce(timestamp - lag(timestamp) OVER w > {GAP_MS}, true) AS first
                FROM read_parquet('{log}/*.parquet') {window}
            ) {window}
            ORDER BY user_id, timestamp, item_id
        ) TO '{out / "log.parquet"}'
    """)


def run_pandas(log: Path, out: Path, memory_limit: str) -> None:
    """In memory, whatever the limit."""
    import pandas as pd
    from scipy import sparse
    from sklearn.utils.extmath import randomized_svd

    out.mkdir()
    frame = pd.read_parquet(log)
    frame["reward"] = frame.pop("is_click").astype(float)
    keys = ["user_id", "timestamp", "item_id"]
    frame = frame.sort_values([*keys, "reward"], kind="stable").drop_duplicates(keys, keep="last")
    times, rewards = frame["timestamp"].to_numpy(), frame["reward"].to_numpy()
    users, user_ids = pd.factorize(frame["user_id"], sort=True)
    items, item_ids = pd.factorize(frame["item_id"], sort=True)
    bounds = np.quantile(times, [0.8, 0.9], method="lower")
    split = np.searchsorted(bounds, times, side="right")
    starts = np.append(True, (np.diff(users) != 0) | (np.diff(times) > GAP_MS))
    first = starts | np.append(True, np.diff(split) != 0)
    offsets = np.append(np.flatnonzero(first), len(frame))
    sums = np.append(0.0, np.cumsum(rewards))
    returns = np.repeat(sums[offsets[1:]], np.diff(offsets)) - sums[:-1]
    columns = {
        "item": items.astype("i4"),
        "timestamp": times,
        "reward": rewards.astype("f4"),
        "return_to_go": returns.astype("f4"),
        "propensity": frame["propensity"].to_numpy(),
        "user": users[offsets[:-1]],
        "split": split[offsets[:-1]].astype("u1"),
        "offsets": offsets,
    }
    for name, values in columns.items():
        np.save(out / f"{name}.npy", values)
    pd.DataFrame({"user_id": user_ids}).to_parquet(out / "users.parquet")
    pd.DataFrame({"item_id": item_ids}).to_parquet(out / "items.parquet")
    train = split == 0
    matrix = sparse.coo_matrix((0.25 + rewards[train], (users[train], items[train]))).tocsr()
    matrix.data = np.log1p(matrix.data)
    by_item, by_user = (np.sqrt(np.asarray(matrix.sum(axis=axis)).ravel()) for axis in (0, 1))
    by_item[by_item == 0] = by_user[by_user == 0] = 1
    balanced = sparse.diags(1 / by_user) @ matrix @ sparse.diags(1 / by_item)
    _, strength, directions = randomized_svd(balanced, 33, random_state=0)
    np.save(out / "embeddings.npy", (np.sqrt(strength)[:, None] * directions).T)


RUN = {"prepare": run_prepare, "pandas": run_pandas, "duckdb": run_duckdb}


def measure(method: str, log: Path, out: Path, memory_limit: str) -> tuple[float, float, float]:
    """CPU seconds, wall seconds and peak resident MiB of a process that runs a method."""
    began = time.perf_counter()
    command = [sys.executable, __file__, "--run", method, str(log), str(out), memory_limit]
    child = subprocess.Popen(command)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    wall = time.perf_counter() - began
    if child.returncode:
        raise SystemExit(f"{method} failed on {log}")
    return usage.ru_utime + usage.ru_stime, wall, usage.ru_maxrss / 1024


def compare(options: argparse.Namespace, rows: int, folder: Path) -> list[tuple[str, ...]]:
    """Measure all methods on a log of `rows` rows; returns lines of the table."""
    from measured_rows import append_row

    log, out = folder / "log", folder / "out"
    make_log(log, rows, options.seed)
    taken: dict[str, list[tuple[float, float, float]]] = {name: [] for name in options.methods}
    for _ in range(options.rounds):
        for method, found in taken.items():
            found.append(measure(method, log, out, options.memory_limit))
            shutil.rmtree(out)
    median = {name: np.median(found, axis=0) for name, found in taken.items()}
    lines = list[tuple[str, ...]]()
    for method, found in taken.items():
        cpu, wall, peak = median[method]
        ratios = np.divide([c for c, _, _ in found], [c for c, _, _ in taken["prepare"]])
        low, middle, high = np.quantile(ratios, [0.1, 0.5, 0.9])
        metrics = {
            **{"ratio": middle, "ratio_10": low, "ratio_90": high},
            "cpu_s": cpu,
            "us_per_row": cpu / rows * 1e6,
            "peak_mib": max(p for _, _, p in found),
        }
        conditions = {"rows": rows, "rounds": options.rounds, "memory_limit": options.memory_limit}
        known = {"policy": "none", "log_seed": options.seed, "conditions": conditions}
        known |= {"wall_time_s": wall, "peak_memory_mib": peak}
        append_row(options.results, SUITE, "random log", method, metrics, **known)
        about = f"{middle:.2f} [{low:.2f}, {high:.2f}]"
        times = f"{cpu:.2f}", f"{cpu / rows * 1e6:.2f}", about
        lines.append((f"{rows:,}", method, *times, f"{wall:.1f}", f"{metrics['peak_mib']:,.0f}"))
    return lines


def main() -> None:
    if sys.argv[1:2] == ["--run"]:  # a process that is measured imports no more than it needs
        method, log, out, memory_limit = sys.argv[2:]
        RUN[method](Path(log), Path(out), memory_limit)
        return
    from measured_rows import make_parser

    from ucfrec.files.atomic import scratch_folder
    from ucfrec.reporting.tables import markdown_table

    parser = make_parser(__doc__, SUITE)
    sizes = [200_000, 1_000_000, 5_000_000]
    parser.add_argument("--rows", type=int, nargs="+", default=sizes, help=f"(default: {sizes})")
    parser.add_argument("--rounds", type=int, default=5, help="timed rounds (default: 5)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--memory-limit", default="2GB", help="of prepare and DuckDB")
    parser.add_argument(
        "--methods", nargs="+", choices=METHODS, default=METHODS, help="prepare among them"
    )
    parser.add_argument("--folder", type=Path, default=Path(), help="of the scratch (default: .)")
    options = parser.parse_args()
    lines = []
    for rows in options.rows:
        with scratch_folder(options.folder, "prepare-time") as folder:
            lines += compare(options, rows, folder)
    head = ("rows", "method", "CPU s", "µs a row", "/ prepare's, median [10%, 90%]", "wall s")
    print(markdown_table((*head, "peak MiB"), lines))


if __name__ == "__main__":
    main()
