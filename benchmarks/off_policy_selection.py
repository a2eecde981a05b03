"""How often the best of four policies is chosen from logs, where the truth is known.

    python benchmarks/off_policy_selection.py                        # 200 replications of each
    python benchmarks/off_policy_selection.py --environments synthetic-taobao --replications 20

In the synthetic catalogue, logs of one softmax policy over guessed tastes judge four others that
are sharper or flatter and show more or less variety; their values are those of 20,000 sessions
played. In SyntheticTaobao, whose actions are vectors, logs of a normal policy around a blend of an
untuned action and the best one, truncated to the box, judge four others whose blends are a little
better or worse; propensities are densities, and values are the exact expected clicks of 40,000
sessions' drawn actions. In `far apart` the blends differ so much that the logs hold next to nothing
of what the candidates do, and the verdicts must say so.

Replications differ in their logs. The table says how often the first is the best, how often that is
so where the verdicts of all four stand, how often all four and any of them stand, the mean rank
correlation with the truth, the mean regret (value of the best less that of the chosen, in clicks a
session), how often the simultaneous band holds the values of all four, and how far the value of the
first is off before and after the correction for having been chosen.

Measured with 200 replications of 3,000 sessions (catalogue), 5,000 and 1,500 (SyntheticTaobao) and
600 (far apart):

synthetic-catalog              best  standing  stands    any rankcorr   regret    band
SNPDIS                       100.0%  100.0%   96.0%  100.0%    0.961   0.0000   94.0%
PDIS                         100.0%  100.0%   96.0%  100.0%    0.934   0.0000   94.5%
SNIPS                        100.0%  100.0%   96.0%  100.0%    0.946   0.0000   93.5%
synthetic-taobao
SNPDIS                        98.5%   98.7%   74.5%   99.5%    0.990   0.0039   96.5%
PDIS                          98.5%   98.7%   74.5%   99.5%    0.987   0.0044   96.5%
SNIPS                         72.5%   65.8%   74.5%   99.5%    0.834   0.0457   91.5%
synthetic-taobao, 1,500 sessions
SNPDIS                        84.0%   77.9%   65.5%   98.5%    0.892   0.0292   93.5%
PDIS                          80.0%   71.8%   65.5%   98.5%    0.869   0.0366   93.5%
SNIPS                         54.0%   40.5%   65.5%   98.5%    0.600   0.1031   88.5%
synthetic-taobao, far apart
SNPDIS                         2.0%       –    0.0%    0.0%   -0.256   7.1005    0.0%
PDIS                           2.5%       –    0.0%    0.0%   -0.568   7.3401   26.0%
SNIPS                          4.5%       –    0.0%    0.0%   -0.315   7.1421    0.0%

1,500 sessions are too few to tell the two best policies of SyntheticTaobao apart nine times in ten,
and SNIPS, whose weights are products over whole sessions, is the worst choice there.
"""

import argparse
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from gymnasium.vector import VectorEnv
from scipy.stats import spearmanr

from ucfrec.acting.rollout import Actor, Step, rollout
from ucfrec.acting.uniform import Memoryless
from ucfrec.arrays import BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.code_version import code_version
from ucfrec.off_policy.estimators import session_terms
from ucfrec.off_policy.logged_steps import LoggedSteps
from ucfrec.off_policy.selection import Selection, select
from ucfrec.off_policy.verdict import influences, judge
from ucfrec.progress import progress
from ucfrec.provenance import provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows
from ucfrec_simulators.behaviors import truncated_normal, truncated_normal_density
from ucfrec_simulators.synthetic_catalog import SoftmaxGuess, SyntheticCatalog
from ucfrec_simulators.taobao.environment import default_action
from ucfrec_simulators.taobao.synthetic import SyntheticTaobao

PARALLEL = 256
ESTIMATORS = ("SNPDIS", "PDIS", "SNIPS")
RESULTS = Path("runs/off_policy/results.jsonl")


class Watched(Actor, Protocol):
    """A logging policy that notes what each candidate would have thought of its choices."""

    thought: Float64Array
    """(N, 4) of the last step: each candidate's probability, or density, of the action drawn; 0 in
    rows that are not live."""


class Environment(Protocol):
    """Where logs come from, and what the candidates are worth there."""

    candidates: tuple[str, ...]
    densities: bool

    def playing(self, seed: int) -> tuple[VectorEnv[Any, Any, Any], Watched]:
        """The environment, and the logging policy in it."""
        ...

    def values(self) -> dict[str, float]:
        """Mean clicks of a session, by candidate."""
        ...


class GuessedTastes(SoftmaxGuess):
    """Logs of the catalogue."""

    def __init__(
        self, environment: SyntheticCatalog, seed: int, others: list[SoftmaxGuess]
    ) -> None:
        super().__init__(environment, seed, *Catalogue.LOGGING)
        self._others, self.thought = others, np.empty((0, len(others)))

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[IntArray, Float32Array]:
        chosen, propensity = super().act(observations, live)
        items, rows = chosen[live], np.arange(live.sum())
        self.thought = np.zeros((len(chosen), len(self._others)))
        for number, other in enumerate(self._others):
            self.thought[live, number] = other.probabilities(live)[rows, items]
        return chosen, propensity


class Catalogue:
    """Softmax policies, each of an error, temperature, epsilon and variety."""

    LOGGING = (1.5, 2.0, 0.3, 1.0)
    CANDIDATES: Mapping[str, tuple[float, float, float, float]] = {
        "flatter": (1.5, 2.5, 0.3, 1.0),
        "less variety": (1.5, 2.0, 0.3, 0.5),
        "more variety": (1.5, 2.0, 0.3, 1.6),
        "variety, sharper": (1.5, 1.8, 0.3, 1.8),
    }
    PLAYED = 20_000
    candidates = tuple(CANDIDATES)
    densities = False

    def playing(self, seed: int) -> tuple[SyntheticCatalog, GuessedTastes]:
        environment = SyntheticCatalog(PARALLEL)
        others = [SoftmaxGuess(environment, seed, *knobs) for knobs in self.CANDIDATES.values()]
        return environment, GuessedTastes(environment, seed, others)

    def values(self) -> dict[str, float]:
        found = {}
        for name, knobs in self.CANDIDATES.items():
            environment = SyntheticCatalog(PARALLEL)
            played = rollout(
                environment, SoftmaxGuess(environment, 1, *knobs), self.PLAYED, seed=10**6
            )
            found[name] = float(played.returns.mean())
        return found


class NoisyBlend(Memoryless):
    """Logs of SyntheticTaobao."""

    def __init__(self, of: "Taobao", environment: SyntheticTaobao, seed: int) -> None:
        self._of, self._environment = of, environment
        self._generator = np.random.default_rng([seed, 7])
        self.thought = np.empty((0, len(of.candidates)))

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Float32Array, Float32Array]:
        best = self._environment.optimal_actions(observations)
        chosen, density = truncated_normal(mean(best, self._of.LOGGING), NOISE, self._generator)
        self.thought = np.zeros((len(chosen), len(self._of.candidates)))
        for number, quality in enumerate(self._of.qualities.values()):
            center = mean(best[live], quality)
            self.thought[live, number] = truncated_normal_density(center, NOISE, chosen[live])
        return chosen, density


NOISE, UNTUNED = 0.3, default_action()
"""Standard deviation of the policies in SyntheticTaobao, before truncation to the box; and the
action that they blend with the best."""


def mean(best: Float32Array, quality: float) -> Float32Array:
    """Blend of the best actions (N, A), share `quality`, and an untuned one."""
    return quality * best + (1 - quality) * UNTUNED


class Taobao:
    """Normal policies around blends of stated quality."""

    LOGGING, USERS = 0.5, 40_000
    densities = True

    def __init__(self, differences: tuple[float, ...]) -> None:
        self.qualities = {f"quality {self.LOGGING + d:g}": self.LOGGING + d for d in differences}
        self.candidates = tuple(self.qualities)

    def playing(self, seed: int) -> tuple[SyntheticTaobao, NoisyBlend]:
        environment = SyntheticTaobao(PARALLEL)
        return environment, NoisyBlend(self, environment, seed)

    def values(self) -> dict[str, float]:
        environment = SyntheticTaobao(1)
        users, lengths = environment.sample_users(self.USERS, np.random.default_rng(10**6))
        owner = np.repeat(np.arange(self.USERS), lengths)
        page = np.arange(len(owner)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        best, found = environment.best_actions(users[owner], page), {}
        for name, quality in self.qualities.items():
            # The same draws for all: what they differ by has hardly an error.
            drawn, _ = truncated_normal(mean(best, quality), NOISE, np.random.default_rng(10**6))
            clicks = environment.expected_clicks(users[owner], page, drawn)
            found[name] = float(clicks.sum() / self.USERS)
        return found


ENVIRONMENTS: Mapping[str, Environment] = {
    "synthetic-catalog": Catalogue(),
    "synthetic-taobao": Taobao((-0.01, 0.005, 0.01, 0.015)),
    "synthetic-taobao, far apart": Taobao((-0.1, 0.1, 0.2, 0.3)),
}


def logs(environment: Environment, sessions: int, seed: int) -> tuple[LoggedSteps, Float64Array]:
    """Logged steps, and each candidate's probabilities or densities (N, 4) of what was logged."""
    env, actor = environment.playing(seed)
    parts: list[Float64Array] = []

    def keep(step: Step) -> None:
        assert step.propensities is not None
        users = step.episodes if step.user_ids is None else step.user_ids
        columns = (step.episodes, step.rewards, step.propensities, users)
        parts.append(np.column_stack([*columns, actor.thought[step.rows]]))

    rollout(env, actor, sessions, seed, keep)
    # Steps of a session come in order; sessions played in parallel are interleaved.
    table = np.concatenate(parts).astype(np.float64)
    table = table[np.argsort(table[:, 0], kind="stable")]
    session = table[:, 0].astype(np.int64)
    first = np.flatnonzero(np.diff(session, prepend=-1))
    steps = LoggedSteps(
        session,
        reward=table[:, 1],
        propensity=table[:, 2],
        target=np.zeros(len(table)),
        user=table[first, 3].astype(np.int64),
        densities=environment.densities,
    )
    return steps, table[:, 4:]


@dataclass(frozen=True)
class Replication:
    """What one set of logs says."""

    selection: Selection
    stands: tuple[bool, ...]
    """Whether the verdict of each candidate stands."""


def replication(environment: Environment, sessions: int, seed: int) -> dict[str, Replication]:
    """Of each estimator."""
    steps, targets = logs(environment, sessions, seed)
    most = np.inf if environment.densities else 1.0
    judged = [replace(steps, target=target) for target in targets.T.clip(0, most)]
    stands = tuple(judge(one, seed).reliable for one in judged)
    terms = [session_terms(one) for one in judged]
    return {
        name: Replication(
            select(
                environment.candidates,
                np.stack([influences(one[name]) for one in terms], axis=1),
                seed,
                steps.user,
            ),
            stands,
        )
        for name in ESTIMATORS
    }


def summary(found: list[Replication], values: Mapping[str, float]) -> dict[str, float]:
    """What the table tells of an estimator; `best_standing` only where all verdicts ever stand."""
    best = max(values, key=lambda one: values[one])
    firsts = [one.selection.chosen for one in found]
    right = np.array([first.name == best for first in firsts])
    all_stand = np.array([all(one.stands) for one in found])
    correlations, held = [], []
    for one in found:
        by_name = {standing.name: standing for standing in one.selection.standings}
        ranked = [by_name[candidate].value for candidate in values]
        correlations.append(spearmanr(ranked, list(values.values())).statistic)
        held.append(all(s.low <= values[s.name] <= s.high for s in one.selection.standings))
    corrected = [one.selection.corrected - values[one.selection.chosen.name] for one in found]
    numbers = {
        "best": right.mean(),
        "stands": all_stand.mean(),
        "any_stands": np.mean([any(one.stands) for one in found]),
        "rank_correlation": np.mean(correlations),
        "regret": np.mean([values[best] - values[first.name] for first in firsts]),
        "band": np.mean(held),
        "naive_error": np.mean([first.value - values[first.name] for first in firsts]),
        "corrected_error": np.mean(corrected),
    }
    if all_stand.any():
        numbers["best_standing"] = right[all_stand].mean()
    return {name: float(number) for name, number in numbers.items()}


def line(name: str, numbers: Mapping[str, float]) -> str:
    """One line of the table."""
    standing = f"{numbers['best_standing']:7.1%}" if "best_standing" in numbers else "      –"
    cells = (
        f"{numbers['best']:7.1%} {standing} {numbers['stands']:7.1%} {numbers['any_stands']:7.1%}",
        f"{numbers['rank_correlation']:8.3f} {numbers['regret']:8.4f} {numbers['band']:7.1%}",
        f"{numbers['naive_error']:+8.4f} {numbers['corrected_error']:+8.4f}",
    )
    return f"{name:<10}" + " ".join(cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--environments", nargs="+", choices=list(ENVIRONMENTS), default=list(ENVIRONMENTS)
    )
    parser.add_argument("--replications", type=int, default=200)
    parser.add_argument("--sessions", type=int, default=3000)
    parser.add_argument(
        "--results", type=Path, default=RESULTS, help=f"file of result rows (default: {RESULTS})"
    )
    options = parser.parse_args()
    for name in options.environments:
        began, environment = time.perf_counter(), ENVIRONMENTS[name]
        values = environment.values()
        print(f"{name}: " + ", ".join(f"{one} {value:.3f}" for one, value in values.items()))
        found: dict[str, list[Replication]] = {one: [] for one in ESTIMATORS}
        with progress(options.replications, name, "replications") as bar:
            for seed in range(options.replications):
                made = replication(environment, options.sessions, 100_000 + 1000 * seed)
                for estimator, one in made.items():
                    found[estimator].append(one)
                bar.update()
        head = "best  standing  stands    any rankcorr   regret    band    naive corrected"
        print(f"{'estimator':<10}   {head}")
        rows = []
        for estimator, replications in found.items():
            numbers = summary(replications, values)
            print(line(estimator, numbers), flush=True)
            rows.append(
                ResultRow(
                    suite="off-policy",
                    table="selection",
                    task=name,
                    method=estimator,
                    policy="four candidates",
                    conditions={"replications": options.replications, "sessions": options.sessions},
                    code_version=code_version(Path(__file__)),
                    metric="best",
                    metrics=numbers,
                    details={"values": values},
                    wall_time_s=time.perf_counter() - began,
                    **provenance(),
                )
            )
        append_rows(options.results, rows)


if __name__ == "__main__":
    main()
