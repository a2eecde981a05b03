"""A run: its configuration, its training and what is read back from it."""
