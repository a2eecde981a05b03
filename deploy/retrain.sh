#!/usr/bin/env bash
# Train on all logs but the latest day, and estimate old and new on that day. Promotes nothing:
# read the verdict, then point /srv/ucfrec/current at the new run.
set -euo pipefail
cd /srv/ucfrec
today=$(date -u +%F)
latest=$(find logs -name '*.parquet' | sort | tail -n 1)
find logs -name '*.parquet' | sort | head -n -1 > "runs/$today.logs"
mapfile -t training < "runs/$today.logs"
ucfrec prepare "${training[@]}" --mapping shop.toml --out "stores/$today"
ucfrec train "stores/$today" --out "runs/$today" --config train.toml
ucfrec ope current "runs/$today" "$latest" --mapping shop.toml --json "runs/$today-ope.json"
ucfrec report "runs/$today" --results "runs/$today-ope.json" --out "runs/$today.html"
