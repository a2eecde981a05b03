"""Evaluation of policies: simulated worlds, and ranking on later logs."""
