"""Versions of ucfrec with one guard less, by the check and the part of it that must find each.

A mutant is the name of a function or class of ucfrec and what replaces it; nothing else changes.
"""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import h5py
import numpy as np

_JOBS = ("collect", "prepare", "train", "update", "tune", "join", "recommend", "score", "ope")
_JOBS += ("evaluate", "report", "serve", "promote")


@dataclass(frozen=True)
class Mutant:
    """A guard, and what is there instead."""

    name: str
    instead: Any


@contextmanager
def applied(mutant: Mutant | None) -> Iterator[None]:
    """Forks of this process run the mutant."""
    with patch(f"ucfrec{mutant.name}", mutant.instead) if mutant else nullcontext():
        yield


class UnexplainedError(Exception):
    """What a guard raises that explains nothing."""


@contextmanager
def _write_in_place(path: Path) -> Iterator[Path]:
    yield path


@contextmanager
def _claim_nothing(path: Path, wait: bool = False) -> Iterator[bool]:
    path.parent.mkdir(parents=True, exist_ok=True)
    yield True


def _skip(*_: object, **__: object) -> None:
    pass


def _explain_nothing(*_: object) -> Any:
    return nullcontext()


def _read_column(path: Path, column: str) -> Any:
    import pyarrow.parquet as pq

    return np.asarray(pq.read_table(path, columns=[column]).column(column))


def _load_weights(_: Path, module: Any, tensors: Any, assign: bool = False) -> None:
    module.load_state_dict(tensors, assign=assign)


def _parse_text(path: Path, _: int, __: str, parse: Callable[[str], Any]) -> Any:
    return parse(path.read_text())


def _read_rule(path: Path) -> Any:
    from ucfrec.acting.decision import DecisionRule

    return DecisionRule(**_read_json(path))


def _read_json(path: Path) -> Any:
    return json.loads(path.read_text())


def _row(text: str, _: str) -> Any:
    from ucfrec.results.rows import ResultRow

    return ResultRow(**json.loads(text))


_RECORD = Mutant(".files.record._first_fault", lambda error, *_: error)
_STATES = Mutant(".episodes.states.damage_explained", _explain_nothing)
_WEIGHTS = Mutant(".fitting.checkpoint.load_weights", _load_weights)
_LOADED = Mutant(".runs.trained_policy.damage_explained", _explain_nothing)
_ROW, _TEXT = (
    Mutant(".results.rows.row_from_json", _row),
    Mutant(".files.atomic._parse", _parse_text),
)
_IDS = Mutant(".files.parquet.read_ids", _read_column)
_COLUMN = Mutant(".episodes.view.InputError", UnexplainedError)
_ERRORS = Mutant(".logs.engine.explain_errors", _explain_nothing)
_EXPLAINED = Mutant(".commands.cli.explanation", _skip)
_READERS = {
    "meta.json": _RECORD,
    "item_states.safetensors": _STATES,
    "users.parquet": _IDS,
    "items.parquet": _IDS,
    "shard-00000/reward.npy": _COLUMN,
    "shard-00000/offsets.npy": _COLUMN,
    "run: run.json": _RECORD,
    "run: decision_rule.json": Mutant(".runs.trained_policy.read_rule", _read_rule),
    "run: policy/best.safetensors": _WEIGHTS,
    "run: items.parquet": Mutant(".runs.trained_policy.read_ids", _read_column),
    "run: reward_model/item_reward.safetensors": _WEIGHTS,
    "run: item_states.safetensors": _STATES,
    "run: training_counts.safetensors": _STATES,
    "run: training_returns.safetensors": _LOADED,
    "report: run.json": _RECORD,
    "report: samples.json": Mutant(".reporting.training.read_json", _read_json),
    "last.safetensors alone": Mutant(".fitting.checkpoint.InputError", UnexplainedError),
    "metrics.jsonl alone": Mutant(".fitting.checkpoint.InputError", UnexplainedError),
    "items.parquet alone": Mutant(".files.parquet.InputError", UnexplainedError),
    "rows.jsonl alone": _ROW,
    "evaluations.json alone": _ROW,
    "report: evaluations": _ROW,
    "mapping.toml alone": _TEXT,
    "config.toml alone": _TEXT,
    "setting.txt alone": Mutant(".runs.config.InputError", UnexplainedError),
    "log.csv alone": Mutant(".logs.tables.InputError", UnexplainedError),
    "log.parquet alone": Mutant(".logs.tables.InputError", UnexplainedError),
    "hopper.hdf5 alone": Mutant("_control.data.d4rl.open_hdf5", h5py.File),
}
_UNCHECKED = Mutant(".files.record.Record.require", _skip)
MUTANTS = {
    **{("kills", job): Mutant(".files.atomic._scratch_moved", _write_in_place) for job in _JOBS},
    ("interruptions", "collect"): Mutant(".files.atomic._remove", _skip),
    ("pairs", "prepare"): Mutant(".files.atomic.claim", _claim_nothing),
    **{("flips", folder): _UNCHECKED for folder in ("store", "run")},
    **{("fuzz", reader): mutant for reader, mutant in _READERS.items()},
    **{("limits", job): _EXPLAINED for job in _JOBS},
    ("hostile Parquet", "prepare"): _EXPLAINED,
}
"""Mutant by check and part."""
