"""Simulating episodes in simulated environments with a trained or built-in policy."""
