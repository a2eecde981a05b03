"""A command imports what it uses and nothing else; seen in processes of its own."""

import json
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


def loaded(*lines: tuple[object, ...]) -> list[set[str]]:
    """Modules in memory when `ucfrec LINE` ends, for each line in turn, in one process."""
    code = (
        "import json, sys\n"
        "from ucfrec.commands.cli import main\n"
        "for line in json.loads(sys.argv[1]):\n"
        "    try:\n"
        "        status = main(line)\n"
        "    except SystemExit as end:\n"
        "        status = end.code\n"
        "    assert status == 0\n"
        "    print('\\n', *sys.modules, file=sys.stderr)\n"
    )
    return modules(code, json.dumps([[*map(str, line)] for line in lines]))


def modules(code: str, *arguments: str) -> list[set[str]]:
    """Modules in memory, as code prints them in lines that begin with a blank."""
    ended = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == 0, ended.stderr
    return [{*line.split()} for line in ended.stderr.splitlines() if line.startswith(" ")]


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


def test_help_needs_no_slow_import() -> None:
    found = loaded(*((command, "--help") for command in UCFREC.commands))
    assert len(found) == len(UCFREC.commands)
    assert not found[-1] & SLOW_TO_IMPORT


def test_preparing_needs_neither_torch_nor_pandas(log: Path, tmp_path: Path) -> None:
    checked, prepared = loaded(
        ("prepare", log, "--validate"), ("prepare", log, "--out", tmp_path / "store")
    )
    unused = SLOW_TO_IMPORT - {"duckdb", "pyarrow"} | TRAINING | ACTING
    assert not checked & unused
    assert not prepared & (unused - {"scipy"})


def test_collecting_needs_no_training_code(tmp_path: Path) -> None:
    out = tmp_path / "logs"
    (found,) = loaded(("collect", "--env", "synthetic-catalog", "--sessions", 5, "--out", out))
    assert not found & (TRAINING | {"sklearn", "duckdb"})


USED = {
    "ucfrec.runs.trained_policy": {"torch", "pyarrow"},
    "ucfrec.runs.run": {"torch", "pyarrow"},
    "ucfrec.recommending.recommend": {"torch", "pyarrow", "pandas", "duckdb"},
    "ucfrec.off_policy.evaluate": {"torch", "pyarrow", "pandas", "duckdb", "scipy"},
}
"""Modules in an order in which each uses what those before it use."""


def test_what_works_on_a_run_imports_what_it_uses() -> None:
    code = "import importlib, sys\nfor name in sys.argv[1:]:\n    importlib.import_module(name)\n"
    found = modules(code + "    print('', *sys.modules, file=sys.stderr)\n", *USED)
    assert len(found) == len(USED)
    for each, used in zip(found, USED.values(), strict=True):
        assert each & SLOW_TO_IMPORT <= used | {"pydantic"}


def test_weights_are_loaded_without_the_compiler() -> None:
    code = (
        "import sys\n"
        "from pathlib import Path\n"
        "import torch\n"
        "from ucfrec.episodes.exposure import ExposureTerm, Likeness\n"
        "from ucfrec.fitting.checkpoint import load_module\n"
        "from ucfrec.policies.base import embedding\n"
        "def build():\n"
        "    return torch.nn.ModuleList(\n"
        "        [embedding(3, 2), ExposureTerm(2, 3, Likeness(3, 2, 0))])\n"
        "load_module(Path('weights'), build, build().state_dict())\n"
        "print('', *sys.modules, file=sys.stderr)\n"
    )
    (found,) = modules(code)
    assert not found & {"torch._dynamo", "sympy", "scipy.stats", "boto3"}
