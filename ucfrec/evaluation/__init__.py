"""Evaluation of policies: simulated environments, and ranking on later logs."""
