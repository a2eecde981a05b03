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
print("tqdm" in sys.modules)
"""


def played(first: float, total: int | None) -> tuple[list[str], str]:
    """Lines on stderr of a job of half a second, and what it printed."""
    code = JOB.format(first=first, total=total)
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    return ended.stderr.splitlines(), ended.stdout.strip()


def test_a_log_file_gets_plain_lines_with_rate_and_time_left() -> None:
    lines, imported_tqdm = played(0.05, 10)
    assert imported_tqdm == "False"
    assert len(lines) == 6
    line = re.fullmatch(
        r"train: 7 of 10 steps \(70%\), ([\d.]+) steps/s, \d s left, loss 0.1429", lines[1]
    )
    assert line
    assert 1 < float(line[1]) <= 10  # 2 steps of this start in 0.2 s or more, not 7
    assert re.fullmatch(r"train: 10 steps done, \d s", lines[-1])


def test_an_unknown_total_leaves_out_what_depends_on_it() -> None:
    lines, _ = played(0.05, None)
    assert re.fullmatch(r"train: 6 steps, [\d.]+ steps/s, loss 0.1667", lines[0])


def test_a_short_job_prints_nothing_without_a_terminal() -> None:
    assert played(30, 10) == ([], "False")


def test_slow_rates_and_long_times_are_readable() -> None:
    from ucfrec.progress import _duration, _rate

    assert _rate(1234.5, "rows") == "1,234 rows/s"
    assert _rate(0.05, "policies") == "3 policies/min"
    assert _rate(0.0005, "policies") == "1.8 policies/h"
    assert [_duration(s) for s in (0.2, 200, 18_750)] == ["0 s", "3 min 20 s", "5 h 12 min"]


def test_a_terminal_shows_a_bar() -> None:
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(theirs, (24, 100))
    code = JOB.format(first=30, total=10)
    with subprocess.Popen([sys.executable, "-c", code], stderr=theirs, stdout=-1) as process:
        os.close(theirs)
        shown = b""
        while True:
            try:
                chunk = os.read(ours, 4096)
            except OSError:
                break
            if not chunk:
                break
            shown += chunk
        assert process.communicate()[0].strip() == b"True"
    os.close(ours)
    assert b"train: 100%" in shown
    assert b"loss=0.1" in shown
