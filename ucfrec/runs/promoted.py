"""Which run of a folder of runs is served: a small file that `ucfrec promote` replaces atomically.

The file names the current run and those before it, the latest last.
"""

from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field

from ucfrec.errors import InputError
from ucfrec.files.atomic import claim
from ucfrec.files.record import Record, Text
from ucfrec.runs.record import RunRecord, verify_run
from ucfrec.runs.trained_policy import TrainedPolicy

POINTER = "promoted.json"
_Name = Annotated[str, Field(strict=True, pattern=r"^\.*[^./][^/]*$")]  # leads to no other folder


class Promoted(Record):
    """The content of the pointer file."""

    FILE: ClassVar[str] = POINTER
    KIND: ClassVar[str] = f"a folder of runs that are served: it has no {POINTER}; promote one"
    REMEDY: ClassVar[str] = "promote a run again"

    current: _Name
    """Name of the run folder, beside the file."""
    fingerprint: Text
    """Of the run as it was promoted."""
    previous: tuple[_Name, ...] = ()

    def require_same(self, trained: TrainedPolicy) -> None:
        """Check that a run of that name is the one that was promoted, or raise InputError."""
        if self.fingerprint != trained.fingerprint:
            raise InputError(
                f"{trained.folder} is not the run that was promoted: {POINTER} has the fingerprint "
                f"{self.fingerprint}, the run {trained.fingerprint}; restore that run, or "
                "promote this one with --force"
            )


def promoted(folder: Path) -> Promoted | None:
    """What the pointer file of a folder says, None without one; InputError if it is damaged."""
    return Promoted.read(folder) if (folder / POINTER).is_file() else None


def promote(run: Path, force: bool = False) -> Promoted:
    """Make a run the current one of the folder that it lies in. InputError if the run is a link,
    not finished or damaged, or, without `force`, is not an update of the current run, or reliably
    worse by any measure."""
    if run.is_symlink():
        raise InputError(
            f"{run} is a link, and the run would be promoted in the folder where it really lies; "
            f"name the run itself, {run.resolve()}"
        )
    run = run.resolve()
    verify_run(run)
    folder = run.parent
    with claim(folder / POINTER, wait=True):
        pointer, fingerprint = promoted(folder), TrainedPolicy.load(run).fingerprint
        if pointer is None:
            return _write(run, fingerprint, ())
        again = pointer.current == run.name
        if not force and (pointer.current, pointer.fingerprint) != (run.name, fingerprint):
            _require_verdict(run, pointer)
        previous = pointer.previous if again else (*pointer.previous, pointer.current)
        # Written again too, so that a server tries again what it could not use.
        return _write(run, fingerprint, previous)


def promote_back(folder: Path) -> Promoted:
    """Return to the run that was current before the current one. InputError if there is none, or it
    is gone or damaged."""
    with claim(folder / POINTER, wait=True):
        pointer = promoted(folder)
        if pointer is None or not pointer.previous:
            raise InputError(f"{folder}: no run was current before; promote one")
        *previous, name = pointer.previous
        back = folder / name
        verify_run(back)
        return _write(back, TrainedPolicy.load(back).fingerprint, tuple(previous))


def _write(run: Path, fingerprint: str, previous: tuple[str, ...]) -> Promoted:
    pointer = Promoted(files={}, current=run.name, fingerprint=fingerprint, previous=previous)
    return pointer.write(run.parent)


def _require_verdict(run: Path, pointer: Promoted) -> None:
    update = RunRecord.read(run).update
    fault = ""
    current = run.parent / pointer.current
    if update is None or update.verdict is None:
        fault = f"has no verdict against the current run {current.name}"
    elif update.run != TrainedPolicy.load(current, split=True).fingerprint:
        fault = f"was compared with {update.of}, not with the current run {current.name}"
    elif harms := update.verdict.harms:
        fault = f"is worse than {current.name}: {harms}"
    if fault:
        raise InputError(f"{run} {fault}; compare them, and add --force to promote it all the same")
    pointer.require_same(TrainedPolicy.load(current))
