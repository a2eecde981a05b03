"""The error that ucfrec raises for input that a user can correct, and messages on one line."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class InputError(ValueError):
    """A file, value or combination of settings that ucfrec cannot use.

    The message is one line: what is wrong, where (file, column, row count) and what to do. The
    command line prints it and exits with status 2.
    """

    def __init__(self, message: str) -> None:
        """
        Args:
            message: may quote text of files; line breaks and control characters in it are replaced,
                see `one_line`.
        """
        super().__init__(one_line(message))


class InputNote(UserWarning):
    """Something about an input that a user should know; the command line prints it as one line."""


@contextmanager
def damage_explained(path: Path | str, remedy: str) -> Iterator[None]:
    """Turn errors over the content of a file, which the block uses, into one `InputError`.

    Args:
        path: of the file, or words for what is used.

    Raises:
        InputError: an entry is missing or has another type or shape than the block needs.
    """
    try:
        yield
    except InputError:
        raise
    except _FAULTS as error:
        what = f"{type(error).__name__}: {error}"
        raise InputError(f"{path} is damaged ({what:.200}); {remedy}") from None


_FAULTS = (
    *(KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError),
    *(RuntimeError, RecursionError, ZeroDivisionError),
)
"""What using values of another type, shape or range raises."""


def one_line(text: str) -> str:
    """`text` without line breaks (each becomes a space) and with other control characters escaped.

    Names and values of foreign files could otherwise forge lines of output or steer a terminal.
    """
    text = " ".join(part for part in text.split("\n") if part.strip()) if "\n" in text else text
    if text.isprintable():
        return text
    return "".join(_visible(character) for character in text)


def _visible(character: str) -> str:
    if character.isprintable() or character.isspace():
        return " " if character.isspace() else character
    return character.encode("unicode_escape").decode("ascii")


def explain_os_error(error: OSError) -> str:
    """What went wrong and what to do, on one line, for an error of the operating system."""
    what, remedy = _OS_ERRORS.get(
        error.errno or 0, (error.strerror or str(error) or "input or output failed", "")
    )
    named = [
        os.fsdecode(f) for f in (error.filename, error.filename2) if isinstance(f, str | bytes)
    ]
    where = " → ".join(named)
    parts = f"{where}: {what}" if where else what
    return one_line(f"{parts}; {remedy}" if remedy else parts)


_DISK = "no space is left on its disk; nothing was written", "free space and run again"
_OS_ERRORS = {
    errno.ENOSPC: _DISK,
    errno.EDQUOT: ("the disk quota is used up; nothing was written", "free space and run again"),
    errno.EROFS: ("the file system is read-only", "write elsewhere"),
    errno.EACCES: ("no permission", "change its permissions or name another path"),
    errno.EPERM: ("not permitted", "change its permissions or name another path"),
    errno.ENOENT: (
        "does not exist, or was removed meanwhile",
        "check the path and run again",
    ),
    errno.ENOTDIR: ("a part of the path is a file, not a folder", "check the path"),
    errno.EISDIR: ("is a folder, a file is needed", "name a file"),
    errno.EEXIST: ("exists already", "remove it or name another path"),
    errno.ENOTEMPTY: (
        "another process has written it meanwhile; nothing was overwritten",
        "name another path",
    ),
    errno.ENAMETOOLONG: ("the name is too long for the file system", "shorten it"),
    errno.EFBIG: (
        "the file would be larger than this system or process may write",
        "raise the limit (ulimit -f) or write elsewhere",
    ),
    errno.ELOOP: ("too many symbolic links", "check the path"),
    errno.EMFILE: ("too many files are open in this process", "raise the limit (ulimit -n)"),
    errno.ENFILE: ("too many files are open on this machine", "close other programs"),
    errno.ENOMEM: ("out of memory", "close other programs or use smaller settings"),
    errno.EIO: ("the disk reports an input or output error", "check the disk"),
    errno.ESTALE: ("the network file system lost the file", "run again"),
    errno.ENOLCK: ("the file system offers no locks", "write to another file system"),
    errno.EXDEV: ("the folder lies on another file system", "write elsewhere"),
}
"""Error number to (what is wrong, what to do)."""
