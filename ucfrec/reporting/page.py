"""The HTML report on runs: conclusions from their results, and how they were trained."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from ucfrec import __version__
from ucfrec.counterfactual.augmentation import AugmentationReport
from ucfrec.errors import damage_explained
from ucfrec.files.atomic import atomic_file, json_text
from ucfrec.fitting.checkpoint import read_metrics
from ucfrec.logs.summary import format_report
from ucfrec.reporting.model_card import describe_data, tabulate_user_model
from ucfrec.reporting.results import (
    conclude,
    draw_environments,
    draw_estimates,
    draw_forest,
    draw_frontier,
    read_evidence,
)
from ucfrec.reporting.tables import Table
from ucfrec.reporting.training import (
    POINTS,
    REFERENCES,
    Curves,
    draw_curves,
    draw_distributions,
    draw_moves,
    read_features,
    select_curves,
    tabulate_augmentation,
    tabulate_samples,
)
from ucfrec.results.statistics import grouped
from ucfrec.runs.record import RUN, RunRecord, read_augmentation, read_candidates, read_record
from ucfrec.runs.trained_policy import AUGMENTATION

_REMEDY = "restore it or train again"


@dataclass(frozen=True)
class _Run:
    """A run folder as the report reads it."""

    folder: Path
    name: str
    record: RunRecord
    augmentation: AugmentationReport | None
    """None if the run has no augmentation (yet)."""
    logged: Curves

    @property
    def status(self) -> str:
        steps = self.record.config.train.steps
        if self.record.policy is not None:
            return f"finished after {self.record.policy.steps:,} steps"
        logged = max((step for curve in self.logged.values() for step in curve), default=0)
        return f"not finished: logged up to step {logged:,} of {steps:,}"

    @property
    def references(self) -> Mapping[str, float]:
        """Reference losses (nats); none if the run's loss is not the items' log-likelihood."""
        losses = self.record.reference_losses
        return losses if losses and "action_loss" in self.logged else {}


def write_report(
    out: Path, runs: Sequence[Path], results: Sequence[Path] = (), items: Path | None = None
) -> None:
    """Write `render_report` to a file, atomically.

    Raises:
        InputError: `out` is a folder, or as `render_report`.
    """
    page = render_report(runs, results, items)
    with atomic_file(out) as scratch:
        # Folder names may have bytes that are not valid Unicode.
        scratch.write_text(page, encoding="utf-8", errors="backslashreplace")


def render_report(
    runs: Sequence[Path], results: Sequence[Path] = (), items: Path | None = None
) -> str:
    """A self-contained HTML page about `runs`; those on the same data share a section and charts.

    Args:
        results: rows of `ucfrec evaluate --json`, `ucfrec ope --json` or `ucfrec demo`.
        items: item features to show with the sample recommendations, for `read_features`.

    Raises:
        InputError: a folder is not a run, or a file has no such rows or features.
    """
    read = _read_runs(runs)
    by_data = grouped(read, lambda run: run.record.fingerprint)
    environments, estimates = read_evidence(results)
    with damage_explained(Path(", ".join(map(str, results))), "write its rows again"):
        evaluated = {
            "verdict": conclude(environments, estimates),
            "environments": draw_environments(environments),
            "estimates": draw_estimates(estimates),
            "forest": draw_forest(estimates),
        }
    features = None if items is None else read_features(items, [run.record.data for run in read])
    warnings, sections = [], []
    for group in by_data.values():
        for run in group:
            with damage_explained(run.folder / RUN, _REMEDY):
                warnings += [(run.name, text) for text in _warnings(run)]
        with damage_explained(group[0].folder / RUN, _REMEDY):
            sections.append(_section(group, features))
    return template("ucfrec.reporting", "report.html").render(
        version=__version__, warnings=warnings, sections=sections, points=POINTS, **evaluated
    )


@cache
def template(package: str, name: str) -> Template:
    """A template of HTML in a package, which escapes all values."""
    environment = Environment(
        loader=PackageLoader(package, ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def _read_runs(folders: Sequence[Path]) -> list[_Run]:
    runs = []
    paths = dict.fromkeys(folder.resolve() for folder in folders)
    common = os.path.commonpath([path.parent for path in paths]) if paths else ""
    for path in paths:
        record = read_record(path)
        augmentation = record.augmentation
        if augmentation is None and (path / AUGMENTATION).exists():
            augmentation = read_augmentation(path / AUGMENTATION)
        logged = select_curves(read_metrics(path / "policy"), record.settings)
        runs.append(_Run(path, str(path.relative_to(common)), record, augmentation, logged))
    return runs


def _warnings(run: _Run) -> list[str]:
    """Reasons why the results of a run may be unreliable."""
    report = run.augmentation
    warnings = [run.status] if run.record.policy is None else []
    if report is not None:
        warnings += report.warnings
        if not report.moves.edits or report.bound >= report.reward_model.reward_std:
            warnings.append(report.verdict)
    warnings.append(run.record.learned_nothing(run.logged))
    return [text for text in warnings if text]


def _section(runs: Sequence[_Run], features: pa.Table | None) -> dict[str, Any]:
    """Template variables of the section on runs with the same data."""
    names, record = [run.name for run in runs], runs[0].record
    edited, user_models, frontiers, samples = [], [], [], []
    for style, run in enumerate(runs):
        if run.augmentation is not None:
            edited.append((run.name, style, run.augmentation))
        if run.record.sizes["items"]:
            if (table := tabulate_user_model(run.record)) is not None:
                user_models.append((run.name, table))
            if (drawn := draw_frontier(run.record, read_candidates(run.folder))) is not None:
                frontiers.append((run.name, drawn))
            samples.append((run.name, tabulate_samples(run.folder, features)))
    pictures, quantiles = draw_distributions(record.data)
    return {
        "names": names,
        "store": record.store,
        "data": Table.of_columns("Training data", {"value": describe_data(record)}),
        "rows": format_report(record.data.model_dump()) if record.data.rows_read else "",
        "pictures": pictures,
        "quantiles": quantiles,
        "summary": _summarise(runs),
        "curves": draw_curves(names, [r.logged for r in runs], [r.references for r in runs]),
        "unlogged": [run.name for run in runs if not run.logged],
        "finished": any(run.record.policy is not None for run in runs),
        "references": any(run.references for run in runs),
        "verdicts": [(name, report.verdict) for name, _, report in edited],
        "augmentation": tabulate_augmentation(edited) if edited else None,
        "moves": draw_moves(edited),
        "user_models": user_models,
        "frontiers": frontiers,
        "samples": samples,
        "differences": _tabulate_differences(runs),
        "records": [(run.name, json_text(run.record.model_dump(), indent=2)) for run in runs],
    }


def _summarise(runs: Sequence[_Run]) -> Table:
    columns = {}
    for run in runs:
        fit = run.record.policy
        columns[run.name] = {
            "policy": run.record.name,
            "seed": str(run.record.seed),
            "status": run.status,
            "best validation loss": fit and fit.best_validation,
            "at step": fit and fit.best_step,
            "wall time, s": run.record.wall_time_s if fit else None,
        }
        known = {key: name for key, name in REFERENCES.items() if key in run.references}
        columns[run.name] |= {f"loss with {name}": run.references[k] for k, name in known.items()}
    return Table.of_columns("Runs", columns)


def _tabulate_differences(runs: Sequence[_Run]) -> Table | None:
    """Settings and versions that differ between runs; None if there are none."""
    settings = [{**run.record.settings, "version": run.record.versions} for run in runs]
    columns = pd.json_normalize(settings, max_level=1).to_dict("list").items()
    rows = [(str(n), values) for n, values in columns if any(v != values[0] for v in values)]
    return Table("Settings that differ", [run.name for run in runs], rows) if rows else None
