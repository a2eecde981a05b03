"""Simulate the log of a service where people rate new films, and tastes move with the releases.

    python examples/make_ratings_log.py films

writes to the folder `films`:

- `ratings.parquet`: `user`, `film`, `rating` from 1 to 10 and `rated_at`;
- `films.csv`: `film` and `genre`.

Every user rates a film once. Films come out all the time: interest in one halves every week,
down to a rest that lasts, and who has rated one part of a series soon rates the next.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

GENRES, DAYS, USERS, FILMS, RATINGS = 12, 160, 6_000, 2_000, 60_000
START = pd.Timestamp("2026-05-01", tz="UTC")


def make_log(folder: Path, seed: int = 0, drift: bool = True) -> pd.DataFrame:
    """Write the log to a folder and return its ratings; without `drift`, all films are old."""
    rng = np.random.default_rng(seed)
    genre = rng.integers(GENRES, size=FILMS)
    appeal = rng.gumbel(0, 0.9, FILMS)
    released = np.where(rng.random(FILMS) < 0.6, -1e3, rng.uniform(-20, DAYS, FILMS))
    if not drift:
        released[:] = -1e3
    sequel = np.full(FILMS, -1)  # of the same genre, the next in order of release
    for number in range(GENRES):
        films = np.flatnonzero(genre == number)[np.argsort(released[genre == number])]
        sequel[films[:-1]] = np.where(rng.random(len(films) - 1) < 0.5, films[1:], -1)
    taste = 2.0 * rng.normal(0, 1, (USERS, GENRES))
    # Each user comes a few times within some months.
    begins, activity = rng.uniform(-60, DAYS, USERS), rng.gamma(0.7, 1.0, USERS) + 0.1
    users = rng.choice(USERS, size=3 * RATINGS, p=activity / activity.sum())
    visits = (
        begins[users] + rng.exponential(40, len(users)).round() + rng.uniform(0, 0.1, len(users))
    )
    inside = np.flatnonzero((visits >= 0) & (visits < DAYS))[:RATINGS]
    inside = inside[np.argsort(visits[inside])]
    seen: dict[int, set[int]] = {}
    last: dict[int, int] = {}
    rows = []
    for user, day in zip(users[inside].tolist(), visits[inside].tolist(), strict=True):
        age = np.where(released > day, np.inf, day - released)
        fresh = np.where(np.isfinite(age), 0.04 + np.exp2(-np.minimum(age, 1e3) / 7), 0.0)
        scores = (
            np.log(np.maximum(fresh, 1e-30)) + appeal + taste[user, genre] + rng.gumbel(size=FILMS)
        )
        following = sequel[last[user]] if user in last else -1
        if following >= 0 and fresh[following]:
            scores[following] += 6.0
        known = seen.setdefault(user, set())
        scores[list(known)] = -np.inf
        film = int(np.argmax(scores))
        known.add(film)
        last[user] = film
        liking = 4.5 + 0.7 * appeal[film] + 0.4 * taste[user, genre[film]] + rng.normal(0, 1.2)
        rows.append((user, film, int(np.clip(round(liking), 1, 10)), day))
    log = pd.DataFrame(rows, columns=["user", "film", "rating", "day"])
    log["rated_at"] = (START + pd.to_timedelta(log.pop("day"), "D")).dt.round("s")
    folder.mkdir(parents=True, exist_ok=True)
    log.to_parquet(folder / "ratings.parquet", index=False)
    columns = {"film": range(FILMS), "genre": [f"genre {number}" for number in genre]}
    pd.DataFrame(columns).to_csv(folder / "films.csv", index=False)
    return log


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write a simulated log of ratings.")
    parser.add_argument("folder", type=Path, nargs="?", default=Path("films"))
    make_log(target := parser.parse_args().folder)
    for file in sorted(target.iterdir()):
        print(f"{file}: {file.stat().st_size / 1e6:.1f} MB")
