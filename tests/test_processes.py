"""Processes end with one line when interrupted, and with their parent; random states are kept."""

import os
import platform
import pty
import random
import re
import resource
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tests.support.episodes import random_episodes, write_store
from tests.support.signals import wait_until_handled
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.evaluation.collect import collect_store
from ucfrec.evaluation.evaluate import evaluate_behavior, evaluate_policy
from ucfrec.evaluation.simulator import Environment
from ucfrec.fitting.loop import LoopConfig, fit
from ucfrec.processes import Interrupted, interruptions_raised
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.start import new_policy
from ucfrec.runs.trained_policy import TrainedPolicy

CHILDREN = """
import os, sys, time
from pathlib import Path
from ucfrec.processes import pool_of_processes, block_ctrl_c
def work(folder):
    (Path(folder) / str(os.getpid())).write_text("")
    time.sleep(60)
if __name__ == "__main__":
    with pool_of_processes(2) as pool:
        with block_ctrl_c():
            waiting = [pool.submit(work, sys.argv[1]) for _ in range(2)]
        [each.result() for each in waiting]
"""


ASCII = {"PYTHONIOENCODING": "ascii"}
C_LOCALE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.mark.parametrize(
    ("terminal", "arguments", "status", "said"),
    [
        (ASCII, ["ucfrec", "settings", "--policy", "ucf"], 0, b"?"),
        (C_LOCALE, ["ucfrec", "prepare", "--help-all"], 0, b"s3://, ?"),
        (ASCII, ["ucfrec", "prepare", "caf\u00e9-\u4e2d.csv", "--validate"], 2, b"does not exist"),
        (C_LOCALE, ["ucfrec", "prepare", os.fsdecode(b"\xff.csv"), "--validate"], 2, b".csv"),
    ],
)
def test_a_terminal_without_unicode_gets_replacement_characters(
    terminal: dict[str, str], arguments: list[str], status: int, said: bytes
) -> None:
    command = [sys.executable, "-m", *map(os.fsencode, arguments)]
    ended = subprocess.run(command, env=os.environ | terminal, capture_output=True, timeout=120)
    assert ended.returncode == status, ended.stderr
    assert said in ended.stdout + ended.stderr
    assert (ended.stdout + ended.stderr).isascii()


def ended(process: int, seconds: float = 20) -> bool:
    """Whether a process ends in time; one that no process has waited for yet counts as ended."""
    until = time.monotonic() + seconds
    with suppress(OSError):
        while Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z":
            if time.monotonic() > until:
                return False
            time.sleep(0.05)
    return True


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_children_end_with_their_parent(tmp_path: Path, number: signal.Signals) -> None:
    (tmp_path / "script.py").write_text(CHILDREN)
    (tmp_path / "marks").mkdir()
    script = [sys.executable, str(tmp_path / "script.py"), str(tmp_path / "marks")]
    parent = subprocess.Popen(script, stderr=subprocess.DEVNULL)
    until = time.monotonic() + 60
    while len(children := list((tmp_path / "marks").iterdir())) < 2:
        assert time.monotonic() < until
        time.sleep(0.05)
    parent.send_signal(number)
    parent.wait(20)
    assert all(ended(int(child.name)) for child in children)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_whatever_an_interruption_causes_is_an_interruption(number: signal.Signals) -> None:
    def work() -> None:
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt:
            raise ImportError("a library that an interruption broke") from None

    before = signal.getsignal(number)
    with pytest.raises(Interrupted) as caught, interruptions_raised():
        work()
    assert caught.value.status == 128 + number
    assert signal.getsignal(number) is before


def test_an_interruption_that_a_callback_swallows_comes_again_and_other_errors_pass() -> None:
    with pytest.raises(ValueError, match="mine"), interruptions_raised():
        raise ValueError("mine")

    class Swallows:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    def work() -> None:
        Swallows()
        for _ in range(100):
            time.sleep(0.05)

    with pytest.raises(Interrupted), interruptions_raised():
        work()


@pytest.mark.parametrize(
    ("number", "moments"), [(signal.SIGINT, (0.0, 0.8)), (signal.SIGTERM, (0.3,))]
)
def test_a_command_interrupted_while_it_starts_prints_one_line(
    tmp_path: Path, number: signal.Signals, moments: tuple[float, ...]
) -> None:
    """The signals come once TERM has a handler, which is the first thing that ucfrec does."""
    log = tmp_path / "log.csv"
    rows = "".join(f"{i % 5},{i % 7},{1_700_000_000_000 + i},{i % 2}\n" for i in range(500))
    log.write_text("user_id,item_id,timestamp,reward\n" + rows)
    command = [sys.executable, "-m", "ucfrec", "prepare", str(log), "--out", str(tmp_path / "out")]
    for moment in moments:
        running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ)
        wait_until_handled(running.pid, signal.SIGTERM)
        time.sleep(moment)
        running.send_signal(number)
        _, printed = running.communicate(timeout=60)
        if running.returncode == 0:
            break
        assert running.returncode == 128 + number, printed
        assert printed.endswith("interrupted\n") or ": interrupted" in printed
        assert len(printed.splitlines()) == 1, printed
    assert {path.name for path in tmp_path.iterdir()} <= {"log.csv", "out"}


def test_without_memory_linear_algebra_is_refused() -> None:
    script = """
import resource
from pathlib import Path
from ucfrec.processes import require_blas_memory
require_blas_memory()
now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (now + 20 * 2**20,) * 2)
try:
    require_blas_memory()
except MemoryError as error:
    print(error)
"""
    if not Path("/proc/self/statm").exists():
        pytest.skip("the address space is measured in /proc")
    end = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert end.stdout == "no 128 MB for linear algebra\n"


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="asks glibc")
def test_large_arrays_have_the_memory_of_earlier_ones() -> None:
    code = (
        "from ucfrec.processes import keep_freed_memory; keep_freed_memory(); import resource; "
        "any(not b'x' * 10**8 for _ in range(20)); print(resource.getrusage(0).ru_minflt)"
    )
    faults = int(subprocess.check_output([sys.executable, "-c", code]))
    assert faults < 2 * 10**8 / resource.getpagesize()


@contextmanager
def unnoticed(seed: int = 5) -> Iterator[None]:
    """All three global generators are as they were before."""

    def drawn() -> tuple[float, ...]:
        return random.random(), float(np.random.random()), float(torch.rand(()))  # noqa: NPY002

    def start() -> None:
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        torch.manual_seed(seed)

    start()
    expected = drawn()
    start()
    yield
    assert drawn() == expected


def test_the_loop_keeps_the_state_when_it_raises_too(tmp_path: Path) -> None:
    module = nn.Linear(2, 1)

    def loss(rate: float) -> tuple[Tensor, dict[str, Tensor]]:
        value = nn.functional.dropout(module(torch.ones(1, 2))).square().mean() * rate
        return value + float(np.random.random() + random.random()), {}  # noqa: NPY002

    for number, rate in enumerate((0.1, float("nan"))):
        with unnoticed(), suppress(InputError):
            config = LoopConfig(steps=4, validate_every=2)
            fit(module, lambda _: rate, loss, config, tmp_path / str(number), seed=1)  # noqa: B023


@pytest.mark.parametrize("name", ["ucf", "dt", "edt4rec"])
def test_a_run_neither_moves_the_callers_state_nor_depends_on_it(tmp_path: Path, name: str) -> None:
    store, weights = write_store(tmp_path / "store", random_episodes([6] * 50, items=False)), []
    quick = {"policy.cql_steps": 3} if name == "edt4rec" else {}
    quick |= {"augment.copies": 1} if name == "ucf" else {}
    size = {"train.steps": 4, "policy.dim": 16, "policy.context": 3, "crm.epochs": 1, **quick}
    config = resolve_config(name, None, size)
    for seed in (1, 2):
        with unnoticed(seed):
            new_policy(store, config)
            train_run(store, tmp_path / str(seed), config)
            weights.append(TrainedPolicy.load(tmp_path / str(seed)).policy.state_dict())
    assert all(torch.equal(tensor, weights[1][key]) for key, tensor in weights[0].items())


def test_collecting_and_evaluating(tmp_path: Path) -> None:
    at = Environment("synthetic-catalog")
    with unnoticed():
        collect_store(at, tmp_path, 60, 0)
    config = resolve_config("bc", None, {"train.steps": 2, "policy.dim": 8})
    train_run(EpisodeStore.open(tmp_path / "store"), tmp_path / "run", config)
    trained = TrainedPolicy.load(tmp_path / "run")
    with unnoticed():
        evaluate_policy(at, trained, "bc", 20, 0)
        evaluate_behavior(at, "mixture", 20, 0)


JOB = """
import sys, time
from ucfrec import processes
processes.FIRST_LINE, processes.NEXT_LINE = {first}, 0.05
with processes.progress({total}, "train", "steps", done=5) as bar:
    for step in range(5, 10):
        time.sleep(0.1)
        bar.set_postfix(loss=1 / (step + 1), refresh=False)
        bar.update()
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
    assert lines_of(30, 10) == []  # a short job


def test_a_terminal_shows_a_bar() -> None:
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(theirs, (24, 100))
    code = JOB.format(first=30, total=10)
    with subprocess.Popen([sys.executable, "-c", code], stderr=theirs) as process:
        os.close(theirs)
        shown = b""
        with suppress(OSError):  # the other end is closed
            while chunk := os.read(ours, 4096):
                shown += chunk
        assert process.wait() == 0
    os.close(ours)
    assert b"train: 100%" in shown
    assert b"loss=0.1" in shown
