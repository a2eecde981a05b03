"""Versions of ucfrec with one guard less, by the check and the part of it that must find each: the
name of a function or class of ucfrec and what replaces it."""

import json
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import patch

import h5py
import pyarrow.parquet as pq

_JOBS = ("collect", "prepare", "train", "update", "tune", "join", "recommend", "score", "ope")
_JOBS += ("evaluate", "report", "serve", "promote")
Mutant = tuple[str, Any]


@contextmanager
def applied(mutant: Mutant | None) -> Iterator[None]:
    """Forks of this process run the mutant."""
    with patch(f"ucfrec{mutant[0]}", mutant[1]) if mutant else nullcontext():
        yield


class UnexplainedError(Exception):
    """Raised where an `InputError` should explain."""


@contextmanager
def _claim_nothing(path: Path, wait: bool = False) -> Iterator[bool]:
    path.parent.mkdir(parents=True, exist_ok=True)
    yield True


def _read_rule(path: Path) -> Any:
    from ucfrec.acting.decision import DecisionRule

    return DecisionRule(**json.loads(path.read_text()))


def _make_row(text: str, _: str) -> Any:
    from ucfrec.results.rows import ResultRow

    return ResultRow(**json.loads(text))


def _explain_nothing(module: str) -> Mutant:
    return f".{module}.InputError", UnexplainedError


def _read_column(path: Path, column: str) -> Any:
    return pq.read_table(path, columns=[column]).column(column).to_numpy()


_RECORD = ".files.record._first_fault", lambda error, *_: error
_STATES = ".episodes.states.damage_explained", lambda *_: nullcontext()
_WEIGHTS = (
    ".fitting.checkpoint.load_weights",
    lambda _, to, *of, **how: to.load_state_dict(*of, **how),
)
_TEXT = ".files.atomic._parse", lambda path, _, __, parse: parse(path.read_text())
_ROW, _IDS = (".results.rows.row_from_json", _make_row), (".files.parquet.read_ids", _read_column)
_COLUMN, _LOG = _explain_nothing("episodes.view"), _explain_nothing("logs.tables")
_UNCHECKED = ".files.record.Record.require", lambda *_, **__: None
_EXPLAINED = ".commands.cli.explanation", lambda _: None
_READERS: dict[str, Mutant] = {
    "meta.json": _RECORD,
    "item_states.safetensors": _STATES,
    "users.parquet": _IDS,
    "items.parquet": _IDS,
    "shard-00000/reward.npy": _COLUMN,
    "shard-00000/offsets.npy": _COLUMN,
    "run: run.json": _RECORD,
    "run: decision_rule.json": (".runs.trained_policy.read_rule", _read_rule),
    "run: policy/best.safetensors": _WEIGHTS,
    "run: items.parquet": (".runs.trained_policy.read_ids", _read_column),
    "run: reward_model/item_reward.safetensors": _WEIGHTS,
    "run: item_states.safetensors": _STATES,
    "run: training_counts.safetensors": _STATES,
    "run: training_returns.safetensors": _explain_nothing("fitting.checkpoint"),
    "report: run.json": _RECORD,
    "report: samples.json": (
        ".reporting.training.read_json",
        lambda path: json.loads(path.read_text()),
    ),
    "last.safetensors alone": _explain_nothing("fitting.checkpoint"),
    "metrics.jsonl alone": _explain_nothing("fitting.checkpoint"),
    "items.parquet alone": _explain_nothing("files.parquet"),
    "rows.jsonl alone": _ROW,
    "evaluations.json alone": _ROW,
    "report: evaluations": _ROW,
    "mapping.toml alone": _TEXT,
    "config.toml alone": _TEXT,
    "setting.txt alone": _explain_nothing("runs.config"),
    "log.csv alone": _LOG,
    "log.parquet alone": _LOG,
    "hopper.hdf5 alone": ("_control.data.d4rl.open_hdf5", h5py.File),
}
MUTANTS: dict[tuple[str, str], Mutant] = {
    **{("kills", job): (".files.atomic._clear_scratch", lambda path: path) for job in _JOBS},
    ("interruptions", "collect"): (".files.atomic._remove", lambda _: None),
    ("pairs", "prepare"): (".files.atomic.claim", _claim_nothing),
    ("flips", "store"): _UNCHECKED,
    ("flips", "run"): _UNCHECKED,
    **{("fuzz", reader): mutant for reader, mutant in _READERS.items()},
    **{("limits", job): _EXPLAINED for job in _JOBS},
    ("hostile Parquet", "prepare"): _EXPLAINED,
}
"""Mutant by check and part."""
