"""What no command can use is refused on one line before anything is done."""

from pathlib import Path

import pytest

from tests.support.control_files import hopper_like, refused, write_hdf5

ZOO_FILE = "hopper_medium-zoo"


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("prepare nowhere.hdf5 --out s", "nowhere.hdf5 does not exist"),
        ("prepare . --out s", ". is not an HDF5 file"),
        ("prepare mujoco/hopper/expert-v9 --out s", "--download"),
        ("screen store --seed -1", "-1 is not a whole number from 0 to 4294967295"),
        ("distract store --out out --seed 4294967296", "4294967296 is not a whole number"),
        ("train nowhere --out run", "nowhere is not an episode store"),
        ("train store --out run --policy popular", "invalid choice: 'popular'"),
        ("train {store} --out {run} --policy dt --screen drop", "without --screen"),
        ("train {store} --out run --env Hopper-v5", "--env is for --select-by-return"),
        ("train {store} --out run --select-by-return 1 --env No-v1", "No-v1 cannot be made"),
        ("evaluate nowhere", "nowhere is not a run folder"),
        ("evaluate run --target abc", "abc is not a finite number"),
        ("evaluate run --distractor nan", "nan is not a finite number"),
        ("evaluate {run} --env Nope-v1", "Nope-v1 cannot be made"),
        ("evaluate {run} --env Walker2d-v5", "sizes (17, 6)"),
        ("evaluate {run} --episodes 1", "of Hopper-v5 has not ended after 3 steps"),
        ("evaluate {run} --episodes 0", "--episodes: 0 is not"),
        ("collect --env Hopper-v5 --out out --agent a.zip --noise nan", "give at least 0"),
        ("collect --env Nowhere-v0 --out out --agent a.zip", "Nowhere-v0 cannot be made"),
        ("benchmark --method nope", "no method is called nope; there are bc, bc-10"),
        ("benchmark --seeds 0", "--seeds: 0 is not"),
        ("benchmark --context nope=8", "nope=8 is not METHOD=STEPS"),
        ("benchmark --file nowhere", "nowhere.hdf5 does not exist"),
        ("benchmark --results rows.jsonl", "rows.jsonl, line 1 is not a result row"),
        ("figures --out out", "name runs with --runs, or"),
        ("figures --out out --results no.jsonl", "check the path"),
        ("figures --out out --results {}.json", "{}.json holds no list of result rows"),
        ("figures --out out --results [1].json", "[1].json, row 1 is not a result row"),
    ],
)
def test_what_cannot_be_used_is_refused(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ucfrec_control.environments.environments._LONGEST", 3)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    paths = {"{run}": folder / "store-run", "{store}": folder / "store"}
    given = [str(paths.get(word, word)) for word in command.split()]
    for content in ("{}", "[1]"):
        Path(f"{content}.json").write_text(content)
    if given[0] == "benchmark":
        Path("data").mkdir()
        Path("rows.jsonl").write_text("no row\n")
        write_hdf5(Path("data", f"{ZOO_FILE}.hdf5"), hopper_like((30, 8, 25)))
        given += ["--data", "data", "--out", "out"]
        given += ["--file", ZOO_FILE] if "--file" not in given else []
    assert says in refused(*given)
