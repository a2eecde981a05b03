"""MovieLens (Harper & Konstan, 2015): ratings of movies, `ratings.csv` and `movies.csv`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from ucfrec.logs.mapping import Dataset, LogMapping, Release
from ucfrec_datasets.generic import Resolved, official_files, official_table

RATINGS, MOVIES, USERS = "ratings", "movies", "users"
GENRES: Final = (
    *("unknown", "Action", "Adventure", "Animation", "Children", "Comedy", "Crime", "Documentary"),
    *("Drama", "Fantasy", "Film-Noir", "Horror", "Musical", "Mystery", "Romance", "Sci-Fi"),
    *("Thriller", "War", "Western"),
)
"""Of the 100K release, in the order of its columns."""
MOVIE_COLUMNS: Final = ("string_split(genres, '|')",)
USER_COLUMNS: Final = ("age", "gender", "occupation")

MAPPING: Final = LogMapping(
    columns={"user_id": "userId", "item_id": "movieId", "timestamp": "timestamp * 1000"},
    reward="rating",
    # Users rate many movies in one visit, at the pace of clicks, and most of them visit once.
    session_by="user",
    earliest="1995-01-01",
)


def _resolve(paths: Sequence[str | Path], mapping: LogMapping) -> Resolved:
    """The ratings, with genres and users of the same paths or of the ratings' folder."""
    logs, files = official_files(paths, RATINGS, (MOVIES, USERS))
    defaults = LogMapping(
        item_features=official_table(files, MOVIES, "movieId", MOVIE_COLUMNS),
        user_features=official_table(files, USERS, "userId", USER_COLUMNS),
    )
    return logs, mapping.over(defaults).over(MAPPING)


def _convert_100k(folder: Path) -> None:
    """Write `u.data` (tabs), `u.item` and `u.user` (bars, Latin-1) as later releases have them."""
    import pandas as pd

    source = folder / "ml-100k"
    ratings = pd.read_csv(source / "u.data", sep="\t", header=None).iloc[:, :4]
    ratings.columns = pd.Index(["userId", "movieId", "rating", "timestamp"])
    ratings.to_csv(source / f"{RATINGS}.csv", index=False)
    layout: dict[str, Any] = {"sep": "|", "header": None, "encoding": "latin-1", "quoting": 3}
    movies = pd.read_csv(source / "u.item", dtype=str, **layout)
    flags = movies.iloc[:, 5:].eq("1").to_numpy()
    movies["genres"] = [
        "|".join(g for g, flag in zip(GENRES, f, strict=True) if flag) for f in flags
    ]
    movies = movies[[0, 1, "genres"]].set_axis(["movieId", "title", "genres"], axis=1)
    movies.to_csv(source / f"{MOVIES}.csv", index=False)
    users = pd.read_csv(source / "u.user", dtype=str, **layout).iloc[:, :4]
    users.set_axis(["userId", *USER_COLUMNS], axis=1).to_csv(source / f"{USERS}.csv", index=False)


DATASET: Final = Dataset(
    summary="MovieLens: a folder with ratings.csv and movies.csv, or files of it",
    resolve=_resolve,
    releases={
        "movielens-100k": Release(
            url="https://files.grouplens.org/datasets/movielens/ml-100k.zip",
            homepage="https://grouplens.org/datasets/movielens/100k/",
            licence="research only, no redistribution (README of the archive)",
            checksum="md5:0e33842e24a9c977be4e0107933c0723",
            size=4_924_029,
            parts={"all": "ml-100k"},
            convert=_convert_100k,
        )
    },
)
