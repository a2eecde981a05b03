"""The default folder of the environments' files."""

import os
from pathlib import Path


def data_folder(name: str) -> Path:
    """The folder `name` in `UCFREC_DATA`, by default in `data`."""
    return Path(os.environ.get("UCFREC_DATA", "data")) / name
