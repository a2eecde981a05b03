"""Windows a second of a training step of UCF, beside the counted floor of the device.

    python benchmarks/gpu_rates.py STORE --peak-tflops 67 --peak-bf16-tflops 989 --bandwidth 4800

Trains on windows of STORE, drawn before the clock runs, at batches of 64 and 4,096 in float32 and
bfloat16, on the GPU if there is one. Prints a table and appends the rows to
runs/gpu_rates/results.jsonl, or to --results.

The floor is the longer of two times: of the operations of matrix products (counted by PyTorch's
FlopCounterMode, which leaves out the rest) at the peak rate, and of the bytes that any step has to
move at the peak bandwidth: weights, gradients and both moments of the optimizer read and written
once, and the windows read. What is printed as `of the floor` is the measured time over that one.
Peaks are those of the device's data sheet; float32 products run as TF32 only with --tf32.
"""

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from ucfrec.code_version import code_version
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.fitting.row_optimizer import RowAdamW, clip_gradients
from ucfrec.policies.base import SequencePolicy
from ucfrec.provenance import provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows
from ucfrec.reporting.tables import markdown_table
from ucfrec.runs.config import resolve_config
from ucfrec.runs.start import new_policy, training_views

RESULTS = Path("runs/gpu_rates/results.jsonl")
PRECISIONS = ("float32", "bfloat16")
_BATCHES_HELD = 4
_FLOAT = 4


class Counted(NamedTuple):
    """What a step has to do at least."""

    flops: int
    """Floating-point operations of matrix products, forward and backward."""
    bytes: int
    """Read from and written to the device's memory."""


def step(
    policy: SequencePolicy, optimizer: torch.optim.Optimizer, windows: Windows, precision: str
) -> None:
    """A training step, as `ucfrec train` takes it."""
    optimizer.zero_grad(set_to_none=True)
    lower = precision == "bfloat16"
    with torch.autocast(windows.states.device.type, dtype=torch.bfloat16, enabled=lower):
        loss, _ = policy.loss(windows)
    loss.backward()  # type: ignore[no-untyped-call]
    clip_gradients(policy.parameters(), 0.25)
    optimizer.step()


def counted(policy: SequencePolicy, windows: Windows) -> Counted:
    """Operations and bytes of a step."""
    with FlopCounterMode(display=False) as counter:
        loss, _ = policy.loss(windows)
        loss.backward()  # type: ignore[no-untyped-call]
    weights = sum(each.numel() for each in policy.parameters())
    given = sum(
        each.numel() * each.element_size()
        for each in (windows.states, windows.actions, windows.rewards, windows.returns_to_go)
    )
    # Weights and two moments are read and written, gradients written and read.
    return Counted(counter.get_total_flops(), 8 * _FLOAT * weights + given)


def seconds(
    policy: SequencePolicy, batches: list[Windows], precision: str, steps: int
) -> np.ndarray:
    """Seconds (steps,) of steps by the clock, after three that count not."""
    optimizer = RowAdamW(policy.parameters(), fused=True)
    taken = []
    for number in range(steps + 3):
        windows = batches[number % len(batches)]
        _wait(windows)
        began = time.perf_counter()
        step(policy, optimizer, windows, precision)
        _wait(windows)
        taken.append(time.perf_counter() - began)
    return np.asarray(taken[3:])


def _wait(windows: Windows) -> None:
    if windows.states.is_cuda:
        torch.cuda.synchronize()


def floor_of(found: Counted, options: argparse.Namespace, precision: str) -> float | None:
    """Seconds that a step takes at least; None without the peaks."""
    peak = options.peak_bf16_tflops if precision == "bfloat16" else options.peak_tflops
    if peak is None or options.bandwidth is None:
        return None
    return max(found.flops / (peak * 1e12), found.bytes / (options.bandwidth * 1e9))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store", type=Path, help="store of `ucfrec prepare`")
    parser.add_argument("--dim", type=int, default=128, help="width of the policy (128)")
    parser.add_argument("--context", type=int, default=20, help="steps of a window (20)")
    parser.add_argument("--batch", type=int, nargs="+", default=[64, 4096], help="(64 4096)")
    parser.add_argument("--steps", type=int, default=100, help="timed steps (100)")
    parser.add_argument("--peak-tflops", type=float, help="of float32, 10^12 a second")
    parser.add_argument("--peak-bf16-tflops", type=float, help="of bfloat16")
    parser.add_argument("--bandwidth", type=float, help="of the memory, GB/s")
    parser.add_argument("--tf32", action="store_true", help="round products of float32 to TF32")
    parser.add_argument("--results", type=Path, default=RESULTS, help="file of result rows")
    options = parser.parse_args()
    if options.tf32:
        torch.set_float32_matmul_precision("high")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    name = torch.cuda.get_device_name() if device.type == "cuda" else "cpu"
    train, _ = training_views(EpisodeStore.open(options.store))
    sizes = [f"policy.dim={options.dim}", f"policy.context={options.context}"]
    config = resolve_config("ucf", None, sizes)
    lines = []
    for batch in options.batch:
        rng = np.random.default_rng(0)
        batches = [
            train.windows(*train.draw_steps(rng, batch), options.context).to(device)
            for _ in range(_BATCHES_HELD)
        ]
        for precision in PRECISIONS:
            policy = new_policy(train, config).to(device).train()
            needed = counted(policy, batches[0])
            taken = seconds(policy, batches, precision, options.steps)
            middle, floor = float(np.median(taken)), floor_of(needed, options, precision)
            found = {
                "windows_per_s": batch / middle,
                "step_ms": 1e3 * middle,
                "p90_ms": 1e3 * float(np.quantile(taken, 0.9)),
                "gflops": needed.flops / 1e9,
                "megabytes": needed.bytes / 1e6,
            }
            if floor is not None:
                found |= {"floor_ms": 1e3 * floor, "of_floor": middle / floor}
            cells = (f"{found[key]:.4g}" if key in found else "" for key in METRICS)
            lines.append((f"{batch:,}", precision, *cells))
            print(*lines[-1], flush=True)
            row = ResultRow(
                suite="gpu-rates",
                table="gpu-rates",
                task="training step",
                method="ucf",
                policy="ucf",
                conditions={
                    "batch": batch,
                    "precision": precision,
                    "tf32": options.tf32,
                    "dim": options.dim,
                    "context": options.context,
                    "items": len(train.item_states.embeddings) if train.has_items else 0,
                    "device": name,
                },
                code_version=code_version(Path(__file__), "ucfrec.runs.policy_fit"),
                metric="windows_per_s",
                metrics=found,
                wall_time_s=float(taken.sum()),
                **provenance(),
            )
            append_rows(options.results, [row])
    print(f"on {name}")
    print(markdown_table(("windows", "numbers", *METRICS.values()), lines))


METRICS = {
    "windows_per_s": "windows/s",
    "step_ms": "ms a step",
    "gflops": "GFLOP",
    "megabytes": "MB",
    "floor_ms": "floor, ms",
    "of_floor": "of the floor",
}


if __name__ == "__main__":
    main()
