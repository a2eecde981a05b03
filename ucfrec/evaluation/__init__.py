"""Policies judged in simulated worlds."""
