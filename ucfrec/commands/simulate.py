"""`ucfrec evaluate` and `collect`: policies in a simulated environment, and logs of it."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from ucfrec.commands.options import ARGUMENT, Group
from ucfrec.commands.shared_options import EnvironmentOptions, RuleOptions
from ucfrec.errors import InputError


class SimulationOptions(EnvironmentOptions):
    """Sessions in an environment."""

    env: Annotated[str, Group("")]
    """Simulator, e.g. synthetic-taobao, or gymnasium:ID, any Gymnasium environment
    (gymnasium:MODULE:ID imports MODULE first)"""
    seed: Annotated[int, Group("")] = 0
    """Seed of the sessions."""


class Evaluate(SimulationOptions, RuleOptions):
    """`ucfrec evaluate`."""

    described_by = "ucfrec.python_api.recommender:Recommender.evaluate"

    runs: Annotated[Sequence[Path], ARGUMENT, "RUN"] = ()
    """Run folders of `ucfrec train`."""
    episodes: int = 1000
    behavior: Sequence[str] = ()
    """Also evaluate this built-in policy of the simulator, e.g. random; repeatable (default:
    none)"""
    json: Annotated[Path | None, "FILE"] = None
    """Also write the rows as JSON."""

    def execute(self) -> None:
        """Print one row per policy."""
        from ucfrec.reporting.measuring import evaluate_in
        from ucfrec.reporting.tables import evaluation_table

        environment = self.make_environment(self.env)
        if not self.runs and not self.behavior:
            raise InputError("name a run folder, or a built-in policy with --behavior")
        policies = [self.load(run) for run in dict.fromkeys(self.runs)]
        evaluation = evaluate_in(
            environment,
            [(policy, self.make_rule(policy)) for policy in policies],
            self.behavior,
            episodes=self.episodes,
            seed=self.seed,
            checkpoint=self.checkpoint,
        )
        print(evaluation_table(list(evaluation)))
        print(
            "\nR_cum: mean return of a session, the sum of its rewards, with a 95% interval; where "
            "two overlap, the order is open.\nR_avg: reward per step, over all steps (pooled) or "
            "in the mean of sessions (episode)."
        )
        if self.json is not None:
            evaluation.save(self.json)
            runs = shlex.join(map(str, self.runs)) or "RUN"
            file = shlex.quote(str(self.json))
            print(f"next: ucfrec report {runs} --results {file} --out report.html")


class Collect(SimulationOptions):
    """`ucfrec collect`."""

    behavior: str | None = None
    """Built-in policy that acts in the sessions (default: mixture if any, else random)"""
    sessions: int = 20_000
    """Number of sessions."""
    out: Path
    """New folder for the logs."""

    def execute(self) -> None:
        """Simulate sessions and write them as Parquet logs."""
        from ucfrec.evaluation.collect import collect

        environment = self.make_environment(self.env)
        simulator = environment.simulator()
        behavior = self.behavior or simulator.logging_behavior
        env, actor = environment.start(256, behavior, self.seed)
        named = {"env_name": environment.title, "behavior": behavior}
        played = collect(simulator, env, actor, self.sessions, self.seed, self.out, **named)
        size = (env.single_observation_space.shape or (0,))[0]
        observation = f"observation of {size} numbers"
        if not size:
            observation = "no observation: states come from the items shown and their rewards"
        print(
            f"{self.out}: {self.sessions} sessions of {behavior}, {int(played.lengths.sum())} "
            f"steps, mean return {played.returns.mean():.3f}; reward column {simulator.feedback}; "
            f"{observation}"
        )
