"""One HTML page about runs: what was trained on which data, how it went, what can be trusted."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from ucfrec import __version__
from ucfrec.errors import InputError
from ucfrec.files import atomic_file, read_json
from ucfrec.fitting.metrics_log import read_metrics
from ucfrec.reporting import charts
from ucfrec.reporting.page_results import read_results, worlds
from ucfrec.reporting.tables import Table, shown
from ucfrec.runs.trained_policy import AUGMENTATION, learner_of, read_record

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
_POINTS = 200
"""Most points a curve is drawn from."""


@dataclass(frozen=True)
class _Run:
    name: str
    record: Mapping[str, Any]
    copies: Mapping[str, Any] | None
    """The augmentation report; None without edited copies, or before they are made."""
    scalars: Mapping[str, Mapping[int, float]]

    @property
    def status(self) -> str:
        wanted = self.record["config"]["train"]["steps"]
        if fitted := self.record.get("policy"):
            return f"finished after {fitted['steps']:,} steps"
        logged = max((step for curve in self.scalars.values() for step in curve), default=0)
        return f"not finished: logged up to step {logged:,} of {wanted:,}"


def write_report(out: Path, runs: Sequence[Path], results: Sequence[Path] = ()) -> None:
    """Write one self-contained page about `runs` to `out`, atomically.

    Runs on the same data share a section, their curves overlaid. A run that is still in training
    is shown as far as it is.

    Args:
        results: rows of `ucfrec evaluate --json` or of `ucfrec demo`; JSON, or JSON lines if the
            name ends in `.jsonl`.

    Raises:
        InputError: a folder is no run, a file holds no such rows, or `out` is a folder.
    """
    if out.is_dir():
        raise InputError(f"{out} is a folder; name a file with --out, e.g. {out / 'report.html'}")
    of_data: dict[str, list[_Run]] = {}
    for run in _read_runs(runs):
        of_data.setdefault(run.record["fingerprint"], []).append(run)
    loader = PackageLoader("ucfrec.reporting", "")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    page = environment.get_template("report.html").render(
        version=__version__,
        warnings=[
            (run.name, text) for of in of_data.values() for run in of for text in _doubts(run)
        ],
        sections=[_section(of) for of in of_data.values()],
        worlds=worlds([row for path in results for row in read_results(path)]),
        layout=charts,
        points=_POINTS,
    )
    with atomic_file(out) as scratch:
        # Folder names need not be Unicode.
        scratch.write_text(page, encoding="utf-8", errors="backslashreplace")


def _read_runs(folders: Sequence[Path]) -> list[_Run]:
    runs = []
    paths = list(dict.fromkeys(folder.resolve() for folder in folders))
    for path in paths:
        record = read_record(path)
        copies = record.get("augmentation")
        if copies is None and (path / AUGMENTATION).exists():
            copies = read_json(path / AUGMENTATION)
        common = os.path.commonpath([other.parent for other in paths])
        name = str(path.relative_to(common))
        runs.append(_Run(name, record, copies, read_metrics(path / "policy")))
    return runs


def _doubts(run: _Run) -> list[str]:
    """What a reader must know before believing a run."""
    doubts = [] if "policy" in run.record else [run.status]
    if run.copies is not None:
        doubts += run.copies["warnings"]
        meant = run.copies["bound"] < run.copies["reward_model"]["reward_std"]
        if not (meant and run.copies["moves"]["edits"]):
            doubts.append(run.copies["verdict"])
    return doubts


def _section(runs: Sequence[_Run]) -> dict[str, Any]:
    """What the template shows of runs on the same data."""
    edited = [run for run in runs if run.copies is not None]
    return {
        "names": [run.name for run in runs],
        "store": runs[0].record["store"],
        "data": _data(runs[0].record),
        "summary": _summary(runs),
        "curves": _curves(runs),
        "verdicts": [(run.name, run.copies["verdict"]) for run in edited if run.copies],
        "copies": _copies(edited),
        "moves": _moves(runs),
        "differences": _differences(runs),
        "records": [(run.name, json.dumps(run.record, indent=2)) for run in runs],
    }


def _data(record: Mapping[str, Any]) -> Table:
    sizes = record["sizes"]
    rows = {
        "fingerprint": record["fingerprint"][:12],
        "reward": record["reward"],
        "training sessions": record.get("train_episodes"),
        "training steps": record.get("train_steps"),
        "actions": f"{sizes['items']:,} items" if sizes["items"] else f"{sizes['action']} numbers",
        "state dimensions": sizes["state"],
        "mean return of a session": record["mean_return"],
    }
    for level, value in record["return_quantiles"].items():
        rows[f"{float(level):.0%} of returns are at most"] = value
    body = [(name, [shown(value)]) for name, value in rows.items()]
    return Table("Training data", "", ["value"], body)


def _summary(runs: Sequence[_Run]) -> Table:
    fitted = [run.record.get("policy", {}) for run in runs]
    rows: list[tuple[str, list[Any]]] = [
        ("learner", [learner_of(run.record) for run in runs]),
        ("seed", [str(run.record["seed"]) for run in runs]),
        ("status", [run.status for run in runs]),
        ("best validation loss", [fit.get("best_validation") for fit in fitted]),
        ("at step", [fit.get("best_step") for fit in fitted]),
        ("wall time, s", [run.record["wall_time_s"] if fit else None
                          for run, fit in zip(runs, fitted, strict=True)]),
    ]  # fmt: skip
    return _of_runs("Runs", runs, rows)


def _of_runs(caption: str, runs: Sequence[_Run], rows: Sequence[tuple[str, list[Any]]]) -> Table:
    body = [(name, [shown(value) for value in values]) for name, values in rows]
    return Table(caption, "", [run.name for run in runs], body)


def _curves(runs: Sequence[_Run]) -> list[tuple[charts.LineChart, Table]]:
    """Every scalar that some run logged: its curves, and the same numbers as a table."""
    logged = {tag for run in runs for tag in run.scalars}
    drawn = []
    for tag in sorted(logged, key=lambda t: ([*_TITLES, t].index(t), t)):
        curves = {
            style: _thinned(run.scalars[tag])
            for style, run in enumerate(runs)
            if tag in run.scalars
        }
        curves = {style: curve for style, curve in curves.items() if curve}
        if not curves:
            continue
        title, names = _TITLES.get(tag, tag), [runs[style].name for style in curves]
        lines = [(runs[style].name, style, curve) for style, curve in curves.items()]
        steps = sorted({step for curve in curves.values() for step in curve})
        rows = [(f"{s:g}", [shown(c.get(s)) for c in curves.values()]) for s in steps]
        drawn.append((charts.line_chart(title, "step", lines), Table(title, "step", names, rows)))
    return drawn


def _thinned(curve: Mapping[int, float]) -> dict[float, float]:
    """The finite points, or evenly chosen ones and the last if there are more than `_POINTS`."""
    points = [(float(at), value) for at, value in sorted(curve.items()) if math.isfinite(value)]
    every = -(-len(points) // _POINTS) or 1
    return dict(points[::-1][::every][::-1])


def _copies(runs: Sequence[_Run]) -> Table | None:
    if not runs:
        return None
    reports = [run.copies for run in runs if run.copies is not None]
    models, moves = [r["reward_model"] for r in reports], [r["moves"] for r in reports]
    rows = [
        ("edited copies", [r["copies"] for r in reports]),
        ("accepted edits", [m["edits"] for m in moves]),
        ("acceptance (share of proposals)", [r["acceptance"] for r in reports]),
        ("δ, error of the reward model", [r["delta"] for r in reports]),
        ("ε_r, tolerance of the gate", [r["epsilon_r"] for r in reports]),
        ("bound δ + ε_r", [r["bound"] for r in reports]),
        ("standard deviation of the reward", [m["reward_std"] for m in models]),
        ("R² with z", [m["r2"] for m in models]),
        ("R² without z", [m["r2_without_z"] for m in models]),
        ("active latent dimensions",
         [f"{m['active_dimensions']} of {m['latent_dim']}" for m in models]),
        ("share of z in the reward's variance", [m["z_share"] for m in models]),
        ("leak: correlation of z with E[r | s, a]", [m["z_leak"] for m in models]),
        ("mean-move ratio (1: one shift for all states)", [m["mean_move_ratio"] for m in moves]),
        ("effective rank of the moves",
         [f"{shown(m['effective_rank'])} of {m['dimensions']}" for m in moves]),
        ("median length of a move ‖Δ‖₂", [m["length_quantiles"].get("0.5") for m in moves]),
    ]  # fmt: skip
    return _of_runs("What the edited copies rest on; δ, ε_r in units of the reward", runs, rows)


def _moves(runs: Sequence[_Run]) -> charts.LineChart | None:
    """Distribution of ‖Δ‖₂."""
    curves = []
    for style, run in enumerate(runs):
        if run.copies is None or not run.copies["moves"]["edits"]:
            continue
        moves = run.copies["moves"]
        middles = [(a + b) / 2 for a, b in pairwise(moves["histogram_edges"])]
        shares = [count / moves["edits"] for count in moves["histogram_counts"]]
        curves.append((run.name, style, dict(zip(middles, shares, strict=True))))
    title = "Accepted edits by the length of their move"
    return charts.line_chart(title, "‖Δ‖₂", curves) if curves else None


def _differences(runs: Sequence[_Run]) -> Table | None:
    """Settings and versions that are not the same in all runs; None if all are."""
    flat = [
        _flat(run.record["config"]) | _flat({"version": run.record["versions"]}) for run in runs
    ]
    names = dict.fromkeys(name for settings in flat for name in settings)
    rows = [(name, [settings.get(name) for settings in flat]) for name in names]
    rows = [(name, values) for name, values in rows if any(v != values[0] for v in values)]
    return _of_runs("Settings that differ", runs, rows) if rows else None


def _flat(tables: Mapping[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in tables.items():
        inner = {f"{name}.{key}": v for key, v in value.items()} if isinstance(value, dict) else {}
        flat |= inner or {name: value}
    return flat
