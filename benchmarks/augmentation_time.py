"""CPU time of proposing edits, beside the bare passes of the reward model that it needs.

    python benchmarks/augmentation_time.py

The bare passes are one reward and gradient for the direction of the move and one for each
correction. `gathered` is the previous way, which copied its cluster's matrix for every step. One
thread, in turn. Appends rows to runs/augmentation_time/results.jsonl, or to --results, and prints a
table.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ucfrec.code_version import code_version
from ucfrec.counterfactual.generators import CSGConfig, TangentGenerator
from ucfrec.counterfactual.reward_model import CausalRewardModel, CRMConfig
from ucfrec.provenance import provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows
from ucfrec.reporting.tables import markdown_table

RESULTS = Path("runs/augmentation_time/results.jsonl")
STEPS, ACTION, CLUSTERS = 8192, 32, 32
SIZES = (17, 130)


class Case:
    """A generator with random clusters, and steps to edit."""

    def __init__(self, size: int) -> None:
        self.config, crm = CSGConfig(), CRMConfig()
        self.model = CausalRewardModel(size, ACTION, crm)
        roots = torch.randn(CLUSTERS, size, size) / size**0.5
        self.covariances = roots @ roots.mT
        self.centres = torch.randn(CLUSTERS, size)
        self.generator = TangentGenerator(self.model, self.centres, self.covariances, self.config)
        self.given = torch.randn(STEPS, size), torch.randn(STEPS, ACTION)
        self.z = torch.randn(STEPS, crm.latent_dim)

    def proposed(self) -> None:
        """Propose an edit at every step."""
        self.generator.propose(*self.given, self.z, torch.Generator().manual_seed(0))

    def bare(self) -> None:
        """The reward model's passes alone."""
        states, actions = self.given
        for _ in range(1 + self.config.corrections):
            move = torch.zeros_like(states).requires_grad_()
            reward = self.model.predict(states + move, actions, self.z)
            torch.autograd.grad(reward.sum(), move)

    def gathered(self) -> None:
        """The products with matrices copied for every step, and the passes."""
        states, _ = self.given
        near = torch.cdist(states, self.centres).argmin(dim=1)
        covariance: Tensor = self.covariances[near]
        torch.einsum("mij,mj->mi", self.covariances[near], states)
        for _ in range(1 + self.config.corrections):
            torch.einsum("mij,mj->mi", covariance, states)
        self.bare()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5, help="timed rounds (5)")
    parser.add_argument("--results", type=Path, default=RESULTS, help="file of result rows")
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    lines = []
    for size in SIZES:
        case, taken = Case(size), []
        for turn in range(options.rounds + 1):
            times = []
            for way in (case.proposed, case.bare, case.gathered):
                began = time.thread_time()
                way()
                times.append(time.thread_time() - began)
            taken += [times] if turn else []
        proposed, bare, gathered = np.array(taken).T
        ratio, before = (float(np.median(way / bare)) for way in (proposed, gathered))
        lines.append((str(size), f"{ratio:.2f}", f"{before:.2f}"))
        row = ResultRow(
            suite="augmentation-time",
            table="augmentation-time",
            task=f"states of {size}",
            method="tangent",
            policy="ucf",
            conditions={"state": size, "steps": STEPS, "rounds": options.rounds},
            code_version=code_version(Path(__file__), "ucfrec.counterfactual.generators"),
            metric="ratio",
            metrics={"ratio": ratio, "gathered": before},
            wall_time_s=float(np.sum(taken)),
            **provenance(),
        )
        append_rows(options.results, [row])
    print(markdown_table(("state", "proposals / bare passes", "gathered / bare passes"), lines))


if __name__ == "__main__":
    main()
