"""Values of options that no command can use are refused before anything is done."""

from pathlib import Path

import pytest

from tests.support.control_files import hopper_like, write_hdf5
from ucfrec_control.cli import main

FILE = "hopper_medium-zoo"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A folder with one file of the benchmark."""
    folder = tmp_path / "data"
    folder.mkdir()
    write_hdf5(folder / f"{FILE}.hdf5", hopper_like((30, 8, 25) * 8))
    return folder


@pytest.mark.parametrize("seed", ["-1", "4294967296", "1.5", "9" * 5000])
@pytest.mark.parametrize(
    "command",
    [
        ["evaluate", "run", "--seed"],
        ["distract", "store", "--out", "out", "--seed"],
        ["screen", "store", "--seed"],
        ["collect", "--env", "Hopper-v5", "--out", "out", "--seed"],
        ["benchmark", "--data", "data", "--evaluation-seed"],
    ],
)
def test_seeds_that_are_none_are_refused(
    command: list[str], seed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*command, seed])
    assert ended.value.code == 2
    assert "not a whole number from 0 to 4294967295" in capsys.readouterr().err


@pytest.mark.parametrize("workers", ["0", "-3"])
def test_a_benchmark_needs_a_worker(
    data: Path, tmp_path: Path, workers: str, capsys: pytest.CaptureFixture[str]
) -> None:
    cells = ["--file", FILE, "--method", "bc", "--seeds", "1", "--out", str(tmp_path / "out")]
    assert main(["benchmark", "--data", str(data), *cells, "--workers", workers]) == 2
    assert f"--workers is {workers}; at least one" in capsys.readouterr().err


@pytest.mark.parametrize("noise", ["nan", "inf", "-1"])
def test_noise_is_a_finite_number(
    tmp_path: Path, noise: str, capsys: pytest.CaptureFixture[str]
) -> None:
    agent = ["--agent", "agent.zip", "--env", "Hopper-v5", "--out", str(tmp_path / "out")]
    assert main(["collect", *agent, "--noise", noise]) == 2
    assert "give at least 0" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["evaluate", "run", "--target", "abc"], "abc is no target; give a number or max"),
        (["evaluate", "run", "--target", "nan"], "nan is no target; give a number or max"),
        (["train", "store", "--out", "run", "--policy", "popular"], "invalid choice: 'popular'"),
    ],
)
def test_wrong_values_are_named(
    arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert says in capsys.readouterr().err
