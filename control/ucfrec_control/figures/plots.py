"""Draw rows and arrays: every public function returns one matplotlib Figure."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ucfrec.reporting.plot_style import COLUMN, EDITED, FACTUAL, PAGE, colors, label, styled
from ucfrec.reporting.statistics import summary

FloatArray = npt.NDArray[np.float64]
Row = Mapping[str, Any]


@styled
def move_histogram(
    edges: Sequence[float], counts: Sequence[int], band: tuple[float, float], title: str = ""
) -> Figure:
    """Histogram of the move lengths of accepted edits, with the band (Figures 5 and 6, left).

    Args:
        edges: (B + 1,) edges of the bins, in standard deviations.
        counts: (B,) number of accepted edits in each bin.
        band: (ρ_low, ρ_high) in standard deviations.
        title: title of the figure.

    Returns:
        The figure.
    """
    figure, axes = _figure(COLUMN, 2.1, title)
    shares = 100 * np.asarray(counts) / max(1, sum(counts))
    axes.bar(edges[:-1], shares, np.diff(edges), align="edge", color=FACTUAL, edgecolor="white")
    for bound, name in zip(band, (r"$\rho_\mathrm{low}$", r"$\rho_\mathrm{high}$"), strict=True):
        axes.axvline(bound, color="black", linestyle="--", linewidth=0.9)
        axes.annotate(
            name, (bound, 1), (2, -2), xycoords=("data", "axes fraction"), va="top",
            textcoords="offset points",
        )  # fmt: skip
    axes.set_xlim(0, 1.12 * max(edges[-1], band[1]))
    axes.set_ylim(0, 1.18 * max(shares.max(), 1e-9))
    axes.set_xlabel(r"length of the move $\|\Delta\|_2$ (standard deviations)")
    axes.set_ylabel("accepted edits (%)")
    return figure


@styled
def acceptance_heatmap(
    lows: Sequence[float],
    highs: Sequence[float],
    acceptance: FloatArray,
    band: tuple[float, float],
    title: str = "",
) -> Figure:
    """Share of accepted proposals for each band; the band of the run is outlined (Figures 5, 6).

    Args:
        lows: (L,) values of ρ_low, in standard deviations.
        highs: (H,) values of ρ_high, in standard deviations.
        acceptance: (L, H) shares from 0 to 1; NaN where ρ_low is not below ρ_high.
        band: (ρ_low, ρ_high) of the run, in standard deviations.
        title: title of the figure.

    Returns:
        The figure.
    """
    figure, axes = _figure(COLUMN, 2.6, title)
    image = axes.imshow(100 * acceptance, vmin=0, vmax=100, origin="lower", aspect="auto")
    axes.spines[["left", "bottom"]].set_visible(False)
    dark = colormaps[image.get_cmap().name]
    for (row, column), share in np.ndenumerate(acceptance):
        if np.isfinite(share):
            bright = np.mean(dark(share)[:3]) > 0.5
            axes.text(
                column, row, f"{100 * share:.0f}", ha="center", va="center",
                color="black" if bright else "white",
            )  # fmt: skip
        if (lows[row], highs[column]) == tuple(band):
            axes.add_patch(
                Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, edgecolor=EDITED, lw=2)
            )
    axes.set_xticks(range(len(highs)), [f"{value:g}" for value in highs])
    axes.set_yticks(range(len(lows)), [f"{value:g}" for value in lows])
    axes.tick_params(length=0)
    axes.set_xlabel(r"$\rho_\mathrm{high}$ (standard deviations)")
    axes.set_ylabel(r"$\rho_\mathrm{low}$ (standard deviations)")
    figure.colorbar(image, ax=axes, label="acceptance (%)", shrink=0.9)
    return figure


@styled
def state_overlay(factual: FloatArray, edited: FloatArray, title: str = "") -> Figure:
    """Scatter plot of factual and edited states (Figures 5 and 6).

    The axes are the first two principal components of the factual states.

    Args:
        factual: (M, S) logged states, in standard deviations.
        edited: (M, S) the same states after their edits, in standard deviations.
        title: title of the figure.

    Returns:
        The figure.
    """
    figure, axes = _figure(COLUMN, 2.9, title)
    centre = factual.mean(axis=0)
    _, spread, directions = np.linalg.svd(factual - centre, full_matrices=False)
    explained = 100 * spread**2 / (spread**2).sum()
    for states, name, color, marker in (
        (factual, "logged", FACTUAL, "o"),
        (edited, "edited", EDITED, "x"),
    ):
        # Points are rasterised in the SVG too: thousands of vector markers are slow to open.
        x, y = ((states - centre) @ directions[:2].T).T
        width = 0.5 if marker == "x" else 0
        axes.scatter(
            x, y, s=7, c=color, marker=marker, lw=width, alpha=0.45, label=name, rasterized=True
        )
    legend = axes.legend(loc="best", markerscale=2, handletextpad=0.2)
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_alpha(1)
    axes.set_xlabel(f"first component ({explained[0]:.0f}% of the variance)")
    axes.set_ylabel(f"second component ({explained[1]:.0f}%)")
    axes.grid(True)
    return figure


@styled
def lambda_curves(rows: Sequence[Row], title: str = "") -> Figure:
    """Normalised score against λ, with one line per dataset (Figure 2).

    A line is the mean over seeds, and its band is ± one standard deviation.

    Args:
        rows: lines (`ResultRow.as_line`) with `task`, `lambda_mask`, `training_seed` and `score`.
        title: title of the figure.

    Returns:
        The figure.
    """
    figure, axes = _figure(COLUMN, 2.5, title)
    weights = sorted({row["lambda_mask"] for row in rows})
    scores = _by_seed(rows, ("task", "lambda_mask"), "score")
    datasets = sorted({row["task"] for row in rows})
    for dataset, color in colors(datasets).items():
        positions = [i for i, value in enumerate(weights) if (dataset, value) in scores]
        summaries = [summary(scores[dataset, weights[i]]) for i in positions]
        mean, sd = (np.array([getattr(each, name) for each in found]) for name in ("mean", "sd"))
        axes.plot(positions, mean, "o-", color=color, label=dataset)
        axes.fill_between(positions, mean - sd, mean + sd, color=color, alpha=0.2, linewidth=0)
    # Weights are evenly spaced, because a logarithmic axis cannot show 0.
    axes.set_xticks(range(len(weights)), [f"{value:g}" for value in weights])
    axes.set_xlabel(r"weight of the mask loss $\lambda$")
    axes.set_ylabel("normalised score")
    axes.grid(True, axis="y")
    _legend_below(figure, axes, 2)
    return figure


@styled
def return_curves(rows: Sequence[Row], title: str = "") -> Figure:
    """Return earned against target return, with one line per method.

    A line is the mean over seeds, and its band runs from the lowest to the highest seed. On the
    dashed diagonal, the return earned equals the target.

    Args:
        rows: lines (`ResultRow.as_line`) with `method`, `target_return`, `training_seed` and
            `return`.
        title: title of the figure.

    Returns:
        The figure.
    """
    figure, axes = _figure(COLUMN, 2.5, title)
    earned = _by_seed(rows, ("method", "target_return"), "return")
    for method, color in colors(sorted({row["method"] for row in rows})).items():
        method_targets = sorted(target for other, target in earned if other == method)
        returns = [earned[method, target] for target in method_targets]
        means = [summary(values).mean for values in returns]
        axes.plot(method_targets, means, "o-", color=color, label=label(method))
        axes.fill_between(
            method_targets,
            list(map(min, returns)),
            list(map(max, returns)),
            color=color,
            alpha=0.2,
            lw=0,
        )
    targets, top = [row["target_return"] for row in rows], axes.get_ylim()[1]
    axes.plot([0, max(targets)], [0, max(targets)], "--", color="black", linewidth=0.9)
    axes.set_xlim(0, 1.03 * max(targets))
    axes.set_ylim(0, 1.1 * top)
    axes.set_xlabel("target return")
    axes.set_ylabel("return earned")
    axes.grid(True)
    _legend_below(figure, axes, 4)
    return figure


@styled
def robustness_bars(rows: Sequence[Row], value: str, ylabel: str, title: str = "") -> Figure:
    """Bar chart of one dataset: a group per method, a bar per distractor (Figures 3 and 4).

    A bar is the mean over seeds, and its error bar is ± one standard deviation.

    Args:
        rows: with `method`, `distractor`, `training_seed` and the key named by `value`; methods and
            distractors are drawn in order of appearance.
        value: the key of the quantity to draw.
        ylabel: label of the vertical axis, with the unit.
        title: title of the figure.

    Returns:
        The figure.
    """
    figure, axes = _figure(PAGE, 2.4, title)
    samples = _by_seed(rows, ("method", "distractor"), value)
    methods = list(dict.fromkeys(row["method"] for row in rows))
    kinds = list(dict.fromkeys(row["distractor"] for row in rows))
    width = 0.84 / len(kinds)
    for number, (kind, color) in enumerate(colors(kinds).items()):
        positions = [i for i, method in enumerate(methods) if (method, kind) in samples]
        values = [summary(samples[methods[i], kind]) for i in positions]
        spread, left = [v.sd for v in values], (number - (len(kinds) - 1) / 2) * width
        axes.bar(
            np.array(positions) + left, [v.mean for v in values], 0.92 * width, yerr=spread,
            color=color, label=label(kind), error_kw={"elinewidth": 0.9, "capsize": 1.5},
        )  # fmt: skip
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set_xticks(range(len(methods)), [label(method) for method in methods])
    axes.tick_params(axis="x", length=0)
    axes.set_ylabel(ylabel)
    axes.grid(True, axis="y")
    _legend_below(figure, axes, len(kinds))
    return figure


@styled
def training_curves(
    curves: Mapping[str, Sequence[Mapping[int, float]]], ylabel: str, title: str = ""
) -> Figure:
    """A logged value against training steps, with one line per method.

    A line is the mean over seeds, and its band runs from the lowest to the highest seed.

    Args:
        curves: for each method, one {step: value} mapping per seed; only steps that all seeds of
            the method have are drawn.
        ylabel: label of the vertical axis.
        title: title of the figure.

    Returns:
        The figure.
    """
    figure, axes = _figure(COLUMN, 2.5, title)
    for method, color in colors(curves).items():
        steps = sorted(set.intersection(*(set(seed) for seed in curves[method])))
        values = np.array([[seed[step] for step in steps] for seed in curves[method]])
        axes.plot(steps, values.mean(axis=0), color=color, label=label(method))
        axes.fill_between(
            steps, values.min(axis=0), values.max(axis=0), color=color, alpha=0.2, linewidth=0
        )
    axes.set_xlim(left=0)
    axes.set_xlabel("training step")
    axes.set_ylabel(ylabel)
    axes.grid(True)
    _legend_below(figure, axes, 4)
    return figure


@styled
def attention_map(weights: FloatArray, title: str = "") -> Figure:
    """Attention from the state token of each step in a window to the tokens that it can see.

    Args:
        weights: (K, 3, K) attention probabilities: querying step; returns-to-go, states or actions;
            step attended to.
        title: title of the figure.

    Returns:
        The figure.
    """
    figure = Figure(figsize=(PAGE, 2.5))
    figure.suptitle(title, fontsize=8)
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    k, modalities = len(weights), ("returns-to-go", "states", "actions")
    ago = np.arange(k) - (k - 1)
    # A square-root colour scale, because a few tokens may receive nearly all attention.
    scale = PowerNorm(0.5, 0, float(weights.max()))
    for number, (axes, name) in enumerate(zip(panels, modalities, strict=True)):
        # Tokens that a step cannot see stay white; a step sees only the actions before it.
        hidden = np.arange(k)[None, :] > np.arange(k)[:, None] - (name == "actions")
        visible = np.where(hidden, np.nan, weights[:, number])
        box = (ago[0] - 0.5, 0.5, 0.5, ago[0] - 0.5)
        image = axes.imshow(visible, norm=scale, extent=box)
        axes.set_title(f"{name}: {100 * weights[-1, number].sum():.0f}% of step 0")
        axes.set_xlabel("step attended to (0 is now)")
    panels[0].set_ylabel("acting step")
    figure.colorbar(image, ax=panels, label="attention", shrink=0.85)
    return figure


def _figure(width: float, height: float, title: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height))
    figure.suptitle(title, fontsize=8)
    return figure, figure.subplots()


def _legend_below(figure: Figure, axes: Axes, columns: int) -> None:
    figure.legend(
        *axes.get_legend_handles_labels(), loc="outside lower center", ncols=columns,
        handlelength=1.4, columnspacing=1.2,
    )  # fmt: skip


def _by_seed(rows: Sequence[Row], names: Sequence[str], value: str) -> dict[Any, list[float]]:
    """Collect `value` over seeds for each key `names`; the last row of a repeated seed counts."""
    latest: dict[Any, dict[int, float]] = defaultdict(dict)
    for row in rows:
        latest[tuple(row[name] for name in names)][row["training_seed"]] = row[value]
    return {key: list(seeds.values()) for key, seeds in latest.items()}
