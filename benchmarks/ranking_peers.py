"""Rank later ratings by our SASRec and by that of RecTools, trained on the same rows; resumes.

    python -m venv peer && peer/bin/pip install "rectools[torch]==0.19.0"
    python benchmarks/ranking_peers.py --out runs/peers --peer peer/bin/python --seeds 3

The log is that of `examples/make_ratings_log.py`. The later tenth of the ratings is judged, each
from all that the user had rated before, among films that the user has not rated; films without
training rows count as misses. Both have width 64; RecTools learns for 20 epochs by softmax. A
second row of ours has as many updates of as many sequences as RecTools, and no refit. CPU seconds
are of one thread: of the training, of ours with all that the command does, and of recommending
from the rows of 2,000 users.
"""

import argparse
import json
import resource
import runpy
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import pandas as pd
import torch

K, LENGTH, EPOCHS, BATCH, USERS = 10, 20, 20, 128, 2000


def rank_with_rectools(folder: Path, seed: int) -> None:
    """Train and rank with RecTools, in its own environment; prints hit rate, NDCG, CPU seconds of
    training and of recommending, and the number of updates."""
    from lightning_fabric import seed_everything
    from rectools import Columns
    from rectools.dataset import Dataset
    from rectools.models import SASRecModel

    torch.set_num_threads(1)
    seed_everything(seed)
    files = (folder / f"{name}.csv" for name in ("first", "later"))
    first, later = (pd.read_csv(file, parse_dates=["rated_at"]) for file in files)
    names = {"user": Columns.User, "film": Columns.Item, "rated_at": Columns.Datetime}
    rows = first.rename(columns=names).assign(**{Columns.Weight: 1.0})
    sizes = {"n_factors": 64, "n_blocks": 2, "n_heads": 1, "session_max_len": LENGTH}
    rates = {"epochs": EPOCHS, "batch_size": BATCH, "lr": 1e-3, "deterministic": True, "verbose": 0}
    model = SASRecModel(loss="softmax", train_min_user_interactions=2, **sizes, **rates)
    begin = time.process_time()
    model.fit(Dataset.construct(rows))
    trained = time.process_time()
    some = Dataset.construct(of_some_users(rows, Columns.User))
    model.recommend(some.user_id_map.external_ids, some, k=K, filter_viewed=True)
    seconds = [trained - begin, time.process_time() - trained]
    network, data = model.lightning_model.torch_model.eval(), model.data_preparator
    numbers = {film: n for n, film in enumerate(data.item_id_map.external_ids)}
    history: defaultdict[str, list[int]] = defaultdict(list)
    gains: list[float] = []
    for user, film in zip(first.user, first.film, strict=True):
        # RecTools leaves out users of one film, and with them some films.
        history[user] += [numbers[film]] if film in numbers else []
    with torch.no_grad():
        vectors = network.item_model.get_all_embeddings()
        for user, film in zip(later.user, later.film, strict=True):
            seen, number = history[user], numbers.get(film, -1)
            latest = seen[-LENGTH:]
            session = {"x": torch.tensor([[0] * (LENGTH - len(latest)) + latest])}
            scores = vectors @ network.encode_sessions(session, vectors)[0, -1]
            scores[[*range(data.n_item_extra_tokens), *seen]] = -torch.inf
            place = 1 + int((scores > scores[number]).sum()) if number >= 0 else K + 1
            gains.append(1 / float(torch.log2(torch.tensor(place + 1.0))) if place <= K else 0.0)
            seen += [number] if number >= 0 else []
    hits, updates = sum(gain > 0 for gain in gains), model.lightning_model.trainer.global_step
    print(json.dumps([hits / len(gains), sum(gains) / len(gains), *seconds, updates]))


def of_some_users(rows: pd.DataFrame, column: str) -> pd.DataFrame:
    """The rows of `USERS` users, of those with two or more films."""
    counts = rows[column].value_counts(sort=False)
    return rows[rows[column].isin(counts.index[counts > 1][:USERS])]


def run(*command: str | Path) -> tuple[str, float]:
    """Output of a command, and the CPU seconds that it took."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    words = [str(word) for word in command]
    printed = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True).stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return printed, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def rank_with_ucfrec(folder: Path, run_folder: Path, options: list[str]) -> list[float]:
    """Train and rank a policy: hit rate, NDCG, CPU seconds of training and of recommending."""
    from ucfrec import Recommender

    ours, columns = (sys.executable, "-m", "ucfrec"), []
    for name in ("user_id=user", "item_id=film", "timestamp=rated_at"):
        columns += ["--column", name]
    store, log = folder / "store", folder / "first.csv"
    if not store.exists():
        how = ("--reward", "rating", "--session-by", "user", "--split", "0.89,0.11,0")
        run(*ours, "prepare", log, "--out", store, *columns, *how)
    options = [*options, "--threads", "1", "--goal", "rank", "--set", "policy.dim=64"]
    _, seconds = run(*ours, "train", store, "--out", run_folder, *options)
    table = run_folder.with_suffix(".json")
    run(*ours, "rank", run_folder, folder / "later.csv", *columns, "--json", table)
    row = json.loads(table.read_text(encoding="utf-8"))[0]
    share = row["conditions"]["steps"] / len(pd.read_csv(folder / "later.csv"))
    recommender, rows = Recommender.load(run_folder), pd.read_csv(log, parse_dates=["rated_at"])
    begin = time.process_time()
    recommender.recommend(of_some_users(rows, "user"), K)
    measured = [share * row["metrics"][name] for name in ("hit_rate_shown", "ndcg_shown")]
    return [*measured, seconds, time.process_time() - begin]


def print_row(method: str, seed: int, measured: list[float]) -> None:
    hits, ndcg, training, recommending = measured[:4]
    numbers = f"{hits:.3f} | {ndcg:.3f} | {training:.0f} | {recommending:.2f}"
    print(f"| {method} | {seed} | {numbers} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of log, store and runs")
    parser.add_argument("--peer", help="Python with RecTools")
    parser.add_argument("--log", type=int, default=0, help="seed of the log")
    parser.add_argument("--seeds", type=int, default=1, help="training seeds")
    parser.add_argument("--policy", action="append", help="ours (default: sasrec)")
    parser.add_argument("--set", action="append", default=[], help="setting of ours; repeatable")
    parser.add_argument("--rectools", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.rectools is not None:
        rank_with_rectools(options.out, options.rectools)
        return
    maker = Path(__file__).parents[1] / "examples" / "make_ratings_log.py"
    log = runpy.run_path(str(maker))["make_log"](options.out, options.log)
    cut = len(log) * 9 // 10
    log[:cut].to_csv(options.out / "first.csv", index=False)
    log[cut:].to_csv(options.out / "later.csv", index=False)
    torch.set_num_threads(1)
    print("| method | seed | HR@10 | NDCG@10 | training CPU s | recommending CPU s |")
    print("|---|---|---|---|---|---|")
    for seed in range(options.seeds):
        updates = 0
        if options.peer:
            command = (options.peer, __file__, "--out", options.out, "--rectools", str(seed))
            measured = json.loads(run(*command)[0].splitlines()[-1])
            print_row("RecTools", seed, measured)
            updates = int(measured[4])
        for policy in options.policy or ["sasrec"]:
            how, out = ["--policy", policy, "--seed", str(seed)], options.out / f"{policy}-{seed}"
            how += [word for text in options.set for word in ("--set", text)]
            print_row(policy, seed, rank_with_ucfrec(options.out, out, how))
            if updates:
                settings = f"train.steps={updates}", "train.patience=0", f"train.batch_size={BATCH}"
                how += ["--no-refit", *(word for text in settings for word in ("--set", text))]
                out = out.with_name(f"{out.name}-{updates}")
                print_row(
                    f"{policy}, {updates} updates", seed, rank_with_ucfrec(options.out, out, how)
                )


if __name__ == "__main__":
    main()
