"""CPU time of a step of four policies batched by `torch.func.vmap`, beside four in turn.

    python benchmarks/seeds_time.py

Four seeds of UCF, windows without padding and without dropout, loss and gradients, one thread, in
turn. `vmap` takes neither our convolution nor anything that depends on values, so it gets plain
shifted products and no look at the padding. Appends the rows to runs/seeds_time/results.jsonl, or
to --results, and prints a table.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

import numpy as np
import torch
from step_time import SIZES, windows
from torch import Tensor, nn
from torch.func import functional_call, grad_and_value, stack_module_state, vmap

from ucfrec.code_version import code_version
from ucfrec.episodes.windows import Windows
from ucfrec.policies import base, ucf
from ucfrec.policies.layers import CausalDepthwise
from ucfrec.provenance import provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows
from ucfrec.reporting.tables import markdown_table
from ucfrec.runs.config import resolve_config

RESULTS = Path("runs/seeds_time/results.jsonl")
SEEDS = 4
CASES = ((64, 10, 16), (64, 20, 64), (128, 20, 64))


class Loss(nn.Module):
    """The loss of a policy as the output of a module, which `functional_call` needs."""

    def __init__(self, policy: ucf.UCFPolicy) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, *tensors: Tensor) -> Tensor:
        return self.policy.loss(Windows(*tensors))[0]


def plain(convolution: CausalDepthwise, steps: Tensor, mask: Tensor | None = None) -> Tensor:
    taps, length = convolution.weight[:, 0].T, steps.shape[1]
    padded = nn.functional.pad(steps, (0, 0, 2, 0))
    products = (padded[:, back : back + length] * taps[back] for back in range(3))
    return sum(products, start=convolution.bias)


@contextmanager
def without_what_vmap_refuses() -> Iterator[None]:
    ours = CausalDepthwise.forward, base.some_padding, ucf.some_padding
    CausalDepthwise.forward = plain
    base.some_padding = ucf.some_padding = lambda mask: None
    try:
        yield
    finally:
        CausalDepthwise.forward, base.some_padding, ucf.some_padding = ours


def ways(dim: int, context: int, batch: int) -> tuple[Callable[[], object], Callable[[], object]]:
    """A step of all seeds batched, and one after the other."""
    settings = [f"policy.dim={dim}", f"policy.context={context}", "policy.dropout=0"]
    config = resolve_config("ucf", None, settings).policy
    losses = [Loss(ucf.UCFPolicy(config, SIZES)) for _ in range(SEEDS)]
    batches = [windows(batch, context) for _ in range(SEEDS)]
    tensors = [[getattr(each, f.name) for f in fields(each)] for each in batches]
    stacked = [torch.stack(parts) for parts in zip(*tensors, strict=True)]
    parameters, buffers = stack_module_state(losses)

    def loss(parameters: dict[str, Tensor], buffers: dict[str, Tensor], *given: Tensor) -> Tensor:
        return functional_call(losses[0], (parameters, buffers), given)

    gradients = vmap(grad_and_value(loss), randomness="different")

    def batched() -> None:
        with without_what_vmap_refuses():
            gradients(parameters, buffers, *stacked)

    def in_turn() -> None:
        for module, given in zip(losses, tensors, strict=True):
            module.zero_grad()
            module(*given).backward()

    return batched, in_turn


def seconds(way: Callable[[], object]) -> float:
    began = time.thread_time()
    way()
    return time.thread_time() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=9, help="timed rounds (default: 9)")
    parser.add_argument("--results", type=Path, default=RESULTS, help="file of result rows")
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines = []
    for case in CASES:
        both = ways(*case)
        taken = np.array([[seconds(way) for way in both] for _ in range(options.rounds + 2)][2:])
        low, middle, high = np.quantile(taken[:, 0] / taken[:, 1], [0.1, 0.5, 0.9])
        sizes = dict(zip(("dim", "context", "batch"), case, strict=True))
        lines.append((*case, f"{middle:.2f} [{low:.2f}, {high:.2f}]"))
        row = ResultRow(
            suite="seeds-time",
            table="seeds-time",
            task="random windows",
            method="batched",
            policy="ucf",
            conditions=sizes | {"seeds": SEEDS, "rounds": options.rounds},
            code_version=code_version(Path(__file__), "ucfrec.policies.ucf"),
            metric="ratio",
            metrics={"ratio": middle, "ratio_10": low, "ratio_90": high},
            wall_time_s=float(taken.sum()),
            **provenance(),
        )
        append_rows(options.results, [row])
    header = ("width", "context", "batch", "batched / one after the other, median [10%, 90%]")
    print(markdown_table(header, lines))


if __name__ == "__main__":
    main()
