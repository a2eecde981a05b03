"""Load on `ucfrec serve` by a real client on this machine: requests per second and latency.

    python benchmarks/serve_load.py RUN --results benchmarks/results/serve_load.jsonl

Starts the server on a free port of the loopback interface, with further options such as
`--reward-weight 2`, and asks it with wrk, which has to be installed: one client first, then many;
then the same with each further number of workers. Appends a row for each number of clients and
prints a table. Requests/s are of wall time. Client and server share the cores; the CPU time of
either, unlike the rate, hardly depends on what else these do.
"""

import json
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from measured_rows import append_row, make_parser

from ucfrec.reporting.tables import markdown_table
from ucfrec.runs.trained_policy import TrainedPolicy

SUITE = "serve-load"
_SCRIPT = """
wrk.method, wrk.body = "POST", {body}
wrk.headers["Content-Type"] = "application/json"
response = function(status) if status ~= 200 then os.exit(1) end end
done = function(summary, latency)
  io.write(string.format("PERCENTILES %f %f %f %f %d\\n", latency:percentile(50) / 1000,
    latency:percentile(90) / 1000, latency:percentile(99) / 1000, summary.duration / 1e6,
    summary.requests))
end
"""


def request(trained: TrainedPolicy, rows: int) -> bytes:
    """A request of an unknown user with a history of random items."""
    assert trained.item_ids is not None
    rng = np.random.default_rng(0)
    items = rng.choice(trained.item_ids, size=rows).tolist()
    size = trained.record.observation_size
    history: list[dict[str, Any]] = [
        {"item_id": item, "timestamp": 1_700_000_000_000 + 1000 * n, "reward": n % 2}
        for n, item in enumerate(items)
    ]
    for row in history:
        if trained.record.session_by == "session_id":
            row["session_id"] = 1
        if size:
            row["observation"] = [0.0] * size
    request = {"user_id": "load", "history": history, "new_session": False, "k": 10}
    return json.dumps(request).encode()


@contextmanager
def served(run: Path, *options: str) -> Iterator[str]:
    """The address of a server."""
    command = [sys.executable, "-m", "ucfrec.commands.cli", "serve", str(run), "--port", "0"]
    with subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        ready = process.stdout.readline()
        try:
            yield ready.split("ready at ")[1].split()[0]
        finally:
            process.terminate()


def with_wrk(address: str, body: bytes, clients: int, seconds: float) -> dict[str, float]:
    """Milliseconds and requests per second, as wrk finds them."""
    with tempfile.NamedTemporaryFile("w", suffix=".lua") as script:
        script.write(_SCRIPT.format(body=json.dumps(body.decode())))
        script.flush()
        command = ["wrk", "-t1", f"-c{clients}", f"-d{seconds:.0f}s", "-s", script.name]
        ran = subprocess.run(
            [*command, f"{address}/recommendations"], capture_output=True, text=True, check=True
        )
    found = re.search(r"PERCENTILES (.*)", ran.stdout)
    assert found is not None, ran.stdout
    p50, p90, p99, taken, count = map(float, found[1].split())
    return {"rate": count / taken, "p50_ms": p50, "p90_ms": p90, "p99_ms": p99}


def cpu_seconds(address: str) -> tuple[float, float]:
    """CPU time of the server, and of what asks it, so far."""
    metrics = httpx.get(f"{address}/metrics").text
    of_server = re.search(r"process_cpu_seconds_total (\d\S+)", metrics)
    assert of_server is not None
    who = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    used = [resource.getrusage(each) for each in who]
    return float(of_server[1]), sum(each.ru_utime + each.ru_stime for each in used)


def measured(address: str, body: bytes, clients: int, seconds: float) -> dict[str, float]:
    """Rate, latencies, and CPU milliseconds of a request on either side."""
    before = cpu_seconds(address)
    found = with_wrk(address, body, clients, seconds)
    after, count = cpu_seconds(address), found["rate"] * seconds
    for name, then, now in zip(("server", "client"), before, after, strict=True):
        found[f"{name}_cpu_ms"] = 1e3 * (now - then) / count
    return found


def main() -> None:
    parser = make_parser(__doc__, SUITE)
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder of `ucfrec train`")
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 8, 64])
    parser.add_argument("--workers", type=int, nargs="+", default=[1], help="(default: 1)")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each (default: 10)")
    parser.add_argument("--history", type=int, default=20, help="rows of a request (default: 20)")
    parser.add_argument("--threads", type=int, default=1, help="of a forward pass (default: 1)")
    options, rule = parser.parse_known_args()
    trained = TrainedPolicy.load(options.run)
    assert trained.item_ids is not None
    lines = list[tuple[object, ...]]()
    body = request(trained, options.history)
    known = {name: getattr(options, name) for name in ("history", "threads", "seconds")}
    known["options"] = " ".join(rule)
    about: dict[str, Any] = {"policy": trained.name}
    about["data_fingerprint"] = trained.record.fingerprint
    task = f"{len(trained.item_ids):,} items"
    for workers in options.workers:
        how = ("--workers", str(workers), "--threads", str(options.threads), *rule)
        with served(options.run, *how) as address:
            measured(address, body, 4 * workers, options.seconds)  # warms the server up
            for clients in options.clients:
                began = time.perf_counter()
                found = measured(address, body, clients, options.seconds)
                about["wall_time_s"] = time.perf_counter() - began
                about["conditions"] = {"clients": clients, "workers": workers, **known}
                append_row(options.results, SUITE, task, "wrk", found, **about)
                lines.append((workers, clients, *(f"{value:,.4g}" for value in found.values())))
    heads = ("workers", "clients", "requests/s", "p50 ms", "p90 ms", "p99 ms")
    print(markdown_table((*heads, "CPU of the server, ms", "of the client, ms"), lines))


if __name__ == "__main__":
    main()
