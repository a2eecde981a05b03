"""Settings of every test: one thread, short validations, and the same examples every time."""

import os
import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

settings.register_profile("ucfrec", deadline=None, derandomize=True, database=None, max_examples=25)
settings.load_profile("ucfrec")
os.environ.setdefault("UCFREC_DATA", str(Path(__file__).parents[2] / "shared" / "data"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The file that takes longest comes first, so that no worker is left with it at the end."""
    items.sort(key=lambda item: item.path.name != "test_examples.py")


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> Iterator[None]:
    """Small tensors gain nothing from threads, and other processes share the cores."""
    import torch  # not above: the process that hands out the tests reads this file, too

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True, scope="session")
def few_windows() -> Iterator[None]:
    """A training of a few steps would spend most of its time validating."""
    from tests.support.short_validation import short_validation

    with short_validation():
        yield


@pytest.fixture(scope="session")
def spark() -> Iterator[Any]:
    """A small local session, which commands use in place of one of their own."""
    sql = pytest.importorskip("pyspark.sql")
    if shutil.which("java") is None and "JAVA_HOME" not in os.environ:
        pytest.skip("Java is missing")
    os.environ.setdefault("PYSPARK_PYTHON", sys.executable)
    builder = sql.SparkSession.builder.master("local[2]").config("spark.ui.enabled", "false")
    interrupted = signal.getsignal(signal.SIGINT)
    session = builder.config("spark.sql.shuffle.partitions", "3").getOrCreate()
    signal.signal(signal.SIGINT, interrupted)  # other tests interrupt themselves
    yield session
    session.stop()
