"""Long tests of robustness: `make torture`, or `python -m tests.torture --scale 0.01`."""
