"""Offline control benchmarks (D4RL, AntMaze) on the core of ucfrec."""
