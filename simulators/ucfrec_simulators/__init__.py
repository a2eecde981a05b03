"""Worlds that sessions are played in: Gymnasium vector environments and their built-in policies."""
