"""Progress without a terminal, in a process of its own, and on one."""

import os
import pty
import re
import subprocess
import sys
import termios

JOB = """
import sys, time
from ucfrec import progress
progress.FIRST_LINE, progress.NEXT_LINE = {first}, 0.05
with progress.progress({total}, "train", "steps", done=5) as bar:
    for step in range(5, 10):
        time.sleep(0.1)
        bar.update(loss=1 / (step + 1))
"""


def lines_of(first: float, total: int | None) -> list[str]:
    """Lines on stderr of a job of half a second."""
    command = [sys.executable, "-c", JOB.format(first=first, total=total)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return ended.stderr.splitlines()


def test_a_log_file_gets_plain_lines_with_rate_and_time_left() -> None:
    lines = lines_of(0.05, 10)
    assert 4 <= len(lines) <= 7
    pattern = r"train:  60% 6/10 \[00:00<00:00, +([\d.]+) steps/s, loss=0.167\]"
    line = re.fullmatch(pattern, lines[0])
    assert line, lines
    assert float(line[1]) <= 10  # 1 step of this start in 0.1 s or more, not 6
    assert lines[-1].startswith("train: 100% 10/10 [")
    assert all(re.match(r"train: [\d.]+ steps \[", line) for line in lines_of(0.05, None))


def test_a_short_job_prints_nothing_without_a_terminal() -> None:
    assert lines_of(30, 10) == []


def test_a_terminal_shows_a_bar() -> None:
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(theirs, (24, 100))
    code = JOB.format(first=30, total=10)
    with subprocess.Popen([sys.executable, "-c", code], stderr=theirs) as process:
        os.close(theirs)
        shown = b""
        try:
            while chunk := os.read(ours, 4096):
                shown += chunk
        except OSError:  # the other end is closed
            pass
        assert process.wait() == 0
    os.close(ours)
    assert b"train: 100%" in shown
    assert b"loss=0.1" in shown
