"""docs/tables.md: the tables of results, written from the rows in benchmarks/results.

    python benchmarks/results_page.py          # writes the page and its pictures
    python benchmarks/results_page.py --check  # fails where the page does not follow from the rows

Numbers have at most three significant digits. The page names the commits that measured a table.
"""

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from textwrap import TextWrapper
from typing import Final

import numpy as np
import pandas as pd
from off_policy_coverage import share_interval

from ucfrec.benchmark.tables import (
    BySeed,
    index_by_seeds,
    subtract,
    summarise_logs,
    summarise_tasks,
    values_by_task,
)
from ucfrec.reporting.tables import NONE, markdown_table
from ucfrec.results.rows import ResultRow, latest, read_rows
from ucfrec.results.statistics import Summary, grouped, summary
from ucfrec_control.benchmark.robustness import SHOWN as DROPS
from ucfrec_control.benchmark.robustness import drops, largest_drops

ROOT = Path(__file__).parents[1]
RESULTS, PAGE = ROOT / "benchmarks" / "results", ROOT / "docs" / "tables.md"
PICTURES = ROOT / "docs" / "assets" / "tables"
FILES = (
    *("recommendation", "counterfactual_copies"),
    *("control", "control_medium", "control_robustness", "control_spread", "launches"),
)
PAPER = """\
| method | KuaiRand R_cum | R_avg | KuaiRec R_cum | R_avg | VirtualTB R_cum | R_avg |
|---|---|---|---|---|---|---|
| DT4Rec | 6.82 ± 2.45 | 0.569 | 28.5 ± 10.4 | 0.880 | 76.8 ± 22.6 | 5.44 |
| CDT4Rec | 7.33 ± 1.98 | 0.651 | 30.5 ± 10.2 | 1.01 | 79.2 ± 22.4 | 5.65 |
| EDT4Rec | 7.58 ± 1.84 | 0.650 | 31.1 ± 11.0 | 1.04 | 79.7 ± 21.7 | 5.67 |
| UCF | 7.62 ± 1.79 | 0.655 | 31.9 ± 10.6 | 1.06 | 80.4 ± 21.2 | 5.70 |"""
ENVIRONMENTS = (
    "**VirtualTaobao** does not separate good methods: one constant action gets 10 clicks of 10 "
    "on every page.",
    "**KuaiRand FB and NX_0** (`kuairand`, `kuairand-nx0`, N = 10) show whether a policy stops "
    "repeating tags, and then how well it knows the items' click rates; `random-mask` is the "
    "return of the first alone.",
    "**KuaiRand NX_10** has sessions of ten steps whatever is shown: planning has nothing to gain, "
    "and the one-step greedy policy is the baseline to beat.",
    "**The synthetic catalogue** punishes greedy policies, and its optimum is known. It is our "
    "own simulator.",
    "**SARDINE BoredInf** is by other authors. Nothing is known of a user at first, and five "
    "clicks on one topic bore: it shows which method learns tastes within a session and varies "
    "topics.",
    "No simulator shows what real users would do: see [what numbers cannot "
    "tell](numbers.md#what-they-cannot-tell).",
)
BUILT_IN: Final = ("random", "random-mask", "oracle", "mixture", "optimal", "best-constant")
"""Policies that come with a simulator."""
KNOWING: Final = ("oracle", "optimal", "best-constant")
"""Policies that know their simulator; never the best of a column."""
BASELINES = (
    *("popular", "item-rate", "item-rate-mask", "recent-clicks", "recent-rate", "item-knn"),
    *("boosted", "crm-greedy"),
)
SEQUENCE = ("sasrec", "gsasrec", "bpr", "bc", "bc-10", "dt", "dt4rec", "cdt4rec", "edt4rec")
UCF = (
    *("ucf-paper", "ucf-paper-algorithm-5", "ucf-plain", "ucf-wo-exposure", "ucf-wo-reward-weight"),
    *("ucf-wo-lookahead", "ucf-wo-policy", "ucf-wo-rule", "ucf-actions", "ucf-both"),
    *("ucf-wo-count", "ucf-wo-arch", "ucf"),
)
METHODS = (*BUILT_IN, *BASELINES, *SEQUENCE, *(f"{name}+shared" for name in SEQUENCE), *UCF)
"""Order of the lines."""
ANSWERS = ("launch", "test it", "do not launch", "the log cannot say")
LOGS = {"gain": "true gain {:+.0%}", "task": "{}", "users": "{:,} users"}
LOGS["exploration"] = "{:.0%} exploration"
"""What launches are counted by."""
NEAR = 0.05
"""Share of the best score by which control's scores may be lower and still be bold."""
_Files = Mapping[str, Sequence[ResultRow]]


def fill(text: str, subsequent_indent: str = "") -> str:
    """Lines of at most 100 characters."""
    wrapper = TextWrapper(
        100, subsequent_indent=subsequent_indent, break_long_words=False, break_on_hyphens=False
    )
    return wrapper.fill(text)


def decimals(value: float, digits: int) -> int:
    """Decimals that give `value` so many significant digits; negative above 10^digits."""
    return digits - 1 - math.floor(math.log10(abs(value))) if value else 0


def rounded(value: float, digits: int = 3, most: int = 99, sign: str = "") -> str:
    """`value` with so many significant digits and at most `most` decimals, never as 1e+03."""
    places = min(decimals(round(value, decimals(value, digits)), digits), most)
    text = f"{round(value, places):{sign}.{max(places, 0)}f}"
    return text if float(text) else text.lstrip("+-")


def error(spread: float, mean: float) -> str:
    """` ± spread`: two significant digits, one where the mean's three hide it, 0 for rounding."""
    if spread <= 1e-6 * abs(mean):
        return " ± 0"
    return f" ± {rounded(spread, 1 if spread < 0.5 * 10.0 ** -decimals(mean, 3) else 2)}"


def level(sample: Summary, standard_error: bool = False) -> str:
    """A mean ± standard deviation or error over seeds; one value has none."""
    if not sample.count:
        return NONE
    spread = sample.standard_error if standard_error else sample.sd
    return rounded(sample.mean) + (error(spread, sample.mean) if sample.count > 1 else "")


def difference(sample: Summary, of_logs: Summary | None = None, unit: str = "") -> str:
    """A mean difference ± its standard error, in brackets the error over the means of logs."""
    if not sample.count:
        return NONE
    if sample.count == 1 or not sample.standard_error:
        return rounded(sample.mean, sign="+") + unit
    known = sample.standard_error
    text = rounded(sample.mean, most=max(decimals(known, 2), 0), sign="+") + unit
    text += f" ± {rounded(known, 2)}{unit}"
    if of_logs is not None and of_logs.count > 1:
        text += f" ({rounded(of_logs.standard_error, 2)}{unit})"
    return text


def pivot(rows: Sequence[ResultRow], cell: Callable[[str, str, Sequence[ResultRow]], str]) -> str:
    """One line per method and one column per environment; `cell` gets (environment, method, their
    rows)."""
    environments = list(dict.fromkeys(str(row.environment) for row in rows))
    of = grouped(rows, lambda row: (str(row.environment), row.method))
    known = {row.method: None for row in rows}
    order = [*(n for n in METHODS if n in known), *(n for n in known if n not in METHODS)]
    lines = [
        (name, *(cell(e, name, of[e, name]) if (e, name) in of else NONE for e in environments))
        for name in order
    ]
    return markdown_table(("method", *environments), lines)


def minus_ucf(rows: Sequence[ResultRow]) -> Callable[[str, str, Sequence[ResultRow]], str]:
    """A cell of `pivot`: the return minus that of UCF of the same log and training seed."""
    ours = {
        environment: index_by_seeds(row for row in own if row.method == "ucf")
        for environment, own in grouped(rows, lambda row: str(row.environment)).items()
    }

    def cell(environment: str, method: str, group: Sequence[ResultRow]) -> str:
        found = subtract(index_by_seeds(group), ours[environment])
        return (
            NONE if method == "ucf" else difference(summary(found.values()), summarise_logs(found))
        )

    return cell


def returns(rows: Sequence[ResultRow]) -> str:
    """Returns, average rewards, and returns minus those of UCF."""
    fair = grouped(
        [row for row in rows if row.method not in KNOWING],
        lambda row: (str(row.environment), row.method),
    )
    means = {key: summary(row.value for row in own).mean for key, own in fair.items()}

    def cell(environment: str, method: str, group: Sequence[ResultRow]) -> str:
        text, own = level(summary(row.value for row in group)), means.get((environment, method))
        best = max(mean for (where, _), mean in means.items() if where == environment)
        return f"**{text}**" if own == best else text

    parts = [
        "R_cum, mean ± standard deviation over logs and training seeds:",
        pivot(rows, cell),
        "R_avg, the mean reward per step of a session:",
        pivot(rows, lambda *at: level(summary(row.metrics["R_avg_episode"] for row in at[2]))),
        fill(
            "R_cum minus that of `ucf` of the same log and training seed, ± standard error over "
            "the pairs, in brackets over the means of logs:"
        ),
        pivot(rows, minus_ucf(rows)),
    ]
    return "\n\n".join(parts)


def components(rows: Sequence[ResultRow]) -> str:
    """The return of UCF, and differences without or with one component more."""
    less = minus_ucf(rows)

    def cell(environment: str, method: str, own: Sequence[ResultRow]) -> str:
        itself = level(summary(row.value for row in own))
        return itself if method == "ucf" else less(environment, method, own)

    return pivot(rows, cell)


def estimated(files: _Files) -> Sequence[ResultRow]:
    """Rows of the main table whose decision rule was chosen in the user model."""
    return [row for row in of("recommendation", "main")(files) if "estimated_value" in row.metrics]


def estimates(rows: Sequence[ResultRow]) -> str:
    """Estimated and actual returns of the chosen rules, and the mean absolute error."""

    def cell(_: str, __: str, group: Sequence[ResultRow]) -> str:
        estimate = summary(row.metrics["estimated_value"] for row in group).mean
        return f"{rounded(estimate)} → {rounded(summary(row.value for row in group).mean)}"

    def error_of(row: ResultRow) -> float:
        return abs(row.metrics["estimated_value"] - row.value)

    def off(own: Sequence[ResultRow]) -> str:
        return rounded(summary(map(error_of, own)).mean, 2)

    lines = []
    for environment, own in grouped(rows, lambda row: str(row.environment)).items():
        logs = grouped(own, lambda row: str(row.log_seed)).items()
        of_logs = ", ".join(f"log {name}: {off(group)}" for name, group in logs)
        near = sum(error_of(row) <= row.value / 10 for row in own)
        lines.append((environment, len(own), near, off(own), of_logs))
    head = ("environment", "rows", "within 10%", "mean absolute error", "by log")
    return f"{pivot(rows, cell)}\n\n{markdown_table(head, lines)}"


def augmentation(rows: Sequence[ResultRow]) -> str:
    """Paired differences of each kind of augmentation to none; over all sizes in percent."""
    lines: list[tuple[object, ...]] = []
    percent: dict[tuple[float, str], dict[tuple[int | None, int | None], list[float]]] = {}
    sizes = dict.fromkeys(_case(row) for row in rows)
    for (mood, size), own in sorted(grouped(rows, _case).items()):
        arms = {
            name: index_by_seeds(group) for name, group in grouped(own, lambda r: r.method).items()
        }
        base = arms["none"]
        for arm in sorted(arms, key=AUGMENTATION.index):
            found = subtract(arms[arm], base) if arm != "none" else {}
            lines.append((f"{mood:g}", size, arm, level(summary(arms[arm].values())), *_of(found)))
            for seeds, value in found.items():
                share = 100 * value / summary(base.values()).mean
                percent.setdefault((mood, arm), {}).setdefault(seeds, []).append(share)
    for (mood, arm), shares in percent.items():
        count = sum(each == mood for each, _ in sizes)
        found = {seeds: float(np.mean(v)) for seeds, v in shares.items() if len(v) == count}
        if count > 1:
            lines.append((f"{mood:g}", "all", arm, NONE, *_of(found, "%")))
    head = ("mood", "sessions", "augmentation", "R_cum", "minus none", "pairs ahead")
    return markdown_table(head, lines)


AUGMENTATION: Final = ("none", "state", "action", "both", "none+reward weight")


def _case(row: ResultRow) -> tuple[float, int]:
    return float(str(row.conditions["mood"])), int(str(row.conditions["sessions"]))


def _of(found: BySeed, unit: str = "") -> tuple[str, str]:
    if not found:
        return NONE, NONE
    ahead = f"{sum(value > 0 for value in found.values())} of {len(found)}"
    return difference(summary(found.values()), summarise_logs(found), unit), ahead


def settings(rows: Sequence[ResultRow]) -> str:
    """One line per setting of UCF."""
    names = ("R_cum", "validation_loss", "acceptance")
    lines = [
        (method, len(own), *(level(summary(row.metrics[name] for row in own)) for name in names))
        for method, own in grouped(rows, lambda row: row.method).items()
    ]
    head = ("setting", "logs × seeds", "R_cum", "validation loss", "accepted edits")
    return markdown_table(head, lines)


def distractor(rows: Sequence[ResultRow]) -> str:
    """Returns of policies trained without the distractor, and with it, shown off and on."""
    lines = []
    cases = grouped(rows, lambda r: (str(r.environment), str(r.conditions["quantiles"]), r.method))
    for case, own in sorted(cases.items(), key=lambda item: (item[0][0], -float(item[0][1]))):
        clean, off, on = (
            index_by_seeds(row for row in own if row.conditions["distractor"] == rate)
            for rate in (None, 0, 1)
        )
        lost = [100 * (1 - off[seeds] / value) for seeds, value in clean.items()]
        means = [level(summary(each.values())) for each in (clean, off, on)]
        lines.append((*case, *means, difference(summary(lost))))
    head = ("environment", "target quantile", "method", "without", "off", "on", "lost when off, %")
    return markdown_table(head, lines)


def scores(rows: Sequence[ResultRow], references: Sequence[str] = ("ucf",)) -> str:
    """Scores by data file, then each method's score minus that of `references`."""
    tasks = dict.fromkeys(row.task.removesuffix("-zoo") for row in rows)
    head, values = ("method", *tasks, "mean"), values_by_task(rows, "score")
    found = {name: summarise_tasks(own) for name, own in values.items()}
    columns = zip(*found.values(), strict=True)
    best = [max(each.mean for each in column if each.count) for column in columns]

    def cell(sample: Summary, highest: float) -> str:
        text = level(sample, standard_error=True)
        return f"**{text}**" if sample.mean >= highest - NEAR * abs(highest) else text

    lines = [(name, *map(cell, own, best)) for name, own in found.items()]
    parts = [
        "Scores, mean ± standard error over training seeds; bold: within 5% of the best:",
        markdown_table(head, lines),
    ]
    for reference in references:
        shown = [
            (name, *map(difference, summarise_tasks([*map(subtract, own, values[reference])])))
            for name, own in values.items()
            if name != reference
        ]
        parts += [
            f"Minus the score of `{reference}` of the same training seed, ± standard error:",
            markdown_table(head, [line for line in shown if set(line[1:]) != {NONE}]),
        ]
    return "\n\n".join(parts)


def robustness(rows: Sequence[ResultRow]) -> str:
    """The largest loss of each method, then the score and the loss in every case."""
    lines = []
    cases = grouped(drops(rows), lambda line: (line["method"], line["task"], line["distractor"]))
    for (method, task, kind), own in cases.items():
        samples = {name: summary(line[name] for line in own) for name in DROPS}
        cells = [level(samples[name]) for name in ("clean", "score", "score_at_one")]
        lost = [rounded(samples[name].mean, most=1) for name in ("drop", "drop_at_one")]
        lines.append((task.removesuffix("-zoo"), kind, method, *cells, *lost))
    largest = [
        (line["method"], *(rounded(line[at], most=1) for at in ("at 0", "at 1")))
        for line in largest_drops(rows)
    ]
    head = ("file", "distractor", "method", "without", "at 0", "at 1", "lost at 0, %", "at 1, %")
    parts = [
        "Largest loss of each method, a mean over seeds, in percent of the score without the "
        "distractor:",
        markdown_table(("method", "at 0", "at 1"), largest),
        "Scores, mean ± standard deviation over seeds, and losses:",
        markdown_table(head, lines),
    ]
    return "\n\n".join(parts)


def contexts(rows: Sequence[ResultRow]) -> str:
    """Scores by context, and their mean where every file has one."""
    tasks = list(dict.fromkeys(row.task for row in rows))
    lines = []
    ordered = sorted(rows, key=lambda row: (row.method, str(row.conditions["context"]).zfill(4)))
    cases = grouped(ordered, lambda row: (row.method, row.conditions["context"]))
    for (method, context), own in cases.items():
        found = {row.task: row.value for row in own}
        mean = rounded(summary(found.values()).mean) if len(found) == len(tasks) else NONE
        cells = (rounded(found[task]) if task in found else NONE for task in tasks)
        lines.append((method, context, *cells, mean))
    head = ("method", "context", *(task.removesuffix("-zoo") for task in tasks), "mean")
    return markdown_table(head, lines)


def answers(rows: Sequence[ResultRow]) -> str:
    """How often an answer of `ope` was right, and what it answered in which launches."""
    log = pd.DataFrame(
        [{**row.as_line(), **row.details, **row.details.get("finds", {})} for row in rows]
    )
    launched, refused = log.answer == "launch", log.answer == "do not launch"
    better, wanted, high = log.gain > 0, log.gain == 0.05, log.gain == 0.1
    tested = log["session"].notna()
    by_session, by_item = (log[unit].eq(True) for unit in ("session", "item"))
    held = (log.low <= log.true * log.logged) & (log.true * log.logged <= log.high)
    shares = (
        ("`launch`: the policy is not better", launched, ~better),
        ("policies that are not better: `launch`", ~better, launched),
        ("+5% or +10%, where 5% is wanted: `do not launch`", better, refused),
        ("+10%: `launch`, or found by the planned test", high, launched | by_session),
        ("tests of +10%: gain found", tested & high, by_session),
        ("tests of +5%, for which they are planned: gain found", tested & wanted, by_session),
        ("tests of policies that are not better: gain found", tested & ~better, by_session),
        ("the same, by reward per item", tested & ~better, by_item),
        ("intervals of the lift with no reason against them: hold it", log.reliable, held),
    )
    lines = list[tuple[object, ...]]()
    for name, among, right in shares:
        if number := int(among.sum()):
            share = float(right[among].mean())
            low, top = share_interval(share, number)
            lines.append((name, number, f"{share:.1%}", f"{max(low, 0.0):.1%} to {top:.1%}"))
    said = [
        (words.format(value), len(own), *(f"{(own == one).mean() * 100:.0f}" for one in ANSWERS))
        for column, words in LOGS.items()
        for value, own in log["answer"].groupby(log[column])
    ]
    parts = [
        markdown_table(("of these, the share", "number", "share", "95% interval"), lines),
        "![Bar chart of the table below](assets/chart-launches.svg)",
        "<!-- chart: launches; Answers in percent; launch, test it, do not launch -->\n"
        + markdown_table(("launches", "number", *ANSWERS), said),
    ]
    return "\n\n".join(parts)


def of(name: str, table: str) -> Callable[[_Files], Sequence[ResultRow]]:
    """Chooses the rows of a table of a file."""
    return lambda files: [row for row in files.get(name, ()) if row.table == table]


@dataclass(frozen=True)
class Section:
    """A part of the page."""

    title: str
    about: str
    command: str
    rows: Callable[[_Files], Sequence[ResultRow]]
    table: Callable[[Sequence[ResultRow]], str]

    def text(self, files: _Files) -> str:
        """The part as Markdown."""
        rows = self.rows(files)
        parts = [f"## {self.title}", fill(self.about), self.table(rows)]
        return "\n\n".join([*parts, fill(_origin(rows, self.command))])


def _origin(rows: Sequence[ResultRow], command: str) -> str:
    """What measured the rows, and how long it took."""
    commits = sorted({row.commit[:7] for row in rows if row.commit})
    trained = {
        (row.method, row.training_seed, row.config_hash, row.metrics["train_wall_time_s"])
        for row in rows
        if "train_wall_time_s" in row.metrics
    }
    seconds = sum(each[-1] for each in trained) + sum(row.wall_time_s or 0.0 for row in rows)
    known = ", ".join(f"`{each}`" for each in commits)
    hours = f"{rounded(seconds / 3600, 2)} hours of one core"
    return f"*{len(rows)} rows; {command}; {hours}; measured at {known}.*"


RUN = "ucfrec benchmark recommendation --table"
CONTROL = "ucfrec-control benchmark --data $UCFREC_DATA/control --budget small --table"
IN_HISTORY = "(a script of earlier commits)"
SECTIONS = (
    Section(
        "Recommendation",
        "A method's name stands for it as published, `+shared` for it with the components that UCF "
        "has as well: exposure features, and a decision rule with a reward weight, selected on the "
        "log. Bold is the highest mean of a column among policies that "
        "do not know the simulator. The shared components decide, not the network: with them all "
        "methods are level in the catalogue and in KuaiRand, and behaviour cloning is ahead of UCF "
        "by 2 in SARDINE. In SARDINE and KuaiRand the rows of `+shared` methods are of an earlier "
        "selection of rules, but for `bc`, `dt`, `ucf` and, in KuaiRand, `cdt4rec`; so are those "
        "of `ucf-wo-count` there.",
        f"`{RUN} main`",
        of("recommendation", "main"),
        returns,
    ),
    Section(
        "The shared components, one by one",
        "The return of UCF, and the difference without one component, or with one more. In the "
        "catalogue the lookahead is worth 1.0 of 9.6, exposure features .2, and the policy itself "
        ".1. Exposure features cost 2.2 in SARDINE. The chosen decision rule is worth most of the "
        "return in KuaiRand and SARDINE. Rules of the catalogue have a lookahead, others have "
        "none.",
        f"`{RUN} shared`",
        of("recommendation", "shared"),
        components,
    ),
    Section(
        "Estimated and actual return",
        "The return that the user model, fitted to the log alone, estimates for the decision rule "
        "that was chosen, and the return in the simulator: means over logs and training seeds of "
        "the rows that record the estimate.",
        f"`{RUN} main`",
        estimated,
        estimates,
    ),
    Section(
        "Counterfactual augmentation",
        "Return minus that without augmentation, by log and training seed, in the synthetic "
        "catalogue, ± standard error over the pairs, in brackets over the means of logs. Mood is "
        "the strength of a planted confounder of each session. Over all sizes in percent of the "
        "return without augmentation. Augmented actions gain with a confounder and nothing "
        "without; augmented states change nothing significant.",
        f"`python benchmarks/counterfactual_copies.py --out runs/copies` {IN_HISTORY}",
        of("counterfactual_copies", "counterfactual-copies"),
        augmentation,
    ),
    Section(
        "Settings of UCF",
        "In the synthetic catalogue. Supervision of the attention (λ) never helped; the band of "
        "the edits and the gate change nothing.",
        f"`{RUN} sweeps`",
        of("recommendation", "sweeps"),
        settings,
    ),
    Section(
        "A misleading column",
        "A planted observation that agrees with the reward in the log and has no effect. UCF loses "
        "up to 65%.",
        f"`{RUN} distractor`",
        of("recommendation", "distractor"),
        distractor,
    ),
    Section(
        "Control",
        "Normalised scores of the last checkpoint after 4,000 steps in batches of 16, a hundredth "
        "of the authors' training (IQL: 50,000 in batches of 64, CQL: 10,000). Learning rates were "
        "chosen on validation loss by one search for all methods. Without a standard error there "
        "is one seed, and a difference may be chance. At these equal steps UCF is between DT and "
        "DC, and all sequence policies are behind cloning the best quarter of the trajectories; "
        "longer trainings may differ.",
        f"`{CONTROL} main`",
        of("control", "main"),
        scores,
    ),
    Section(
        "Control at the medium budget",
        "Scores of the last checkpoint after 10,000 steps in batches of 64 windows of 8 steps, for "
        "cloning of 512 steps, at width 128, with averaged weights, in 50 episodes. One seed, so a "
        "difference may be chance. `ucf-wo-count-context-20` is `ucf-wo-count` with the 20 steps "
        "of history that the search below selects, `--context ucf-wo-count=20`. DC and LSDT were "
        "trained on a GPU (H200), the others on CPUs.",
        "`ucfrec-control benchmark --data $UCFREC_DATA/control --budget medium --table main "
        "--seeds 1`",
        of("control_medium", "main"),
        partial(scores, references=("ucf-wo-count",)),
    ),
    Section(
        "Control: 8 or 20 steps of history",
        "The search for the context of each method at the medium budget: one seed, in other "
        "episodes than those of the reported scores, trained on a GPU (H200). DT and DC do better "
        "with 8 steps, UCF with 20. LSDT with 20 was measured on one file only, so it keeps 8.",
        "a script of earlier commits, `control_search.py contexts --budget medium`",
        of("control_medium", "contexts"),
        contexts,
    ),
    Section(
        "Control at equal training time",
        "The same files, rates and batches, but more steps for the faster methods (x2, x3, x8). "
        "UCF x2 and cloning x8 train about as long as DT and DC, UCF x3 as long as LSDT, half "
        "as long again. `ucf-paper` has 4,000 steps here too. `best-25` learns from the best "
        "quarter of the trajectories. UCF without augmentation is ahead of DT, DC and LSDT on all "
        "trajectories, and level with cloning the best quarter.",
        f"`{CONTROL} equal-time`",
        of("control", "equal-time"),
        partial(scores, references=("ucf-x2", "ucf-wo-count-x2", "ucf-wo-count-best-25-x2")),
    ),
    Section(
        "Control: the best quarter of the trajectories",
        "All without embeddings of time steps. Learning from the best quarter alone helps every "
        "method. One seed, so a difference may be chance.",
        f"`{CONTROL} pursuing`",
        of("control", "pursuing"),
        scores,
    ),
    Section(
        "Control: the cost of a distractor",
        "Policies trained with a distractor in their states and evaluated with it fixed to 0, and "
        "the same policies with it fixed to 1. Dropping what screening flags costs nothing.",
        "`ucfrec-control robustness --data $UCFREC_DATA/control --budget small`",
        of("control_robustness", "robustness"),
        robustness,
    ),
    Section(
        "Launches",
        "Answers of `ope` to simulated launches, whose true gain in return per session is -10%, 0, "
        "+5% or +10%. In the synthetic catalogue and at a publisher with pages of four articles, "
        "logs are of 400, 1,200 or 3,000 users with two sessions each, and 5%, 20% or 100% of "
        "their requests explore. A lift of 5% is wanted, the default. Tests are A/B tests of the "
        "users that `ope` plans, at their end: by the return per session, for which they are "
        "planned, and by the reward per item. All policies draw by scores of items, the same for "
        "every user. A policy with a gain of 0 counts as not better. Gains "
        "of +5% are 4.6% in the mean at the publisher, of which 75% of such tests would find one.",
        "`python benchmarks/launches.py`",
        of("launches", "launches"),
        answers,
    ),
)


NAMES = (
    ("ucf", "UCF with augmented states; by default `train` augments nothing"),
    ("ucf-wo-count", "UCF without augmentation, the default of `train`"),
    ("ucf-wo-arch", "DT on the augmented data of UCF"),
    ("ucf-plain", "UCF without the shared components"),
    (
        "ucf-paper",
        "the paper's losses and generator, at the budget's width, batch and rate; `-algorithm-5` "
        "edits states as its Algorithm 5 says",
    ),
    ("ucf-screened, -dropped", "interventions on dimensions that screening flags; without them"),
    ("-wo-exposure, -wo-rule", "without exposure features; without a selected rule"),
    ("-actions, -both", "augmented actions; augmented states and actions"),
    ("bc-10, bc-25", "behaviour cloning of the best 10% or 25% of the episodes"),
    ("-best-25", "trained on the best 25% of the trajectories"),
    ("-wo-time", "without timestep embeddings"),
    ("-mask", "without items that share a tag with the last ten"),
    ("-x2, -x3, -x8", "two, three or eight times the training steps"),
    ("-context-N", "N steps of history"),
)
"""Methods and suffixes of the tables, and what they mean."""


def page(files: _Files, pictures: Sequence[str]) -> str:
    """The whole page as Markdown."""
    head = fill(
        "Written by `python benchmarks/results_page.py` from the rows in `benchmarks/results`. "
        "[Results](results.md) explains them, the [lab notebook](log.md) lists what was tried. "
        "Every benchmark resumes where it was interrupted."
    )
    paper = fill(
        "**These are numbers of the paper's own simulators and do not compare with ours.** The "
        "best public match for a return of 7 to 8 in KuaiRand is repeats allowed with N = 10; "
        "DORL's published 11.9 over 27.6 steps is NX_0 at N = 4, `kuairand-n4-nx0` here. KuaiRec's "
        "files were not available."
    )
    shown = "\n".join(f"![{name}](assets/tables/{name}.svg)" for name in pictures)
    about = "\n".join(fill(f"- {each}", subsequent_indent="  ") for each in ENVIRONMENTS)
    parts = ["# Tables", head, "## What each simulator can and cannot show", about]
    names = [(f"`{name}`".replace(", ", "`, `"), said) for name, said in NAMES]
    parts += ["## Names of methods", markdown_table(("name", "meaning"), names)]
    parts += [section.text(files) for section in SECTIONS if section.rows(files)]
    parts += ["## The paper's Table 2", paper, PAPER]
    parts += ["## Pictures", shown] if pictures else []
    return "\n\n".join(parts) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--check", action="store_true", help="compare instead of writing")
    options = parser.parse_args()
    files = {name: latest(read_rows(RESULTS / f"{name}.jsonl")) for name in FILES}
    if not options.check:
        from results_pictures import draw

        draw(files, METHODS, PICTURES)
    text = page(files, [path.stem for path in sorted(PICTURES.glob("*.svg"))])
    if not options.check:
        PAGE.write_text(text, encoding="utf-8")
        print(f"page: {PAGE}")
    elif PAGE.read_text(encoding="utf-8") != text:
        sys.exit(f"{PAGE} is not what the rows say; run python benchmarks/results_page.py")


if __name__ == "__main__":
    main()
