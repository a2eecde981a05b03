"""A training run (Algorithm 1) and the folder that holds it."""

import dataclasses
import shutil
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.acting import PolicyActor
from ucfrec.augment import augment
from ucfrec.checkpoint import load_tensors, load_weights
from ucfrec.config import POLICIES, Config, config_from_dict
from ucfrec.crm import fit_crm
from ucfrec.csg import fit_csg
from ucfrec.errors import InputError
from ucfrec.files import atomic_folder, read_json, write_json
from ucfrec.heads import ItemHead
from ucfrec.policy import SequencePolicy
from ucfrec.states import ItemStates
from ucfrec.store import ITEM_STATES, EpisodeStore
from ucfrec.train import fit
from ucfrec.windows import Overlay, Windows

RUN = "run.json"
ITEMS, USERS = "items.parquet", "users.parquet"
_VALIDATION_BATCHES = 16
_VALIDATION_BATCH = 256
_QUANTILES = (0.5, 0.75, 0.9, 0.95, 0.99, 1.0)


def train_run(store: EpisodeStore, out: Path, config: Config) -> dict[str, Any]:
    """Train a policy on the training episodes of `store`, or go on where `out` was left.

    Reward model, generator, edited copies (unless `augment.copies` is 0), then the policy; each
    stage that is finished is kept.

    Returns:
        The record in `run.json`: command, configuration, seed, store fingerprint, versions, wall
        time and what every stage reports.

    Raises:
        InputError: `out` is a run on another store or with another configuration, or the store has
            no training episodes.
    """
    train = store.split("train")
    if train.n_episodes == 0:
        raise InputError(f"{store.path} has no training episodes; prepare it with a later split")
    if not (out / RUN).exists():
        _begin(store, train, out, config)
    record = read_json(out / RUN)
    _require_same(record, store, out, config)
    began = time.perf_counter() - record["wall_time_s"]
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    validation = store.split("validation")
    if config.augment.copies > 0:
        train = train.with_overlay(_counterfactuals(train, validation, out, config, record))
    policy = new_policy(train, config).to(device)
    k = policy.config.context

    def draw(generator: np.random.Generator) -> Windows:
        return train.windows(*train.draw_steps(generator, config.train.batch_size), k).to(device)

    fitted = fit(
        policy,
        draw,
        policy.loss,
        config.train,
        out / "policy",
        seed=config.seed,
        validate=_validation(policy, validation, config.seed) if validation.n_episodes else None,
        describe=config.policy_name,
    )
    record["policy"] = dataclasses.asdict(fitted)
    record["wall_time_s"] = time.perf_counter() - began
    write_json(out / RUN, record)
    return dict(record)


def _begin(store: EpisodeStore, train: EpisodeStore, out: Path, config: Config) -> None:
    record = {
        "command": sys.argv,
        "config": dataclasses.asdict(config),
        "seed": config.seed,
        "store": str(store.path.resolve()),
        "fingerprint": store.meta["fingerprint"],
        "reward": store.meta["reward"],
        "sizes": _sizes(store),
        "observation_size": store.observation_size,
        "return_quantiles": {
            str(q): float(np.quantile(train.returns, q)) for q in _QUANTILES
        },
        "mean_return": float(train.returns.mean()),
        "versions": {name: version(name) for name in ("ucfrec", "torch", "numpy")},
        "wall_time_s": 0.0,
    }
    with atomic_folder(out) as scratch:
        for name in (ITEM_STATES, ITEMS, USERS):
            if (store.path / name).exists():
                shutil.copyfile(store.path / name, scratch / name)
        write_json(scratch / RUN, record)


def _require_same(record: Mapping[str, Any], store: EpisodeStore, out: Path, config: Config) -> None:
    if record["fingerprint"] != store.meta["fingerprint"]:
        raise InputError(
            f"{out} is a run on another store ({record['store']}, fingerprint "
            f"{record['fingerprint'][:12]}), not on {store.path} "
            f"({store.meta['fingerprint'][:12]}); name another run folder"
        )
    before, now = dataclasses.asdict(config_from_dict(record["config"])), dataclasses.asdict(config)
    for table, values in now.items():
        if before[table] != values:
            was = _difference(before[table], values)
            raise InputError(
                f"{out} was begun with another {table} ({was}); name another run folder, or give "
                "the same configuration to resume"
            )


def _difference(before: Any, now: Any) -> str:
    if not isinstance(now, Mapping):
        return f"{before} there, {now} here"
    return ", ".join(
        f"{key} is {before.get(key)} there, {value} here"
        for key, value in now.items()
        if before.get(key) != value
    )


def _counterfactuals(
    train: EpisodeStore,
    validation: EpisodeStore,
    out: Path,
    config: Config,
    record: dict[str, Any],
) -> Overlay:
    """Reward model, generator and accepted edits (Algorithms 2 to 5)."""
    path = out / "overlay.safetensors"
    if path.exists():
        return Overlay.load(path)
    raise NotImplementedError


def _sizes(store: EpisodeStore) -> dict[str, int]:
    columns = store.meta["columns"]
    if store.has_items:
        items, dim = store.item_states.embeddings.shape
        return {"state": store.state_size, "action": dim, "items": items}
    return {"state": store.state_size, "action": columns[schema.ACTION][0], "items": 0}


def new_policy(train: EpisodeStore, config: Config) -> SequencePolicy:
    """A policy with the normalisation and item embeddings of `train`, its weights untrained."""
    torch.manual_seed(config.seed)
    policy = POLICIES[config.policy_name](config.policy, _sizes(train))
    base = EpisodeStore.select(train, np.arange(len(train.episode_ids)))
    mean, std = base.state_statistics
    policy.state_mean.copy_(mean)
    policy.state_std.copy_(torch.where(std > 1e-6, std, 1.0))
    scale = config.policy.return_scale or float(np.abs(base.returns).max()) or 1.0
    policy.return_scale.fill_(scale)
    episodes, steps = base.all_steps()
    if isinstance(policy.head, ItemHead):
        counts = np.bincount(
            base.step_values(schema.ITEM, episodes, steps), minlength=len(policy.head.counts)
        )
        policy.head.start_from(base.item_states.embeddings, torch.from_numpy(counts).float())
    else:
        actions = base.step_values(schema.ACTION, episodes, steps)
        policy.head.scale.copy_(torch.from_numpy(np.abs(actions).max(0)).clamp(min=1.0))
    return policy


def _validation(policy: SequencePolicy, validation: EpisodeStore, seed: int) -> Any:
    """The mean action loss at held-out steps, the same ones at every call."""
    generator = np.random.default_rng([seed, 0])
    drawn = [
        validation.draw_steps(generator, _VALIDATION_BATCH) for _ in range(_VALIDATION_BATCHES)
    ]
    k, device = policy.config.context, policy.state_mean.device
    windows = [validation.windows(*steps, k) for steps in drawn]

    def loss() -> float:
        return float(torch.stack([policy.action_loss(w.to(device)) for w in windows]).mean())

    return loss


@dataclass(frozen=True)
class TrainedPolicy:
    """A policy read back from a run folder, with all that acting and recommending need."""

    policy: SequencePolicy
    record: Mapping[str, Any]
    item_states: ItemStates | None
    item_ids: npt.NDArray[Any] | None
    """(n_items,) identifiers in the logs; None where actions are vectors."""
    user_ids: npt.NDArray[Any]
    """(n_users,) identifiers in the logs; empty where there are none."""

    @classmethod
    def load(cls, run: Path, checkpoint: str = "best") -> "TrainedPolicy":
        """Read `best` (on validation) or `last` weights of a run.

        Raises:
            InputError: `run` is no run folder, or has no checkpoint yet.
        """
        if not (run / RUN).exists():
            raise InputError(f"{run} is not a run folder: it has no {RUN}; train one first")
        record = read_json(run / RUN)
        config = config_from_dict(record["config"])
        policy = POLICIES[config.policy_name](config.policy, record["sizes"])
        path = run / "policy" / f"{checkpoint}.safetensors"
        load_weights(path, policy, _weights(path))
        policy.eval()
        states = run / ITEM_STATES
        return cls(
            policy,
            record,
            ItemStates.load(states) if states.exists() else None,
            _ids(run / ITEMS, schema.ITEM_ID) if states.exists() else None,
            _ids(run / USERS, schema.USER_ID),
        )

    def target_return(self, quantile: float) -> float:
        """The `quantile` of training returns, interpolated between those the run recorded."""
        known = self.record["return_quantiles"]
        return float(np.interp(quantile, [float(q) for q in known], list(known.values())))

    def actor(self, episodes: int, target_return: float) -> PolicyActor:
        """An actor for `episodes` environments side by side."""
        return PolicyActor(
            self.policy,
            episodes,
            target_return,
            self.record["observation_size"],
            self.item_states,
            self.item_ids,
        )


def _weights(path: Path) -> dict[str, Tensor]:
    tensors, _ = load_tensors(path)
    return {name: t for name, t in tensors.items() if not name.startswith("optimizer.")}


def _ids(path: Path, column: str) -> npt.NDArray[Any]:
    if not path.exists():
        return np.empty(0, dtype=np.int64)
    return np.asarray(pq.read_table(path, columns=[column]).column(column))
