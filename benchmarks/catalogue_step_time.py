"""CPU time of UCF's training step by size of the catalogue, on one thread.

    python benchmarks/catalogue_step_time.py --rounds 9

Times are ratios to the step at the first size, in turn. Besides every size with sampled items, the
first one is measured with the softmax of all its items. Memory is the peak of the process so far.
Items have three tags, an embedding of 32 numbers and training counts that fall with their rank.
Appends the rows to runs/catalogue_step_time/results.jsonl, or to --results, and prints a table.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ucfrec.code_version import code_version
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Windows
from ucfrec.fitting.row_optimizer import RowAdamW, clip_gradients
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.policies.registry import policy_class
from ucfrec.provenance import peak_memory_mib, provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows
from ucfrec.reporting.tables import markdown_table
from ucfrec.runs.config import resolve_config

RESULTS = Path("runs/catalogue_step_time/results.jsonl")
STATE, EMBEDDING, TAGS = 130, 32, 47


class Trained:
    """A policy of `items` items with its optimizer and a few batches."""

    def __init__(self, items: int, options: argparse.Namespace, sampled: bool) -> None:
        counts = 1e5 * torch.arange(1, items + 1) ** -0.8
        settings = [f"policy.{name}={getattr(options, name)}" for name in ("dim", "context")]
        settings.append(f"policy.sampled_above={0 if sampled else items}")
        sizes = {"state": STATE, "action": EMBEDDING, "items": items, "tags": 3}
        self.policy = policy_class("ucf")(resolve_config("ucf", None, settings).policy, sizes)
        _describe_items(self.policy, counts)
        self.optimizer = RowAdamW(self.policy.parameters(), fused=True)
        self.batches = [_windows(options.batch, options.context, counts) for _ in range(3)]
        self.turn, self.seconds = 0, list[float]()

    def step(self) -> None:
        """One training step."""
        batch = self.batches[self.turn % len(self.batches)]
        self.turn += 1
        began = time.thread_time()
        value, _ = self.policy.loss(batch)
        self.optimizer.zero_grad()
        value.backward()  # type: ignore[no-untyped-call]
        clip_gradients(self.policy.parameters(), 0.25)
        self.optimizer.step()
        self.seconds.append(time.thread_time() - began)


def _describe_items(policy: SequencePolicy, counts: Tensor) -> None:
    assert isinstance(policy.head, ItemHead)
    assert policy.head.exposure is not None
    embeddings, tags = torch.randn(len(counts), EMBEDDING), torch.randint(TAGS, (len(counts), 3))
    policy.head.start_from(embeddings, counts)
    states = ItemStates(embeddings, torch.zeros(0, 0), 0.0, 1.0, tags=tags)
    policy.head.exposure.start_from(states, torch.rand(1000))


def _windows(batch: int, context: int, counts: Tensor) -> Windows:
    drawn = torch.searchsorted(counts.cumsum(0), torch.rand(batch, context) * counts.sum())
    return Windows(
        states=torch.randn(batch, context, STATE),
        actions=drawn.clamp(max=len(counts) - 1),
        rewards=torch.rand(batch, context),
        returns_to_go=torch.rand(batch, context),
        timesteps=torch.arange(context).repeat(batch, 1),
        mask=torch.ones(batch, context, dtype=torch.bool),
    )


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--items",
        type=int,
        nargs="+",
        default=[7_583, 100_000, 1_000_000],
        help="sizes of catalogues (default: 7583 100000 1000000)",
    )
    parser.add_argument("--dim", type=int, default=128, help="width of the policy (default: 128)")
    parser.add_argument("--context", type=int, default=20, help="steps of a window (default: 20)")
    parser.add_argument("--batch", type=int, default=64, help="windows of a batch (default: 64)")
    parser.add_argument("--rounds", type=int, default=9, help="timed rounds (default: 9)")
    parser.add_argument(
        "--results", type=Path, default=RESULTS, help=f"file of result rows (default: {RESULTS})"
    )
    return parser.parse_args()


def main() -> None:
    options = _options()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    cases, peaks = {}, {}
    for items, sampled in [(options.items[0], False), *((each, True) for each in options.items)]:
        cases[items, sampled] = trained = Trained(items, options, sampled)
        for _ in range(2):
            trained.step()
        trained.seconds.clear()
        peaks[items, sampled] = peak_memory_mib()
    for _ in range(options.rounds):
        for trained in cases.values():
            trained.step()
    first = cases[options.items[0], True].seconds
    lines = []
    for (items, sampled), trained in cases.items():
        low, middle, high = np.quantile(np.divide(trained.seconds, first), [0.1, 0.5, 0.9])
        softmax = "sampled" if sampled else "all items"
        lines.append((f"{items:,}", softmax, f"{middle:.2f} [{low:.2f}, {high:.2f}]"))
        row = ResultRow(
            suite="step-time",
            table="catalogue",
            task=f"{items} items",
            method=f"ucf, softmax of {softmax}",
            policy="ucf",
            conditions={
                **{name: getattr(options, name) for name in ("dim", "context", "batch", "rounds")},
                "items": items,
                "sampled": sampled,
            },
            code_version=code_version(Path(__file__), "ucfrec.policies.ucf"),
            metric="ratio",
            metrics={"ratio": middle, "ratio_10": low, "ratio_90": high},
            wall_time_s=sum(trained.seconds),
            peak_memory_mib=peaks[items, sampled],
            **provenance(),
        )
        append_rows(options.results, [row])
    heads = ("items", "softmax", f"time / at {options.items[0]:,}, median [10%, 90%]")
    print(markdown_table(heads, lines))


if __name__ == "__main__":
    main()
