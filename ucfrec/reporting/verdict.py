"""Conclusions from the results of a report, as sentences.

Two results count as different only if their 95% intervals do not overlap, which is stricter than a
test of the difference at 5%.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from ucfrec.reporting.page_results import Estimates, Results
from ucfrec.reporting.tables import shown
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
    rows: int
    trainings: int
    """Number of distinct training seeds."""
    value: float
    """Mean R_cum over rows."""
    low: float
    """Lowest end of the rows' 95% intervals."""
    high: float
    """Highest end of the rows' 95% intervals."""

    def above(self, other: "_Return") -> bool:
        """Whether all intervals are above all intervals of `other`."""
        return self.low > other.high

    def __str__(self) -> str:
        return f"{self.policy} ({shown(self.value)})"


def verdict(results: Results) -> list[str]:
    """One paragraph per environment, then one per policy with estimates from logs."""
    paragraphs = [
        _of_environment(environment, rows) for environment, rows in results.environments.items()
    ]
    paragraphs += [_of_estimates(one) for one in results.estimates]
    return paragraphs or [NO_RESULTS]


def _of_environment(environment: str, rows: Sequence[ResultRow]) -> str:
    returns = _returns(rows)
    trained = sorted((one for one in returns if one.trained), key=lambda one: -one.value)
    references = [one for one in returns if not one.trained]
    if not trained:
        return f"In {environment}, only built-in policies were evaluated: {_listed(references)}."
    best, *others = trained
    sentences = [_best(environment, best, others)]
    if references:
        sentences.append(_against(best, references))
    else:
        sentences.append(
            "No built-in policy (random, logging or best) was evaluated to compare it with."
        )
    if max(one.trainings for one in trained) < 2:
        one = "It was" if not others else "Each policy was"
        sentences.append(f"{one} trained once; the spread over training seeds is unknown.")
    return " ".join(sentences)


def _returns(rows: Sequence[ResultRow]) -> list[_Return]:
    """One summary per policy and checkpoint, in order of first appearance."""
    groups = grouped(rows, lambda row: (row.method, row.checkpoint))
    several = {policy for policy, _ in groups if sum(key[0] == policy for key in groups) > 1}
    return [
        _Return(
            f"{policy}, checkpoint {checkpoint}" if policy in several else policy,
            any(row.training_seed is not None for row in group),
            len(group),
            len({row.training_seed for row in group}),
            sum(row.value for row in group) / len(group),
            min(row.interval[0] for row in group if row.interval),
            max(row.interval[1] for row in group if row.interval),
        )
        for (policy, checkpoint), group in groups.items()
    ]


def _best(environment: str, best: _Return, others: Sequence[_Return]) -> str:
    if best.trainings > 1:
        how = (
            f"{shown(best.value)} in the mean of {best.trainings} trainings (their 95% intervals "
            f"span {shown(best.low)} to {shown(best.high)})"
        )
    else:
        how = f"{shown(best.value)} (95% interval {shown(best.low)} to {shown(best.high)})"
    if not others:
        return f"In {environment}, {best.policy} has a return of {how} per episode."
    text = (
        f"In {environment}, {best.policy} has the highest return of {len(others) + 1} trained "
        f"policies: {how} per episode."
    )
    close = [one for one in others if not best.above(one)]
    if close:
        text += f" Its interval overlaps that of {_listed(close)}:"
        return f"{text} which of them has the higher return is open."
    return f"{text} Its interval lies above those of the others, the next being {others[0]}."


def _against(best: _Return, references: Sequence[_Return]) -> str:
    """Compare the best trained policy with the built-in policies."""
    above = [one for one in references if best.above(one)]
    below = [one for one in references if one.above(best)]
    open_ = [one for one in references if one not in above and one not in below]
    parts = []
    if above:
        parts.append(f"higher than that of {_listed(above)}")
    if below:
        parts.append(f"lower than that of {_listed(below)}")
    text = f"Its return is {', and '.join(parts)}." if parts else ""
    if open_:
        text += (
            f" Whether it is higher or lower than that of {_listed(open_)} is open: intervals "
            "overlap."
        )
    return text.strip()


def _of_estimates(one: Estimates) -> str:
    """What `ucfrec ope` concluded of a policy, as its rows say."""
    rows = [*one.rows, *([one.logged] if one.logged else [])]
    said = next((row.details["verdict"] for row in rows if row.details.get("verdict")), None)
    if said is None:
        return f"For {one.name}, the rows have no verdict of ucfrec ope."
    return f"For {one.name}: {said}."


def _listed(things: Sequence[object]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    names = [str(thing) for thing in things]
    return " and ".join(part for part in (", ".join(names[:-1]), *names[-1:]) if part)
