"""The error that ucfrec raises for input that a user can correct, and messages on one line."""

import errno
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class InputError(ValueError):
    """A file, value or combination of settings that ucfrec cannot use.

    The message is one line: what is wrong, where (file, column, row count) and what to do. The
    command line prints it and exits with status 2.
    """

    def __init__(self, message: str) -> None:
        """`message` may quote text of files: see `one_line`."""
        super().__init__(one_line(message))


class InputNote(UserWarning):
    """Something about an input that a user should know; the command line prints it as one line."""


def warn_user(message: str) -> None:
    """Warn of something about an input, on behalf of the caller's caller."""
    warnings.warn(message, InputNote, stacklevel=3)


@contextmanager
def damage_explained(path: Path | str, remedy: str) -> Iterator[None]:
    """Turn errors over the content of the file `path` into one `InputError`."""
    try:
        yield
    except InputError:
        raise
    except _FAULTS as error:
        what = f"{path} is damaged ({type(error).__name__}: {error})"
        raise InputError(f"{what}; {remedy}") from None


_FAULTS = (
    *(LookupError, TypeError, ValueError, AttributeError, OverflowError),
    *(RuntimeError, ZeroDivisionError),
)
"""What using values of another type, shape or range raises."""


def one_line(text: str) -> str:
    """`text` without line breaks (each becomes a space) and with other control characters escaped.

    Names and values of foreign files could otherwise forge lines of output or steer a terminal.
    """
    text = " ".join(part for part in text.split("\n") if part.strip()) if "\n" in text else text
    if text.isprintable():
        return text
    spaced = (" " if character.isspace() else character for character in text)
    return "".join(
        character if character.isprintable() else repr(character)[1:-1] for character in spaced
    )


def explain_os_error(error: OSError) -> str:
    """What went wrong and what to do, on one line, for an error of the operating system."""
    names = [
        os.fsdecode(f) for f in (error.filename, error.filename2) if isinstance(f, str | bytes)
    ]
    what = error.strerror or str(error) or "input or output failed"
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        what += "; nothing was written; free space and run again"
    return one_line(f"{' → '.join(names)}: {what}" if names else what)
