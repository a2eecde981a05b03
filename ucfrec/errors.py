"""The one error that a user of the toolkit is meant to read."""


class InputError(ValueError):
    """Something handed to ucfrec cannot be used as it is.

    The message is one line that names what is wrong, where (file, column, row count) and what to
    do. The command line prints it and exits with status 2.
    """
