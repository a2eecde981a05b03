"""Offline control benchmarks (D4RL, AntMaze) with the policies of ucfrec."""
