"""Training on a control store, with presets and screening."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from pydantic import TypeAdapter

from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import AugmentedEpisodes
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json, write_json
from ucfrec.fitting.loop import SILENT, Callbacks
from ucfrec.policies.registry import BUILT_IN, policy_names, policy_package
from ucfrec.provenance import versions
from ucfrec.runs.config import Config
from ucfrec.runs.record import RUN, RunRecord, read_record
from ucfrec.runs.run import share_stage, train_run
from ucfrec.runs.start import training_views
from ucfrec_control.data.trajectories import PACKAGES, control_source
from ucfrec_control.environments.scores import find_kind, find_task
from ucfrec_control.training.screening import (
    SCREENING,
    TREATMENT,
    ScreeningReport,
    read_screening,
    screen_store,
)

_POLICIES: Final = ("ucf", "ucf-paper", "dt", "dc", "lsdt", "bc")
"""Built-in policies whose actions may be vectors."""
_SEED: Final = 0
"""Of the screening before any training: which dimensions cause nothing is a question to the log,
and runs of other training seeds shall differ in their training only."""


def control_policies() -> tuple[str, ...]:
    """Names of the policies to train on control stores: built-in ones, then those of plugins."""
    return (*_POLICIES, *(name for name in policy_names() if name not in BUILT_IN))


@dataclass(frozen=True)
class Preset:
    """The combination of all rules that match a run."""

    tables: Mapping[str, Mapping[str, Any]]
    """Configuration by table, as in TOML."""
    targets: tuple[float, ...]
    """Target returns; empty if no rule matches the task."""


def find_preset(task: str, kind: str, policy: str) -> Preset:
    """The preset of a method on one kind of dataset of a task.

    Args:
        task: name of a `ucfrec_control.environments.scores.Task`; "" for none.
        kind: as `ucfrec_control.environments.scores.find_kind` returns it.
        policy: one of `ucfrec.policies.registry.policy_names`.
    """
    run = {"task": task, "kind": kind, "policy": policy}
    tables: dict[str, dict[str, Any]] = {}
    targets: list[float] = []
    text = files("ucfrec_control.training").joinpath("presets.toml").read_text(encoding="utf-8")
    for rule in tomllib.loads(text)["rule"]:
        names = {key: rule.get(key, value) for key, value in run.items()}
        if any(run[k] not in ([n] if isinstance(n, str) else n) for k, n in names.items()):
            continue
        for table, values in rule.get("set", {}).items():
            tables[table] = tables.get(table, {}) | values
        targets = rule.get("targets", targets)
    return Preset(tables, tuple(targets))


def dataset_of(store: EpisodeStore) -> Mapping[str, Any]:
    """The `source` of a control store: dataset, environment and versions.

    Raises:
        InputError: `store` is not a control store.
    """
    source = store.record.source
    if "env_id" not in source.others:
        raise InputError(
            f"{store.path} is not a control store; write one with `ucfrec-control prepare`"
        )
    return control_source(source, store.path)


def preset_of(dataset: Mapping[str, Any], policy: str) -> Preset:
    """The preset of a method on the dataset that `dataset_of` describes."""
    task = find_task(dataset["env_id"] or dataset["dataset"])
    return find_preset(task.name if task else "", find_kind(dataset["dataset"]), policy)


def describe_returns(store: EpisodeStore) -> str:
    """What the logged trajectories returned, which a policy is compared with: two lines of text."""
    dataset, returns = dataset_of(store), np.sort(store.returns)
    task = find_task(dataset["env_id"] or dataset["dataset"])
    parts = {"behaviour": returns, "best quarter": returns[-max(1, len(returns) // 4) :]}
    return "\n".join(
        f"{name:13} mean return {values.mean():.4g} of {len(values):,} logged trajectories"
        + (f", score {task.score(values.mean()):.1f}" if task else "")
        for name, values in parts.items()
    )


def train_control(
    store: EpisodeStore,
    out: Path,
    config: Config,
    *,
    screening: str | None = None,
    shared: Path | None = None,
    callbacks: Callbacks = SILENT,
) -> RunRecord:
    """`ucfrec.runs.run.train_run` on a control store, after screening.

    Args:
        out: run folder; an interrupted run resumes, with the dimensions it started with.
        screening: "drop" to train without the dimensions that have no effect, "copies" to add
            copies of the trajectories that intervene on them; None to train on the store as it is.
        shared: as `train_run` has it, and for screening; a run whose dimensions are dropped has its
            other stages to itself.

    Raises:
        InputError: as `train_run` and `screen_store`; the store is not a control store; the run was
            started with another `screening`; or no dimension would be left.
    """
    dataset_of(store)
    plugin = policy_package(config.policy_name)
    entries: dict[str, Any] = {"versions": versions((*PACKAGES, *([plugin] if plugin else [])))}
    report = None
    if (out / RUN).exists():
        record = read_record(out)
        report, started_with = read_screening(record), record.extra.get(TREATMENT)
        if started_with != screening:
            option = f" --screen {started_with}" if started_with else "out --screen"
            raise InputError(
                f"{out} was started with{option}; name another run folder, or give the same "
                "options to resume"
            )
    if screening is None:
        return train_run(store, out, config, entries, shared=shared, callbacks=callbacks)
    report = report or _screen_once(store, shared)
    if len(report.flagged) == store.state_size:
        raise InputError(
            f"{store.path}: screening found no effect of any of the {store.state_size} state "
            "dimensions; the log has too few steps, or too noisy ones, to decide: train without "
            "--screen"
        )
    entries["extra"] = {TREATMENT: screening, SCREENING: asdict(report)}
    if screening == "drop":
        entries["dropped_observations"] = report.flagged
        selected = store.without_observation_dimensions(report.flagged)
        return train_run(selected, out, config, entries, callbacks=callbacks)
    train = training_views(store)[0]
    more = make_interventions(train, report.flagged, config.seed) if report.flagged else None
    return train_run(store, out, config, entries, more, shared=shared, callbacks=callbacks)


def _screen_once(store: EpisodeStore, shared: Path | None) -> ScreeningReport:
    """Screen a store, once for all runs that share stages."""
    inputs = {"screened": store.record.fingerprint, "steps": store.n_steps, "seed": _SEED}
    with TemporaryDirectory() as scratch:
        file = Path(scratch) / "screening.json"

        def make() -> None:
            write_json(file, asdict(screen_store(store, _SEED)))

        share_stage(shared, inputs, screen_store.__module__, file.parent, (file.name,), make)
        return TypeAdapter(ScreeningReport).validate_python(read_json(file))


def make_interventions(
    view: EpisodeStore, dimensions: Sequence[int], seed: int
) -> AugmentedEpisodes:
    """Two copies of every episode of `view` under do(d ~ marginal), d being `dimensions`: values
    are drawn, jointly, from its steps, for the first copy once an episode, then at every step."""
    rng = np.random.default_rng(seed)
    episodes, steps = view.all_steps()
    states = view.windows(episodes, steps, 1).states[:, 0].numpy()
    once, _ = rng.integers(len(steps), size=(2, view.n_episodes))
    always = rng.integers(len(steps), size=len(steps))
    edited, columns = np.stack([states, states]), list(dimensions)
    edited[0][:, columns] = states[once[episodes]][:, columns]
    edited[1][:, columns] = states[always][:, columns]
    return AugmentedEpisodes(
        copy_source=np.tile(view.episode_ids, 2),
        edit_copy=np.concatenate([episodes, episodes + view.n_episodes]),
        edit_step=np.tile(steps, 2),
        edit_state=np.concatenate(edited),
    )
