"""What sessions of users without training rows tell the reward model of their tastes, on real logs.

    python benchmarks/new_users.py --out runs/new-users      # three minutes on one core

The users of KuaiRand-Pure, whose files are in $UCFREC_DATA/kuairand, are drawn into five parts:
three to fit the reward model of items to, one that chooses its effects, one that judges them and
that nothing else has seen. The model is fitted with and without tastes learned within the session
(`UserPosterior`), and for items alone, in three draws. The log loss on the judged users' clicks
tells of both how much and what users like; the AUC, over all users, of how much more the shown item
scores than the mean of all items, tells what. (GAUC would compare a user's clicks with the steps
that they themselves changed.) Appends rows to results.jsonl in --out, or to --results.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
import torch
from sklearn.metrics import roc_auc_score
from torch import Tensor
from torch.nn import functional as F

from ucfrec.code_version import code_version
from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs.mapping import LogMapping, log_files
from ucfrec.logs.prepare import prepare
from ucfrec.plugins import load_plugin
from ucfrec.provenance import provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows, read_rows
from ucfrec.reporting.tables import markdown_table
from ucfrec.schema import USER
from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.reward_effects import EFFECTS
from ucfrec.user_model.reward_fit import fit_item_reward_model
from ucfrec.user_model.reward_rows import RewardRows
from ucfrec_simulators.folders import data_folder

ITEMS: Final = ("item", "user", "content", "affinity")
MODELS: Final[Mapping[str, tuple[str, ...]]] = {
    "items alone": ITEMS,
    "without tastes": tuple(name for name in EFFECTS if name != "tastes"),
    "with tastes": EFFECTS,
}
"""Effects that are tried. Those of users only serve to tell those of items."""
DRAWS, PARTS = 3, 5
"""Draws of the users, and parts of each."""
_ROWS: Final = 512
"""Rows whose items are all scored at once."""


def stores(folder: Path, seed: int) -> tuple[EpisodeStore, EpisodeStore]:
    """Stores of the users to fit to and to choose with, and of those to judge with.

    The second has the items and item embeddings of the first, which no judged user has a part in.
    """
    given = [
        file for file in log_files([data_folder("kuairand")]) if "_statistic_" not in file.name
    ]
    logs = [file for file in given if file.name.startswith("log_")]
    features = [file for file in given if file not in logs]
    rows = pd.concat([pd.read_parquet(file) for file in logs])
    owner = np.unique(rows["user_id"], return_inverse=True)[1]
    judged = np.random.default_rng(seed).permutation(owner.max() + 1)[owner] % PARTS == 0
    known = folder / "known"
    for path, part in ((known, ~judged), (folder / "judged", judged)):
        if path.exists():
            continue
        log = folder / f"log_standard_{path.name}.parquet"
        folder.mkdir(parents=True, exist_ok=True)
        rows[part].to_parquet(log)
        paths, mapping = load_plugin("datasets", "kuairand").resolve(
            [log, *features], LogMapping(reward="is_click")
        )
        prepare(paths, mapping, path, like=None if path == known else known)
    return EpisodeStore.open(known), EpisodeStore.open(folder / "judged")


def measured(folder: Path, seed: int) -> list[ResultRow]:
    """The rows of all models for one draw of the users."""
    store, judged = stores(folder, seed)
    owner = np.unique(store.episode_values(USER), return_inverse=True)[1]
    choosing = np.random.default_rng(seed).permutation(owner.max() + 1)[owner] % (PARTS - 1) == 0
    train, validation = (store.select(np.flatnonzero(part)) for part in (~choosing, choosing))
    of_item, losses = {}, {}
    for name, effects in MODELS.items():
        model, _ = fit_item_reward_model(
            train, validation, folder / name.replace(" ", "-"), seed, effects=effects
        )
        rows = RewardRows.of(judged, model.reach, judged.n_steps, seed)
        scores, of_item[name] = scores_of(model, rows)
        target = model.target(rows.rewards).double()
        losses[name] = F.binary_cross_entropy_with_logits(scores.double(), target, reduction="none")
    liked, found = rows.rewards.numpy() > 0, list[ResultRow]()
    for name in MODELS:
        difference = by_user(losses["without tastes"] - losses[name], rows.users)
        metrics = {
            "loss": float(losses[name].mean()),
            "loss_less": difference[0],
            "loss_less_error": difference[1],
            "auc": float(roc_auc_score(liked, of_item[name].numpy())),
        }
        found.append(
            ResultRow(
                suite="new-users",
                table="new-users",
                task="kuairand-pure",
                method=name,
                policy="reward model",
                training_seed=seed,
                conditions={"judged_steps": len(rows)},
                code_version=code_version(Path(__file__), fit_item_reward_model.__module__),
                data_fingerprint=store.record.fingerprint,
                metric="loss",
                metrics=metrics,
                **provenance(),
            )
        )
    return found


@torch.no_grad()
def scores_of(model: ItemRewardModel, rows: RewardRows) -> tuple[Tensor, Tensor]:
    """Scores (M,) of the items shown, and how much more these are than the mean of all items'."""
    own, more = [], []
    for start in range(0, len(rows), _ROWS):
        part = slice(start, start + _ROWS)
        scores = model.scores(rows.states[part], rows.shown.at(part))
        own.append(scores.gather(1, rows.items[part].unsqueeze(1))[:, 0])
        more.append(own[-1] - scores.mean(1))
    return torch.cat(own), torch.cat(more)


def by_user(differences: Tensor, users: Tensor) -> tuple[float, float]:
    """Mean (nats a row) of differences (M,), and its standard error over users (M,)."""
    owner = np.unique(users.numpy(), return_inverse=True)[1]
    sums, counts = np.bincount(owner, differences.numpy()), np.bincount(owner)
    mean = sums.sum() / counts.sum()
    return float(mean), float(np.sqrt(np.square(sums - mean * counts).sum()) / counts.sum())


def table(rows: list[ResultRow]) -> str:
    """All draws, one line a model and draw."""
    head = ("draw", "model", "log loss", "less than without", "AUC")
    lines = []
    for row in rows:
        each = row.metrics
        less = f"{each['loss_less']:+.4f} ± {each['loss_less_error']:.4f}"
        lines.append(
            (row.training_seed, row.method, f"{each['loss']:.4f}", less, f"{each['auc']:.4f}")
        )
    return markdown_table(head, lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/new-users"), help="resumed")
    parser.add_argument("--results", type=Path, help="file of rows (results.jsonl in --out)")
    parser.add_argument("--show-only", action="store_true", help="print the rows at hand")
    options = parser.parse_args()
    results = options.results or options.out / "results.jsonl"
    if not options.show_only:
        for seed in range(DRAWS):
            found = measured(options.out / f"draw-{seed}", seed)
            known = read_rows(results) if results.exists() else []
            append_rows(results, [each for each in found if not any(map(each.covers, known))])
    print(table(read_rows(results)))


if __name__ == "__main__":
    main()
