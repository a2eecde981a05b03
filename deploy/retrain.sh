#!/usr/bin/env bash
# Every day: join what was shown with what was clicked, train on from the current run, and promote
# the new run. `ucfrec promote` refuses a worse one, so that the old one goes on.
set -euo pipefail
cd /srv/ucfrec
day=$(date -u -d yesterday +%F)
new="runs/$day"
shown="shown/exposures-${day//-/}T*.parquet"
clicks=("clicks/$day.parquet")
# What was shown before midnight is clicked after it, too.
next="clicks/$(date -u -d "$day + 1 day" +%F).parquet"
[ -e "$next" ] && clicks+=("$next")
ucfrec join "$shown" "${clicks[@]}" --within 30m --out "logs/$day.parquet"
# After a refusal there are the logs of several days.
mapfile -t logs < <(find logs -name '????-??-??.parquet' -newer runs/promoted.json | sort)
ucfrec update runs "${logs[@]}" --mapping shop.toml --window 60d --out "$new"
ucfrec report "$new" --out "$new.html"
ucfrec promote "$new"
