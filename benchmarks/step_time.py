"""CPU time of a training step of every policy on one thread, as a ratio to those of DT and DC.

    python benchmarks/step_time.py --dim 128 --context 20
    python benchmarks/step_time.py --bfloat16      # also with products in bfloat16

Appends the rows to runs/step_time/results.jsonl, or to --results, and prints a table. Only ratios
are kept: the policies are timed in turn, so a slower machine slows all of them.
"""

import time
from collections.abc import Callable

import numpy as np
import torch
from measured_rows import append_row, make_parser
from torch import nn

from ucfrec.episodes.windows import Windows
from ucfrec.fitting.loop import RowAdamW
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.registry import policy_class
from ucfrec.reporting.tables import markdown_table
from ucfrec.runs.config import resolve_config

SUITE = "step-time"
SIZES = {"state": 91, "action": 27, "items": 0}
POLICIES = ("dt", "dc", "lsdt", "ucf", "dt4rec", "cdt4rec", "edt4rec", "sasrec", "bc")


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


def step_of(policy: SequencePolicy, batch: Windows, lower: bool = False) -> Step:
    """A training step of a policy; with `lower`, its products are computed in bfloat16."""
    optimizer = RowAdamW(policy.parameters(), fused=True)

    def step() -> None:
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=lower):
            loss, _ = policy.loss(batch)
        optimizer.zero_grad()
        loss.float().backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(policy.parameters(), 0.25)
        optimizer.step()

    return step


def seconds(step: Step) -> float:
    """CPU seconds of a step."""
    began = time.thread_time()
    step()
    return time.thread_time() - began


def main() -> None:
    parser = make_parser(__doc__, SUITE)
    parser.add_argument("--dim", type=int, default=128, help="width of the policies (default: 128)")
    parser.add_argument("--context", type=int, default=20, help="steps of a window (default: 20)")
    parser.add_argument("--batch", type=int, default=64, help="windows of a batch (default: 64)")
    parser.add_argument("--rounds", type=int, default=20, help="timed rounds (default: 20)")
    parser.add_argument("--policy", action="append", choices=POLICIES, help="repeatable (all)")
    parser.add_argument("--bfloat16", action="store_true", help="time products in bfloat16, too")
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    batch = windows(options.batch, options.context)
    steps: dict[str, Step] = {}
    for name in dict.fromkeys(("dt", "dc", *(options.policy or POLICIES))):
        settings = [f"policy.dim={options.dim}", f"policy.context={options.context}"]
        config = resolve_config(name, None, settings).policy
        steps[name] = step_of(policy_class(name)(config, SIZES), batch)
        if options.bfloat16:
            steps[f"{name}, bfloat16"] = step_of(policy_class(name)(config, SIZES), batch, True)
    rounds = range(options.rounds + 2)
    taken = np.array([[seconds(step) for step in steps.values()] for _ in rounds][2:])
    times = dict(zip(steps, taken.T, strict=True))
    sizes = {name: getattr(options, name) for name in ("dim", "context", "batch", "rounds")}
    lines = []
    for name, own in times.items():
        low, middle, high = np.quantile(own / times["dt"], [0.1, 0.5, 0.9]).tolist()
        to_dc = float(np.median(own / times["dc"]))
        of_float32 = float(np.median(own / times[name.removesuffix(", bfloat16")]))
        ratios = {"ratio": middle, "ratio_10": low, "ratio_90": high, "ratio_to_dc": to_dc}
        ratios["ratio_to_float32"] = of_float32
        lines.append(
            (name, f"{middle:.2f} [{low:.2f}, {high:.2f}]", f"{to_dc:.3f}", f"{of_float32:.2f}")
        )
        about = {"conditions": sizes, "wall_time_s": float(own.sum())}
        append_row(options.results, SUITE, "random windows", name, ratios, **about)
    head = ("policy", "time of a step / DT's, median [10%, 90%]", "/ DC's", "/ its own in float32")
    print(markdown_table(head, lines))


if __name__ == "__main__":
    main()
