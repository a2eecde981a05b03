"""Settings of every test: one thread, and the same examples every time."""

from collections.abc import Iterator

import pytest
import torch
from hypothesis import settings

settings.register_profile("ucfrec", deadline=None, derandomize=True, database=None, max_examples=40)
settings.load_profile("ucfrec")


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> Iterator[None]:
    """Small tensors gain nothing from threads, and other processes share the cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
