"""Kills, interruptions and pairs of processes."""

import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

from tests.torture.children import TIMEOUT, End, Running, command, leftovers, run
from tests.torture.made import Inputs, Job, said


def references(inputs: Inputs, folder: Path) -> dict[str, tuple[str, float]]:
    """What every job says when it is left alone, and the seconds that it takes."""
    known = {}
    for job in inputs.jobs():
        out = folder / f"{job.name}{job.suffix}"
        end = run(*job.arguments(out))
        if end.status:
            raise SystemExit(f"{job.name}: {end.printed}")
        known[job.name] = (said(out), end.seconds)
    return known


def kills(
    inputs: Inputs, known: dict[str, tuple[str, float]], folder: Path, cases: int, seed: int
) -> Counter[str]:
    """Kill a command at a random moment, run it again, and compare what comes out."""
    generator, faults = random.Random(seed), Counter[str]()
    jobs = inputs.jobs()
    for number in range(cases):
        job = jobs[number % len(jobs)]
        expected, seconds = known[job.name]
        place = folder / f"kill-{number}"
        place.mkdir()
        out = place / f"out{job.suffix}"
        running = Running(command(*job.arguments(out)))
        time.sleep(generator.uniform(0, 1.05 * seconds))
        running.send(signal.SIGKILL)
        first = running.wait()
        faults["killed"] += first.status == -signal.SIGKILL
        if job.name in ("collect", "prepare") and out.exists():
            faults[f"{job.name}: differs"] += said(out) != expected
            shutil.rmtree(place)
            continue
        again = run(*job.arguments(out))
        _count(faults, job, again.fault([0]))
        if again.status == 0 and said(out) != expected:
            faults[f"{job.name}: another result"] += 1
        left = leftovers(place, inputs.folder)
        faults[f"{job.name}: leaves {len(left)}"] += bool(left)
        shutil.rmtree(place)
    return faults


def interruptions(
    inputs: Inputs, known: dict[str, tuple[str, float]], folder: Path, cases: int, seed: int
) -> Counter[str]:
    """Ctrl-C and TERM at random moments, every fourth time in a process from its very start."""
    generator, faults = random.Random(seed), Counter[str]()
    jobs = inputs.jobs()
    for number in range(cases):
        job = jobs[generator.randrange(len(jobs))]
        seconds = known[job.name][1]
        sent = (signal.SIGINT, signal.SIGTERM)[number % 2]
        place = folder / f"interrupt-{number}"
        place.mkdir()
        out = place / f"out{job.suffix}"
        if number % 4 == 3:
            end = _from_the_start(job, out, sent, generator.uniform(0.1, 3.0 + seconds))
        else:
            running = Running(command(*job.arguments(out)))
            # A fork has Python's own handlers until the first line of the command.
            time.sleep(0.05 + generator.uniform(0, 1.05 * seconds))
            running.send(sent)
            end = running.wait()
        _count(faults, job, end.fault([0, 128 + sent]))
        faults["interrupted"] += end.status == 128 + sent
        left = leftovers(place, inputs.folder)
        faults[f"{job.name}: leaves {len(left)}"] += bool(left)
        shutil.rmtree(place)
    return faults


def _from_the_start(job: Job, out: Path, sent: signal.Signals, moment: float) -> End:
    arguments = [sys.executable, "-m", "ucfrec", *map(str, job.arguments(out))]
    start = time.monotonic()
    started = subprocess.Popen(
        arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    time.sleep(moment)
    started.send_signal(sent)
    try:
        _, printed = started.communicate(timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        started.kill()
        return End(1, "", time.monotonic() - start, hung=True)
    return End(started.returncode, printed, time.monotonic() - start)


def pairs(
    inputs: Inputs, known: dict[str, tuple[str, float]], folder: Path, cases: int, seed: int
) -> Counter[str]:
    """Two processes with one output: one winner, and one clear line or a wait for the other."""
    generator, faults = random.Random(seed), Counter[str]()
    jobs = inputs.jobs()
    for number in range(cases):
        job = jobs[number % len(jobs)]
        expected, seconds = known[job.name]
        place = folder / f"pair-{number}"
        place.mkdir()
        out = place / f"out{job.suffix}"
        both = []
        for _ in range(2):
            both.append(Running(command(*job.arguments(out))))
            time.sleep(generator.uniform(0, 0.5 * seconds))
        ends = [running.wait() for running in both]
        for end in ends:
            _count(faults, job, end.fault([0, 2]))
        statuses = sorted(end.status for end in ends)
        # A training that ended before the second began is resumed by it, with nothing to do.
        both_may_win = job.waits or job.name == "train"
        if statuses != [0, 2] and not (both_may_win and statuses == [0, 0]):
            faults[f"{job.name}: ends {statuses}"] += 1
        refused = next((end.printed for end in ends if end.status == 2), "")
        if refused and "is being" not in refused and "exists already" not in refused:
            faults[f"{job.name}: says {refused[:80]}"] += 1
        faults["refused"] += bool(refused)
        if said(out) != expected:
            faults[f"{job.name}: another result"] += 1
        left = leftovers(place, inputs.folder)
        faults[f"{job.name}: leaves {len(left)}"] += bool(left)
        shutil.rmtree(place)
    return faults


def _count(faults: Counter[str], job: Job, fault: str) -> None:
    if fault:
        faults[f"{job.name}: {fault}"] += 1
