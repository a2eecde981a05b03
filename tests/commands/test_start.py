"""A command imports what it uses and nothing else; each is started in a process of its own."""

import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from ucfrec.commands.cli import UCFREC

START = 1_700_000_000_000
SLOW_TO_IMPORT = {"torch", "sklearn", "scipy", "pandas", "duckdb", "pyarrow", "gymnasium"}
TRAINING = {f"ucfrec.{room}" for room in ("policies", "counterfactual", "runs", "fitting.loop")}
ACTING = {"gymnasium", "ucfrec.acting", "ucfrec.evaluation"}


def loaded(*arguments: object) -> set[str]:
    """Modules in memory when `ucfrec ARGUMENTS` ends."""
    code = (
        "import sys\n"
        "from ucfrec.commands.cli import main\n"
        "try:\n"
        "    status = main(sys.argv[1:])\n"
        "except SystemExit as end:\n"
        "    status = end.code\n"
        "print('\\n', *sys.modules, file=sys.stderr)\n"
        "sys.exit(status)\n"
    )
    return modules(code, *map(str, arguments))


def modules(code: str, *arguments: str) -> set[str]:
    ended = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == 0, ended.stderr
    return set(ended.stderr.splitlines()[-1].split())


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten rows."""
    path = tmp_path_factory.mktemp("start") / "log.csv"
    rows = range(10)
    frame = pd.DataFrame({"user_id": [i % 3 for i in rows], "item_id": [i % 4 for i in rows]})
    frame["timestamp"] = [START + i * 1000 for i in rows]
    frame["reward"] = [i % 2 for i in rows]
    frame.to_csv(path, index=False)
    return path


@pytest.mark.parametrize("command", sorted(UCFREC.commands))
def test_help_needs_no_slow_import(command: str) -> None:
    assert not loaded(command, "--help") & SLOW_TO_IMPORT


def test_checking_a_log_needs_neither_torch_nor_pandas(log: Path) -> None:
    found = loaded("prepare", log, "--validate")
    assert not found & (SLOW_TO_IMPORT - {"duckdb", "pyarrow"} | TRAINING | ACTING)


def test_preparing_a_log_needs_neither_torch_nor_pandas(log: Path, tmp_path: Path) -> None:
    found = loaded("prepare", log, "--out", tmp_path / "store")
    assert not found & (SLOW_TO_IMPORT - {"duckdb", "pyarrow", "scipy"} | TRAINING | ACTING)


def test_collecting_needs_no_training_code(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    found = loaded("collect", "--env", "synthetic-catalog", "--sessions", 5, "--out", logs)
    assert not found & (TRAINING | {"sklearn", "duckdb"})


@pytest.mark.parametrize(
    ("module", "needed"),
    [
        ("ucfrec.runs.trained_policy", {"torch", "pyarrow"}),
        ("ucfrec.runs.run", {"torch", "pyarrow"}),
        ("ucfrec.off_policy.evaluate", {"torch", "pyarrow", "duckdb", "pandas", "scipy"}),
        ("ucfrec.recommending.recommend", {"torch", "pyarrow", "pandas", "duckdb"}),
    ],
)
def test_what_works_on_a_run_imports_what_it_uses(module: str, needed: set[str]) -> None:
    found = modules(f"import sys, {module}\nprint('', *sys.modules, file=sys.stderr)")
    assert found & SLOW_TO_IMPORT <= needed
