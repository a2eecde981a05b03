"""Bring a run up to date with new logs, and compare it with the run that it came from."""
