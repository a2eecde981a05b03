"""Table and chart of the reward model and augmented episodes in the report."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from ucfrec.counterfactual.state_augmentation import AugmentationReport
from ucfrec.reporting import charts
from ucfrec.reporting.tables import Table, shown


def augmentation_table(runs: Sequence[tuple[str, int, AugmentationReport]]) -> Table:
    """Quality of the reward model and of the edits, one column per run (name, style, report)."""
    reports = [report for _, _, report in runs]
    models, moves = [r.reward_model for r in reports], [r.moves for r in reports]
    actions = [r.actions for r in reports]
    rows: list[tuple[str, list[Any]]] = [
        ("R² of the reward model, from state and action", [m.r2_without_z for m in models]),
        ("R² with the abduced z, which has seen the reward", [m.r2 for m in models]),
        ("standard deviation of the reward", [m.reward_std for m in models]),
        ("active latent dimensions",
         [f"{m.active_dimensions} of {m.latent_dim}" for m in models]),
        ("share of z in the reward's variance", [m.z_share for m in models]),
        ("leak: correlation of z with E[r | s, a]", [m.z_leak for m in models]),
        ("augmented episodes", [r.copies for r in reports]),
        ("accepted edits", [m.edits for m in moves]),
        ("acceptance (share of proposals)", [r.acceptance for r in reports]),
        ("δ, error of the reward model", [r.delta for r in reports]),
        ("ε_r, tolerance of the gate", [r.epsilon_r for r in reports]),
        ("bound δ + ε_r", [r.bound for r in reports]),
        ("mean-move ratio (1: one shift for all states)", [m.mean_move_ratio for m in moves]),
        ("effective rank of the moves",
         [f"{shown(m.effective_rank)} of {m.dimensions}" for m in moves]),
        ("median length of a move ‖Δ‖₂", [m.length_quantiles.get("0.5") for m in moves]),
    ]  # fmt: skip
    if any(actions):
        rows += [
            ("other actions proposed", [a and a.proposals for a in actions]),
            ("copies with another action", [a and a.copies for a in actions]),
            ("mean change of their reward", [a and a.mean_change for a in actions]),
            ("share of them with a higher reward", [a and a.earns_more for a in actions]),
        ]
    body = [(name, [shown(value) for value in values]) for name, values in rows]
    caption = (
        "Reward model and augmented episodes, on held-out steps; δ, ε_r in units of the reward"
    )
    return Table(caption, "", [name for name, _, _ in runs], body)


def moves_chart(runs: Sequence[tuple[str, int, AugmentationReport]]) -> charts.LineChart | None:
    """Distribution of the edit length ‖Δ‖₂ in runs (name, style, report); None without any edit."""
    curves = []
    for name, style, report in runs:
        moves = report.moves
        if not moves.edits:
            continue
        centers = [(a + b) / 2 for a, b in pairwise(moves.histogram_edges)]
        shares = [count / moves.edits for count in moves.histogram_counts]
        curves.append((name, style, dict(zip(centers, shares, strict=True))))
    title = "Accepted edits by the length of their move"
    return charts.line_chart(title, "‖Δ‖₂", curves) if curves else None
