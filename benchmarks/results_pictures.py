"""Pictures of the page of tables; `results_page.py` draws them."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from counterfactual_copies import ARMS, compared
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ucfrec.reporting.plot_style import OURS, PAGE, PLAIN, save, styled
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.statistics import Summary, grouped, summary


@styled
def draw(
    main: Sequence[ResultRow],
    copies: Sequence[ResultRow],
    control: Mapping[str, Sequence[ResultRow]],
    folder: Path,
) -> None:
    """Draw each environment of Table 2, the copies, and control's scores.

    Args:
        main: rows of the recommendation benchmark's main table.
        copies: rows of the benchmark of counterfactual copies.
        control: rows of the control benchmark, by the table's name.
        folder: gets a picture each.
    """
    for environment, group in grouped(main, lambda row: str(row.environment)).items():
        figure = Figure(figsize=(5.2, 4.6))
        axes = figure.add_subplot()
        axes.set_title(environment)
        found = {
            name: summary(row.value for row in rows)
            for name, rows in grouped(group, lambda row: row.method).items()
        }
        _bars(axes, found, {name: each.sd for name, each in found.items()})
        axes.set_xlabel("return of a session (mean ± sd over logs and training seeds)")
        save(figure, folder, f"table-2-{environment}")
    _draw_copies(copies, folder)
    for table, rows in control.items():
        _draw_control(rows, folder, f"control-{table}")


def _bars(axes: Axes, found: dict[str, Summary], errors: dict[str, float]) -> None:
    """A horizontal bar a method, the first on top, UCF in its color."""
    names = list(found)[::-1]
    axes.barh(
        names,
        [found[name].mean for name in names],
        xerr=[errors[name] if found[name].count > 1 else 0.0 for name in names],
        color=[OURS if _is_ucf(name) else PLAIN for name in names],
        height=0.7,
    )


def _is_ucf(method: str) -> bool:
    """Whether a method is UCF as it is here, perhaps without copies or with more steps."""
    return method == "ucf" or method.startswith(("ucf-x", "ucf-wo-count"))


def _draw_copies(rows: Sequence[ResultRow], folder: Path) -> None:
    """What copies change, by the size of the log, for each planted confounder."""
    copies = compared(rows)
    if not copies:
        return
    figure = Figure(figsize=(5.2, 3.2))
    panels = figure.subplots(1, len({mood for mood, _ in copies}), sharey=True, squeeze=False)
    for axes, mood in zip(panels[0], sorted({mood for mood, _ in copies}), strict=True):
        axes.set_title(f"mood {mood:g}")
        axes.axhline(0.0, color=PLAIN, linewidth=0.8)
        for arm in [name for name in ARMS if name != "none"]:
            of_mood = sorted((size, own) for (m, size), own in copies.items() if m == mood)
            measured = [(size, own[arm].pairs) for size, own in of_mood if arm in own]
            if not measured:
                continue
            sizes, found = zip(*measured, strict=True)
            errors = [each.standard_error if each.count > 1 else 0.0 for each in found]
            means = [each.mean for each in found]
            axes.errorbar(sizes, means, yerr=errors, marker="o", label=arm)
        axes.set_xscale("log")
        axes.set_xlabel("logged sessions")
    panels[0][0].set_ylabel("return less that of no copies")
    panels[0][-1].legend()
    save(figure, folder, "copies")


def _draw_control(rows: Sequence[ResultRow], folder: Path, name: str) -> None:
    """The score of every method on each file, last checkpoints."""
    of_files = grouped([row for row in rows if row.checkpoint == "last"], lambda row: row.task)
    if not of_files:
        return
    lines = -(-len(of_files) // 3)
    figure = Figure(figsize=(PAGE, 2.6 * lines))
    panels = figure.subplots(lines, 3, sharey=True, squeeze=False).ravel()
    for axes, task in zip(panels, sorted(of_files), strict=False):
        own = grouped(of_files[task], lambda row: row.method)
        found = {method: summary(row.value for row in own[method]) for method in sorted(own)}
        _bars(axes, found, {method: each.standard_error for method, each in found.items()})
        axes.set_title(task.removesuffix("-zoo"))
        axes.tick_params(axis="y", labelsize=6)
    figure.supxlabel("normalised score (mean ± standard error over training seeds)", fontsize=8)
    save(figure, folder, name)
