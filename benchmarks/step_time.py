"""CPU time of a training step of every policy on one thread, as a ratio to those of DT and DC.

    python benchmarks/step_time.py --dim 128 --context 20 --reference CLONE

Appends the rows to runs/step_time/results.jsonl, or to --results, and prints a table. Only ratios
are kept: the policies are timed in turn, so a slower machine slows all of them. CLONE is a clone of
github.com/beanie00/Decision-ConvFormer, whose network is timed, too, in its authors' size (3
layers, window of 6); it needs transformers 4.6.0, huggingface-hub 0.0.8, regex and sacremoses on
the path (`pip install --no-deps --target FOLDER`, apart from ours).
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from ucfrec.arrays import Float64Array
from ucfrec.episodes.windows import Windows
from ucfrec.fitting.loop import RowAdamW, WeightAverage
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.registry import policy_class
from ucfrec.processes import provenance
from ucfrec.reporting.tables import markdown_table
from ucfrec.results.rows import ResultRow, append_rows
from ucfrec.runs.config import resolve_config

RESULTS = Path("runs/step_time/results.jsonl")
SIZES = {"state": 91, "action": 27, "items": 0}
POLICIES = ("dt", "dc", "lsdt", "ucf", "dt4rec", "cdt4rec", "edt4rec", "sasrec", "bc")
REFERENCE = "reference_dc"
AVERAGED = "-averaged"
"""End of the names of policies whose weights are averaged."""


def windows(batch: int, context: int) -> Windows:
    """Random windows of (batch, context) steps."""
    return Windows(
        states=torch.randn(batch, context, SIZES["state"]),
        actions=torch.rand(batch, context, SIZES["action"]) * 2 - 1,
        rewards=torch.rand(batch, context),
        returns_to_go=torch.rand(batch, context),
        timesteps=torch.arange(context).repeat(batch, 1),
        mask=torch.ones(batch, context, dtype=torch.bool),
    )


Step = Callable[[], None]


def step_of(policy: SequencePolicy, batch: Windows, decay: float = 0.0) -> Step:
    """A training step of one of our policies, with its weights averaged if `decay` is not 0."""
    optimizer = RowAdamW(policy.parameters(), fused=True)
    average = WeightAverage(policy, decay) if decay else None

    def step() -> None:
        value, _ = policy.loss(batch)
        moved = None if average is None else average.before_step()
        descend(value, policy, optimizer)
        if average is not None and moved is not None:
            average.after_step(moved)

    return step


def reference_step(clone: Path, dim: int, batch: Windows) -> Step:
    """A training step of Decision ConvFormer's own code, as its trainer takes it."""
    sys.path.insert(0, str(clone / "gym"))
    from models.decision_convformer import DecisionConvFormer  # type: ignore[import-not-found]

    original = torch.Tensor.to

    def stays(tensor: Tensor, *args: object, **kwargs: object) -> Tensor:
        return tensor if args == ("cuda",) else original(tensor, *args, **kwargs)  # type: ignore[call-overload]

    torch.Tensor.to = stays  # type: ignore[method-assign,assignment]  # it always asks for a GPU
    network = DecisionConvFormer(
        *(SIZES["state"], SIZES["action"], dim),
        **{"max_length": batch.states.shape[1], "max_ep_len": 1000, "n_layer": 3},
        **{"window_size": 6, "drop_p": 0.1, "resid_pdrop": 0.1, "env_name": ""},
    )
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-4, weight_decay=1e-4)

    def step() -> None:
        returns = batch.returns_to_go.unsqueeze(-1)
        predicted = network(batch.states, batch.actions, returns, batch.timesteps)
        steps = batch.mask.reshape(-1)
        found, asked = (
            each.reshape(-1, SIZES["action"])[steps] for each in (predicted, batch.actions)
        )
        loss = nn.functional.mse_loss(found, asked)
        descend(loss, network, optimizer)

    return step


def descend(loss: Tensor, module: nn.Module, optimizer: torch.optim.Optimizer) -> None:
    optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    nn.utils.clip_grad_norm_(module.parameters(), 0.25)
    optimizer.step()


def quantiles(times: Float64Array, others: Float64Array) -> Float64Array:
    """10% quantile, median and 90% quantile of the ratio of times of the same rounds."""
    found: Float64Array = np.quantile(times / others, [0.1, 0.5, 0.9])
    return found


def seconds(step: Step) -> float:
    """CPU seconds of a step."""
    began = time.thread_time()
    step()
    return time.thread_time() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dim", type=int, default=128, help="width of the policies (default: 128)")
    parser.add_argument("--context", type=int, default=20, help="steps of a window (default: 20)")
    parser.add_argument("--batch", type=int, default=64, help="windows of a batch (default: 64)")
    parser.add_argument("--rounds", type=int, default=20, help="timed rounds (default: 20)")
    parser.add_argument("--policy", action="append", choices=POLICIES, help="repeatable (all)")
    parser.add_argument(
        "--average",
        type=float,
        default=0.0,
        metavar="DECAY",
        help="also time steps that average the weights, as train.average (off)",
    )
    parser.add_argument(
        "--reference", type=Path, metavar="CLONE", help="Decision ConvFormer's code"
    )
    parser.add_argument(
        "--results", type=Path, default=RESULTS, help=f"file of result rows (default: {RESULTS})"
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    batch = windows(options.batch, options.context)
    steps: dict[str, Step] = {}
    for name in dict.fromkeys(("dt", "dc", *(options.policy or POLICIES))):
        settings = [f"policy.dim={options.dim}", f"policy.context={options.context}"]
        config = resolve_config(name, None, settings).policy
        steps[name] = step_of(policy_class(name)(config, SIZES), batch)
        if options.average:
            averaged = policy_class(name)(config, SIZES)
            steps[f"{name}{AVERAGED}"] = step_of(averaged, batch, options.average)
    if options.reference is not None:
        steps[REFERENCE] = reference_step(options.reference, options.dim, batch)
    taken = np.array(
        [[seconds(step) for step in steps.values()] for _ in range(options.rounds + 2)][2:]
    )
    times = dict(zip(steps, taken.T, strict=True))
    for name in steps:
        if name.endswith(AVERAGED):
            low, middle, high = quantiles(times[name], times[name.removesuffix(AVERAGED)])
            print(f"{name}: {middle:.3f} [{low:.3f}, {high:.3f}] times the step without averaging")
    peers = {f"ratio_to_{peer}": peer for peer in ("dc", REFERENCE) if peer in steps}
    sizes = {name: getattr(options, name) for name in ("dim", "context", "batch", "rounds")}
    lines = []
    for name, own in times.items():
        low, middle, high = quantiles(own, times["dt"])
        of_peers = {key: float(np.median(own / times[peer])) for key, peer in peers.items()}
        of_reference = f"{of_peers[f'ratio_to_{REFERENCE}']:.3f}" if REFERENCE in steps else "–"
        dt_ratio = f"{middle:.2f} [{low:.2f}, {high:.2f}]"
        lines.append((name, dt_ratio, f"{of_peers['ratio_to_dc']:.3f}", of_reference))
        row = ResultRow(
            suite="step-time",
            table="step-time",
            task="random windows",
            method=name,
            policy=name.removesuffix(AVERAGED),
            conditions=sizes,
            metric="ratio",
            metrics={"ratio": middle, "ratio_10": low, "ratio_90": high, **of_peers},
            wall_time_s=float(own.sum()),
            **provenance(),
        )
        append_rows(options.results, [row])
    header = ("policy", "time of a step / DT's, median [10%, 90%]", "/ DC's", "/ the authors' DC's")
    print(markdown_table(header, lines))


if __name__ == "__main__":
    main()
