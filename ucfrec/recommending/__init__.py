"""Recommending next items to the users of a log."""
