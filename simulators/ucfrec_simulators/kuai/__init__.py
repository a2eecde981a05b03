"""Worlds made from the Kuaishou logs."""
