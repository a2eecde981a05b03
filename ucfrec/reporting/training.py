"""What the report shows of a training: quality of the data, curves, augmentation and samples."""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as csv
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.counterfactual.augmentation import AugmentationReport
from ucfrec.episodes.record import Source
from ucfrec.errors import InputError, damage_explained
from ucfrec.files.atomic import read_json, require_file
from ucfrec.reporting.charts import Chart, histogram, line_chart, name_bins
from ucfrec.reporting.tables import Table, format_value
from ucfrec.runs.run import SAMPLES
from ucfrec.runs.trained_policy import ITEMS

Curves = Mapping[str, Mapping[int, float]]
"""{name: {step: value}}, as from `ucfrec.fitting.checkpoint.read_metrics`."""
POINTS: Final = 200
"""Most points of a drawn curve."""
REFERENCES: Final = {"uniform": "all items alike", "popularity": "items by popularity"}
"""Key to display name of the reference losses of `ucfrec.runs.record.RunRecord`."""
_TITLES: Final = {
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
_LOSS_WEIGHTS: Final = {"mask_loss": "lambda_mask", "reward_loss": "reward_weight"}
"""Loss to the policy setting that is its weight; with weight 0 it is not trained on."""
_DISTRIBUTIONS: Final = {
    "session_lengths": ("Sessions by length", "steps of a session"),
    "rewards": ("Steps by reward", "reward"),
    "item_popularity": ("Items by popularity", "steps that show the item"),
}
"""Name of a distribution in the `summary` of `prepare` to its title and x-axis label."""
_MOST_CHARACTERS: Final = 120
"""Most characters of the shown features of an item."""
_LEVELS: Final = ("0", "0.25", "0.5", "0.75", "0.99", "1")


def draw_distributions(source: Source) -> tuple[list[tuple[Chart, Table]], Table | None]:
    """Chart and table of each distribution that `prepare` summarised, and their quantiles."""
    pictures, quantiles = [], []
    for name, (title, x_label) in _DISTRIBUTIONS.items():
        values = source.summary.get(name)
        if values is None:
            continue
        quantiles.append((title, [values.quantiles.get(level) for level in _LEVELS]))
        if total := sum(values.counts):
            bins = name_bins(values.edges, values.values)
            cells = [[count, f"{count / total:.2%}"] for count in values.counts]
            rows = list(zip(bins, cells, strict=True))
            table = Table(title, ["count", "share"], rows, x_label)
            pictures.append((histogram(title, x_label, values.counts, bins), table))
    columns = ["smallest", "25%", "median", "75%", "99%", "largest"]
    return pictures, Table("Quantiles", columns, quantiles) if quantiles else None


def select_curves(logged: Curves, config: Mapping[str, Any]) -> Curves:
    """The curves to draw: no loss of weight 0, and no total loss that equals a single term."""
    policy = config["policy"]
    unused = {loss for loss, weight in _LOSS_WEIGHTS.items() if policy.get(weight) == 0}
    curves = {name: curve for name, curve in logged.items() if name not in unused}
    if curves.get("loss") in [curve for name, curve in curves.items() if name != "loss"]:
        del curves["loss"]
    return curves


def draw_curves(
    names: Sequence[str], logged: Sequence[Curves], references: Sequence[Mapping[str, float]]
) -> list[tuple[Chart, Table]]:
    """Chart and table of every scalar that at least one of R runs on the same data logged.

    Args:
        references: (R,) losses (nats) of showing items uniformly and by popularity, by key of
            `REFERENCES`; empty if the loss of the run is not comparable.
    """
    scalars = {name for curves in logged for name in curves}
    pictures = []
    for name in sorted(scalars, key=lambda n: ([*_TITLES, n].index(n), n)):
        lines = [
            (names[style], style, curve)
            for style, run in enumerate(logged)
            if (curve := _thin_curve(run.get(name, {})))
        ]
        if not lines:
            continue
        title, levels = _TITLES.get(name, name), {}
        if name in ("validation_loss", "action_loss"):
            first, *further = (references[style] for _, style, _ in lines)
            if all(losses == first for losses in further):
                levels = {REFERENCES[key]: first[key] for key in REFERENCES if key in first}
        steps = sorted({step for _, _, curve in lines for step in curve})
        rows = [(f"{step:g}", [curve.get(step) for _, _, curve in lines]) for step in steps]
        table = Table(title, [run for run, _, _ in lines], rows, "step")
        pictures.append((line_chart(title, "step", lines, levels), table))
    return pictures


def _thin_curve(curve: Mapping[int, float]) -> dict[float, float]:
    """The finite points; at most `POINTS` of them, evenly spaced and including the last."""
    points = [(float(at), value) for at, value in sorted(curve.items()) if math.isfinite(value)]
    every = -(-len(points) // POINTS) or 1
    return dict(points[::-1][::every][::-1])


def tabulate_augmentation(runs: Sequence[tuple[str, int, AugmentationReport]]) -> Table:
    """Quality of the reward model and of the edits, one column per run (name, style, report)."""
    columns: dict[str, dict[str, object]] = {}
    for name, _, report in runs:
        model, moves, actions = report.reward_model, report.moves, report.actions
        columns[name] = {
            "R² of the reward model, from state and action": model.r2_without_z,
            "R² with the abduced z, which has seen the reward": model.r2,
            "standard deviation of the reward": model.reward_std,
            "active latent dimensions": f"{model.active_dimensions} of {model.latent_dim}",
            "share of z in the reward's variance": model.z_share,
            "leak: correlation of z with E[r | s, a]": model.z_leak,
            "augmented episodes": report.copies,
            "accepted edits": moves.edits,
            "acceptance (share of proposals)": report.acceptance,
            "δ, error of the reward model": report.delta,
            "ε_r, tolerance of the gate": report.epsilon_r,
            "bound δ + ε_r": report.bound,
            "mean-move ratio (1: one shift for all states)": moves.mean_move_ratio,
            "effective rank of the moves":
                f"{format_value(moves.effective_rank)} of {moves.dimensions}",
            "median length of a move ‖Δ‖₂": moves.length_quantiles.get("0.5"),
        }  # fmt: skip
        if actions:
            columns[name] |= {
                "other actions proposed": actions.proposals,
                "copies with another action": actions.copies,
                "mean change of their reward": actions.mean_change,
                "share of them with a higher reward": actions.earns_more,
            }
    caption = (
        "Reward model and augmented episodes, on held-out steps; δ, ε_r in units of the reward"
    )
    return Table.of_columns(caption, columns)


def draw_moves(runs: Sequence[tuple[str, int, AugmentationReport]]) -> Chart | None:
    """Distribution of the edit length ‖Δ‖₂ in runs (name, style, report); None without any edit."""
    curves = []
    for name, style, report in runs:
        moves = report.moves
        if moves.edits:
            centers = [(low + high) / 2 for low, high in pairwise(moves.histogram_edges)]
            shares = [count / moves.edits for count in moves.histogram_counts]
            curves.append((name, style, dict(zip(centers, shares, strict=True))))
    title = "Accepted edits by the length of their move"
    return line_chart(title, "‖Δ‖₂", curves) if curves else None


def tabulate_samples(run: Path, features: pa.Table | None) -> tuple[str, list[Table]] | None:
    """The decision rule of the samples and one table per session, with features of the items by
    `item_id`; None if a run has no samples."""
    if not (run / SAMPLES).exists() or not (run / ITEMS).exists():
        return None
    samples = read_json(run / SAMPLES)
    with damage_explained(run / SAMPLES, "restore it or train again"):
        sessions = samples["sessions"]
        numbers = {n for s in sessions for n in (*s["history"], s["logged"], *s["recommended"])}
        items = _item_cells(pq.read_table(run / ITEMS), sorted(numbers), features)
        tables = [_tabulate_session(n, session, items) for n, session in enumerate(sessions, 1)]
        return str(samples["rule"]), tables


def read_features(path: Path, logs: Iterable[Source] = (), text_ids: bool = False) -> pa.Table:
    """Read item features with a column `item_id` from CSV (file name `.csv`) or Parquet.

    Args:
        logs: of runs; their own name of the column is accepted in the file, too.
        text_ids: whether ids in CSV stay as they are written.

    Raises:
        InputError: the file cannot be read as that or lacks the column.
    """
    require_file(path, "name another file")
    mapped = (log.mapping.get(schema.ITEM_ID) or schema.ITEM_ID for log in logs)
    names = dict.fromkeys((schema.ITEM_ID, *(name.strip('"') for name in mapped)))
    try:
        texts = dict.fromkeys(names, pa.string()) if text_ids else None
        types = csv.ConvertOptions(column_types=texts)
        text = path.suffix == ".csv"
        table = csv.read_csv(path, convert_options=types) if text else pq.read_table(path)
    except (OSError, pa.ArrowInvalid) as error:
        raise InputError(f"{path} cannot be read as Parquet or CSV: {error}") from None
    column = next((name for name in names if name in table.column_names), None)
    if column is None:
        wanted = " or ".join(map(repr, names))
        raise InputError(f"{path} has no column {wanted}; add one with the item ids")
    return table.rename_columns({column: schema.ITEM_ID})


def _item_cells(
    items: pa.Table, numbers: Sequence[int], features: pa.Table | None
) -> dict[int, dict[str, str]]:
    """Item number to the cells (column: text) of its row in `items` and of its features."""
    rows = items.take(pa.array(numbers, pa.int64())).to_pylist()
    cells = {
        number: {name: str(value) for name, value in row.items()}
        for number, row in zip(numbers, rows, strict=True)
    }
    if features is not None:
        ids = pa.array([row[schema.ITEM_ID] for row in rows])
        try:
            matches = features.filter(pc.is_in(features[schema.ITEM_ID], value_set=ids)).to_pylist()
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError, TypeError):
            matches = []  # the ids are of another type, so none of them can match
        described = {row.pop(schema.ITEM_ID): _describe_item(row) for row in matches}
        for number, row in zip(numbers, rows, strict=True):
            cells[number]["features"] = described.get(row[schema.ITEM_ID], "–")
    return cells


def _describe_item(features: Mapping[str, Any]) -> str:
    """Text of the features that are neither missing nor zero, cut to `_MOST_CHARACTERS`."""
    parts = []
    for name, value in features.items():
        if value:
            values = value if isinstance(value, list) else [value]
            parts.append(f"{name} {', '.join(map(format_value, values))}")
    text = "; ".join(parts) or "–"
    return text if len(text) <= _MOST_CHARACTERS else f"{text[: _MOST_CHARACTERS - 1]}…"


def _tabulate_session(
    number: int, session: Mapping[str, Any], items: Mapping[int, Mapping[str, str]]
) -> Table:
    history = zip(session["history"], session["rewards"], strict=True)
    body = [("shown before", [reward, *items[item].values()]) for item, reward in history]
    body.append(("shown next in the log", [None, *items[session["logged"]].values()]))
    for rank, item in enumerate(session["recommended"], start=1):
        again = " (shown before)" if item in session["history"] else ""
        body.append((f"recommended {rank}{again}", [None, *items[item].values()]))
    columns = ["reward", *items[session["logged"]]]
    return Table(f"Held-out session {number}", columns, body)
