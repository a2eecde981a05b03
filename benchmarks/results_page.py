"""docs/tables.md: the tables of results, written from the rows in benchmarks/results.

    python benchmarks/results_page.py          # writes the page, and its pictures with matplotlib
    python benchmarks/results_page.py --check  # fails where the page is not what the rows say

Rows of earlier code count: the page says which commits measured a table.
"""

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from textwrap import TextWrapper
from typing import Any

from counterfactual_copies import difference_table as copies_table

from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import latest, read_rows
from ucfrec.reporting.statistics import grouped, summary
from ucfrec.reporting.tables import NONE, markdown_table, mean_and_sd
from ucfrec_control.benchmark.robustness import SHOWN as SHOWN_DROPS
from ucfrec_control.benchmark.robustness import SHOWN_LARGEST, drops, largest_drops
from ucfrec_control.benchmark.tables import difference_table, over_seeds, score_table
from ucfrec_simulators.benchmark.methods import ADDITIONS, METHODS, PAPER
from ucfrec_simulators.benchmark.tables import difference_to_ours, distractor_table, sweep_table

HERE = Path(__file__).parent
RESULTS, PAGE = HERE / "results", HERE.parent / "docs" / "tables.md"
PICTURES = HERE.parent / "docs" / "assets" / "tables"
PUBLISHED = """\
| method | KuaiRand R_cum | R_avg | KuaiRec R_cum | R_avg | VirtualTB R_cum | R_avg |
|---|---|---|---|---|---|---|
| DT4Rec | 6.82 ± 2.45 | 0.569 | 28.54 ± 10.42 | 0.880 | 76.79 ± 22.63 | 5.442 |
| CDT4Rec | 7.33 ± 1.98 | 0.651 | 30.49 ± 10.19 | 1.006 | 79.21 ± 22.38 | 5.649 |
| EDT4Rec | 7.58 ± 1.84 | 0.650 | 31.07 ± 10.98 | 1.040 | 79.67 ± 21.67 | 5.674 |
| UCF | 7.62 ± 1.79 | 0.655 | 31.87 ± 10.55 | 1.058 | 80.42 ± 21.15 | 5.696 |"""
ENVIRONMENTS = (
    "**VirtualTaobao** cannot tell good methods apart: one constant action earns 10 clicks of 10 "
    "on every page.",
    "**KuaiRand FB and NX_0** (N = 10) tell whether a policy stops repeating tags, and then how "
    "well it knows the items' click rates; `random-mask` is what the first alone earns. With N = 4 "
    "or 1 there is less to stop.",
    "**KuaiRand NX_10** has sessions of ten steps whatever is shown: planning has nothing to gain, "
    "one-step greed is the floor to beat.",
    "**The synthetic catalogue** punishes greed, and its optimum is known. We wrote it.",
    "**SARDINE BoredInf** was written by nobody here. Nothing is known of a user at first, and "
    "five clicks on one topic bore: it tells who learns tastes within a session, and who gives "
    "them a rest.",
    "None of them says what real users would do: see [what the numbers cannot "
    "tell](numbers.md#what-they-cannot-tell).",
)
BUILT_IN = ("oracle", "optimal", "best-constant")
"""Policies that know an environment; never the best of a column."""


def fill(text: str, subsequent_indent: str = "") -> str:
    """Lines of at most 100 characters."""
    wrapper = TextWrapper(
        100, subsequent_indent=subsequent_indent, break_long_words=False, break_on_hyphens=False
    )
    return wrapper.fill(text)


@dataclass(frozen=True)
class Section:
    """A part of the page."""

    title: str
    about: str
    command: str
    rows: Callable[[Mapping[str, Sequence[ResultRow]]], Sequence[ResultRow]]
    table: Callable[[Sequence[ResultRow]], str]

    def text(self, files: Mapping[str, Sequence[ResultRow]]) -> str:
        """The part as Markdown."""
        rows = self.rows(files)
        about, origin = fill(self.about), fill(_origin(rows, self.command))
        parts = [f"## {self.title}", about, self.table(rows), origin]
        return "\n\n".join(part for part in parts if part)


def _origin(rows: Sequence[ResultRow], command: str) -> str:
    """What measured the rows, and how long it took."""
    commits = sorted({row.commit[:7] for row in rows if row.commit})
    trained = {
        (row.method, row.training_seed, row.config_hash, row.data_fingerprint): row.metrics[
            "train_wall_time_s"
        ]
        for row in rows
        if "train_wall_time_s" in row.metrics
    }
    hours = (sum(trained.values()) + sum(row.wall_time_s or 0.0 for row in rows)) / 3600
    parts = [f"{len(rows)} rows", f"`{command}`"]
    if trained:
        parts.append(f"{hours:.1f} hours of one core")
    known = "an unknown commit" if not commits else ", ".join(f"`{each}`" for each in commits)
    return f"*{'; '.join(parts)}; measured at {known}.*"


def pivot(
    rows: Sequence[ResultRow], cell: Callable[[str, str, Sequence[ResultRow]], str], methods: Any
) -> str:
    """One line a method and one column an environment; `cell` is given (environment, method, their
    rows)."""
    environments = list(dict.fromkeys(str(row.environment) for row in rows))
    of = grouped(rows, lambda row: (str(row.environment), row.method))
    named = {row.method: None for row in rows}
    order = [*(n for n in named if n not in methods), *(n for n in methods if n in named)]
    lines = [
        (name, *(cell(w, name, of[w, name]) if (w, name) in of else NONE for w in environments))
        for name in order
    ]
    return markdown_table(("method", *environments), lines)


def returns_and_differences(rows: Sequence[ResultRow]) -> str:
    """Returns, then average rewards, then what each method earns less than UCF."""
    best: dict[str, float] = {}
    for (environment, method), group in grouped(
        rows, lambda row: (str(row.environment), row.method)
    ).items():
        mean = summary(row.value for row in group).mean
        if method not in BUILT_IN:
            best[environment] = max(best.get(environment, mean), mean)

    def earned(environment: str, method: str, group: Sequence[ResultRow]) -> str:
        said = mean_and_sd(row.value for row in group)
        is_best = summary(row.value for row in group).mean == best.get(environment)
        return f"**{said}**" if is_best and method not in BUILT_IN else said

    def average(environment: str, method: str, group: Sequence[ResultRow]) -> str:
        return mean_and_sd(row.metrics["R_avg_episode"] for row in group)

    differences = difference_to_ours(rows)
    parts = [
        "R_cum, mean ± standard deviation over logs and training seeds:",
        pivot(rows, earned, METHODS),
        "R_avg, the mean reward of a session's step:",
        pivot(rows, average, METHODS),
        fill(
            "R_cum less that of `ucf` of the same log and seed, ± standard error over the pairs, "
            "in brackets over the means of logs:"
        ),
        pivot(rows, lambda environment, method, _: differences[environment, method], METHODS),
    ]
    return "\n\n".join(parts)


def additions(rows: Sequence[ResultRow]) -> str:
    """What UCF earns with and without each addition, as differences."""
    differences = difference_to_ours(rows)

    def cell(environment: str, method: str, group: Sequence[ResultRow]) -> str:
        if method == "ucf":
            return mean_and_sd(row.value for row in group)
        return differences[environment, method]

    return pivot(rows, cell, {"ucf": None, **ADDITIONS, **PAPER})


def promises(rows: Sequence[ResultRow]) -> str:
    """What was promised of the chosen rules, and what came; then how far off it was."""

    def cell(environment: str, method: str, group: Sequence[ResultRow]) -> str:
        said = summary(row.metrics["promised"] for row in group).mean
        return f"{said:.3g} → {summary(row.value for row in group).mean:.3g}"

    def off(own: Sequence[ResultRow]) -> str:
        return f"{summary(abs(row.metrics['promised'] - row.value) for row in own).mean:.2g}"

    lines = []
    for environment, own in grouped(rows, lambda row: str(row.environment)).items():
        logs = grouped(own, lambda row: str(row.log_seed)).items()
        of_logs = ", ".join(f"log {name} {off(group)}" for name, group in logs)
        lines.append((environment, len(own), off(own), of_logs))
    told = markdown_table(("environment", "rows", "off by, mean", "by log"), lines)
    return f"{pivot(rows, cell, METHODS)}\n\n{told}"


def promised(files: Mapping[str, Sequence[ResultRow]]) -> Sequence[ResultRow]:
    """Rows of the main table whose rule was chosen, and that say what it promised."""
    return [row for row in of("recommendation", "main")(files) if "promised" in row.metrics]


def scores(rows: Sequence[ResultRow], references: Sequence[str] = ("ucf",)) -> str:
    """Table 1's shape: last checkpoints, then each method's score less that of `references`."""
    last = [row for row in rows if row.checkpoint == "last"]
    parts = [
        "Scores, mean ± standard error over seeds; bold: within 5% of the best:",
        of_lines(score_table(last, "last")),
    ]
    for reference in references:
        parts += [
            f"Scores less that of `{reference}` of the same seed, ± standard error:",
            of_lines(difference_table(last, reference)),
        ]
    return "\n\n".join(parts)


def losses_to_distractors(rows: Sequence[ResultRow]) -> str:
    """The largest drop of each method, then all."""
    shown = ("task", "distractor", "method")
    largest = markdown_table(
        SHOWN_LARGEST,
        [
            (line["method"], *(f"{line[at]:.1f}" for at in SHOWN_LARGEST[1:]))
            for line in largest_drops(rows)
        ],
    )
    parts = [
        "Each method's largest loss, of means over seeds, in percent of the clean score:",
        largest,
        "Scores, mean ± standard deviation over seeds, and losses in percent:",
        of_lines(over_seeds(drops(rows), shown, SHOWN_DROPS)),
    ]
    return "\n\n".join(parts)


def of_lines(lines: Sequence[Mapping[str, Any]]) -> str:
    """A table whose columns are those of its first line."""
    return markdown_table(list(lines[0]), [list(line.values()) for line in lines])


def of(name: str, table: str, dated: bool = True) -> Callable[..., Sequence[ResultRow]]:
    """Chooses the rows of `table` of a file; if `dated`, those with the version of their code."""

    def chosen(files: Mapping[str, Sequence[ResultRow]]) -> Sequence[ResultRow]:
        rows = [row for row in files.get(name, ()) if row.table == table]
        return [row for row in rows if row.code_version or not dated]

    return chosen


def histories(files: Mapping[str, Sequence[ResultRow]]) -> Sequence[ResultRow]:
    """What learns from the best quarter with shorter histories, and what that is compared with."""
    shorter = [r for r in of("control_histories", "equal-time")(files) if "-context-" in r.method]
    same_time = [r for r in of("control", "equal-time")(files) if "-25" in r.method]
    cloning = [r for r in of("control", "main")(files) if r.method in ("bc-10", "bc-25")]
    return [*shorter, *same_time, *cloning] if shorter else []


RUN = "ucfrec benchmark recommendation --table"
CONTROL = "ucfrec-control benchmark $UCFREC_DATA/control --budget small --table"
SECTIONS = (
    Section(
        "Recommendation (Table 2)",
        "A learner's name stands for it as its authors have it, `+` for it with what UCF has as "
        "well: exposure features, and a decision rule with a reward weight by the reward model, "
        "chosen on the log. `ucf-plain` is UCF without them, `ucf-paper` the paper's. `…-mask` "
        "leaves out the tags of the last ten items. Bold is the highest of a column among what "
        "knows no environment.",
        f"{RUN} main",
        of("recommendation", "main"),
        returns_and_differences,
    ),
    Section(
        "Additions to the paper, one by one",
        "What UCF earns, and by how much more or less without one of the additions, or with "
        "something more.",
        f"{RUN} additions",
        of("recommendation", "additions"),
        additions,
    ),
    Section(
        "What was promised, and what came",
        "The return that the model of the users, fitted to the log alone, gave the rule that was "
        "chosen, and the return in the environment: means over logs and training seeds. Rows "
        "measured before they said so are missing.",
        f"{RUN} main",
        promised,
        promises,
    ),
    Section(
        "Counterfactual copies",
        "Return less that of no copies, by log and training seed, in the synthetic catalogue; "
        "mood is the strength of a planted confounder of each session. Over all sizes: in percent "
        "of the return without copies.",
        "python benchmarks/counterfactual_copies.py --out runs/copies",
        of("counterfactual_copies", "counterfactual-copies"),
        copies_table,
    ),
    Section(
        "Settings of UCF",
        "",
        f"{RUN} sweeps",
        of("recommendation", "sweeps"),
        sweep_table,
    ),
    Section(
        "A distractor that causes nothing",
        "",
        f"{RUN} distractor",
        of("recommendation", "distractor"),
        distractor_table,
    ),
    Section(
        "Control (Tables 1 and 3)",
        "Normalised scores of the last checkpoint after 4,000 steps in batches of 16, a hundredth "
        "of what the authors' settings learn from (IQL: 50,000 in batches of 64, CQL: 10,000). "
        "Learning rates were chosen on validation loss by one search for all learners (IQL's with "
        "20,000 steps, CQL's with 2,500). Where no standard error stands there is one seed, and a "
        "difference may be luck.",
        f"{CONTROL} main",
        of("control", "main"),
        scores,
    ),
    Section(
        "Control: the same training time",
        "The same files, rates and batches, but more steps for what learns faster (x2, x3, x8). "
        "Trainings of UCF x2 and of cloning x8 take about as long as DT's and DC's, trainings of "
        "UCF x3 as long as LSDT's, half as long again. The paper's UCF has 4,000 steps here too. "
        "`best-25` learns from the best quarter of the trajectories. One seed where no "
        "standard error stands.",
        f"{CONTROL} equal-time",
        of("control", "equal-time"),
        partial(scores, references=("ucf-x2", "ucf-wo-count-x2", "ucf-wo-count-best-25-x2")),
    ),
    Section(
        "Control: what a history is worth",
        "Trained as above on the best quarter of the trajectories, with histories of 1 and of 5 "
        "steps (`context`) at as many predictions per update, beside the rows with 20 steps and "
        "behaviour cloning. Made after the scores with 20 steps on `hopper_medium-expert` were "
        "seen. One seed where no standard error stands.",
        "python benchmarks/control_histories.py --data $UCFREC_DATA/control --out runs/control",
        histories,
        partial(scores, references=("ucf-wo-count-best-25-x2-context-1",)),
    ),
    Section(
        "Control: ways to pursue reward",
        "All without embeddings of time steps, as UCF is: advantage weights, the largest return "
        "that the policy expects as target, both, and the best quarter of the trajectories. One "
        "seed, and of `weights` one file, of DC with `max-return` five: a difference may be luck.",
        f"{CONTROL} pursuing",
        of("control", "pursuing"),
        scores,
    ),
    Section(
        "Control: what a distractor costs (Figures 3 and 4)",
        "Policies trained with a distractor in their states and played with it fixed to 0, and the "
        "same policies with it fixed to 1.",
        "ucfrec-control robustness --data $UCFREC_DATA/control --budget small",
        of("control_robustness", "robustness"),
        losses_to_distractors,
    ),
)


def page(files: Mapping[str, Sequence[ResultRow]], pictures: Sequence[str]) -> str:
    """The whole page as Markdown."""
    head = fill(
        "Written by `python benchmarks/results_page.py` from the rows in "
        "`benchmarks/results`. What they mean is in [What was found](results.md), what was tried "
        "in [the log](log.md). Every benchmark says how long it will take before it starts, and "
        "goes on where it was interrupted."
    )
    paper = fill(
        "**Its numbers, of its environments**: they do not compare with ours. "
        "The best public match for a return of 7 to 8 in KuaiRand is repeats allowed with N = 10; "
        "DORL's published 11.85 over 27.6 steps is NX_0 at N = 4, the environments "
        "`kuairand-n4-nx0` here. KuaiRec's files were not at hand."
    )
    shown = "\n".join(f"![{name}](assets/tables/{name}.svg)" for name in pictures)
    environments = "\n".join(
        fill(f"- {environment}", subsequent_indent="  ") for environment in ENVIRONMENTS
    )
    parts = ["# Tables", head, "## What each environment can and cannot tell", environments]
    parts += [section.text(files) for section in SECTIONS if section.rows(files)]
    parts += ["## The paper's Table 2", paper, PUBLISHED]
    parts += ["## Pictures", shown] if pictures else []
    return "\n\n".join(parts) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="compare instead of writing")
    options = parser.parse_args()
    names = (
        *("recommendation", "counterfactual_copies"),
        *("control", "control_robustness", "control_histories"),
    )
    files = {name: latest(read_rows(RESULTS / f"{name}.jsonl")) for name in names}
    if not options.check and find_spec("matplotlib") is not None:
        from results_pictures import draw

        PICTURES.mkdir(parents=True, exist_ok=True)
        draw(
            of("recommendation", "main")(files),
            of("counterfactual_copies", "counterfactual-copies")(files),
            {table: of("control", table)(files) for table in ("main", "equal-time")},
            PICTURES,
        )
        for drawn in PICTURES.glob("*.png"):
            drawn.unlink()
    text = page(files, [path.stem for path in sorted(PICTURES.glob("*.svg"))])
    if not options.check:
        PAGE.write_text(text, encoding="utf-8")
        print(f"page: {PAGE}")
    elif PAGE.read_text(encoding="utf-8") != text:
        sys.exit(f"{PAGE} is not what the rows say; run python benchmarks/results_page.py")


if __name__ == "__main__":
    main()
