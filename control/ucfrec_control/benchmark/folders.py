"""Where the control benchmarks keep their stores and runs."""

from pathlib import Path

from ucfrec.code_version import code_version
from ucfrec.runs.shared_stages import SharedStages
from ucfrec_control.data.distractor import zoo_store


def stores_of(folder: Path) -> Path:
    """The folder of the stores that this version of the code writes."""
    return folder / "stores" / code_version(zoo_store.__module__)


def stages_of(folder: Path) -> SharedStages:
    """Where runs share reward models and copies."""
    return SharedStages(folder / "stages")


def run_name(method: str, code: str, seed: int) -> str:
    """The folder name of a run, with the code's version: other code must not resume it."""
    return f"{method}-{code}-{seed}"
