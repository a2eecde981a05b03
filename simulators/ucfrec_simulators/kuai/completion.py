"""Completion of a user × item click table from the rows of one time window of a log."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from sklearn.metrics import roc_auc_score
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.arrays import Array, Float32Array, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_folder, write_json
from ucfrec.fitting.loop import LoopConfig, fit
from ucfrec.processes import random_state_kept

USERS_FILE, ITEMS_FILE, REPORT_FILE = "users.parquet", "items.parquet", "completion.json"
BINS: Final = 10


@dataclass(frozen=True)
class CompletionConfig:
    """Size and training of the completion model.

    The defaults were chosen on the validation rows of KuaiRand's 28–30 April, not on the test rows.
    """

    factors: int = 4
    dropout: float = 0.7
    steps: int = 1500
    batch_size: int = 1024
    learning_rate: float = 2e-3
    weight_decay: float = 0.5


@dataclass(frozen=True)
class CompletionReport:
    """Accuracy of the completed table on test rows, which are later than the fitted rows."""

    rows: int
    held_out_rows: int
    auc: float
    log_loss: float
    """Nats per row."""
    base_log_loss: float
    """Log loss (nats) of predicting the fitted rows' mean click rate for every pair."""
    calibration_error: float
    """Expected calibration error: mean of |predicted − observed| click rate over `calibration`."""
    calibration: list[tuple[float, float]]
    """(predicted, observed) click rate of each tenth of the test rows, by rising prediction."""
    users: int
    items: int


class CompletionModel(nn.Module):
    """Logistic factorisation over ids and features: ⟨p_u + P f_u, q_i + Q g_i⟩ + b + b_u + b_i."""

    user_features: Tensor
    item_features: Tensor

    def __init__(
        self, user_features: Tensor, item_features: Tensor, config: CompletionConfig
    ) -> None:
        """Build for features (n_users, F) and (n_items, G)."""
        super().__init__()
        size = config.factors + 1  # the last component is the bias
        self.register_buffer("user_features", user_features)
        self.register_buffer("item_features", item_features)
        self.user_vectors = nn.Embedding(len(user_features), size)
        self.item_vectors = nn.Embedding(len(item_features), size)
        self.of_user = nn.Parameter(0.05 * torch.randn(user_features.shape[1], size))
        self.of_item = nn.Parameter(0.05 * torch.randn(item_features.shape[1], size))
        self.bias = nn.Parameter(torch.zeros(()))
        self.dropout = nn.Dropout(config.dropout)
        for table in (self.user_vectors, self.item_vectors):
            nn.init.normal_(table.weight, std=0.05)

    def forward(self, users: Tensor, items: Tensor) -> Tensor:
        """Log-odds (M,) of a click of users (M,) on items (M,)."""
        user = self.user_vectors(users) + self.user_features[users] @ self.of_user
        item = self.item_vectors(items) + self.item_features[items] @ self.of_item
        match = (self.dropout(user[:, :-1]) * item[:, :-1]).sum(-1)
        return match + user[:, -1] + item[:, -1] + self.bias  # type: ignore[no-any-return]

    @torch.no_grad()
    def factors(self) -> tuple[Float32Array, Float32Array]:
        """Vectors (n, factors + 2) of users and of items; their inner products are the log-odds."""
        user = self.user_vectors.weight + self.user_features @ self.of_user
        item = self.item_vectors.weight + self.item_features @ self.of_item
        one_user, one_item = torch.ones(len(user), 1), torch.ones(len(item), 1)
        users = torch.cat([user[:, :-1], user[:, -1:] + self.bias, one_user], dim=1)
        items = torch.cat([item[:, :-1], one_item, item[:, -1:]], dim=1)
        return users.numpy(), items.numpy()


class Completed:
    """The completed table, computed on access and indexed like an array (see `Rewards`)."""

    def __init__(self, users: Float32Array, items: Float32Array) -> None:
        """The table of users (n_users, D) and items (n_items, D)."""
        self._users, self._items = users, items
        self.shape = (len(users), len(items))

    def __getitem__(self, pairs: tuple[IntArray, IntArray]) -> Array:
        """Click probabilities (...) of aligned users (...) and items (...)."""
        users, items = pairs
        logits = np.einsum("...d,...d->...", self._users[users], self._items[items])
        return np.asarray(1 / (1 + np.exp(-logits)))


@random_state_kept()
def complete(
    store: EpisodeStore,
    tags: Mapping[int, tuple[int, ...]],
    out: Path,
    config: CompletionConfig | None = None,
    seed: int = 0,
) -> CompletionReport:
    """Fit the completion model on the rows of `store` and write the environment's files to `out`.

    The model is fitted on the store's training rows, with early stopping on its validation rows.
    The report is of its test rows, which are later than both. The store must hold the evaluation
    window only, and no rows that a policy is trained on.

    Writes `users.parquet` (user_id, vector), `items.parquet` (item_id, vector, tags) and
    `completion.json`, atomically. The click probability of a pair is the logistic function of the
    inner product of its vectors. InputError if rewards are not clicks, a split is empty, or `out`
    exists.

    Args:
        store: logs of items with clicks (0 or 1) as rewards, split in time.
        tags: tags of each video id; a missing video has no tags.
        seed: seed of the initial weights and of the batches.
    """
    config, states = config or CompletionConfig(), store.item_states
    fitted, validation, test = (_rows(store.split(name)) for name in schema.SPLITS)
    torch.manual_seed(seed)
    model = CompletionModel(states.user_features, states.embeddings, config)
    with torch.no_grad():
        model.bias.fill_(torch.logit(fitted[2].mean()).item())

    def draw(generator: np.random.Generator) -> tuple[Tensor, ...]:
        batch = torch.from_numpy(generator.integers(len(fitted[2]), size=config.batch_size))
        return tuple(column[batch] for column in fitted)

    def loss(rows: tuple[Tensor, ...]) -> tuple[Tensor, dict[str, Tensor]]:
        return F.binary_cross_entropy_with_logits(model(rows[0], rows[1]), rows[2]), {}

    loop = LoopConfig(
        steps=config.steps,
        batch_size=config.batch_size,
        learning_rate=config.learning_rate,
        weight_decay=config.weight_decay,
        warmup_steps=0,
        clip_norm=0.0,
        validate_every=50,
        patience=6,
        average=0.0,
    )
    with atomic_folder(out) as folder:
        with TemporaryDirectory(dir=folder) as work:
            validate = lambda: float(loss(validation)[0])  # noqa: E731
            fit(model, draw, loss, loop, Path(work), seed=seed, validate=validate, describe="fill")
        report = _evaluate(model, fitted[2], test)
        _write(store, model, tags, folder)
        origin = {"fingerprint": store.record.fingerprint, "seed": seed, "config": asdict(config)}
        write_json(folder / REPORT_FILE, asdict(report) | origin)
    return report


def _rows(store: EpisodeStore) -> tuple[Tensor, Tensor, Tensor]:
    """Users, items and clicks of every step, (M,) each."""
    if not store.n_episodes:
        raise InputError(f"{store.path} has an empty split; prepare it with three shares")
    episodes, steps = store.all_steps()
    clicks = store.step_values(schema.REWARD, episodes, steps)
    if not np.isin(clicks, (0, 1)).all():
        raise InputError(f"{store.path}: rewards are not clicks; prepare it with 0 and 1")
    users = store.episode_values(schema.USER)[episodes]
    items = store.step_values(schema.ITEM, episodes, steps).astype(np.int64)
    return torch.from_numpy(users), torch.from_numpy(items), torch.from_numpy(clicks).float()


@torch.no_grad()
def _evaluate(
    model: CompletionModel, fitted: Tensor, test: tuple[Tensor, Tensor, Tensor]
) -> CompletionReport:
    users, items, clicks = test
    predicted = torch.sigmoid(model(users, items))
    order = torch.argsort(predicted)
    tenths = [(float(predicted[t].mean()), float(clicks[t].mean())) for t in order.chunk(BINS)]
    base_rate = fitted.mean().expand(len(clicks))
    return CompletionReport(
        rows=len(fitted),
        held_out_rows=len(clicks),
        auc=float(roc_auc_score(clicks, predicted)),
        log_loss=float(F.binary_cross_entropy(predicted, clicks)),
        base_log_loss=float(F.binary_cross_entropy(base_rate, clicks)),
        calibration_error=float(np.mean([abs(p - o) for p, o in tenths])),
        calibration=tenths,
        users=len(model.user_features),
        items=len(model.item_features),
    )


def _write(
    store: EpisodeStore, model: CompletionModel, tags: Mapping[int, tuple[int, ...]], folder: Path
) -> None:
    users, items = model.factors()
    user_ids = pq.read_table(store.path / "users.parquet").column(schema.USER_ID)
    item_ids = pq.read_table(store.path / "items.parquet").column(schema.ITEM_ID)
    item_tags = [list(tags.get(item, ())) for item in item_ids.to_pylist()]
    tables = {
        USERS_FILE: {schema.USER_ID: user_ids, "vector": _lists(users)},
        ITEMS_FILE: {
            schema.ITEM_ID: item_ids,
            "vector": _lists(items),
            "tags": pa.array(item_tags, type=pa.list_(pa.int64())),
        },
    }
    for name, columns in tables.items():
        pq.write_table(pa.table(columns), folder / name)


def _lists(rows: Float32Array) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(rows.ravel(), rows.shape[1])
