"""Conclusions from the results of a report, as sentences.

Two results count as different only if their 95% intervals do not overlap, which is stricter than a
test of the difference at 5%.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from ucfrec.reporting.page_results import Estimates, Results
from ucfrec.reporting.tables import format_value
from ucfrec.results.row import ResultRow
from ucfrec.results.statistics import grouped

NO_RESULTS = (
    "No results are given, so the returns of these policies are unknown. A validation loss "
    "measures how well logged choices are predicted, not the return. Evaluate the policies in a "
    "simulator (ucfrec evaluate --json) or from logs (ucfrec ope --json), and give the rows with "
    "--results."
)


@dataclass(frozen=True)
class _Return:
    """Return of one policy in one environment, over all its rows."""

    policy: str
    trained: bool
    trainings: int
    """Number of distinct training seeds."""
    value: float
    """Mean R_cum over rows."""
    low: float
    """Lowest end of the rows' 95% intervals."""
    high: float
    """Highest end of the rows' 95% intervals."""

    def above(self, reference: "_Return") -> bool:
        """Whether all intervals are above all intervals of `reference`."""
        return self.low > reference.high

    def __str__(self) -> str:
        return f"{self.policy} ({format_value(self.value)})"


def verdict(results: Results) -> list[str]:
    """One paragraph per environment, then one per policy with estimates from logs."""
    paragraphs = [
        _conclude(environment, _collect_returns(rows))
        for environment, rows in results.environments.items()
    ]
    paragraphs += [_quote(estimates) for estimates in results.estimates]
    return paragraphs or [NO_RESULTS]


def _collect_returns(rows: Sequence[ResultRow]) -> list[_Return]:
    """One summary per policy and checkpoint, in order of first appearance."""
    groups = grouped(rows, lambda row: (row.method, row.checkpoint))
    policies = [policy for policy, _ in groups]
    return [
        _Return(
            policy if policies.count(policy) == 1 else f"{policy}, checkpoint {checkpoint}",
            any(row.training_seed is not None for row in group),
            len({row.training_seed for row in group}),
            sum(row.value for row in group) / len(group),
            min(row.interval[0] for row in group if row.interval),
            max(row.interval[1] for row in group if row.interval),
        )
        for (policy, checkpoint), group in groups.items()
    ]


def _conclude(environment: str, returns: Sequence[_Return]) -> str:
    trained = sorted((policy for policy in returns if policy.trained), key=lambda p: -p.value)
    references = [policy for policy in returns if not policy.trained]
    if not trained:
        return f"In {environment}, only built-in policies were evaluated: {_join(references)}."
    best, *lower = trained
    ends = f"{format_value(best.low)} to {format_value(best.high)}"
    value = f"{format_value(best.value)} (95% interval {ends})"
    if best.trainings > 1:
        value = f"{format_value(best.value)} in the mean of {best.trainings} trainings "
        value += f"(their 95% intervals span {ends})"
    if lower:
        text = (
            f"In {environment}, {best.policy} has the highest return of {len(trained)} trained "
            f"policies: {value} per episode."
        )
        if close := [policy for policy in lower if not best.above(policy)]:
            text += f" Its interval overlaps that of {_join(close)}:"
            text += " which of them has the higher return is open."
        else:
            text += f" Its interval lies above those of the others, the next being {lower[0]}."
    else:
        text = f"In {environment}, {best.policy} has a return of {value} per episode."
    text += _compare(best, references)
    if max(policy.trainings for policy in trained) < 2:
        once = "Each policy was" if lower else "It was"
        text += f" {once} trained once; the spread over training seeds is unknown."
    return text


def _compare(best: _Return, references: Sequence[_Return]) -> str:
    """Compare the best trained policy with the built-in policies."""
    if not references:
        return " No built-in policy (random, logging or best) was evaluated to compare it with."
    below = [policy for policy in references if best.above(policy)]
    above = [policy for policy in references if policy.above(best)]
    unclear = [policy for policy in references if policy not in (*above, *below)]
    parts = [f"higher than that of {_join(below)}"] if below else []
    parts += [f"lower than that of {_join(above)}"] if above else []
    text = f" Its return is {', and '.join(parts)}." if parts else ""
    if unclear:
        text += f" Whether it is higher or lower than that of {_join(unclear)} is open: intervals "
        text += "overlap."
    return text


def _quote(estimates: Estimates) -> str:
    """What `ucfrec ope` concluded of a policy, as its rows say."""
    rows = [*estimates.rows, *([estimates.logged] if estimates.logged else [])]
    verdicts = (row.details["verdict"] for row in rows if row.details.get("verdict"))
    if (quoted := next(verdicts, None)) is None:
        return f"For {estimates.name}, the rows have no verdict of ucfrec ope."
    return f"For {estimates.name}: {quoted}."


def _join(policies: Sequence[_Return]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    *names, last = map(str, policies)
    return f"{', '.join(names)} and {last}" if names else last
