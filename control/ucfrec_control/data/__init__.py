"""Trajectories: reading, writing and collecting them."""
