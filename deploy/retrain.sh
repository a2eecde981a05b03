#!/usr/bin/env bash
# Every day: join what was shown with what was clicked, train on from the current run, and promote
# the new run. `ucfrec promote` refuses a worse one, so that the old one goes on.
set -euo pipefail
cd /srv/ucfrec
day=$(date -u -d yesterday +%F)
shown="shown/exposures-${day//-/}T*.parquet"
ucfrec join "$shown" "clicks/$day.parquet" --within 30m --out "logs/$day.parquet"
ucfrec update runs "logs/$day.parquet" --mapping shop.toml --window 60d --out "runs/$day"
ucfrec report "runs/$day" --out "runs/$day.html"
ucfrec promote "runs/$day"
