"""Training runs: configuration, training, run folders, and policies loaded from them."""
