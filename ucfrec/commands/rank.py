"""`ucfrec rank`: how policies rank what users were shown and clicked later."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from ucfrec.commands.options import POSITIVE
from ucfrec.commands.shared_options import LogOptions, RuleOptions, find_runs

if TYPE_CHECKING:
    from ucfrec.results.rows import Ranking


class Rank(LogOptions, RuleOptions):
    """`ucfrec rank`."""

    described_by = "ucfrec.python_api.recommender:Recommender.rank"
    usage = "%(prog)s RUN... [LOGS...] [options]"
    epilog = (
        "Without LOGS, the policies rank the test split of the store of the first run. Matrix "
        "factorisation, a baseline, needs ucfrec[rank]."
    )

    k: Annotated[int, POSITIVE] = 10
    keep_seen: bool = False
    """Also recommend items that the user has seen; (default: leave them out)"""
    seed: int = 0
    liked: Annotated[str | None, "SQL"] = None
    json: Annotated[Path | None, "FILE"] = None
    """Also write the rows, with intervals, as JSON."""

    def execute(self) -> None:
        """Print one row per policy."""
        from ucfrec.evaluation.ranking_table import require_one_catalogue
        from ucfrec.logs.summary import format_summary
        from ucfrec.processes import shorten_paths
        from ucfrec.reporting.measuring import TEST_SPLIT, rank_policies
        from ucfrec.runs.trained_policy import TrainedPolicy

        runs, logs = find_runs(self.logs)
        policies = [TrainedPolicy.load(run, self.checkpoint, split=not logs) for run in runs]
        require_one_catalogue(policies)
        with self.read_sessions(policies, logs, self.json) as logged:
            if logs:
                print(format_summary(logged.report), end="\n\n")
            ranking = rank_policies(
                [(policy, self.make_rule(policy)) for policy in policies],
                logged,
                ", ".join(map(shorten_paths, logs)) or TEST_SPLIT,
                k=self.k,
                filter_seen=not self.keep_seen,
                liked=self.liked,
                seed=self.seed,
                checkpoint=self.checkpoint,
            )
        print(_describe(ranking))
        if self.json is not None:
            ranking.save(self.json)
        print(_conclude(ranking, runs[0]))


def _describe(ranking: "Ranking") -> str:
    """The table, what its columns are, and what makes the numbers less reliable."""
    from ucfrec.evaluation.ranking import MEASURES
    from ucfrec.reporting.tables import format_rows

    columns = ranking.shown
    rows = [{**dict.fromkeys(columns), "policy": row.method, **row.metrics} for row in ranking]
    conditions = ranking.rows[0].conditions
    lines = [format_rows(rows, ("policy", *columns)), ""]
    lines += [f"{name:<16}{MEASURES[name]}" for name in columns if name in MEASURES]
    lines += [
        f"{'liked':<16}{conditions['liked']}: {conditions['liked_share']:.1%} of the steps",
        f"k is {conditions['k']}; --json has 95% intervals and paired differences by user",
    ]
    if lost := float(conditions["out_of_reach"] or 0):
        lines.append(
            f"{lost:.1%} of the steps show an item that the user has seen, which is excluded: "
            f"hit_rate_shown is at most {1 - lost:.3g}; --keep-seen ranks these items too"
        )
    return "\n".join([*lines, *(f"warning: {warning}" for warning in ranking.warnings)])


def _conclude(ranking: "Ranking", run: Path) -> str:
    """What the rows show, in two lines: the best by liked items, and what to do next."""
    rates = {n: row.metrics.get("hit_rate_liked", math.nan) for n, row in enumerate(ranking)}
    rates = {n: rate for n, rate in rates.items() if not math.isnan(rate)}
    if 0 not in rates:
        return "\nno step was liked; next: name what counts as liked with --liked"
    rows, best = ranking.rows, max(rates, key=lambda n: rates[n])
    if not rates[best]:
        return "\nno method lists an item that was liked; next: a larger --k, or --keep-seen"
    first = f"; {rows[0].method} has {rates[0]:.3f}" if best else ""
    return (
        f"\n{rows[best].method} has the highest hit rate on liked items ({rates[best]:.3f} with "
        f"{rows[best].conditions['k']} items){first}. Logged clicks favour what was shown:\n"
        f"next: ucfrec ope {run}, the return per session that it would bring"
    )
