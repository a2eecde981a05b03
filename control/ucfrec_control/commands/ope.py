"""`ucfrec-control ope`: what a policy would return, estimated from logged trajectories."""

from pathlib import Path
from typing import Annotated, Literal

from ucfrec.commands.options import ARGUMENT, Table
from ucfrec.episodes.store import EpisodeStore
from ucfrec_control.training.evaluate import choose_rule, load_run
from ucfrec_control.training.fqe import estimate


class Ope(Table):
    """`ucfrec-control ope`."""

    run: Annotated[Path, ARGUMENT]
    """Run folder."""
    store: Annotated[Path, ARGUMENT]
    """Episode store of trajectories of the same robot: that of the training, or another."""
    target: float | None = None
    """Target return (default: the preset's, else the largest of the training)"""
    discount: float = 0.99
    """γ, of later rewards."""
    checkpoint: Literal["last", "best", "return"] = "last"
    """Weights to evaluate."""

    def execute(self) -> None:
        """Run `ucfrec-control ope`."""
        trained = load_run(self.run, self.checkpoint)
        rule = choose_rule(trained, self.target)
        result = estimate(trained, rule, EpisodeStore.open(self.store), self.discount)
        for reason in result.reasons:
            print(f"do not rely on the estimate: {reason}")
        value, of_behaviour = (
            "no estimate" if estimated is None else f"{estimated:.4g}"
            for estimated in (result.value, result.behaviour_value)
        )
        if result.interval is not None:
            low, high = result.interval
            value += f" [{low:.4g}, {high:.4g}]"
        print(f"discounted returns of an episode, γ = {self.discount:g}")
        print(f"policy        {value}, by fitted Q evaluation")
        print(f"behaviour     {of_behaviour}, by fitted Q evaluation")
        print(f"behaviour     {result.behaviour:.4g}, logged")
        print(f"best quarter  {result.best_quarter:.4g}, logged")
        if result.cut:
            print(
                f"A time limit ended {result.cut:,} trajectories: their logged returns stop there, "
                "estimates go on."
            )
        print(
            "\nThe interval is over trajectories. It does not cover what the regressions cannot "
            "express: try the policy in a simulator before it moves a robot."
        )
