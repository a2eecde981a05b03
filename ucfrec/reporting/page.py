"""The HTML report on runs: conclusions from their results, and how they were trained."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from ucfrec import __version__
from ucfrec.counterfactual.augmentation import AugmentationReport
from ucfrec.errors import damage_explained
from ucfrec.files.atomic import atomic_file, json_text
from ucfrec.files.record import CARD
from ucfrec.fitting.checkpoint import read_metrics
from ucfrec.logs.summary import format_report
from ucfrec.reporting.items import Features, features_by_id, read_features
from ucfrec.reporting.model_card import describe_data, describe_user_model
from ucfrec.reporting.results import conclude_update, read_findings
from ucfrec.reporting.tables import Table
from ucfrec.reporting.training import (
    POINTS,
    Curves,
    draw_curves,
    select_curves,
    tabulate_augmentation,
    tabulate_samples,
)
from ucfrec.results.statistics import grouped
from ucfrec.runs.record import RUN, RunRecord, read_augmentation, read_record
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


def write_report(
    out: Path, runs: Sequence[Path], results: Sequence[Path] = (), items: Path | None = None
) -> None:
    """Write `render_report` to a file, atomically. InputError if `out` is a folder, or as of
    `render_report`."""
    page = render_report(runs, results, items)
    with atomic_file(out) as scratch:
        # Folder names may have bytes that are not valid Unicode.
        scratch.write_text(page, encoding="utf-8", errors="backslashreplace")


def render_report(
    runs: Sequence[Path], results: Sequence[Path] = (), items: Path | None = None
) -> str:
    """A self-contained HTML page about `runs`; those on the same data share a section and charts.
    InputError if a folder is not a run, or a file has no results or features.

    Args:
        results: files of `--json`, of any command, or of result rows.
        items: item features to show with the sample recommendations, for `read_features`.
    """
    loaded = _read_runs(runs)
    findings = read_findings(results)
    for run in loaded:
        if (update := run.record.update) and update.verdict:
            findings.append(conclude_update(update.of, update.verdict))
    table = None if items is None else read_features(items, [run.record.data for run in loaded])
    features = features_by_id(table)
    warnings, sections = [], []
    for group in grouped(loaded, lambda run: run.record.fingerprint).values():
        for run in group:
            with damage_explained(run.folder / RUN, _REMEDY):
                warnings += [(run.name, text) for text in _list_warnings(run)]
        with damage_explained(group[0].folder / RUN, _REMEDY):
            sections.append(_fill_section(group, features))
    return template("ucfrec.reporting", "report.html").render(
        version=__version__,
        findings=findings,
        answers=grouped((f for f in findings if f.answer), lambda finding: finding.answer),
        warnings=warnings,
        sections=sections,
        points=POINTS,
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
        record, stage = read_record(path), path / AUGMENTATION
        augmentation = record.augmentation
        if augmentation is None and stage.exists():
            augmentation = read_augmentation(stage)
        logged = select_curves(read_metrics(path / "policy"), record.settings)
        runs.append(_Run(path, str(path.relative_to(common)), record, augmentation, logged))
    return runs


def _list_warnings(run: _Run) -> list[str]:
    """Reasons why the results of a run may be unreliable."""
    report = run.augmentation
    warnings = [run.status] if run.record.policy is None else []
    if report is not None:
        warnings += report.warnings
        if not report.moves.edits or report.bound >= report.reward_model.reward_std:
            warnings.append(report.verdict)
    warnings.append(run.record.learned_nothing(run.logged))
    return [text for text in warnings if text]


def _fill_section(runs: Sequence[_Run], features: Features) -> dict[str, Any]:
    """Template variables of the section on runs with the same data."""
    names = [run.name for run in runs]
    record = runs[0].record
    user_models, samples = [], []
    augmented = {run.name: run.augmentation for run in runs if run.augmentation is not None}
    for run in runs:
        if parts := describe_user_model(run.record):
            table = Table.of_columns("User model, on held-out rows", {"value": parts})
            user_models.append((run.name, table))
        if run.record.sizes["items"]:
            samples.append((run.name, tabulate_samples(run.folder, features)))
    return {
        "runs": runs,
        "store": record.store,
        "data": Table.of_columns("Training data", {"value": describe_data(record)}),
        "rows": format_report(record.data.model_dump()) if record.data.rows_read else "",
        "summary": _summarise(runs),
        "curves": draw_curves(names, [run.logged for run in runs]),
        "augmentation": tabulate_augmentation(augmented) if augmented else None,
        "user_models": user_models,
        "samples": samples,
        "differences": _tabulate_differences(runs),
        "records": [(run.name, json_text(run.record.model_dump(), indent=2)) for run in runs],
        "cards": [
            (run.name, card.read_text("utf-8", errors="backslashreplace"))
            for run in runs
            if (card := run.folder / CARD).exists()
        ],
    }


def _summarise(runs: Sequence[_Run]) -> Table:
    columns = {}
    for run in runs:
        fit = run.record.policy
        losses = run.record.reference_losses or {}
        columns[run.name] = {
            "policy": run.record.name,
            "seed": str(run.record.seed),
            "status": run.status,
            "best validation loss": fit and fit.best_validation,
            "at step": fit and fit.best_step,
            "wall time, s": fit and run.record.wall_time_s,
            # Comparable where the loss is the log-likelihood of items.
            **{f"loss by {n}": loss for n, loss in losses.items() if "action_loss" in run.logged},
        }
    return Table.of_columns("Runs", columns)


def _tabulate_differences(runs: Sequence[_Run]) -> Table | None:
    """Settings and versions that differ between runs; None if there are none."""
    settings = [{**run.record.settings, "version": run.record.versions} for run in runs]
    columns = pd.json_normalize(settings, max_level=1).to_dict("list").items()
    rows = [(str(n), values) for n, values in columns if any(v != values[0] for v in values)]
    return Table("Settings that differ", [run.name for run in runs], rows) if rows else None
