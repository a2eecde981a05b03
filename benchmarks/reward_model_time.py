"""CPU time and held-out quality of the causal reward model, beside those of an earlier version.

    git clone . previous && git -C previous checkout ea1fb02
    python benchmarks/reward_model_time.py STORE --previous previous

Each fit is a process of one thread that runs one of the two versions, in turn. Appends the rows to
runs/reward_model_time/results.jsonl, or to --results, and prints a table.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from ucfrec.code_version import code_version
from ucfrec.provenance import provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows
from ucfrec.reporting.tables import markdown_table

RESULTS = Path("runs/reward_model_time/results.jsonl")
ROOT = Path(__file__).parents[1]
FIT = """
import json, sys, tempfile, time
from pathlib import Path
import torch
from ucfrec.counterfactual.augment import sample_transitions
from ucfrec.counterfactual.reward_model import CRMConfig
from ucfrec.counterfactual.reward_model_fit import fit_crm
from ucfrec.episodes.store import EpisodeStore
from ucfrec.runs.start import training_views
torch.set_num_threads(1)
seed = int(sys.argv[2])
views = training_views(EpisodeStore.open(Path(sys.argv[1])))
config = CRMConfig()
train, held_out = (
    sample_transitions(view, limit, seed)
    for view, limit in zip(views, (config.max_transitions, config.max_transitions // 10))
)
with tempfile.TemporaryDirectory() as folder:
    began = time.process_time()
    _, report = fit_crm(train, held_out, config, Path(folder), seed)
    seconds = time.process_time() - began
print(json.dumps({"seconds": seconds, "r2": report.r2, "r2_without_z": report.r2_without_z}))
"""


def fitted(store: Path, seed: int, code: Path) -> dict[str, float]:
    """CPU seconds of a fit by the code in a folder, and R² on held-out steps with and without z."""
    paths = [str(code / part) for part in ("", "datasets", "simulators", "control")]
    end = subprocess.run(
        [sys.executable, "-c", FIT, str(store.resolve()), str(seed)],
        cwd=code,  # comes before the path
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"},
        check=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    values: dict[str, float] = json.loads(end.stdout)
    return values


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store", type=Path, help="episode store")
    parser.add_argument("--previous", type=Path, required=True, help="clone of the earlier version")
    parser.add_argument("--seeds", type=int, default=5, help="fits of each version (default: 5)")
    parser.add_argument("--results", type=Path, default=RESULTS, help="file of result rows")
    options = parser.parse_args()
    versions = {"now": ROOT, "previous": options.previous.resolve()}
    found: dict[str, list[dict[str, float]]] = {name: [] for name in versions}
    for seed in range(options.seeds):
        for name, code in versions.items():
            found[name].append(fitted(options.store, seed, code))
            print(f"seed {seed}, {name}: {found[name][-1]}", file=sys.stderr, flush=True)
    lines = []
    for name, fits in found.items():
        measured = {key: np.array([each[key] for each in fits]) for key in fits[0]}
        spread = {f"{key}_sd": float(value.std()) for key, value in measured.items()}
        middle = {key: float(np.median(value)) for key, value in measured.items()}
        lines.append((name, *(f"{middle[key]:.4g} ± {spread[f'{key}_sd']:.2g}" for key in middle)))
        row = ResultRow(
            suite="reward-model-time",
            table="reward-model-time",
            task=options.store.parent.name,
            method=name,
            policy="ucf",
            conditions={"seeds": options.seeds},
            code_version=code_version(Path(__file__), "ucfrec.counterfactual.reward_model_fit"),
            metric="seconds",
            metrics=middle | spread,
            wall_time_s=float(measured["seconds"].sum()),
            **provenance(),
        )
        append_rows(options.results, [row])
    header = ("version", "CPU s, median ± sd over seeds", "held-out R² with z", "without z")
    print(markdown_table(header, lines))


if __name__ == "__main__":
    main()
