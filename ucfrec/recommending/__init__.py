"""The next items for users of a log."""
