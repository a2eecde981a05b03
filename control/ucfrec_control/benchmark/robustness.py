"""What distractors cost (Figures 3 and 4, Appendix G.4), and whether screening flags them.

Every method is trained on the clean data and on the same data with a distractor in the states, and
evaluated with the distractor fixed to 0. Two trainings also differ randomly. Evaluating the same
policy with the distractor fixed to 1 instead isolates the effect of the distractor.
"""

from collections.abc import Sequence
from typing import Any

from ucfrec.episodes.store import EpisodeStore
from ucfrec.reporting.tables import NONE
from ucfrec.results.rows import ResultRow
from ucfrec.results.statistics import grouped, summary
from ucfrec_control.data.distractor import CLEAN
from ucfrec_control.training.screening import SCREENING, DimensionReport

SHOWN = ("clean", "score", "drop", "score_at_one", "drop_at_one")
SHOWN_LARGEST = ("method", "at 0", "at 1")
SHOWN_SCREENING = (
    *("task", "distractor", "flagged", "effect", "reward_effect"),
    *("true_flagged", "weakest_true"),
)


def drops(rows: Sequence[ResultRow]) -> list[dict[str, Any]]:
    """The score that each method lost to each distractor, where there is a clean row too.

    `clean` and `score` are the normalised scores of the policies trained without and with the
    distractor, which is fixed to 0. `drop` is the loss in percent of `clean`: negative for a gain,
    NaN if `clean` is not above 0. `score_at_one` and `drop_at_one` are of the second policy, from
    the same initial states, with the distractor fixed to 1. The last of several equal keys counts.

    Returns:
        One mapping per dataset, method, seed and distractor, with these and the values of `SHOWN`.
    """
    last = {
        ((row.task, row.method, row.training_seed), row.conditions["distractor"]): row.metrics
        for row in rows
    }
    lines = []
    for (pair, distractor), metrics in last.items():
        clean_metrics = last.get((pair, CLEAN))
        if distractor == CLEAN or clean_metrics is None:
            continue
        clean, score = clean_metrics["score"], metrics["score"]
        at_one = metrics.get("score_at_one", float("nan"))
        values = (clean, score, _lost(clean, score), at_one, _lost(clean, at_one))
        names = ("task", "method", "training_seed", "distractor")
        lines.append(dict(zip((*names, *SHOWN), (*pair, distractor, *values), strict=True)))
    return lines


def _lost(clean: float, score: float) -> float:
    return 100 * (clean - score) / clean if clean > 0 else float("nan")


def largest_drops(rows: Sequence[ResultRow]) -> list[dict[str, Any]]:
    """The largest of each method's drops, in percent, with the distractor fixed to 0 and to 1: over
    datasets and distractors, each in the mean over seeds."""
    lines = []
    for method, lines_of_method in grouped(drops(rows), lambda line: line["method"]).items():
        cases = grouped(lines_of_method, lambda line: (line["task"], line["distractor"])).values()
        largest = [
            max(summary(line[name] for line in case).mean for case in cases)
            for name in ("drop", "drop_at_one")
        ]
        lines.append(dict(zip(SHOWN_LARGEST, (method, *largest), strict=True)))
    return lines


def verdicts(dimensions: Sequence[DimensionReport], store: EpisodeStore) -> list[dict[str, Any]]:
    """The verdict of a screening report on each state dimension of `store`."""
    added = {d["dimension"] for d in store.record.source.others.get("distractors", [])}
    names = ("dimension", "effect", "p_value", "reward_effect", "reward_p_value")
    return [
        {"distractor": d.dimension in added, "flagged": not d.causes}
        | {name: getattr(d, name) for name in names}
        for d in dimensions
    ]


def screening_rows(rows: Sequence[ResultRow]) -> list[dict[str, Any]]:
    """One line per row with a screening: flagged dimensions and estimated effects.

    `effect` and `reward_effect` are those of the distractor on the next state and on the reward.
    `weakest_true` is the smallest effect among the true dimensions, of each the larger one of the
    two; dimensions that were not tested are excluded.
    """
    lines: list[dict[str, Any]] = []
    for row in rows:
        verdicts = row.details.get(SCREENING)
        if verdicts is None:
            continue
        added = [d for d in verdicts if d["distractor"]]
        true = [d for d in verdicts if not d["distractor"]]
        effects = [max(d["effect"], d["reward_effect"]) for d in true if d["effect"] is not None]
        columns: dict[str, Any] = {"task": row.task, "distractor": row.conditions["distractor"]}
        columns["training_seed"] = row.training_seed
        columns["flagged"] = all(d["flagged"] for d in added) if added else NONE
        columns |= {name: added[0][name] if added else NONE for name in ("effect", "reward_effect")}
        columns["true_flagged"] = [d["dimension"] for d in true if d["flagged"]]
        lines.append({**columns, "weakest_true": min(effects, default=NONE)})
    return lines
