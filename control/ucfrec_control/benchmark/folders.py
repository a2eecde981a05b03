"""Where the control benchmarks keep their stores and runs."""

from pathlib import Path

from ucfrec.runs.shared_stages import SharedStages


def stores_of(folder: Path) -> Path:
    """The folder of the stores."""
    return folder / "stores"


def stages_of(folder: Path) -> SharedStages:
    """Where runs share reward models and copies."""
    return SharedStages(folder / "stages")
