"""The record of a store: damage to any entry is one line, or changes nothing that is needed."""

from contextlib import suppress
from pathlib import Path

import pytest

from tests.support.episodes import random_episodes, some_states, write_store
from tests.support.records import DAMAGE, damaged, paths
from ucfrec.commands.cli import main
from ucfrec.episodes.record import Source, StoreRecord
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json, write_json

SOURCE = {
    "files": ["log.parquet"], "session_by": "gap", "session_gap_ms": 1_800_000, "rows_read": 9,
    "duplicates": "first", "dropped": {"duplicate": 1}, "unknown_propensities": 2,
    "time_range_ms": [1_574_553_600_000, 1_575_158_400_000],
    "split_times_ms": [1_575_072_000_000, 1_575_115_200_000],
}  # fmt: skip
NEEDED = {"version", "n_steps", "n_episodes", "n_shards", "columns", "fingerprint",
          "source"}  # fmt: skip


@pytest.fixture
def store(tmp_path: Path) -> Path:
    path = write_store(tmp_path / "store", random_episodes([3, 4, 5]), some_states()).path
    StoreRecord.read(path).copy_with(source=Source.model_validate(SOURCE)).seal(path)
    return path


def test_an_adapters_entries_are_kept(store: Path) -> None:
    source = Source.model_validate({**SOURCE, "env_id": None, "seed": 3})
    StoreRecord.read(store).copy_with(source=source).seal(store)
    assert StoreRecord.read(store).source.others == {"env_id": None, "seed": 3}


@pytest.mark.parametrize("kind", DAMAGE)
def test_every_entry_is_checked(store: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    value = read_json(store / "meta.json")
    for path in paths(value, depth=1):
        damaged(store / "meta.json", value, path, DAMAGE[kind])
        refused = None
        with suppress(InputError):
            EpisodeStore.open(store)
            refused = False
        assert main(["verify", str(store)]) == (0 if refused is False else 2), path
        assert len(capsys.readouterr().err.splitlines()) == (0 if refused is False else 1), path
        if kind in ("huge", "list", "NaN") or (kind == "missing" and path[-1] in NEEDED):
            assert refused is None, path


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("n_shards", 10**12),
        ("n_shards", 2),
        ("n_episodes", 10**12),
        ("columns", {"reward": [], "observation": [10**12]}),
        ("columns", {"reward": [], "../../etc/passwd": []}),
        ("source", {"files": "log.parquet"}),
        ("source", {"time_range_ms": [0, 10**17]}),
    ],
)
def test_what_cannot_be_is_named(store: Path, name: str, value: object) -> None:
    write_json(store / "meta.json", {**read_json(store / "meta.json"), name: value})
    with pytest.raises(InputError, match=rf"meta\.json is damaged: its {name}") as caught:
        EpisodeStore.open(store)
    assert "prepare it again" in str(caught.value)


def test_a_changed_a_newer_and_no_record_are_named(store: Path) -> None:
    path = store / "meta.json"
    changed = path.read_text().replace("log.parquet", "x.parquet")
    for content, says in ((changed, "was changed after"), ('{"version": 99}', "upgrade ucfrec")):
        path.write_text(content)
        with pytest.raises(InputError, match=says):
            EpisodeStore.open(store)
    path.unlink()
    with pytest.raises(InputError, match=r"not an episode store.*meta\.json"):
        EpisodeStore.open(store)
