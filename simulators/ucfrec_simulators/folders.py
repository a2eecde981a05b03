"""The default folder of the environments' files, and names of folders."""

import os
import re
from pathlib import Path


def data_folder(name: str) -> Path:
    """The folder `name` in `UCFREC_DATA`, or in ../shared/data."""
    return Path(os.environ.get("UCFREC_DATA", "../shared/data")) / name


def folder_name(name: str) -> str:
    """The name of a task or environment without characters that a path gives a meaning, such as
    "/"."""
    return re.sub(r"[^\w,.= -]+", "-", name)
