"""Settings of every test: one thread, and the same examples every time."""

from collections.abc import Iterator
from importlib.util import find_spec

import pytest
import torch
from hypothesis import settings

settings.register_profile("ucfrec", deadline=None, derandomize=True, database=None, max_examples=40)
settings.load_profile("ucfrec")


# The control adapter's tests need its extra.
CONTROL = ("h5py", "matplotlib", "minari", "mujoco")
collect_ignore_glob = [] if all(map(find_spec, CONTROL)) else ["test_control_*.py"]


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> Iterator[None]:
    """Small tensors gain nothing from threads, and other processes share the cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
