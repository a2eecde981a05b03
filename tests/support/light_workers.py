"""Workers that import nothing heavy: what `tests/recommending/test_server.py` starts."""

import os
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path

from ucfrec.processes import Interrupted, interruptions_raised
from ucfrec.recommending.server import Parent, Workers, listening_socket


class Ends:
    """What a parent ends."""

    should_exit = force_exit = False


def answer(listening: socket.socket, parent: Parent) -> None:
    """Send each client the number of this process; at the end, take a second or be forced."""
    ends = Ends()
    parent.ends(ends)  # type: ignore[arg-type]
    listening.listen()
    listening.settimeout(0.05)
    parent.report("ready", "light workers")
    while not ends.should_exit:
        with suppress(TimeoutError), listening.accept()[0] as client:
            client.sendall(str(os.getpid()).encode())
    until = time.monotonic() + 1
    while not ends.force_exit and time.monotonic() < until:
        time.sleep(0.02)
    # In one write, as both workers write to the same pipe.
    os.write(1, b"forced\n" if ends.force_exit else b"in order\n")


def refuse(listening: socket.socket, parent: Parent) -> None:
    """Cannot start."""
    parent.report("failed", "no model")


def refuse_later(listening: socket.socket, parent: Parent) -> None:
    """The first two can start; later ones cannot."""
    for name in ("first", "second"):
        with suppress(FileExistsError):
            Path(os.environ["LIGHT_WORKERS"], name).touch(exist_ok=False)
            return answer(listening, parent)
    parent.report("failed", "no model")


def main() -> None:
    """Two workers of the function that is named, until Ctrl-C or TERM."""
    work = {each.__name__: each for each in (answer, refuse, refuse_later)}[sys.argv[1]]
    with (
        suppress(Interrupted),
        interruptions_raised(),
        listening_socket("127.0.0.1", 0) as listening,
        Workers(work, listening) as workers,
    ):
        print(workers.start(2), listening.getsockname()[1], flush=True)
        workers.keep()


if __name__ == "__main__":
    main()
