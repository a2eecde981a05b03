"""The process: how it ends, with its parent too; memory; random state; progress on stderr."""

import ctypes
import io
import mmap
import os
import random
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from contextvars import ContextVar
from importlib import import_module
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor

    from tqdm import tqdm

Progress: TypeAlias = "tqdm[Any]"
FIRST_LINE = 10.0
"""Seconds before the first line of progress without a terminal; a shorter job prints nothing."""
NEXT_LINE = 30.0
"""Seconds between lines."""
_AGAIN = 0.1
"""Seconds after which an interruption that a library swallowed is raised again."""
_BLAS = 128 * 2**20
"""Bytes that OpenBLAS asks the operating system for at its first use, and some more."""
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4  # of malloc.h
_LABEL: ContextVar[str] = ContextVar("label", default="")
"""Which of several jobs at the same time this is; empty for the only one."""
_PHASE: ContextVar[str] = ContextVar("phase", default="")


class Interrupted(KeyboardInterrupt):
    """Raised in the main thread by Ctrl-C or TERM, which have the number `number`."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.status = 128 + number
        """Exit status of a process that ends by this signal."""


def run_program(module: str) -> int:
    """Run the `main` of a module with the arguments of this process; returns its exit status.

    Until it is imported, Ctrl-C and TERM end the process with one line and status 130 or 143; once
    it has ended, they change nothing: without this, Python would give the signals back to the
    operating system while it ends, and the process would count as killed. Characters that the
    encoding of stdout lacks are replaced: a file name that is not Unicode must not end a command.
    """
    _handle_signals(_end)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    main: Callable[[], int] = import_module(module).main
    try:
        return main()
    finally:
        _handle_signals(signal.SIG_IGN)
        if atomic := sys.modules.get("ucfrec.files.atomic"):
            atomic.release_locks()


def _end(number: int, _: FrameType | None) -> NoReturn:
    os.write(2, b"interrupted\n")
    os._exit(128 + number)


def _handle_signals(handler: Any) -> dict[signal.Signals, Any]:
    """Set the handler of Ctrl-C and TERM; returns those that they had. HUP, of a terminal that is
    closed, counts as TERM, unless it is ignored, as under nohup."""
    ending = (signal.SIGINT, signal.SIGTERM)
    if sys.platform != "win32" and signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        signal.signal(signal.SIGHUP, lambda *_: signal.raise_signal(signal.SIGTERM))
    return {number: signal.signal(number, handler) for number in ending}


@contextmanager
def interruptions_raised() -> Iterator[None]:
    """Raise `Interrupted` in the block on Ctrl-C and TERM, even where a library swallows it.

    Whatever else is raised after a signal came is a consequence of it: an import that was cut off
    raises an `ImportError`, a cursor that was closed an error of the database. It leaves the block
    as `Interrupted`, too. Has no effect but in the main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def interrupt(number: int, _: FrameType | None) -> None:
        came.append(number)
        raise Interrupted(number)

    def unraisable(unraised: "sys.UnraisableHookArgs") -> None:
        # A callback of a library cannot pass exceptions on; Python reports them and goes on.
        if not came:
            reported(unraised)
        elif issubclass(unraised.exc_type, KeyboardInterrupt):
            timer = threading.Timer(_AGAIN, signal.raise_signal, (came[0],))
            timer.daemon = True
            timer.start()

    handlers = _handle_signals(interrupt)
    reported, sys.unraisablehook = sys.unraisablehook, unraisable
    try:
        yield
    except BaseException:
        if came:
            raise Interrupted(came[0]) from None
        raise
    finally:
        sys.unraisablehook = reported
        for number, handler in handlers.items():
            signal.signal(number, handler)


@contextmanager
def block_ctrl_c() -> Iterator[None]:
    """Processes that are started in the block are not reached by Ctrl-C; their parent ends them."""
    if sys.platform == "win32":
        yield
        return
    from multiprocessing import resource_tracker

    # Starting the first process starts the tracker, too, which lets Ctrl-C through again.
    resource_tracker.ensure_running()
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextmanager
def pool_of_processes(
    workers: int, begin: Callable[[], None] | None = None
) -> "Iterator[ProcessPoolExecutor]":
    """Yield a pool whose processes end when the block raises, and when this process is killed.

    Submit work within `block_ctrl_c`: Ctrl-C on a terminal reaches every process of a command, and
    this one ends the others. Each process first calls `begin`, a function of a module.
    """
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, spawn, initializer=_begin, initargs=(begin,))
    try:
        yield pool
    except BaseException:
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(begin: Callable[[], None] | None) -> None:
    """End when the parent has ended, also when it was killed; call `begin`."""
    import multiprocessing  # takes longer than the rest of this module

    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(128 + signal.SIGTERM)

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()
    if begin is not None:
        begin()


def require_blas_memory() -> None:
    """Raise MemoryError where there is none for linear algebra.

    Where the operating system refuses, OpenBLAS asks again for ever, in code that no signal ends.
    """
    try:
        mmap.mmap(-1, _BLAS).close()
    except OSError as error:
        raise MemoryError(f"no {_BLAS / 2**20:.0f} MB for linear algebra") from error


def keep_freed_memory() -> None:
    """Keep freed memory for new tensors, whose pages took longer to get than to use (glibc)."""
    with suppress(AttributeError, OSError, TypeError):
        for option, value in ((_TRIM_THRESHOLD, 2**29), (_MMAP_MAX, 0)):
            ctypes.CDLL(None).mallopt(option, value)


@contextmanager
def random_state_kept() -> Iterator[None]:
    """Restore the global generators of torch (every device), numpy and `random` on exit."""
    import numpy as np  # commands that compute nothing need neither
    import torch

    python_state, numpy_state = random.getstate(), np.random.get_state()  # noqa: NPY002
    devices = range(torch.cuda.device_count())
    try:
        with torch.random.fork_rng(devices=devices):
            yield
    finally:
        random.setstate(python_state)
        np.random.set_state(numpy_state)  # noqa: NPY002


@contextmanager
def progress(
    total: float | None,
    job: str,
    unit: str,
    done: float = 0,
    shown: bool = True,
) -> Iterator[Progress]:
    """Display on stderr the finished share of a job, its rate and the estimated time left.

    On a terminal this is a bar; elsewhere, plain lines at intervals.

    Args:
        total: units of the whole job; None if unknown.
        job: name of the job, e.g. "train".
        unit: what is counted, in the plural, e.g. "steps".
        done: units that were finished before this process resumed the job, outside the rate.
        shown: whether this process displays anything.
    """
    from tqdm import tqdm

    if not hasattr(tqdm, "_lock"):
        tqdm.set_lock(threading.RLock())  # one between processes would import multiprocessing
    label = _LABEL.get()
    layout: dict[str, Any] = {"unit_scale": total is None or total >= 100_000, "disable": not shown}
    # Bars of several processes would overwrite each other.
    if label or not sys.stderr.isatty():
        tqdm.monitor_interval = 0  # no thread: every update looks at the clock
        layout |= {"delay": FIRST_LINE, "mininterval": NEXT_LINE, "miniters": 1}
        layout |= {"ncols": 0, "file": _Lines()}
    name = ": ".join(filter(None, (label, _PHASE.get(), job)))
    with tqdm(total=total, desc=name, unit=f" {unit}", initial=done, **layout) as bar:
        yield bar


@contextmanager
def label_progress(name: str, label: ContextVar[str] = _LABEL) -> Iterator[None]:
    """Name this job in the progress of all that it does, as one of several at the same time."""
    token = label.set(name)
    try:
        yield
    finally:
        label.reset(token)


def phase(doing: str, number: int, of: int) -> AbstractContextManager[None]:
    """Name the phase of a long job, e.g. `Fitting the reward model (2 of 5)`, in its progress."""
    return label_progress(f"{doing} ({number} of {of})", _PHASE)


class _Lines:
    """Stderr of a job without a terminal: every state of tqdm's bar is a line of its own."""

    def write(self, text: str) -> None:
        if text := text.strip("\r\n "):
            print(text, file=sys.stderr)

    def flush(self) -> None:
        sys.stderr.flush()
