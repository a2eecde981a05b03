"""What the report shows of a training: curves, augmentation and samples."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.counterfactual.augmentation import AugmentationReport
from ucfrec.errors import damage_explained
from ucfrec.files.atomic import read_json
from ucfrec.reporting.items import Features, describe_features
from ucfrec.reporting.tables import Table
from ucfrec.results.charts import Chart, line_chart
from ucfrec.runs.run import SAMPLES
from ucfrec.runs.trained_policy import ITEMS

Curves = Mapping[str, Mapping[int, float]]
"""{name: {step: value}}, as from `ucfrec.fitting.checkpoint.read_metrics`."""
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
_LOSS_WEIGHTS = {"mask_loss": "lambda_mask", "reward_loss": "reward_weight"}
"""Loss to the policy setting that is its weight; with weight 0 it is not trained on."""


def select_curves(logged: Curves, config: Mapping[str, Any]) -> Curves:
    """The curves to draw: no loss of weight 0, and no total loss that equals a single term."""
    weights = config["policy"]
    curves = {n: curve for n, curve in logged.items() if weights.get(_LOSS_WEIGHTS.get(n)) != 0}
    total = curves.pop("loss", {})
    return {**curves, "loss": total} if total and total not in curves.values() else curves


def draw_curves(names: Sequence[str], logged: Sequence[Curves]) -> list[tuple[Chart, Table]]:
    """Chart and table of every scalar that at least one of R runs on the same data logged."""
    scalars = {name for curves in logged for name in curves}
    pictures = []
    for name in dict.fromkeys((*_TITLES, *sorted(scalars))):
        lines = [
            (names[style], style, curve)
            for style, run in enumerate(logged)
            if (curve := _thin_curve(run.get(name, {})))
        ]
        if not lines:
            continue
        title = _TITLES.get(name, name)
        steps = sorted({step for _, _, curve in lines for step in curve})
        rows = [(f"{step:g}", [curve.get(step) for _, _, curve in lines]) for step in steps]
        table = Table(title, [run for run, _, _ in lines], rows, "step")
        pictures.append((line_chart(title, "step", lines), table))
    return pictures


def _thin_curve(curve: Mapping[int, float]) -> dict[float, float]:
    """The finite points; at most `POINTS` of them, evenly spaced and including the last."""
    points = [(float(at), value) for at, value in sorted(curve.items()) if math.isfinite(value)]
    every = -(-len(points) // POINTS) or 1
    return dict(points[::-1][::every][::-1])


def tabulate_augmentation(reports: Mapping[str, AugmentationReport]) -> Table:
    """Quality of the reward model and of the edits, one column per run by name."""
    columns = {
        name: pd.json_normalize(asdict(report)).select_dtypes("number").loc[0].to_dict()
        for name, report in reports.items()
    }
    return Table.of_columns("Reward model and augmented episodes, on held-out steps", columns)


def tabulate_samples(run: Path, items: Features) -> tuple[str, list[Table]] | None:
    """The decision rule of the samples and one table per session, with features of the items; None
    if a run has no samples."""
    if not (run / SAMPLES).exists() or not (run / ITEMS).exists():
        return None
    samples, ids = read_json(run / SAMPLES), pq.read_table(run / ITEMS)[schema.ITEM_ID]
    tables = []
    with damage_explained(run / SAMPLES, "restore it or train again"):
        for number, session in enumerate(samples["sessions"], start=1):
            history = zip(session["history"], session["rewards"], strict=True)
            lines = [("shown before", item, reward) for item, reward in history]
            lines.append(("shown next in the log", session["logged"], None))
            for rank, item in enumerate(session["recommended"], start=1):
                again = " (shown before)" if item in session["history"] else ""
                lines.append((f"recommended {rank}{again}", item, None))
            body = [
                (name, [item_id, describe_features(items.get(item_id, {})), reward])
                for name, item, reward in lines
                for item_id in [str(ids[item])]
            ]
            columns = [schema.ITEM_ID, "features", "reward"]
            tables.append(Table(f"Held-out session {number}", columns, body))
    return str(samples["rule"]), tables
