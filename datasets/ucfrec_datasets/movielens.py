"""MovieLens (Harper & Konstan, 2015): ratings of movies, `ratings.csv` and `movies.csv`."""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from ucfrec.errors import InputError
from ucfrec.logs.mapping import Dataset, FeatureTable, LogMapping, Release, log_files

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


def _resolve(paths: Sequence[str | Path], given: LogMapping) -> tuple[tuple[Path, ...], LogMapping]:
    """The ratings, with genres and users of the same paths or of the ratings' folder."""
    named = log_files(paths)
    folders = [Path(path) for path in paths if Path(path).is_dir()]
    logs = tuple(
        file
        for file in named
        if _stem(file) == RATINGS
        or (_stem(file) not in (MOVIES, USERS) and file.parent not in folders)
    )
    if not logs:
        raise InputError(
            f"no MovieLens ratings among {len(named)} file(s) such as {named[0]}; name a folder "
            f"or file with {RATINGS}.csv"
        )
    candidates = (*named, *log_files([logs[0].parent]))
    defaults = LogMapping(
        item_features=_table(candidates, MOVIES, "movieId", MOVIE_COLUMNS),
        user_features=_table(candidates, USERS, "userId", USER_COLUMNS),
    )
    return logs, given.over(defaults).over(MAPPING)


def _stem(file: Path) -> str:
    return file.name.partition(".")[0]


def _table(
    files: Sequence[Path], name: str, key: str, columns: tuple[str, ...]
) -> tuple[FeatureTable, ...]:
    found = next((file for file in files if _stem(file) == name), None)
    return () if found is None else (FeatureTable((found,), key, columns),)


def _convert_100k(folder: Path) -> None:
    """Write the files of the 100K release in the form of the later ones.

    They are `u.data` (tabs), `u.item` and `u.user` (bars, Latin-1), without heads.
    """
    source = folder / "ml-100k"
    ratings = (row[:4] for row in _rows(source / "u.data", "\t"))
    _write(source / f"{RATINGS}.csv", ("userId", "movieId", "rating", "timestamp"), ratings)
    movies = ((row[0], row[1], _genres(row[5:])) for row in _rows(source / "u.item", "|"))
    _write(source / f"{MOVIES}.csv", ("movieId", "title", "genres"), movies)
    users = (row[:4] for row in _rows(source / "u.user", "|"))
    _write(source / f"{USERS}.csv", ("userId", *USER_COLUMNS), users)


def _genres(flags: Sequence[str]) -> str:
    return "|".join(genre for genre, flag in zip(GENRES, flags, strict=True) if flag == "1")


def _rows(file: Path, separator: str) -> Iterator[list[str]]:
    with file.open(encoding="latin-1", newline="") as lines:
        yield from csv.reader(lines, delimiter=separator, quoting=csv.QUOTE_NONE)


def _write(file: Path, head: Sequence[str], rows: Iterator[Sequence[str]]) -> None:
    with file.open("w", encoding="utf-8", newline="") as lines:
        writer = csv.writer(lines)
        writer.writerow(head)
        writer.writerows(rows)


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
