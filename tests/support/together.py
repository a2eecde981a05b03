"""Processes that train together, as `torchrun` would start them, but forked: that takes no time."""

import multiprocessing
import os
import socket
import traceback
from collections.abc import Callable
from pathlib import Path

import torch

from ucfrec.fitting.distributed import joined


def together(count: int, work: Callable[[], None], folder: Path) -> None:
    """Call `work` in each of `count` processes that have joined; assertions in them hold here."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    context = multiprocessing.get_context("fork")
    given = [(rank, count, port, work, folder) for rank in range(count)]
    children = [context.Process(target=_child, args=arguments) for arguments in given]
    for child in children:
        child.start()
    for child in children:
        child.join(120)
        child.kill()
    errors = [path.read_text() for path in sorted(folder.glob("error-*"))]
    assert not errors, errors[0]
    assert [child.exitcode for child in children] == [0] * count


def _child(rank: int, count: int, port: int, work: Callable[[], None], folder: Path) -> None:
    torch.set_num_threads(1)  # a fork has none of its parent's threads
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(count)}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    try:
        with joined():
            work()
    except BaseException:
        (folder / f"error-{rank}").write_text(traceback.format_exc())
        raise
