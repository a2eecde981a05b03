"""Training curves, as the report shows them."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ucfrec.reporting import charts
from ucfrec.reporting.tables import Table, shown

Curves = Mapping[str, Mapping[int, float]]
"""{name: {step: value}}, as `ucfrec.fitting.metrics_log.read_metrics` gives them."""
POINTS = 200
"""Most points a curve is drawn from."""
_TITLES = {
    "validation_loss": "Validation loss (action, held-out steps)",
    "action_loss": "Training loss of the action (one batch)",
    "attention_on_parents": "Attention mass on the causal parents (1: all of it)",
    "mask_loss": "Mask loss of the attention (Eq. 5)",
    "loss": "Training loss, all terms",
    "gradient_norm": "Gradient norm before clipping",
    "samples_per_second": "Samples a second",
    "waiting_for_data": "Share of time waiting for data",
}
"""Curves by the name they are logged under, in the order of the page; others come after."""
_ACTION_LOSSES = ("validation_loss", "action_loss")
_SWITCHES = {"mask_loss": "lambda_mask", "reward_loss": "reward_weight"}
"""Losses that a setting of the policy weights: with weight 0 they are not trained on."""
REFERENCES = {"uniform": "all items alike", "popularity": "items by popularity"}
"""What the reference losses of `ucfrec.runs.reference_losses` are called."""


def trained_on(logged: Curves, config: Mapping[str, Any]) -> Curves:
    """The curves worth drawing: no loss whose weight is 0, no sum that is only one of its terms."""
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
    """Every scalar that some run logged: its curves overlaid, and the same numbers as a table.

    Args:
        names: of R runs on the same data.
        logged: R times what a run logged.
        references: R times the losses of a recommender that shows all items alike and of one that
            shows them by popularity; empty where the loss is another.
    """
    found = {name for curves in logged for name in curves}
    drawn = []
    for name in sorted(found, key=lambda n: ([*_TITLES, n].index(n), n)):
        curves = {style: _thinned(one[name]) for style, one in enumerate(logged) if name in one}
        curves = {style: curve for style, curve in curves.items() if curve}
        if not curves:
            continue
        title, owners = _TITLES.get(name, name), [names[style] for style in curves]
        lines = [(names[style], style, curve) for style, curve in curves.items()]
        levels = _levels([references[style] for style in curves]) if name in _ACTION_LOSSES else {}
        steps = sorted({step for curve in curves.values() for step in curve})
        rows = [(f"{s:g}", [shown(c.get(s)) for c in curves.values()]) for s in steps]
        chart = charts.line_chart(title, "step", lines, levels)
        drawn.append((chart, Table(title, "step", owners, rows)))
    return drawn


def _levels(references: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The reference losses that all the runs of a chart share."""
    first = references[0]
    if any(other != first for other in references):
        return {}
    return {name: first[key] for key, name in REFERENCES.items() if key in first}


def _thinned(curve: Mapping[int, float]) -> dict[float, float]:
    """The finite points, or evenly chosen ones and the last if there are more than `POINTS`."""
    points = [(float(at), value) for at, value in sorted(curve.items()) if math.isfinite(value)]
    every = -(-len(points) // POINTS) or 1
    return dict(points[::-1][::every][::-1])
