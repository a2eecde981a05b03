"""The Python API: a policy as an object, and the frames and files that are given to it."""
