"""MovieLens: files generated in the form of the releases, and the 100K archive in its own form."""

import hashlib
import io
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import ucfrec_datasets
from ucfrec import EpisodeStore, Recommender
from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import prepare
from ucfrec_datasets import movielens
from ucfrec_datasets.movielens import DATASET, GENRES

SMALL = {"train.steps": 3, "policy.dim": 8, "rule.choose": False}
RNG = np.random.default_rng(0)
RATINGS = pd.DataFrame({"userId": np.repeat(np.arange(1, 31), 10)})
RATINGS["movieId"], RATINGS["rating"] = RNG.integers(1, 41, 300), RNG.integers(1, 6, 300)
RATINGS["timestamp"] = 880_000_000 + RNG.permutation(300) * 60
RATINGS = RATINGS.drop_duplicates(["userId", "movieId"])


def test_a_folder_has_ratings_and_genres(tmp_path: Path) -> None:
    folder = tmp_path / "ml-latest-small"
    folder.mkdir()
    RATINGS.to_csv(folder / "ratings.csv", index=False)
    movies = pd.DataFrame({"movieId": range(1, 41), "title": "A, B (1995)", "genres": "Drama|War"})
    movies.to_csv(folder / "movies.csv", index=False)
    pd.DataFrame({"userId": [1], "movieId": [1], "tag": ["x"]}).to_csv(folder / "tags.csv")
    files, mapping = DATASET.resolve([folder], LogMapping())
    assert [file.name for file in files] == ["ratings.csv"]
    report = prepare(files, mapping, tmp_path / "store")
    assert report["steps"] == len(RATINGS)
    store = EpisodeStore.open(tmp_path / "store")
    assert store.item_states.tags.shape[1] >= 2
    frame = store.to_frame()
    assert frame.timestamp.min() == RATINGS.timestamp.min() * 1000
    assert set(frame.reward) == {1, 2, 3, 4, 5}
    with pytest.raises(InputError, match="no log among"):
        DATASET.resolve([folder / "movies.csv"], LogMapping())


def official_100k() -> bytes:
    """The archive of the 100K release, made up."""
    data = RATINGS.to_csv(sep="\t", header=False, index=False)
    flags = ["|".join("1" if g in (n % 19, 5) else "0" for g in range(19)) for n in range(1, 41)]
    items = [f"{n}|Café {n} (1995)|01-Jan-1995||http://x|{f}" for n, f in enumerate(flags, 1)]
    users = [f"{n}|{20 + n}|{'MF'[n % 2]}|student|00000" for n in range(1, 31)]
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as content:
        content.writestr("ml-100k/u.data", data)
        content.writestr("ml-100k/u.item", "\n".join(items).encode("latin-1"))
        content.writestr("ml-100k/u.user", "\n".join(users))
    return file.getvalue()


def test_one_call_trains_on_the_100k_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    content = official_100k()
    release = DATASET.releases["movielens-100k"]
    checksum = f"md5:{hashlib.md5(content).hexdigest()}"
    changed = replace(DATASET, releases={"movielens-100k": replace(release, checksum=checksum)})
    (tmp_path / "ml-100k.zip").write_bytes(content)
    with pytest.raises(InputError, match=r"ml-100k\.zip has md5 .*, the release 0e33842e24a9c977"):
        ucfrec_datasets.load("movielens-100k", tmp_path)
    monkeypatch.setattr(movielens, "DATASET", changed)
    logs = ucfrec_datasets.load("movielens-100k", tmp_path)
    assert main(["datasets", "movielens-100k", "--folder", str(tmp_path)]) == 0
    assert f"movielens-100k: {len(logs.files)} log files" in capsys.readouterr().out
    movies = pd.read_csv(logs.files[0].with_name("movies.csv"))
    assert movies.title[2] == "Café 3 (1995)"
    assert movies.genres[2] == f"{GENRES[3]}|{GENRES[5]}"
    policy = Recommender("dt", settings=SMALL).fit(logs, tmp_path / "run")
    assert policy.trained.record.data.dataset == "movielens"
    assert policy.trained.item_states.user_features.shape[1] > 3  # age, gender, occupation
    assert len(policy.rank(logs, k=3)) > 3


def test_every_release_is_found_and_documented() -> None:
    text = (Path(__file__).parents[2] / "docs" / "datasets.md").read_text(encoding="utf-8")
    for name in ("kuairand-pure", "kuairec", "open-bandit", "movielens-100k"):
        with pytest.raises(InputError, match="has no part 'none'"):
            ucfrec_datasets.load(name, "unused", "none")
        assert f"`{name}`" in text
    with pytest.raises(InputError, match="no data set is called 'netflix'"):
        ucfrec_datasets.load("netflix", "unused")
