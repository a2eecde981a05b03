"""Pictures of the page of tables; `results_page.py` draws them."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from ucfrec.results.charts import OURS, PAGE, PLAIN, file_style, save
from ucfrec.results.rows import ResultRow
from ucfrec.results.statistics import grouped, summary


@file_style()
def draw(files: Mapping[str, Sequence[ResultRow]], order: Sequence[str], folder: Path) -> None:
    """Draw the returns in each simulator of Table 2, control's scores, and those of checkpoints.

    Args:
        files: rows by the name of their file.
        order: methods of the recommendation benchmark, from top to bottom.
        folder: gets the pictures; earlier ones are removed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for earlier in folder.iterdir():
        earlier.unlink()
    main = [row for row in files["recommendation"] if row.table == "main"]
    main.sort(key=lambda row: order.index(row.method) if row.method in order else len(order))
    _panels(main, "environment", "return (mean ± sd over logs and seeds)", folder, "returns")
    for table in ("main", "equal-time"):
        rows = [row for row in files["control"] if row.table == table]
        label = "normalized score (mean ± sd over training seeds)"
        _panels(rows, "task", label, folder, f"control-{table}")
    if files["control_spread"]:
        _checkpoints(files["control_spread"], folder, "control-spread")
    for drawn in folder.glob("*.png"):
        drawn.unlink()


def _panels(rows: Sequence[ResultRow], by: str, label: str, folder: Path, name: str) -> None:
    """A panel for each value of the field `by`, three in a line: a bar a method, the first on top,
    UCF in its color."""
    groups = grouped(rows, lambda row: str(getattr(row, by)).removesuffix("-zoo"))
    methods = list(dict.fromkeys(row.method for row in rows))
    lines = -(-len(groups) // 3)
    figure = Figure(figsize=(PAGE, lines * (0.6 + 0.09 * len(methods))))
    panels = figure.subplots(lines, 3, sharey=True, squeeze=False).ravel()
    for axes, title in zip(panels, groups, strict=False):
        axes.set_title(title)
        axes.tick_params(axis="y", labelsize=5)
        of = grouped(groups[title], lambda row: row.method)
        found = {name: summary(row.value for row in of.get(name, ())) for name in methods[::-1]}
        ours = [n == "ucf" or n.startswith(("ucf-x", "ucf-wo-count")) for n in found]
        axes.barh(
            list(found),
            [each.mean if each.count else 0.0 for each in found.values()],
            xerr=[each.sd if each.count > 1 else 0.0 for each in found.values()],
            color=[OURS if is_ours else PLAIN for is_ours in ours],
            height=0.7,
        )
    for axes in panels[len(groups) :]:
        axes.set_visible(False)
    figure.supxlabel(label, fontsize=8)
    save(figure, folder, name)


def _checkpoints(rows: Sequence[ResultRow], folder: Path, name: str) -> None:
    """A panel for each file: the scores of every training's last checkpoints, raw and averaged."""
    files = grouped(rows, lambda row: row.task.removesuffix("-zoo"))
    figure = Figure(figsize=(PAGE, 2.2))
    panels = figure.subplots(1, len(files), sharey=True, squeeze=False).ravel()
    for axes, (title, own) in zip(panels, files.items(), strict=True):
        axes.set_title(title)
        seeds = sorted({row.training_seed for row in own if row.training_seed is not None})
        axes.set_xticks(seeds, [f"seed {seed}" for seed in seeds])
        for weights, color, aside in (("raw", PLAIN, -0.15), ("averaged", OURS, 0.15)):
            shown = [row for row in own if row.conditions["weights"] == weights]
            at = [(row.training_seed or 0) + aside for row in shown]
            last = [row.conditions["checkpoints_before_last"] == 0 for row in shown]
            sizes = [26 if each else 7 for each in last]
            axes.scatter(at, [row.value for row in shown], sizes, color=color, label=weights)
    panels[0].set_ylabel("normalized score")
    panels[0].legend(loc="best")
    save(figure, folder, name)
