"""Policies judged from logs alone."""
