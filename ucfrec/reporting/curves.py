"""Training curves in the report."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ucfrec.reporting import charts
from ucfrec.reporting.tables import Table, shown

Curves = Mapping[str, Mapping[int, float]]
"""{name: {step: value}}, as from `ucfrec.fitting.metrics_log.read_metrics`."""
POINTS = 200
"""Most points of a drawn curve."""
_TITLES = {
    "validation_loss": "Validation loss (action, held-out steps)",
    "action_loss": "Training loss of the action (one batch)",
    "attention_on_parents": "Attention mass on the causal parents (1: all of it)",
    "uniform_on_parents": "Attention mass on the causal parents, were it uniform",
    "mask_loss": "Mask loss of the attention (Eq. 5)",
    "loss": "Training loss, all terms",
    "gradient_norm": "Gradient norm before clipping",
    "samples_per_second": "Samples per second",
    "waiting_for_data": "Share of time waiting for data",
}
"""Logged name to title, in the order of the page; other curves follow."""
_ACTION_LOSSES = ("validation_loss", "action_loss")
_SWITCHES = {"mask_loss": "lambda_mask", "reward_loss": "reward_weight"}
"""Loss to the policy setting that is its weight; with weight 0 it is not trained on."""
REFERENCES = {"uniform": "all items alike", "popularity": "items by popularity"}
"""Key to display name of the reference losses of `ucfrec.runs.start.reference_losses`."""


def trained_on(logged: Curves, config: Mapping[str, Any]) -> Curves:
    """The curves to draw: no loss of weight 0, and no total loss that equals a single term."""
    policy = config["policy"]
    off = {loss for loss, weight in _SWITCHES.items() if policy.get(weight) == 0}
    kept = {name: curve for name, curve in logged.items() if name not in off}
    terms = [curve for name, curve in kept.items() if name != "loss"]
    if kept.get("loss") in terms:
        del kept["loss"]
    return kept


def draw_curves(
    names: Sequence[str], logged: Sequence[Curves], references: Sequence[Mapping[str, float]]
) -> list[tuple[charts.LineChart, Table]]:
    """Chart and table of every scalar that at least one run logged.

    Args:
        names: (R,) names of runs on the same data.
        logged: (R,) curves that each run logged.
        references: (R,) losses (nats) of showing items uniformly and by popularity, by key of
            `REFERENCES`; empty if the loss of the run is not comparable.
    """
    scalars = {name for curves in logged for name in curves}
    drawn = []
    for name in sorted(scalars, key=lambda n: ([*_TITLES, n].index(n), n)):
        curves = {style: _thinned(run[name]) for style, run in enumerate(logged) if name in run}
        curves = {style: curve for style, curve in curves.items() if curve}
        if not curves:
            continue
        title, columns = _TITLES.get(name, name), [names[style] for style in curves]
        lines = [(names[style], style, curve) for style, curve in curves.items()]
        levels = _levels([references[style] for style in curves]) if name in _ACTION_LOSSES else {}
        steps = sorted({step for curve in curves.values() for step in curve})
        rows = [(f"{s:g}", [shown(c.get(s)) for c in curves.values()]) for s in steps]
        chart = charts.line_chart(title, "step", lines, levels)
        drawn.append((chart, Table(title, "step", columns, rows)))
    return drawn


def _levels(references: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The reference losses, by display name; none if they differ between the runs of a chart."""
    first = references[0]
    if any(other != first for other in references):
        return {}
    return {name: first[key] for key, name in REFERENCES.items() if key in first}


def _thinned(curve: Mapping[int, float]) -> dict[float, float]:
    """The finite points; at most `POINTS` of them, evenly spaced and including the last."""
    points = [(float(at), value) for at, value in sorted(curve.items()) if math.isfinite(value)]
    every = -(-len(points) // POINTS) or 1
    return dict(points[::-1][::every][::-1])
