"""Stages of a training that several runs on one log have in common: made once, then copied."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from ucfrec import __version__
from ucfrec.files.atomic import atomic_file, atomic_folder
from ucfrec.files.locks import claim
from ucfrec.provenance import config_hash


@dataclass(frozen=True)
class SharedStages:
    """A folder with finished stages, each in a folder of its own; None shares nothing."""

    folder: Path | None

    def provide(
        self,
        inputs: Mapping[str, Any],
        stage: str,
        out: Path,
        names: Sequence[str],
        make: Callable[[], object],
    ) -> None:
        """Copy the files of a stage to the run folder `out`, or make them there and keep a copy.

        Another process that needs the same stage waits until it is made.

        Args:
            inputs: all that the stage depends on: data, settings, seed. Another version of the
                package makes its own.
            names: files and folders of the stage in `out`, those that are made; the last one marks
                the stage as finished, and is copied last. No file is ever there in part.
        """
        if self.folder is None:
            make()
            return
        stage_folder = self.folder / config_hash({**inputs, "stage": stage, "version": __version__})
        with claim(stage_folder, wait=True):
            if stage_folder.exists():
                _copy(stage_folder, out, names)
                return
            make()
            with atomic_folder(stage_folder) as scratch:
                _copy(out, scratch, names)


OWN: Final = SharedStages(None)
"""For a run that makes all its stages itself."""


def _copy(source: Path, to: Path, names: Sequence[str]) -> None:
    for name in names:
        if (source / name).is_dir():
            shutil.copytree(source / name, to / name, dirs_exist_ok=True, copy_function=_copy_file)
        elif (source / name).exists():
            _copy_file(source / name, to / name)


def _copy_file(source: str | Path, to: str | Path) -> None:
    with atomic_file(Path(to)) as scratch:
        shutil.copyfile(source, scratch)
