"""Rank later ratings by our SASRec and by that of RecTools, trained on the same rows; resumes.

    python -m venv peer && peer/bin/pip install "rectools[torch]==0.19.0"
    python benchmarks/ranking_peers.py --out runs/peers --peer peer/bin/python --seeds 3

The log is that of `examples/make_ratings_log.py`. The later tenth of the ratings is judged, each
from all that the user had rated before, among films that the user has not rated; films without
training rows count as misses. Both have width 64; RecTools learns for 20 epochs by softmax. CPU
seconds are of one thread, for RecTools with the ranking, for ours with the refit.
"""

import argparse
import json
import resource
import runpy
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pandas as pd

K, LENGTH = 10, 20


def rank_with_rectools(folder: Path, seed: int) -> None:
    """Train and rank with RecTools, in its own environment; prints hit rate and NDCG."""
    import torch
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
    rates = {"epochs": 20, "batch_size": 128, "lr": 1e-3, "deterministic": True, "verbose": 0}
    model = SASRecModel(loss="softmax", train_min_user_interactions=2, **sizes, **rates)
    model.fit(Dataset.construct(rows))
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
    print(json.dumps([sum(gain > 0 for gain in gains) / len(gains), sum(gains) / len(gains)]))


def run(*command: str | Path) -> tuple[str, float]:
    """Output of a command, and the CPU seconds that it took."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    words = [str(word) for word in command]
    printed = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True).stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return printed, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def rank_with_ucfrec(folder: Path, seed: int, policy: str) -> tuple[list[float], float]:
    """Train and rank a policy: hit rate, NDCG, and the CPU seconds of the training."""
    ours, out, columns = (sys.executable, "-m", "ucfrec"), folder / f"{policy}-{seed}", []
    for name in ("user_id=user", "item_id=film", "timestamp=rated_at"):
        columns += ["--column", name]
    store, log = folder / "store", folder / "first.csv"
    if not store.exists():
        how = ("--reward", "rating", "--session-by", "user", "--split", "0.89,0.11,0")
        run(*ours, "prepare", log, "--out", store, *columns, *how)
    options = ["--policy", policy, "--seed", str(seed), "--threads", "1", "--goal", "rank"]
    _, seconds = run(*ours, "train", store, "--out", out, *options, "--set", "policy.dim=64")
    run(*ours, "rank", out, folder / "later.csv", *columns, "--json", out.with_suffix(".json"))
    row = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))[0]
    share = row["conditions"]["steps"] / len(pd.read_csv(folder / "later.csv"))
    return [share * row["metrics"][name] for name in ("hit_rate_shown", "ndcg_shown")], seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of log, store and runs")
    parser.add_argument("--peer", help="Python with RecTools")
    parser.add_argument("--log", type=int, default=0, help="seed of the log")
    parser.add_argument("--seeds", type=int, default=1, help="training seeds")
    parser.add_argument("--policy", action="append", help="ours (default: sasrec)")
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
    print("| method | seed | HR@10 | NDCG@10 | CPU s |\n|---|---|---|---|---|")
    for seed in range(options.seeds):
        for policy in options.policy or ["sasrec"]:
            (hits, ndcg), seconds = rank_with_ucfrec(options.out, seed, policy)
            print(f"| {policy} | {seed} | {hits:.3f} | {ndcg:.3f} | {seconds:.0f} |", flush=True)
        if options.peer:
            command = (options.peer, __file__, "--out", options.out, "--rectools", str(seed))
            printed, seconds = run(*command)
            hits, ndcg = json.loads(printed.splitlines()[-1])
            print(f"| RecTools | {seed} | {hits:.3f} | {ndcg:.3f} | {seconds:.0f} |", flush=True)


if __name__ == "__main__":
    main()
