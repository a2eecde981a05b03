"""Environments and normalised scores."""
