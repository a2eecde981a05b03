"""What later days of KuaiRand-Pure tell of policies trained on the days before.

    python benchmarks/next_period.py --out runs/next    # evaluated on 29-30 April
    python benchmarks/next_period.py --out runs/next --validation 27 --until 29      # on 28 April

Runs the commands of README.md on the files in $UCFREC_DATA/kuairand: it trains on the days up to
`--validation`, whose rows choose the decision rule and then take part in the refit, and ranks the
days after it as later logs. It appends rows to results.jsonl in --out, or to --results, and prints
the table of `ucfrec rank`.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from ucfrec.commands.cli import main as ucfrec
from ucfrec.logs.mapping import log_files
from ucfrec.results.rows import append_rows, read_results
from ucfrec_simulators.session_env import data_folder

SETTINGS = ("train.steps=2000", "policy.dim=64")
_CHINA = "2022-04-{:02d}T00:00+08:00"


def run(*arguments: str | Path) -> None:
    """Run one `ucfrec` command.

    Raises:
        SystemExit: it failed.
    """
    print("ucfrec", *arguments, flush=True)
    if status := ucfrec([str(argument) for argument in arguments]):
        raise SystemExit(status)


def cut_logs(out: Path, first: int, until: int) -> tuple[list[Path], Path]:
    """The files of KuaiRand, with logs of before the day `first` of April, and a log of the days
    from it until before the day `until`.

    The statistics of videos are means over the whole month, the evaluated days included; this
    leaves them out.
    """
    files = [
        file for file in log_files([data_folder("kuairand")]) if "_statistic_" not in file.name
    ]
    (log,) = (file for file in files if file.name.startswith("log_"))
    rows = pd.read_parquet(log)
    april = pd.Timestamp(_CHINA.format(1))
    begin, end = ((april + pd.Timedelta(days=d - 1)).timestamp() * 1000 for d in (first, until))
    out.mkdir(parents=True, exist_ok=True)
    earlier, later = out / log.name, out / f"later_{log.name}"
    rows[rows["time_ms"] < begin].to_parquet(earlier)
    rows[(rows["time_ms"] >= begin) & (rows["time_ms"] < end)].to_parquet(later)
    return [earlier, *(file for file in files if file != log)], later


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of store and runs; resumed")
    parser.add_argument("--results", type=Path, help="file of result rows")
    parser.add_argument("--validation", type=int, default=28, help="day of April (default: 28)")
    parser.add_argument("--until", type=int, default=31, help="the first day that is left out")
    parser.add_argument("--policy", action="append", help="policies (default: ucf)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the training (default: 0)")
    parser.add_argument("--set", action="append", default=[], help="settings over the command's")
    options = parser.parse_args()
    first, until = options.validation, options.until
    out = options.out / f"{first}-{until}"
    store, days = out / "store", f"{first + 1}-{until - 1} April"
    earlier, later = cut_logs(out, first + 1, until)
    if not store.exists():
        days_of = f"{_CHINA.format(first)},{_CHINA.format(first + 1)}"
        split = ("--reward", "is_click", "--split", days_of)
        run("prepare", *earlier, "--dataset", "kuairand", "--out", store, *split)
    settings = [part for each in (*SETTINGS, *options.set) for part in ("--set", each)]
    runs = []
    for policy in options.policy or ["ucf"]:
        runs.append(out / "-".join([policy, str(options.seed), *options.set]).replace("/", "-"))
        given = ("--policy", policy, "--seed", str(options.seed))
        run("train", store, "--out", runs[-1], *given, *settings)
    results = options.results or options.out / "results.jsonl"
    for folder in runs:
        run("rank", folder, later, "--json", folder.with_suffix(".json"))
        about: dict[str, Any] = dict.fromkeys(("suite", "table"), "next-period")
        rows = [
            replace(row, **about, task="kuairand", conditions={"days": days, "k": row["k"]})
            for row in read_results(folder.with_suffix(".json"))
        ]
        append_rows(results, rows)


if __name__ == "__main__":
    main()
