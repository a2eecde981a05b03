"""Kills, interruptions and pairs of processes."""

import random
import shutil
import signal
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.support.signals import wait_until_handled
from tests.torture.children import End, Running, command, leftovers, run, run_first, run_fresh
from tests.torture.inputs import Inputs, Job, digest_output

_FRESH_KILLS, _FRESH_INTERRUPTIONS = 20, 4
"""Every such case is a new interpreter, signalled from its very start; the others are forks."""
_START = 3.0
"""Seconds that a new interpreter needs, at most, before a command begins."""


@dataclass(frozen=True)
class Ends:
    """Cases of one command."""

    inputs: Inputs
    job: Job
    expected: str
    """What the output says if the command is left alone."""
    seconds: float
    """Seconds that the command takes in a fork."""
    folder: Path

    @classmethod
    def of(cls, inputs: Inputs, job: Job, folder: Path) -> "Ends":
        """Run the command twice, the second time with everything imported."""
        for number, start in enumerate((run_first, run)):
            out = folder / f"{job.name}-{number}{job.suffix}"
            end = start(*job.arguments(out))
            if end.status:
                raise SystemExit(f"{job.name}: {end.printed}")
        return cls(inputs, job, digest_output(out), end.seconds, folder)

    def kills(self, cases: int, seed: int) -> Counter[str]:
        """Kill the command at a random moment, look at its output, run it again, and look again."""
        counts = Counter[str]()
        for generator, out, fresh in self._places("kill", cases, seed, counts, _FRESH_KILLS):
            end = self._signal(generator, out, signal.SIGKILL, fresh)
            counts["killed"] += end.status == -signal.SIGKILL
            # What is there must be whole; a training's folder may be one that is resumed.
            if out.exists() and self.job.name != "train":
                self._compare(counts, out)
            if not (self.job.name in ("collect", "prepare") and out.exists()):
                self._count(counts, run(*self.job.arguments(out)).fault([0]))
            self._compare(counts, out)
        return counts

    def interruptions(self, cases: int, seed: int) -> Counter[str]:
        """Ctrl-C and TERM at random moments."""
        counts, places = Counter[str](), ("interrupt", cases, seed)
        for generator, out, fresh in self._places(*places, counts, _FRESH_INTERRUPTIONS):
            sent = (signal.SIGINT, signal.SIGTERM)[generator.randrange(2)]
            end = self._signal(generator, out, sent, fresh)
            self._count(counts, end.fault([0, 128 + sent, -sent]))
            counts["interrupted"] += end.status in (128 + sent, -sent)
            if end.status == -sent:
                # An interpreter that finalises has no handlers any more; all must be done by then.
                self._count(counts, f"says {end.printed[:80]}" if end.printed else "")
                self._compare(counts, out)
        return counts

    def pairs(self, cases: int, seed: int) -> Counter[str]:
        """Two processes with one output: one winner, and one clear line or a wait for the other."""
        counts = Counter[str]()
        for generator, out, _ in self._places("pair", cases, seed, counts):
            both = []
            for _ in range(2):
                both.append(Running(command(*self.job.arguments(out))))
                time.sleep(generator.uniform(0, 0.5 * self.seconds))
            ends = [running.wait() for running in both]
            for end in ends:
                self._count(counts, end.fault([0, 2]))
            statuses = sorted(end.status for end in ends)
            # A training that ended before the second began is resumed by it, with nothing to do.
            both_may_win = self.job.waits or self.job.name == "train"
            if statuses != [0, 2] and not (both_may_win and statuses == [0, 0]):
                self._count(counts, f"ends {statuses}")
            refused = next((end.printed for end in ends if end.status == 2), "")
            if refused and "is being" not in refused and "exists already" not in refused:
                self._count(counts, f"says {refused[:80]}")
            counts["refused"] += bool(refused)
            self._compare(counts, out)
        return counts

    def _places(
        self, name: str, cases: int, seed: int, counts: Counter[str], fresh: int = 1
    ) -> Iterator[tuple[random.Random, Path, bool]]:
        """Output paths in folders that must be clean afterwards; whether it is a `fresh`-th one."""
        generator = random.Random(f"{seed} {self.job.name}")
        for number in range(cases):
            place = self.folder / f"{name}-{number}"
            place.mkdir()
            yield generator, place / f"out{self.job.suffix}", number % fresh == fresh - 1
            left = leftovers(place, self.inputs.folder)
            self._count(counts, f"leaves {len(left)}: {left[0]}" if left else "")
            shutil.rmtree(place)

    def _signal(self, generator: random.Random, out: Path, sent: int, fresh: bool) -> End:
        """Run the command, `fresh` in a new interpreter, and send a signal at a random moment."""
        moment = generator.uniform(0, 1.05 * self.seconds)
        if fresh:
            moment += generator.uniform(0, _START)
            return run_fresh(*self.job.arguments(out), number=sent, moment=moment)
        running = Running(command(*self.job.arguments(out)))
        if sent != signal.SIGKILL:
            # A fork has Python's own handlers until the first line of the command.
            wait_until_handled(running.pid, signal.SIGTERM)
        time.sleep(moment)
        running.send(sent)
        return running.wait()

    def _compare(self, counts: Counter[str], out: Path) -> None:
        if not out.exists():
            self._count(counts, "no result")
        elif digest_output(out) != self.expected:
            self._count(counts, "another result")

    def _count(self, counts: Counter[str], fault: str) -> None:
        if fault:
            counts[fault] += 1
