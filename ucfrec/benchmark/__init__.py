"""Benchmarks: cells of methods and tasks, their budgets, plan, workers, time and tables."""
