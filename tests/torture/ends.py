"""Kills, interruptions and pairs of processes."""

import json
import random
import shutil
import signal
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.support.signals import wait_until_handled
from tests.torture.children import End, Running, leftovers, run_first, traced
from tests.torture.inputs import Inputs, Job, digest_output

_REFUSED = ("is being", "exists already", "cannot listen")


@dataclass(frozen=True)
class Ends:
    """Cases of one command."""

    inputs: Inputs
    job: Job
    folder: Path
    expected: str
    """What the output says if the command is left alone."""
    seconds: float
    """Seconds that the command takes in a fork."""
    aims: list[tuple[int, int]]
    """Steps at which the command writes, by number, and the calls until the next step."""

    @classmethod
    def of(cls, inputs: Inputs, folder: Path, job: Job) -> "Ends":
        """Run the command three times: to import everything, for its time, and for its steps."""
        from ucfrec.files.atomic import LOCK

        answer, seconds = folder / "steps.json", 0.0
        for number in range(3):
            place = folder / f"{job.name}-{number}"
            place.mkdir()
            work = inputs.work(job, place / job.out)
            end = run_first(traced(work, place, answer) if number == 2 else work)
            if end.status:
                raise SystemExit(f"{job.name}: {end.printed}")
            seconds = seconds if number == 2 else end.seconds
        # What a search does not finish, it starts anew.
        others = ("os.rename", "/trial-", "/promotable", LOCK)
        aims = [
            (number, calls)
            for number, (step, calls) in enumerate(json.loads(answer.read_text()))
            if calls and not any(word in step for word in others)
        ]
        return cls(inputs, job, folder, digest_output(place / job.out), seconds, aims)

    def kills(self, cases: int, seed: int) -> Counter[str]:
        """Kill the command while it writes or at any moment; look, run it again, look again."""
        counts = Counter[str]()
        for generator, out, number in self._places("kill", cases, seed, counts):
            work = self.inputs.work(self.job, out)
            if number % 3 < 2:
                step, calls = generator.choice(self.aims)
                # A file is not whole for some calls after it is opened.
                at = step, generator.randint(1, min(calls, generator.choice((4, calls))))
                end = Running(traced(work, out.parent, self.folder / "steps.json", at)).wait()
            else:
                end = self._signal(generator, out, signal.SIGKILL)
            counts["killed"] += end.status == -signal.SIGKILL
            there = out.is_file() or any(out.glob("[!.]*"))
            if there:
                # A training that is resumed has a part of its files, each of them whole.
                self._compare(counts, out, "killed: ", self.job.second == "resumes")
            if not (there and self.job.second == "refused"):
                end = Running(work).wait()
                self._count(counts, end.fault([0]) and f"run again: {end.fault([0])}")
            self._compare(counts, out)
        return counts

    def interruptions(self, cases: int, seed: int) -> Counter[str]:
        """Ctrl-C and TERM at random moments."""
        counts = Counter[str]()
        for generator, out, _ in self._places("interrupt", cases, seed, counts):
            sent = (signal.SIGINT, signal.SIGTERM)[generator.randrange(2)]
            end = self._signal(generator, out, sent)
            self._count(counts, end.fault([0, 128 + sent, -sent]))
            counts["interrupted"] += end.status in (128 + sent, -sent)
            if end.status == -sent:
                # An interpreter that finalises has no handlers any more; all must be done by then.
                self._count(counts, end.printed and f"says {end.printed[:80]}")
                self._compare(counts, out)
        return counts

    def pairs(self, cases: int, seed: int) -> Counter[str]:
        """Two processes with one output: one winner, and one clear line or a wait for the other."""
        counts = Counter[str]()
        for generator, out, _ in self._places("pair", cases, seed, counts):
            both = []
            for _ in range(2):
                both.append(Running(self.inputs.work(self.job, out)))
                time.sleep(generator.uniform(0, 0.5 * self.seconds))
            ends = [running.wait() for running in both]
            # The client of the second server may end it before it finds the address taken.
            allowed = [0, 2, 143] if self.job.second == "serves" else [0, 2]
            for end in ends:
                self._count(counts, end.fault(allowed))
            statuses = sorted(end.status for end in ends)
            if statuses[0] or (self.job.second == "refused" and statuses[1] != 2):
                self._count(counts, f"ends {statuses}")
            refused = next((end.printed for end in ends if end.status == 2), "")
            said = any(words in refused for words in _REFUSED)
            self._count(counts, "" if said or not refused else f"says {refused[:80]}")
            counts["refused"] += bool(refused)
            self._compare(counts, out)
        return counts

    def _places(
        self, name: str, cases: int, seed: int, counts: Counter[str]
    ) -> Iterator[tuple[random.Random, Path, int]]:
        """Output paths in folders that must be clean afterwards, and numbers of cases."""
        generator = random.Random(f"{seed} {self.job.name}")
        for number in range(cases):
            place = self.folder / f"{name}-{number}"
            place.mkdir()
            yield generator, place / self.job.out, number
            left = leftovers(place, self.inputs.folder)
            self._count(counts, f"leaves {len(left)}: {left[0]}" if left else "")
            shutil.rmtree(place)

    def _signal(self, generator: random.Random, out: Path, sent: int) -> End:
        """Run the command, and send a signal at a random moment."""
        running = Running(self.inputs.work(self.job, out))
        if sent != signal.SIGKILL:
            # A fork has Python's own handlers until the first line of the command.
            wait_until_handled(running.pid, signal.SIGTERM)
        time.sleep(generator.uniform(0, 1.05 * self.seconds))
        running.send(sent)
        return running.wait()

    def _compare(self, counts: Counter[str], out: Path, when: str = "", part: bool = False) -> None:
        """Check that the output is whole and says what is expected, or is a `part` of it."""
        try:
            same = digest_output(out) == self.expected if out.exists() else False
        except Exception as error:
            self._count(counts, f"{when}not whole: {type(error).__name__} {error!s:.80}")
        else:
            self._count(counts, "" if same or part else f"{when}no result, or another")

    def _count(self, counts: Counter[str], fault: str) -> None:
        if fault:
            counts[fault] += 1
