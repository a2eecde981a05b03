"""Runs `tests.support.killed_loop` in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def kills(work: str, folder: Path) -> int:
    """How many processes of some work were killed before it was done."""
    command = [sys.executable, ROOT / "tests" / "support" / "killed_loop.py", work, folder]
    env = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    ended = subprocess.run(command, env=env, capture_output=True, text=True, timeout=900)
    assert ended.returncode == 0, ended.stderr
    return int(ended.stdout.split()[-1])
