"""Rows and arrays to figures: every function returns one matplotlib Figure."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ucfrec.arrays import Float64Array
from ucfrec.results.charts import COLUMN, OURS, PAGE, PLAIN, file_style
from ucfrec.results.statistics import summary

Row = Mapping[str, Any]
FACTUAL, EDITED = "#0072B2", "#D55E00"
# The color-blind-safe palette of Okabe and Ito (2008).
_PALETTE = (
    *("#0072B2", "#E69F00", "#009E73", "#D55E00"),
    *("#CC79A7", "#56B4E9", "#000000", "#8C8C8C"),
)
# A method or condition has the same color in all figures.
_FIXED = {
    **{"bc": "#8C8C8C", "dt": "#0072B2", "dc": "#56B4E9", "lsdt": "#009E73", "ucf": "#D55E00"},
    **{"ucf-screened": "#CC79A7", "ucf-dropped": "#F0E442"},
    **{"ucf-wo-count": "#E69F00", "ucf-wo-arch": "#000000"},
    **{"none": "#8C8C8C", "deterministic": "#0072B2", "stochastic": "#56B4E9", "early": "#E69F00"},
}
_LABELS = {
    **{name: name.upper() for name in ("bc", "dt", "dc", "lsdt", "ucf")},
    **{"ucf-screened": "UCF, screened", "ucf-dropped": "UCF, dropped"},
    **{"ucf-wo-count": "w/o Count", "ucf-wo-arch": "w/o Arch", "none": "no distractor"},
}
_PANELS = 3
"""Most datasets side by side."""


def label(name: str) -> str:
    """Display name of a method or condition in figures."""
    return _LABELS.get(name, name)


def colors(names: Iterable[str]) -> dict[str, str]:
    """Name to color: the fixed color of the name, else an unused color of the palette."""
    labels = list(names)
    taken = {_FIXED.get(name) for name in labels}
    free = cycle([color for color in _PALETTE if color not in taken] or _PALETTE)
    return {name: _FIXED.get(name) or next(free) for name in labels}


@file_style()
def move_histogram(
    edges: Sequence[float], counts: Sequence[int], band: tuple[float, float], title: str = ""
) -> Figure:
    """Accepted edits by the length of their move, with the band (Figures 5 and 6, left)."""
    length = r"length of the move $\|\Delta\|_2$ (standard deviations)"
    figure, axes = _figure(COLUMN, 2.1, title, length, "accepted edits (%)")
    shares = 100 * np.asarray(counts) / max(1, sum(counts))
    axes.bar(edges[:-1], shares, np.diff(edges), align="edge", color=FACTUAL, edgecolor="white")
    for bound, name in zip(band, (r"$\rho_\mathrm{low}$", r"$\rho_\mathrm{high}$"), strict=True):
        axes.axvline(bound, color="black", linestyle="--", linewidth=0.9)
        place: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "va": "top"}
        axes.annotate(name, (bound, 1), (2, -2), textcoords="offset points", **place)
    axes.set_xlim(0, 1.12 * max(edges[-1], band[1]))
    axes.set_ylim(0, 1.18 * max(shares.max(), 1e-9))
    return figure


@file_style()
def acceptance_heatmap(
    lows: Sequence[float],
    highs: Sequence[float],
    acceptance: Float64Array,
    band: tuple[float, float],
    title: str = "",
) -> Figure:
    """Share of accepted proposals under every band; the run's own is outlined (Figures 5 and 6).

    Args:
        acceptance: (lows, highs) from 0 to 1, NaN where there is no such band.
    """
    high, low = (rf"$\rho_\mathrm{{{side}}}$ (standard deviations)" for side in ("high", "low"))
    figure, axes = _figure(COLUMN, 2.6, title, high, low)
    image = axes.imshow(100 * acceptance, vmin=0, vmax=100, origin="lower", aspect="auto")
    axes.spines[["left", "bottom"]].set_visible(False)
    dark = colormaps[image.get_cmap().name]
    for (row, column), share in np.ndenumerate(acceptance):
        if np.isfinite(share):
            color = "black" if np.mean(dark(share)[:3]) > 0.5 else "white"
            text = f"{100 * share:.0f}"
            axes.text(column, row, text, ha="center", va="center", color=color)
        if (lows[row], highs[column]) == tuple(band):
            corner = (column - 0.5, row - 0.5)
            axes.add_patch(Rectangle(corner, 1, 1, fill=False, edgecolor=EDITED, lw=2))
    axes.set_xticks(range(len(highs)), [f"{value:g}" for value in highs])
    axes.set_yticks(range(len(lows)), [f"{value:g}" for value in lows])
    axes.tick_params(length=0)
    figure.colorbar(image, ax=axes, label="acceptance (%)", shrink=0.9)
    return figure


@file_style()
def state_overlay(factual: Float64Array, edited: Float64Array, title: str = "") -> Figure:
    """Factual and edited states in the factual ones' first two principal components (Figures 5, 6).

    Args:
        factual: (M, S) in standard deviations.
    """
    figure, axes = _figure(COLUMN, 2.9, title)
    centre = factual.mean(axis=0)
    _, spread, directions = np.linalg.svd(factual - centre, full_matrices=False)
    variance = 100 * spread**2 / (spread**2).sum()
    for states, name, color, marker, width in (
        (factual, "logged", FACTUAL, "o", 0.0),
        (edited, "edited", EDITED, "x", 0.5),
    ):
        # Drawn as pixels in the SVG too: thousands of points make it slow to open.
        x, y = ((states - centre) @ directions[:2].T).T
        look: dict[str, Any] = {"s": 7, "c": color, "marker": marker, "lw": width}
        axes.scatter(x, y, alpha=0.45, label=name, rasterized=True, **look)
    legend = axes.legend(loc="best", markerscale=2, handletextpad=0.2)
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_alpha(1)
    axes.set_xlabel(f"first component ({variance[0]:.0f}% of the variance)")
    axes.set_ylabel(f"second component ({variance[1]:.0f}%)")
    axes.grid(True)
    return figure


@file_style()
def lambda_curves(rows: Sequence[Row], title: str = "") -> Figure:
    """Normalised score over λ, a line a dataset, mean ± standard deviation over seeds (Figure 2).

    Args:
        rows: lines (`ResultRow.as_line`) that differ in `task`, `lambda_mask` and `training_seed`.
    """
    weight = r"weight of the mask loss $\lambda$"
    figure, axes = _figure(COLUMN, 2.5, title, weight, "normalised score")
    places = sorted({row["lambda_mask"] for row in rows})
    scores = _group_seeds(rows, ("task", "lambda_mask"), "score")
    datasets = sorted({row["task"] for row in rows})
    for dataset, color in colors(datasets).items():
        at = [i for i, value in enumerate(places) if (dataset, value) in scores]
        points = [summary(scores[dataset, places[i]]) for i in at]
        mean, sd = np.array([(point.mean, point.sd) for point in points]).T
        axes.plot(at, mean, "o-", color=color, label=dataset)
        axes.fill_between(at, mean - sd, mean + sd, color=color, alpha=0.2, linewidth=0)
    # Places stand apart evenly: 0 has no place on a logarithmic axis.
    axes.set_xticks(range(len(places)), [f"{value:g}" for value in places])
    axes.grid(True, axis="y")
    _legend_below(figure, axes, 2)
    return figure


@file_style()
def robustness_bars(rows: Sequence[Row], value: str, ylabel: str, title: str = "") -> Figure:
    """Bars of one dataset: methods side by side, a bar a distractor (Figures 3 and 4).

    A bar is the mean over seeds, its line the standard deviation over them.

    Args:
        rows: with `method`, `distractor`, `training_seed` and `value`, in the order to be drawn.
    """
    figure, axes = _figure(PAGE, 2.4, title, ylabel=ylabel)
    values_by_bar = _group_seeds(rows, ("method", "distractor"), value)
    methods = list(dict.fromkeys(row["method"] for row in rows))
    kinds = list(dict.fromkeys(row["distractor"] for row in rows))
    width = 0.84 / len(kinds)
    for number, (kind, color) in enumerate(colors(kinds).items()):
        at = [i for i, method in enumerate(methods) if (method, kind) in values_by_bar]
        values = [summary(values_by_bar[methods[i], kind]) for i in at]
        spread, left = [v.sd for v in values], (number - (len(kinds) - 1) / 2) * width
        axes.bar(
            np.array(at) + left, [v.mean for v in values], 0.92 * width, yerr=spread,
            color=color, label=label(kind), error_kw={"elinewidth": 0.9, "capsize": 1.5},
        )  # fmt: skip
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set_xticks(range(len(methods)), [label(method) for method in methods])
    axes.tick_params(axis="x", length=0)
    axes.grid(True, axis="y")
    _legend_below(figure, axes, len(kinds))
    return figure


@file_style()
def score_panels(rows: Sequence[Row], title: str = "") -> Figure:
    """Normalised scores as bars, a panel a dataset: mean over seeds, with its standard error
    (Tables 1, 3, 9 and 10).

    Args:
        rows: lines (`ResultRow.as_line`) that differ in `task`, `method` and seed, in the order to
            be drawn.
    """
    scores = _group_seeds(rows, ("task", "method"), "score")
    tasks, methods = (list(dict.fromkeys(row[name] for row in rows)) for name in ("task", "method"))
    columns = min(_PANELS, len(tasks))
    lines = -(-len(tasks) // columns)
    figure = Figure(figsize=(PAGE, lines * (1.1 + 0.16 * len(methods))))
    figure.suptitle(title, fontsize=8)
    panels = figure.subplots(lines, columns, sharey=True, squeeze=False).ravel()
    for task, axes in zip(tasks, panels, strict=False):
        at = [i for i, method in enumerate(methods) if (task, method) in scores]
        values = [summary(scores[task, methods[i]]) for i in at]
        bar_colors = [OURS if methods[i] == "ucf" else PLAIN for i in at]
        errors = [value.standard_error for value in values]
        axes.barh(at, [value.mean for value in values], xerr=errors, color=bar_colors, height=0.75)
        axes.set_title(task)
        axes.grid(True, axis="x")
    panels[0].set_yticks(range(len(methods)), [label(method) for method in methods])
    panels[0].invert_yaxis()
    for axes in panels[len(tasks) :]:
        axes.set_visible(False)
    figure.supxlabel("normalised score", fontsize=8)
    return figure


@file_style()
def attention_map(weights: Float64Array, title: str = "") -> Figure:
    """How much the state token of every step of a window attends to every earlier token: (K, 3, K)
    weights by querying step, modality (return-to-go, state, action) and step."""
    figure = Figure(figsize=(PAGE, 2.5))
    figure.suptitle(title, fontsize=8)
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    k, modalities = len(weights), ("returns-to-go", "states", "actions")
    ago = np.arange(k) - (k - 1)
    # A root scale: nearly all attention may lie on a few tokens.
    scale = PowerNorm(0.5, 0, float(weights.max()))
    for number, (axes, name) in enumerate(zip(panels, modalities, strict=True)):
        # What a row cannot see is left white; actions are seen one step late.
        hidden = np.arange(k)[None, :] > np.arange(k)[:, None] - (name == "actions")
        visible = np.where(hidden, np.nan, weights[:, number])
        box = (ago[0] - 0.5, 0.5, 0.5, ago[0] - 0.5)
        image = axes.imshow(visible, norm=scale, extent=box)
        axes.set_title(f"{name}: {100 * weights[-1, number].sum():.0f}% of step 0")
        axes.set_xlabel("step attended to (0 is now)")
    panels[0].set_ylabel("acting step")
    figure.colorbar(image, ax=panels, label="attention", shrink=0.85)
    return figure


def _figure(
    width: float, height: float, title: str, xlabel: str = "", ylabel: str = ""
) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height))
    figure.suptitle(title, fontsize=8)
    axes = figure.subplots()
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    return figure, axes


def _legend_below(figure: Figure, axes: Axes, columns: int) -> None:
    handles, labels = axes.get_legend_handles_labels()
    spacing = {"ncols": columns, "handlelength": 1.4, "columnspacing": 1.2}
    figure.legend(handles, labels, loc="outside lower center", **spacing)


def _group_seeds(rows: Sequence[Row], names: Sequence[str], value: str) -> dict[Any, list[float]]:
    """Values by their rows' `names`; of a seed that comes twice, the last counts."""
    latest: dict[Any, dict[int, float]] = defaultdict(dict)
    for row in rows:
        latest[tuple(row[name] for name in names)][row["training_seed"]] = row[value]
    return {key: list(seeds.values()) for key, seeds in latest.items()}
