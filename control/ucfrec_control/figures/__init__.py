"""Pictures of the paper, from stored results."""
