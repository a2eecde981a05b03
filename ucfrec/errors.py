"""The error that ucfrec raises for input that a user can correct."""


class InputError(ValueError):
    """A file, value or combination of settings that ucfrec cannot use.

    The message is one line: what is wrong, where (file, column, row count) and what to do. The
    command line prints it and exits with status 2.
    """
