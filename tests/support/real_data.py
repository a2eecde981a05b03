"""What several test files share."""

import os
from pathlib import Path

import pytest


def data_folder(name: str) -> Path:
    """The folder `name` of the real data, or skip the test where it is absent."""
    folder = Path(os.environ["UCFREC_DATA"]) / name
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set UCFREC_DATA to the folder that holds {name}/")
    return folder
